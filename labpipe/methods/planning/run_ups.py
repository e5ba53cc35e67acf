"""plan of run-ups: which loads, trial unbalances and speeds to run, and the pipeline of their joint fit.

With the slopes J of the joint fit's residual at expected parameters, a run tells J^T J of the logarithms of
PARAMETERS, its Fisher information. Readings have standard errors of a share of the amplitude, with a floor,
and of the phase; where the rotor is unstable, or moves farther than the limits allow, it is not run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.artefacts.identification_file import read_identification
from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import ConfigError, FitError, SettingError
from labpipe.methods.planning.plan_file import PIPELINE, ROTOR, PlanFile, write_runs
from labpipe.methods.planning.report import run_names, run_sentences
from labpipe.methods.planning.runs import Answered, CandidateRun, Change, RunQuantity, RunQuestion, plan_runs
from labpipe.methods.planning.settings import PlanKind, check_distinct, check_relative, criterion_setting
from labpipe.methods.rotor.response import GROWTH_TOLERANCE
from labpipe.methods.run_ups.joint import EXPONENTS, MeasuredThreshold, family_about
from labpipe.methods.run_ups.measured import excitation_text
from labpipe.methods.run_ups.misfit import ExcitedRun, LoadRuns, scales
from labpipe.methods.run_ups.records import TRAINED, RunUp, Shaker
from labpipe.methods.run_ups.rotor import (
    BOUND,
    COEFFICIENTS,
    PARAMETERS,
    PRIOR,
    RPM,
    FilmFamily,
    RunUpRotor,
    largest_displacement,
    with_search_range,
)
from labpipe.methods.run_ups.run_up_csv import write_run_up_csv
from labpipe.project.measured import file_stem
from labpipe.records.settings import Settings, choice, flag, integer, names, quantity, section, setting, text
from labpipe.records.uncertain import Uncertain
from labpipe.registry import nearest

RUN_UPS = "run-ups"
SPEEDS = ("critical_speed", "threshold")
# No readings of a larger relative error: a fit weighs along and across the measured phasor, noise then.
LARGEST_ERROR = 0.2


@dataclass(frozen=True)
class ReadingSettings(Settings):
    """Standard errors of the readings at one speed, from one dwell there."""

    amplitude: float = quantity("of the amplitude itself", "1", 0.01)
    displacement: float = quantity("added to every reading, in squares", "m", 0.0)
    phase: float = quantity("of the phase", "rad", float(np.deg2rad(1)))
    threshold: float = quantity("of the threshold speed itself", "1", 0.002)

    def __post_init__(self) -> None:
        self.require_positive("amplitude", "phase", "threshold")
        self.require_not_negative("displacement")


@dataclass(frozen=True)
class TrialSettings(Settings):
    """One way to excite the rotor: a trial unbalance, or a shaker whose force does not turn."""

    unbalance: tuple[tuple[str, complex], ...] = setting(
        "phasors", "by plane: {disc 1: 50 g.mm at 0 deg}", "kg.m", ()
    )
    shaker: str = text("plane on which a shaker acts, along x, instead")
    force: float = quantity("of the shaker, 0-to-peak", "N", 1.0)
    ratio: float = quantity("frequency of the shaker over that of the shaft", "1", 0.95)

    def __post_init__(self) -> None:
        if bool(self.unbalance) == bool(self.shaker):
            hint = "unbalance: {disc 1: 50 g.mm at 0 deg}"
            raise ConfigError("a trial has an unbalance or a shaker", hint=hint)
        if self.unbalance and not any(size for _, size in self.unbalance):
            raise SettingError("unbalance", "the trial unbalance is zero", "{disc 1: 50 g.mm at 0 deg}")
        self.require_positive("force", "ratio")


@dataclass(frozen=True)
class RunUpPlanSettings(Settings):
    """Which run-ups there could be, how they are read, what they are to tell; *rig*: contents of `rotor`."""

    model: str = choice("what will be identified: the oil film over load and speed", (RUN_UPS,))
    rotor: str = setting("file", "rotor file with pins", file_kind="run-up-rotor", into="rig")
    _: KW_ONLY
    loads: tuple[float, ...] = setting("values", "static loads that can be set", "N")
    speeds: tuple[float, float] = setting("band", "speeds that can be run", "Hz")
    step: float = quantity("from one speed of a run to the next", "Hz")
    dwell: float = quantity("time at one speed", "s")
    duration: float = quantity("of all runs together", "s")
    trials: tuple[tuple[str, TrialSettings], ...] = setting(
        "sections", "ways to excite the rotor, by name", section=TrialSettings, default=(), needed=True
    )
    stretches: int = integer("parts of the speeds that can be run by themselves", 3)
    changeover: float = quantity("time between runs", "s", 0.0)
    to_threshold: bool = flag("the highest stretch may be run on until the rotor becomes unstable")
    displacement_limit: float | None = quantity("largest at a plane, 0-to-peak; default: none", "m", None)
    journal_limit: float | None = quantity("largest of the journal, 0-to-peak; default: none", "m", None)
    noise: ReadingSettings = section("of a reading", ReadingSettings, ReadingSettings())
    expected: tuple[tuple[str, tuple[float, ...]], ...] = setting(
        "series",
        "factors on the rotor file's film, exponents of the viscosity; default: the rotor file",
        "1",
        (),
    )
    earlier: str = setting(
        "file", "identification.json whose joint fit is expected where `expected` has none", default=""
    )
    known: tuple[str, ...] = names(f"what is known: of {', '.join(PARAMETERS)}", may_be_empty=True)
    at_load: float | None = quantity("load at which speeds and coefficients are predicted", "N", None)
    at_speed: float | None = quantity("speed at which coefficients are predicted", "Hz", None)
    goal: tuple[tuple[str, tuple[float, ...]], ...] = setting(
        "series",
        "relative standard errors that are wanted: {k_xy: 5 %, threshold: 1 %}; default: all parameters "
        "alike",
        "1",
        (),
    )
    criterion: str = criterion_setting()
    rig: RunUpRotor | None = None

    def __post_init__(self) -> None:
        self._check_signs()
        if len(self.omega) < 2 * max(self.stretches, 1):
            what = f"{len(self.omega)} speeds make no {self.stretches} stretches of two or more"
            raise SettingError("stretches", what)
        if not self.trials:
            hint = "{trial-1: {unbalance: {disc 1: 50 g.mm}}}"
            raise SettingError("trials", "there is no way to excite the rotor", hint)
        for field, listed in (("known", self.known), ("expected", tuple(dict(self.expected)))):
            for name in listed:
                if name not in PARAMETERS:
                    what = f"the film has no parameter {name}"
                    raise SettingError(field, what, nearest(name, PARAMETERS))
        if len({file_stem(name) for name, _ in self.trials}) < len(self.trials):
            raise SettingError("trials", "two trials would write the same files", "rename one")
        for name, values in self.expected:
            self._check_expected(name, values)
        self._check_goals()
        if self.rig is not None:
            self._check_rotor(self.rig)

    def _check_signs(self) -> None:
        self.require_positive("loads", "step", "dwell", "duration", "at_load", "at_speed")
        self.require_positive("displacement_limit", "journal_limit")
        check_distinct(self, "loads")
        self.require_not_negative("changeover")
        steps = (self.speeds[1] - self.speeds[0]) / self.step
        if abs(steps - round(steps)) > 1e-6 * steps:
            what = f"the speeds are {steps:.6g} steps from end to end"
            raise SettingError("step", what, "a whole number of them")
        if self.speeds[0] <= 0 or self.stretches < 1:
            raise SettingError("speeds", "speeds begin above zero, and there is one stretch of them at least")

    def _check_expected(self, name: str, values: tuple[float, ...]) -> None:
        if len(values) != 1 or (name not in EXPONENTS and values[0] <= 0):
            raise SettingError("expected", f"{name} is one factor above zero", f"{name}: 0.9")
        if abs(logarithm(name, values[0])) > BOUND[PARAMETERS.index(name)]:
            what = f"{name} of {values[0]:g} is beyond what a joint fit looks for"
            raise SettingError("expected", what, "change the rotor file")

    def _check_goals(self) -> None:
        names = (*PARAMETERS, *(SPEEDS if self.at_load else ()))
        names += COEFFICIENTS if self.at_load and self.at_speed else ()
        for name, _ in self.goal:
            if name not in names:
                predicted = name in (*SPEEDS, *COEFFICIENTS)
                hint = "at_load and at_speed say where" if predicted else nearest(name, names)
                raise SettingError("goal", f"no {name} is predicted", hint)
            if name in self.known:
                raise SettingError("goal", f"{name} is known", "leave one of goal and known out")
        check_relative(self.goal)

    def _check_rotor(self, rig: RunUpRotor) -> None:
        rig.place.film("a plan of run-ups")
        if rig.tabulated is not None:
            raise SettingError("rotor", "a plan is made of the film, not of `coefficients`", "leave it out")
        for name, trial in self.trials:
            for plane in (*dict(trial.unbalance), *([trial.shaker] if trial.shaker else [])):
                if plane not in rig.plane_names:
                    what = f"trial {name}: no plane '{plane}'"
                    raise SettingError("trials", what, nearest(plane, rig.plane_names))

    @property
    def omega(self) -> FloatArray:
        """All speeds (n_speed,) [rad/s]."""
        low, high = self.speeds
        return 2 * np.pi * np.linspace(low, high, round((high - low) / self.step) + 1)

    def values(self, earlier: Mapping[str, float]) -> FloatArray:
        """Expected logarithms (12,) [-] of PARAMETERS; *earlier*: factors and exponents [1] by default."""
        values = {name: 0.0 if name in EXPONENTS else 1.0 for name in PARAMETERS}
        values |= {**earlier, **{name: value for name, (value,) in self.expected}}
        return np.array([logarithm(name, values[name]) for name in PARAMETERS])


def logarithm(name: str, value: float) -> float:
    """The logarithm that stands for a factor; an exponent of the viscosity stands for itself."""
    return value if name in EXPONENTS else float(np.log(value))


METHOD = "joint"
# Standard error of the logarithm of what is known.
KNOWN = 1e-5
STEP = 1e-4
# The second load that is tried, over the highest.
OTHER_LOAD = 1.5


@dataclass(frozen=True)
class RunUpChoice:
    """The run-ups to choose from, by the settings of a plan, of a rig that is *expected*."""

    settings: RunUpPlanSettings
    expected: ExpectedRig

    def iterate_runs(self) -> Iterator[RunCandidate]:
        """Every load with every trial over every stretch of the speeds."""
        settings = self.settings
        stretches = np.array_split(settings.omega, settings.stretches)
        for place, load in enumerate(settings.loads, 1):
            for name, trial in settings.trials:
                shaker = Shaker(trial.shaker, trial.force, 0.0, trial.ratio) if trial.shaker else None
                for number, speed in enumerate(stretches, 1):
                    stem = f"load-{place}-{file_stem(name)}"
                    stem += f"-{number}" if settings.stretches > 1 else ""
                    candidate = RunCandidate(stem, load, speed, dict(trial.unbalance), shaker)
                    yield candidate
                    may_go_on = settings.to_threshold and number == settings.stretches and not shaker
                    if may_go_on and self.expected.threshold(load) is not None:
                        yield replace(candidate, name=f"{stem}-threshold", to_threshold=True)

    @cached_property
    def _allowed(self) -> tuple[list[RunCandidate], list[str]]:
        """The runs at the speeds that the limits allow, and what to note of it."""
        limits = self.settings.displacement_limit, self.settings.journal_limit
        kept, cut, whole = [], 0, 0
        for candidate in self.iterate_runs():
            allowed = limit_speeds(self.expected, candidate, *limits)
            kept += [] if allowed is None else [allowed]
            full = allowed is not None and allowed.speed.size == candidate.speed.size
            cut, whole = cut + (not full), whole + full
        if not kept:
            what = "no run keeps within the limits and above the noise"
            raise SettingError("trials", what, "other trial unbalances, or other speeds")
        words = f"{cut} of {cut + whole} candidates leave out speeds at which they would be unstable"
        return kept, [f"{words}, beyond the limits or within the noise."] if cut else []

    def run(self, name: str) -> RunUp:
        """The run of that name as it is expected, without noise."""
        candidate = next(candidate for candidate in self._allowed[0] if candidate.name == name)
        return expected_run(self.expected, candidate)

    @cached_property
    def conditions(self) -> tuple[CandidateRun, ...]:
        dwell = self.settings.dwell
        conditions = []
        for candidate in self._allowed[0]:
            low, high = candidate.speed[[0, -1]] / RPM
            end = ", on to the threshold" if candidate.to_threshold else ""
            words = (
                ("load", f"{candidate.load:.4g} N"),
                ("excitation", excitation_text(candidate.unbalance, candidate.shaker)),
                ("speeds", f"{low:.0f} to {high:.0f} rpm in {candidate.speed.size} steps{end}"),
                ("rate", f"{(high - low) / (dwell * max(candidate.speed.size - 1, 1)):.3g} rpm/s"),
            )
            seconds = dwell * candidate.speed.size + self.settings.changeover
            of_run = information(self.expected, candidate)
            conditions.append(CandidateRun(candidate.name, seconds, words, of_run))
        return tuple(conditions)

    def plan(self, title: str) -> Answered:
        """The runs that tell most within the time. ConfigError where no number of runs meets a goal."""
        settings = self.settings
        spreads = np.where(np.isin(PARAMETERS, settings.known), KNOWN, PRIOR)
        question = RunQuestion(
            parameters=PARAMETERS,
            units=PRIOR,
            prior=np.diag(spreads**-2.0),
            conditions=self.conditions,
            quantities=tuple(self._quantities()),
            duration=settings.duration,
            criterion=settings.criterion,
            settled=settings.known,
            remedies=tuple(self._remedies()),
        )
        return plan_runs(question, title, settings.model, self._allowed[1])

    def _remedies(self) -> Iterator[Change]:
        settings = self.settings
        changes = [Change("a measured clearance (known: clearance)", 1, (), ("clearance",))]
        if not any(trial.shaker for _, trial in settings.trials):
            shaken = (("shaker", TrialSettings(shaker=self.expected.rig.plane_names[0])),)
            extra = self._others(trials=shaken, loads=settings.loads[:1])
            changes.append(Change("a run under a shaker whose force does not turn", 1, extra))
        if len(set(settings.loads)) == 1:
            extra = self._others(loads=(OTHER_LOAD * max(settings.loads),))
            changes.append(Change("a second load", 1, extra))
        for size in (1, 2):
            for chosen in combinations(changes, size):
                extra = tuple(condition for change in chosen for condition in change.conditions)
                parameters = tuple(parameter for change in chosen for parameter in change.settled)
                words = " and ".join(change.words for change in chosen)
                yield Change(words, size, (*self.conditions, *extra), parameters)

    def _others(self, **changes: Any) -> tuple[CandidateRun, ...]:
        """Conditions under other settings; none where no run is possible."""
        settings = replace(self.settings, to_threshold=False, **changes)
        try:
            return replace(self, settings=settings).conditions
        except (ConfigError, FitError):
            return ()

    def _quantities(self) -> Iterator[RunQuantity]:
        settings, expected = self.settings, self.expected
        goals = {name: values[0] for name, values in settings.goal}
        for number, name in enumerate(PARAMETERS):
            if name not in settings.known:
                value = float(expected.values[number])
                shown = value if name in EXPONENTS else float(np.exp(value))
                yield RunQuantity(name, "1", shown, np.eye(len(PARAMETERS))[number], goals.get(name), 1.0)
        if settings.at_load is None:
            return
        for name in SPEEDS:
            at_speed = _speed_row(expected, settings.at_load, name)
            if at_speed is not None:
                value, row = at_speed
                goal = None if name not in goals else goals[name] * value
                yield RunQuantity(name, "rad/s", value, row, goal, value)
            elif name in goals:
                what = f"no {name} is expected under {settings.at_load:g} N"
                raise SettingError("goal", what, "leave its goal out")
        if settings.at_speed is not None:
            place = np.array([2 * np.pi * settings.at_speed])
            load = np.array([settings.at_load])
            eight, slopes = expected.family.coefficients_and_slopes(expected.values, load, place)
            sizes = scales(eight)[0].tolist()
            for name, value, row, size in zip(COEFFICIENTS, eight[0].tolist(), slopes[0], sizes, strict=True):
                unit = "N/m" if name.startswith("k") else "N.s/m"
                goal = None if name not in goals else goals[name] * size
                yield RunQuantity(name, unit, value, row, goal, size)


def _speed_row(expected: ExpectedRig, load: float, name: str) -> tuple[float, FloatArray] | None:

    def speed(values: FloatArray) -> float | None:
        at = expected.family.at_load(values, load)
        return expected.rig.critical_speed(at) if name == "critical_speed" else expected.rig.threshold(at)

    try:
        value = speed(expected.values)
        units = STEP * np.eye(len(PARAMETERS))
        ends = [[speed(expected.values + sign * unit) for sign in (1, -1)] for unit in units]
    except FitError:
        return None
    if value is None or any(end is None for pair in ends for end in pair):
        return None
    return value, np.array([(high - low) / (2 * STEP) for high, low in np.array(ends, float)])


def expected_rig(settings: RunUpPlanSettings, earlier: Mapping[str, float]) -> ExpectedRig:
    """The rig of the settings; *earlier*: factors and exponents [1] of an earlier fit."""
    rig = settings.rig
    assert rig is not None
    if rig.speeds is None:
        rig = replace(rig, speeds=(float(settings.omega[0]), float(settings.omega[-1])))
    family = family_about(rig, settings.loads, "a plan of run-ups")
    return ExpectedRig(rig, family, settings.values(earlier), settings.noise)


def run_up_files(file: PlanFile, output: OutputFolder) -> tuple[list[str], list[str]]:
    settings: RunUpPlanSettings = file.settings
    choice = RunUpChoice(settings, expected_rig(settings, earlier_parameters(file)))
    plan = choice.plan(file.title).plan
    names = [f"expected/{run.name}.csv" for run in plan.runs]
    for name, run in zip(names, plan.runs, strict=True):
        write_run_up_csv(output.write_path(name), choice.run(run.name))
    rotor = (file.path.parent / settings.rotor).read_text(encoding="utf-8")
    runs = [{"file": f"recordings/{name}.csv"} for run in plan.runs for name in run_names(run)]
    section: dict[str, Any] = {"rotor": ROTOR, "methods": [METHOD], "runs": runs}
    if settings.known:
        section["known"] = list(settings.known)
    names += write_runs(plan, {ROTOR: rotor, PIPELINE: {"title": plan.title, "run_ups": section}}, output)
    return list(run_sentences(plan)), names


def earlier_parameters(file: PlanFile) -> dict[str, float]:
    """Parameters of the earlier joint fit, its viscosity at the load and speed that the plan refers it to."""
    if not file.settings.earlier:
        return {}
    path = file.path.parent / file.settings.earlier
    result = read_identification(path).sections.get("run_ups")
    methods = [] if result is None else [method for method in result.methods if method.name == METHOD]
    if result is None or not methods:
        what = f"{path.name} holds no joint fit of run-ups"
        raise SettingError("earlier", what, "run_ups: {methods: [joint]}")
    values = {parameter.name: parameter.value for parameter in methods[0].parameters}
    loads = [run.load for run in result.runs if run.role == TRAINED]
    old = family_about(with_search_range(file.settings.rig, result.runs), loads)
    new = expected_rig(file.settings, {}).family
    by_speed, by_load = (values.get(name, 0.0) for name in EXPONENTS)
    moved = (new.speed / old.speed) ** by_speed * (new.load / old.load) ** by_load
    return values | {"viscosity": values.get("viscosity", 1.0) * moved}


RUN_UPS_PLAN = PlanKind(RunUpPlanSettings, run_up_files)


@dataclass(frozen=True)
class ExpectedRig:
    """The rotor, its film, the expected logarithms *values* (12,) [-] of PARAMETERS, noise of a *reading*."""

    rig: RunUpRotor
    family: FilmFamily
    values: FloatArray
    reading: ReadingSettings

    def threshold(self, load: float) -> float | None:
        """Expected threshold of instability [rad/s] under a load [N]; None for none within the search."""
        return self.rig.threshold(self.family.at_load(self.values, load))


@dataclass(frozen=True)
class RunCandidate:
    """A run under a *load* [N] at speeds (n_speed,) [rad/s], an unbalance [kg m] by plane or a shaker."""

    name: str
    load: float
    speed: FloatArray
    unbalance: Mapping[str, complex]
    shaker: Shaker | None = None
    to_threshold: bool = False


def expected_run(expected: ExpectedRig, candidate: RunCandidate) -> RunUp:
    """The run as it is expected, without noise, with the standard errors of its readings."""
    rig, speed = expected.rig, candidate.speed
    shape = (speed.size, len(rig.planes), 2)
    ones = np.ones(shape)
    unit = RunUp(
        candidate.name,
        candidate.load,
        speed,
        rig.plane_names,
        ones + 0j,
        amplitude_error=ones,
        phase_error=ones,
        unbalance=candidate.unbalance,
        shaker=candidate.shaker,
    )
    matrices = expected.family.at_load(expected.values, candidate.load)(speed)
    response = rig.excite(unit).response(*matrices).reshape(shape)
    reading = expected.reading
    floor = reading.displacement / np.abs(response)
    threshold = expected.threshold(candidate.load) if candidate.to_threshold else None
    return replace(
        unit,
        response=response,
        amplitude_error=np.hypot(reading.amplitude, floor) * np.abs(response),
        phase_error=np.hypot(reading.phase, floor),
        threshold=None if threshold is None else Uncertain(threshold, reading.threshold * threshold),
    )


def information(expected: ExpectedRig, candidate: RunCandidate) -> FloatArray:
    """What a run tells of the logarithms of PARAMETERS, (12, 12) [-]; FitError for a threshold that the
    search does not find. Equation (plan-run-up).
    """
    run = expected_run(expected, candidate)
    speeds = LoadRuns(run.load, run.speed, (ExcitedRun.of(expected.rig, run),))
    rows = speeds.residual(expected.family, expected.values)[1]()
    matrix = rows.T @ rows
    if run.threshold is not None:
        measured = MeasuredThreshold(expected.rig, run.load, run.threshold)
        row = measured.residual(expected.family, expected.values)[1]()
        matrix = matrix + row.T @ row
    elif candidate.to_threshold:
        what = f"no threshold is expected under {candidate.load:.4g} N"
        raise FitError(what, hint="leave to_threshold out")
    return np.asarray(matrix)


def limit_speeds(
    expected: ExpectedRig,
    candidate: RunCandidate,
    displacement_limit: float | None = None,
    journal_limit: float | None = None,
) -> RunCandidate | None:
    """The candidate at the speeds at which the rotor is stable, no displacement 0-to-peak at a plane or of
    the journal exceeds its limit [m], and every reading is above its noise; None where fewer than two are
    left.
    """
    run = expected_run(expected, replace(candidate, to_threshold=False))
    stiffness, damping = expected.family.at_load(expected.values, run.load)(run.speed)
    good = expected.rig.stability.growth(run.speed, stiffness, damping) <= GROWTH_TOLERANCE
    good &= np.all(run.amplitude_error <= LARGEST_ERROR * np.abs(run.response), axis=(1, 2))
    if displacement_limit is not None:
        good &= np.all(largest_displacement(run.response) <= displacement_limit, axis=1)
    if journal_limit is not None:
        journal = expected.rig.excite(run).journal(stiffness, damping)[0]
        good &= largest_displacement(journal) <= journal_limit
    return replace(candidate, speed=candidate.speed[good]) if np.count_nonzero(good) > 1 else None
