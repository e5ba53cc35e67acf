"""Every key of a fit with every model: it changes what is found, or it is refused at its line with the models
that take it.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labpipe.errors import ConfigError, ConfigErrors, LabpipeError
from labpipe.estimation.budget import with_repeat_sources
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import ESTIMATORS, MODELS, FitSettings, estimator_of, model_kind, takers
from labpipe.methods.magnetic_bearing.settings import BlockSettings, MagnetSettings
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.work import fits_of
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.uncertain import RepeatSource
from tests.estimation.conftest import FX, FY, X, Y, with_noise
from tests.estimation.test_base_motion import LINES, response as of_base
from tests.methods.floating_bearing.test_fit import drawn, settings_of
from tests.methods.magnetic_bearing.levitated import COUPLED
from tests.methods.magnetic_bearing.test_block import response as of_block
from tests.methods.ring_down.test_fit import linear
from tests.methods.wear.worn_cases import fit_settings, measured, worn_rig

LINEAR = tuple(model for model in MODELS if model_kind(model).equations is not None)


def uncoupled(damping: float, std: float = 1e-7) -> FrequencyResponse:
    """0.92 kg on 180 and 213 kN/m in x and y, 120 N s/m in x and *damping* in y, uncoupled: several
    coefficients are zero.
    """
    frequency = np.arange(40.0, 121.0)
    w = 2 * np.pi * frequency[:, None, None]
    matrix = np.linalg.inv(
        np.diag([180e3, 213e3]) + 1j * w * np.diag([120.0, damping]) - w**2 * 0.92 * np.eye(2)
    )
    return with_noise(frequency, matrix, (X, Y), (FX, FY), std, np.random.default_rng(7))


def among_others() -> FrequencyResponse:
    """The same with modes at 36 and 124 Hz, beside the lines: more than one term to either side."""
    whole = uncoupled(80.0)
    w = 2 * np.pi * whole.frequency[:, None, None]
    others = sum(1 / (0.92 * ((2 * np.pi * f) ** 2 - w**2)) for f in (36.0, 124.0))
    return replace(whole, matrix=whole.matrix + others * np.eye(2))


def hardly_damped() -> np.ndarray:
    """Transmissibility of 2 kg on 128 kN/m, between lines, with a damping that noise hides."""
    w = 2 * np.pi * LINES
    stiffness = 128e3 + 1e-4j * w
    return np.asarray(stiffness / (stiffness - 2 * w**2))


# What each model is fitted to, and settings with which it can be.
ONE_MASS, TWO_MASSES = {"mass": "0.92 kg +- 1 %"}, {"mass": ("0.92 kg", "0.92 kg")}
CASES: dict[str, tuple[Callable[[], Any], Callable[[], FitSettings]]] = {
    "sdof": (lambda: uncoupled(0.0), lambda: FitSettings("sdof", input="fy", output="y", **ONE_MASS)),
    "rotor-2dof": (lambda: uncoupled(0.0), lambda: FitSettings("rotor-2dof", **ONE_MASS)),
    "rotor-2dof-direct": (lambda: uncoupled(0.0), lambda: FitSettings("rotor-2dof-direct", **ONE_MASS)),
    "mdof": (lambda: uncoupled(0.0), lambda: FitSettings("mdof", **ONE_MASS)),
    "base": (lambda: of_base(hardly_damped(), 1e-3, seed=2), lambda: FitSettings("base", mass="2 kg +- 1 %")),
    "modal": (among_others, lambda: FitSettings("modal")),
    "decay": (linear, lambda: FitSettings("decay")),
    "dynamic-stiffness": (
        drawn,
        lambda: settings_of(form="kcm", baseline_stiffness="1.35 MN/m", baseline_damping="800 N.s/m"),
    ),
    "magnet": (COUPLED.spectra, lambda: FitSettings("magnet", mass=4.0, model_settings=MagnetSettings())),
    "block": (lambda: of_block(1, 0.01), lambda: FitSettings("block", model_settings=BlockSettings("1"))),
    "worn-bearing": (lambda: measured(worn_rig(22.27, 11.0), 0.02, np.random.default_rng(3)), fit_settings),
}
# A value of each key as it is written, and as settings hold it; by the model where they differ.
WRITTEN = {
    "mass": "0.5 kg",
    "estimator": "ls",
    "input": "[other]",
    "output": "[other]",
    "band": "50-70 Hz",
    "bands": "[50-70 Hz, 80-100 Hz]",
    "peaks": "{y: [60-90 Hz]}",
    "sliding": "{width: 30 Hz, step: 20 Hz}",
    "subtract": "{stiffness: 10 kN/m}",
    "share": "2",
    "eliminate": "true",
    "symmetric": "true",
    "lumped_mass": "true",
    "scale_mass": "true",
    "residuals": "true",
    "relative": "true",
    "damping": "hysteretic",
    "fixed": "{c: 1 N.s/m}",
    "tied": "[[k_xx, k_yy]]",
    "weight": "noise",
    "bootstrap": "60",
    "coverage": "90 %",
    "monte_carlo": "200",
    "compare": "true",
    "test": "[other]",
    "repeats": "pool",
    "repeat_groups": "[a*, b*]",
}
VALUES: dict[str, Any] = {
    "bands": ("50-70 Hz", "80-100 Hz"),
    "input": ("other",),
    "output": ("other",),
    "peaks": (("y", ((60.0, 90.0),)),),
    "sliding": {"width": "30 Hz", "step": "20 Hz"},
    "subtract": {"stiffness": "10 kN/m"},
    "fixed": (("c", 1.0),),
    "tied": (("k_xx", "k_yy"),),
    **dict.fromkeys(
        ("eliminate", "symmetric", "lumped_mass", "scale_mass", "relative", "compare", "residuals"), True
    ),
    **{key: int(WRITTEN[key]) for key in ("share", "bootstrap", "monte_carlo")},
}
OF_MODEL: dict[tuple[str, str], Any] = {
    ("base", "band"): "20-60 Hz",
    ("base", "bands"): ("20-50 Hz", "30-60 Hz"),
    ("decay", "band"): "35-45 Hz",
    ("block", "band"): "20-1000 Hz",
    ("block", "bands"): ("20-1000 Hz", "20-2000 Hz"),
    ("worn-bearing", "band"): "10-80 Hz",
    ("mdof", "tied"): (("k_x_x", "k_y_y"),),
    ("rotor-2dof", "fixed"): (("c_xx", 1.0),),
    ("rotor-2dof-direct", "fixed"): (("c_xx", 1.0),),
    ("mdof", "fixed"): (("c_x_x", 1.0),),
}
# What else a key needs to have a meaning.
BESIDE: dict[str, dict[str, Any]] = {
    "weight": {"estimator": "ls"},
    "lumped_mass": {"mass": "estimate"},
    "residuals": {"mass": "estimate"},
    "peaks": {"input": (), "output": ()},
}
PAIRS = list(itertools.product(MODELS, WRITTEN))


@functools.cache
def data_of(model: str) -> Any:
    return CASES[model][0]()


@functools.cache
def numbers(settings: FitSettings) -> tuple[Any, ...]:
    """All that a fit reports in numbers; where it is not possible, why."""
    try:
        fits = identify(data_of(settings.model), settings, judging=False)
    except LabpipeError as error:
        return (error.what,)
    return tuple(
        (
            fit.band_hz,
            [(p.name, p.value, p.std_error, p.systematic, p.ci95, p.expanded) for p in fit.parameters],
            [(candidate.name, candidate.chi2) for candidate in fit.candidates],
            None if fit.budget is None or fit.budget.drawn is None else fit.budget.drawn.tolist(),
        )
        for fit in fits
    )


def repeated(model: str, coverage: float) -> list[float | None]:
    """Expanded uncertainties of a fit with scatter between repeats: that, if nothing else, is stated with the
    fit's coverage.
    """
    settings = replace(CASES[model][1](), coverage=coverage)
    fit = identify(data_of(model), settings, judging=False)[0]
    source = RepeatSource("remounting", next(p.name for p in fit.parameters if p.std_error is not None), 0.01)
    return [p.expanded for p in with_repeat_sources(fit, [source], "", {}, settings.coverage).parameters]


def takes(model: str, key: str) -> bool:
    if key == "estimator":
        return model in LINEAR or WRITTEN[key] in model_kind(model).estimators
    return model in takers(key)


def test_every_key_and_model_is_walked() -> None:
    assert {*WRITTEN, "model"} == {field.name for field in fields(FitSettings) if "setting" in field.metadata}
    assert set(CASES) == set(MODELS)


# What these do needs several tests, or several recordings, and is shown where those are.
OF_REPEATS = ("test", "coverage", "repeats", "repeat_groups")


@pytest.mark.parametrize(
    ("model", "key"), [pair for pair in PAIRS if takes(*pair) and pair[1] not in OF_REPEATS]
)
def test_a_key_that_is_taken_changes_what_is_found(model: str, key: str) -> None:
    plain = replace(CASES[model][1](), **BESIDE.get(key, {}))
    changed = replace(plain, **{key: OF_MODEL.get((model, key), VALUES.get(key, WRITTEN[key]))})
    assert repr(numbers(changed)) != repr(numbers(plain))


@pytest.mark.parametrize("model", tuple(MODELS))
def test_every_model_states_its_coverage(model: str) -> None:
    assert repeated(model, 0.90) != repeated(model, 0.95)


@pytest.mark.parametrize("model", tuple(MODELS))
def test_other_tests_than_those_named_are_not_fitted(model: str) -> None:
    assert fits_of([data_of(model)], replace(CASES[model][1](), test=("other",)), Path("p.yaml")) == []


RIG = (
    "name: R\nsample_rate: 1 kHz\nmass: 2 kg\nchannels:\n  f: {quantity: force}\n  x: {quantity: "
    "displacement}\n"
)
FRF = {"decays": "{excitation: decay}", "spectra": "{excitation: periodic, period: 1 s, result: spectra}"}


def written(folder: Path, model: str, key: str, more: str = "") -> Path:
    """A pipeline whose last line is the key, in a fit of that model."""
    (folder / "rig.yaml").write_text(RIG)
    (folder / "a.csv").write_text("f,x\n1,2\n")
    kind = model_kind(model)
    rotor = Path(__file__).parents[2] / "configs/rotors/mendes.yaml"
    section = "" if kind.settings is None or kind.optional else f"    {kind.section}: {{rotor: {rotor}}}\n"
    head = (
        "rig: rig.yaml\nrecordings: a.csv\nfrf: "
        f"{FRF.get(kind.of, '{excitation: periodic, period: 1 s}')}\nidentify:\n  a:\n"
    )
    path = folder / "p.yaml"
    path.write_text(f"{head}    model: {model}\n{section}{more}    {key}: {WRITTEN[key]}\n")
    return path


@pytest.mark.parametrize(("model", "key"), [pair for pair in PAIRS if not takes(*pair)])
def test_a_key_that_is_not_taken_is_refused_at_its_line(model: str, key: str, tmp_path: Path) -> None:
    path = written(tmp_path, model, key)
    line = len(path.read_text().splitlines())
    with pytest.raises(ConfigErrors) as refused:
        load_pipeline(path)
    (fault,) = refused.value.faults
    assert str(fault).startswith(f"{path}:{line}:5: identify.a.{key}: ")
    if key == "estimator":
        assert (
            "does not estimate model" in fault.what
            and fault.hint == f"estimator: {model_kind(model).estimators[0]}"
        )
    else:
        assert fault.what.endswith(f"is not for model {model}") and fault.hint.endswith(
            f"models that take it: {', '.join(takers(key))}"
        )
    with pytest.raises(ConfigError):
        replace(CASES[model][1](), **{key: VALUES.get(key, WRITTEN[key])})


@pytest.mark.parametrize("model", tuple(MODELS))
def test_defaults_that_are_written_out_are_taken(model: str) -> None:
    plain = CASES[model][1]()
    defaults = {
        field.name: field.default for field in fields(plain) if field.name in WRITTEN and field.name != "mass"
    }
    assert replace(plain, **{**defaults, "input": plain.input, "output": plain.output}) == plain


@pytest.mark.parametrize(
    ("estimator", "key"), [(name, key) for name in ESTIMATORS for key in estimator_of(name).refuses]
)
def test_a_key_that_an_estimator_has_no_use_for_is_refused_at_its_line(
    estimator: str, key: str, tmp_path: Path
) -> None:
    model = "sdof" if estimator_of(estimator).one_frf else "mdof"
    path = written(tmp_path, model, key, f"    estimator: {estimator}\n")
    with pytest.raises(
        ConfigErrors, match=f"'{key}' is not for (estimator {estimator}|model {model}); leave it out"
    ) as refused:
        load_pipeline(path)
    assert f"{path}:8:5: identify.a.{key}: " in str(refused.value)


@pytest.mark.parametrize(
    ("model", "keys", "message"),
    [
        ("mdof", {"lumped_mass": True}, "'lumped_mass' is for a mass that is estimated; mass: estimate"),
        ("base", {"mass": "estimate", "uncertainties": (), "share": 2}, "'share' needs the mass"),
        (
            "base",
            {"mass": "estimate", "uncertainties": (), "subtract": {"damping": "1 N.s/m"}},
            "'subtract' needs the mass",
        ),
        (
            "sdof",
            {"mass": 0.92, "uncertainties": (), "monte_carlo": 200},
            "'monte_carlo' has nothing to draw",
        ),
        ("modal", {"mass": ("1 kg", "2 kg")}, "a modal fit takes one mass"),
        (
            "sdof",
            {"damping": "hysteretic", "subtract": {"damping": "1 N.s/m"}},
            "'subtract' cannot be combined with hysteretic damping",
        ),
        ("sdof", {"share": 0}, "'share' must be at least 1"),
        ("sdof", {"sliding": {"width": 5.0, "step": 0.0}}, "step must be positive"),
    ],
)
def test_keys_that_change_nothing_beside_others_are_refused(
    model: str, keys: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        identify(data_of(model), replace(CASES[model][1](), **keys))


def test_a_mode_seen_from_another_point_takes_support_and_share() -> None:
    seen = replace(data_of("sdof"), outputs=(Port("q", "q", "1"), Y), inputs=(Port("f", "f", "3"), FY))
    plain = FitSettings("sdof", input="f", output="q")
    (whole,) = identify(seen, plain)
    (shared,) = identify(seen, replace(plain, share=2))
    assert "modal_constant_quadrature" in {p.name for p in whole.parameters}
    assert shared.parameter("k").value == pytest.approx(shared.parameter("k_total").value / 2, rel=1e-12)
