"""The worked plug-in: its numbers against closed forms, calculations by hand, and truths that its examples
were made with.
"""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from labpipe.errors import ConfigError, DataError
from labpipe.estimation.fitting import identify
from labpipe.estimation.likelihood import maximum_likelihood
from labpipe.estimation.measured import measured_part
from labpipe.estimation.model import Setup
from labpipe.estimation.settings import MODELS, FitSettings
from labpipe.methods.run_ups.records import RunUp
from labpipe.methods.run_ups.rotor import RunUpRotor
from labpipe.methods.run_ups.settings import RunUpSettings
from labpipe.project.rules import Rule
from labpipe.project.scripting import rotor
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit, Goodness
from labpipe.records.recording import Recording
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

ROOT = Path(__file__).parents[2]
SOURCE = Path(__file__).parents[2] / "docs/plugin/src"


@pytest.fixture
def part(monkeypatch: pytest.MonkeyPatch):
    """Import a module of the plug-in."""
    monkeypatch.syspath_prepend(str(SOURCE))

    def load(name: str) -> ModuleType:
        sys.modules.pop(f"labpipe_example.{name}", None)
        return importlib.import_module(f"labpipe_example.{name}")

    return load


def test_the_reader_gives_what_was_stored_in_any_chunks(
    part, tmp_path: Path, rng: np.random.Generator, monkeypatch
) -> None:
    module = part("r16_table")
    samples = rng.integers(-30_000, 30_000, (1000, 2)).astype("<i2")
    channels = [{"name": "f", "unit": "N", "scale": 0.5}, {"name": "y", "unit": "um", "scale": 0.01}]
    path = tmp_path / "a.r16"
    path.write_bytes(json.dumps({"rate_hz": 2000, "channels": channels}).encode() + b"\n" + samples.tobytes())
    monkeypatch.setattr(module, "CHUNK_ROWS", 300)
    table = module.R16Table(path)
    np.testing.assert_allclose(np.concatenate(list(table.chunks(["y", "f"]))), samples[:, ::-1] * [0.01, 0.5])
    assert (table.sample_rate, table.units) == (2000.0, {"f": "N", "y": "um"})


HEAD = b'{"rate_hz": 1, "channels": [{"name": "a", "unit": "V", "scale": 1}]}\n'


@pytest.mark.parametrize(
    ("content", "said"), [(b"no JSON\n12", "does not begin"), (HEAD + b"123", "ends within a sample")]
)
def test_the_reader_refuses_what_it_cannot_read(part, tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "a.r16"
    path.write_bytes(content)
    with pytest.raises(DataError, match=said):
        part("r16_table").R16Table(path)


def test_disturbed_lines_pull_ml_but_not_the_robust_estimator(part, rng: np.random.Generator) -> None:
    """Closed form: the FRF of k = 80 kN/m, c = 40 N s/m, m = 2 kg with 1 % noise. Two of 60 lines are 30 %
    too large.

    Both are below the resonance: one on either side would cancel in k.
    """
    frequency = np.linspace(25, 40, 60)
    omega = 2 * np.pi * frequency
    exact = 1 / (80e3 - 2 * omega**2 + 40j * omega)
    sigma = 0.01 * np.abs(exact)
    noisy = exact + sigma * (rng.normal(size=60) + 1j * rng.normal(size=60)) / np.sqrt(2)
    noisy[[10, 14]] *= 1.3
    ports = (Port("y", "y", "y", np.pi / 2),)
    response = FrequencyResponse(
        frequency, noisy[:, None, None], ports, ports, covariance=(sigma**2 + 0j)[:, None, None]
    )
    measured = measured_part(response, [0], [0], np.full(60, True))
    model = MODELS["sdof"].model(Setup(ports, ports, FitSettings("sdof", mass=2.0)))
    plain, own = maximum_likelihood(measured, model), part("robust").robust(measured, model)
    errors = [abs(estimate.values[0] - 80e3) / np.sqrt(own.covariance[0, 0]) for estimate in (plain, own)]
    assert errors[1] < 2 and errors[0] > 2 * errors[1]
    assert "lines weigh less" in own.notes[-1]
    with pytest.raises(Exception, match="needs the noise"):
        part("robust").robust(replace(measured, covariance=None), model)


def test_the_damper_is_that_of_the_closed_form(part) -> None:
    """By hand at 30 % eccentricity: c = pi mu R (L/c)^3 / (2 (1 - e^2)^1.5) = 24 428 N s/m, k = 2 mu R
    (L/c)^3 w e / (1 - e^2)^2.
    """
    module = part("squeeze_film")
    sizes = {
        "kind": "squeeze-film-damper",
        "diameter": 0.1,
        "length": 0.03,
        "clearance": 1e-4,
        "viscosity": 0.01,
        "frequency": 100.0,
    }
    centred, eccentric = module.coefficients(
        [module.SqueezeFilm(**sizes), module.SqueezeFilm(**sizes, eccentricity=0.3)]
    )
    np.testing.assert_allclose(eccentric.damping, 24428.205 * np.eye(2), rtol=1e-6)
    np.testing.assert_allclose(
        eccentric.stiffness, 27_000 * 2 * np.pi * 100 * 0.3 / 0.91**2 * np.eye(2), rtol=1e-12
    )
    assert not centred.stiffness.any()
    with pytest.raises(ConfigError, match="eccentricity"):
        module.SqueezeFilm(**sizes, eccentricity=1.0)


# The virtual rig.
RIG = {"kind": "virtual-sdof-rig", "mass": 2.0, "stiffness": 80e3, "damping": 40.0}


def recorded(rig_module: ModuleType, seed: int = 1, **changes: object) -> Recording:
    (recording,) = rig_module.recordings(rig_module.VirtualSdofRig(**RIG, **changes), seed, ("multisine",))
    return recording


def test_the_virtual_rig_obeys_its_equation_of_motion(part) -> None:
    """m y'' + c y' + k y = f in the time domain.

    Derivatives by central differences of fourth order, 40 samples per shortest period.
    """
    recording = recorded(part("sdof_rig"), band=(1.0, 25.0), force_noise=0.0, displacement_noise=0.0)
    force, y = recording.samples.T
    rate = recording.sample_rate
    velocity = (8 * (np.roll(y, -1) - np.roll(y, 1)) - np.roll(y, -2) + np.roll(y, 2)) * rate / 12
    acceleration = (
        (16 * (np.roll(y, -1) + np.roll(y, 1)) - np.roll(y, -2) - np.roll(y, 2) - 30 * y) * rate**2 / 12
    )
    np.testing.assert_allclose(
        2.0 * acceleration + 40.0 * velocity + 80e3 * y, force, atol=1e-4 * np.max(np.abs(force))
    )


def test_the_virtual_rig_gives_its_truth_by_hand(part) -> None:
    """w = sqrt(80000 / 2) = 200 rad/s, zeta = 40 / (2 2 200) = 0.05."""
    rig_module = part("sdof_rig")
    truth = rig_module.parameters(rig_module.VirtualSdofRig(**RIG))
    assert truth == pytest.approx({"k": 80e3, "c": 40.0, "m": 2.0, "f_n": 200 / (2 * np.pi), "zeta": 0.05})


def test_the_virtual_rig_draws_its_noise_from_the_seed_and_at_its_level(part) -> None:
    rig_module = part("sdof_rig")
    quiet = recorded(rig_module, force_noise=0.0, displacement_noise=0.0).samples
    noise = recorded(rig_module, force_noise=2e-3, displacement_noise=3e-7).samples - quiet
    np.testing.assert_allclose(np.std(noise, axis=0), [2e-3, 3e-7], rtol=0.05)
    assert np.array_equal(recorded(rig_module).samples, recorded(rig_module).samples)
    assert not np.array_equal(recorded(rig_module).samples, recorded(rig_module, seed=2).samples)
    louder = rig_module.at_level(rig_module.VirtualSdofRig(**RIG), 3.0)
    assert (louder.force_noise, louder.displacement_noise) == pytest.approx((3e-3, 3e-7))


def test_a_fit_of_the_virtual_rig_covers_its_truth(part) -> None:
    response = measure([recorded(part("sdof_rig"))], FrfSettings("periodic", period=2.0))
    (fit,) = identify(response, FitSettings("sdof", mass=2.0, band=(25.0, 40.0)))
    for name, true in {"k": 80e3, "c": 40.0}.items():
        parameter = fit.parameter(name)
        assert abs(parameter.value - true) < 4 * parameter.std_error < 0.01 * true


@pytest.mark.parametrize(("entry", "value"), [("mass", 0.0), ("periods", 1)])
def test_the_virtual_rig_refuses_what_it_cannot_be(part, entry: str, value: float) -> None:
    with pytest.raises(ConfigError, match=r"positive|periods"):
        part("sdof_rig").VirtualSdofRig(**{**RIG, entry: value})


# The run-up method.
@pytest.fixture(scope="module")
def film() -> RunUpRotor:
    return replace(rotor(ROOT / "configs/rotors/falah.yaml"), speeds=(50.0, 300.0))


def run_up(
    rig: RunUpRotor, load: float, factors: np.ndarray, rng: np.random.Generator | None = None
) -> RunUp:
    """The response with the start coefficients times *factors* (8,), with 1 % and 1 deg of noise where there
    is a generator.
    """
    speed = np.linspace(60.0, 280.0, 30)
    stiffness, damping = rig.start_coefficients(load, speed)
    split = factors.reshape(2, 2, 2)
    exact = (
        rig.condense(speed, rig.known_unbalance)
        .response(split[0] * stiffness, split[1] * damping)
        .reshape(30, 2, 2)
    )
    turn = 0.0 if rng is None else rng.normal(0, np.radians(1), exact.shape)
    size = 1.0 if rng is None else 1 + rng.normal(0, 0.01, exact.shape)
    errors = {"amplitude_error": 0.01 * np.abs(exact), "phase_error": np.full(exact.shape, np.radians(1))}
    return RunUp(
        f"{load:g} N",
        load,
        speed,
        rig.plane_names,
        exact * size * np.exp(1j * turn),
        **errors,
        unbalance=rig.known_unbalance,
    )


@pytest.mark.parametrize("true", [0.6, 1.0, 1.7])
def test_the_common_factor_is_recovered_to_rounding_without_noise(
    part, film: RunUpRotor, true: float
) -> None:
    fit = part("common_factor").fit_common_factor(
        film, [run_up(film, load, np.full(8, true)) for load in (4.0, 9.0)]
    )
    assert fit.factor == pytest.approx(true, rel=1e-8)
    assert fit.chi2 < 1e-9 and fit.n_datum == 2 * 30 * 8


def test_the_standard_error_is_that_of_the_sum_of_squares(part, film: RunUpRotor) -> None:
    """One standard error from the minimum, chi-square has risen by one: by the sum of squares itself, no
    slope is used.
    """
    module = part("common_factor")
    runs = [run_up(film, 5.0, np.full(8, 1.2))]
    fit = module.fit_common_factor(film, runs)
    groups = module.runs_by_load(film, runs)
    for sign in (-1, 1):
        residual, _ = module.residual_and_slope(
            film, groups, float(np.log(fit.factor + sign * fit.std_error))
        )
        assert residual @ residual == pytest.approx(1.0, rel=0.03)


def test_the_common_factor_scatters_as_its_standard_error_says(part, film: RunUpRotor) -> None:
    module = part("common_factor")
    fits = [
        module.fit_common_factor(film, [run_up(film, 5.0, np.full(8, 1.2), np.random.default_rng(seed))])
        for seed in range(60)
    ]
    deviations = np.array([(fit.factor - 1.2) / fit.std_error for fit in fits])
    # 60 draws of a normal distribution: their mean within 4 / sqrt(60), their rms within 4 / sqrt(120) of
    # one.
    assert abs(np.mean(deviations)) < 0.52 and abs(np.sqrt(np.mean(deviations**2)) - 1) < 0.37


def test_one_factor_that_is_not_enough_is_rejected_and_has_no_errors(part, film: RunUpRotor) -> None:
    module = part("common_factor")
    settings = RunUpSettings(rotor="r.yaml", runs=({"file": "a.csv"},), rig=film)
    factors = {
        "not rejected": np.full(8, 1.2),
        "rejected": np.array([1.2, 1.2, 1.2, 0.7, 1.2, 1.2, 1.2, 0.8]),
    }
    rng = np.random.default_rng(5)
    for verdict, eight in factors.items():
        run = run_up(film, 5.0, eight, rng)
        solved = module.solve_common_factor(film, [run], settings)
        (factor,) = solved.method.parameters
        at_load = solved.predictor(film, run)
        assert solved.method.verdict == verdict and (solved.method.chi2_p < 1e-3) == (verdict == "rejected")
        errors = (factor.std_error, factor.ci95, at_load.std_error, at_load.critical, at_load.threshold)
        assert [error is None for error in errors] == [verdict == "rejected"] * 5


def test_the_common_factor_predicts_any_run(part, film: RunUpRotor) -> None:
    """Closed form: coefficients and their errors are the factor, and its error, times the rotor file's."""
    settings = RunUpSettings(rotor="r.yaml", runs=({"file": "a.csv"},), rig=film)
    solved = part("common_factor").solve_common_factor(film, [run_up(film, 5.0, np.full(8, 1.2))], settings)
    other = run_up(film, 12.0, np.full(8, 1.2))
    at_load = solved.predictor(film, other)
    stiffness, damping = film.start_coefficients(12.0, other.speed)
    start = np.concatenate([stiffness.reshape(-1, 4), damping.reshape(-1, 4)], axis=1)
    np.testing.assert_allclose(at_load.coefficients, 1.2 * start, rtol=1e-7)
    np.testing.assert_allclose(at_load.std_error, solved.anywhere.std_error * np.abs(start), rtol=1e-12)
    critical, threshold = at_load.critical(""), at_load.threshold()
    true = lambda speed: tuple(1.2 * part for part in film.start_coefficients(12.0, speed))  # noqa: E731
    assert critical.value == pytest.approx(film.critical_speed(true), rel=1e-6) and critical.std_error > 0
    assert threshold.value == pytest.approx(film.threshold(true), rel=1e-6) and threshold.std_error > 0


# The section.
def fit_of(name: str, *modes: tuple[float, float], test: str = "") -> Fit:
    """A fit with modes (natural frequency [Hz], damping ratio), the frequencies known to 0.5 Hz."""
    many = len(modes) > 1
    pairs = [(f"_{n}" if many else "", *mode) for n, mode in enumerate(modes, 1)]
    parameters = [
        parameter
        for end, f, zeta in pairs
        for parameter in (
            Parameter(f"f_n{end}", f, "Hz", std_error=0.5),
            Parameter(f"zeta{end}", zeta, "1", std_error=0.001),
        )
    ]
    return Fit(
        name,
        "sdof",
        "ml",
        band_hz=(1.0, 2.0),
        lines=1,
        equations=1,
        dof=1,
        gof=Goodness(1.0, 1.0),
        parameters=tuple(parameters),
        condition_number=1.0,
        correlation=np.eye(1),
        test=test,
    )


def margin(module: ModuleType, frequency: float, ratio: float, order: float):
    fit = fit_of("a", (frequency, ratio))
    ((f_n, zeta),) = module.natural_frequencies(fit)
    return module.margin_of(fit, f_n, zeta, order, (40.0, 50.0))


@pytest.mark.parametrize(
    ("frequency", "ratio", "order", "expected", "error", "required"),
    [
        # zeta 0.01: AF = 50, 17 (1 - 1 / 48.5) = 16.6495 %: below the speeds at most 16 %, above 26.6495 %,
        # at most 26 %.
        (60.0, 0.01, 1.0, 0.2, 0.5 / 50, 0.26),
        (30.0, 0.01, 1.0, 0.25, 0.5 / 40, 0.16),
        (60.0, 0.01, 2.0, 0.25, 0.5 / 80, 0.16),
        (45.0, 0.01, 1.0, 0.0, None, 0.16),
        # zeta 0.1: AF = 5, 17 (1 - 1 / 3.5) = 12.142857 %.
        (60.0, 0.1, 1.0, 0.2, 0.5 / 50, 0.22142857),
        (30.0, 0.1, 1.0, 0.25, 0.5 / 40, 0.12142857),
        # zeta 0.21: AF = 2.38, critically damped.
        (45.0, 0.21, 1.0, 0.0, None, 0.0),
    ],
)
def test_margins_by_hand(
    part, frequency: float, ratio: float, order: float, expected: float, error: float | None, required: float
) -> None:
    """At 40 to 50 Hz: distance to the nearer end of the order's band over that end."""
    one = margin(part("separation"), frequency, ratio, order)
    assert (one.margin, one.required) == (pytest.approx(expected), pytest.approx(required, rel=1e-6))
    assert one.std_error == (None if error is None else pytest.approx(error))
    assert one.kept == (expected >= required)


def test_every_mode_of_every_fit_is_held_against_every_order(part) -> None:
    module = part("separation")
    assert [f.name for f, _ in module.natural_frequencies(fit_of("a", (10.0, 0.1), (20.0, 0.1)))] == [
        "f_n_1",
        "f_n_2",
    ]
    calibration = replace(fit_of("line", (1.0, 0.1)), parameters=(Parameter("slope", 1.0, "1"),))
    assert not list(module.natural_frequencies(calibration))
    assert [zeta.name for _, zeta in module.natural_frequencies(fit_of("a", (10.0, 0.1)))] == ["zeta"]


@pytest.mark.parametrize(
    "entries", [{"speeds": (0.0, 50.0)}, {"speeds": (40.0, 50.0), "orders": (1.0, -1.0)}]
)
def test_the_section_refuses_impossible_settings(part, entries: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match="above zero"):
        part("separation").SeparationSettings(**entries)


def compare(rule: Rule, value: float | None, unit: str) -> tuple[float | None, bool]:
    """Rules of this file are bounds from below, in parts of one."""
    assert (rule.kind, unit) == (">=", "1")
    return value, value is not None and value >= float(rule.bound)


@pytest.fixture
def two_tests(part):
    """One mode of two tests at 40 to 50 Hz, once the speed: 60 Hz is 20 % away, 65 Hz is 30 %.

    Zeta 0.1 asks for 22.1 %.
    """
    module = part("separation")
    fits = [fit_of("a", (60.0, 0.1), test="cold"), fit_of("a", (65.0, 0.1), test="warm")]
    margins = [
        module.margin_of(fit, *mode, 1.0, (40.0, 50.0))
        for fit in fits
        for mode in module.natural_frequencies(fit)
    ]
    return module, module.Separation((40.0, 50.0), tuple(margins))


@pytest.mark.parametrize(
    ("which", "item", "bound", "found", "passed"),
    [
        ("", "a.f_n.1x", "0.25", 0.2, False),
        ("", "a.f_n.1x", "0.15", 0.2, True),
        ("warm", "a.f_n.1x", "0.25", 0.3, True),
        ("cold", "a.f_n.1x", "0.25", 0.2, False),
        ("", "least", "0.25", 0.2, False),
        ("warm", "least", "0.25", 0.3, True),
    ],
)
def test_a_rule_holds_for_every_test_or_for_the_one_in_brackets(
    two_tests, which, item, bound, found, passed
) -> None:
    module, record = two_tests
    address, place = f"separation.{item}", "p.yaml:1:1"
    rule = Rule(
        section="expect",
        address=address,
        fit="separation",
        which=which,
        item=item,
        kind=">=",
        bound=bound,
        place=place,
    )
    outcome = module.outcome(rule, record, compare)
    assert (outcome.value, outcome.passed) == (pytest.approx(found), passed)


def test_a_missed_margin_is_a_warning_in_report_and_terminal(two_tests) -> None:
    module, record = two_tests
    assert [finding.message for _, finding in module.findings(record)] == [
        "a.f_n.1x: 20.0 % where 22.1 % are required."
    ]
    ((verdict, table),) = [section.blocks for section in module.report(record, None)]
    assert (verdict.kind, verdict.text) == ("failed", "Separation margins are missed.")
    # The error of 0.5 Hz over the 50 Hz of the nearer end.
    assert [row[-3:] for row in table.rows] == [("20.0 ± 1", "22.1", "no"), ("30.0 ± 1", "22.1", "yes")]
    assert [line.rpartition(": ")[2] for line in module.terminal(record)][1:] == ["MISSED", "kept"]


def test_margins_are_listed_by_fit_and_test_with_their_errors(two_tests) -> None:
    module, record = two_tests
    listed = [
        (one.fit, one.test, one.parameter.name, one.parameter.value, one.parameter.std_error)
        for one in module.parameters(record)
    ]
    name = ("separation.a", "margin_1x")
    assert listed == [
        (name[0], "cold", name[1], pytest.approx(0.2), pytest.approx(0.01)),
        (name[0], "warm", name[1], pytest.approx(0.3), pytest.approx(0.01)),
    ]


@pytest.mark.parametrize(
    ("group", "name"),
    [
        ("bearing", "ball-bearing"),
        ("plan", "run-ups"),
        ("damping_law", "hysteretic"),
        ("section", "calibrate"),
    ],
)
def test_the_page_names_the_class_of_an_entry(group: str, name: str) -> None:
    """What stands in a group of `entry_points.txt` is an instance of the class on its row of the page."""
    target = next(
        point.load()
        for point in entry_points(group=f"labpipe.{group}", name=name)
        if "labpipe." in point.value
    )
    page = (ROOT / "docs/pages/extend/reader.md").read_text("utf-8")
    (row,) = (line for line in page.splitlines() if f"| `labpipe.{group}` |" in line)
    assert f"`{type(target).__name__}`" in row
