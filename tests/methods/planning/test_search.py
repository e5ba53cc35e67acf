"""Plans at the limits of a rig against flat multisines of equal peak and time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.planning.campaigns import (
    INTERLEAVED,
    ONE_BY_ONE,
    SCHEMES,
    TOGETHER,
    PlannedRig,
    RigLimits,
    crest_factors,
    enlarge_to_limits,
)
from labpipe.methods.planning.model import relative_errors
from labpipe.methods.planning.search import BOTH_LIMITS, LEAST_CREST, Wanted, best, flat, reference
from labpipe.raw_files.excitation import peaks
from tests.methods.planning.rigs import RIGS

FORCE = {"pedestal": 5.0, "rotor": 20.0, "seal": 2000.0}


def planned_rig(name: str, displacement: float | None = None) -> tuple[PlannedRig, np.ndarray, Wanted]:
    model, noise, frequency = RIGS[name]()
    spacing = float(frequency[1] - frequency[0])
    limits = RigLimits(FORCE[name], displacement)
    rig = PlannedRig(
        model, noise, limits, np.eye(model.n_dof, dtype=complex), ("x", "y")[: model.n_dof], spacing
    )
    return rig, np.round(frequency / spacing).astype(int), Wanted("minimax", np.ones(len(model.names)))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_both_shakers_at_once_tell_what_their_powers_tell(scheme: str) -> None:
    # Between lines the seal changes little, so that the sum over a pair is that of a diagonal spectrum.
    rig, lines, _ = planned_rig("seal")
    rig, lines = replace(rig, spacing=rig.spacing / 8), np.arange(80, 808)
    power = np.ones((lines.size, 2)) * [3.0, 5.0]
    tests = SCHEMES[scheme](lines, power, rig.shakers)
    whole = sum(rig.rate(test) for test in tests)
    separate = sum(rig.rate(test) for test in SCHEMES[ONE_BY_ONE](lines, power, rig.shakers))
    np.testing.assert_allclose(relative_errors(whole), relative_errors(separate), rtol=0.01)
    assert len(tests) == (2 if scheme == ONE_BY_ONE else 1)


def test_signals_are_as_large_as_the_limits_allow() -> None:
    rig, lines, _ = planned_rig("rotor", 20e-6)
    (test,) = SCHEMES[TOGETHER](lines, np.ones((lines.size, 2)), rig.shakers)
    large = enlarge_to_limits(rig, test)
    over = peaks(large.lines, rig.amplitudes_over_limits(large).sum(axis=1))
    assert over.max() == pytest.approx(1.0, rel=1e-9)
    assert np.all(crest_factors(large) >= np.sqrt(2))


@pytest.mark.long
def test_a_floor_keeps_every_line_excited() -> None:
    rig, lines, wanted = planned_rig("pedestal")
    found = best(rig, lines, wanted, (ONE_BY_ONE,))
    (test,) = found.campaign.tests
    assert np.array_equal(test.lines, lines)
    assert found.certificate is not None and found.certificate.efficiency >= 0.999
    assert reference(rig, lines, wanted).certificate.efficiency >= 0.999


@pytest.mark.long
def test_crest_factor_out_of_reach() -> None:
    rig, lines, wanted = planned_rig("pedestal")
    narrow = PlannedRig(
        rig.model, rig.noise, RigLimits(5.0, None, 1.4143), rig.directions, rig.shakers, rig.spacing
    )
    with pytest.raises(ConfigError, match="no design has a crest factor of"):
        best(narrow, lines[::5], wanted, (ONE_BY_ONE,))


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "displacement", "phases", "least"),
    [
        ("pedestal", 40e-6, LEAST_CREST, 2.0),
        ("pedestal", None, BOTH_LIMITS, 6.0),
        ("seal", None, BOTH_LIMITS, 1.6),
    ],
)
def test_gain_over_a_flat_multisine_of_equal_peak_and_time(
    name: str, displacement: float | None, phases: str, least: float
) -> None:
    # Flat: x, then y, equal times, phases of least crest. With the displacement limited, phases for both
    # limits are most of the gain.
    rig, lines, wanted = planned_rig(name, displacement)
    schemes = (ONE_BY_ONE,) if rig.model.n_dof == 1 else (INTERLEAVED,)
    found = best(rig, lines, wanted, schemes)
    gain = flat(rig, lines, ONE_BY_ONE, phases).errors(1.0).max() / found.campaign.errors(1.0).max()
    assert gain >= least
