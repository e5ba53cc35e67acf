"""From the settings of a plan to tests, their signals and what they will tell."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from math import ceil

import numpy as np

from labpipe.arrays import FloatArray, IntArray
from labpipe.errors import SettingError
from labpipe.methods.planning import campaigns
from labpipe.methods.planning.model import AXES, PlannedModel, SensorDensities, planned_model
from labpipe.methods.planning.records import Plan, PlannedCoefficient, PlannedTest
from labpipe.methods.planning.runs import LONGEST, least_factor
from labpipe.methods.planning.search import (
    FLAT_PHASES,
    LEAST_CREST,
    DesignCandidate,
    Wanted,
    best,
    flat,
    reference,
    schemes_of,
)
from labpipe.methods.planning.settings import BEST, PlanSettings
from labpipe.methods.planning.uncertainty import (
    Earlier,
    Expected,
    ForceVectors,
    Goals,
    Rehearse,
    aims,
    calibration_notes,
    combine_with_earlier,
    goals_of,
    identifiability,
    lasting_notes,
    limits,
    spread,
    spread_notes,
    unreachable,
    with_uncertainty,
)
from labpipe.quantities import UnitError, parse_value
from labpipe.raw_files.excitation import peaks
from labpipe.records.rig import AXIS_ANGLES
from labpipe.records.uncertain import Budget
from labpipe.spectra.settings import check_excluded

FEWEST_PERIODS = 3
# Of one period: a search over more lines takes hours.
MOST_LINES, MOST_SAMPLES = 20_000, 1 << 24
# True errors of labpipe's own fits over those with known noise, by the number of periods that give the noise:
# of 2000 simulated tests each (tests/methods/planning/test_weights.py). Fits of FRFs have the noise of
# neighbouring lines and lose nothing; fits of the spectra of all channels know it from the periods alone.
OF_SPECTRA = {3: 1.07, 4: 1.05, 5: 1.02, 10: 1.0}
MAINS_WIDTH = 0.5
NO_FLOOR = (
    "Without a floor the plan leaves few lines: the model cannot be tested on the data. 20 % of the power is "
    "usual."
)
FLAT_IS_BEST = (
    "No design tells more than a flat spectrum within these limits: the plan is flat, with phases of least "
    "peak."
)
NO_ERRORS = "The earlier result states no errors: the uncertainty of the prediction is not known."
# One direction of force whose errors are more than this times those of x and then y gets a note.
MUCH_WORSE = 2.0
# Share of its standard error by which motion that has not died away may shift a coefficient, from which share
# on a plan says so, and the most periods that are looked at: a motion that lasts longer is said to.
SETTLED, NOTICED, MOST_SKIPPED = 0.1, 0.3, 1000


@dataclass(frozen=True)
class Planned:
    """A plan with the rig it is for and the forces of its tests, phases included."""

    plan: Plan
    rig: campaigns.PlannedRig
    tests: tuple[campaigns.Multisines, ...]

    def signals(self, test: int) -> dict[str, FloatArray]:
        """Force of every running shaker of a test, by file, (n_sample,) [N], transient periods included."""
        planned = self.plan.tests[test]
        period = period_signals(self.tests[test], self.plan.sample_rate, self.plan.period)
        whole = np.tile(period, (planned.periods + planned.skip, 1))
        return dict(zip(planned.files, whole.T, strict=True))


def period_signals(test: campaigns.Multisines, sample_rate: float, period: float) -> FloatArray:
    """Forces (n_sample, n_running) [N] of the running shakers in one period [s] at *sample_rate* [Hz]."""
    n_sample = round(period * sample_rate)
    running = test.forces[:, campaigns.running_shakers(test)]
    spectrum = np.zeros((n_sample // 2 + 1, running.shape[1]), complex)
    spectrum[test.lines] = running * (n_sample / 2)
    return np.fft.irfft(spectrum, n_sample, axis=0)


@dataclass(frozen=True)
class _Question:
    """What is planned, and what it is compared with: *flats* are the flat multisines by their phases."""

    settings: PlanSettings
    title: str
    rig: campaigns.PlannedRig
    lines: IntArray
    goals: Goals
    wanted: Wanted
    flats: Mapping[str, campaigns.PlannedCampaign]


def make_plan(
    settings: PlanSettings, expected: Expected, title: str, rehearse: Rehearse | None = None
) -> Planned:
    """The plan for the *expected* coefficients; ConfigError where the rig cannot determine them, or time is
    too short.

    rehearse: gives the uncertainty budget of the evaluation of tests; None where nothing but noise is known
    of the sensors.
    """
    question = _question(settings, expected, title, rehearse)
    rig, wanted = question.rig, question.wanted
    design = best(rig, question.lines, wanted, schemes_of(len(rig.shakers), _scheme(settings, rig.model)))
    periods = _periods(settings, design.campaign)
    skip = _skip(settings, rig, design.campaign, periods)
    lengths = [(skip + number) * settings.period for number in periods]
    pairs = zip(design.campaign.tests, lengths, strict=True)
    tests = [campaigns.from_rest(rig, test, seconds) for test, seconds in pairs]
    timed = campaigns.with_shares(rig, tests, np.array(periods) / sum(periods))
    budget = None if rehearse is None else rehearse(rig, timed.tests, periods)
    plan = _plan(question, design, timed, periods, skip)
    if settings.skip is None and skip > 1:
        skipped = f"{skip} periods, {skip * settings.period:.4g} s, that are skipped"
        waiting = f"Every test begins with {skipped}: motion takes that long to die away."
        plan = replace(plan, notes=(*plan.notes, waiting))
    if budget is not None:
        plan = _with_budget(plan, question, timed, budget, expected.earlier)
    if expected.earlier is not None:
        common = () if budget is None else tuple(source.source for source in budget.sources)
        plan = _plan_over_draws(plan, question, timed, expected.earlier, common)
    return Planned(plan, rig, timed.tests)


def _question(settings: PlanSettings, expected: Expected, title: str, rehearse: Rehearse | None) -> _Question:
    model = planned_model(settings.model, expected.values, settings.mass, settings.axes)
    rig, lines, goals = bench(settings, model), planned_lines(settings), goals_of(settings, model)
    if not (settings.combine_earlier and expected.earlier is not None):
        _check_identifiable(rig, lines)
    flats = {phases: flat(rig, lines, campaigns.ONE_BY_ONE, phases) for phases in FLAT_PHASES}
    first = None
    if rehearse is not None and (settings.combine_earlier or np.any(np.isfinite(goals.expanded))):
        # Systematic parts hardly depend on the spectrum: a flat one tells what goals leave to noise.
        tests = flats[LEAST_CREST].tests
        periods = max(round(settings.duration / settings.period / len(tests)), 1)
        first = rehearse(rig, tests, [periods] * len(tests))
    if first is None and np.any(np.isfinite(goals.expanded)):
        what = "nothing but noise is uncertain, so that no expanded uncertainty is known"
        raise SettingError("goal", what, "rig: FILE with sensitivity: 8 V/mm +- 1 %, or mass: 0.79 kg +- 5 g")
    if settings.combine_earlier:
        assert expected.earlier is not None
        common = () if first is None else tuple(source.source for source in first.sources)
        prior = expected.earlier.information_beside(model, settings.duration, common)
        rig = replace(rig, earlier=prior)
        flats = {phases: replace(of_phases, earlier=prior) for phases, of_phases in flats.items()}
        if not np.all(np.diagonal(prior.information) > 0):
            _check_identifiable(rig, lines)
    wanted = Wanted(settings.criterion, aims(limits(goals, first, model.scales), goals), settings.floor)
    return _Question(settings, title, rig, lines, goals, wanted, flats)


def _scheme(settings: PlanSettings, model: PlannedModel) -> str:
    one_force = _one_force(settings)
    if len(settings.shakers) == 1 or model.n_dof == 1 or not (one_force or not model.by_spectra):
        return settings.scheme
    if settings.scheme not in (BEST, campaigns.ONE_BY_ONE):
        hint = f"scheme: {campaigns.ONE_BY_ONE}" + (", or a force for every shaker" if one_force else "")
        what = "the rig has one force" if one_force else f"model {settings.model} is fitted to FRFs"
        raise SettingError("scheme", what, hint)
    return campaigns.ONE_BY_ONE


def _one_force(settings: PlanSettings) -> bool:
    """Whether a test records one force, by the channels of the rig, or else by the shakers."""
    if settings.sensors is None:
        return len(settings.shakers) == 1
    return sum(channel.channel.role == "input" for channel in settings.sensors.channels) == 1


def _with_budget(
    plan: Plan, question: _Question, timed: campaigns.PlannedCampaign, budget: Budget, earlier: Earlier | None
) -> Plan:
    model, goals = question.rig.model, question.goals
    random = np.array([c.error_weighted * c.scale for c in plan.coefficients])
    if timed.earlier is not None and earlier is not None:
        budget = combine_with_earlier(budget, earlier, timed, model, plan.duration)
    budget = replace(budget, random=random, drawn=None)
    coefficients = with_uncertainty(plan.coefficients, budget)
    allowed = limits(goals, budget, model.scales)
    beyond = unreachable(goals, allowed)
    needed = None
    if goals.any and not np.any(beyond):
        needed = _duration_needed(question, timed, allowed / plan.factor, plan.duration)
    never = tuple(compress(model.names, beyond))
    calibrate = calibration_notes(goals, budget, random, model.scales)
    notes = (*plan.notes, *lasting_notes(coefficients), *calibrate)
    return replace(plan, coefficients=coefficients, needed=needed, unreachable=never, notes=notes)


def _duration_needed(
    question: _Question, timed: campaigns.PlannedCampaign, allowed: FloatArray, duration: float
) -> float | None:
    least = FEWEST_PERIODS * len(timed.tests) * question.settings.period
    needed = max(time_needed(timed, allowed, duration), least)
    return needed if np.isfinite(needed) else None


def _plan_over_draws(
    plan: Plan, question: _Question, timed: campaigns.PlannedCampaign, earlier: Earlier, common: Sequence[str]
) -> Plan:
    rig, wanted = question.rig, question.wanted
    covariance = earlier.covariance_of(rig.model, common)
    if not np.all(np.isfinite(covariance)):
        return replace(plan, notes=(*plan.notes, NO_ERRORS))
    if not np.any(covariance):
        return plan
    limits, least = wanted.goals / plan.factor, question.flats[LEAST_CREST]
    drawn = spread(rig, timed, least, covariance, limits, wanted.criterion, plan.duration)
    ranges = [(float(low), float(high)) if np.isfinite(high) else None for low, high in drawn.errors.T]
    pairs = zip(plan.coefficients, ranges, strict=True)
    errors = np.array([c.error for c in plan.coefficients])
    notes = spread_notes(drawn, errors, dict(plan.gains)[LEAST_CREST], question.goals.any)
    return replace(
        plan,
        coefficients=tuple(replace(c, error_range=ends) for c, ends in pairs),
        gain_range=(float(drawn.gain[0]), float(drawn.gain[1])),
        notes=(*plan.notes, *notes),
    )


def planned_lines(settings: PlanSettings) -> IntArray:
    """Lines (n_line,) [multiples of 1 / period] that may be excited; ConfigError where none is left."""
    low, high = settings.band
    if (high - low) * settings.period > MOST_LINES or settings.sample_rate * settings.period > MOST_SAMPLES:
        what = f"a period of {settings.period:g} s has {(high - low) * settings.period:.3g} lines in the band"
        hint = f"plan with up to {MOST_LINES} lines, and up to {MOST_SAMPLES} samples a period"
        raise SettingError("period", what, hint)
    lines = np.arange(max(ceil(low * settings.period - 1e-9), 1), int(high * settings.period + 1e-9) + 1)
    frequency = lines / settings.period
    kept = np.ones(lines.size, bool)
    check_excluded(settings.exclude, settings.band)
    for first, last in settings.exclude:
        kept &= (frequency < first) | (frequency > last)
    if settings.speed is not None:
        kept &= np.abs(frequency - settings.speed) > 1.001 / settings.period
    if settings.mains is not None:
        nearest = np.maximum(np.round(frequency / settings.mains), 1) * settings.mains
        kept &= np.abs(frequency - nearest) > MAINS_WIDTH
    if np.count_nonzero(kept) < 2:
        what = f"{np.count_nonzero(kept)} lines are left in the band"
        raise SettingError("band", what, "widen `band` or lengthen `period`")
    return lines[kept]


def weighting_factor(periods: int, of_spectra: bool) -> float:
    """Standard error over that with known noise, *periods* telling it; *of_spectra*: of all channels."""
    return float(np.interp(periods, list(OF_SPECTRA), list(OF_SPECTRA.values()))) if of_spectra else 1.0


def bench(settings: PlanSettings, model: PlannedModel) -> campaigns.PlannedRig:
    """The rig of the settings. ConfigError for shakers that the model does not have."""
    names = settings.shakers or AXES[: model.n_dof]
    if len(names) > model.n_dof:
        what = f"{len(names)} shakers for {model.n_dof} directions"
        raise SettingError("shakers", what, "one or two, x and y")
    directions = np.array([_direction(name) for name in names]) if model.n_dof == 2 else np.ones((1, 1))
    if len(names) == 2 and abs(np.linalg.det(directions)) < 1e-3:
        raise SettingError("shakers", "both shakers push in one direction", "x and y")
    stated = settings.noise_density or settings.noise
    assert stated is not None
    sizes = stated.force, stated.displacement, stated.acceleration
    noise = (
        SensorDensities(*sizes)
        if settings.noise_density
        else SensorDensities.of_samples(*sizes, settings.sample_rate)
    )
    noise = replace(noise, one_force=_one_force(settings))
    limits = campaigns.RigLimits(settings.force_limit, settings.displacement_limit, settings.crest_factor)
    return campaigns.PlannedRig(
        model, noise, limits, directions.astype(complex), tuple(names), 1 / settings.period
    )


def _direction(name: str) -> tuple[float, float]:
    try:
        angle = AXIS_ANGLES[name] if name in AXIS_ANGLES else parse_value(name, "rad")
    except UnitError:
        hint = "x, y, or an angle from x such as 45 deg"
        raise SettingError("shakers", f"'{name}' is not a direction", hint) from None
    return (float(np.cos(angle)), float(np.sin(angle)))


def _check_identifiable(rig: campaigns.PlannedRig, lines: IntArray) -> None:
    # Each direction on every line, one by one.
    frequency = np.repeat(rig.spacing * lines, len(rig.directions))
    excitation = ForceVectors(frequency, np.tile(rig.directions, (lines.size, 1)))
    identified = identifiability(rig.model, rig.noise, excitation)
    if not identified.full:
        what = f"with forces along {', '.join(rig.shakers)} {identified.words}"
        raise SettingError("shakers", what, identified.remedy)


def _periods(settings: PlanSettings, design: campaigns.PlannedCampaign) -> tuple[int, ...]:
    whole = settings.duration / settings.period
    periods = tuple(int(share * whole + 0.5) for share in design.shares)
    if min(periods) < FEWEST_PERIODS:
        needed = ceil(FEWEST_PERIODS / float(design.shares.min())) * settings.period
        left = f"{settings.duration:g} s leave {min(periods)} periods for a test"
        what = f"{left}, the noise is known from {FEWEST_PERIODS} or more"
        raise SettingError("duration", what, f"a duration of {needed:g} s, or a shorter period")
    return periods


def _skip(
    settings: PlanSettings,
    rig: campaigns.PlannedRig,
    design: campaigns.PlannedCampaign,
    periods: tuple[int, ...],
) -> int:
    """Transient periods of a test: as asked for, or until free motion no longer counts, one at least."""
    if settings.skip is not None:
        return settings.skip
    timed = campaigns.with_shares(rig, design.tests, np.array(periods) / sum(periods))
    motion = campaigns.settling(rig, timed, periods)
    return 1 if motion is None else _periods_to_settle(motion, design.errors(sum(periods) * settings.period))


def _periods_to_settle(motion: campaigns.Settling, errors: FloatArray) -> int:
    settled = (n for n in range(1, MOST_SKIPPED) if np.all(np.abs(motion.shifts(n)) <= SETTLED * errors))
    return next(settled, MOST_SKIPPED)


def settling_notes(
    rig: campaigns.PlannedRig, timed: campaigns.PlannedCampaign, periods: tuple[int, ...], skip: int
) -> Iterator[str]:
    """What it costs where motion that starts with a test is not waited for to die away."""
    motion = campaigns.settling(rig, timed, periods)
    if motion is None:
        return
    errors = timed.errors(sum(periods) / rig.spacing)
    shifts = np.abs(motion.shifts(skip))
    worst = int(np.argmax(shifts / errors))
    if shifts[worst] > NOTICED * errors[worst]:
        yield (
            f"Motion has not died away after `skip: {skip}`: what is left of it shifts "
            f"{rig.model.names[worst]} by about {100 * shifts[worst]:.2g} %, "
            f"{shifts[worst] / errors[worst]:.2g} times its standard error. "
            f"`skip: {_periods_to_settle(motion, errors)}` is long enough."
        )


def _plan(
    question: _Question,
    design: DesignCandidate,
    timed: campaigns.PlannedCampaign,
    periods: tuple[int, ...],
    skip: int,
) -> Plan:
    settings, rig, wanted = question.settings, question.rig, question.wanted
    duration = sum(periods) * settings.period
    at_once = any(np.count_nonzero(campaigns.running_shakers(test)) > 1 for test in design.campaign.tests)
    factor = weighting_factor(min(periods), rig.model.stator_mass > 0 or at_once)
    planned = _poor(timed, wanted)
    gains = tuple((phases, _poor(flat, wanted) / planned) for phases, flat in question.flats.items())
    certificate = design.certificate or reference(rig, question.lines, wanted).certificate
    return Plan(
        title=question.title,
        model=rig.model.kind,
        criterion=wanted.criterion,
        scheme=design.scheme,
        design=design.criterion,
        floor=design.floor,
        period=settings.period,
        sample_rate=settings.sample_rate,
        duration=duration,
        efficiency=certificate.efficiency,
        factor=factor,
        coefficients=tuple(_coefficients(question, timed, factor, duration)),
        tests=tuple(planned_test(rig, test, n, skip) for test, n in zip(timed.tests, periods, strict=True)),
        gains=gains,
        needed=_duration_needed(question, timed, wanted.goals / factor, duration)
        if question.goals.any
        else None,
        mass=settings.mass,
        notes=(*_notes(rig, question.lines, design, wanted), *settling_notes(rig, timed, periods, skip)),
        combined=rig.earlier is not None,
    )


def _poor(tests: campaigns.PlannedCampaign, wanted: Wanted) -> float:
    """How poor the tests are, by what is wanted."""
    return campaigns.score(tests.information, wanted.criterion, wanted.goals)


def _coefficients(
    question: _Question, timed: campaigns.PlannedCampaign, factor: float, duration: float
) -> Iterator[PlannedCoefficient]:
    model, goals = question.rig.model, question.goals
    errors, others = timed.errors(duration), question.flats[LEAST_CREST].errors(duration)
    columns = np.array([model.expected, model.scales, errors, factor * errors, others]).T.tolist()
    for number, (expected, scale, error, weighted, other) in enumerate(columns):
        random, expanded = float(goals.random[number]), float(goals.expanded[number])
        yield PlannedCoefficient(
            model.names[number],
            model.units[number],
            expected,
            scale,
            error,
            weighted,
            other,
            goal=random if np.isfinite(random) else None,
            goal_expanded=expanded if np.isfinite(expanded) else None,
        )


def time_needed(campaign: campaigns.PlannedCampaign, limits: FloatArray, duration: float) -> float:
    """Time [s] of the campaign after which no relative standard error exceeds its limit (n_coefficient,) [1],
    of a *duration* [s] or not. Infinite where more than LONGEST times the duration would be needed.
    """
    if campaign.earlier is None:
        return float(duration * np.max(campaign.errors(duration) / limits) ** 2)
    low = float(-np.log(LONGEST))
    return duration * least_factor(low, lambda factor: np.all(campaign.errors(duration * factor) <= limits))


def planned_test(
    rig: campaigns.PlannedRig, test: campaigns.Multisines, periods: int, skip: int
) -> PlannedTest:
    """A test of *periods* periods, after *skip* that are dropped, as it is written down."""
    running = campaigns.running_shakers(test)
    forces = test.forces[:, running]
    names = tuple(compress(rig.shakers, running))
    stem = "-".join(name.replace(" ", "") for name in names)
    ends = [f"-{name.replace(' ', '')}" for name in names] if len(names) > 1 else [""]
    files = tuple(f"{stem}{end}.csv" for end in ends)
    return PlannedTest(
        name=stem,
        periods=periods,
        skip=skip,
        shakers=names,
        files=files,
        frequency=tuple((rig.spacing * test.lines).tolist()),
        amplitude=tuple(tuple(column) for column in np.abs(forces).T.tolist()),
        phase=tuple(tuple(column) for column in np.angle(forces).T.tolist()),
        crest_factor=tuple(campaigns.crest_factors(test).tolist()),
        peak_force=tuple(peaks(test.lines, forces).tolist()),
        peak_displacement=tuple(campaigns.largest_motion(rig, test, (skip + periods) / rig.spacing).tolist()),
    )


def _notes(
    rig: campaigns.PlannedRig, lines: IntArray, design: DesignCandidate, wanted: Wanted
) -> tuple[str, ...]:
    notes = []
    if design.criterion == "flat":
        notes.append(FLAT_IS_BEST)
    elif design.floor == 0:
        notes.append(NO_FLOOR)
    if len(rig.shakers) < rig.model.n_dof:
        both = campaigns.PlannedRig(
            rig.model, rig.noise, rig.limits, np.eye(2, dtype=complex), AXES, rig.spacing
        )
        ratio = _poor(design.campaign, wanted) / _poor(flat(both, lines, campaigns.ONE_BY_ONE), wanted)
        if ratio > MUCH_WORSE:
            alone = f"Forces along {rig.shakers[0]} alone leave errors {ratio:.2g} times those"
            notes.append(f"{alone} of a flat multisine in x, then in y.")
    return tuple(notes)
