"""measure: recordings -> one frequency response matrix with its covariance, coherence and findings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, DataError, LabpipeError
from labpipe.records.finding import Finding, note
from labpipe.records.recording import SampleSource
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.bands import block_samples, settings_findings
from labpipe.spectra.channel_layout import sum_errors
from labpipe.spectra.channels import READ_SAMPLES, check_in_time, columns_of, in_time, uncertainty_findings
from labpipe.spectra.convert import TRANSMISSIBILITY, directional
from labpipe.spectra.covariance import correct_covariance
from labpipe.spectra.feedback import feedback_of_records
from labpipe.spectra.impact import check_single_force, find_hits, impact_parts
from labpipe.spectra.joint import joint_parts
from labpipe.spectra.periodic import periodic_parts, realisations, robust_mean
from labpipe.spectra.ports import Layout, Parts, check_rate, find_layout, join, source_findings, without_short
from labpipe.spectra.quality import AliasingMonitor, aliasing_findings, reciprocity_findings
from labpipe.spectra.random import random_parts
from labpipe.spectra.random_lines import LOW_SNR
from labpipe.spectra.settings import SPECTRA, FrfSettings
from labpipe.spectra.stepped import SAME_LINE, stepped_parts
from labpipe.spectra.swept_sine import sweep_parts
from labpipe.spectra.synchronous import without_shaft

# Multiple coherence below which an output is mostly noise.
EXPLAINED = 0.5
# Share of the same force in another recording below which one is the noise of its idle sensor.
IDLE = 0.05

# Excitations whose forces and responses are compared block by block, and whose records show by themselves
# whether the loop is closed; periods do by what does not repeat.
BLOCKS = ("random", "impact")

EXCITATIONS: dict[str, Callable[[Sequence[SampleSource], FrfSettings, Layout], Parts]] = {
    "periodic": periodic_parts,
    "random": random_parts,
    "impact": impact_parts,
    "stepped-sine": stepped_parts,
    "sweep": sweep_parts,
}


def measure(
    sources: Sequence[SampleSource],
    settings: FrfSettings,
    *,
    name: str = "",
    conditions: dict[str, Any] | None = None,
) -> FrequencyResponse:
    """The FRF matrix H = Y/U (time factor e^{+jwt}) of recordings that together excite every input. A force
    that a recording lacks is zero in it. DataError for recordings that do not fit together, are too short,
    hold NaN, or whose forces are not independent; one too short for an average is left out by name beside
    longer ones of its channels.
    """
    check_rate(sources)
    if settings.excitation not in EXCITATIONS:
        what = f"excitation {settings.excitation} gives no FRF"
        raise ConfigError(what, hint="fit free decays with model: decay")
    if settings.gives == SPECTRA:
        raise ConfigError("`result: spectra` gives no FRF", hint="channel_spectra makes them")
    if settings.excitation in BLOCKS:
        for source in sources:
            check_in_time(source, [channel for channel in source.channels if channel.role != "reference"])
        sources = in_time(sources)
    sources, short = without_short(sources, settings)
    if settings.realisations:
        responses = [_measure(members, settings, name, conditions) for members in realisations(sources)]
        response = robust_mean(responses, settings.smooth)
    else:
        counts = _hit_counts(sources, settings)
        whole = _of_sensor_places(sources, settings, counts, name, conditions)
        response = _with_repeats(whole, sources, settings, counts)
    if response.form != TRANSMISSIBILITY:
        response = response.with_findings(reciprocity_findings(response))
    response = response.with_findings(short)
    return directional(response) if settings.directional else response


def _hit_counts(sources: Sequence[SampleSource], settings: FrfSettings) -> list[int]:
    """How many hits each recording holds, where some are left out by their numbers among all; else zeros.
    DataError for a number that no hit has.
    """
    counts, reject = [0] * len(sources), settings.impact.reject
    if reject:
        assert settings.block is not None
        for place, source in enumerate(sources):
            n_sample = block_samples(source, settings.block)
            hits = find_hits(source, check_single_force(source), n_sample, settings.impact)
            counts[place] = sum(1 for _ in hits)
        if max(reject) > sum(counts):
            what = f"`reject` names hit {max(reject)}, {sum(counts)} are found"
            raise DataError(what, hint="numbers run through all recordings of a test")
    return counts


def _of_recordings(settings: FrfSettings, chosen: Iterable[int], counts: Sequence[int]) -> FrfSettings:
    """The settings for the *chosen* of several recordings that hold so many hits: their own numbers are left
    out, counted among their hits alone.
    """
    ends = np.cumsum(counts)
    numbers = [number for n in chosen for number in range(ends[n] - counts[n] + 1, ends[n] + 1)]
    reject: Any = tuple(str(place) for place, n in enumerate(numbers, 1) if n in settings.impact.reject)
    return replace(settings, impact=replace(settings.impact, reject=reject))


def _with_repeats(
    response: FrequencyResponse, sources: Sequence[SampleSource], settings: FrfSettings, counts: Sequence[int]
) -> FrequencyResponse:
    """The response with that of every recording alone, where each has all of it; *counts*: of their hits.
    Recordings that alone give no response, or other lines, are no repeats, but for one whose hits are all
    left out beside others; of a single recording its hits are.
    """
    ports = [port.label for port in (*response.outputs, *response.inputs)]
    spacing = float(np.min(np.diff(response.frequency), initial=response.frequency[0]))
    alone, names, levels, chains = [], [], [], []
    for number, source in enumerate(sources if len(sources) > 1 else ()):
        if len([channel for channel in source.channels if channel.role in ("input", "output")]) < len(ports):
            return response
        try:
            of_one = _measure([source], _of_recordings(settings, [number], counts), source.name, None)
        except (LabpipeError, np.linalg.LinAlgError):
            if settings.excitation == "impact":
                continue
            return response
        # The nearest lines: those of dwells differ by the errors of their frequencies.
        lines = np.searchsorted((of_one.frequency[1:] + of_one.frequency[:-1]) / 2, response.frequency)
        apart = float(np.max(np.abs(of_one.frequency[lines] - response.frequency)))
        labels = [port.label for port in (*of_one.outputs, *of_one.inputs)]
        if labels != ports or apart > SAME_LINE * spacing:
            return response
        alone.append(of_one.matrix[lines])
        names.append(source.name)
        chains.append((of_one.outputs, of_one.inputs))
        levels.append(_levels(source))
    sizes = np.array(levels)
    # Beside a force that is idle, a recording shows some columns of the response alone.
    if len(alone) < 2 or (sizes.shape[1] > 1 and np.any(sizes < IDLE * sizes.max(axis=0))):
        return response
    outputs, inputs = (tuple(map(mean_port, zip(*ends, strict=True))) for ends in zip(*chains, strict=True))
    return replace(
        response,
        outputs=outputs,
        inputs=inputs,
        repeats=np.array(alone),
        repeat_names=tuple(names),
        repeat_levels=None if sizes.shape[1] > 1 else sizes[:, 0],
        repeat_shares=None,
        repeats_are="recordings",
    )


def mean_port(ports: tuple[Port, ...]) -> Port:
    """Of one port in each of n recordings, that of their mean: of a calibration that the share p of them has,
    the error is p times its own. Their scatter shows p (1 - p) / (n - 1) of its square in the variance of
    the mean. Equation (repeats-calibrations).
    """
    times = Counter(calibration for port in ports for calibration in port.uncertainties)
    uncertainties = []
    for calibration, count in times.items():
        p, n = count / len(ports), len(ports)
        error = replace(calibration.uncertainty, std_error=p * calibration.uncertainty.std_error)
        shown = 1 - float(np.sqrt(max(1 - (1 - p) / (p * (n - 1)), 0.0)))
        uncertainties.append(replace(calibration, uncertainty=error, shown=shown))
    return replace(ports[0], uncertainties=tuple(uncertainties))


def _levels(source: SampleSource) -> FloatArray:
    """The r.m.s. of each force about its mean, (n_input,) [unit of the force]."""
    columns = columns_of(source.channels, "input")
    count, total, square = 0, np.zeros(len(columns)), np.zeros(len(columns))
    for block in source.blocks(READ_SAMPLES):
        forces = block[:, columns]
        count, total, square = count + len(forces), total + forces.sum(0), square + (forces**2).sum(0)
    return np.sqrt(np.maximum(square / count - (total / count) ** 2, 0.0))


def _of_sensor_places(
    sources: Sequence[SampleSource],
    settings: FrfSettings,
    counts: Sequence[int],
    name: str,
    conditions: dict[str, Any] | None,
) -> FrequencyResponse:
    places: dict[tuple[Any, ...], list[int]] = {}
    for number, source in enumerate(sources):
        place = tuple((channel.name, channel.dof) for channel in source.channels if channel.role == "output")
        places.setdefault(place, []).append(number)
    moved = [sensor for place in places for sensor in place]
    if len(places) == 1 or len(set(moved)) < len(moved):
        # One place, or a recording that lacks a response of the others, which is refused.
        return _measure(sources, settings, name, conditions)
    responses = [
        _measure(
            [sources[n] for n in members],
            _of_recordings(settings, members, counts),
            sources[members[0]].name,
            conditions,
        )
        for members in places.values()
    ]
    names = [port.channel for response in responses for port in response.outputs]
    if len(set(names)) < len(names):
        for number, response in enumerate(responses):
            outputs = tuple(replace(port, label=port.dof) for port in response.outputs)
            responses[number] = replace(response, outputs=outputs)
    return replace(join(responses), name=name)


def _measure(
    sources: Sequence[SampleSource], settings: FrfSettings, name: str, conditions: dict[str, Any] | None
) -> FrequencyResponse:
    layout, turned = _layout_of(sources, settings)
    sources, settings, shaft = without_shaft(sources, settings)
    cleaned = sources
    forces, responses = (
        [sensor.name for sensor in sensors] for sensors in (layout.input_sensors, layout.output_sensors)
    )
    is_told = settings.excitation in BLOCKS
    loop = feedback_of_records(sources, settings.reference, forces, responses) if is_told else ()
    monitors = [AliasingMonitor(source, settings.excitation == "impact") for source in sources]
    sources = list(monitors)
    open_loop = EXCITATIONS[settings.excitation]
    joint = bool(settings.reference) and settings.excitation == "random"
    parts = (joint_parts if joint else open_loop)(sources, settings, layout)
    aliasing = aliasing_findings(monitors, settings.band, _coherent_outputs(parts, layout))
    # What is folded back from above half the sampling rate comes before its cause as well.
    of_bands = settings_findings(parts.frequency, settings)
    of_lines = (*turned, *shaft, *of_bands, *aliasing, *parts.findings, *(() if aliasing else loop))
    findings = (*source_findings(sources), *uncertainty_findings(sources), *of_lines)
    sensor_factor = layout.sensor_factor(parts.frequency)
    matrix = parts.matrix * sensor_factor
    if parts.covariance is None and parts.averages <= len(layout.inputs):
        # Of as many averages as forces it is 1, whatever the noise.
        parts = replace(parts, coherence=None, multiple_coherence=None, partial_coherence=None)
    repeats_are = "sweeps" if settings.excitation == "sweep" else "hits"
    return FrequencyResponse(
        frequency=parts.frequency,
        matrix=matrix,
        outputs=layout.outputs,
        inputs=layout.inputs,
        form=layout.form,
        covariance=correct_covariance(parts.covariance, sensor_factor),
        coherence=parts.coherence,
        multiple_coherence=parts.multiple_coherence,
        partial_coherence=parts.partial_coherence,
        change=None if parts.change is None else parts.change * sensor_factor,
        open_loop=None if parts.open_loop is None else parts.open_loop * sensor_factor,
        snr=parts.snr,
        snr_channels=_channel_names(layout) if parts.snr is not None else (),
        averages=parts.averages,
        covariance_dof=parts.dof,
        line_correlation=parts.line_correlation,
        # Gains of a line on its neighbours' noise, of size one together.
        line_gains=None
        if parts.line_gains is None
        else parts.line_gains * np.exp(1j * np.angle(sensor_factor))[:, None],
        blocks=parts.blocks,
        repeats=None if parts.hits is None else np.moveaxis(parts.hits, 1, 0) * sensor_factor,
        repeat_names=tuple(f"{repeats_are[:-1]} {number}" for number in parts.hit_numbers),
        repeat_levels=np.array(parts.hit_peaks) if parts.hit_peaks else None,
        repeat_shares=parts.hit_shares,
        repeats_are=repeats_are,
        errors=(
            *sum_errors(cleaned, settings, layout, (parts.frequency, matrix), open_loop),
            *(error.turn(lambda part: part * sensor_factor) for error in parts.errors),
        ),
        name=name,
        findings=findings,
        conditions=dict(conditions or {}),
    )


def _layout_of(sources: Sequence[SampleSource], settings: FrfSettings) -> tuple[Layout, tuple[Finding, ...]]:
    """The layout of the recordings, and a note of responses that are turned to the quantity of the others."""
    layout = find_layout(sources)
    if len(set(layout.orders)) == 1:
        return layout, ()
    if settings.excitation == "random" and settings.local == "none":
        what = "the responses are of several quantities, and each leaks from block to block in its own way"
        hint = "local: polynomial follows what leaks; or role: reference for all but one quantity"
        raise DataError(what, hint=hint)
    pairs = zip(layout.output_sensors, layout.orders, strict=True)
    names = ", ".join(f"{sensor.name} ({sensor.quantity})" for sensor, n in pairs if n != layout.derivatives)
    return layout, (note("turned-response", f"{names} turned to the {layout.form} that the others are"),)


def _channel_names(layout: Layout) -> tuple[str, ...]:
    inputs, outputs = ([port.label for port in ports] for ports in (layout.inputs, layout.outputs))
    if set(inputs) & set(outputs):
        inputs, outputs = [f"{label} (input)" for label in inputs], [f"{label} (output)" for label in outputs]
    return (*inputs, *outputs)


def _coherent_outputs(parts: Parts, layout: Layout) -> set[str]:
    n_output = len(layout.outputs)
    if parts.multiple_coherence is not None:
        coherent = np.median(parts.multiple_coherence, axis=0) > EXPLAINED
    elif parts.snr is not None:
        coherent = np.median(parts.snr[:, -n_output:], axis=0) > LOW_SNR
    else:
        coherent = np.ones(n_output, bool)
    return {port.channel for port, is_coherent in zip(layout.outputs, coherent, strict=True) if is_coherent}
