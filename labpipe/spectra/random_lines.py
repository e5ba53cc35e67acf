"""All channels under random excitation: what is due to each recorded drive, which holds none of the
sensors' noise, and how far noise covers the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import DataError, SettingError
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel, SampleSource
from labpipe.records.response import Blocks
from labpipe.registry import nearest
from labpipe.spectra.channel_layout import ChannelLayout
from labpipe.spectra.channels import checked_blocks
from labpipe.spectra.covariance import noise_levels, residual_spectrum
from labpipe.spectra.feedback import feedback_of_records
from labpipe.spectra.matrices import hermitian
from labpipe.spectra.ports import LOW_COHERENCE, POOR_SHARE, select_lines
from labpipe.spectra.random import block_average, blocks_of, with_bursts
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.welch import CrossSpectra

LOW_SNR = 10.0
# A force's part that is due to what is injected, over the standard deviation of that part, below which it
# might as well be noise.
SILENT = 2.0


def check_injection(
    strength: FloatArray, frequency: FloatArray, injected: Sequence[str], forces: Sequence[str]
) -> None:
    """DataError where what is *injected* does not move the *forces* beyond their noise; *strength*
    (n_line,) [1] at *frequency* [Hz].
    """
    share = float(np.mean(strength < SILENT))
    if share <= POOR_SHARE:
        return
    what = (
        f"the reference {', '.join(injected)} does not move the force {', '.join(forces)} beyond its noise "
        f"at {100 * share:.0f} % of the lines in {frequency[0]:g}-{frequency[-1]:g} Hz"
    )
    raise DataError(
        what,
        hint="is it what is injected into this loop? Raise its level, record longer, or narrow `band` to it",
    )


@dataclass(frozen=True, kw_only=True)
class MeasuredLines:
    """frequency (n_line,) [Hz], vectors (n_line, n_run, n_channel) and covariance (n_line, n_run, n_channel,
    n_channel) [SI], as in ChannelSpectra; dof: complex degrees of freedom of the covariance; weak: outputs
    that are mostly noise; acting (n_line, n_run): where a force acts in a run, None for all lines.
    """

    frequency: FloatArray
    vectors: ComplexArray
    covariance: ComplexArray
    runs: tuple[str, ...]
    dof: float
    line_correlation: tuple[complex, ...] = ()
    blocks: Blocks | None = None
    findings: tuple[Finding, ...] = ()
    weak: set[str] = field(default_factory=set)
    acting: BoolArray | None = None


def snr_findings(
    vectors: ComplexArray, covariance: ComplexArray, channels: Sequence[Channel], excited: BoolArray
) -> tuple[tuple[Finding, ...], set[str]]:
    """Warnings where noise is large, and the names of the outputs among them; *vectors* and *covariance* [SI]
    as in MeasuredLines. Of forces line by line where they act, *excited* (n_line, n_run, n_channel), of
    responses in power over band and runs.
    """
    size = np.abs(vectors)
    noise = np.sqrt(np.maximum(np.einsum("lrcc->lrc", covariance).real, 0.0))
    findings: list[Finding] = []
    weak: set[str] = set()
    for number, channel in enumerate(channels):
        acting = excited[:, :, number]
        if channel.role == "input" and np.any(acting):
            share = float(np.mean((size < LOW_SNR * noise)[:, :, number][acting]))
            if share > POOR_SHARE:
                findings.append(low_snr(channel.name, f" at {100 * share:.0f} % of its lines"))
        signal, scatter = (np.sum(part[:, :, number] ** 2) for part in (size, noise))
        if channel.role == "output" and scatter * LOW_SNR**2 > signal:
            findings.append(low_snr(channel.name, ", in power over the band"))
            weak.add(channel.name)
    return tuple(findings), weak


def low_snr(label: str, where: str) -> Finding:
    """The warning of a channel whose signal is hardly above its noise, and *where*."""
    return Finding("low-snr", f"channel {label}: the signal is less than {LOW_SNR:g} times its noise{where}")


# Share of a drive's power that the others must leave it.
INDEPENDENT = 1e-3
DRIVES = ("voltage", "current")


def random_lines(
    sources: Sequence[SampleSource], settings: FrfSettings, layout: ChannelLayout
) -> MeasuredLines:
    """The part of all channels that is due to each drive, one run per drive, as amplitudes of a line as wide
    as a block's. DataError without recorded drives, for drives that are not independent, and for too few
    blocks.
    """
    drives = _drives(sources, settings, layout)
    spectra = [_welch(source, settings, layout, number, drives) for number, source in enumerate(sources)]
    chosen = select_lines(spectra[0].frequency, settings)
    weights = np.array([spectrum.n_block for spectrum in spectra], float)
    weights /= weights.sum()
    parts = [weight * spectrum.matrix[chosen] for weight, spectrum in zip(weights, spectra, strict=True)]
    matrix = np.asarray(sum(parts))
    averages = sum(spectrum.averages for spectrum in spectra)
    frequency = spectra[0].frequency[chosen]
    n, n_drive = len(layout.recorded), len(drives)
    if averages <= n_drive + 2:
        what = f"{averages:.2g} effective averages are too few for the noise of the channels"
        raise DataError(what, hint="record longer, or shorten `block`")
    lower = lower_of_drives(matrix[:, n:, n:], drives)
    transform = layout.transform(frequency)
    s_zr = transform @ matrix[:, :n, n:]
    s_zz = transform @ matrix[:, :n, :n] @ hermitian(transform)
    columns, left = due_to_drives(s_zz, s_zr, lower, averages)
    share = weights @ (np.array(layout.columns) >= 0)
    # Recordings without a channel are zeros in the mean, which is the noise of the others.
    noise = due_to_drives(matrix[:, :n, :n], matrix[:, :n, n:], lower, averages)[1]
    noise /= np.sqrt(np.outer(share, share))
    by_drive, dof = [noise] * n_drive, averages - n_drive
    if np.all(share == 1):
        first = [*range(n, n + n_drive), *range(n)]
        whole, *rest = (part[:, first][:, :, first] for part in (matrix, *parts))
        by_drive, dof = noise_by_drive(
            noise, whole, rest, [spectrum.averages for spectrum in spectra], n_drive
        )
    residual = np.stack([transform @ moved @ hermitian(transform) for moved in by_drive], axis=1)
    # The amplitude, 0 to peak, of the lines of one block.
    assert settings.block is not None
    width = 2 / settings.block
    covariance = residual * (width / averages)
    vectors = np.sqrt(width) * columns.swapaxes(1, 2)
    excited = np.zeros(vectors.shape, bool)
    excited[:, :, layout.inputs] = (
        np.abs(vectors[:, :, layout.inputs]) > 0.1 * np.max(np.abs(vectors), axis=1)[:, None, layout.inputs]
    )
    findings, weak = snr_findings(vectors, covariance, layout.channels, excited)
    for number in layout.inputs:
        moved = np.linalg.norm(columns[:, number], axis=1)
        error = np.sqrt(residual[:, :, number, number].real.mean(axis=1) / averages)
        strength = np.divide(moved, error, out=np.full(moved.shape, np.inf), where=moved > 0)
        check_injection(strength, frequency, drives, [layout.channels[number].name])
    forces, responses = (
        [channel.name for channel in layout.channels if channel.role == role] for role in ("input", "output")
    )
    fed_back = feedback_of_records(sources, drives, forces, responses)
    return MeasuredLines(
        frequency=frequency,
        vectors=vectors,
        covariance=covariance,
        runs=drives,
        dof=dof,
        line_correlation=tuple(complex(value) for value in spectra[0].line_correlation),
        blocks=with_bursts(blocks_of(spectra, settings, "H1"), spectra, sources),
        findings=(*findings, *_unexplained_findings(s_zz, left, layout), *fed_back),
        weak=weak,
    )


def _drives(sources: Sequence[SampleSource], settings: FrfSettings, layout: ChannelLayout) -> tuple[str, ...]:
    """The names of the drives: those of `reference`, else all voltages and currents of role reference;
    DataError where there are none. ConfigError where more of them stand beside fewer forces: a command that
    the loop makes is not a drive, and only its user knows it.
    """
    references = [channel for source in sources for channel in source.channels if channel.role == "reference"]
    names = tuple(dict.fromkeys(channel.name for channel in references if channel.quantity in DRIVES))
    if settings.reference:
        check_recorded(settings.reference, sources)
        names = settings.reference
    elif len(names) > len(layout.inputs) > 0:
        what = (
            f"{', '.join(names)} have the role reference, more than there are forces or currents "
            f"({len(layout.inputs)})"
        )
        hint = f"name what is injected from outside, not what the loop makes: frf: {{reference: {names[0]}}}"
        raise SettingError("reference", what, hint)
    if not names:
        hint = (
            "record the drives of the shakers as channels of quantity: voltage, role: reference, or use "
            "a periodic excitation"
        )
        what = "random excitation needs a recorded drive of every shaker, since measured channels have noise"
        raise DataError(what, hint=hint)
    for source in sources:
        missing = set(names) - {channel.name for channel in source.channels}
        if missing:
            raise DataError(
                f"recording '{source.name}' lacks the drive {', '.join(sorted(missing))} of another recording"
            )
    return names


def check_recorded(references: Sequence[str], sources: Sequence[SampleSource]) -> None:
    """SettingError for a reference that is not recorded, or is a force or a response: the noise of its sensor
    would be none.
    """
    roles = {channel.name: channel.role for source in sources for channel in source.channels}
    for name in references:
        if name not in roles:
            what = f"'{name}' is not a channel of the recordings"
            raise SettingError("reference", what, nearest(name, dict.fromkeys(roles)))
        if roles[name] != "reference":
            part = "force" if roles[name] == "input" else "response"
            what = f"'{name}' is a {part} of the FRF; the reference is injected into the loop from outside"
            raise SettingError("reference", what, "record it, and give it role: reference in the rig file")


def _welch(
    source: SampleSource, settings: FrfSettings, layout: ChannelLayout, number: int, drives: Sequence[str]
) -> CrossSpectra:
    names = [channel.name for channel in source.channels]
    columns = np.array([*layout.columns[number], *(names.index(name) for name in drives)])
    average = block_average(source, settings, columns.size)
    for block in checked_blocks(source):
        average.add(block[:, np.maximum(columns, 0)] * (columns >= 0))
    return average.spectra(source.sample_rate)


def due_to_drives(
    s_zz: ComplexArray, s_zr: ComplexArray, lower: ComplexArray, averages: float
) -> tuple[ComplexArray, ComplexArray]:
    """W = S_zr L^-H (n_line, n, n_drive) and the noise (S_zz - W W^H) n / (n - n_drive) (n_line, n, n)
    [unit^2/Hz], n *averages*. s_zz (n_line, n, n), s_zr (n_line, n, n_drive) [unit^2/Hz] of channels and
    drives, *lower* L of the drives (n_line, n_drive, n_drive). Equation (frf-due-to-drives).
    """
    columns = hermitian(np.linalg.solve(lower, hermitian(s_zr)))
    return columns, (s_zz - columns @ hermitian(columns)) * (averages / (averages - lower.shape[1]))


def noise_by_drive(
    noise: ComplexArray,
    spectra: ComplexArray,
    parts: Sequence[ComplexArray],
    averages: Sequence[float],
    n_drive: int,
) -> tuple[list[ComplexArray], float]:
    """The noise (n_line, n, n) [unit^2/Hz] in what each drive moves, and its complex degrees of freedom: that
    of every recording by its share in the drive's power, or *noise* where all are alike. *parts* of the
    *spectra* (n_line, n_channel, n_channel), drives first, of *averages* each. Equation (frf-noise-of-drive).
    """
    drives = spectra[:, :n_drive, :n_drive]
    inverse, white = np.linalg.inv(drives), np.linalg.inv(np.linalg.cholesky(drives))
    shares = np.array(
        [np.einsum("lrr->rl", white @ part[:, :n_drive, :n_drive] @ hermitian(white)).real for part in parts]
    )
    left = np.array([residual_spectrum(part, spectra[:, n_drive:, :n_drive] @ inverse) for part in parts])
    dof, total = np.array(averages) - shares.sum(axis=1).mean(axis=1), float(sum(averages))
    levels = noise_levels(np.einsum("elcc->lce", left).real, dof)
    if len(parts) == 1 or np.all(levels == 1):
        return [noise] * n_drive, total - n_drive
    # What channels share, and what blocks lose, differs from line to line. A singular matrix tells less.
    known = dof > noise.shape[1]
    of_parts = np.array(
        [
            part * (total / own) if is_known else noise * level
            for part, own, is_known, level in zip(left, dof, known, levels.mean(axis=0), strict=True)
        ]
    )
    by_drive = np.einsum("erl,elcd->rlcd", shares, of_parts)
    power, whole = (np.einsum("...cc->...", matrix).real for matrix in (of_parts, by_drive))
    taken = np.mean(shares * power[:, None] / np.where(whole > 0, whole, 1.0), axis=2)
    # The effective degrees of freedom of a sum (Welch and Satterthwaite), in the mean over the drives.
    return list(by_drive), float(n_drive / np.sum(taken**2 / np.where(known, dof, total)[:, None]))


def lower_of_drives(s_rr: ComplexArray, drives: Sequence[str], word: str = "drive") -> ComplexArray:
    """L of S_rr = L L^H (n_line, n_drive, n_drive) [unit^2/Hz]. DataError where a drive is silent or follows
    from the others.
    """
    power = np.einsum("lrr->lr", s_rr).real
    if np.any(power <= 0):
        silent = drives[int(np.flatnonzero(np.any(power <= 0, axis=0))[0])]
        what = f"the {word} {silent} is silent in the band"
        raise DataError(what, hint=f"is it the {word} of this excitation? narrow `band` to it")
    scale = np.sqrt(power)
    smallest = np.linalg.eigvalsh(s_rr / (scale[:, :, None] * scale[:, None, :]))[:, 0]
    if np.any(smallest < INDEPENDENT):
        hint = "excite by independent random signals, one after the other or together"
        raise DataError(f"the {word}s {', '.join(drives)} are not independent", hint=hint)
    return np.linalg.cholesky(s_rr)


def _unexplained_findings(
    s_zz: ComplexArray, residual: ComplexArray, layout: ChannelLayout
) -> tuple[Finding, ...]:
    power, rest = (np.sum(np.einsum("lcc->lc", matrix).real, axis=0) for matrix in (s_zz, residual))
    return tuple(
        Finding(
            "low-coherence",
            f"channel {channel.name}: {100 * part / whole:.0f} % of its power in the "
            "band is not due to the drives",
        )
        for channel, whole, part in zip(layout.channels, power, rest, strict=True)
        if channel.role != "reference" and whole > 0 and part > (1 - LOW_COHERENCE) * whole
    )
