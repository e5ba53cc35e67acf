"""labpipe orders SOURCE: amplitude and phase of an order of the shaft speed over a run."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts.writing import OutputFolder, output_file, output_folder
from labpipe.cli.output import echo
from labpipe.document.charts import svg_file
from labpipe.errors import ConfigError
from labpipe.methods.run_ups.judgement import IntervalEstimate, RunUpJudgement, judge
from labpipe.methods.run_ups.measured import run_up_of, weight_effect
from labpipe.methods.run_ups.records import RunUp
from labpipe.methods.run_ups.run_up_csv import write_run_up_csv
from labpipe.methods.run_ups.settings import MANY_PULSES, ONE_PULSE
from labpipe.project.ingest import SourceFile, ingest, is_recording
from labpipe.project.measured import file_stems
from labpipe.project.rig_file import load_rig
from labpipe.quantities import QUANTITIES, locate_units, parse_value, to_display
from labpipe.records.recording import Channel
from labpipe.records.rig import Rig
from labpipe.records.settings import Setting, parse_phasor, to_band
from labpipe.report import chart
from labpipe.report.document import Figure
from labpipe.report.figures import PHASE, phase_degrees
from labpipe.spectra.orders import OrderTrack, plane_track, track_order
from labpipe.spectra.settings import ShaftLines

MOST_ORBITS = 8
MOST_COLUMNS = 4
# Room above the amplitudes for their names, and above the limit of a gap.
LEGEND_ROOM, LIMIT_ROOM = 1.3, 1.15
# Share of the gap beyond which an orbit is reported, unless stated.
LIMIT = 0.2
# Relative change below which a speed counts as constant.
STEADY = 1e-3


def _unit(quantity: str) -> tuple[str, float]:
    entry = QUANTITIES.get(quantity)
    return (entry.display_unit, to_display(1.0, entry.display_unit)) if entry else ("SI", 1.0)


def order_figure(name: str, track: OrderTrack, circles: Sequence[OrderTrack], quantity: str) -> Figure:
    across, along = _across(track)
    unit, factor = _unit(quantity)
    phases = [
        chart.dots(port.label, across, phase_degrees(track.amplitude[:, n]), n % chart.PALETTE_SIZE, size=1.5)
        for n, port in enumerate(track.ports)
    ]
    amplitudes = _amplitudes(track, across, factor)
    for n, port in enumerate(track.ports):
        whole = factor * track.overall[:, n]
        amplitudes.append(
            chart.curve(f"{port.label}, whole motion", across, whole, n % chart.PALETTE_SIZE, "--", width=0.8)
        )
    panels = [
        chart.Panel(along, _amplitude_axis("amplitude", unit, amplitudes), tuple(amplitudes)),
        chart.Panel(along, PHASE, tuple(phases)),
    ]
    for plane in circles:
        radii = _amplitudes(plane, across, factor)
        panels.append(chart.Panel(along, _amplitude_axis("circles", unit, radii), tuple(radii)))
    meaning = "shaded: two standard deviations; dashed: half of the whole motion's peak-to-peak value"
    caption = f"{name}: order {track.order:g}, 0-to-peak, and phase against the tacho; {meaning}."
    return Figure(
        chart.stack(panels, 2.2 * len(panels)),
        caption,
        f"Amplitude and phase of order {track.order:g} of {name}",
    )


def _amplitudes(track: OrderTrack, across: FloatArray, factor: float) -> list[chart.Series]:
    series = []
    for number, port in enumerate(track.ports):
        size = factor * np.abs(track.amplitude[:, number])
        spread = 2 * factor * np.sqrt(track.variance[:, number] / 2)
        band, colour = (np.maximum(size - spread, 0), size + spread), number % chart.PALETTE_SIZE
        series.append(
            chart.curve(port.label, across, size, colour, marker=".", size=1.5, band=band, opacity=0.2)
        )
    return series


def _amplitude_axis(title: str, unit: str, series: Sequence[chart.Series]) -> chart.Axis:
    return chart.Axis(title, unit, low=0.0, high=LEGEND_ROOM * _largest(series))


def _largest(series: Sequence[chart.Series]) -> float:
    parts = [part for entry in series for part in (entry.y, entry.high) if part is not None]
    return float(np.nanmax(np.concatenate(parts)))


def _across(track: OrderTrack) -> tuple[FloatArray, chart.Axis]:
    turning = bool(np.ptp(track.speed) > STEADY * np.max(track.speed))
    return (
        (60 * track.speed, chart.Axis("speed", "rpm")) if turning else (track.time, chart.Axis("time", "s"))
    )


def gap_figure(
    name: str, track: OrderTrack, circles: Sequence[OrderTrack], gap: float, limit: float
) -> Figure:
    across, along = _across(track)
    series: list[chart.Series] = []
    for number, circle in enumerate(circles):
        (plane,) = circle.planes
        label, colour = plane.name or "orbit", number % chart.PALETTE_SIZE
        half_axis = np.abs(circle.amplitude).sum(axis=1)
        share = 100 * circle.orbit[:, 0] / gap
        series.append(chart.curve(f"{label}, whole motion", across, share, colour, width=1.2))
        series.append(
            chart.curve(f"{label}, order {track.order:g}", across, 100 * half_axis / gap, colour, "--")
        )
    bound = chart.level(100 * limit, name=f"{100 * limit:g} % of the gap")
    panel = chart.Panel(
        along, chart.Axis("orbit / gap", "%", 0.0, LIMIT_ROOM * _largest([*series, bound])), (*series, bound)
    )
    caption = (
        f"{name}: largest distance of the shaft from the middle of its orbit, against the gap of "
        f"{to_display(gap, 'um'):g} um."
    )
    return Figure(chart.stack([panel], 3.2), caption, f"Orbit size of {name} against the gap")


def orbit_series_figure(name: str, circles: OrderTrack, quantity: str) -> Figure:
    chosen = np.unique(
        np.linspace(0, circles.time.size - 1, min(MOST_ORBITS, circles.time.size)).round().astype(int)
    )
    panels = tuple(_orbit(circles, row, *_unit(quantity)) for row in chosen.tolist())
    columns = min(MOST_COLUMNS, chosen.size)
    rows = -(-chosen.size // columns)
    (plane,) = circles.planes
    where = f" at {plane.name}" if plane.name else ""
    graphic = chart.Chart(panels, rows, columns, (chart.WIDTH, 2.0 * rows + 0.4), "xy", "none")
    return Figure(
        graphic,
        f"{name}: orbits of order {circles.order:g}{where}, from x to y (forward) or backward; the dot marks "
        "the tacho's pulse.",
        f"Orbits of {name}{where}",
    )


def _orbit(circles: OrderTrack, row: int, unit: str, factor: float) -> chart.Panel:
    """One orbit: x = Re (f + b) e, y = Re (-j f + j b) e, as one complex number f e + conj(b e)."""
    forward, backward = circles.amplitude[row]
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, 181))
    path = factor * (forward * turn + np.conj(backward * turn))
    series = (
        chart.curve("orbit", path.real, path.imag),
        chart.dots("pulse", path.real[:1], path.imag[:1], 1, marker="o"),
    )
    title = f"{60 * circles.speed[row]:.0f} rpm{', backward' * bool(abs(backward) > abs(forward))}"
    return chart.Panel(chart.Axis("x", unit), chart.Axis("y", unit), series, title, equal=True)


def judged_figure(name: str, verdict: RunUpJudgement, quantity: str) -> Figure:
    """Amplitudes without the slow roll over speed, critical speeds with intervals, operating speeds."""
    unit, factor = _unit(quantity)
    series: list[chart.Series] = []
    for number, label in enumerate(verdict.probes):
        low, high = factor * verdict.ends[:, :, number]
        size, colour = factor * verdict.curve[:, number], number % chart.PALETTE_SIZE
        series.append(chart.curve(label, 60 * verdict.fine, size, colour, band=(low, high), opacity=0.2))
    axis = _amplitude_axis("amplitude", unit, series)
    for peak in verdict.peaks:
        colour, top = verdict.probes.index(peak.probe) % chart.PALETTE_SIZE, factor * peak.amplitude.value
        ends = 60 * np.array([peak.speed.low, peak.speed.high])
        bars = [factor * peak.amplitude.low], [factor * peak.amplitude.high]
        series.append(chart.curve("", ends, [top, top], colour, width=2.0))
        series.append(chart.dots("", [60 * peak.speed.value], [top], colour, marker="o", bars=bars))
    shade = ""
    if verdict.speed_range is not None:
        series += [chart.upright(60 * end, line="--") for end in verdict.speed_range]
        shade = " Between the dashed lines: operating speeds."
    caption = (
        f"{name}: amplitude, 0-to-peak, {'with' if verdict.slow_roll is None else 'without'} its slow roll, "
        f"and critical speeds; shaded and bars: 95 % intervals.{shade}"
    )
    panel = chart.Panel(chart.Axis("speed", "rpm"), axis, tuple(series))
    return Figure(
        chart.stack([panel], 3.2), caption, f"Amplitude of {name} over speed with its critical speeds"
    )


Column = tuple[str, FloatArray]


@dataclass(frozen=True)
class Clearance:
    """The radial *gap* of the bearings [m], and the *limit* of a motion as a share of it."""

    gap: float
    limit: float


@dataclass(frozen=True)
class TrackedRun:
    """An order over a run of *channels*, and in circles of every plane; *clearance* for its orbits."""

    name: str
    channels: tuple[Channel, ...]
    track: OrderTrack
    circles: tuple[OrderTrack, ...]
    clearance: Clearance | None = None

    @property
    def probes(self) -> tuple[tuple[str, str], ...]:
        return tuple((c.name, c.quantity) for c in self.channels if c.role == "output")

    @property
    def quantity(self) -> str:
        """What the responses are, empty where they differ."""
        quantities = {quantity for _, quantity in self.probes}
        return quantities.pop() if len(quantities) == 1 else ""

    @property
    def speeds(self) -> FloatArray:
        """Speed of every stretch (n_stretch,) [rpm]."""
        return 60 * self.track.speed

    def without_slow_roll(self, verdict: RunUpJudgement | None) -> TrackedRun:
        """The order less the slow roll of a *verdict*; the whole motion stays as recorded."""
        if verdict is None or verdict.slow_roll is None:
            return self
        track = self.track
        left, unknown = track.amplitude - verdict.slow_roll, track.variance + verdict.slow_roll_variance
        track = replace(track, amplitude=left, variance=unknown)
        return replace(self, track=track, circles=tuple(plane_track(track, p) for p in track.planes))


def track_run(
    source: Path,
    rig: Rig | None,
    lines: ShaftLines,
    order: float,
    revolutions: int,
    output: OutputFolder,
    clearance: Clearance | None = None,
    suffix: str = "",
) -> TrackedRun:
    """The order of a raw file (with its rig), its recording written with a *suffix*, or of a calibrated one.
    ConfigError for a gap where no plane moves in it.
    """
    if rig is None and not is_recording(source):
        raise ConfigError("a raw file needs its rig file", source, "add -r RIG")
    # A calibrated recording is opened as it is, whatever the rig.
    recording = ingest(SourceFile(source, rig or Rig("", ())), output, f"{source.stem}{suffix}", Path.cwd())
    track = track_order(recording, lines, order=order, revolutions=revolutions)
    circles = tuple(plane_track(track, plane) for plane in track.planes)
    run = TrackedRun(recording.name, tuple(recording.channels), track, circles, clearance)
    if clearance is not None and (run.quantity != "displacement" or not circles):
        hint = "two displacements in known directions (dof: x and y, or front.x and front.y) are needed"
        raise ConfigError("--gap: no orbit to compare with the gap", source, hint)
    return run


def write_tracked(run: TrackedRun, verdict: RunUpJudgement | None, output: OutputFolder) -> list[str]:
    _write_table(run, output.write_path("orders.csv"))
    figures = {"orders.svg": order_figure(run.name, run.track, run.circles, run.quantity)}
    stems = file_stems((plane.name for plane in run.track.planes), "planes")
    for circles in run.circles:
        (plane,) = circles.planes
        place = f"-{stems[plane.name]}" if plane.name else ""
        figures[f"orbits{place}.svg"] = orbit_series_figure(run.name, circles, run.quantity)
    if run.clearance:
        gap, limit = run.clearance.gap, run.clearance.limit
        figures["gap.svg"] = gap_figure(run.name, run.track, run.circles, gap, limit)
    entries = {}
    if verdict is not None:
        entries["judgement.json"] = json.dumps(judgement_entry(verdict, run.quantity), indent=1) + "\n"
        figures["judgement.svg"] = judged_figure(run.name, verdict, run.quantity)
    texts = entries | {name: svg_file(figure) for name, figure in figures.items()}
    for name, text in texts.items():
        output.write_path(name).write_text(text, encoding="utf-8")
    return ["orders.csv", *texts]


def run_up_table(
    run: TrackedRun, load: float, unbalance: Mapping[str, complex], before: TrackedRun | None = None
) -> RunUp:
    """The 1x of every plane, less that of the run *before*; ConfigError for a plane without a name."""
    if any(not plane.name for plane in run.track.planes):
        hint = "dof: disc1.x and dof: disc1.y in the rig file"
        raise ConfigError("--save-run-up: the plane of the responses has no name", hint=hint)
    table = run_up_of(run.track, run.channels, run.name, load, unbalance)
    if before is None:
        return table
    return weight_effect(run_up_of(before.track, before.channels, before.name, load, unbalance), table)


def write_run_up(table: RunUp, path: Path) -> str:
    """Write a run-up table, complete or absent; what is in it, in words."""
    with output_file(path) as target:
        write_run_up_csv(target, table)
    text = f"{path}, {table.n_speed} speeds"
    sources = dict.fromkeys(error.uncertainty.source for error in table.uncertainties)
    return f"{text}, without the uncertainties of {', '.join(sources)}" if sources else text


def order_lines(run: TrackedRun) -> Iterator[str]:
    """What is wrong with the tacho, the largest amplitudes, and orbits against the gap."""
    yield from (f"warning {finding.code}: {finding.message}" for finding in run.track.findings)
    unit, factor = _unit(run.quantity)
    for track in (run.track, *run.circles):
        for number, port in enumerate(track.ports):
            size = factor * np.abs(track.amplitude[:, number])
            peak = int(np.argmax(size))
            line = f"{port.label:<8} largest {size[peak]:.4g} {unit} 0-to-peak at {run.speeds[peak]:.4g} rpm"
            if track is run.track:
                line += f"; whole motion {factor * np.max(track.overall[:, number]):.4g}"
            yield line
    if run.clearance is None:
        return
    gap, share = run.clearance.gap, run.clearance.limit
    limit = f"{100 * share:g} %"
    for number, plane in enumerate(run.track.planes):
        orbit = run.track.orbit[:, number]
        peak, beyond = int(np.argmax(orbit)), np.flatnonzero(orbit > share * gap)
        verdict = f"within {limit} at all speeds"
        if beyond.size:
            low, high = run.speeds[beyond].min(), run.speeds[beyond].max()
            verdict = f"beyond {limit} at speeds from {low:.4g} to {high:.4g} rpm"
        largest = f"{factor * orbit[peak]:.4g} {unit} = {100 * orbit[peak] / gap:.3g} % of the gap"
        yield f"{plane.name:<8} largest orbit {largest} at {run.speeds[peak]:.4g} rpm: {verdict}"


def _write_table(run: TrackedRun, path: Path) -> None:
    columns = [("time_s", run.track.time), ("speed_hz", run.track.speed)]
    for track in (run.track, *run.circles):
        for number, port in enumerate(track.ports):
            phasor = track.amplitude[:, number]
            columns.append((f"{port.label}:amplitude", np.abs(phasor)))
            columns.append((f"{port.label}:phase_deg", np.degrees(np.angle(phasor))))
            columns.append((f"{port.label}:std", np.sqrt(track.variance[:, number])))
    columns += [
        (f"{port.label}:overall", run.track.overall[:, number]) for number, port in enumerate(run.track.ports)
    ]
    for circles in run.circles:
        columns += _orbit_columns(circles, run.clearance)
    with path.open("w", encoding="utf-8", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerow([title for title, _ in columns])
        np.savetxt(stream, np.column_stack([values for _, values in columns]), "%.9g", ",")


def _orbit_columns(circles: OrderTrack, clearance: Clearance | None) -> list[Column]:
    (plane,) = circles.planes
    whole = circles.orbit[:, 0]
    columns = {
        "half_axis": np.abs(circles.amplitude).sum(axis=1),
        "orbit": whole,
        "centreline_x": circles.mean[:, 0],
        "centreline_y": circles.mean[:, 1],
    }
    if clearance is not None:
        columns["orbit_per_gap"] = whole / clearance.gap
    return [(plane.label(name), values) for name, values in columns.items()]


def track_and_write(
    recording: Path,
    output: Path,
    rig_path: Path | None,
    tacho: str | None,
    pulses: int,
    speed: str | None,
    order: float,
    harmonics: int,
    revolutions: int,
    gap: str | None,
    limit: str | None,
    save_run_up: Path | None,
    load: str | None,
    unbalance: tuple[str, ...],
    quiet: bool,
    slow_roll: str | None,
    speed_range: str | None,
    baseline: Path | None,
    centreline: bool,
) -> int:
    slow, operating = _band("--slow-roll", slow_roll), _band("--speed-range", speed_range)
    is_judged, is_saved = any((slow, operating, baseline)), save_run_up is not None
    _check_options(order, is_judged, is_saved, load, unbalance)
    rig = None if rig_path is None else load_rig(rig_path)
    shaft_speed = _value("--speed", speed, "Hz")
    if tacho is None and shaft_speed is None:
        tacho = _tacho_of(rig)
    lines = ShaftLines(shaft_speed, tacho, pulses, harmonics)
    if pulses > 1 and (is_saved or baseline is not None):
        raise ConfigError(f"--pulses: {MANY_PULSES}", hint=ONE_PULSE)
    conditions = _run_conditions(load, unbalance) if is_saved else None
    added = _stated_unbalance(unbalance, baseline is not None, is_saved)
    with output_folder(output) as folder:
        run = track_run(recording, rig, lines, order, revolutions, folder, _clearance(gap, limit))
        if centreline and not run.circles:
            raise ConfigError("--centreline: there is no plane", hint="dof: front.x and front.y")
        before = None
        if baseline is not None:
            before = track_run(baseline, rig, lines, order, revolutions, folder, suffix="-baseline")
            if before.probes != run.probes:
                hint = "record both with one rig"
                raise ConfigError("--baseline: its responses are not those of the run", baseline, hint)
        verdict = None
        if is_judged:
            of = None if before is None else before.track
            verdict = judge(run.track, slow_roll=slow, speed_range=operating, unbalance=added, baseline=of)
        # That of a baseline is the same and cancels.
        whole, run = run, run.without_slow_roll(verdict)
        names, saved = write_tracked(run, verdict, folder), ""
        if save_run_up is not None and conditions is not None:
            table = run_up_table(whole if before else run, *conditions, before)
            saved = f"; {write_run_up(table, save_run_up)}"
    code = 0 if verdict is None or verdict.accepted else 1
    if quiet:
        return code
    between = f"{run.speeds.min():.4g}-{run.speeds.max():.4g} rpm"
    echo(f"{run.name}: order {order:g}, {run.speeds.size} segments of {revolutions} revolutions, {between}")
    judged = () if verdict is None else judgement_lines(verdict, run.quantity)
    for row in (*order_lines(run), *(_centreline(run) if centreline else ()), *judged):
        echo(f"  {row}")
    echo(f"written to {output}: {', '.join(names)}{saved}")
    return code


def _tacho_of(rig: Rig | None) -> str:
    """The one tacho of a *rig*; ConfigError without one, or among several."""
    channels = () if rig is None else rig.all_channels
    names = [channel.name for channel in channels if channel.quantity == "tacho"]
    if len(names) != 1:
        hint = f"--tacho {' or '.join(names) or 'CHANNEL'}, or --speed '50 Hz'"
        raise ConfigError("the speed of the shaft is needed", hint=hint)
    return names[0]


def _check_options(
    order: float, is_judged: bool, is_saved: bool, load: str | None, unbalance: tuple[str, ...]
) -> None:
    if not 0 < order < np.inf:
        raise ConfigError("--order must be positive")
    if order != 1 and (is_judged or is_saved):
        raise ConfigError(f"a run-up is of order 1, not {order:g}", hint="leave --order out")
    if load is not None and not is_saved:
        raise ConfigError("--load belongs to --save-run-up", hint="leave it out")
    if unbalance and not (is_judged or is_saved):
        hint = "--save-run-up, --slow-roll, --speed-range or --baseline"
        raise ConfigError("--unbalance belongs to a table or a judgement", hint=hint)


def _band(option: str, text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    with locate_units(option):
        return to_band(text, Setting("band", option, unit="Hz"))


def _stated_unbalance(texts: tuple[str, ...], since: bool, is_saved: bool) -> float:
    """The one unbalance [kg m] that the motion answers, else 0; ConfigError where a baseline needs it."""
    sizes = [abs(size) for size in _unbalances(texts).values()]
    if len(sizes) == 1 and sizes[0] > 0:
        return sizes[0]
    if since or (sizes and not is_saved):
        hint = "--unbalance 'disc 1=50 g.mm at 0 deg'"
        raise ConfigError("sensitivity is to one stated unbalance above zero", hint=hint)
    return 0.0


def _centreline(run: TrackedRun) -> Iterator[str]:
    unit, factor = _unit(run.quantity)
    first, last = int(np.argmin(run.track.speed)), int(np.argmax(run.track.speed))
    for circles in run.circles:
        (plane,) = circles.planes
        x, y = circles.mean[last] - circles.mean[first]
        moved = float(np.hypot(x, y))
        share = f", {100 * moved / run.clearance.gap:.3g} % of the gap" if run.clearance else ""
        yield (
            f"{plane.name:<8} centreline moved by {factor * moved:.4g} {unit} at "
            f"{np.degrees(np.arctan2(y, x)):.0f} deg from {run.speeds[first]:.4g} to "
            f"{run.speeds[last]:.4g} rpm{share}"
        )


def judgement_lines(verdict: RunUpJudgement, quantity: str) -> Iterator[str]:
    """Slow roll, critical speeds with their margins and decisions, sensitivities."""
    unit, factor = _unit(quantity)
    if verdict.slow_roll is not None:
        for label, vector in zip(verdict.probes, verdict.slow_roll, strict=True):
            size, angle = factor * abs(vector), np.degrees(np.angle(vector))
            yield f"{label:<8} slow roll {size:.3g} {unit} at {angle:.0f} deg, subtracted"
    for peak in verdict.peaks:
        text = f"{peak.probe:<8} critical speed {_ends(peak.speed, 60.0)} rpm"
        if peak.amplification is not None:
            text += f", amplification factor {_ends(peak.amplification)}"
        if peak.margin is not None:
            asked = "unknown" if peak.asked is None else f"{_ends(peak.asked)} %"
            text += f", margin {_ends(peak.margin)} %, asked for {asked}: {peak.outcome}"
        if peak.fast:
            text += "; passed too fast for a steady peak"
        yield text
    if not verdict.peaks:
        yield "no critical speed within the run"
    if verdict.not_run:
        yield verdict.not_run
    for row in verdict.sensitivities:
        size = _ends(row.size, 1e-6 * factor)
        yield f"{row.probe:<8} sensitivity {size} {unit}/(g mm) at {60 * row.speed:.0f} rpm"


def _ends(estimate: IntervalEstimate, factor: float = 1.0) -> str:
    value, low, high = (factor * x for x in (estimate.value, estimate.low, estimate.high))
    return f"{value:.4g} ({low:.4g} to {high:.4g})"


def judgement_entry(verdict: RunUpJudgement, quantity: str) -> dict[str, Any]:
    """As `judgement.json` has it: SI units, speeds in Hz, intervals of 95 %."""
    slow_roll = None
    if verdict.slow_roll is not None:
        vectors = zip(verdict.probes, verdict.slow_roll.tolist(), strict=True)
        slow_roll = {label: {"re": vector.real, "im": vector.imag} for label, vector in vectors}
    return {
        "schema": "labpipe/run-up-judgement/1",
        "quantity": quantity,
        "accepted": verdict.accepted,
        "not_run": verdict.not_run,
        "speed_range_hz": verdict.speed_range,
        "slow_roll": slow_roll,
        "critical_speeds": [asdict(peak) for peak in verdict.peaks],
        "sensitivities": [asdict(sensitivity) for sensitivity in verdict.sensitivities],
    }


def _run_conditions(load: str | None, unbalance: tuple[str, ...]) -> tuple[float, dict[str, complex]]:
    newtons = _value("--load", load, "N")
    if newtons is None or not unbalance:
        hint = "--load '3.66 N' --unbalance 'disc 1=50 g.mm at 0 deg'"
        raise ConfigError("--save-run-up needs --load and --unbalance", hint=hint)
    return newtons, _unbalances(unbalance)


def _unbalances(texts: tuple[str, ...]) -> dict[str, complex]:
    unbalances = {}
    for text in texts:
        plane, _, size = (part.strip() for part in text.partition("="))
        if plane in unbalances:
            raise ConfigError(f"--unbalance: '{plane}' is named twice", hint="give the sum of both")
        with locate_units(f"--unbalance {text}"):
            unbalances[plane] = parse_phasor(size, "kg.m")
    return unbalances


def _clearance(gap: str | None, limit: str | None) -> Clearance | None:
    length, share = _value("--gap", gap, "m"), _value("--limit", limit, "1")
    if length is None:
        if share is not None:
            raise ConfigError("--limit belongs to --gap", hint="leave it out")
        return None
    share = LIMIT if share is None else share
    if not (length > 0 and share > 0):
        raise ConfigError("--gap and --limit must be positive")
    return Clearance(length, share)


def _value(option: str, text: str | None, unit: str) -> float | None:
    if text is None:
        return None
    with locate_units(option):
        return parse_value(text, unit)
