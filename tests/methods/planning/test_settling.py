"""A planned test waits for motion to die away, from the plan to the recorded file; what has not died away is
named.

The rig is the test's own: a seismic mass of 2 kg on 40 kN/m with .3 % of damping, whose free motion decays by
exp(-.85) in a period of 2 s. Its motion from rest is exact: the steady one of all lines less the free one
that begins with it.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pytest
import yaml

from labpipe.methods.planning.plan_file import read_plan
from labpipe.methods.planning.records import Plan
from tests.conftest import Command

STIFFNESS, MASS, ZETA = 40e3, 2.0, 0.003
DAMPING = 2 * ZETA * np.sqrt(STIFFNESS * MASS)
PLAN = {
    "model": "sdof",
    "mass": f"{MASS} kg",
    "expected": {"k": f"{STIFFNESS} N/m", "c": f"{DAMPING} N.s/m"},
    "noise": {"force": "5 mN", "displacement": "0.2 um"},
    "sample_rate": "250 Hz",
    "band": "15-30 Hz",
    "period": "2 s",
    "force_limit": "2 N",
    "duration": "40 s",
}


def from_rest(
    plan: Plan,
    folder: Path,
    seed: int,
    stiffness: float = STIFFNESS,
    damping: float = DAMPING,
    gains: tuple[float, float] = (0.0, 0.0),
) -> None:
    """recordings/x.csv: the plan's signal as sensors see it on the rig, from rest, noise added; *gains* of
    force and motion that are off by so much.
    """
    (test,) = plan.tests
    applied = pc.read_csv(folder / test.files[0])["f [N]"].to_numpy()
    t = np.arange(applied.size) / plan.sample_rate
    w = 2 * np.pi * np.array(test.frequency)
    moved = (
        np.array(test.amplitude[0])
        * np.exp(1j * np.array(test.phase[0]))
        / (stiffness + 1j * w * damping - MASS * w**2)
    )
    steady = sum((x * np.exp(1j * v * t)).real for x, v in zip(moved, w, strict=True))
    decay = damping / (2 * MASS)
    damped = np.sqrt(stiffness / MASS - decay**2)
    begin, speed = moved.sum().real, (1j * w * moved).sum().real
    free = np.exp(-decay * t) * (
        begin * np.cos(damped * t) + (speed + decay * begin) / damped * np.sin(damped * t)
    )
    rng = np.random.default_rng(seed)
    columns = {
        "f [N]": (1 + gains[0]) * (applied + 5e-3 * rng.normal(size=t.size)),
        "x [m]": (1 + gains[1]) * (steady - free + 0.2e-6 * rng.normal(size=t.size)),
    }
    (folder / "recordings").mkdir(exist_ok=True)
    pc.write_csv(pa.table(columns), folder / "recordings" / f"{test.name}.csv")


def _carried_out(
    labpipe: Command, folder: Path, entries: dict[str, object], seeds: int
) -> tuple[Plan, list[dict[str, object]], list[str]]:
    """The plan, a fit of every seed, and the words of every run."""
    (folder / "plan.yaml").write_text(
        yaml.safe_dump({"title": "Seismic mass", "plan": entries}), encoding="utf-8"
    )
    ended = labpipe("plan", folder / "plan.yaml", "-o", folder / "planned")
    assert ended.code == 0, ended.err
    plan = read_plan(folder / "planned" / "plan.json")
    fits, words = [], []
    for seed in range(seeds):
        from_rest(plan, folder / "planned", seed)
        ended = labpipe("run", folder / "planned" / "pipeline.yaml", "-o", folder / f"out{seed}")
        assert ended.code == 0, ended.err
        fits += json.loads((folder / f"out{seed}" / "identification.json").read_text("utf-8"))["fits"]
        words.append(ended.out + ended.err)
    return plan, fits, words


@pytest.mark.long
def test_a_plan_waits_until_motion_has_died_away(labpipe: Command, tmp_path: Path) -> None:
    plan, fits, words = _carried_out(labpipe, tmp_path, PLAN, 4)
    assert plan.tests[0].skip > 5
    assert any("that are skipped" in note for note in plan.notes)
    error = next(c.error_weighted * c.scale for c in plan.coefficients if c.name == "c")
    found = np.array([p["value"] for fit in fits for p in fit["parameters"] if p["name"] == "c"])
    assert np.all(np.abs(found - DAMPING) < 4 * error)
    assert abs(np.mean(found) - DAMPING) < 3 * error / np.sqrt(found.size)
    assert not any("has not died away" in said or "raise the force" in said for said in words)


@pytest.mark.long
def test_what_a_period_too_few_costs_is_said_before_and_found_after(labpipe: Command, tmp_path: Path) -> None:
    plan, (fit,), (words,) = _carried_out(labpipe, tmp_path, {**PLAN, "skip": 1}, 1)
    assert plan.tests[0].skip == 1
    (said,) = [note for note in plan.notes if "has not died away" in note]
    c = next(p for p in fit["parameters"] if p["name"] == "c")
    expected = next(c for c in plan.coefficients if c.name == "c")
    off = abs(c["value"] - DAMPING) / DAMPING
    # The plan's first-order shift is of the size that comes: weights by the scatter of the periods, which the
    # motion enlarges, change it.
    shift = float(said.split("by about ")[1].split(" %")[0]) / 100
    assert shift > 10 * expected.error
    assert shift / 5 < off < shift * 5
    # exp(-.848 n) of the free motion is left after n periods: to a tenth of a standard error it takes ln(10
    # shift / error) / .848 of them.
    times, enough = (
        float(said.split("%, ")[1].split(" times")[0]),
        int(said.split("`skip: ")[2].split("`")[0]),
    )
    assert enough == pytest.approx(1 + np.log(10 * times) / 0.848, abs=1.5)
    assert "has not died away after `skip: 1`" in words and "by a factor of 0.43 per period" in words
    assert "raise the force" not in words


@pytest.mark.parametrize("skip", [2, 5])
def test_the_shift_is_that_of_a_fit_of_what_is_left(skip: int) -> None:
    """Against an independent calculation: least squares, weighted as the noise is, on the average of sampled
    periods with free motion.
    """
    from labpipe.methods.planning.campaigns import Multisines, PlannedRig, RigLimits, equal_times, settling
    from labpipe.methods.planning.model import SensorDensities, planned_model

    noise, spacing, periods, rate = SensorDensities(1e-3, 2e-7), 0.5, 6, 2000.0
    rig = PlannedRig(
        planned_model("sdof", {"k": STIFFNESS, "c": DAMPING}, MASS),
        noise,
        RigLimits(1.0),
        np.ones((1, 1), complex),
        ("x",),
        spacing,
    )
    lines = np.arange(30, 61)
    forces = np.exp(1j * np.random.default_rng(3).uniform(0, 2 * np.pi, lines.size))[:, None]
    campaign = equal_times(rig, [Multisines("x", lines, forces, np.arange(lines.size))])
    motion = settling(rig, campaign, (periods,))
    assert motion is not None
    w = 2 * np.pi * spacing * lines
    stiffness = STIFFNESS + 1j * w * DAMPING - MASS * w**2
    moved = forces[:, 0] / stiffness
    t = (np.arange(round(periods * rate / spacing)) / rate) + skip / spacing
    decay = ZETA * np.sqrt(STIFFNESS / MASS)
    damped = np.sqrt(STIFFNESS / MASS - decay**2)
    begin, speed = moved.sum().real, (1j * w * moved).sum().real
    free = -np.exp(-decay * t) * (
        begin * np.cos(damped * t) + (speed + decay * begin) / damped * np.sin(damped * t)
    )
    left = np.array([2 * np.mean(free * np.exp(-1j * v * t)) for v in w])
    weight = 1 / np.sqrt(noise.force**2 + noise.displacement**2 * np.abs(stiffness) ** 2)
    design = np.stack([moved * STIFFNESS, 1j * w * moved * DAMPING], axis=1) * weight[:, None]
    rest = -stiffness * left * weight
    solved, *_ = np.linalg.lstsq(
        np.vstack([design.real, design.imag]), np.concatenate([rest.real, rest.imag]), rcond=None
    )
    # Rectangles instead of the integral: 2 % at 2 kHz.
    assert motion.shifts(skip) == pytest.approx(solved, rel=0.02, abs=0.01 * np.abs(solved).max())
