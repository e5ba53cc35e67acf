"""Checks of a measured response: independent forces, coherence, reciprocity, aliasing."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.distributions import gamma_tail
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note
from labpipe.records.recording import SampleSource
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.channels import DerivedRecording, columns_of
from labpipe.spectra.damping import half_power
from labpipe.spectra.ports import Layout
from labpipe.spectra.windows import hann

# Largest condition number of the force matrix at which its inverse is used.
WORST_FORCE_CONDITION = 1e3


def condition_number(correlation: ComplexArray) -> FloatArray:
    """Largest over smallest eigenvalue [1], (n_frequency,), of Hermitian matrices (n_frequency, n, n) with
    ones on the diagonal.
    """
    if correlation.shape[1] == 2:
        # Two channels, the usual case: the eigenvalues are 1 +- |c|.
        c = np.minimum(np.abs(correlation[:, 0, 1]), 1.0)
        smallest, largest = 1 - c, 1 + c
    else:
        values = np.linalg.eigvalsh(correlation)
        smallest, largest = np.maximum(values[:, 0], 0.0), values[:, -1]
    return np.divide(largest, smallest, out=np.full(smallest.shape, np.inf), where=smallest > 0)


def _worst_condition(correlation: ComplexArray) -> float:
    """The largest condition number [1] of matrices as in condition_number, or a bound of it that is far below
    what matters. With the determinant d <= smallest (n / (n - 1))^(n - 1), and the largest of n eigenvalues
    of mean 1 is below n: eigenvalues cost ten times a determinant.
    """
    n = correlation.shape[1]
    if n > 2:
        smallest = np.linalg.det(correlation).real * ((n - 1) / n) ** (n - 1)
        correlation = correlation[n > smallest * WORST_FORCE_CONDITION]
    return float(np.max(condition_number(correlation), initial=1.0))


def force_inverse(forces: ComplexArray, layout: Layout) -> ComplexArray:
    """Pseudo-inverse [1/N] of the forces (n_line, n_input, n_experiment), (n_line, n_experiment, n_input).
    DataError when the forces do not span every input at every line.
    """
    n_input, n_experiment = forces.shape[1:]
    names = ", ".join(port.label for port in layout.inputs)
    if n_experiment < n_input:
        hint = f"{n_input} forces ({names}) need {n_input} recordings with independent forces"
        raise DataError(f"{n_experiment} recording(s) cannot separate {n_input} forces", hint=hint)
    size = np.max(np.abs(forces), axis=(0, 2))
    singular = np.linalg.svd(forces / size[:, None], compute_uv=False)
    if np.any(singular[:, -1] * WORST_FORCE_CONDITION < singular[:, 0]):
        what = f"the forces {names} do not act in independent directions"
        raise DataError(what, hint="excite each direction in its own recording")
    return np.linalg.pinv(forces / size[:, None]) / size[None, None, :]


def signal_to_noise(mean: ComplexArray, noise: ComplexArray) -> FloatArray:
    """|mean| / std of the mean [1] by line and channel, the largest over the recordings, (n_line, n_channel).
    mean (n_line, n_channel, n_recording) [unit], noise (n_recording, n_line, n_channel, n_channel) [unit^2].
    """
    std = np.sqrt(np.maximum(np.einsum("eljj->lje", noise).real, 0.0))
    ratio = np.divide(np.abs(mean), std, out=np.full(std.shape, np.inf), where=std > 0)
    ratio[np.abs(mean) == 0] = 0.0
    return np.minimum(np.max(ratio, axis=2), 1e12)


def check_forces(s_uu: ComplexArray, layout: Layout) -> None:
    """DataError unless the forces with spectra (n_frequency, n_input, n_input) [N^2/Hz] are independent at
    every line.
    """
    scale = np.sqrt(np.einsum("fii->fi", s_uu).real)
    check_power(scale)
    if _worst_condition(s_uu / (scale[:, :, None] * scale[:, None, :])) > WORST_FORCE_CONDITION**2:
        names = ", ".join(port.label for port in layout.inputs)
        what = f"the forces {names} do not act independently"
        raise DataError(what, hint="excite each direction in its own recording")


def check_power(power: FloatArray) -> None:
    """DataError unless all forces have *power* (n_frequency, n_input) [any unit] at every line."""
    if np.any(power == 0):
        raise DataError("a force has no power at a line of the band", hint="narrow `band` to what is excited")


def check_responses(s_yy: ComplexArray, layout: Layout, estimator: str) -> None:
    """DataError unless *estimator* can use the outputs with spectra (n_frequency, n_output, n_output)
    [unit^2/Hz]. No output may be silent; for H2 the outputs must also be independent, since their
    cross-spectra are inverted.
    """
    power = np.einsum("foo->fo", s_yy).real
    silent = [port.label for port, values in zip(layout.outputs, power.T, strict=True) if np.any(values == 0)]
    if silent:
        hint = "is the sensor connected? H1 does not need it"
        raise DataError(f"{estimator} needs responses at every line; silent: {', '.join(silent)}", hint=hint)
    scale = np.sqrt(power)
    condition = condition_number(s_yy / (scale[:, :, None] * scale[:, None, :]))
    if estimator == "H2" and np.any(condition > WORST_FORCE_CONDITION**2):
        what = "the responses do not move independently, so H2 cannot be formed"
        raise DataError(what, hint="use H1 or Hv")


def ordinary_coherence(s_uu: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> FloatArray:
    """gamma^2 = |S_yu|^2 / (S_yy S_uu) per output and force, (n_frequency, n_output, n_input) [1]. s_uu
    (n_frequency, n_input, n_input) [N^2/Hz], s_yu (n_frequency, n_output, n_input), s_yy (n_frequency,
    n_output, n_output). Equation (frf-coherence).
    """
    return coherence_by_power(np.einsum("fii->fi", s_uu).real, s_yu, s_yy)


def coherence_by_power(force_power: FloatArray, s_yu: ComplexArray, s_yy: ComplexArray) -> FloatArray:
    """ordinary_coherence (n_frequency, n_output, n_input) [1] from the *force_power* (n_frequency, n_input)
    [N^2/Hz] alone.
    """
    power = np.einsum("foo->fo", s_yy).real[:, :, None] * force_power[:, None, :]
    return _clip(_square(s_yu), power)


def multiple_coherence(h1: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray) -> FloatArray:
    """gamma^2 = H1 S_uy / S_yy per output, (n_frequency, n_output) [1], the share of H1 = S_yu S_uu^-1,
    (n_frequency, n_output, n_input). Spectra as in ordinary_coherence. Equation (frf-multiple-coherence).
    """
    return _clip(_explained_power(h1, s_yu), np.einsum("foo->fo", s_yy).real)


def partial_coherence(
    inverse_force: FloatArray, h1: ComplexArray, s_yu: ComplexArray, s_yy: ComplexArray
) -> FloatArray:
    """Coherence of an output and one force, both conditioned on the other forces, (n_frequency, n_output,
    n_input) [1]: of the inverse Q of the spectra of all forces and that output, by blocks Q_yu = -q H1 and
    Q_uu = S_uu^-1 + q H1^H H1 with the residual power 1 / q. inverse_force: the diagonal of S_uu^-1,
    (n_frequency, n_input) [Hz/N^2]; the other arguments as in multiple_coherence. Equation
    (frf-partial-coherence).
    """
    residual = np.einsum("foo->fo", s_yy).real - _explained_power(h1, s_yu)
    explained = _square(h1)
    alone = inverse_force[:, None, :] * np.maximum(residual, 0.0)[:, :, None]
    return _clip(explained, explained + alone)


def _explained_power(h1: ComplexArray, s_yu: ComplexArray) -> FloatArray:
    explained: FloatArray = np.sum(h1.real * s_yu.real + h1.imag * s_yu.imag, axis=2)
    return explained


def _square(values: ComplexArray) -> FloatArray:
    squared: FloatArray = values.real**2 + values.imag**2
    return squared


def _clip(part: FloatArray, whole: FloatArray) -> FloatArray:
    """part / whole within 0 ... 1, which rounding alone may leave; 0 where there is no signal."""
    ratio = np.divide(part, whole, out=np.zeros_like(part), where=whole > 0)
    return np.clip(ratio, 0.0, 1.0, out=ratio)


# Neighbouring lines of a windowed spectrum share noise over this many lines.
SHARED_LINES = 3
# Pairs reported, the p-value below which a difference is significant, and the least p-value printed.
MOST_PAIRS = 6
NOT_BY_CHANCE = 0.01
LEAST_CHANCE = 1e-12


@dataclass(frozen=True)
class Reciprocity:
    """H from dof *second* (force) to *first* (response) against the reverse. ratio (n_frequency,) [1]: |H_ij
    - H_ji|^2 over its variance, 1 on average where reciprocity holds; difference [1]: rms of |H_ij - H_ji|
    over the rms of both; p_value: probability of a mean ratio at least as large where reciprocity holds.
    """

    first: str
    second: str
    ratio: FloatArray
    difference: float
    p_value: float


def reciprocity(response: FrequencyResponse) -> tuple[Reciprocity, ...]:
    """All pairs of dofs with both a response and a force; DataError without covariance or without such a
    pair. var(H_ij - H_ji) = C_pp + C_qq - 2 Re C_pq, from the covariance of the response. Equation
    (frf-reciprocity).
    """
    if response.variance is None:
        what = "reciprocity cannot be tested without the covariance of the FRF"
        raise DataError(what, hint="record more periods or blocks")
    rows = {port.dof: number for number, port in enumerate(response.outputs)}
    columns = {port.dof: number for number, port in enumerate(response.inputs)}
    shared = [dof for dof in rows if dof in columns]
    if len(shared) < 2:
        raise DataError("reciprocity needs two dofs that are both excited and measured")
    pairs = [(i, j) for number, i in enumerate(shared) for j in shared[number + 1 :]]
    return tuple(_pair(response, i, j, (rows[i], columns[j]), (rows[j], columns[i])) for i, j in pairs)


def reciprocity_findings(response: FrequencyResponse) -> tuple[Finding, ...]:
    """Notes on the pairs of dofs both excited and measured, the least reciprocal first. None where
    reciprocity cannot be tested.
    """
    try:
        pairs = sorted(reciprocity(response), key=lambda pair: (pair.p_value, -pair.difference))
    except DataError:
        return ()
    return tuple(
        note(
            "reciprocity",
            f"H of {pair.first} to {pair.second} and of {pair.second} to {pair.first} differ by "
            f"{100 * pair.difference:.3g} % (rms), "
            f"{'within' if pair.p_value > NOT_BY_CHANCE else 'beyond'} the noise "
            f"(p {f'= {pair.p_value:.2g}' if pair.p_value >= LEAST_CHANCE else f'< {LEAST_CHANCE:g}'})",
        )
        for pair in pairs[:MOST_PAIRS]
    )


def _pair(
    response: FrequencyResponse, first: str, second: str, forward: tuple[int, int], reverse: tuple[int, int]
) -> Reciprocity:
    n_input = len(response.inputs)
    p, q = (row * n_input + column for row, column in (forward, reverse))
    c = response.covariance_of
    variance = (c(p, p) + c(q, q) - 2 * c(p, q).real).real
    here, there = response.matrix[:, *forward], response.matrix[:, *reverse]
    if np.any(variance <= 0):
        raise DataError(
            f"H of {first} to {second} and its reverse have no variance at a line, so they cannot be compared"
        )
    normal = (here - there) / np.sqrt(variance)
    ratio = np.abs(normal) ** 2
    size = np.sqrt(np.mean(np.abs(here) ** 2 + np.abs(there) ** 2) / 2)
    difference = float(np.sqrt(np.mean(np.abs(here - there) ** 2)) / size)
    return Reciprocity(first, second, ratio, difference, _p_value(normal, response.covariance_dof))


def _p_value(normal: ComplexArray, dof: float) -> float:
    """P(mean ratio at least as large): a gamma distribution with the mean and variance of averaged F(2, 2
    dof) ratios. Mean dof/(dof-1), variance dof^3 / ((dof-1)^2 (dof-2)) / n_e of n_e = n / (1 + 2 sum |r_k|^2)
    lines.
    """
    if dof <= 2:
        what = f"reciprocity cannot be tested with {dof:g} degrees of freedom of the covariance"
        raise DataError(what, hint="record longer")
    power = np.sum(np.abs(normal) ** 2)
    shared = [
        abs(np.sum(normal[k:] * normal[:-k].conj())) / power
        for k in range(1, min(SHARED_LINES, normal.size - 1) + 1)
    ]
    # The mean of |r|^2 over n lines is 1/n without correlation.
    excess = sum(max(r**2 - 1 / normal.size, 0.0) for r in shared)
    n_effective = max(normal.size / (1 + 2 * excess), 1.0)
    exact = np.isinf(dof)
    shape = n_effective * (1.0 if exact else (dof - 2) / dof)
    mean = power / normal.size * (1.0 if exact else (dof - 1) / dof)
    return gamma_tail(mean * shape, shape)


# Length of the segment analysed in every block [samples].
SEGMENT = 1024
SHORTEST = 64
# Above TOP_SHARE of half the sampling rate an anti-alias filter leaves less than MOST_POWER of the power
# density in the band.
TOP_SHARE = 0.95
MOST_POWER = 0.1


class AliasingMonitor(DerivedRecording):
    """A recording that accumulates the power spectrum of its channels while its blocks are read. Satisfies
    SampleSource.
    """

    def __init__(self, source: SampleSource, hits: bool = False) -> None:
        """*hits*: hammer excitation; each segment is then centred on the largest force of its block."""
        super().__init__(source)
        self._n = min(SEGMENT, 1 << (max(source.n_sample, 1).bit_length() - 1))
        self._window = hann(self._n)[:, None]
        self._forces = columns_of(source.channels, "input") if hits else []
        self._power = np.zeros((self._n // 2 + 1, len(source.channels)))
        self._n_segment = 0

    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """The recording's blocks (n, n_channel) [channel unit], unchanged."""
        for block in self.source.blocks(n_sample):
            if block.shape[0] >= self._n >= SHORTEST:
                hit = int(np.argmax(np.max(np.abs(block[:, self._forces]), axis=1))) if self._forces else 0
                start = min(max(hit - self._n // 2, 0), block.shape[0] - self._n)
                segment = block[start : start + self._n]
                self._n_segment += 1
                self._power += np.abs(fft.rfft((segment - segment.mean(axis=0)) * self._window, axis=0)) ** 2
            yield block

    def powers(self, band: tuple[float, float] | None) -> FloatArray:
        """Mean power per line above and inside the band, (2, n_channel) [unit^2]; 0 without complete segments
        or lines to compare. "Above": between TOP_SHARE of half the sampling rate (or the band's upper edge)
        and half the sampling rate.
        """
        half = self.sample_rate / 2
        frequency = np.arange(self._power.shape[0]) * (self.sample_rate / self._n)
        low, high = band or (0.0, half)
        inside = (frequency >= low) & (frequency <= min(high, TOP_SHARE * half)) & (frequency > 0)
        above = (frequency > max(TOP_SHARE * half, high if band else 0.0)) & (frequency < half)
        if not np.any(inside) or not np.any(above):
            return np.zeros((2, len(self.channels)))
        scale = 1 / max(self._n_segment, 1) / np.sum(self._window**2)
        return scale * np.array([self._power[lines].mean(axis=0) for lines in (above, inside)])


# 1 / coherence - 1 at a peak over what noise beside it makes there, a / |H|^2 of the response and b of force
# and gains, from which on blocks leak: one in a hundred tables of five averages has so much by chance. Lines
# within the half-power width, and beside it, that are needed; rounds that find a and b.
DIP, LINES_OF_PEAK, LINES_BESIDE, ROUNDS = 4.0, 3, 8, 8
# Half-power widths from the peak between which lines are beside it; coherence of lines that may be a peak.
BESIDE, OF_PEAK = (1.0, 4.0), 0.5


def leaking_peaks(response: FrequencyResponse) -> tuple[Finding, ...]:
    """A warning where the coherence of an FRF of unknown blocks falls at its highest peak: their ends tear
    the response from its force where it rings longest.
    """
    for row, output in enumerate(response.outputs):
        for column, force in enumerate(response.inputs):
            found = response.coherence is not None and _dip(
                response.frequency, response.matrix[:, row, column], response.coherence[:, row, column]
            )
            if found:
                what = (
                    f"{output.label} over {force.label}: coherence falls at the peak at {found[0]:.4g} Hz, "
                    f"where 1 - coherence is {found[1]:.2g} times what noise makes of it, by the lines "
                    "beside: as where blocks of random data leak, which makes damping too large, and no "
                    "standard error shows it"
                )
                cure = (
                    "state `window:` and `excitation: random` in the entry under frfs:, or use longer blocks"
                )
                return (Finding("leakage", f"{what}; {cure}; or the structure is not linear"),)
    return ()


def _dip(frequency: FloatArray, h: ComplexArray, coherence: FloatArray) -> tuple[float, float] | None:
    """The highest peak [Hz] of an element and by what 1 / coherence - 1 [1], which rises there, is beyond DIP
    times the likeliest a / |H|^2 + b of exponential values beside it.
    """
    if not np.all(coherence > 0) or frequency.size < LINES_BESIDE:
        return None
    # Beyond the band of the force H is noise over noise.
    highest = frequency[np.argmax(np.abs(h) * (coherence > OF_PEAK))]
    try:
        peak = half_power(frequency, h, (highest, highest))
    except (DataError, np.linalg.LinAlgError):
        return None
    off = np.abs(frequency - peak.frequency) / (peak.high - peak.low)
    inside, beside = off <= 0.5, (off >= BESIDE[0]) & (off <= BESIDE[1])
    if inside.sum() < LINES_OF_PEAK or beside.sum() < LINES_BESIDE:
        return None
    unexplained = 1 / coherence - 1
    courses = np.stack([np.min(np.abs(h[beside])) ** 2 / np.abs(h) ** 2, np.ones(h.size)], axis=1)
    noise = np.ones(h.size)
    for _ in range(ROUNDS):
        weighted = courses[beside] / noise[beside, None], unexplained[beside] / noise[beside]
        noise = np.maximum(courses @ scipy.optimize.nnls(*weighted)[0], np.finfo(float).tiny)
    there, usual = np.mean(unexplained[inside]), np.median(unexplained[beside])
    ratio = float(there / np.mean(noise[inside]))
    return (peak.frequency, ratio) if ratio > DIP and there > usual > 0 else None


def aliasing_findings(
    sources: Sequence[AliasingMonitor], band: tuple[float, float] | None, channels: Collection[str]
) -> tuple[Finding, ...]:
    """Warnings for *channels* with aliasing: power density just below half the sampling rate above a tenth
    of that in the band. The powers of all recordings are added: an output that a force does not excite
    holds noise only.
    """
    total: dict[str, FloatArray] = {}
    for source in sources:
        for channel, power in zip(source.channels, source.powers(band).T, strict=True):
            if channel.name in channels:
                total[channel.name] = total.get(channel.name, np.zeros(2)) + power
    ratios = {
        name: near_half / in_band
        for name, (near_half, in_band) in total.items()
        if near_half > MOST_POWER * in_band
    }
    rate = sources[0].sample_rate if sources else 0.0
    return tuple(
        Finding(
            "aliasing",
            f"channel {name}: the power just below half the sampling rate ({rate / 2:g} Hz) is "
            f"{100 * share:.0f} % of that in the band, so frequencies above it are probably folded into the "
            "FRF; use the logger's anti-alias filter, or sample faster",
        )
        for name, share in ratios.items()
    )
