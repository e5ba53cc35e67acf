"""orders: a recording with its shaft speed -> amplitude and phase of an order over the run, as table and figures."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts.writing import OutputFolder, output_file
from labpipe.errors import ConfigError
from labpipe.formats.run_up_csv import write_run_up_csv
from labpipe.records.rig import Rig
from labpipe.spectra.orders import OrderTrack, plane_track, track_order
from labpipe.spectra.run_up_orders import run_up_of
from labpipe.spectra.settings import ShaftLines
from labpipe.stages.ingest import ingest, is_recording

Column = tuple[str, FloatArray]


@dataclass(frozen=True)
class Clearance:
    """The radial *gap* of the bearings [m], and the *limit* of a motion as a share of it."""

    gap: float
    limit: float


@dataclass(frozen=True)
class TrackedRun:
    """An order over a run, and in forward and backward circles for every plane with two responses in known directions.

    *quantity*: what the responses are, empty where they differ; *clearance*: gap that orbits are compared with, if any.
    """

    name: str
    track: OrderTrack
    circles: tuple[OrderTrack, ...]
    quantity: str
    clearance: Clearance | None = None

    @property
    def speeds(self) -> FloatArray:
        """Speed of every stretch (n_stretch,) [rpm]."""
        return 60 * self.track.speed


def track_run(
    source: Path,
    rig: Rig | None,
    lines: ShaftLines,
    order: float,
    revolutions: int,
    output: OutputFolder,
    clearance: Clearance | None = None,
) -> TrackedRun:
    """The order of a raw file (with its rig) or of a calibrated recording; ConfigError for a gap where no plane moves in it."""
    if rig is None and not is_recording(source):
        raise ConfigError("a raw file needs its rig file", where=str(source), hint="add -r RIG")
    # A calibrated recording is opened as it is, whatever the rig.
    recording = ingest(source, rig or Rig("", ()), output, source.stem, Path.cwd())
    track = track_order(recording, lines, order=order, revolutions=revolutions)
    circles = tuple(plane_track(track, plane) for plane in track.planes)
    quantities = {channel.quantity for channel in recording.channels if channel.role == "output"}
    quantity = quantities.pop() if len(quantities) == 1 else ""
    if clearance is not None and (quantity != "displacement" or not circles):
        hint = "two displacements in known directions (dof: x and y, or front.x and front.y) are needed"
        raise ConfigError("--gap: no orbit to hold against the gap", where=str(source), hint=hint)
    return TrackedRun(recording.name, track, circles, quantity, clearance)


def write_tracked(run: TrackedRun, output: OutputFolder) -> list[str]:
    """orders.csv and the figures; their names."""
    from labpipe.document.charts import svg_file
    from labpipe.report.order_figures import gap_figure, orbit_series_figure, order_figure

    _write_table(run, output.write_path("orders.csv"))
    figures = {"orders.svg": order_figure(run.name, run.track, run.circles, run.quantity)}
    for circles in run.circles:
        (plane,) = circles.planes
        figures[f"orbits{f'-{plane.name}' if plane.name else ''}.svg"] = orbit_series_figure(run.name, circles, run.quantity)
    if run.clearance is not None:
        figures["gap.svg"] = gap_figure(run.name, run.track, run.circles, run.clearance.gap, run.clearance.limit)
    for name, figure in figures.items():
        output.write_path(name).write_text(svg_file(figure), encoding="utf-8")
    return ["orders.csv", *figures]


def save_run_up(run: TrackedRun, path: Path, load: float, unbalance: Mapping[str, complex]) -> int:
    """The order 1 of every plane as a run-up table, complete or absent; the number of its speeds. ConfigError for another order."""
    if run.track.order != 1:
        raise ConfigError(f"a run-up is of order 1, not {run.track.order:g}", hint="leave --order out")
    table = run_up_of(run.track, run.name, load, unbalance)
    with output_file(path) as target:
        write_run_up_csv(target, table)
    return table.n_speed


def order_lines(run: TrackedRun, unit: str, shown: Callable[[float], float]) -> list[str]:
    """Terminal lines on every response, circle and plane; *shown*: from an SI value to the display *unit*."""
    rows = []
    for track in (run.track, *run.circles):
        for number, port in enumerate(track.ports):
            size = np.abs(track.amplitude[:, number])
            peak = int(np.argmax(size))
            whole = "" if track is not run.track else f"; whole motion {shown(float(np.max(track.overall[:, number]))):.4g}"
            rows.append(f"{port.label:<8} largest {shown(float(size[peak])):.4g} {unit} 0-to-peak at {run.speeds[peak]:.4g} rpm{whole}")
    return [*rows, *_against_gap(run, unit, shown)]


def _against_gap(run: TrackedRun, unit: str, shown: Callable[[float], float]) -> list[str]:
    """The largest orbit of every plane as share of the gap, and from which speed it lies beyond the limit."""
    if run.clearance is None:
        return []
    rows = []
    for number, plane in enumerate(run.track.planes):
        orbit = run.track.orbit[:, number]
        peak, beyond = int(np.argmax(orbit)), np.flatnonzero(orbit > run.clearance.limit * run.clearance.gap)
        share = 100 * orbit[peak] / run.clearance.gap
        limit = f"{100 * run.clearance.limit:g} %"
        verdict = f"beyond {limit} from {run.speeds[beyond[0]]:.4g} rpm on" if beyond.size else f"within {limit} at all speeds"
        size = f"{shown(float(orbit[peak])):.4g} {unit} = {share:.3g} % of the gap"
        rows.append(f"{plane.name:<8} largest orbit {size} at {run.speeds[peak]:.4g} rpm: {verdict}")
    return rows


def _write_table(run: TrackedRun, path: Path) -> None:
    """A row for every stretch: amplitudes 0-to-peak [SI], phases [deg] against the tacho's pulse, standard deviations, whole motion."""
    columns = [("time_s", run.track.time), ("speed_hz", run.track.speed)]
    for track in (run.track, *run.circles):
        columns += _order_columns(track)
    columns += [(f"{port.label}:overall", run.track.overall[:, number]) for number, port in enumerate(run.track.ports)]
    for circles in run.circles:
        columns += _orbit_columns(circles, run.clearance)
    with path.open("w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow([title for title, _ in columns])
        for row in zip(*(values for _, values in columns), strict=True):
            table.writerow([f"{value:.9g}" for value in row])


def _order_columns(track: OrderTrack) -> list[Column]:
    columns: list[Column] = []
    for number, port in enumerate(track.ports):
        x = track.amplitude[:, number]
        columns.append((f"{port.label}:amplitude", np.abs(x)))
        columns.append((f"{port.label}:phase_deg", np.degrees(np.angle(x))))
        columns.append((f"{port.label}:std", np.sqrt(track.variance[:, number])))
    return columns


def _orbit_columns(circles: OrderTrack, clearance: Clearance | None) -> list[Column]:
    """Larger half axis of the order's ellipse |f| + |b|; largest distance of the whole motion from its middle, also per gap."""
    (plane,) = circles.planes
    whole = circles.orbit[:, 0]
    columns = [(plane.labelled("half_axis"), np.abs(circles.amplitude).sum(axis=1)), (plane.labelled("orbit"), whole)]
    return columns if clearance is None else [*columns, (plane.labelled("orbit_per_gap"), whole / clearance.gap)]
