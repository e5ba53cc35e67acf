"""From the section rotor_system to its result: the tests as evidence, the posterior or a named alternative,
predictions, weights, what to measure next.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import plain_text
from labpipe.distributions import chi2_tail, normal_tail
from labpipe.errors import ConfigError, DataError, FitError, locate_errors
from labpipe.estimation.measured import Measured, matrix_errors, measured_part
from labpipe.methods.rotor.theory import BROKEN, KEPT, LEAST_DECREMENT, decision
from labpipe.methods.rotor_system import build, evidence, predictions, records
from labpipe.methods.rotor_system.model import Unknown
from labpipe.methods.rotor_system.posterior import (
    WIDENED,
    Explanation,
    Pull,
    SystemPosterior,
    budget,
    common_changes,
    explanations,
    fit_system,
    normality,
    pulls,
    refit,
)
from labpipe.methods.rotor_system.settings import MODES, RESPONSE, RotorSystemSettings, SystemTest, place_of
from labpipe.methods.run_ups.records import RunUp
from labpipe.methods.run_ups.section import read_measured_run
from labpipe.project.work import Work
from labpipe.quantities import UnitError
from labpipe.records.finding import NORMAL, NOTE, WARNING, Finding, note
from labpipe.records.fit_details import Modes
from labpipe.records.response import FrequencyResponse
from labpipe.records.uncertain import Uncertain
from labpipe.registry import nearest
from labpipe.spectra.convert import DERIVATIVES

# What was read for a test: its FRF in its band, or its run-up.
Reading = Measured | RunUp
# Speeds of a Campbell diagram.
SPEEDS = 41
# A common change of all bearings that the tests at speed tell no better than this, is not told.
FAINT = 0.15
# Fall of chi-square by one further unknown from which tests disagree, the square of standard errors; falls
# that differ by less, a factor of 20 between likelihoods, tell nothing.
TELLING, UNDECIDED = 16.0, 6.0
# Logarithm of a factor up to which a straight line from the fit says how large it would have to be.
FAR = 3.0
# Share of the critical speed up to which one more run-up would go.
NEARER = 0.95


def run_rotor_system(settings: RotorSystemSettings, work: Work) -> records.RotorSystemResult:
    """The result of the section; LabpipeError names it and the test."""
    system = settings.system
    assert system is not None
    with locate_errors(f"{work.pipeline.path}: rotor_system"):
        check_counts_once(settings.tests, work)
        readings = {test.name: reading for test in settings.tests if (reading := _reading(test, work))}
        sensors = {test.name: sensors_of(test, readings.get(test.name)) for test in settings.tests}
        work.tell(f"rotor     {system.rig.name}: {len(settings.tests)} tests together")
        out_of_place = list(_interlacing(settings, system, work))
        try:
            built, posterior = _fit(settings, system, sensors, work, readings)
        except FitError as error:
            error.hint = "; ".join(finding.message for finding in out_of_place) or error.hint
            raise
        speeds = np.linspace(*settings.band, SPEEDS)
        result = system_result(system, built, posterior, speeds, settings.draws, settings.seed)
        measured = (
            (test.speed, float(frequency))
            for test in settings.tests
            if test.kind == RESPONSE and not test.free and test.has_modes
            for frequency in free_modes_of(test, work).frequency
        )
        weights = predictions.balance(settings, built, posterior, result.criticals)
        findings = (*result.findings, *out_of_place)
        if settings.standard:
            findings = (*findings, *limits_of(settings.standard, result))
        return replace(result, balance=weights, measured=tuple(measured), findings=findings)


def limits_of(standard: str, result: records.RotorSystemResult) -> Iterator[Finding]:
    """What a rotor does not keep of a *standard* at its operating speed, by its *result*; a note where its
    intervals do not say.
    """
    speed = f"at {60 * result.operating:.0f} rpm"
    limits = [
        (
            f"the separation margin of the critical speed of {60 * critical.speed:.0f} rpm {speed} is "
            f"{critical.margin[0]:.1f} %, where {critical.margin[1]:.1f} % are asked for",
            critical.met,
        )
        for critical in result.criticals
        if critical.margin is not None and critical.met is not None
    ]
    least, _, probability = result.decrement
    asked = f"where more than {LEAST_DECREMENT:g} is asked for"
    for what, kept in [*limits, (f"the least log decrement {speed} is {least:.3g}, {asked}", probability)]:
        if (word := decision(kept)) != KEPT:
            message = f"{standard}: {what}; kept with a probability of {100 * kept:.0f} %: {word}"
            yield Finding("standard-limit", message, WARNING if word == BROKEN else NOTE)


def check_counts_once(tests: Sequence[SystemTest], work: Work) -> None:
    """ConfigError for modes of a fit beside lines of the FRF that it is of."""
    fits = [(test, fit) for test in tests for fit in work.fits if test.kind == MODES and fit.name == test.fit]
    for modes, fit in fits:
        for other in tests:
            begin, end = other.band or (0.0, np.inf)
            same_lines = begin < fit.band_hz[1] and fit.band_hz[0] < end
            if other.kind == RESPONSE and other.test == fit.test and same_lines:
                what = f"'{modes.name}' is a fit of the FRF of '{other.name}'"
                raise ConfigError(what, hint="its lines count once; leave one of them out")


def _fit(
    settings: RotorSystemSettings,
    system: build.RotorSystem,
    sensors: Mapping[str, build.Sensors],
    work: Work,
    readings: Mapping[str, Reading],
) -> tuple[build.Built, SystemPosterior]:

    def fit_alternative(alternative: str) -> tuple[build.Built, SystemPosterior]:
        built = build.build(system, settings.small_errors, sensors, alternative)
        tests = [evidence_of(test, built, system, work, readings.get(test.name)) for test in settings.tests]
        return built, replace(fit_system(built.model, tests), alternative=alternative)

    alternatives = [build.PEDESTALS] if not system.pedestals else []
    running = any(sensor.turning for sensor in sensors.values())
    alternatives += [build.TOGETHER] if running and not settings.small_errors.together else []
    return most_probable(fit_alternative, alternatives)


def most_probable(
    fitted: Callable[[str], tuple[build.Built, SystemPosterior]], alternatives: Sequence[str]
) -> tuple[build.Built, SystemPosterior]:
    """The fit of the rotor as it is declared, "", or of the most probable alternative to it where a test
    misfits or small errors are large; fitted to moved data where it is not normal.
    """
    fits: list[tuple[build.Built, SystemPosterior]] = []
    faults: list[FitError] = []
    for alternative in ("", *alternatives):
        try:
            fits.append(fitted(alternative))
        except FitError as error:
            # A rotor that misses what there is may fit nowhere.
            faults.append(error)
        doubtful = faults or fits[0][1].misfits or fits[0][1].enlarged
        if not doubtful:
            break
    if not fits:
        raise faults[0]
    built, posterior = max(fits, key=lambda fit: fit[1].ln_evidence)
    if doubtful:
        posterior = replace(posterior, widened=WIDENED)
    excess, bearable = normality(posterior)
    return built, replace(refit(posterior), normal=False) if excess > bearable else posterior


def _reading(test: SystemTest, work: Work) -> Reading | None:
    if test.kind == RESPONSE:
        return measured_in_band(test, _response(test, work))
    if test.run is None:
        return None
    # Two tests may have recordings of one name, in folders of their own.
    run = read_measured_run(replace(test.run, name=test.name), work.output, work.pipeline.folder).run
    if run.shaker is not None:
        raise DataError(f"test '{test.name}': a shaker excites this run", hint="give it as an FRF")
    return run


def sensors_of(test: SystemTest, reading: Reading | None) -> build.Sensors:
    """The channels of a *reading* with the uncertainties that are stated of them; else none."""
    if isinstance(reading, Measured):
        labels = tuple(port.label for port in reading.outputs)
        stated = tuple(error.uncertainty for error in matrix_errors(reading, directions=True))
        return build.Sensors(labels, test.gain, test.speed > 0, calibrations=stated)
    if reading is not None:
        labels = tuple(f"{plane} {axis}" for plane in reading.planes for axis in ("x", "y"))
        stated = tuple(error.uncertainty for error in reading.uncertainties)
        return build.Sensors(labels, test.gain, True, True, stated)
    return build.Sensors(())


def _response(test: SystemTest, work: Work) -> FrequencyResponse:
    response = next((response for response in work.responses if response.name == test.test), None)
    if response is None:
        names = [response.name for response in work.responses]
        raise ConfigError(f"test '{test.name}': no FRF '{test.test}'", hint=nearest(test.test, names))
    return response


def evidence_of(
    test: SystemTest, built: build.Built, system: build.RotorSystem, work: Work, reading: Reading | None
) -> evidence.SystemEvidence:
    """What a *test* says of the unknowns: its *reading*, or what its entries state."""
    if isinstance(reading, Measured):
        outputs, inputs = (
            tuple(_dof(system, _place(test, port.dof, port.label)) for port in ports)
            for ports in (reading.outputs, reading.inputs)
        )
        assert reading.variance is not None
        # A window spreads the noise of a line over its neighbours.
        error = np.sqrt(reading.shared_noise * reading.variance / 2)
        return evidence.Responses(
            test.name,
            reading.omega,
            outputs,
            inputs,
            reading.matrix,
            error.reshape(reading.matrix.shape),
            spin=2 * np.pi * test.speed,
            supported=not test.free,
            gains=built.gains[test.name],
            changes={
                built.sources[error.uncertainty.source]: error.change
                for error in matrix_errors(reading, directions=True)
            },
            shared=reading.shared_noise,
            leakage=reading.leakage,
        )
    if reading is not None:
        return _vectors(test, reading, built, system)
    return free_modes_of(test, work) if test.has_modes else _deflections(test, system)


def _deflections(test: SystemTest, system: build.RotorSystem) -> evidence.Deflections:
    places = [(_dof(system, to), _dof(system, force), number) for to, force, number in test.read_deflections]
    outputs = tuple(dict.fromkeys(output for output, _, _ in places))
    inputs = tuple(dict.fromkeys(force for _, force, _ in places))
    measured, error = (np.full((len(outputs), len(inputs)), np.nan) for _ in range(2))
    for output, force, number in places:
        at = outputs.index(output), inputs.index(force)
        measured[at], error[at] = number.value, number.std_error
    whole = evidence.Deflections(test.name, outputs, inputs, measured, error)
    if test.mass is None:
        return whole
    share = test.mass.std_error / test.mass.value
    return replace(whole, mass=float(np.log(test.mass.value)), mass_error=share)


def _dof(system: build.RotorSystem, place: tuple[int, str]) -> int:
    node, direction = place
    return system.rig.rotor.dofs(node)["yz".index(direction)]


def free_modes_of(test: SystemTest, work: Work) -> evidence.FreeModes:
    """Modes of the one modal fit that a *test* names, or those that it states; ConfigError."""
    if test.fit:
        modal = [fit for fit in work.fits if fit.detail(Modes) is not None]
        chosen = [fit for fit in modal if fit.name == test.fit]
        if len(chosen) != 1:
            what = f"test '{test.name}': there are {len(chosen) or 'no'} modal fits '{test.fit}'"
            hint = "name one test, in one band" if chosen else nearest(test.fit, [fit.name for fit in modal])
            raise ConfigError(what, hint=hint)
        (fit,) = chosen
        modes = fit.detail(Modes)
        assert modes is not None
        # By the interval: it holds the model error as well.
        intervals = {p.name: p.ci95 for p in fit.parameters if p.ci95 is not None}
        errors = {name: (high - low) / (2 * NORMAL) for name, (low, high) in intervals.items()}
        frequency, damping = np.array(modes.frequency), np.array(modes.damping_ratio)
        modes_of = range(1, frequency.size + 1)
        f_error, d_error = (
            np.array([errors.get(f"{name}_{n}", np.nan) for n in modes_of]) for name in ("f_n", "zeta")
        )
        damping = np.where(np.isfinite(d_error), damping, np.nan)
        if not np.all(np.isfinite(f_error)):
            raise DataError(f"test '{test.name}': a mode of fit '{test.fit}' has no interval")
    else:
        unknown = [Uncertain(np.nan, np.nan)] * len(test.frequencies)
        (frequency, f_error), (damping, d_error) = (
            np.array([(number.value, number.std_error) for number in numbers]).T
            for numbers in (test.read_frequencies, test.read_damping or unknown)
        )
    numbers = np.array(test.numbers or range(1, frequency.size + 1), dtype=int)
    if numbers.size != frequency.size:
        raise ConfigError(f"test '{test.name}': {numbers.size} numbers for {frequency.size} modes")
    return evidence.FreeModes(test.name, numbers, frequency, f_error / frequency, damping, d_error / damping)


def measured_in_band(test: SystemTest, response: FrequencyResponse) -> Measured:
    """The FRF of a test in its band."""
    if response.form not in DERIVATIVES:
        hint = "a response to a force is needed"
        raise DataError(f"test '{test.name}': its FRF is a {response.form}", hint=hint)
    if response.variance is None:
        raise DataError(f"test '{test.name}': the noise of its FRF is not known")
    whole = (*response.outputs, *response.inputs)
    _check_places(test, [name for port in whole for name in (port.dof, port.label)])
    low, high = test.band or (0.0, np.inf)
    kept = (response.frequency >= max(low, 1e-9)) & (response.frequency <= high)
    if not kept.any():
        raise DataError(f"test '{test.name}': no line lies in its band")
    if np.any(response.variance[kept] <= 0):
        raise DataError(f"test '{test.name}': the noise of its FRF is zero", hint="state its variance")
    rows, columns = (list(range(n)) for n in response.matrix.shape[1:])
    return measured_part(response, rows, columns, kept)


def _interlacing(settings: RotorSystemSettings, system: build.RotorSystem, work: Work) -> Iterator[Finding]:
    with_modes = [test for test in settings.tests if test.has_modes]
    free = [test for test in with_modes if test.kind != RESPONSE or test.free]
    coupled = any(
        np.any((np.abs(b.stiffness) + b.stiffness_error)[[0, 1], [1, 0]]) for b in system.linear.values()
    ) or len(system.linear) < len(system.rig.bearings)
    for test in with_modes:
        if test.kind != RESPONSE or test.free or test.speed:
            continue
        inputs = [_place(test, p.dof, p.label)[1] for p in _response(test, work).inputs]
        planes = 2 if coupled else len(set(inputs))
        bearings, pedestals = len(system.rig.bearings), len(system.pedestals)
        for hung in free:
            modes = free_modes_of(hung, work), free_modes_of(test, work)
            for place, number, below in evidence.out_of_order(*modes, planes, bearings, pedestals):
                rotor, stands = (m.frequency[n - 1] for m, n in zip(modes, (number, place), strict=True))
                side = "below" if below else "above"
                what = "springs" if below else f"{bearings} springs, no mode missed,"
                yield Finding(
                    "interlacing",
                    f"test '{test.name}': mode {place} at {stands:.4g} Hz lies {side} bending mode {number} "
                    f"of test '{hung.name}', {rotor:.4g} Hz, as no {what} to ground can make it: another "
                    "assembly, other masses or joints, or a negative stiffness (of a controller)",
                )


def _check_places(test: SystemTest, names: Sequence[str]) -> None:
    for name in test.read_places:
        if name not in names:
            what = f"test '{test.name}': places: no dof or plane '{name}'"
            raise ConfigError(what, hint=nearest(name, names))


def _place(test: SystemTest, *names: str) -> tuple[int, str]:
    """Where a dof or plane is: as `places` says, else as its name does ("3y", "node 3")."""
    places, directed = test.read_places, test.kind == RESPONSE
    for name in names:
        if name in places:
            return places[name]
    for name in names:
        with suppress(UnitError):
            return place_of(name if directed else name.removeprefix("node"), directed)
    hint = f"places: {{{names[0]}: {'3 y' if directed else '3'}}}"
    raise ConfigError(f"test '{test.name}': where on the rotor is '{names[0]}'?", hint=hint)


def _vectors(
    test: SystemTest, run: RunUp, built: build.Built, system: build.RotorSystem
) -> evidence.RunUpVectors:
    _check_places(test, [*run.planes, *run.unbalance])
    loaded, nodes = test.axes == "load", [_place(test, plane)[0] for plane in run.planes]
    # x along the load is -z, and y a quarter turn further with the spin is y.
    outputs = [dof for node in nodes for dof in system.rig.rotor.dofs(node)[:: -1 if loaded else 1]]
    signs = np.tile([-1.0 if loaded else 1.0, 1.0], len(nodes))

    def by_probe(values: ComplexArray) -> ComplexArray:
        return signs * values.reshape(run.n_speed, -1)

    error = np.sqrt((run.amplitude_error**2 + (np.abs(run.response) * run.phase_error) ** 2) / 2)
    added = tuple(
        (system.rig.rotor.dofs(_place(test, plane)[0])[0], amount * (-1j if loaded else 1.0))
        for plane, amount in run.unbalance.items()
        if amount
    )
    for dof, _ in added:
        if dof not in [first for first, _, _ in built.planes.values()]:
            what = f"an unbalance was added at node {dof // 4 + 1}, where the rotor file has none"
            raise ConfigError(f"test '{test.name}': {what}")
    return evidence.RunUpVectors(
        test.name,
        run.speed,
        tuple(outputs),
        by_probe(run.response),
        evidence.run_up_whitener(error.reshape(run.n_speed, -1).T, test.slow_roll),
        planes=tuple(built.planes.values()),
        added=added,
        gains=built.gains[test.name],
        phases=built.phases[test.name],
        changes={built.sources[source]: by_probe(change) for source, change in run.changes().items()},
        net=None if run.baseline is None else (run, signs * run.baseline_changes()),
    )


def declared_result(system: build.RotorSystem, speeds: FloatArray) -> records.RotorSystemResult:
    """What a rotor file says before anything is measured, over *speeds* (n_speed,) [Hz]: intervals by what it
    declares.
    """
    built = build.build(system, build.SmallErrors(), {})
    posterior = fit_system(built.model, [], estimate_sizes=False)
    return system_result(system, built, posterior, speeds, predictions.DRAWS // 2, 1)


def system_result(
    system: build.RotorSystem,
    built: build.Built,
    posterior: SystemPosterior,
    speeds: FloatArray,
    n_draw: int,
    seed: int,
) -> records.RotorSystemResult:
    """The section of a result: what *posterior* says of unknowns, tests, critical speeds and stability.

    *speeds* (n_speed,) [rad/s] of the diagrams, rising; *n_draw* draws of the amplitudes from *seed*.
    """
    rig = system.rig
    low, high = band = float(speeds[0]), float(speeds[-1])
    operating = rig.speed if rig.speed > 0 else high
    diagram = predictions.campbell(posterior, np.union1d(speeds, [operating]))
    pulled = pulls(posterior)
    least, error, gradient = predictions.least_decrement(posterior, operating)
    short = LEAST_DECREMENT - least
    above = float(normal_tail(short / error)) if error else float(short < 0)
    criticals: list[records.CriticalResult] = []
    if built.planes:
        nodes = sorted({rig.response, *built.planes, *(place.node for place in rig.bearings)})
        outputs = [dof for node in nodes for dof in rig.rotor.dofs(node)]
        # No unbalance in the middle, as without a run-up, makes no peak: that of its uncertainty does
        values = posterior.values.copy()
        for _, real, imaginary in built.planes.values():
            if values[real] == values[imaginary] == 0:
                values[real] = built.model.errors[real]
        shaken = replace(posterior, values=values)
        criticals = predictions.critical_speeds(shaken, built, band, rig.speed, outputs, n_draw, seed)
    return records.RotorSystemResult(
        rig.name,
        operating,
        unknowns=tuple(_unknowns(posterior, pulled)),
        tests=tuple(
            records.SystemTestResult(test.name, test.kind, *chi2, chi2_tail(*chi2), pull.unknown, pull.z)
            for test, pull, chi2 in zip(posterior.tests, pulled, posterior.chi2.values(), strict=True)
        ),
        small_errors=tuple(
            records.SmallErrorResult(group, built.model.groups[group], size)
            for group, size in posterior.sizes.items()
        ),
        campbell=diagram,
        decrement=(least, error, above),
        criticals=tuple(criticals),
        onset=predictions.onset(posterior, max(low, 0.05 * operating)),
        next_tests=_next_tests(posterior, gradient / least, criticals) if least > 0 else {},
        budget=budget(posterior, gradient) if least > 0 else {},
        ln_evidence=posterior.ln_evidence,
        alternative=posterior.alternative,
        widened=posterior.widened,
        findings=tuple(findings_of(posterior)),
    )


def _unknowns(posterior: SystemPosterior, pulled: Sequence[Pull]) -> Iterator[records.UnknownResult]:
    shares = posterior.shares
    for number, unknown in enumerate(posterior.model.unknowns):
        value, error = float(posterior.values[number]), float(posterior.standard_errors[number])
        yield records.UnknownResult(
            unknown.name,
            *_people(unknown, value, error),
            *_people(unknown, unknown.mean, unknown.error),
            unknown.unit or unknown.nominal_unit,
            unknown.group,
            bool(shares[number] < 0.7),
            *max(
                ((pull.test, float(pull.wider[number])) for pull in pulled),
                key=itemgetter(1),
                default=("", 1.0),
            ),
        )


def _people(unknown: Unknown, value: float, error: float) -> tuple[float, float]:
    if unknown.unit:
        return value, error
    amount = unknown.nominal * float(np.exp(value))
    return amount, abs(amount) * error


def findings_of(posterior: SystemPosterior) -> Iterator[Finding]:
    """Tests that no rotor of the file gives, tests and numbers that disagree, notes on intervals."""
    for name, tail in posterior.misfits.items():
        chi2, n = posterior.chi2[name]
        yield Finding(
            "model-mismatch",
            f"test '{name}': chi-square {chi2:.0f} of {n} data (probability {tail:.1g}); no rotor of this "
            "file gives it together with the other tests",
        )
    if posterior.alternative:
        yield Finding(
            "alternative",
            f"the rotor of the file is less probable than one with {posterior.alternative}; the numbers are "
            "of that one",
        )
    for group, ratio in posterior.enlarged.items():
        yield Finding(
            "enlarged-errors",
            f"small errors of {group.replace('_', ' ')} are {ratio:.1f} times as large as declared; "
            "intervals of predictions are widened by half",
        )
    explained = explanations(posterior)
    if any(explanation.fall > TELLING and explanation.test for explanation in explained):
        text = f"tests of one rotor disagree: {explained_text(posterior, explained)}"
        yield Finding("tests-disagree", text)
    for name, z in posterior.contradicted:
        text = f"the tests contradict the declared {name}, by {abs(z):.1f} of its uncertainties"
        yield Finding("stated-value", text)
    yield from _notes(posterior)


def explained_text(posterior: SystemPosterior, explained: Sequence[Explanation]) -> str:
    """The most telling explanations of tests that disagree, best first, as a text."""

    def words(cause: Explanation) -> str:
        if cause.group:
            group = cause.group.replace("_", " ")
            return f"small errors of {group} {cause.value:.1f} times as large as declared"
        unknown = posterior.model.unknowns[cause.number]
        if not unknown.unit and abs(cause.value - unknown.mean) > FAR:
            return f"another {unknown.name} in test '{cause.test}'"
        value, unit = _people(unknown, cause.value, 0.0)[0], unknown.unit or unknown.nominal_unit
        return f"{unknown.name} of {plain_text(value, unit, 3)} in test '{cause.test}'"

    text = ", ".join(f"by {cause.fall:.0f} with {words(cause)}" for cause in explained[:2])
    same = len(explained) > 1 and explained[0].fall - explained[1].fall < UNDECIDED
    return f"chi-square falls {text}" + ("; which of them, the tests cannot tell" if same else "")


def _notes(posterior: SystemPosterior) -> Iterator[Finding]:
    if posterior.refits is not None:
        yield note(
            "first-order",
            "a normal posterior does not fit the tests: its intervals are those of "
            f"{len(posterior.refits)} fits of data that were moved by their own noise",
        )
    elif not posterior.normal:
        yield Finding(
            "first-order",
            "a normal posterior does not fit the tests, and fits of data that were moved by their own noise "
            "lose the rotor: intervals are approximate, and another test is needed",
        )
    for what, spread in common_changes(posterior).items():
        if spread > FAINT:
            tell = f"tell it to {100 * spread:.0f} % only" if spread < 1 else "do not tell it"
            yield note(
                "bearings-at-speed",
                f"a change of the {what} of all bearings at speed against rest: the tests {tell}; if they "
                "may change together, declare small_errors: {together: 30 %}, or run nearer to the critical "
                "speed",
            )
    untold = [
        unknown.name
        for unknown, share in zip(posterior.model.unknowns, posterior.shares, strict=True)
        if share >= 0.7 and not unknown.group and not unknown.name.startswith(records.SENSORS)
    ]
    if untold:
        yield note("not-told-by-tests", f"no test tells {', '.join(untold)}")


def _next_tests(
    posterior: SystemPosterior, gradient: FloatArray, criticals: Sequence[records.CriticalResult]
) -> dict[str, float]:
    """Standard error of a prediction with this *gradient* (n_unknown,), as it is and with one more test of
    each kind: u' = sqrt(g^T (F + F_c)^-1 g).
    """
    candidates: dict[str, evidence.SystemEvidence] = {
        f"{test.name} once more": test for test in posterior.tests
    }
    for test in posterior.tests:
        if not isinstance(test, evidence.RunUpVectors):
            continue
        above = [at for peak in criticals if (at := 2 * np.pi * peak.speed) > test.speed[-1]]
        if above and (top := NEARER * min(above)) > 1.02 * test.speed[-1]:
            speed = np.linspace(test.speed[0], top, test.speed.size)
            nearer = test.plan(speed, np.median(test.noise, axis=1))
            candidates[f"{test.name} up to {30 / np.pi * top:.0f} rpm"] = nearer
    spreads = {name: posterior.covariance_with(test) for name, test in candidates.items()}
    spreads = {"as it is": posterior.covariance} | spreads
    roots = {name: float(np.sqrt(gradient @ spread @ gradient)) for name, spread in spreads.items()}
    return {name: posterior.widened * root for name, root in roots.items()}
