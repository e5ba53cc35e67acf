"""Worlds of comparisons of tests: one truth behind all of them, every test at the condition that it really
had.

Behind a ratio to a theory stands the bending shaft on a multiple of the bearing's stiffness; behind trends
and differences a power law of stiffness and damping over the condition; behind repeats one stiffness, with a
part of its own in every setting. All of it is computed forward from the true numbers; the comparison gets the
numbers that are written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.methods.rolling_bearing.loads import DOFS, transfer_matrix
from labpipe.methods.rolling_bearing.ratio import theory_of
from labpipe.project.pipeline_file import Pipeline
from labpipe.records.comparison import Comparison
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit
from labpipe.records.uncertain import Uncertainty
from labpipe.spectra.convert import receptance_factor
from labpipe.uncertainty.compare import Evidence, compare
from labpipe.uncertainty.observations import condition_of
from labpipe.uncertainty.settings import CompareSettings, TheorySettings
from tests.draws.cases import Case, cases_of_fit, measured_tests
from tests.draws.usual import Errors

KINDS = ("trend", "difference", "repeatability", "ratio", "rayleigh", "bands")
# Scatter of the stiffness between settings, relative, as that of the rig behind the sample recordings.
BETWEEN = 0.0037
# First of the bearing's dofs that are tilts.
TILTS = 3

# The receptance [m/N] (n_line,) of one test in a world.
Truth = Callable[[Errors], np.ndarray]


@dataclass(frozen=True)
class Tested:
    """One fit of one test, and the *truth* behind it, which is that of its own worlds where there is none."""

    case: Case
    truth: Truth | None

    def fitted(self, errors: Errors, rng: np.random.Generator | None) -> Fit:
        return self._in_world(errors).fitted(errors, rng, ())[0]

    def response(self, errors: Errors) -> Any:
        """What the comparison asks of a test's response: lines, ports, weights, conditions."""
        return replace(self._in_world(errors).worlds.response, name=self.case.test)

    def _in_world(self, errors: Errors) -> Case:
        if self.truth is None:
            return self.case
        worlds = self.case.worlds
        response = worlds.response
        curve = self.case.fit.curve
        row = [port.label for port in response.outputs].index(curve.outputs[0])
        column = [port.label for port in response.inputs].index(curve.inputs[0])
        matrix = response.matrix.copy()
        matrix[:, row, column] = self.truth(errors) * receptance_factor(response.form, response.frequency)
        return replace(self.case, worlds=replace(worlds, response=replace(response, matrix=matrix)))


@dataclass(frozen=True)
class Question:
    """Comparisons of one fit and term, which have their tests in common."""

    settings: tuple[CompareSettings, ...]
    tested: tuple[Tested, ...]
    folder: Path

    def amounts(self, errors: Errors, rng: np.random.Generator | None) -> dict[str, Parameter]:
        found: dict[str, Parameter] = {}
        for one in self.answers(errors, rng):
            found |= {f"{one.name}.{amount.name}": amount for amount in one.amounts}
            found |= {
                f"{one.name}.{band.parameter}[{np.mean(band.band_hz):g} Hz].ratio": _ratio_of(band)
                for band in one.bands
            }
        return found

    def answers(self, errors: Errors, rng: np.random.Generator | None) -> list[Comparison]:
        """All comparisons in one world; repeats of tests without noise do not scatter and have none."""
        fits = tuple(one.fitted(errors, rng) for one in self.tested)
        settings = tuple(
            {fit.name: one.case.settings for one, fit in zip(self.tested, fits, strict=True)}.values()
        )
        responses = {one.case.test: one.response(errors) for one in self.tested}
        evidence = Evidence(fits, tuple(responses.values()), settings)
        chosen = [one for one in self.settings if rng is not None or one.kind != "repeatability"]
        return [compare(one, evidence, self._theory(one)) for one in chosen]

    def truths(self) -> dict[str, float]:
        """The true amounts: those of a world without errors.

        Of repeats those that the worlds are made with.
        """
        found = {name: one.value for name, one in self.amounts(Errors(), None).items()}
        for one in self.settings:
            if one.kind == "repeatability":
                fits = [tested.fitted(Errors(), None) for tested in self.tested]
                mean = fits[0].parameter(one.parameter).value
                noise = [fit.parameter(one.parameter).std_error for fit in fits]
                found[f"{one.name}.mean"] = mean
                if one.parameter == "k":
                    # Of damping a delay is followed by every test with other weights, and repeats scatter by
                    # more than their noise.
                    within = float(np.sqrt(np.mean(np.square(noise))))
                    found |= {f"{one.name}.within": within, f"{one.name}.between": BETWEEN * mean}
        return found

    def _theory(self, settings: CompareSettings) -> Any:
        return None if settings.theory is None else _theory(self.folder, settings.theory)


def _ratio_of(band: Any) -> Parameter:
    low, high = band.ratio_ci95
    return Parameter("ratio", band.ratio, "1", std_error=(high - low) / (2 * 1.959964), ci95=(low, high))


@cache
def _theory(folder: Path, settings: TheorySettings) -> Any:
    """The theory over the condition, each condition computed once."""
    return cache(theory_of(folder, settings))


def questions_of(pipeline: Pipeline, most: int = 1000) -> list[Question]:
    """The comparisons of a pipeline that rest on fits, by fit and term; of sliding bands at most *most*."""
    chosen = [one for one in pipeline.sections.get("compare", ()) if one.kind in KINDS]
    if not chosen:
        return []
    tests = {test.name: test for test in measured_tests(pipeline)}
    groups: dict[tuple[str, str], list[CompareSettings]] = {}
    for one in chosen:
        groups.setdefault((one.fit, one.term), []).append(one)
    questions = []
    for (name, term), settings in groups.items():
        fit_settings = next(one for one in pipeline.fits if one.name == name)
        of_bands = settings[0].kind == "bands"
        cases = [
            case
            for test in tests.values()
            for case in cases_of_fit(fit_settings, [test], most if of_bands else 1000)
            if case.term == term
        ]
        truths = _truths(settings, cases, tests, pipeline.folder)
        tested = tuple(Tested(case, truth) for case, truth in zip(cases, truths, strict=True))
        questions.append(Question(tuple(settings), tested, pipeline.folder))
    return questions


def _truths(
    settings: Sequence[CompareSettings], cases: Sequence[Case], tests: Mapping[str, Any], folder: Path
) -> list[Truth | None]:
    first = settings[0]
    if first.kind == "bands":
        return _of_first_test(cases)
    theory = next((one for one in settings if one.theory is not None), None)
    if first.kind == "repeatability":
        groups = [tests[case.test].conditions[first.group] for case in cases]
        return _of_settings(cases, [f"setting {group}" for group in groups])
    setting_error = max(one.setting_error for one in settings)
    pairs = [condition_of(first.condition, case.test, tests[case.test].conditions) for case in cases]
    if theory is not None:
        return _of_theory(settings, cases, pairs, folder, setting_error)
    return _of_law(cases, np.array([value for value, _ in pairs]), setting_error)


def _true_factor(case: Case, setting_error: float, errors: Errors) -> float:
    """True condition over the one that was set."""
    return 1 + errors.of(Uncertainty(f"condition of {case.test}", setting_error, "1"))


def _of_first_test(cases: Sequence[Case]) -> list[Truth | None]:
    """Every band as in the first test that has it: the tests do not differ."""
    first: dict[str, Case] = {}
    for case in cases:
        first.setdefault(_band(case), case)
    assert all(
        np.array_equal(first[_band(case)].worlds.response.frequency, case.worlds.response.frequency)
        for case in cases
    )
    for number, case in enumerate(cases):
        matrix = first[_band(case)].worlds.response.matrix
        object.__setattr__(case.worlds, "response", replace(case.worlds.response, matrix=matrix))
        assert cases[number] is case
    return [None for _ in cases]


def _band(case: Case) -> str:
    return f"{case.settings.band}"


def _of_settings(cases: Sequence[Case], sources: Sequence[str]) -> list[Truth | None]:
    """Stiffness and damping of the first test, the stiffness times that of the setting."""
    k, c, mass = (cases[0].fit.parameter(name).value for name in ("k", "c", "m"))
    between = [lambda errors, name=name: BETWEEN * errors.of(Uncertainty(name, 1.0, "1")) for name in sources]
    return [
        _moved(case, mass, lambda errors, part=part: (k * (1 + part(errors)), c))
        for case, part in zip(cases, between, strict=True)
    ]


def _of_law(cases: Sequence[Case], conditions: np.ndarray, setting_error: float) -> list[Truth | None]:
    """Stiffness and damping by power laws through all tests."""
    middle = np.exp(np.mean(np.log(conditions)))
    laws = [
        np.polyfit(np.log(conditions / middle), np.log([case.fit.parameter(name).value for case in cases]), 1)
        for name in ("k", "c")
    ]

    def at(case: Case, condition: float, errors: Errors) -> tuple[float, float]:
        x = np.log(condition * _true_factor(case, setting_error, errors) / middle)
        k, c = (float(np.exp(np.polyval(law, x))) for law in laws)
        return k, c

    mass = cases[0].fit.parameter("m").value
    return [
        _moved(case, mass, lambda errors, case=case, x=x: at(case, x, errors))
        for case, x in zip(cases, conditions, strict=True)
    ]


def _moved(case: Case, mass: float, coefficients: Callable[[Errors], tuple[float, float]]) -> Truth:
    """The receptance of the *mass* [kg], one in all tests, on the true stiffness [N/m] and damping [N
    s/m].
    """
    omega = 2 * np.pi * case.worlds.response.frequency

    def truth(errors: Errors) -> np.ndarray:
        k, c = coefficients(errors)
        return np.asarray(1 / (k - mass * omega**2 + 1j * omega * c))

    return truth


def _of_theory(
    settings: Sequence[CompareSettings],
    cases: Sequence[Case],
    pairs: Sequence[tuple[float, str]],
    folder: Path,
    setting_error: float,
) -> list[Truth | None]:
    """The bending shaft on the theory's stiffness at the true condition, times the ratio and with the damping
    that were measured.
    """
    with_theory = next(one for one in settings if one.kind == "ratio")
    measured = Question((with_theory,), tuple(Tested(case, None) for case in cases), folder)
    (answer,) = measured.answers(Errors(), None)
    ratio, beta = (
        next(one.value for one in answer.amounts if one.name == name) for name in ("ratio", "beta")
    )
    named = with_theory.theory
    assert named is not None
    theory = _theory(folder, named)
    return [
        _in_series(
            case,
            pair,
            (ratio, beta),
            named,
            theory,
            lambda errors, case=case: _true_factor(case, setting_error, errors) - 1,
        )
        for case, pair in zip(cases, pairs, strict=True)
    ]


def _in_series(
    case: Case,
    pair: tuple[float, str],
    factors: tuple[float, float],
    named: TheorySettings,
    theory: Any,
    step_of: Callable[[Errors], float],
) -> Truth:
    """The receptance of the shaft on (ratio, beta) times the theory, at a condition off by the share that
    *step_of* a world gives.
    """
    steps = np.array([-0.02, 0.0, 0.02])
    ends = [theory(((float(pair[0] * (1 + step)), pair[1]),)) for step in steps]
    course = np.polyfit(steps, np.array([one.stiffness.ravel() for one in ends]), 2)
    outputs, curve = case.worlds.response.outputs, case.fit.curve
    assert curve is not None
    place = next(DOFS.index(port.dof or port.label) for port in outputs if port.label == curve.outputs[0])
    arms = named.arm**2 if place >= TILTS and named.arm else 1.0
    frequency = case.worlds.response.frequency

    def truth(errors: Errors) -> np.ndarray:
        step = step_of(errors)
        stiffness = factors[0] * (course[0] * step**2 + course[1] * step + course[2]).reshape(5, 5)
        bending = np.inf
        if named.shaft is not None:
            bending = named.shaft.value + errors.of(
                Uncertainty("bending shaft", named.shaft.std_error, "N/m")
            )
        transfer = transfer_matrix(ends[1].shaft, stiffness, frequency, factors[1], bending)
        return np.asarray(transfer[:, place, place] * arms)

    return truth
