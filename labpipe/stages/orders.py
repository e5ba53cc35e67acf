"""orders: a recording with its shaft speed -> amplitude and phase of an order over the run, as table and figures."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import ConfigError, DataError
from labpipe.records.rig import Rig
from labpipe.spectra.orders import OrderTrack, directional_track, track_order
from labpipe.spectra.settings import ShaftLines
from labpipe.stages.ingest import ingest, is_recording


@dataclass(frozen=True)
class TrackedRun:
    """An order over a run, and in forward and backward circles where two responses stand in known directions.

    *quantity*: what the responses are, empty where they differ.
    """

    name: str
    track: OrderTrack
    circles: OrderTrack | None
    quantity: str


def track_run(source: Path, rig: Rig | None, lines: ShaftLines, order: float, revolutions: int, output: OutputFolder) -> TrackedRun:
    """The order of a raw file (with its rig) or of a calibrated recording."""
    if rig is None and not is_recording(source):
        raise ConfigError("a raw file needs its rig file", where=str(source), hint="add -r RIG")
    # A calibrated recording is opened as it is, whatever the rig.
    recording = ingest(source, rig or Rig("", ()), output, source.stem, Path.cwd())
    track = track_order(recording, lines, order=order, revolutions=revolutions)
    try:
        circles = directional_track(track)
    except DataError:
        circles = None
    quantities = {channel.quantity for channel in recording.channels if channel.role == "output"}
    return TrackedRun(recording.name, track, circles, quantities.pop() if len(quantities) == 1 else "")


def write_tracked(run: TrackedRun, output: OutputFolder) -> list[str]:
    """orders.csv and the figures; their names."""
    from labpipe.report.drawing import svg_text
    from labpipe.report.order_figures import orbit_series_figure, order_figure

    names = ["orders.csv", "orders.svg"]
    _write_table(run, output.write_path(names[0]))
    output.write_path(names[1]).write_text(svg_text(order_figure(run.name, run.track, run.circles, run.quantity).drawing), encoding="utf-8")
    if run.circles is not None:
        names.append("orbits.svg")
        output.write_path(names[2]).write_text(svg_text(orbit_series_figure(run.name, run.circles, run.quantity).drawing), encoding="utf-8")
    return names


def _write_table(run: TrackedRun, path: Path) -> None:
    """A row for every stretch: amplitudes 0-to-peak [SI], phases [deg] against the tacho's pulse, standard deviations."""
    tracks = [run.track] if run.circles is None else [run.track, run.circles]
    titles = [f"{port.label}:{part}" for track in tracks for port in track.ports for part in ("amplitude", "phase_deg", "std")]
    with path.open("w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(["time_s", "speed_hz", *titles])
        for row in range(run.track.time.size):
            cells = [
                f"{value:.9g}"
                for track in tracks
                for x, variance in zip(track.amplitude[row], track.variance[row], strict=True)
                for value in (abs(x), np.degrees(np.angle(x)), np.sqrt(variance))
            ]
            table.writerow([f"{run.track.time[row]:.9g}", f"{run.track.speed[row]:.9g}", *cells])
