"""Inputs and outputs of recordings as rows and columns of their common FRF matrix, and responses joined to
one.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from labpipe.errors import DataError
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel, SampleSource
from labpipe.records.response import BlockCovariance, Blocks, FrequencyResponse, Port, StoredCovariance
from labpipe.records.uncertain import MatrixError
from labpipe.spectra.bands import EDGE, lines_in
from labpipe.spectra.channels import check_in_time, columns_of
from labpipe.spectra.convert import DERIVATIVES, TRANSMISSIBILITY
from labpipe.spectra.settings import FrfSettings

# Time derivatives of a motion.
ORDER_OF = {"displacement": 0, "velocity": 1, "acceleration": 2}
FORM_OF = {"displacement": "receptance", "velocity": "mobility", "acceleration": "accelerance"}


@dataclass(frozen=True)
class Layout:
    """Inputs and outputs of the common matrix, and their channels in each recording. *input_columns*: per
    recording the channel index of every input, or -1 where that force does not act.
    """

    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    input_columns: tuple[tuple[int, ...], ...]
    output_columns: tuple[tuple[int, ...], ...]
    form: str
    input_sensors: tuple[Channel, ...]
    output_sensors: tuple[Channel, ...]

    def sensor_factor(self, frequency: FloatArray) -> ComplexArray:
        """S_input / S_output, the factor that corrects H for the sensors, (n_line, n_output, n_input) [1], at
        *frequency* (n_line,) [Hz], times (j w)^-n of `orders`. Raises as sensor_response does. Equation
        (spec-sensor-frf).
        """
        responses = [
            [sensor_response(sensor, frequency) for sensor in sensors]
            for sensors in (self.output_sensors, self.input_sensors)
        ]
        outputs, inputs = (np.array(rows, np.complex128).T for rows in responses)
        factor = inputs[:, None, :] / outputs[:, :, None]
        return factor / self.motion_factor(frequency)[:, :, None]

    def motion_factor(self, frequency: FloatArray) -> ComplexArray:
        """(j w)^n of `orders`, (n_line, n_output) [1/s^n], at *frequency* (n_line,) [Hz]; 1 at 0 Hz for n =
        0.
        """
        return (2j * np.pi * frequency[:, None]) ** np.array(self.orders)

    @property
    def one_force_each(self) -> bool:
        """Whether there are several forces of which one alone acts in every recording, as of a
        roving hammer.
        """
        return len(self.inputs) > 1 and all(
            sum(column >= 0 for column in columns) == 1 for columns in self.input_columns
        )

    @property
    def acting(self) -> list[int]:
        """The number of the force that acts in every recording."""
        return [max(range(len(columns)), key=columns.__getitem__) for columns in self.input_columns]

    @property
    def orders(self) -> tuple[int, ...]:
        """Time derivatives of every measured response beyond the form's, or beyond the motion of the base."""
        of_form = DERIVATIVES.get(self.form)
        if self.form == TRANSMISSIBILITY:
            of_form = ORDER_OF[self.input_sensors[0].quantity]
        if of_form is None:
            return (0,) * len(self.output_sensors)
        return tuple(ORDER_OF[sensor.quantity] - of_form for sensor in self.output_sensors)

    @property
    def derivatives(self) -> int:
        """The order of most responses."""
        return Counter(self.orders).most_common(1)[0][0]

    def pad(self, recording: int, values: ComplexArray, axes: int) -> ComplexArray:
        """*values* (..., n_channel) [any unit], its last *axes* axes in the order inputs, outputs. Zero for
        an absent force.
        """
        columns = (*self.input_columns[recording], *self.output_columns[recording])
        return at_columns(values, columns, axes)


def at_columns(values: ComplexArray, columns: Sequence[int], axes: int) -> ComplexArray:
    """*values* (..., n_channel) [any unit] at *columns* of its last *axes* axes; zero for a column -1."""
    chosen = np.array(columns)
    if np.array_equal(chosen, np.arange(values.shape[-1])):
        return values
    for axis in range(values.ndim - axes, values.ndim):
        values = np.take(values, np.maximum(chosen, 0), axis=axis)
        shape = [1] * values.ndim
        shape[axis] = chosen.size
        values = values * (chosen >= 0).reshape(shape)
    return values


def find_layout(sources: Sequence[SampleSource]) -> Layout:
    """The layout of the recordings' common matrix. DataError when a recording lacks an output or quantities
    differ.
    """
    inputs, input_columns, input_sensors = _ports_of(sources, "input")
    outputs, output_columns, output_sensors = _ports_of(sources, "output")
    form = _form(input_sensors, output_sensors)
    return Layout(inputs, outputs, input_columns, output_columns, form, input_sensors, output_sensors)


def response_ports(
    sources: Sequence[SampleSource],
) -> tuple[tuple[Port, ...], tuple[tuple[int, ...], ...], tuple[Channel, ...]]:
    """The responses of recordings without regard to forces: ports, the columns of each recording, channels.
    DataError as find_layout.
    """
    check_rate(sources)
    return _ports_of(sources, "output")


def sensor_response(sensor: Channel, frequency: FloatArray) -> ComplexArray:
    """Sensor frequency response, indicated / true: exp(-j w delay) g(f) exp(j phi(f)), (n_line,) [1] at
    *frequency* (n_line,) [Hz]. Gain g and phase phi are interpolated linearly in the channel's table; a phase
    that stays within -180 to 180 deg, or 0 to 360 deg, may jump by a turn. DataError for a line outside the
    table. Equation (spec-sensor).
    """
    response: ComplexArray = np.exp(-2j * np.pi * frequency * sensor.delay)
    if not sensor.response:
        return response
    nodes, gain, phase = np.array(sensor.response).T
    low, high = frequency.min(), frequency.max()
    if low < nodes[0] * (1 - EDGE) or high > nodes[-1] * (1 + EDGE):
        span = f"{nodes[0]:g}-{nodes[-1]:g} Hz"
        what = f"the band {low:g}-{high:g} Hz leaves the table of channel '{sensor.name}' ({span})"
        raise DataError(what, hint="narrow `band`, or calibrate the sensor further")
    half_turns = np.array([phase.min(), phase.max()]) / np.pi
    if np.max(np.abs(half_turns)) <= 1 or (half_turns[0] >= 0 and half_turns[1] <= 2):
        phase = np.unwrap(phase)
    return response * np.interp(frequency, nodes, gain) * np.exp(1j * np.interp(frequency, nodes, phase))


Key = tuple[str, str, float | None, float, tuple[tuple[float, float, float], ...]]


def _key(channel: Channel) -> Key:
    return (channel.name, channel.dof, channel.angle, channel.delay, channel.response)


def _ports_of(
    sources: Sequence[SampleSource], role: str
) -> tuple[tuple[Port, ...], tuple[tuple[int, ...], ...], tuple[Channel, ...]]:
    columns = [_columns_of(source, role) for source in sources]
    keys = list(dict.fromkeys(key for members in columns for key in members))
    places = [key[:3] for key in keys]
    for name, *_ in (place for place in places if places.count(place) > 1):
        what = f"'{name}' has not the same delay and response table in all recordings"
        raise DataError(what, hint="one test for each chain of that channel")
    if role == "output":
        for source, members in zip(sources, columns, strict=True):
            missing = ", ".join(key[0] for key in keys if key not in members)
            if missing:
                raise DataError(
                    f"recording '{source.name}' lacks the response {missing} of another recording"
                )
    by_key = {key: s.channels[n] for s, of in zip(sources, columns, strict=True) for key, n in of.items()}
    sensors = tuple(by_key[key] for key in keys)
    numbers = tuple(tuple(members.get(key, -1) for key in keys) for members in columns)
    return _ports(sensors), numbers, sensors


def _columns_of(source: SampleSource, role: str) -> dict[Key, int]:
    numbers = columns_of(source.channels, role)
    if not numbers:
        what = "force (role: input)" if role == "input" else "response (role: output)"
        raise DataError(f"recording '{source.name}' has no {what}", hint="see the channels of the rig file")
    check_in_time(source, [source.channels[number] for number in numbers])
    return {_key(source.channels[number]): number for number in numbers}


def _ports(sensors: Sequence[Channel]) -> tuple[Port, ...]:
    """Ports labelled by channel where that is unique, else by dof, else by both."""
    names, dofs = [sensor.name for sensor in sensors], [sensor.dof for sensor in sensors]
    ports = []
    for sensor in sensors:
        name, dof = sensor.name, sensor.dof
        unique = name if names.count(name) == 1 else dof if dofs.count(dof) == 1 else f"{name}@{dof}"
        ports.append(Port(unique, name, dof, sensor.angle, sensor.uncertainties))
    return tuple(ports)


def _form(forces: Sequence[Channel], responses: Sequence[Channel]) -> str:
    """The form of the matrix. Of motions of several quantities at places of their own it is that of most of
    them, and the others are turned to it.
    """
    effects = Counter(channel.quantity for channel in responses)
    causes, places = {channel.quantity for channel in forces}, {channel.dof for channel in responses}
    of_motions = len(causes) == 1 and effects.keys() <= ORDER_OF.keys()
    is_base = of_motions and causes <= ORDER_OF.keys()
    may_differ = (is_base or (of_motions and causes == {"force"})) and len(places) == len(responses)
    if len(effects) > 1 and not may_differ:
        hint = (
            "keep one per FRF matrix (role: reference for the others, or a sum of channels: derived), give "
            "every motion a `dof` of its own, or use frf: {result: spectra}"
        )
        raise DataError(f"the responses are of several quantities ({', '.join(sorted(effects))})", hint=hint)
    if is_base:
        return TRANSMISSIBILITY
    return FORM_OF.get(effects.most_common(1)[0][0], "other") if causes == {"force"} else "other"


def check_rate(sources: Sequence[SampleSource]) -> None:
    """DataError for no recordings, and for recordings of different sampling rates."""
    rates = [source.sample_rate for source in sources]
    if not rates:
        raise DataError("no recordings", hint="name at least one")
    if max(rates) - min(rates) > 1e-9 * max(rates):
        named = ", ".join(f"{source.name} {source.sample_rate:g} Hz" for source in sources)
        raise DataError(f"the recordings have different sampling rates: {named}")


def source_findings(sources: Sequence[SampleSource]) -> tuple[Finding, ...]:
    """What was found in the recordings, with the name of each where there are several."""
    several = len(sources) > 1
    return tuple(
        replace(finding, message=f"{source.name}: {finding.message}") if several else finding
        for source in sources
        for finding in source.findings
    )


def left_out(source: SampleSource, why: str) -> Finding:
    """What is said of a recording that does not count beside others."""
    return Finding("recording-left-out", f"recording '{source.name}' is left out: {why}")


def without_short(
    sources: Sequence[SampleSource], settings: FrfSettings
) -> tuple[Sequence[SampleSource], tuple[Finding, ...]]:
    """The recordings but those that are too short for an average, beside longer ones of the same channels;
    what is said of the former.
    """
    least = (settings.skip + 1) * settings.period if settings.period else settings.block or 0.0
    # Of realisations none may be missing.
    least *= not settings.realisations
    channels = [[(channel.name, channel.dof) for channel in source.channels] for source in sources]
    long = [source.n_sample >= round(least * source.sample_rate) for source in sources]
    counts = [
        here or names not in itertools.compress(channels, long)
        for here, names in zip(long, channels, strict=True)
    ]
    why = f"it is shorter than one average takes ({least:g} s)"
    short = [source for source, count in zip(sources, counts, strict=True) if not count]
    return list(itertools.compress(sources, counts)), tuple(left_out(source, why) for source in short)


# Share of lines with low signal-to-noise ratio above which a warning is given.
POOR_SHARE = 0.1
# Share of a response's power that the forces explain.
LOW_COHERENCE = 0.9


@dataclass(frozen=True, kw_only=True)
class Parts:
    """FRF matrix (n_line, n_output, n_input) [output unit / N], covariance and quality on the measured lines.
    frequency (n_line,) [Hz]; covariance (n_line, n, n) of vec(H), n = n_output * n_input, or its parts;
    coherences and snr [1] as in FrequencyResponse; line_correlation and line_gains (n_line, n_neighbour,
    n_output, n_input) likewise, change, open_loop and blocks. hits (n_line, n_hit, n_output, n_input) [output
    unit / N] of one recording's hits or of all sweeps alone, with their numbers and peak (sweeps: r.m.s.)
    forces [N]; hit_shares (n_hit,) [1] of a sweep's block before zeros; errors that lines have in common.
    """

    frequency: FloatArray
    matrix: ComplexArray
    covariance: StoredCovariance
    averages: float
    dof: float
    findings: tuple[Finding, ...] = ()
    coherence: FloatArray | None = None
    multiple_coherence: FloatArray | None = None
    partial_coherence: FloatArray | None = None
    snr: FloatArray | None = None
    line_correlation: tuple[complex, ...] = ()
    line_gains: ComplexArray | None = None
    blocks: Blocks | None = None
    change: ComplexArray | None = None
    open_loop: ComplexArray | None = None
    hits: ComplexArray | None = None
    hit_numbers: tuple[int, ...] = ()
    hit_peaks: tuple[float, ...] = ()
    hit_shares: FloatArray | None = None
    errors: tuple[MatrixError, ...] = ()


def select_lines(frequency: FloatArray, settings: FrfSettings) -> BoolArray:
    """Lines (n_line,) [Hz] in the settings' band and outside its excluded bands, as a mask (n_line,).
    DataError when none is left.
    """
    chosen = lines_in(frequency, settings.band, settings.exclude)
    if not np.any(chosen):
        raise DataError("no line of the band is left", hint="`exclude` and `mask` cover them all")
    return chosen


def parts_at_lines(parts: Parts, chosen: BoolArray) -> Parts:
    """The parts at the *chosen* lines (n_line,) alone."""
    arrays: dict[str, Any] = {
        name: values[chosen] for name, values in vars(parts).items() if isinstance(values, np.ndarray)
    }
    if isinstance(parts.covariance, BlockCovariance):
        arrays["covariance"] = replace(parts.covariance, blocks=parts.covariance.blocks[chosen])
    return replace(parts, **arrays)


def coherence_findings(multiple: FloatArray, power: FloatArray, layout: Layout) -> tuple[Finding, ...]:
    """Warnings for outputs of whose *power* (n_frequency, n_output) [unit^2/Hz] much is noise, by the
    *multiple* coherence (same shape).
    """
    total = np.sum(power, axis=0)
    noise = np.divide(
        np.sum((1 - multiple) * power, axis=0), total, out=np.zeros_like(total), where=total > 0
    )
    return tuple(
        Finding(
            "low-coherence",
            f"response {port.label}: {100 * share:.0f} % of its power in the band is "
            "not explained by the forces",
        )
        for port, share in zip(layout.outputs, noise, strict=True)
        if share > 1 - LOW_COHERENCE
    )


# Relative tolerance between the frequency axes, which files print with six digits.
SAME_AXIS = 1e-5
# What a response has for each element beside H.
QUALITIES = ("coherence", "partial_coherence", "distortion", "change", "open_loop", "line_gains")


def join(responses: Sequence[FrequencyResponse]) -> FrequencyResponse:
    """One matrix (n_frequency, n_output, n_input) [unit of the form] of elements, rows or columns that lie in
    several responses. Rows and columns are in the order of the numbers in their labels. Coherences and
    covariances stay where all responses have them; their noise is independent. DataError for an element that
    is missing or there twice, for frequencies or forms that differ.
    """
    first = responses[0]
    for response in responses[1:]:
        _check_alike(response, first)
    outputs = _joined_ports([port for response in responses for port in response.outputs])
    inputs = _joined_ports([port for response in responses for port in response.inputs])
    rows, columns = ({port.label: number for number, port in enumerate(ports)} for ports in (outputs, inputs))
    _check_all_joined(responses, rows, columns)
    places = [
        (np.array([rows[o.label] for o in part.outputs])[:, None], [columns[i.label] for i in part.inputs])
        for part in responses
    ]
    shape = len(rows), len(columns)
    whole = {name: _place(responses, name, places, shape) for name in ("matrix", *QUALITIES)}
    windows = {response.line_correlation for response in responses}
    return FrequencyResponse(
        frequency=first.frequency,
        outputs=outputs,
        inputs=inputs,
        form=first.form,
        covariance=_covariance(responses, places, shape),
        covariance_dof=min(response.covariance_dof for response in responses),
        averages=min(response.averages for response in responses),
        line_correlation=windows.pop() if len(windows) == 1 else (),
        blocks=_joined_blocks([response.blocks for response in responses]),
        errors=_errors(responses, places, shape),
        findings=tuple(dict.fromkeys(finding for response in responses for finding in response.findings)),
        conditions=first.conditions,
        **whole,
    )


def _joined_blocks(blocks: Sequence[Blocks | None]) -> Blocks | None:
    """Those of all, of bursts with their mean course, of hits as where one rings on; None where they
    differ.
    """
    known = [of for of in blocks if of is not None]
    if not known or (len(known) < len(blocks) and not known[0].after_hit):
        return None
    if len({replace(of, bursts=(0.0,) * len(of.bursts), after_hit=0.0) for of in known}) > 1:
        return None
    course = tuple(np.mean([of.bursts for of in known], axis=0).tolist())
    return replace(known[0], bursts=course, after_hit=max(of.after_hit for of in known))


# Rows (n, 1) and columns of a response in the joined matrix.
Place = tuple[IntArray, list[int]]


def _place(
    responses: Sequence[FrequencyResponse], name: str, places: Sequence[Place], shape: tuple[int, int]
) -> Any:
    """An array by output and input of all responses; None where one has none."""
    parts = [getattr(response, name) for response in responses]
    if any(part is None for part in parts):
        return None
    whole = np.zeros((*parts[0].shape[:-2], *shape), parts[0].dtype)
    for (row, column), part in zip(places, parts, strict=True):
        whole[..., row, column] = part
    return whole


def _covariance(
    responses: Sequence[FrequencyResponse], places: Sequence[Place], shape: tuple[int, int]
) -> StoredCovariance:
    covariances = [
        covariance for covariance in (response.covariance for response in responses) if covariance is not None
    ]
    if len(covariances) < len(responses):
        return None
    elements = [(row * shape[1] + column).ravel() for row, column in places]
    if len({element.size for element in elements}) == 1:
        return BlockCovariance(np.array(elements), np.stack(covariances, axis=1))
    n = shape[0] * shape[1]
    whole = np.zeros((responses[0].n_frequency, n, n), np.complex128)
    for element, covariance in zip(elements, covariances, strict=True):
        whole[:, element[:, None], element] = covariance
    return whole


def _errors(
    responses: Sequence[FrequencyResponse], places: Sequence[Place], shape: tuple[int, int]
) -> tuple[MatrixError, ...]:
    by_source = {error.uncertainty.source: error for response in responses for error in response.errors}
    wholes = {source: np.zeros((responses[0].n_frequency, *shape), np.complex128) for source in by_source}
    for response, (row, column) in zip(responses, places, strict=True):
        for error in response.errors:
            wholes[error.uncertainty.source][:, row, column] += error.change
    # Powers of one matrix are not those of several together.
    return tuple(replace(error, change=wholes[source], parts=()) for source, error in by_source.items())


def _check_all_joined(
    responses: Sequence[FrequencyResponse], rows: Iterable[str], columns: Iterable[str]
) -> None:
    holders: dict[tuple[str, str], str] = {}
    for response in responses:
        for output, port in itertools.product(response.outputs, response.inputs):
            pair = output.label, port.label
            if pair in holders:
                what = f"{output.label}/{port.label} lies in {holders[pair]} and in {response.name}"
                raise DataError(what, hint="one file for each element")
            holders[pair] = response.name
    missing = [
        f"{output}/{port}"
        for output, port in itertools.product(rows, columns)
        if (output, port) not in holders
    ]
    if missing:
        raise DataError(f"{', '.join(missing[:5])} was not measured", hint="every output needs every input")


def _check_alike(response: FrequencyResponse, first: FrequencyResponse) -> None:
    if response.form != first.form:
        raise DataError(f"{response.name} is a {response.form}, {first.name} a {first.form}")
    if response.n_frequency != first.n_frequency:
        what = f"{response.name} has {response.n_frequency} frequencies, {first.name} has {first.n_frequency}"
        raise DataError(what)
    if not np.allclose(response.frequency, first.frequency, rtol=SAME_AXIS, atol=0):
        line = int(np.argmax(np.abs(response.frequency - first.frequency)))
        raise DataError(
            f"the frequencies of {response.name} differ from those of {first.name}: "
            f"{response.frequency[line]:g} and {first.frequency[line]:g} Hz at line {line + 1}"
        )


def _joined_ports(ports: Sequence[Port]) -> tuple[Port, ...]:
    """Distinct ports, 2x before 10x."""
    distinct = {port.label: port for port in reversed(ports)}
    parts = {label: [part for part in re.split(r"(\d+)", label) if part] for label in distinct}
    natural = {
        label: [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in split]
        for label, split in parts.items()
    }
    return tuple(distinct[label] for label in sorted(distinct, key=natural.__getitem__))
