"""Optimum designs against printed ones, and their certificates against designs drawn at random."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import FitError
from labpipe.methods.planning import designs
from labpipe.methods.planning.designs import CRITERIA, certificate, optimum, variances
from labpipe.methods.planning.model import sensitivities
from labpipe.methods.planning.search import candidates
from tests.methods.planning.rigs import RIGS

# Quadratic regression y = a + b x + c x^2 on [-1, 1], 21 points.
POINTS = np.linspace(-1, 1, 21)
QUADRATIC = np.stack([np.outer(row, row) for row in np.stack([np.ones(21), POINTS, POINTS**2], axis=1)])


@pytest.mark.parametrize(
    ("criterion", "shares"), [("D", [1 / 3, 1 / 3, 1 / 3]), ("A", [1 / 4, 1 / 2, 1 / 4])]
)
def test_quadratic_regression(criterion: str, shares: list[float]) -> None:
    # Fedorov 1972, Theory of Optimal Experiments, sec. 2.2 and 2.9: the points -1, 0, 1.
    design = optimum(criterion, QUADRATIC)
    np.testing.assert_allclose(design.shares[[0, 10, 20]], shares, atol=2e-3)
    assert design.certificate.efficiency >= 0.999


def test_minimax_of_a_line() -> None:
    # y = a + b x at x = 0 (share 1 - w) and x = 2 (share w): I = [[1, 2w], [2w, 4w]], v_a = 1 / (1 - w), v_b
    # = 1 / (4 w (1 - w)). For w >= 1/4 the variance of a is the larger: the largest is least at w = 1/4, v =
    # 4 / 3.
    points = np.stack([np.outer(row, row) for row in np.array([[1.0, 0.0], [1.0, 2.0]])])
    design = optimum("minimax", points)
    np.testing.assert_allclose(design.shares, [0.75, 0.25], atol=1e-3)
    np.testing.assert_allclose(variances(design.information), 4 / 3, rtol=2e-3)
    assert design.certificate.efficiency >= 0.999


@pytest.mark.parametrize("floor", [0.0, 0.2])
@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("name", RIGS)
def test_every_design_is_certified(name: str, criterion: str, floor: float) -> None:
    model, noise, lines = RIGS[name]()
    found = candidates(model, noise, 2 * np.pi * lines, np.eye(model.n_dof, dtype=complex))
    flat = np.full(found.line.size, 1 / found.line.size)
    design = optimum(criterion, found.information, floor=floor * flat)
    assert design.certificate.efficiency >= 0.999
    assert design.shares.sum() == pytest.approx(1.0)
    assert np.all(design.shares >= floor * flat * (1 - 1e-9))
    # The certificate holds against any other design: flat, and mixtures of few lines.
    rng = np.random.default_rng(11)
    for _ in range(50):
        other = np.zeros(found.line.size)
        other[rng.choice(found.line.size, 12)] = rng.uniform(size=12)
        other = floor * flat + (1 - floor) * (0.9 * other / other.sum() + 0.1 * flat)
        assert _value(criterion, other, found.information) >= design.certificate.efficiency * _value(
            criterion, design.shares, found.information
        )


def _value(criterion: str, shares: np.ndarray, information: np.ndarray) -> float:
    whole = np.tensordot(shares, information, 1)
    if criterion == "D":
        return float(np.linalg.det(whole / 1e3) ** (-1 / len(whole)))
    v = variances(whole)
    return float(v.sum() if criterion == "A" else v.max())


def test_goals_leave_other_coefficients_aside() -> None:
    model, noise, lines = RIGS["rotor"]()
    found = candidates(model, noise, 2 * np.pi * lines, np.eye(2, dtype=complex))
    wanted = np.array([name == "c_xy" for name in model.names])
    alone, all_of_them = (optimum("minimax", found.information, which) for which in (np.eye(8)[wanted], None))
    assert alone.certificate.efficiency >= 0.999
    assert variances(alone.information)[wanted][0] < variances(all_of_them.information)[wanted][0]


@pytest.mark.parametrize("criterion", CRITERIA)
def test_a_poor_design_has_a_poor_certificate(criterion: str) -> None:
    model, noise, lines = RIGS["pedestal"]()
    found = candidates(model, noise, 2 * np.pi * lines, np.eye(1, dtype=complex))
    flat = found.information.mean(axis=0)
    assert certificate(criterion, found.information, flat, np.eye(2)).efficiency < 0.1


def test_cost_of_displacement() -> None:
    # Where displacement alone is limited, the power of a line is its share over |H|^2 / stroke^2.
    model, noise, lines = RIGS["pedestal"]()
    omega = 2 * np.pi * lines
    found = candidates(model, noise, omega, np.eye(1, dtype=complex), 1.0, 2e-6)
    moved = np.abs(model.receptance(omega)[:, 0, 0]) ** 2 / 4e-12
    np.testing.assert_allclose(found.cost, moved)
    change = sensitivities(model, noise, omega)[:, :, 0, 0]
    np.testing.assert_allclose(found.information[:, 0, 0], 2 * np.abs(change[:, 0]) ** 2 / moved)


def test_many_candidates_that_tell_alike_are_looked_at_in_part(monkeypatch: pytest.MonkeyPatch) -> None:
    """Legendre polynomials up to degree 4 on 301 points, of which 104 stay after the first steps: programmes
    of up to 50 and some of them, and a design that no other betters by more than .03 %.
    """
    points = np.polynomial.legendre.legvander(np.linspace(-1, 1, 301), 4)
    polish, sizes = designs._polish, []

    def counted(criterion: str, whole: np.ndarray, wanted: np.ndarray, chosen: np.ndarray, start: np.ndarray):
        sizes.append(chosen.size)
        return polish(criterion, whole, wanted, chosen, start)

    monkeypatch.setattr(designs, "_polish", counted)
    monkeypatch.setattr(designs, "MOST_AT_ONCE", 50)
    found = optimum("minimax", points[:, :, None] * points[:, None, :])
    assert max(sizes) <= designs.MOST_AT_ONCE + designs.PROMISING
    assert found.certificate.efficiency > 0.9997


def test_one_line_is_not_enough_for_three_coefficients() -> None:
    rows = np.array([[[1.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0]]])
    with pytest.raises(FitError, match="no excitation of these lines"):
        optimum("D", rows)
