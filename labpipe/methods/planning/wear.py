"""plan of wear tests: at which speeds and loads and in which bands to test.

With white forces of one-sided density S_F in y and then in z, each for T seconds, and noise densities S_n of
the probes and S_m of the force transducer, I_ij = 2 T sum over terms of the integral of S_F Re(h_i* h_j) /
(S_n + |H|^2 S_m) over the band, h_i the derivatives of the receptance H by the parameters (Pintelon and
Schoukens 2012, System Identification, sec. 9.10).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import yaml

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import SettingError
from labpipe.methods.journal_bearing.bearing import journal_equilibrium
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.journal_bearing.kind import Wear
from labpipe.methods.planning.excitation import uncertain_text
from labpipe.methods.planning.plan_file import PIPELINE, PlanFile, write_runs
from labpipe.methods.planning.records import RunPlan
from labpipe.methods.planning.report import run_sentences
from labpipe.methods.planning.runs import Answered, CandidateRun, Change, RunQuantity, RunQuestion, plan_runs
from labpipe.methods.planning.settings import PlanKind, check_distinct, criterion_setting
from labpipe.methods.rotor.response import ReducedRotor, reduced_rotor
from labpipe.methods.rotor.rig import BearingPlace, RotorRig, worn_place
from labpipe.methods.wear.model import PLACES, rotor_response
from labpipe.methods.wear.settings import ANGLE, DEPTH, NUISANCES, UNITS, nuisance
from labpipe.methods.wear.tables import VaryingSupport, film_slopes
from labpipe.records.settings import Settings, choice, integer, quantity, section, setting, text
from labpipe.records.uncertain import Uncertain

WORN = "worn-bearing"


@dataclass(frozen=True)
class WearNoise(Settings):
    """Standard deviations of the sensors' noise per sample, at the sampling rate of the plan."""

    displacement: float = quantity("of the displacement", "m", 1e-6)
    force: float = quantity("of the force", "N", 0.0)

    def __post_init__(self) -> None:
        self.require_positive("displacement")
        self.require_not_negative("force")


@dataclass(frozen=True)
class WearGoal(Settings):
    """Standard errors that are wanted."""

    depth: float | None = quantity("of the depth", "m", None)
    angle: float | None = quantity("of the angle", "rad", None)

    def __post_init__(self) -> None:
        self.require_positive("depth", "angle")


@dataclass(frozen=True)
class WearPlanSettings(Settings):
    """Which tests there could be, how measured, what they are to tell; *rig*: contents of `rotor`."""

    model: str = choice("what will be identified: depth and angle of wear", (WORN,))
    rotor: str = setting("file", "rotor file", file_kind="rotor", into="rig")
    _: KW_ONLY
    expected: Wear = section("depth and angle that are expected", Wear)
    speeds: tuple[float, ...] = setting("values", "speeds that can be run", "Hz")
    duration: float = quantity("of all tests together", "s")
    sample_rate: float = quantity("of the recordings", "Hz")
    bands: tuple[tuple[float, float], ...] = setting(
        "bands", "bands that can be excited, one at a time", "Hz"
    )
    force: float = quantity("rms of the shaker's white force, in whatever band", "N")
    bearing: str = text("name of the worn bearing; default: the last one")
    loads: tuple[float, ...] = setting(
        "values", "static forces on the shaft that can be set, up; default: as in the file", "N", ()
    )
    load_node: int = integer("node of that static force; default: that of the shaker", 0)
    run: float = quantity("length of one run, under a force in y and again in z", "s", 60.0)
    changeover: float = quantity("time between tests", "s", 0.0)
    block: float = quantity("block length of the responses", "s", 4.0)
    noise: WearNoise = section("of the sensors, per sample", WearNoise, WearNoise())
    viscosity: Uncertain | None = nuisance("estimated along, e.g. 0.104 Pa.s +- 3 %", "Pa.s")
    clearance: Uncertain | None = nuisance("of all bearings, estimated along, e.g. 90 um +- 2 %", "m")
    cavitation_pressure: Uncertain | None = nuisance("estimated along, e.g. -0.1 bar +- 0.1 bar", "Pa")
    beta: Uncertain | None = nuisance("damping of the shaft, estimated along", "s")
    angle_limit: float = quantity("largest angle there could be, either way", "rad", np.pi / 9)
    goal: WearGoal = section("{depth: 0.2 um, angle: 1 deg}; default: both alike", WearGoal, WearGoal())
    criterion: str = criterion_setting()
    rig: RotorRig | None = None

    def __post_init__(self) -> None:
        self.require_positive("duration", "sample_rate", "force", "run", "block")
        check_distinct(self, "speeds", "bands", "loads")
        self.require_positive("speeds")
        if any(low <= 0 or 2 * high >= self.sample_rate for low, high in self.bands):
            raise SettingError("bands", "bands lie between 0 and half the sampling rate")
        if self.run < 2 * self.block or self.changeover < 0:
            raise SettingError("run", "a run holds two blocks or more, and no time between tests is negative")
        if self.expected.depth < 0 or abs(self.expected.angle) > self.angle_limit:
            hint = "a depth of zero or more, within angle_limit"
            raise SettingError("expected", "the expected wear is beyond its limits", hint)
        for name, given in self.nuisances.items():
            if not given.std_error > 0:
                hint = "90 um +- 2 %; what is certain belongs in the rotor file"
                raise SettingError(name, f"{name} has no uncertainty", hint)
        if self.rig is not None:
            worn_place(self.rig, self.bearing)
            self.rig.rotor.check_node(self.node, "load_node")

    @property
    def node(self) -> int:
        """Node of the static force."""
        assert self.rig is not None
        return self.load_node or self.rig.force

    @property
    def nuisances(self) -> dict[str, Uncertain]:
        return {name: getattr(self, name) for name in NUISANCES if getattr(self, name) is not None}

    @property
    def static_forces(self) -> tuple[float, ...]:
        assert self.rig is not None
        return self.loads or (sum(force for node, _, force in self.rig.loads if node == self.node),)


MESH = FilmMesh(240, 30)


@dataclass(frozen=True)
class ResponseTest:
    """One test: rms *force* [N], *seconds* [s] under each of two directions, lines *spacing* [Hz] apart,
    without *exclude* [Hz].

    displacement [m/sqrt(Hz)], force_noise [N/sqrt(Hz)]: one-sided densities of the sensors' noise.
    """

    force: float
    seconds: float
    spacing: float
    displacement: float
    force_noise: float
    exclude: tuple[tuple[float, float], ...] = ()

    def lines(self, band: tuple[float, float]) -> FloatArray:
        """Frequencies (n_line,) [Hz] of a band that tell something; ConfigError where there is none."""
        low, high = (round(end / self.spacing) for end in band)
        lines = np.arange(max(low, 1), high + 1) * self.spacing
        left_out = [(lines >= first) & (lines <= last) for first, last in self.exclude]
        kept = np.asarray(lines[~np.any(left_out, axis=0)] if left_out else lines)
        if not kept.size:
            what = f"no line is left between {band[0]:g} and {band[1]:g} Hz"
            hint = "lines about the speeds are left out: widen it, or longer blocks"
            raise SettingError("bands", what, hint)
        return kept


@dataclass(frozen=True)
class ExpectedWear:
    """A rotor with expected *values* [SI], wear_depth and wear_angle of the *bearing* first."""

    rig: RotorRig
    bearing: str
    values: Mapping[str, float]

    def at(self, speed: float, node: int, load: float) -> ExpectedWear:
        """At another speed [Hz] and with another vertical static force [N] at a node, positive up."""
        others = ((at, y, 0.0 if at == node else z) for at, y, z in self.rig.loads if at != node or y)
        return replace(self, rig=replace(self.rig, speed=speed, loads=(*others, (node, 0.0, load))))

    def receptance_and_slopes(
        self, lines: FloatArray, mesh: FilmMesh = MESH
    ) -> tuple[ComplexArray, ComplexArray]:
        """H (n_line, 2, 2) [m/N] at lines [Hz], its derivatives (n, n_line, 2, 2) [m/N per SI unit]."""
        loads = self.rig.static_loads()
        supports = [self._support(place, loads[place.name], mesh) for place in self.rig.bearings]
        nodes = (*(place.node for place in self.rig.bearings), self.rig.force, self.rig.response)

        def rotor(beta: float) -> ReducedRotor:
            return reduced_rotor(replace(self.rig.rotor, beta=beta), nodes, lines, self.rig.omega)

        return rotor_response(self.rig, rotor, supports, self.values, tuple(self.values), self.beta)

    @property
    def beta(self) -> float:
        """Damping of the shaft in proportion to its stiffness [s]."""
        return float(self.values.get("beta", self.rig.rotor.beta))

    def _support(self, place: BearingPlace, load: tuple[float, float], mesh: FilmMesh) -> VaryingSupport:
        """A bearing with the derivatives of its coefficients by the parameters."""
        slopes = np.zeros((2, len(self.values), 2, 2))
        if not place.is_film:
            return VaryingSupport(place.support(load, self.rig.omega), *slopes)
        others = ("beta",) if place.name == self.bearing else ("beta", DEPTH, ANGLE)
        names = [name for name in self.values if name not in others]
        bearing = replace(place.film("wear"), **{name: self.values[name] for name in names})
        film = journal_equilibrium(bearing, load, self.rig.omega, mesh)
        for name, slope in film_slopes(film, names).items():
            slopes[:, tuple(self.values).index(name)] = slope
        return VaryingSupport(place.springs(film), *slopes)


def information(
    expected: ExpectedWear, testing: ResponseTest, band: tuple[float, float], terms: str = "full"
) -> FloatArray:
    """What a test in a *band* [Hz] tells of the parameters, (n, n) [1/SI units squared], from these *terms*
    of the receptance. Equation (plan-wear).
    """
    lines = testing.lines(band)
    response, slopes = expected.receptance_and_slopes(lines)
    density = testing.force**2 / (band[1] - band[0])
    noise = testing.displacement**2 + (testing.force_noise * np.abs(response)) ** 2
    weight = np.zeros((lines.size, 4))
    chosen = list(PLACES[terms])
    weight[:, chosen] = (2 * testing.seconds * testing.spacing * density / noise).reshape(-1, 4)[:, chosen]
    flat = slopes.reshape(len(slopes), lines.size, 4)
    return np.einsum("ilt,lt,jlt->ij", flat.conj(), weight, flat).real


RIG = "rig.yaml"
# Lines about a speed that are left out, either way [blocks].
BESIDE = 2.5
# Correlation above which two parameters are hardly told apart.
ALIKE = 0.95
# Wear that is tried as a change where the expected one tells no angle.
VISIBLE = 5e-6


@dataclass(frozen=True)
class WearPoint:
    """One operating point and band of a test: *speed* [Hz], static *force* [N], *band* [Hz]."""

    speed: float
    force: float
    band: tuple[float, float]


@dataclass(frozen=True)
class WearTests:
    """The tests to choose from, by the settings of a plan, of a bearing with that *wear*."""

    settings: WearPlanSettings
    wear: Wear

    @cached_property
    def expected(self) -> ExpectedWear:
        rig, nuisances = self.settings.rig, self.settings.nuisances
        assert rig is not None
        others = {name: given.value for name, given in nuisances.items()}
        values = {DEPTH: self.wear.depth, ANGLE: self.wear.angle, **others}
        return ExpectedWear(rig, rig.place(self.settings.bearing).name, values)

    @cached_property
    def testing(self) -> ResponseTest:
        settings, noise = self.settings, self.settings.noise
        beside = BESIDE / settings.block
        exclude = tuple((speed - beside, speed + beside) for speed in settings.speeds)
        density = float(np.sqrt(2 / settings.sample_rate))
        displacement, force = density * noise.displacement, density * noise.force
        return ResponseTest(settings.force, settings.run, 1 / settings.block, displacement, force, exclude)

    @cached_property
    def points(self) -> dict[str, WearPoint]:
        forces, bands = self.settings.static_forces, self.settings.bands
        points = {}
        for speed in self.settings.speeds:
            for place, force in enumerate(forces, 1):
                for number, band in enumerate(bands, 1):
                    name = f"{speed:g}Hz".replace(".", "p")
                    name += f"-load-{place}" if len(forces) > 1 else ""
                    name += f"-band-{number}" if len(bands) > 1 else ""
                    points[name] = WearPoint(speed, force, band)
        return points

    @property
    def prior(self) -> FloatArray:
        """Information (n, n) [1/SI units squared] before any test."""
        return np.diag([0.0, 0.0, *(given.std_error**-2.0 for given in self.settings.nuisances.values())])

    @property
    def units(self) -> FloatArray:
        """Of the parameters (n,) [SI units]: 1 um, 1 deg and the errors known before."""
        errors = (given.std_error for given in self.settings.nuisances.values())
        return np.array([1e-6, np.deg2rad(1.0), *errors])

    def information(self, point: WearPoint, terms: str = "full") -> FloatArray:
        """What one test tells, (n, n) [1/SI units squared], from these *terms* of the receptance."""
        at = self.expected.at(point.speed, self.settings.node, point.force)
        return information(at, self.testing, point.band, terms)

    @property
    def conditions(self) -> tuple[CandidateRun, ...]:
        settings = self.settings
        seconds = 2 * settings.run + settings.changeover
        conditions = []
        for name, point in self.points.items():
            words = (
                ("speed", f"{60 * point.speed:.5g} rpm"),
                ("static force", f"{point.force:.4g} N"),
                ("band", f"{point.band[0]:g} to {point.band[1]:g} Hz"),
                ("force", f"{settings.force:g} N rms in y, then in z, {settings.run:g} s each"),
            )
            conditions.append(CandidateRun(name, seconds, words, self.information(point)))
        return tuple(conditions)

    def plan(self, title: str) -> RunPlan:
        """The tests that tell most within the time. ConfigError where no number of them meets a goal."""
        settings, values = self.settings, self.expected.values
        goals = {DEPTH: settings.goal.depth, ANGLE: settings.goal.angle}
        remedies: tuple[Change, ...] = ()
        if self.wear.depth < VISIBLE:
            worn = replace(self, wear=Wear(VISIBLE, self.wear.angle))
            remedies = (Change(f"a wear of {1e6 * VISIBLE:g} um", 1, worn.conditions),)
        question = RunQuestion(
            parameters=tuple(values),
            units=self.units,
            prior=self.prior,
            conditions=self.conditions,
            quantities=tuple(
                RunQuantity(name, UNITS[name], value, row, goals.get(name))
                for row, (name, value) in zip(np.eye(len(values)), values.items(), strict=True)
            ),
            duration=settings.duration,
            criterion=settings.criterion,
            remedies=remedies,
        )
        answered = plan_runs(question, title, settings.model)
        notes = (*self._range_notes(answered), *self._alike_notes(answered), *self._term_notes(answered))
        return answered.add_notes(notes).plan

    def _range_notes(self, answered: Answered) -> Iterator[str]:
        error = next(number.error for number in answered.plan.numbers if number.name == ANGLE)
        limit = self.settings.angle_limit
        before = float(2 * limit / np.sqrt(12))
        if error is not None and error > before / 2:
            longer = (error / (before / 5)) ** 2
            yield (
                f"At a depth of {1e6 * self.wear.depth:.3g} um these tests do not tell the angle: its "
                f"standard error of {np.degrees(error):.2g} deg stands against {np.degrees(before):.2g} deg "
                f"if every angle up to {np.degrees(limit):.3g} deg is alike. A fifth of that needs "
                f"{longer:.2g} times the time, or deeper wear."
            )

    def _alike_notes(self, answered: Answered) -> Iterator[str]:
        errors = np.sqrt(np.diagonal(answered.covariance))
        correlation = answered.covariance / np.outer(errors, errors)
        names = tuple(self.expected.values)
        for first in range(len(names)):
            for second in range(first):
                if abs(correlation[first, second]) > ALIKE:
                    pair = f"{names[second]} and {names[first]} can hardly be separated"
                    alike = f"(correlation {correlation[first, second]:+.3f})"
                    yield f"{pair} {alike}: an error of one is made good by the other."

    def _term_notes(self, answered: Answered) -> Iterator[str]:
        scale = np.outer(self.units, self.units)
        for terms in (terms for terms in PLACES if terms != "full"):
            total = self.prior
            for run in answered.plan.runs:
                total = total + run.count * self.information(self.points[run.name], terms)
            errors = np.sqrt(np.diagonal(np.linalg.pinv(total * scale)))
            yield f"From the {terms} terms alone: depth to {errors[0]:.2g} um, angle to {errors[1]:.2g} deg."


def wear_files(file: PlanFile, output: OutputFolder) -> tuple[list[str], list[str]]:
    settings: WearPlanSettings = file.settings
    tests = WearTests(settings, settings.expected)
    plan = tests.plan(file.title)
    rotor = yaml.safe_load((file.path.parent / settings.rotor).read_text(encoding="utf-8"))
    loads = rotor.get("loads") or ()
    others = [{**load, "z": "0 N"} if load["node"] == settings.node else load for load in loads]
    files: dict[str, Any] = {}
    expected, noise = settings.expected, settings.noise
    for run in plan.runs:
        point = tests.points[run.name]
        files[f"rotor-{run.name}.yaml"] = {
            **rotor,
            "speed": f"{point.speed!r} Hz",
            "loads": [*others, {"node": settings.node, "z": f"{point.force!r} N"}],
        }
        files[f"virtual-{run.name}.yaml"] = {
            "kind": "virtual-journal-rig",
            "rotor": f"rotor-{run.name}.yaml",
            **({"bearing": settings.bearing} if settings.bearing else {}),
            "states": {"worn": {"depth": f"{expected.depth!r} m", "angle": f"{expected.angle!r} rad"}},
            "force": f"{settings.force!r} N",
            "lowest": f"{point.band[0]!r} Hz",
            "bandwidth": f"{point.band[1]!r} Hz",
            "sample_rate": f"{settings.sample_rate!r} Hz",
            "duration": f"{run.count * settings.run!r} s",
            "noise": {"displacement": f"{noise.displacement!r} m", "force": f"{noise.force!r} N"},
        }
    channels = {
        "f": {"column": "force [N]", "quantity": "force", "unit": "N", "role": "input", "dof": "y"},
        "y": {"column": "y [um]", "quantity": "displacement", "unit": "um", "role": "output", "dof": "y"},
        "z": {"column": "z [um]", "quantity": "displacement", "unit": "um", "role": "output", "dof": "z"},
    }
    files[RIG] = {"name": "Wear rig", "sample_rate": f"{settings.sample_rate!r} Hz", "channels": channels}
    files[PIPELINE] = pipeline_entries(plan, tests)
    return list(run_sentences(plan)), write_runs(plan, files, output)


def pipeline_entries(plan: RunPlan, choice: WearTests) -> dict[str, Any]:
    """The pipeline that evaluates the tests: each fit begins with what the one before has found."""
    settings = choice.settings
    tests, fits, last = [], {}, ""
    for run in plan.runs:
        folder, point = f"recordings/{run.name}", choice.points[run.name]
        in_z = {"file": f"{folder}/worn-z.parquet", "channels": {"f": {"dof": "z"}}}
        recordings = [f"{folder}/worn-y.parquet", in_z]
        conditions = {"speed": f"{point.speed!r} Hz", "load": f"{point.force!r} N"}
        tests.append({"name": run.name, "recordings": recordings, "conditions": conditions})
        wear: dict[str, Any] = {"rotor": f"rotor-{run.name}.yaml", "bearing": choice.expected.bearing}
        if last:
            wear |= {"prior": last, "same_wear": True}
        for name, given in settings.nuisances.items() if not last else ():
            wear[name] = uncertain_text(given, UNITS[name])
        wear["angle_limit"] = f"{settings.angle_limit!r} rad"
        last, band = f"wear-{run.name}", f"{point.band[0]!r}-{point.band[1]!r} Hz"
        fits[last] = {"model": settings.model, "test": run.name, "band": band, "wear": wear}
    ends = [end for run in plan.runs for end in choice.points[run.name].band]
    least, most = min(ends), max(ends)
    band = f"{least!r}-{most!r} Hz"
    frf: dict[str, Any] = {"excitation": "random", "block": f"{settings.block!r} s", "band": band}
    gaps = [(low, high) for low, high in choice.testing.exclude if low <= most and high >= least]
    if gaps:
        frf["exclude"] = [f"{max(low, 0.0)!r}-{high!r} Hz" for low, high in gaps]
    return {"title": plan.title, "rig": RIG, "tests": tests, "frf": frf, "identify": fits}


WEAR = PlanKind(WearPlanSettings, wear_files)
