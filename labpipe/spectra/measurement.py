"""measure: recordings -> one frequency response matrix with its covariance, coherence and findings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.errors import DataError
from labpipe.records.finding import Finding
from labpipe.records.recording import SampleSource
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.bands import line_range, lines_in
from labpipe.spectra.coherence import multiple_coherence, ordinary_coherence
from labpipe.spectra.estimators import ESTIMATORS, INSTRUMENTS
from labpipe.spectra.periodic import LineSpectrum, PeriodAverage, excited_lines, samples_per_period, smoothed_noise
from labpipe.spectra.ports import Layout, find_layout
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.uncertainty import covariance_of_periodic, covariance_of_random
from labpipe.spectra.welch import CrossSpectra, WelchAverage, window_values

READ_SAMPLES = 1 << 16
LOW_COHERENCE = 0.9
LOW_SNR = 10.0
# Share of the lines that may be poor before it is worth a warning.
POOR_SHARE = 0.1
# Forces whose matrix is worse conditioned than this do not act in independent directions.
WORST_FORCE_CONDITION = 1e3


def measure(
    sources: Sequence[SampleSource], settings: FrfSettings, *, name: str = "", conditions: dict[str, Any] | None = None
) -> FrequencyResponse:
    """The FRF matrix H = Y/U (time factor e^{+jwt}) of recordings that together excite every input.

    Several recordings, one per force direction say, give one matrix; a force that a recording does not have is zero in it. Memory
    does not grow with the recordings' length. Raises DataError for recordings that do not fit together, are too short, hold NaN,
    or whose forces do not excite independent directions.
    """
    _check_rates(sources)
    layout = find_layout(sources)
    parts = (_measure_periodic if settings.excitation == "periodic" else _measure_random)(sources, settings, layout)
    findings = (*_source_findings(sources), *parts.findings)
    turn = layout.undelayed(parts.frequency)
    flat = turn.reshape(turn.shape[0], -1)
    covariance = None if parts.covariance is None else parts.covariance * (flat[:, :, None] * flat[:, None, :].conj())
    return FrequencyResponse(
        frequency=parts.frequency,
        matrix=parts.matrix * turn,
        outputs=layout.outputs,
        inputs=layout.inputs,
        form=layout.form,
        covariance=covariance,
        coherence=parts.coherence,
        multiple_coherence=parts.multiple_coherence,
        snr=parts.snr,
        snr_channels=tuple(port.label for port in (*layout.inputs, *layout.outputs)) if parts.snr is not None else (),
        averages=parts.averages,
        covariance_dof=parts.dof,
        name=name,
        findings=findings,
        conditions=dict(conditions or {}),
    )


@dataclass(frozen=True)
class _Parts:
    """What either kind of excitation contributes to a FrequencyResponse."""

    frequency: NDArray[np.floating]
    matrix: NDArray[np.complexfloating]
    covariance: NDArray[np.complexfloating] | None
    averages: float
    dof: float
    findings: tuple[Finding, ...] = ()
    coherence: NDArray[np.floating] | None = None
    multiple_coherence: NDArray[np.floating] | None = None
    snr: NDArray[np.floating] | None = None


def _check_rates(sources: Sequence[SampleSource]) -> None:
    rates = [source.sample_rate for source in sources]
    if not rates:
        raise DataError("no recordings", hint="name at least one")
    if max(rates) - min(rates) > 1e-9 * max(rates):
        named = ", ".join(f"{source.name} {source.sample_rate:g} Hz" for source in sources)
        raise DataError(f"the recordings have different sampling rates: {named}")


def _source_findings(sources: Sequence[SampleSource]) -> tuple[Finding, ...]:
    several = len(sources) > 1
    return tuple(
        Finding(finding.code, f"{source.name}: {finding.message}" if several else finding.message)
        for source in sources
        for finding in source.findings
    )


def _checked_blocks(source: SampleSource) -> Iterator[NDArray[np.floating]]:
    """The recording's blocks; DataError at the first sample that is no number, and at the end for a force that never varied."""
    start = 0
    first, varies = np.empty(0), np.zeros(len(source.channels), bool)
    for block in source.blocks(READ_SAMPLES):
        if not np.all(np.isfinite(block)):
            sample, column = (int(n) for n in np.argwhere(~np.isfinite(block))[0])
            where = f"sample {start + sample} ({(start + sample) / source.sample_rate:g} s)"
            channel = source.channels[column].name
            hint = "labpipe fills no gaps; cut the recording there or record it again"
            raise DataError(f"channel '{channel}' of '{source.name}' has no number at {where}", hint=hint)
        first = block[0] if start == 0 else first
        varies |= np.any(block != first, axis=0)
        start += block.shape[0]
        yield block
    for channel_record, moved in zip(source.channels, varies, strict=True):
        if channel_record.role == "input" and not moved:
            raise DataError(f"the force channel '{channel_record.name}' of '{source.name}' does not vary", hint="is the sensor connected?")


def _measure_periodic(sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout) -> _Parts:
    assert settings.period is not None
    spectra = [_period_average(source, settings) for source in sources]
    lines = _lines_of_all_forces(spectra, layout)
    if not np.any(lines):
        raise DataError("no line of the force stands out of its noise", hint="check `period` and `band`, or raise the level")
    spectra = [spectrum.select(lines) for spectrum in spectra]
    n_input = len(layout.inputs)
    mean = np.stack([layout.padded(e, spectrum.mean, 1) for e, spectrum in enumerate(spectra)], axis=2)
    forces, responses = mean[:, :n_input], mean[:, n_input:]
    inverse = _force_inverse(forces, layout)
    matrix = responses @ inverse
    noises = [layout.padded(e, s.noise, 2) for e, s in enumerate(spectra) if s.noise is not None]
    covariance = covariance_of_periodic(matrix, inverse, np.stack(noises)) if len(noises) == len(spectra) else None
    snr = None if covariance is None else _signal_to_noise(mean, np.stack(noises))
    findings = _no_covariance_finding(spectra[0].n_period) if covariance is None else _snr_findings(snr, layout)
    averages = float(min(spectrum.n_period for spectrum in spectra))
    dof = min(spectrum.dof for spectrum in spectra) if covariance is not None else np.inf
    return _Parts(spectra[0].frequency, matrix, covariance, averages, dof, findings, snr=snr)


def _lines_of_all_forces(spectra: Sequence[LineSpectrum], layout: Layout) -> NDArray[np.bool_]:
    """The lines at which every force acts in one of the recordings; hum in one force channel alone makes no line of the matrix."""
    acting = np.zeros((spectra[0].frequency.size, len(layout.inputs)), bool)
    for spectrum, columns in zip(spectra, layout.input_columns, strict=True):
        for number, column in enumerate(columns):
            if column >= 0:
                acting[:, number] |= excited_lines(spectrum, [column])
    return np.all(acting, axis=1)


def _period_average(source: SampleSource, settings: FrfSettings) -> LineSpectrum:
    """The averaged and smoothed lines of one recording in the band."""
    assert settings.period is not None
    n_sample = samples_per_period(settings.period, source.sample_rate)
    lines = line_range(n_sample, source.sample_rate, settings.band)
    average = PeriodAverage(n_sample, len(source.channels), settings.skip, lines)
    for block in _checked_blocks(source):
        average.add(block)
    spectrum = average.spectrum(source.sample_rate)
    return smoothed_noise(spectrum.select(_lines_left(spectrum.frequency, settings)), settings.smooth)


def _lines_left(frequency: NDArray[np.floating], settings: FrfSettings) -> NDArray[np.bool_]:
    chosen = lines_in(frequency, settings.band, settings.exclude)
    if not np.any(chosen):
        raise DataError("no line of the band is left", hint="`exclude` takes them all")
    return chosen


def _force_inverse(forces: NDArray[np.complexfloating], layout: Layout) -> NDArray[np.complexfloating]:
    """pinv of the forces (n_line, n_input, n_experiment); DataError when they do not span every input at every line."""
    n_input, n_experiment = forces.shape[1:]
    names = ", ".join(port.label for port in layout.inputs)
    if n_experiment < n_input:
        hint = f"{n_input} forces ({names}) need {n_input} recordings with independent forces"
        raise DataError(f"{n_experiment} recording(s) cannot separate {n_input} forces", hint=hint)
    size = np.max(np.abs(forces), axis=(0, 2))
    singular = np.linalg.svd(forces / size[:, None], compute_uv=False)
    if np.any(singular[:, -1] * WORST_FORCE_CONDITION < singular[:, 0]):
        raise DataError(f"the forces {names} do not act in independent directions", hint="excite each direction in its own recording")
    return np.linalg.pinv(forces / size[:, None]) / size[None, None, :]


def _signal_to_noise(mean: NDArray[np.complexfloating], noise: NDArray[np.complexfloating]) -> NDArray[np.floating]:
    """|mean| / std of the mean per line and channel, the largest over the recordings, (n_line, n_channel)."""
    std = np.sqrt(np.einsum("eljj->lje", noise).real)
    ratio = np.divide(np.abs(mean), std, out=np.full(std.shape, np.inf), where=std > 0)
    ratio[np.abs(mean) == 0] = 0.0
    return np.minimum(np.max(ratio, axis=2), 1e12)


def _no_covariance_finding(n_period: int) -> tuple[Finding, ...]:
    message = f"{n_period} period is left, so the noise of the FRF is not known; record at least 2 periods after the transient ones"
    return (Finding("no-covariance", message),)


def _snr_findings(snr: NDArray[np.floating] | None, layout: Layout) -> tuple[Finding, ...]:
    assert snr is not None
    poor = np.mean(snr < LOW_SNR, axis=0)
    labels = [port.label for port in (*layout.inputs, *layout.outputs)]
    return tuple(
        Finding("low-snr", f"channel {label}: the signal is less than {LOW_SNR:g} times its noise at {100 * share:.0f} % of the lines")
        for label, share in zip(labels, poor, strict=True)
        if share > POOR_SHARE
    )


def _measure_random(sources: Sequence[SampleSource], settings: FrfSettings, layout: Layout) -> _Parts:
    spectra = [_welch_average(source, settings) for source in sources]
    n_blocks = np.array([spectrum.n_block for spectrum in spectra], float)
    padded = np.stack([layout.padded(e, spectrum.matrix, 2) for e, spectrum in enumerate(spectra)])
    matrix = np.einsum("e,efab->fab", n_blocks / n_blocks.sum(), padded)
    chosen = _lines_left(spectra[0].frequency, settings)
    n_input = len(layout.inputs)
    matrix = matrix[chosen]
    s_uu, s_yu, s_yy = matrix[:, :n_input, :n_input], matrix[:, n_input:, :n_input], matrix[:, n_input:, n_input:]
    _check_independent(s_uu, layout)
    if settings.estimator != "H1":
        _check_responses(s_yy, layout, settings.estimator)
    response = ESTIMATORS[settings.estimator](s_uu, s_yu, s_yy)
    instruments = INSTRUMENTS[settings.estimator](response, np.einsum("faa->fa", matrix).real)
    averages = sum(spectrum.averages for spectrum in spectra)
    multiple = multiple_coherence(s_uu, s_yu, s_yy)
    enough = averages > n_input + 1
    return _Parts(
        frequency=spectra[0].frequency[chosen],
        matrix=response,
        covariance=covariance_of_random(matrix, response, instruments, averages) if enough else None,
        averages=averages,
        dof=averages - n_input if enough else np.inf,
        findings=_coherence_findings(multiple, layout) if enough else _no_average_finding(averages),
        coherence=ordinary_coherence(s_uu, s_yu, s_yy),
        multiple_coherence=multiple,
    )


def _welch_average(source: SampleSource, settings: FrfSettings) -> CrossSpectra:
    assert settings.block is not None
    n_sample = round(settings.block * source.sample_rate)
    if n_sample < 4:
        raise DataError(f"a block of {settings.block:g} s holds {n_sample} samples of '{source.name}'", hint="lengthen `block`")
    step = max(1, round(n_sample * (1 - settings.overlap)))
    lines = line_range(n_sample, source.sample_rate, settings.band)
    average = WelchAverage(window_values(settings.window, n_sample), step, len(source.channels), lines)
    for block in _checked_blocks(source):
        average.add(block)
    return average.spectra(source.sample_rate)


def _check_independent(s_uu: NDArray[np.complexfloating], layout: Layout) -> None:
    """DataError when the forces are so correlated that their responses cannot be told apart."""
    scale = np.sqrt(np.einsum("fii->fi", s_uu).real)
    if np.any(scale == 0):
        raise DataError("a force has no power at a line of the band", hint="narrow `band` to what is excited")
    values = np.linalg.eigvalsh(s_uu / (scale[:, :, None] * scale[:, None, :]))
    if np.any(values[:, 0] * WORST_FORCE_CONDITION**2 < values[:, -1]):
        names = ", ".join(port.label for port in layout.inputs)
        raise DataError(f"the forces {names} do not act independently", hint="excite each direction in its own recording")


def _check_responses(s_yy: NDArray[np.complexfloating], layout: Layout, estimator: str) -> None:
    """DataError when a response on which the estimator leans is silent, or a combination of the others where it inverts them all."""
    power = np.einsum("foo->fo", s_yy).real
    silent = [port.label for port, values in zip(layout.outputs, power.T, strict=True) if np.any(values == 0)]
    if silent:
        hint = "is the sensor connected? H1 does without"
        raise DataError(f"{estimator} needs responses at every line; silent: {', '.join(silent)}", hint=hint)
    scale = np.sqrt(power)
    values = np.linalg.eigvalsh(s_yy / (scale[:, :, None] * scale[:, None, :]))
    if estimator == "H2" and np.any(values[:, 0] * WORST_FORCE_CONDITION**2 < values[:, -1]):
        raise DataError("the responses do not move independently, so H2 cannot be formed", hint="use H1 or Hv")


def _coherence_findings(multiple: NDArray[np.floating], layout: Layout) -> tuple[Finding, ...]:
    return tuple(
        Finding(
            "low-coherence",
            f"response {port.label}: the coherence is below {LOW_COHERENCE:g} at {100 * share:.0f} % of the lines",
        )
        for port, share in zip(layout.outputs, np.mean(multiple < LOW_COHERENCE, axis=0), strict=True)
        if share > POOR_SHARE
    )


def _no_average_finding(averages: float) -> tuple[Finding, ...]:
    message = f"{averages:.2g} effective averages are too few to know the noise of the FRF; record longer or shorten `block`"
    return (Finding("no-covariance", message),)
