"""A small laboratory on disk: a rig file, recordings of a mass on a spring, pipelines over them.

What a run leaves behind.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from labpipe.artefacts.writing import output_folder
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.run import Manner, run
from labpipe.records.identification import Identification

RIG = """name: Small rig
time: "t [s]"
channels:
  f: {column: "force [N]", quantity: force, unit: N, role: input, dof: y}
  y: {column: "y [um]", quantity: displacement, unit: um, role: output, dof: y}
mass: 0.79 kg
"""
PIPELINE = """title: Small
rig: rig.yaml
tests:
  - {name: soft, recordings: soft.csv, conditions: {preload: 100 N}}
  - {name: hard, recordings: hard.csv, conditions: {preload: 200 N}}
frf: {excitation: periodic, period: 1 s, skip: 0}
identify:
  direct: {model: sdof, input: f, output: y, band: 10-40 Hz}
  plain: {model: sdof, estimator: ls, input: f, output: y, band: 15-35 Hz}
accept: {direct.gof: '>= 0.9'}
report: {formats: []}
"""
ALONE = (
    PIPELINE.replace("tests:\n", "recordings: soft.csv\n")
    .replace("  - {name: soft, recordings: soft.csv, conditions: {preload: 100 N}}\n", "")
    .replace("  - {name: hard, recordings: hard.csv, conditions: {preload: 200 N}}\n", "")
)
STIFFNESS = {"soft": 18e3, "hard": 22e3}
DAMPING, MASS = 20.0, 0.79


def recording(stiffness: float, seed: int = 1) -> str:
    """Three periods of 1 s at 100 Hz: lines 1-45 Hz with Schroeder's phases, noise of 0.1 um; seed pinned."""
    rng = np.random.default_rng(seed)
    t = np.arange(300) / 100
    lines = np.arange(1, 46)
    phasors = np.exp(1j * (2 * np.pi * np.outer(t, lines) - np.pi * lines * (lines - 1) / 45))
    omega = 2 * np.pi * lines
    receptance = 1e6 / (stiffness - MASS * omega**2 + 1j * DAMPING * omega)
    force, y = phasors.real.sum(1), (phasors * receptance).real.sum(1) + 0.1 * rng.normal(size=t.size)
    rows = zip(t, force, y, strict=True)
    return "t [s],force [N],y [um]\n" + "".join(f"{row[0]:.6g},{row[1]:.9g},{row[2]:.9g}\n" for row in rows)


def laboratory(folder: Path, pipeline: str = PIPELINE) -> Path:
    """The files of the laboratory; the pipeline's path."""
    (folder / "rig.yaml").write_text(RIG)
    for name, stiffness in STIFFNESS.items():
        (folder / f"{name}.csv").write_text(recording(stiffness))
    (folder / "pipeline.yaml").write_text(pipeline)
    return folder / "pipeline.yaml"


def done(
    pipeline: Path, out: Path, overrides: Iterable[str] = (), manner: Manner | None = None
) -> Identification:
    """Run the pipeline into a folder, as the command does."""
    with output_folder(out) as output:
        return run(load_pipeline(pipeline, overrides), output, manner or Manner())


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


class Witness:
    """What was made again since a moment: files are replaced when they are made, so their number on the disk
    changes.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._before = self._numbers()

    def _numbers(self) -> dict[str, int]:
        return {
            path.relative_to(self._folder).as_posix(): path.stat().st_ino
            for path in self._folder.rglob("*")
            if path.is_file()
        }

    def made(self) -> set[str]:
        """The files that are new or were made again."""
        return {name for name, number in self._numbers().items() if self._before.get(name) != number}
