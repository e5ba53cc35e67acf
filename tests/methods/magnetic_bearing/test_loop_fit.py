"""Unknowns of a control loop: their names, their estimates within their uncertainty, and what cannot be told
apart.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from labpipe.errors import ConfigError, FitError
from labpipe.methods.magnetic_bearing.loop_fit import (
    LoopFit,
    goodness,
    identifiability_findings,
    loop_fit as fit_of_all,
)
from labpipe.methods.magnetic_bearing.loop_problem import View, unknown, with_unknowns
from tests.methods.magnetic_bearing.loop_cases import bearing, measured


def loop_fit(views: list[View], names: tuple[str, ...]) -> LoopFit:
    return fit_of_all([view.observation for view in views], names)


@pytest.mark.parametrize(
    ("name", "value", "unit"),
    [
        ("gap", 0.45e-3, "m"),
        ("delay", 75e-6, "s"),
        ("gain", 1.0, "A/V"),
        ("proportional", 1.0, "1"),
        ("force_per_current", 5.8, "N/A"),
        ("negative_stiffness", 33106.0, "N/m"),
        ("turns", None, ""),
        ("sensor_bandwidth", None, ""),
        ("gapp", None, ""),
    ],
)
def test_an_unknown_has_its_value_from_the_file(name: str, value: float | None, unit: str) -> None:
    file = bearing("hmb-geometry")
    if value is None:
        with pytest.raises(ConfigError, match=name):
            unknown(file, name)
        return
    found = unknown(file, name)
    assert (found.value, found.unit) == (pytest.approx(value, rel=1e-5), unit)
    changed = unknown(with_unknowns(file, {name: 1.1 * found.value}), name)
    assert changed.value == pytest.approx(1.1 * found.value)


def test_the_gap_acts_on_both_factors() -> None:
    """k_i goes as 1 / g^2 and k_n as 1 / g^3 of a magnet whose iron has no reluctance and whose bias is a
    magnetomotive force.
    """
    plants = [with_unknowns(bearing("hmb-geometry"), {"gap": gap}).suspension() for gap in (0.45e-3, 0.50e-3)]
    assert plants[0].loop.force_per_current / plants[1].loop.force_per_current == pytest.approx(
        (50 / 45) ** 2
    )
    assert plants[0].negative_stiffness / plants[1].negative_stiffness == pytest.approx((50 / 45) ** 3)


def test_a_stated_pull_takes_the_place_of_the_inferred_one() -> None:
    file = bearing("hmb-magnetic")
    assert file.static_stiffness is not None
    changed = with_unknowns(file, {"negative_stiffness": 30e3}).suspension()
    assert changed.negative_stiffness == 30e3
    with pytest.raises(ConfigError, match="no 'gap'"):
        unknown(file, "gap")


@pytest.mark.long
@pytest.mark.parametrize("averages", [0, 5])
def test_intervals_hold_the_true_values_in_95_of_100_cases(averages: int, rng: np.random.Generator) -> None:
    """Gap and delay over 60 noises, the support drawn within its uncertainty; from 5 periods the noise
    itself is estimated.

    The count of each unknown is compared with the binomial distribution of 95 % at 1 in 200 (80 % are seen in
    87 of 100), its errors in standard errors within three deviations of their root mean square.
    """
    file = bearing("hmb-geometry")
    start = with_unknowns(file, {"gap": 0.47e-3, "delay": 60e-6})
    truth = {"gap": 0.45e-3, "delay": 75e-6}
    held, errors = dict.fromkeys(truth, 0), []
    for _ in range(60):
        view = replace(measured(file, rng, averages=averages), file=start)
        fitted = loop_fit([view], tuple(truth))
        assert fitted.converged and fitted.determined
        for parameter in fitted.parameters:
            assert parameter.ci95 is not None
            held[parameter.name] += parameter.ci95[0] <= truth[parameter.name] <= parameter.ci95[1]
        errors.append([(p.value - truth[p.name]) / p.full_error for p in fitted.parameters])
    assert all(count >= stats.binom.ppf(0.005, 60, 0.95) for count in held.values()), held
    assert np.all(np.abs(np.sqrt(np.mean(np.square(errors), axis=0)) - 1) < 3 / np.sqrt(120))


def test_several_tests_give_one_value(rng: np.random.Generator) -> None:
    """Two tests under different gains halve the variance at least: the errors shrink by more than 1 / sqrt 2
    less 5 %.
    """
    file = bearing("hmb-geometry")
    other = with_unknowns(file, {"proportional": 1.2})
    alone = loop_fit([measured(file, rng)], ("delay", "gap"))
    both = loop_fit([measured(file, rng), measured(other, rng)], ("delay", "gap"))
    for one, two in zip(alone.parameters, both.parameters, strict=True):
        assert (
            two.std_error is not None and one.std_error is not None and two.std_error < 0.75 * one.std_error
        )
    ((*names, between),) = both.correlations
    chi2, chance, condition = goodness(both)
    assert names == ["gap", "delay"] and (chi2.name, chance.name) == ("chi2_reduced", "chi2_p")
    # Two columns of an angle acos(r) have the least condition number, ((1 + r) / (1 - r))^.5, at one length.
    assert not identifiability_findings(replace(both, condition_number=29.9, bent=()))
    (hardly,) = identifiability_findings(
        replace(both, condition_number=31.0, alike=("gap", "delay"), bent=())
    )
    assert hardly.code == "collinear" and hardly.message.startswith(
        "gap and delay are hardly told apart (condition number 31, limit 30)"
    )
    assert condition.name == "condition_number" and condition.value < 100
    assert condition.value >= np.sqrt((1 + abs(between)) / (1 - abs(between)))


def test_what_acts_only_as_a_product_cannot_be_told_apart(rng: np.random.Generator) -> None:
    """Amplifier gain and force per current multiply each other everywhere."""
    view = measured(replace(bearing("hmb-magnetic"), static_stiffness=None, negative_stiffness=33106.0), rng)
    fitted = loop_fit([view], ("gain", "force_per_current"))
    assert not fitted.determined and set(fitted.alike) == {"gain", "force_per_current"}
    assert all(parameter.std_error is None and parameter.ci95 is None for parameter in fitted.parameters)
    (finding,) = identifiability_findings(fitted)
    assert finding.code == "collinear" and "cannot be told apart by this response" in finding.message
    (stopped,) = identifiability_findings(replace(fitted, condition_number=2.0, converged=False))
    assert stopped.code == "no-convergence"


def test_what_acts_on_nothing_is_said(rng: np.random.Generator) -> None:
    """With the static stiffness stated, the inferred pull makes up for a stated mass.

    Recoil of a magnet without area acts on nothing.
    """
    fitted = loop_fit([measured(bearing("hmb-geometry"), rng)], ("delay", "recoil"))
    assert not fitted.determined and fitted.alike == ("recoil",)


def test_a_wrong_loop_is_exposed_by_chi_square_and_a_right_one_is_not(rng: np.random.Generator) -> None:
    file = bearing("hmb-geometry")
    right = [loop_fit([measured(file, rng)], ()).chi2_p for _ in range(20)]
    assert min(right) > 1e-3 and np.mean(right) > 0.2
    wrong = replace(measured(file, rng), file=with_unknowns(file, {"proportional": 1.1}))
    assert loop_fit([wrong], ()).chi2_p < 1e-6


def test_without_noise_nothing_can_be_judged(rng: np.random.Generator) -> None:
    view = measured(bearing("hmb-magnetic"), rng)
    blind = replace(view, response=replace(view.response, covariance=None))
    with pytest.raises(FitError, match="noise of the response is not known"):
        loop_fit([blind], ("delay",))


def test_a_delay_that_would_be_negative_is_held_at_zero(rng: np.random.Generator) -> None:
    """A sensor that leads by 30 us on a loop without delay: the gap is that of a fit whose file has no
    delay.
    """
    file = with_unknowns(bearing("hmb-geometry"), {"delay": 0.0})
    view = measured(file, rng)
    lead = np.exp(2j * np.pi * 30e-6 * view.response.frequency)[:, None, None]
    ahead = replace(view, response=replace(view.response, matrix=view.response.matrix * lead))
    found = loop_fit(
        [replace(ahead, file=with_unknowns(file, {"gap": 0.47e-3, "delay": 60e-6}))], ("gap", "delay")
    )
    alone = loop_fit([replace(ahead, file=with_unknowns(file, {"gap": 0.47e-3}))], ("gap",))
    gap, delay = found.parameters
    assert found.converged and found.at_zero == ("delay",) and alone.converged
    assert (
        delay.value == 0.0
        and delay.at_bound
        and delay.ci95 is not None
        and delay.ci95[0] == 0.0 < delay.ci95[1]
    )
    assert gap.value == pytest.approx(alone.parameters[0].value, rel=1e-6)
    # A delay that may lie above zero leaves the gap in more uncertainty than one that is known.
    assert (
        gap.std_error is not None
        and alone.parameters[0].std_error is not None
        and gap.std_error > alone.parameters[0].std_error
    )
    assert [finding.code for finding in identifiability_findings(found)] == ["at-bound", "first-order"]
