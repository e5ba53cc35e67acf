"""Several recordings of one FRF: means over them, with the part between and the model error that all share.

Truth and faults are closed forms; the scatter between recordings and the noise are drawn here.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.header import Header
from labpipe.artefacts.measured_files import read_response, write_response
from labpipe.errors import SettingError
from labpipe.estimation.fitting import identify
from labpipe.estimation.repeated import RepeatValues, stated_mean
from labpipe.estimation.repeats import RepeatMean
from labpipe.estimation.settings import FitSettings
from labpipe.methods.modal.settings import ModalSettings
from labpipe.records.finding import Finding, Parameter, Repeats
from labpipe.records.identification import Fit, random_part
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.records.uncertain import ChannelUncertainty, Uncertainty

FREQUENCY = np.linspace(90.0, 110.0, 101)
F_N, ZETA, MASS = 100.0, 0.01, 2.0
# Scatter between recordings, in ln f and ln zeta, and the noise of one over the rms of its response.
MOVED, DAMPED, NOISE = 0.1 * ZETA, 0.05, 0.01


def mode(f_n: float, zeta: float, amount: float = 1 / MASS) -> np.ndarray:
    w, w_n = 2 * np.pi * FREQUENCY, 2 * np.pi * f_n
    return amount / (w_n**2 - w**2 + 2j * zeta * w_n * w)


def repeated(
    n: int, seed: int, *, hidden: float = 0.0, outlier: float = 0.0, trend: float = 0.0
) -> FrequencyResponse:
    rng = np.random.default_rng(seed)
    std = NOISE * float(np.sqrt(np.mean(np.abs(mode(F_N, ZETA)) ** 2)))
    matrices = []
    for number in range(n):
        moved = MOVED * rng.normal() + trend * (number - (n - 1) / 2) + (outlier if number == n - 1 else 0.0)
        h = mode(F_N * np.exp(moved), ZETA * np.exp(DAMPED * rng.normal())) + hidden * mode(101.2, 0.012)
        noise = std * (rng.normal(size=h.size) + 1j * rng.normal(size=h.size)) / np.sqrt(2)
        matrices.append((h + noise)[:, None, None])
    mean = np.mean(matrices, axis=0)
    variance = np.var(matrices, axis=0, ddof=1) / n
    return FrequencyResponse(
        FREQUENCY,
        mean,
        (Port("y", "y", "x"),),
        (Port("f", "f", "x"),),
        covariance=diagonal_covariance(variance),
        covariance_dof=n - 1.0,
        averages=n,
        repeats=np.array(matrices),
        repeat_names=tuple(f"hit-{number + 1}" for number in range(n)),
    )


def fitted(response: FrequencyResponse, *, model: str = "sdof", **settings: object) -> Fit:
    (fit,) = identify(response, FitSettings(model, **settings))  # type: ignore[arg-type]
    return fit


@pytest.mark.long
@pytest.mark.parametrize("hidden", [0.0, 0.03])
def test_means_hold_the_structure_that_moves_between_recordings(hidden: float) -> None:
    """10 tests of 6 recordings, with and without a hidden mode in all of them: of 20 intervals of f_n and
    zeta at 95 % 16 or more hold but once in 400; where 70 % do, three in four fail.
    """
    held = []
    for seed in range(10):
        fit = fitted(repeated(6, seed, hidden=hidden))
        for name, truth in (("f_n", F_N), ("zeta", ZETA)):
            parameter = fit.parameter(name)
            assert parameter.repeats.n == 6 and len(parameter.repeats.values) == parameter.repeats.used
            held.append(parameter.ci95[0] <= truth <= parameter.ci95[1])
    assert sum(held) >= 16


def test_the_mean_and_its_parts() -> None:
    """f_n is the exponential of the mean of logarithms; noise of a mean of 6 is far below their scatter."""
    response = repeated(6, 1)
    fit = fitted(response)
    f_n = fit.parameter("f_n")
    singles = [
        fitted(replace(response, matrix=matrix, covariance=None, repeats=None, repeat_names=())).parameter(
            "f_n"
        )
        for matrix in response.repeats
    ]
    np.testing.assert_allclose(f_n.repeats.values, [one.value for one in singles], rtol=2e-6)
    assert f_n.value == pytest.approx(np.exp(np.mean(np.log(f_n.repeats.values))), rel=1e-6)
    spread = np.std(np.log(f_n.repeats.values), ddof=1)
    assert 0.5 * spread < f_n.repeats.spread / F_N < 1.6 * spread
    assert f_n.interval.repeats > 5 * f_n.interval.noise
    assert any("means over 6 recordings" in text for text in fit.notes)


@pytest.mark.long
def test_noise_that_grows_with_the_response_is_that_of_a_repeat() -> None:
    """Of 50 single FRFs without a variance, a gain of 3 % from line to line: f_n and zeta scatter by what
    their errors say, within three of the 10 % of a deviation of 50 draws (of even noise: 0.43, 0.54 of it).
    """
    rng, h = np.random.default_rng(5), mode(F_N, ZETA)
    single = replace(repeated(2, 0), covariance=None, repeats=None, repeat_names=())
    off, errors = [], []
    for _ in range(50):
        gain = 1 + 0.03 * (rng.normal(size=h.size) + 1j * rng.normal(size=h.size)) / np.sqrt(2)
        (fit,) = identify(
            replace(single, matrix=(h * gain)[:, None, None]), FitSettings("sdof"), judging=False
        )
        found = [fit.parameter(name) for name in ("f_n", "zeta")]
        off.append([p.value for p in found])
        errors.append([p.std_error for p in found])
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / np.std(off, axis=0)
    assert np.all(np.abs(ratio - 1) < 0.3), ratio


@pytest.mark.parametrize(("at", "held"), [(7, True), (0, True), (4, False)])
def test_a_recording_that_stands_out_is_named_and_left_out(at: int, held: bool) -> None:
    """Two half-widths off. The first or last one may as well be of another state: the interval holds either
    reading.
    """
    response = repeated(8, 2, outlier=2 * ZETA)
    matrices = np.insert(response.repeats[:7], at, response.repeats[7], axis=0)
    fit = fitted(replace(response, repeats=matrices))
    f_n = fit.parameter("f_n")
    assert f_n.repeats.used == 7 and f_n.ci95[0] < F_N < f_n.ci95[1] and f_n.value < F_N * (1 + 0.2 * ZETA)
    assert (f_n.ci95[1] > F_N * (1 + 2 * ZETA)) == held == (f_n.interval.repeats > 0.4 * ZETA * F_N)
    messages = " ".join(finding.message for finding in fit.findings)
    assert f"recording 'hit-{at + 1}' is left out" in messages
    assert ("name the groups (repeat_groups)" in messages) == held


@pytest.mark.parametrize("seed", range(3))
def test_a_drift_between_recordings_is_stated_in_their_middle(seed: int) -> None:
    """Twelve recordings a tenth of the half-power half-width apart, 1.1 % in all, which scatter by as much:
    the interval of the middle is that of the scatter about the line, 2.2 times .1 ZETA / sqrt(12) (times 1.5
    at most by what twelve scatter, and by their prior).
    """
    drifting = fitted(repeated(12, seed, trend=0.1 * ZETA))
    f_n = drifting.parameter("f_n")
    assert (f_n.repeats.covariate, f_n.repeats.at) == ("order of recording", 6.5)
    assert f_n.ci95[0] < F_N < f_n.ci95[1] < f_n.ci95[0] + 2 * 1.5 * 2.2 * 0.1 * ZETA / np.sqrt(12) * F_N
    (said,) = (finding.message for finding in drifting.findings if finding.code == "repeats-in-order")
    change = float(re.search(r"f_n by \+([\d.]+) %", said)[1])  # type: ignore[index]
    assert change == pytest.approx(1.1, abs=0.4)


def test_a_step_between_recordings_is_no_drift() -> None:
    """Of eight, the second half .4 half-power half-widths higher."""
    response = repeated(8, 3)
    rng = np.random.default_rng(3)
    std = NOISE * float(np.sqrt(np.mean(np.abs(mode(F_N, ZETA)) ** 2)))
    noise = std * (rng.normal(size=(8, 101)) + 1j * rng.normal(size=(8, 101))) / np.sqrt(2)
    moved = np.array([mode(F_N * (1 + 0.4 * ZETA * (number > 3)), ZETA) for number in range(8)])
    stepped = fitted(replace(response, repeats=(moved + noise)[:, :, None, None]))
    assert "repeats-in-order" in [finding.code for finding in stepped.findings]
    assert stepped.parameter("f_n").repeats.covariate == ""


@pytest.mark.parametrize("seed", range(3))
def test_a_frequency_that_follows_the_force_is_stated_at_the_middle_one(seed: int) -> None:
    """Softer by a fifth of the half-power half-width at the middle of nine levels, in proportion to them."""
    levels = np.array([5.0, 12.5, 8.75, 15.0, 6.25, 11.25, 7.5, 13.75, 10.0])
    response = repeated(9, seed)
    rng = np.random.default_rng(seed + 50)
    std = NOISE * float(np.sqrt(np.mean(np.abs(mode(F_N, ZETA)) ** 2)))
    noise = std * (rng.normal(size=(9, 101)) + 1j * rng.normal(size=(9, 101))) / np.sqrt(2)
    matrices = np.array([mode(F_N * (1 - 0.2 * ZETA * level / 10), ZETA) for level in levels]) + noise
    fit = fitted(replace(response, repeats=matrices[:, :, None, None], repeat_levels=levels))
    f_n = fit.parameter("f_n")
    assert f_n.repeats.covariate == "level of the force" and f_n.repeats.at == 10.0
    assert f_n.ci95[0] < F_N * (1 - 0.2 * ZETA) < f_n.ci95[1]
    # The scatter about the course is that of the noise alone; without it, that of the levels.
    assert np.ptp(f_n.ci95) < 0.3 * 0.2 * ZETA * F_N
    unknown = fitted(replace(response, repeats=matrices[:, :, None, None]))
    assert np.ptp(unknown.parameter("f_n").ci95) > 2 * np.ptp(f_n.ci95)
    assert any("hold at an r.m.s. of 10 " in text for text in fit.notes)


def test_levels_that_change_nothing_are_no_course() -> None:
    fit = fitted(replace(repeated(9, 7), repeat_levels=np.linspace(5.0, 15.0, 9)))
    assert fit.parameter("f_n").repeats.covariate == "" and fit.parameter("f_n").repeats.at is None


def test_pool_fits_all_of_them_together() -> None:
    response = repeated(6, 4)
    pooled, alone = fitted(response, repeats="pool"), fitted(replace(response, repeats=None, repeat_names=()))
    assert pooled.parameter("f_n") == alone.parameter("f_n") and pooled.parameter("f_n").repeats is None


def test_modes_of_a_repeat_that_shows_fewer_keep_their_numbers() -> None:
    """Two modes, closed form; one sweep of five does not see the first, and has another between them."""
    lines = np.linspace(60.0, 140.0, 401)
    rng = np.random.default_rng(8)

    def of(f_n: float, amount: float) -> np.ndarray:
        w, w_n = 2 * np.pi * lines, 2 * np.pi * f_n
        return amount / (w_n**2 - w**2 + 2j * 0.01 * w_n * w)

    matrices = []
    for amount in (1.0, 1.0, 0.0, 1.0, 1.0):
        h = of(80.0 * np.exp(MOVED * rng.normal()), amount) + of(120.0 * np.exp(MOVED * rng.normal()), 1.5)
        h = h + of(100.0, 1.0 - amount)
        noise = NOISE * np.sqrt(np.mean(np.abs(h) ** 2)) * rng.normal(size=(2, h.size))
        matrices.append((h + noise[0] + 1j * noise[1])[:, None, None])
    response = FrequencyResponse(
        lines,
        np.mean(matrices, axis=0),
        (Port("y", "y", "2"),),
        (Port("f", "f", "1"),),
        covariance=diagonal_covariance(np.var(matrices, axis=0, ddof=1) / 5),
        covariance_dof=4.0,
        averages=5,
        repeats=np.array(matrices),
        repeat_names=tuple(f"sweep {number}" for number in range(1, 6)),
        repeats_are="sweeps",
    )
    (fit,) = identify(response, FitSettings("modal", model_settings=ModalSettings()))
    for truth, used in ((80.0, 4), (120.0, 5)):
        modes = [parameter for parameter in fit.parameters if parameter.name.startswith("f_n_")]
        parameter = min(modes, key=lambda mode: abs(mode.value - truth))
        assert parameter.ci95[0] < truth < parameter.ci95[1] and np.ptp(parameter.ci95) < 1.0
        assert parameter.repeats.used == used


def test_repeats_are_written_and_read(tmp_path: Path) -> None:
    response = replace(repeated(3, 5), repeat_levels=np.array([1.0, 2.0, 3.0]), repeats_are="hits")
    path = tmp_path / "test.frf.parquet"
    write_response(path, response, Header("frf", {}, inputs=()))
    again = read_response(path)
    np.testing.assert_array_equal(again.repeats, response.repeats)
    assert again.repeat_names == response.repeat_names and again.repeats_are == "hits"
    np.testing.assert_array_equal(again.repeat_levels, response.repeat_levels)


@pytest.mark.parametrize("log", [True, False])
def test_what_repeats_leave_open_has_no_interval(log: bool) -> None:
    """A logarithm known to 2.4 +- 800 says nothing of c: exp(710) is not a number any more. Of a number
    that the model error which they share leaves open, their scatter says nothing either.
    """
    damping = Parameter("c", 11.0, "N.s/m", std_error=0.1, ci95=(10.8, 11.2))
    common = replace(damping, std_error=None, ci95=None, fitted=11.0, reason="not determined: other modes")
    mean = RepeatMean(2.4, 800.0 if log else 0.1, 0.1, np.full(2, 0.5), np.zeros(0))
    shared = None if log else common
    of = RepeatValues(np.array([2.3, 2.5]), np.full(2, 1e-4), log=log)
    found = stated_mean(damping, mean, of, shared, 1, Repeats(2, 2, 0.1, ()))
    assert (found.ci95, found.std_error, found.full_error, found.interval) == (None,) * 4
    assert found.reason.startswith("not determined") and found.repeats.used == 2


def test_a_model_error_that_repeats_share_keeps_its_ends() -> None:
    """A damping between a third and six times its value by the fit of all: so it stays where the repeats
    agree to a thousandth. As a share of the value that interval has the half-width 2.8, and e^2.8 is 17.
    """
    mean = RepeatMean(float(np.log(0.03)), 1e-3, 1e-4, np.full(2, 0.5), np.zeros(0))
    pooled = Parameter("zeta_1", 0.03, "1", std_error=1e-5, ci95=(0.03, 0.03))
    common = replace(pooled, ci95=(0.01, 0.18), fitted=0.03, reason="gain curve")
    values = RepeatValues(np.log([0.03, 0.03]), np.full(2, 1e-8), log=True)
    found = stated_mean(pooled, mean, values, common, 100, Repeats(2, 2, 1e-4, ()))
    np.testing.assert_allclose(found.ci95, (0.01, 0.18), rtol=1e-3)


def test_a_gain_of_few_degrees_of_freedom_widens_means_by_student_s_factor() -> None:
    """The gain of the response is known to 5 % by 3 degrees of freedom, six hits scatter in k by .2 %:
    the interval is the expanded one, t(3) = 3.18 times 5 % within 2 %.
    """
    response = repeated(6, 1)
    gain = ChannelUncertainty("gain", Uncertainty("y.gain", 0.05, "1", dof=3.0))
    known = replace(response, outputs=(replace(response.outputs[0], uncertainties=(gain,)),))
    k = fitted(known).parameter("k")
    assert k.repeats.used == 6 and (k.ci95[1] - k.ci95[0]) / 2 == pytest.approx(k.expanded, rel=1e-3)
    assert k.expanded == pytest.approx(3.182 * 0.05 * k.value, rel=0.02)


def test_recordings_of_one_name_are_repeats_as_others_are() -> None:
    """r.csv of three folders: the mean does not ask for names."""
    response = repeated(6, 1)
    alike = fitted(replace(response, repeat_names=("r",) * 6))
    assert alike.parameter("f_n") == fitted(response).parameter("f_n")


@pytest.mark.parametrize("estimator", ["ls", "iv", "amplitude"])
def test_recordings_are_weighted_by_the_noise_of_all(estimator: str) -> None:
    fit = fitted(repeated(6, 1), estimator=estimator, weight="noise")
    assert fit.parameter("f_n").repeats.used == 6
    assert not [finding for finding in fit.findings if finding.code == "repeat-left-out"]


@pytest.mark.parametrize("key", ["bootstrap", "monte_carlo"])
def test_draws_of_one_fit_are_none_of_repeats(key: str) -> None:
    with pytest.raises(SettingError, match=f"'{key}' draws the noise of one fit"):
        fitted(repeated(3, 1), **{key: 200})


def test_groups_without_a_recording_are_not_listed() -> None:
    fit = fitted(repeated(6, 1), repeat_groups=("hit-[123]", "hit-[456]", "tue-*"))
    assert any("in the groups hit-[123], hit-[456], the mean" in text for text in fit.notes)


@pytest.mark.parametrize("keys", [{}, {"repeat_groups": ("hit-[123]", "hit-[456]")}])
def test_a_chosen_peak_is_the_mean_of_repeats_like_a_band(keys: dict[str, object]) -> None:
    """The same fit by other keys; what the FRF says of itself is said once."""
    looped = replace(repeated(6, 1), findings=(Finding("feedback", "fed back"),))
    (peak,) = identify(looped, FitSettings("sdof", peaks=(("x", ((90.0, 110.0),)),), **keys))  # type: ignore[arg-type]
    band = fitted(looped, band=(90.0, 110.0), **keys)
    assert (peak.term, peak.parameters, peak.notes) == ("x", band.parameters, band.notes)
    assert [finding.code for finding in peak.findings].count("feedback") == 1


def test_the_budget_of_repeats_holds_what_they_scatter_by() -> None:
    """A gain +- 1 % beside the scatter of six recordings: k scatters by itself as without the gain, and the
    combined uncertainty is the root of both squares (GUM, eq. 10). f_n knows no gain.
    """
    plain = repeated(6, 1)
    gain = ChannelUncertainty("gain", Uncertainty("cell", 0.01, "1"))
    stated = replace(plain, inputs=(replace(plain.inputs[0], uncertainties=(gain,)),))
    without, fit = fitted(plain), fitted(stated)
    assert fit.budget is not None
    for name, share in (("k", 0.01), ("f_n", 0.0)):
        alone, combined = without.parameter(name), fit.parameter(name)
        assert combined.combined == pytest.approx(np.hypot(alone.full_error, share * alone.value), rel=0.01)
        assert combined.expanded == pytest.approx((combined.ci95[1] - combined.ci95[0]) / 2, rel=0.02)
        assert random_part(fit, combined) == pytest.approx(alone.full_error, rel=1e-6)


@pytest.mark.parametrize(
    ("names", "settings"),
    [
        (("f_n", "zeta"), {}),
        (("f_n_1", "zeta_1"), {"model": "modal", "model_settings": ModalSettings(order=20)}),
    ],
)
def test_noise_that_grows_and_is_shared_by_lines_is_that_of_the_mean(names, settings) -> None:
    """Noise of 3 % of the response, alike on neighbours as by a Hann window: errors of the mean of 6 of f_n
    and zeta are A J^T S J A of least squares over 6, S the noise that was drawn. Of modes J has a residue of
    any phase and residual terms a + b / s^2 as well; their errors were .24 of it.
    """
    base = repeated(6, 0)
    h, shared = mode(F_N, ZETA), np.eye(FREQUENCY.size)
    shared += sum(c * (np.eye(h.size, k=d) + np.eye(h.size, k=-d)) for d, c in ((1, 4 / 9), (2, 1 / 36)))
    rng, root = np.random.default_rng(3), 0.03 * np.abs(h)[:, None] * np.linalg.cholesky(shared)
    drawn = root @ (rng.normal(size=(6, h.size, 1)) + 1j * rng.normal(size=(6, h.size, 1))) / np.sqrt(2)
    matrices = (h[:, None] + drawn)[..., None]
    response = replace(base, matrix=matrices.mean(axis=0), repeats=matrices, line_correlation=(4 / 9, 1 / 36))
    fit = fitted(response, band=(90.0, 110.0), **settings)
    slopes = np.stack(
        [(mode(F_N * (1 + e), ZETA * (1 + g), (1 + m) / MASS) - h) / 1e-6 for e, g, m in 1e-6 * np.eye(3)],
        axis=1,
    )
    if settings:
        of_terms = np.stack([np.abs(h).max() + 0 * h, np.abs(h).max() * (F_N / FREQUENCY) ** 2], axis=1)
        slopes = np.concatenate([slopes, 1j * slopes[:, 2:], of_terms, 1j * of_terms], axis=1)
    jacobian = np.concatenate([slopes.real, slopes.imag])
    gain = np.linalg.pinv(jacobian)
    noise = np.kron(np.eye(2), root @ root.T / 2)
    expected = np.sqrt(np.diag(gain @ noise @ gain.T) / 6)
    found = [fit.parameter(name).std_error / size for name, size in zip(names, (F_N, ZETA), strict=True)]
    np.testing.assert_allclose(found, expected[:2], rtol=0.2)


def test_a_short_sweep_shares_noise_between_lines_as_its_own_zeros_make_it() -> None:
    """Noise of a quarter of a block, zeros after it: lines d apart share sinc(d / 4), whatever those of all
    sweeps together do. Errors of the mean of 24 are A J^T S J A over 24, S the noise that was drawn; by those
    of all they were .47 of it.
    """
    h, lines = mode(F_N, 0.04), np.arange(FREQUENCY.size)
    time, size = np.arange(512) / 512 - 0.5, 0.02 * np.max(np.abs(h)) / np.sqrt(512 / 4)
    waves = np.exp(-2j * np.pi * np.outer(lines, time))[:, np.abs(time) < 1 / 8]
    rng = np.random.default_rng(8)
    drawn = rng.normal(size=(24, waves.shape[1])) + 1j * rng.normal(size=(24, waves.shape[1]))
    matrices = (h + size * drawn / np.sqrt(2) @ waves.T)[:, :, None, None]
    response = replace(
        repeated(24, 0),
        matrix=matrices.mean(axis=0),
        repeats=matrices,
        repeat_shares=np.full(24, 0.25),
        line_correlation=(0.0,) * 8,
    )
    fit = fitted(response, band=(90.0, 110.0))
    moved = (mode(F_N * (1 + e), 0.04 * (1 + g), (1 + m) / MASS) for e, g, m in 1e-6 * np.eye(3))
    slopes = np.stack([(other - h) / 1e-6 for other in moved], axis=1)
    gain = np.linalg.pinv(np.concatenate([slopes.real, slopes.imag]))
    noise = size**2 / 2 * (waves @ waves.conj().T).real
    expected = np.sqrt(np.diag(gain @ np.kron(np.eye(2), noise) @ gain.T) / 24)
    found = [fit.parameter("f_n").std_error / F_N, fit.parameter("zeta").std_error / 0.04]
    np.testing.assert_allclose(found, expected[:2], rtol=0.2)
