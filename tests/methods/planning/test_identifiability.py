"""What an excitation determines, from counting equations; and that every remedy named is one, on data."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.methods.planning.model import (
    PlannedModel,
    SensorDensities,
    planned_model,
    relative_errors,
    sensitivities,
    vector_information,
)
from labpipe.methods.planning.uncertainty import ForceVectors, Identifiability, identifiability
from tests.methods.planning.rigs import PEDESTAL, ROTOR, pedestal, rig_rotor, seal

AXES = np.eye(2, dtype=complex)
OBLIQUE = np.array([[1.0, 1.0]], complex) / np.sqrt(2)
SYMMETRIC = {**ROTOR, "k_yy": 180e3, "c_yy": 120.0, "k_xy": 0.0, "k_yx": 0.0, "c_xy": 0.0, "c_yx": 0.0}


def _found(model: PlannedModel, lines: list[float] | np.ndarray, directions: np.ndarray) -> Identifiability:
    noise = {"sdof": pedestal, "rotor-2dof": rig_rotor, "dynamic-stiffness": seal}[model.kind]()[1]
    frequency = np.repeat(np.asarray(lines, float), len(directions))
    excitation = ForceVectors(frequency, np.tile(directions, (len(lines), 1)))
    return identifiability(model, noise, excitation)


def test_one_line_gives_two_numbers_of_a_pedestal() -> None:
    model = planned_model("sdof", {**PEDESTAL, "m": 0.79})
    found = _found(model, [65.0], np.eye(1, dtype=complex))
    assert (found.rank, found.undetermined) == (2, ("k", "m"))
    assert found.words == "the excitation determines 2 of 3 coefficients; not told apart: k, m"
    assert found.remedies == ("a known mass", "another line")
    assert _found(model, [65.0, 65.5], np.eye(1, dtype=complex)).full
    assert _found(model.with_known_mass(), [65.0], np.eye(1, dtype=complex)).full


def test_eight_coefficients() -> None:
    model, _, lines = rig_rotor()
    one = _found(model, [60.0], AXES[:1])
    assert (one.rank, one.remedies) == (4, ("another line", "a second direction of force"))
    assert _found(model, [60.0], AXES).full
    assert _found(model, [60.0, 61.0], AXES[:1]).full
    # Without cross terms a force in x moves nothing in y: what answers to y is not told.
    uncoupled = {**ROTOR, "k_xy": 0.0, "k_yx": 0.0, "c_xy": 0.0, "c_yx": 0.0}
    straight = _found(planned_model("rotor-2dof", uncoupled, 0.92), lines, AXES[:1])
    assert (straight.rank, straight.undetermined) == (4, ("k_xy", "k_yy", "c_xy", "c_yy"))


def test_forces_at_45_degrees_on_a_symmetric_rig() -> None:
    _, _, lines = rig_rotor()
    found = _found(planned_model("rotor-2dof", SYMMETRIC, 0.92), lines, OBLIQUE)
    assert found.rank == 4
    assert found.remedies == ("a second direction of force",)
    assert found.remedy == "a second direction of force would determine all"


def test_twelve_coefficients() -> None:
    # a(jw) X + b(jw) Y = 0 has real quadratics a, b for any single direction of force: two of twelve are not
    # told, whatever the lines.
    model, _, lines = seal()
    for direction in (AXES[:1], AXES[1:], OBLIQUE, np.array([[0.6, -0.8]], complex)):
        assert _found(model, lines, direction).rank == 10
    one = _found(model, lines, OBLIQUE)
    assert one.remedies == ("a known mass", "a second direction of force")
    assert _found(model.with_known_mass(), lines, OBLIQUE).full
    assert _found(model, lines, AXES).full
    both = _found(model, [50.0], AXES)
    assert (both.rank, both.remedies) == (8, ("a known mass", "another line"))
    assert _found(model, [50.0, 51.0], AXES).full


@pytest.mark.parametrize("lines", [[50.0], [10.0, 20.0, 30.0]])
def test_a_vector_per_line_cannot_tell_more_than_its_equations(lines: list[float]) -> None:
    model, _, _ = seal()
    found = _found(model, lines, AXES[:1])
    # Two complex equations for every line.
    assert found.rank <= min(4 * len(lines), 10)


@pytest.mark.parametrize(("damping", "ratios"), [(120.0, (59, 20, 6.0)), (26.5, (13, 4.5, 1.6))])
def test_forces_at_45_degrees_on_a_rig_that_is_nearly_symmetric(
    damping: float, ratios: tuple[float, ...]
) -> None:
    """Largest error over that of x, then y at equal power, for 1, 3, 10 % of anisotropy: sqrt(1 + (4 zeta /
    a)^2), calculated apart.

    The two planes are told apart by how far their resonances lie from each other, in half-power widths: zeta
    is 15 and 3.3 %.
    """
    _, noise, lines = rig_rotor()
    force_alone = SensorDensities(force=noise.force)
    for anisotropy, expected in zip((0.01, 0.03, 0.1), ratios, strict=True):
        both = 1 + anisotropy
        values = {**SYMMETRIC, "k_yy": 180e3 * both, "c_xx": damping, "c_yy": damping * both}
        sensitivity = sensitivities(planned_model("rotor-2dof", values, 0.92), force_alone, 2 * np.pi * lines)
        spread = [np.tile(direction, (lines.size, 1)) for direction in AXES / np.sqrt(2)]
        apart = sum(vector_information(sensitivity, forces).sum(axis=0) for forces in spread)
        oblique = vector_information(sensitivity, np.tile(OBLIQUE[0], (lines.size, 1))).sum(axis=0)
        # Errors in units of the largest of their kind, so that terms expected as zero count alike.
        largest = np.array([value for value in (180e3 * both, damping * both) for _ in range(4)])
        scale = largest / planned_model("rotor-2dof", values, 0.92).scales
        found = (relative_errors(oblique) / scale).max() / (relative_errors(apart) / scale).max()
        assert found == pytest.approx(expected, rel=0.06)
        assert found == pytest.approx(
            np.hypot(1, 4 * damping / (2 * np.sqrt(180e3 * 0.92)) / anisotropy), rel=0.08
        )
