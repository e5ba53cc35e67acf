"""A pinned rotor condensed to its bearing: against dense algebra, stiff springs for pins, differences, and
time integration.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from labpipe.errors import ConfigError
from labpipe.methods.rotor.pinned import condensed_rotor, inverse, pinned_rotor, unbalance_forces
from labpipe.methods.rotor.response import dynamic_stiffness, unbalance_response
from labpipe.methods.rotor.shaft import NodeSupport, Rotor, RotorMatrices, ShaftElement
from tests.methods.rotor.falah_cases import PINNED, ROTOR, RPM, UNBALANCE, film

SPEED = np.arange(400.0, 2800, 100) * RPM
FORCES = unbalance_forces(PINNED, UNBALANCE, SPEED)
CONDENSED = condensed_rotor(PINNED, 3, SPEED, FORCES, (2, 3, 4))


def on_bearing(stiffness: np.ndarray, damping: np.ndarray) -> RotorMatrices:
    """The rotor with a bearing at node 3."""
    matrices, place = PINNED.matrices, np.ix_(PINNED.dofs(3), PINNED.dofs(3))
    k, c = matrices.stiffness.copy(), matrices.damping.copy()
    k[place] += stiffness
    c[place] += damping
    return replace(matrices, stiffness=k, damping=c)


def whole_state(speed: float, stiffness: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Phasors of all twelve dofs by one dense solve: the readable twin."""
    place = np.array([speed])
    z = dynamic_stiffness(on_bearing(stiffness, damping), place, place)[0]
    return np.linalg.solve(z, unbalance_forces(PINNED, UNBALANCE, place)[0])


def integrated(
    speed: float, stiffness: np.ndarray, damping: np.ndarray, turns: int, rtol: float = 1e-10
) -> np.ndarray:
    """Phasors of all dofs from *turns* turns of Runge-Kutta integration that starts on the matched state."""
    matrices = on_bearing(stiffness, damping)
    n = PINNED.n_dof
    state = np.concatenate([np.zeros((n, n)), np.eye(n)], axis=1)
    motion = -np.linalg.solve(
        matrices.mass, np.concatenate([matrices.stiffness, matrices.at_speed(speed)], axis=1)
    )
    push = np.linalg.solve(matrices.mass, unbalance_forces(PINNED, UNBALANCE, np.array([speed]))[0])
    system = np.concatenate([state, motion])

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        rate = system @ y
        rate[n:] += (push * np.exp(1j * speed * t)).real
        return rate

    start = whole_state(speed, stiffness, damping)
    first = np.concatenate([start.real, (1j * speed * start).real])
    period = 2 * np.pi / speed
    times = period * (turns - 1 + np.arange(64) / 64)
    found = solve_ivp(slope, (0, turns * period), first, "DOP853", times, rtol=rtol, atol=1e-16)
    return 2 / 64 * found.y[:n] @ np.exp(-1j * speed * times)


def test_twelve_degrees_of_freedom_between_two_pins() -> None:
    assert PINNED.stations == (2, 3, 4)
    assert PINNED.n_dof == 12
    assert PINNED.dofs(3) == [4, 5]
    for matrix in (PINNED.matrices.mass, PINNED.matrices.stiffness):
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-9 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(PINNED.matrices.stiffness).min() > 0


def test_static_deflection_of_a_pinned_beam() -> None:
    """F l^3 / 48 E I at mid span, shear a part in a thousand."""
    second_moment = np.pi / 64 * 16.5e-3**4
    flexibility = np.linalg.inv(PINNED.matrices.stiffness)
    middle = PINNED.dofs(3)[0]
    np.testing.assert_allclose(
        flexibility[middle, middle], 0.76**3 / (48 * 2.1e11 * second_moment), rtol=3e-3
    )


def test_condensing_changes_nothing_against_a_dense_solve() -> None:
    stiffness, damping = film()(SPEED)
    found = CONDENSED.response(stiffness, damping)
    dofs = [*PINNED.dofs(2), *PINNED.dofs(3), *PINNED.dofs(4)]
    expected = np.array(
        [whole_state(one, k, c)[dofs] for one, k, c in zip(SPEED, stiffness, damping, strict=True)]
    )
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    journal, _ = CONDENSED.journal(stiffness, damping)
    np.testing.assert_allclose(found[:, 2:4], journal, rtol=1e-12)


def test_pins_equal_very_stiff_springs_with_all_dofs_kept() -> None:
    """20 dofs and springs of 1e11 N/m: what static condensation of the end rotations costs is below a part in
    ten thousand.
    """
    stiffness, damping = film()(SPEED)
    pins = [NodeSupport(node, 1e11 * np.eye(2), np.zeros((2, 2))) for node in (1, 5)]
    expected = [
        unbalance_response(ROTOR, [*pins, NodeSupport(3, k, c)], np.array([one]), UNBALANCE, ROTOR.dofs(4))[0]
        for one, k, c in zip(SPEED[::6], stiffness[::6], damping[::6], strict=True)
    ]
    np.testing.assert_allclose(CONDENSED.response(stiffness, damping)[::6, 4:], expected, rtol=1e-4)


def test_slopes_equal_differences_by_every_coefficient() -> None:
    """Central differences over a part in a thousand."""
    stiffness, damping = film()(SPEED)
    here, slopes = CONDENSED.response_and_slopes(stiffness, damping)
    np.testing.assert_allclose(here, CONDENSED.response(stiffness, damping), rtol=1e-12)
    for number in range(8):
        change = np.zeros(8)
        change[number] = 1e-3 * (np.abs(stiffness).mean() if number < 4 else np.abs(damping).mean())
        k, c = change.reshape(2, 2, 2)
        difference = CONDENSED.response(stiffness + k, damping + c) - CONDENSED.response(
            stiffness - k, damping - c
        )
        expected = difference / (2 * change[number])
        np.testing.assert_allclose(slopes[..., number], expected, atol=1e-4 * np.abs(expected).max())


def test_many_sets_of_coefficients_at_once() -> None:
    stiffness, damping = film()(SPEED)
    factors = np.array([0.8, 1.0, 1.2])[:, None, None, None]
    many = CONDENSED.response(factors * stiffness, damping)
    np.testing.assert_allclose(many[2], CONDENSED.response(1.2 * stiffness, damping), rtol=1e-12)


@pytest.mark.parametrize("rpm", [900.0, 1430.0, 2300.0])
def test_time_integration_from_the_matched_state_stays_on_it(rpm: float) -> None:
    """To 1e-6 of the largest amplitude, after five turns."""
    speed = rpm * RPM
    stiffness, damping = (found[0] for found in film()(np.array([speed])))
    phasors = integrated(speed, stiffness, damping, turns=5)
    place = np.array([speed])
    condensed = condensed_rotor(PINNED, 3, place, unbalance_forces(PINNED, UNBALANCE, place), (2, 4))
    ours = condensed.response(stiffness, damping)[0]
    theirs = phasors[[*PINNED.dofs(2), *PINNED.dofs(4)]]
    assert np.max(np.abs(ours - theirs)) < 1e-6 * np.max(np.abs(ours))


def test_two_forces_add() -> None:
    parts = [
        condensed_rotor(PINNED, 3, SPEED, unbalance_forces(PINNED, {node: size}, SPEED), (2, 4))
        for node, size in UNBALANCE.items()
    ]
    stiffness, damping = film()(SPEED)
    both = condensed_rotor(PINNED, 3, SPEED, FORCES, (2, 4)).response(stiffness, damping)
    np.testing.assert_allclose(sum(part.response(stiffness, damping) for part in parts), both, rtol=1e-9)


def test_some_speeds_alone() -> None:
    stiffness, damping = film()(SPEED)
    chosen = np.arange(SPEED.size) % 5 == 0
    part = CONDENSED.at(chosen).response(stiffness[chosen], damping[chosen])
    np.testing.assert_array_equal(part, CONDENSED.response(stiffness, damping)[chosen])


def test_closed_inverse(rng: np.random.Generator) -> None:
    matrices = rng.standard_normal((7, 2, 2)) + 1j * rng.standard_normal((7, 2, 2))
    np.testing.assert_allclose(inverse(matrices), np.linalg.inv(matrices), rtol=1e-12)


@pytest.mark.parametrize(
    ("pins", "said"),
    [
        ((1,), "two different nodes"),
        ((1, 1), "two different nodes"),
        ((1, 9), "node 9"),
        ((1, 2), "a disc sits on the pin"),
    ],
)
def test_pins_that_cannot_be_are_refused(pins: tuple[int, ...], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        pinned_rotor(ROTOR, pins)


def test_a_shaft_of_pins_alone_is_refused() -> None:
    with pytest.raises(ConfigError, match="no node between"):
        pinned_rotor(Rotor((ShaftElement(0.1, 0.01),)), (1, 2))


def test_a_pin_has_no_degrees_of_freedom() -> None:
    with pytest.raises(ConfigError, match="not between the pins"):
        PINNED.dofs(1)
