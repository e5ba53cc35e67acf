"""What evaluates a planned excitation: the rig file, unless the plan names one, and the pipeline with the planned lines."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from labpipe.errors import ConfigError
from labpipe.marked_yaml import load_marked
from labpipe.planner.settings import PlanSettings
from labpipe.records.plan import PlannedTest
from labpipe.records.recording import Channel
from labpipe.records.rig import Rig
from labpipe.records.uncertain import SHAPES, Uncertain, split_doubt

RIG, PIPELINE = "rig.yaml", "pipeline.yaml"
FIT = "planned"
# What evaluates spectra of all channels.
OF_SPECTRA = "dynamic-stiffness"
SI_UNITS = {"force": "N", "displacement": "m", "acceleration": "m/s^2"}


@dataclass(frozen=True)
class Evaluation:
    """Settings of the plan, its title and tests, whether masses are among the coefficients, and the rig file that it names, if any."""

    settings: PlanSettings
    title: str
    tests: tuple[PlannedTest, ...]
    with_masses: bool
    rig_path: Path | None = None

    @property
    def shakers(self) -> list[str]:
        """Every shaker that runs in a test."""
        return list(dict.fromkeys(shaker for test in self.tests for shaker in test.shakers))

    @property
    def at_once(self) -> bool:
        """Whether shakers run at once."""
        return any(len(test.shakers) > 1 for test in self.tests)

    @property
    def side_by_side(self) -> bool:
        """Whether the test is evaluated from spectra of all channels: a stator, or shakers that run at once."""
        return self.settings.kind.floating or self.at_once


def check_rig(rig: Rig, settings: PlanSettings, shakers: Sequence[str]) -> None:
    """ConfigError unless the rig has what the model needs: a force for every shaker, or one that is moved, and every response once."""
    if rig.derived:
        raise ConfigError("sums of channels are not planned with", hint="a rig file with what is recorded", field="rig")
    axes = settings.kind.axes
    needed = [("displacement", axis) for axis in axes]
    needed += [("acceleration", axis) for axis in axes] if settings.kind.floating else []
    channels = [channel.channel for channel in rig.channels if channel.channel.role != "reference"]
    for quantity, axis in needed:
        having = [channel for channel in channels if channel.quantity == quantity and channel.role == "output"]
        if not any(len(axes) == 1 or channel.dof == axis for channel in having):
            raise ConfigError(f"the rig has no {quantity} in {axis}", hint="a channel with `dof`", field="rig")
    wrong = [channel for channel in channels if channel.role == "output" and channel.quantity not in {quantity for quantity, _ in needed}]
    if wrong:
        raise ConfigError(
            f"{wrong[0].name} is no response that this model takes", hint="role: reference, or a rig file without it", field="rig"
        )
    forces = [channel for channel in channels if channel.role == "input"]
    if not forces or (len(forces) > 1 and {force.dof for force in forces} != set(shakers)):
        raise ConfigError(
            f"the rig's forces ({', '.join(force.dof for force in forces)}) are not those of the shakers ({', '.join(shakers)})",
            hint="one force that is moved, or one for every shaker",
            field="rig",
        )


def forces_of(rig: Rig) -> list[Channel]:
    """The forces of a rig."""
    return [channel.channel for channel in rig.channels if channel.channel.role == "input"]


def rig_entries(evaluation: Evaluation) -> dict[str, Any]:
    """The rig file where the plan names none: a channel for every signal, its column of the same name with its unit."""
    shakers, settings = evaluation.shakers, evaluation.settings
    if evaluation.side_by_side:
        forces = {f"f_{number}": _channel(f"f_{number}", "force", shaker) for number, shaker in enumerate(shakers, 1)}
    else:
        forces = {"f": _channel("f", "force", shakers[0])}
    axes = settings.kind.axes
    motions = {axis: _channel(axis, "displacement", axis) for axis in axes}
    moved = {f"a_{axis}": _channel(f"a_{axis}", "acceleration", axis) for axis in axes} if settings.kind.floating else {}
    return {"name": evaluation.title, "sample_rate": f"{settings.sample_rate!r} Hz", "channels": {**forces, **motions, **moved}}


def _channel(name: str, quantity: str, dof: str) -> dict[str, str]:
    role, unit = "input" if quantity == "force" else "output", SI_UNITS[quantity]
    return {"column": f"{name} [{unit}]", "quantity": quantity, "unit": unit, "role": role, "dof": dof}


def pipeline_entries(evaluation: Evaluation, folder: Path) -> dict[str, Any]:
    """The pipeline in *folder* that evaluates the test, the planned lines passed to it; recordings are looked for in recordings/."""
    settings, tests = evaluation.settings, evaluation.tests
    recordings: list[Any] = [f"recordings/{test.name}.csv" for test in tests]
    moved = _moved_force(evaluation)
    if moved:
        recordings = [
            {"file": name, "channels": {moved[0]: {"dof": f"{test.shakers[0]}{moved[1]}"}}}
            for name, test in zip(recordings, tests, strict=True)
        ]
    lines = sorted({frequency for test in tests for frequency in test.frequency})
    spacing = 1 / settings.period
    frf: dict[str, Any] = {
        "excitation": "periodic",
        "period": f"{settings.period!r} s",
        "skip": min(test.skip for test in tests),
        "band": f"{lines[0] - spacing / 4!r}-{lines[-1] + spacing / 4!r} Hz",
    }
    gaps = list(_gaps(lines, spacing))
    if gaps:
        frf["exclude"] = gaps
    if evaluation.side_by_side:
        frf["result"] = "spectra"
    rig = RIG if evaluation.rig_path is None else os.path.relpath(evaluation.rig_path, folder)
    return {"title": evaluation.title, "rig": rig, "recordings": recordings, "frf": frf, "identify": {FIT: _fit(evaluation)}}


def _moved_force(evaluation: Evaluation) -> tuple[str, str] | None:
    """Name of the one force that is moved from test to test, and the doubt of its direction as it is written; None where none is."""
    settings = evaluation.settings
    if evaluation.side_by_side:
        return None
    if evaluation.rig_path is None:
        return ("f", "") if len(evaluation.tests) > 1 else None
    if len(settings.kind.axes) == 1:
        return None
    assert settings.sensors is not None
    forces = forces_of(settings.sensors)
    if len(forces) > 1:
        return None
    written = load_marked(evaluation.rig_path).content["channels"].content[forces[0].name].content.get("dof")
    doubt = "" if written is None else split_doubt(written.text)[1]
    return forces[0].name, f" +- {doubt}" if doubt else ""


def _gaps(lines: Sequence[float], spacing: float) -> list[str]:
    """Bands between excited lines without any."""
    return [f"{low + spacing / 4!r}-{high - spacing / 4!r} Hz" for low, high in pairwise(lines) if high - low > 1.5 * spacing]


def _fit(evaluation: Evaluation) -> dict[str, Any]:
    settings = evaluation.settings
    number = dict(settings.doubts).get("mass") or (None if settings.mass is None else Uncertain(settings.mass))
    if not evaluation.side_by_side:
        mass: dict[str, Any] = {"mass": "estimate"} if number is None else {"mass": uncertain_text(number, "kg")}
        return {"model": settings.model, **mass}
    entries = {"form": "kcm" if evaluation.with_masses else "kc"}
    # Displacements of a rotor are absolute; those of a floating stator are against its shaft.
    if not settings.kind.floating:
        entries["motion"] = "absolute"
    if number is not None:
        entries["stator_mass"] = uncertain_text(number, "kg")
    return {"model": OF_SPECTRA, "dynamic_stiffness": entries}


def uncertain_text(number: Uncertain, unit: str) -> str:
    """A number as people write it, with its doubt: 0.79 kg +- 0.005 kg (rectangular, source=scale)."""
    if not number.std_error:
        return f"{number.value!r} {unit}"
    qualities = [number.shape] if number.shape != "normal" else []
    qualities += [f"dof={number.dof:g}"] if number.dof else []
    qualities += [f"source={number.source}"] if number.source else []
    behind = f" ({', '.join(qualities)})" if qualities else ""
    return f"{number.value!r} {unit} +- {number.std_error * SHAPES[number.shape]!r} {unit}{behind}"
