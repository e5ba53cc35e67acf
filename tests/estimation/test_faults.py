"""Faults that a good goodness of fit hides, on a rig of four dofs: how often each is named, and how often
sound runs are left alone.

White force on all four dofs for 200 s (100 and 50 s where the motion is integrated), blocks of 4 s, 5-50 Hz;
K is known to .05 % (.1 %), so that every fault below moves it by far more than three standard errors.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from labpipe.estimation.fitting import identify
from labpipe.estimation.levels import with_level_findings
from labpipe.estimation.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings
from tests.methods.run_ups.four_dof_rig import MASS, RATE, FourDofRig, recordings, true_stiffness

FRF = FrfSettings(excitation="random", block=4.0, band=(5.0, 50.0))
# Runs side by side: the integration in time takes about as long for ten as for one.
TOGETHER = 60

FIT = FitSettings("mdof", mass=tuple(MASS), name="four")


def fits(seeds: range, **fault: object) -> Iterator[Fit]:
    for first in range(seeds.start, seeds.stop, TOGETHER):
        for record in recordings(
            FourDofRig(noise=1e-4, **fault), range(first, min(first + TOGETHER, seeds.stop))
        ):
            yield from identify(measure([record], FRF), FIT)


def counted(seeds: range, **fault: object) -> tuple[Counter[str], list[str], float]:
    """How many runs carry each code, what drift looks like in each, and the rms error of K in standard
    errors.
    """
    codes: Counter[str] = Counter()
    shapes, errors = [], []
    for fit in fits(seeds, **fault):
        codes.update({finding.code for finding in fit.findings})
        shapes += [
            finding.message.split("looks like ")[-1] for finding in fit.findings if finding.code == "drift"
        ]
        stiffness = [fit.parameter(f"k_{i}_{j}") for i in range(1, 5) for j in range(1, 5)]
        errors.append(
            [
                (p.value - k) / p.std_error
                for p, k in zip(stiffness, true_stiffness().reshape(-1), strict=True)
            ]
        )
    return codes, shapes, float(np.sqrt(np.max(np.mean(np.square(errors), axis=0))))


def test_the_changing_rig_without_a_change_is_the_exact_one() -> None:
    """Integration against the closed form: equal but for the swing from rest, which has died away after 5
    s.
    """
    (exact,) = recordings(FourDofRig(length=20.0, noise=0.0), range(1))
    (integrated,) = recordings(FourDofRig(length=20.0, noise=0.0, stiffness=1e-15), range(1))
    motion = exact.samples[round(5 * RATE) :, 4:]
    difference = integrated.samples[round(5 * RATE) :, 4:] - motion
    assert np.sqrt(np.mean(difference**2)) < 1e-3 * np.sqrt(np.mean(motion**2))


@pytest.mark.long
@pytest.mark.parametrize(
    ("fault", "looks_like", "runs"),
    [
        ({"gain": 0.03}, "the gain of x1", 2),
        pytest.param({"stiffness": -0.06, "length": 100.0}, "all stiffness", 3, marks=pytest.mark.long),
    ],
    ids=["gain", "softer"],
)
def test_drift_is_named(fault: dict[str, float], looks_like: str, runs: int) -> None:
    """All of three: a rate of 40 % passes once in 16.

    The rate of the gain is among those of test_warning_rates.
    """
    codes, shapes, error = counted(range(runs), **fault)
    assert error > 3
    assert codes["drift"] >= 0.9 * runs
    assert sum(shape.startswith(looks_like) for shape in shapes) >= 0.9 * runs
    # Half of the whole drift lies between the means of the halves.
    amount = next(iter(fault.values()))
    assert np.mean([float(shape.split(" by ")[1].split()[0]) for shape in shapes]) == pytest.approx(
        50 * amount, rel=0.1
    )


@pytest.mark.long
def test_cubic_springs_are_named_between_two_levels() -> None:
    """Springs to ground with 5e8 N/m^3: about 3 % more stiffness at 10 N than at 5 N.

    One level alone looks like noise. Linear springs are among the rates of test_warning_rates.
    """
    conditions = {"quiet": {"level": "5 N"}, "loud": {"level": "10 N"}}
    # All of three: a rate of 40 % passes once in 16.
    runs = 3
    quiet, loud = (fits(range(runs), cubic=5e8, force=force, length=50.0) for force in (5.0, 10.0))
    named = [
        _level_finding(replace(low, test="quiet"), replace(high, test="loud"), conditions)
        for low, high in zip(quiet, loud, strict=True)
    ]
    assert len([message for message in named if message]) >= 0.9 * runs
    assert np.mean(
        [float(message.split("stiffness by ")[1].split()[0]) for message in named if message]
    ) == pytest.approx(3, abs=0.5)


def _level_finding(low: Fit, high: Fit, conditions: dict[str, dict[str, str]]) -> str:
    messages = [
        f.message
        for fit in with_level_findings([low, high], conditions)
        for f in fit.findings
        if f.code == "amplitude"
    ]
    return messages[0] if messages else ""
