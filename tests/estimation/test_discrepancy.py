"""Intervals with model error: golden values of an independent calculation of the same method, and draws of
its own kinds of error.

The golden values come from a separate program (two seeded sets, a minimal-standard generator): components to
1e-6, what runs through iterative fits to 1e-3 of the half-width.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import FitError
from labpipe.estimation import discrepancy
from labpipe.estimation.discrepancy import course, evidence, larger_noise, mixture
from labpipe.estimation.mode_model import Curve, Fitted, ModeModel, extensions
from labpipe.estimation.statistics import mixture_interval


def noise(n: int, x: int) -> np.ndarray:
    """Circular noise of E|n|^2 = 1 from x <- 16807 x mod 2147483647, two numbers a line."""
    drawn = []
    for _ in range(n):
        x = 16807 * x % 2147483647
        y = 16807 * x % 2147483647
        drawn.append(np.sqrt(-np.log(x / 2147483647)) * np.exp(2j * np.pi * y / 2147483647))
        x = y
    return np.array(drawn)


def mode(f: np.ndarray, f_n: float, zeta: float) -> np.ndarray:
    return np.asarray(f_n**2 / (f_n**2 - f**2 + 2j * zeta * f_n * f))


def hidden_mode() -> Fitted:
    f = 92 + 16 * np.arange(81) / 80
    others = (
        0.05 * mode(f, 103, 0.012)
        + 0.4 * mode(f, 62, 0.02)
        + 0.7 * mode(f, 131, 0.015)
        + 0.2 * mode(f, 170, 0.01)
    )
    model = ModeModel(Curve(f, mode(f, 100, 0.01) + others + 0.1 * noise(81, 1), np.full(81, 0.1)))
    return model.fit(model.start(np.log([100, 0.01])))


def gain_curve() -> Fitted:
    f = 96 + 9 * np.arange(61) / 60
    x = (f - 100.5) / 9
    exact = mode(f, 100, 0.012) * (1 + 0.02 * np.cos(2.2 * x + 0.3) + 0.015j * np.sin(2.8 * x))
    std = 0.002 * np.abs(exact) + 0.02
    model = ModeModel(Curve(f, exact + std * noise(61, 7), std), coefficients=True, residual=0)
    return model.fit(model.start(np.log([1.0, 3.8e-5, 2.5e-6])))


# (type, length, amplitude): ln E (set 2 alone: residues have a unit of their own), mean, variance, largest
# eigenvalue.
OF_POLE = {
    ("a", 2.0, 10.0): (
        [4.605148079043306, -4.607190147239185],
        [5.368864858208516e-09, 5.18180052677702e-05],
        21.523144537305072,
    ),
    ("m", 4.5, 10.0): (
        [4.605176230334842, -4.613074996052742],
        [5.75964135830199e-09, 5.560487491278326e-05],
        65.2629119216449,
    ),
    ("z", 4.0, 100.0): (
        [4.606246044727376, -4.456709867286341],
        [1.5742460733578686e-05, 0.15194996268440822],
        74.74724741546339,
    ),
}


def test_single_components_are_those_of_the_independent_calculation() -> None:
    base = hidden_mode()
    assert np.exp(base.theta[:2]) == pytest.approx([99.96918170118963, 0.010176825148985078], rel=1e-6)
    assert base.chi2 == pytest.approx(3670.0629347698173, rel=1e-9) and base.dof == 156
    none = np.zeros((1, base.theta.size))
    for (kind, length, amplitude), (mean, variance, largest) in OF_POLE.items():
        of = course(base, kind, length)
        told = evidence(base, [replace(of, amplitudes=np.array([amplitude]))], none, 1)
        assert told.mean[0, 0, :2] == pytest.approx(mean, abs=1e-6)
        assert np.diag(told.covariance[0, 0])[:2] == pytest.approx(variance, rel=1e-4)
        assert np.max(of.eigenvalues) == pytest.approx(largest, rel=1e-6)


def test_evidence_of_coefficients_is_that_of_the_independent_calculation() -> None:
    base = gain_curve()
    assert base.chi2 == pytest.approx(1181.8970971395224, rel=1e-9)
    none = np.zeros((1, base.theta.size))
    of = replace(course(base, "a", 2.0), amplitudes=np.array([0.0, 1.0, 10.0]))
    told = evidence(base, [of], none, 1)
    assert told.log[0] == pytest.approx([-618.1869633339944, -120.3043113415938, -128.649540675033], rel=1e-7)
    assert told.mean[0, 2] == pytest.approx(
        [-0.016377408554240424, -10.188753689397554, -12.90244685266657], abs=1e-6
    )


@pytest.mark.parametrize(
    ("made", "shares", "stated"),
    [
        (
            hidden_mode,
            {"Ja": 0.880094, "Jm": 0.071636, "J+aa": 0.011959, "J+am": 0.021785, "J+az": 0.014525},
            [(4.605111764142879, 4.60525454503096), (-4.616722299741603, -4.601235061028687)],
        ),
        (
            gain_curve,
            {"a": 0.738156, "m": 0.238912, "z": 0.000183, "+aa": 0.007433, "+am": 0.008462, "+az": 0.006854},
            [
                (-0.04161354126118322, 0.04185751238807039),
                (-10.215350254734288, -10.132128416874128),
                (-12.927742820666644, -12.844283490986971),
            ],
        ),
    ],
)
def test_the_whole_mixture_is_that_of_the_independent_calculation(made, shares, stated, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """That has no second mode beside a resonance that moves."""
    monkeypatch.setattr(discrepancy.mode_model, "second_beside_moving", lambda *_: None)
    found = mixture(made())
    assert {name: share for name, share in found.shares.items() if share > 1e-5} == pytest.approx(
        shares, abs=5e-5
    )
    for number, (low, high) in enumerate(stated):
        row = np.eye(found.noise.shape[0])[number]
        assert found.stated_interval(row)[1:] == pytest.approx((low, high), abs=1e-3 * (high - low) / 2)


def test_the_hidden_mode_is_found_where_it_is() -> None:
    (second,) = (fit for fit in extensions(hidden_mode()) if fit.model.member == "J")
    assert np.exp(second.theta[2:4]) == pytest.approx([103.17758839499449, 0.008690121912178442], rel=1e-5)
    assert second.chi2 == pytest.approx(548.8609581309244, rel=1e-8)
    assert mixture(hidden_mode()).second == pytest.approx(103.17758839499449, rel=1e-6)


@pytest.mark.parametrize(
    ("f_2", "zeta_2", "size"), [(97.86, 0.0128, 0.066), (97.17, 0.0102, 0.122), (97.35, 0.0101, 0.394)]
)
def test_coefficients_are_those_of_the_mode_that_was_fitted(f_2: float, zeta_2: float, size: float) -> None:
    """Beside 1 / (k + c s + m s^2) with k = 1 stands a mode of *size* of its residue: the second mode of the
    mixture, whichever of the two minima with exchanged modes its noise makes the lower one; k and c are then
    held within 2 %. Else k was 6 to 12 % off, with an interval of 2 %.
    """
    f, w = 86.7 + 26.9 * np.arange(141) / 140, 2 * np.pi * 100.0
    exact = mode(f, 100.0, 0.0097) + size * mode(f, f_2, zeta_2)
    std = 0.004 / (2 * 0.0097) * np.ones(141)
    model = ModeModel(Curve(f, exact + std * noise(141, 5), std), coefficients=True, residual=0)
    found = mixture(model.fit(model.start(np.log([1.0, 2 * 0.0097 / w, 1 / w**2]))))
    assert found.second == pytest.approx(f_2, rel=1e-3)
    for row, truth in ((np.eye(3)[0], 0.0), (np.eye(3)[1], np.log(2 * 0.0097 / w))):
        _, low, high = found.stated_interval(row)
        assert low < truth < high < low + 0.04


@pytest.mark.parametrize("coefficients", [False, True])
def test_a_second_mode_beside_a_resonance_that_drifts(coefficients: bool) -> None:
    """A frequency that drifts evenly by .6 of the half-power half-width either way, a mode of a tenth 1.3
    widths above: a second mode alone makes the damping 17 and 24 % too large, with intervals of 20 and 66 %.
    """
    f = 92 + 16 * np.arange(141) / 140
    drift = np.mean([mode(f, 100 * (1 + 0.006 * x), 0.01) for x in np.linspace(-1, 1, 41)], axis=0)
    std = 0.3 * np.ones(141)
    curve = Curve(f, drift + 0.1 * mode(f, 102.6, 0.012) + std * noise(141, 3), std)
    start = np.log([1.0, 2 * 0.01 / 628.3, 628.3**-2] if coefficients else [100, 0.01])
    model = ModeModel(curve, coefficients=coefficients, residual=0 if coefficients else 1)
    found = mixture(model.fit(model.start(start)))
    row = model.to_resonance[1] if coefficients else np.eye(found.noise.shape[0])[1]
    _, low, high = np.array(found.stated_interval(row)) + (model.offset[1] if coefficients else 0.0)
    assert low < np.log(0.01) < high < low + 0.2


def test_slopes_of_every_member_are_central_differences() -> None:
    f = np.linspace(95, 105, 41)
    curve = Curve(f, mode(f, 100, 0.01), np.ones(41))
    for coefficients, q in ((False, np.log([100, 0.01])), (True, np.log([1.0, 3.8e-5, 2.5e-6]))):
        for member, more in (
            ("", []),
            ("J", [101.0, 0.02]),
            ("L", [0.004]),
            ("G", [0.004]),
            ("U", [0.004]),
            ("C", [0.004]),
            ("JU", [0.004, 101.0, 0.02]),
        ):
            model = ModeModel(curve, coefficients, 2, member=member)
            theta = model.start(np.concatenate([q, np.log(more)]))
            jacobian = model.at(theta)[1]
            for number in range(theta.size):
                step = (
                    1e-7
                    * np.eye(theta.size)[number]
                    * max(1.0, abs(theta[number]) if number >= model.n_shape else 1.0)
                )
                slope = (model.at(theta + step)[0] - model.at(theta - step)[0]) / (2 * step[number])
                np.testing.assert_allclose(jacobian[number], slope, atol=2e-6 * np.max(np.abs(slope)) + 1e-7)


@pytest.mark.long
def test_a_sound_fit_keeps_its_interval() -> None:
    """Thirty draws: noise-only width but for a few per cent, and the truth is held."""
    f = np.linspace(94, 106, 100)
    widths, held = [], 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        drawn = 0.05 * (rng.standard_normal(100) + 1j * rng.standard_normal(100)) / np.sqrt(2)
        model = ModeModel(Curve(f, mode(f, 100, 0.01) + drawn, np.full(100, 0.05)))
        found = mixture(model.fit(model.start(np.log([100, 0.01]))))
        row = np.eye(found.noise.shape[0])[1]
        _, low, high = found.stated_interval(row)
        widths.append((high - low) / (2 * 1.959964 * np.sqrt(row @ found.noise @ row)))
        held += low <= np.log(0.01) <= high
    # Of 30 at 95 % fewer than 25 come once in 600 times.
    assert np.exp(np.mean(np.log(widths))) < 1.12 and held >= 25


def test_a_band_that_shows_no_course_is_refused() -> None:
    f = np.linspace(99, 101, 30)
    model = ModeModel(Curve(f, mode(f, 100, 0.01), np.full(30, 0.1)))
    with pytest.raises(FitError, match="too narrow"):
        mixture(model.fit(model.start(np.log([100, 0.01]))))


def test_ends_of_one_wide_component_are_those_of_a_normal_distribution() -> None:
    """A component that has all the weight, far wider than its mean is precise: by rounding its own end lay on
    either side of itself.
    """
    rng = np.random.default_rng(0)
    for _ in range(200):
        mean, deviation = 1e10 * rng.normal(), 10 ** rng.uniform(9, 13)
        low, high = mixture_interval(np.ones(1), np.array([mean]), np.array([deviation]))
        assert (low - mean) / deviation == pytest.approx(-1.959963984540054, rel=1e-9)
        assert (high - mean) / deviation == pytest.approx(1.959963984540054, rel=1e-9)


def test_without_a_course_the_evidence_is_that_of_the_ordinary_fit() -> None:
    """However far the courses draw the linearisation, amplitude 0 is the minimum itself."""
    base = hidden_mode()
    rows = base.model.prior_rows(base.theta, base.theta.size)
    courses = [course(base, kind, length) for kind, length in (("a", 2.0), ("m", 4.5), ("z", 4.0))]
    told = evidence(base, [replace(of, amplitudes=np.array([0.0, 10.0, 100.0])) for of in courses], rows, 3)
    alone = evidence(base, [replace(of, amplitudes=np.zeros(1)) for of in courses], rows, 1)
    deviation = np.sqrt(np.diag(base.covariance))
    assert np.all(np.abs(told.mean[:, 0] - base.theta[base.model.kept]) < 1e-3 * deviation)
    assert told.log[:, 0] == pytest.approx(alone.log[:, 0], abs=1e-9)
    assert np.all(np.any(np.abs(told.theta - base.theta)[:, :2] > deviation[:2], axis=1))


def test_courses_beside_each_other_tell_what_each_tells_alone() -> None:
    """Each ends where it would alone, after one linearisation or three; one that sees no line is left out."""
    base = hidden_mode()
    rows = base.model.prior_rows(base.theta, base.theta.size)
    courses = [larger_noise(base), course(base, "a", 2.0), course(base, "z", 8.0)]
    blind = replace(courses[1], rotate=0 * courses[1].rotate)
    with np.errstate(invalid="ignore"):
        together = evidence(base, [courses[0], blind, *courses[1:]], rows, 3)
    assert np.all(together.log[1] == -np.inf)
    for number, of in zip((0, 2, 3), courses, strict=True):
        alone = evidence(base, [of], rows, 3)
        for part in ("log", "mean", "covariance", "theta"):
            np.testing.assert_allclose(getattr(together, part)[number], getattr(alone, part)[0], rtol=1e-12)
