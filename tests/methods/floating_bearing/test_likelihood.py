"""V against a plain sum over lines with whole matrices, its gradient and the forms' derivatives against
differences.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import ConfigError, FitError
from labpipe.methods.floating_bearing.forms import FORMS, SYMMETRIES, StiffnessModel, banded_form
from labpipe.methods.floating_bearing.likelihood import ErrorsInVariables, Noise, estimate
from labpipe.methods.floating_bearing.settings import Baseline, Given, balance_of
from labpipe.methods.floating_bearing.stator import stator_of
from labpipe.records.uncertain import Uncertain
from tests.methods.floating_bearing.floating_rig import JOURNAL, SEAL, FloatingRig, complex_normal, kcm

FORM_CASES = [*FORMS.values(), banded_form(np.linspace(20.0, 60.0, 4))]
OMEGA = 2 * np.pi * np.arange(20.0, 60.0, 5.0)


def some_values(model: StiffnessModel, rng: np.random.Generator) -> np.ndarray:
    """Values of the size of a bearing's, shape parameters inside the band."""
    sizes = {"N/m": 1e7, "N.s/m": 1e5, "kg": 30.0}
    linear = [sizes[unit] * rng.normal() for unit in model.units[: model.n_linear]]
    shape = {"tau_r": np.log(4e-3), "f_p": np.log(2 * np.pi * 35.0), "zeta_p": np.log(0.4), "alpha": 0.7}
    return np.array([*linear, *(shape[parameter.name] for parameter in model.form.shape)])


@pytest.mark.parametrize("symmetry", list(SYMMETRIES))
@pytest.mark.parametrize("form", FORM_CASES, ids=lambda form: form.name)
def test_derivatives_of_a_form_are_those_of_central_differences(form, symmetry: str) -> None:
    model = StiffnessModel(form, symmetry)
    values = some_values(model, np.random.default_rng(1))
    exact = model.jacobian(values, OMEGA)
    for number in range(values.size):
        step = np.zeros(values.size)
        step[number] = 1e-5 * max(abs(values[number]), 0.1)
        change = (model.stiffness(values + step, OMEGA) - model.stiffness(values - step, OMEGA)) / (
            2 * step[number]
        )
        assert np.allclose(change, exact[number], rtol=1e-6, atol=1e-6 * np.max(np.abs(exact[number])))


def test_forms_are_those_of_their_formulas() -> None:
    """Element xx by hand at one frequency: H = K + jwC + R, R of each form written out."""
    w, s = OMEGA[2], 1j * OMEGA[2]
    f, zeta, tau = 35.0, 0.4, 4e-3
    pad = (3e6 + 2e4 * s) / (1 + 2 * zeta * s / (2 * np.pi * f) + s**2 / (2 * np.pi * f) ** 2)
    by_hand = {
        "kc": (1e7 + 1e5 * s, [1e7, 1e5]),
        "kcm": (1e7 + 1e5 * s + 20 * s**2, [1e7, 1e5, 20.0]),
        "relaxation": (1e7 + 1e5 * s + 3e6 * s * tau / (1 + s * tau), [1e7, 1e5, 3e6, np.log(tau)]),
        "pad": (1e7 + 1e5 * s + pad, [1e7, 1e5, 3e6, 2e4, np.log(2 * np.pi * f), np.log(zeta)]),
        "rational": (
            1e7 + 1e5 * s + pad + 20 * s**2,
            [1e7, 1e5, 3e6, 2e4, 20.0, np.log(2 * np.pi * f), np.log(zeta)],
        ),
        "fractional": (1e7 + 3e6 * (1j * w / (2 * np.pi)) ** 0.7, [1e7, 3e6, 0.7]),
    }
    for name, (expected, values) in by_hand.items():
        h = StiffnessModel(FORMS[name], "isotropic").stiffness(np.array(values), OMEGA)
        assert h[2] == pytest.approx(expected * np.eye(2), rel=1e-12)


def test_bands_have_names_and_values_of_their_own() -> None:
    model = StiffnessModel(banded_form(np.array([20.0, 40.0, 60.0])), "direct")
    assert model.names == ("k_xx_1", "k_yy_1", "k_xx_2", "k_yy_2", "c_xx_1", "c_yy_1", "c_xx_2", "c_yy_2")
    h = model.stiffness(np.array([1.0, 2, 3, 4, 5, 6, 7, 8]), 2 * np.pi * np.array([20.0, 39.0, 40.0, 60.0]))
    assert h[:, 0, 0].real.tolist() == [1, 1, 3, 3] and h[:, 1, 1].real.tolist() == [2, 2, 4, 4]
    with pytest.raises(ConfigError, match="25 bands are too many"):
        banded_form(np.linspace(20.0, 60.0, 26))


def rig() -> FloatingRig:
    return FloatingRig(kcm(**JOURNAL), frequency=np.arange(20.0, 80.0, 6.0), noise=0.1)


def correlated(rng: np.random.Generator):
    """Spectra whose channels have a full covariance, another one at every line and run."""
    clean, std = rig().clean(), rig().std()
    mixing = std[:, None] * complex_normal(rng, (*clean.shape, 6)) / np.sqrt(6)
    noise = (mixing @ complex_normal(rng, (*clean.shape, 1)))[..., 0]
    return rig().spectra(clean + noise, mixing @ mixing.conj().swapaxes(-1, -2))


BASELINE = Baseline(StiffnessModel(FORMS["kc"], "isotropic"), np.array([1.4e6, 800.0]), ())


@pytest.mark.parametrize("absolute", [False, True])
def test_the_sum_is_that_of_whole_matrices_and_its_gradient_exact(absolute: bool) -> None:
    """METHODS: B = [I, -H, -(M_s I + Z_b / (jw)^2)], V = sum e^H (B C B^H)^-1 e, line by line with numpy's
    solver, for all six channels.
    """
    rng = np.random.default_rng(3)
    spectra = correlated(rng)
    model = StiffnessModel(FORMS["pad"], "none")
    given = Given(Uncertain(60.0), BASELINE, absolute)
    problem = ErrorsInVariables(balance_of(stator_of(spectra, None, (), ()), given), model)
    values = some_values(model, rng)

    def plain(p: np.ndarray) -> float:
        total = 0.0
        omega = 2 * np.pi * spectra.frequency
        h = model.stiffness(p, omega)
        for line, w in enumerate(omega):
            inertia = -(60.0 + (1.4e6 + 800j * w) / (1j * w) ** 2) * np.eye(2)
            motion = (np.zeros((2, 2)), inertia + h[line] / w**2) if absolute else (-h[line], inertia)
            b = np.hstack([np.eye(2), *motion])
            for run in range(2):
                e = b @ spectra.vectors[line, run]
                total += (e.conj() @ np.linalg.solve(b @ spectra.covariance[line, run] @ b.conj().T, e)).real
        return total

    assert problem.chi2(values) == pytest.approx(plain(values), rel=1e-10)
    gradient = 2 * problem.jacobian(values).T @ problem.residual(values)
    for number in range(values.size):
        step = np.zeros(values.size)
        step[number] = 1e-5 * max(abs(values[number]), 0.1)
        assert gradient[number] == pytest.approx(
            (plain(values + step) - plain(values - step)) / (2 * step[number]), rel=2e-5
        )


def test_without_noise_the_truth_comes_out() -> None:
    """Noise of 1e-7: the coefficients to as many digits, on a shaft that moves."""
    quiet = FloatingRig(
        kcm(**SEAL), noise=1e-7, baseline=kcm([[1.4e6, 0], [0, 1.4e6]], [[800.0, 0], [0, 800.0]])
    )
    balance = balance_of(
        stator_of(quiet.draw(np.random.default_rng(1)), None, (), ()), Given(Uncertain(60.0), BASELINE)
    )
    found = estimate(balance, StiffnessModel(FORMS["kcm"], "none"), Noise())
    exact = np.concatenate([np.ravel(SEAL[letter]) for letter in "kcm"])
    assert np.all(np.abs(found.values - exact) < 1e-5 * np.abs(exact)) and found.converged


def test_noise_that_is_not_known_or_hardly_is_refused() -> None:
    spectra = rig().spectra(rig().clean(), np.zeros((10, 2, 6, 6)))
    balance = balance_of(stator_of(spectra, None, (), ()), Given())
    with pytest.raises(FitError, match="noise of the channels is not known"):
        estimate(balance, StiffnessModel(FORMS["kc"], "none"), Noise())
    balance = balance_of(stator_of(rig().draw(np.random.default_rng(1)), None, (), ()), Given())
    with pytest.raises(FitError, match="3 degrees of freedom only"):
        estimate(balance, StiffnessModel(FORMS["kc"], "none"), Noise(3.0))
    with pytest.raises(FitError, match="80 real equations cannot determine 96"):
        estimate(balance, StiffnessModel(banded_form(np.linspace(20.0, 80.0, 13)), "none"), Noise())


def test_corrections_for_a_covariance_from_few_periods() -> None:
    """By hand for nu = 10: 2 V times 10/8 too large, covariance times 100/63."""
    assert Noise(10.0).excess == pytest.approx(1.25) and Noise(10.0).inflation == pytest.approx(100 / 63)
    assert Noise().excess == 1 and Noise(shared=1.9).inflation == 1.9
    # 95 % of F(d1, d2) with d1 = 40: chi-square is rarer at the same value than F with few degrees of
    # freedom.
    assert Noise().p_value(60.0, 40) < Noise(200.0).p_value(60.0, 40) < Noise(6.0).p_value(60.0, 40)
