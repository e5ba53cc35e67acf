"""The section rotor_system: its rules, lists, lines and report."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.display import amount_text, number, plain_text, probability_text, with_error
from labpipe.methods.rotor.theory import DECISIONS, LEAST_DECREMENT, decision, drawn_decrements
from labpipe.methods.rotor_system.build import APPARENT
from labpipe.methods.rotor_system.evaluate import run_rotor_system
from labpipe.methods.rotor_system.records import (
    SENSORS,
    CriticalResult,
    RotorSystemResult,
    SmallErrorResult,
    VibrationResult,
)
from labpipe.methods.rotor_system.settings import RotorSystemSettings
from labpipe.project.judging import CompareNumber, compare_warnings
from labpipe.project.rules import Rule
from labpipe.records.finding import NORMAL, WARNING, Finding, Parameter, of_level
from labpipe.records.identification import Identification, ListedParameter, RuleOutcome
from labpipe.records.sections import PipelineSection
from labpipe.registry import nearest
from labpipe.report.chart import Axis, Panel, Series, curve, dots, level, look, stack, upright
from labpipe.report.document import Block, Figure, Paragraph, Section, Table

NAME = "rotor_system"
RPM = 60.0
UM = 1e6
# Share of a variance from which a source is a row of the budget.
LEAST_SHARE = 0.01


def _amounts(result: RotorSystemResult) -> dict[str, tuple[float, float | None, str]]:
    amounts: dict[str, tuple[float, float | None, str]] = {
        unknown.name.replace(" ", "_"): (unknown.value, unknown.error, unknown.unit)
        for unknown in result.unknowns
        if not unknown.group
    }
    amounts["least_decrement"] = (result.decrement[0], result.decrement[1], "1")
    amounts["decrement_probability"] = (result.decrement[2], None, "1")
    if result.onset is not None:
        speed, error = result.onset
        amounts["onset"] = (speed, speed * error, "Hz")
    for place, critical in enumerate(result.criticals, 1):
        amounts[f"critical_speed_{place}"] = (critical.speed, _error(critical.speed_interval), "Hz")
        if critical.amplification is not None and critical.amplification_interval is not None:
            error = _error(critical.amplification_interval)
            amounts[f"amplification_{place}"] = (critical.amplification, error, "1")
        if critical.met is not None:
            amounts[f"margin_probability_{place}"] = (critical.met, None, "1")
    if result.balance is not None:
        amounts["vibration_left"] = (result.balance.after, _error(result.balance.interval), "m")
    return amounts


def _error(interval: tuple[float, float]) -> float:
    return (interval[1] - interval[0]) / (2 * NORMAL)


def _ends(interval: Iterable[float], factor: float = 1.0, form: str = ".3g") -> str:
    return " to ".join(f"{float(f'{factor * end:{form}}'):.6g}" for end in interval)


def outcome(rule: Rule, result: RotorSystemResult, compare_number: CompareNumber) -> RuleOutcome:
    """The outcome of a rule such as "rotor_system.least_decrement >= 0.1"; ConfigError at its place for what
    the result does not have.
    """
    if rule.item == "warnings":
        return rule.outcome(*compare_warnings(rule, result.findings))
    decisions = {
        f"margin_{place}": decision(critical.met)
        for place, critical in enumerate(result.criticals, 1)
        if critical.met is not None
    }
    decisions["decrement"] = decision(result.decrement[2])
    if rule.item in decisions:
        word = decisions[rule.item]
        if rule.bound not in DECISIONS:
            raise rule.fault(f"unknown decision '{rule.bound}'", nearest(rule.bound, DECISIONS))
        return rule.outcome(word, word == rule.bound)
    amounts = _amounts(result)
    if rule.item not in amounts:
        hint = nearest(rule.item, [*amounts, *decisions, "warnings"])
        raise rule.fault(f"the rotor has no '{rule.item}'", hint)
    value, error, unit = amounts[rule.item]
    return rule.outcome(*compare_number(rule, value, unit, error))


def findings(result: RotorSystemResult) -> Iterator[tuple[str, Finding]]:
    """All of them, under the rotor's name."""
    return ((result.rotor, finding) for finding in result.findings)


def list_parameters(result: RotorSystemResult) -> Iterator[ListedParameter]:
    """Unknowns and predictions."""
    codes = tuple(dict.fromkeys(finding.code for finding in of_level(WARNING, result.findings)))
    for name, (value, error, unit) in _amounts(result).items():
        parameter = Parameter(name, value, unit, derived=True, std_error=error)
        yield ListedParameter(fit=NAME, parameter=parameter, model="rotor-system", warnings=codes)


def lines(result: RotorSystemResult) -> Iterator[str]:
    """What the tests say together, in lines."""
    yield f"{result.rotor}: {len(result.tests)} tests together"
    for unknown in result.unknowns:
        if not unknown.group and not unknown.name.startswith(SENSORS):
            mark = "" if unknown.told else "   (no test tells)"
            yield f"  {unknown.name:<28} {_text(unknown.value, unknown.error, unknown.unit)}{mark}"
    yield from sentences(result)


def _least_name(result: RotorSystemResult) -> str:
    """Of which mode the least decrement is, as the Campbell diagram shows it at the operating speed."""
    diagram, name = result.campbell, f"least log decrement at {RPM * result.operating:.0f} rpm"
    row = int(np.argmin(np.abs(diagram.speed - result.operating)))
    mode = int(np.argmin(np.abs(np.nan_to_num(diagram.log_decrement[row], nan=np.inf) - result.decrement[0])))
    is_there = np.isclose(diagram.log_decrement[row, mode], result.decrement[0], rtol=1e-6)
    return f"{name} (mode of {diagram.frequency[row, mode]:.4g} Hz)" if is_there else name


def sentences(result: RotorSystemResult) -> Iterator[str]:
    """Critical speeds, stability, weights and what to measure next."""
    operating = RPM * result.operating
    for critical in result.criticals:
        yield _critical_sentence(critical, operating)
    least, error, probability = result.decrement
    yield (
        f"{_least_name(result)}: {with_error(least, error)}, above {LEAST_DECREMENT:g} "
        f"with a probability of {100 * probability:.0f} %: {decision(probability)}"
    )
    if result.onset is None:
        yield "no instability within the speeds looked at"
    else:
        speed, spread = result.onset
        yield f"unstable from {RPM * speed:.0f} rpm on (standard error {100 * spread:.1f} %)"
    yield from _weights(result)
    yield from _next(result)


def _weights(result: RotorSystemResult) -> Iterator[str]:
    balance = result.balance
    if balance is None:
        return
    for weight in balance.weights:
        size, angle = UM * weight.size, np.degrees(weight.angle)
        yield f"weight at node {weight.node}: {size:.4g} g mm at {angle:.1f} deg"
    yield (
        f"vibration (rms of the probes): {UM * balance.before:.3g} um as it is, {UM * balance.after:.3g} "
        f"um expected with the weights (95 %: {_ends(balance.interval, UM)} um)"
    )
    best = min(balance.next_runs, key=balance.next_runs.__getitem__)
    yield f"one more run with {best} first: {UM * balance.next_runs[best]:.3g} um expected"


def _next(result: RotorSystemResult) -> Iterator[str]:
    others = {name: error for name, error in result.next_tests.items() if name != "as it is"}
    if others:
        best = min(others, key=others.__getitem__)
        yield (
            f"next: {best}; the standard error of the least decrement falls from "
            f"{100 * result.next_tests['as it is']:.2g} to {100 * others[best]:.2g} %"
        )


def _critical_sentence(critical: CriticalResult, operating: float) -> str:
    ends = _ends(critical.speed_interval, RPM, ".0f")
    text = f"critical speed {RPM * critical.speed:.0f} rpm (95 %: {ends}) at {critical.place}"
    if critical.amplification is None or critical.amplification_interval is None:
        return f"{text}; no half-power points within the speeds"
    ends = _ends(critical.amplification_interval)
    text += f", amplification {critical.amplification:.3g} (95 %: {ends})"
    if critical.missing > 0.05:
        text += f"; in {100 * critical.missing:.0f} % of the draws there is none"
    if critical.margin is None or critical.met is None:
        return f"{text}; no margin is asked for"
    there, asked = critical.margin
    return (
        f"{text}; margin to {operating:.0f} rpm {there:.1f} %, {asked:.1f} % asked for, met with a "
        f"probability of {100 * critical.met:.0f} %: {decision(critical.met)}"
    )


def sections(result: RotorSystemResult, _identification: Identification) -> tuple[Section, ...]:
    """The section of the report."""
    return (Section(f"Rotor: {result.rotor}", result_blocks(result)),)


def result_blocks(result: RotorSystemResult) -> tuple[Block, ...]:
    """Predictions, unknowns, tests and figures; of a rotor without tests its predictions."""
    blocks: list[Block] = [prediction_table(result)]
    blocks += [Paragraph(line) for line in (*_weights(result), *_next(result))]
    if result.tests:
        blocks += [unknown_table(result), budget_table(result), test_table(result)]
        rows = tuple(_small_error_row(error) for error in result.small_errors)
        header = ("small errors of", "declared", "found")
        blocks.append(Table(header, rows, "Standard deviations", (1, 2)))
    blocks.append(campbell_figure(result))
    if result.balance is not None and result.balance.vibration is not None:
        blocks.append(vibration_figure(result.balance.vibration))
    if result.tests:
        blocks.append(unknown_figure(result))
    return tuple(blocks)


def prediction_table(result: RotorSystemResult) -> Table:
    """Critical speeds and stability with their 95 % intervals, and what is asked of them."""
    rows: list[tuple[str, str, str, str]] = []
    for critical in result.criticals:
        margin, ends = "", _ends(critical.speed_interval, RPM, ".0f")
        if critical.margin is not None and critical.met is not None:
            there, asked = critical.margin
            margin = f"margin {there:.1f} %, {asked:.1f} % asked for: {_sure(critical.met)}"
        place = f"critical speed, at {critical.place} [rpm]"
        rows.append((place, f"{RPM * critical.speed:.0f}", ends, margin))
        if critical.amplification is not None and critical.amplification_interval is not None:
            ends = _ends(critical.amplification_interval)
            rows.append(("amplification factor there", f"{critical.amplification:.3g}", ends, ""))
        ends = _ends(critical.amplitude_interval, UM)
        rows.append(("amplitude there [um]", f"{UM * critical.amplitude:.3g}", ends, ""))
    least, error, probability = result.decrement
    ends = _ends((least - NORMAL * error, least + NORMAL * error))
    limit = f"above {LEAST_DECREMENT:g}: {_sure(probability)}"
    rows.append((_least_name(result), f"{least:.3g}", ends, limit))
    if result.onset is not None:
        speed, spread = RPM * result.onset[0], NORMAL * result.onset[1]
        ends = _ends((speed * np.exp(-spread), speed * np.exp(spread)), form=".0f")
        rows.append(("onset of instability [rpm]", f"{speed:.0f}", ends, ""))
    header = ("prediction", "value", "95 %", "asked for by API 617")
    return Table(header, tuple(rows), "What follows for the rotor", (1,))


# Factor and unit of standard deviations that are not shares.
OF_SMALL_ERRORS = {"apparent_mass": (APPARENT, "kg"), "phase": (1.0, "rad")}


def _small_error_row(error: SmallErrorResult) -> tuple[str, str, str]:
    factor, unit = OF_SMALL_ERRORS.get(error.name, (100.0, "%"))
    name = f"{error.name.replace('_', ' ')} [{unit}]"
    return name, number(factor * error.declared, 3), number(factor * error.found, 3)


def _sure(probability: float) -> str:
    return f"probability {probability_text(probability)}, {decision(probability)}"


def _text(value: float, error: float, unit: str) -> str:
    return with_error(UM * value, UM * error, "g mm") if unit == "kg.m" else amount_text(value, error, unit)


def unknown_table(result: RotorSystemResult) -> Table:
    """Unknowns beside what was declared of them."""
    rows = tuple(
        (
            unknown.name,
            _text(unknown.value, unknown.error, unknown.unit),
            _text(unknown.prior, unknown.prior_error, unknown.unit),
            number(unknown.error / unknown.prior_error, 2) + ("" if unknown.told else " (no test tells)"),
            f"{unknown.by_test}, {number(unknown.wider, 2)} times" if unknown.told else "",
        )
        for unknown in result.unknowns
        if not unknown.group
    )
    header = ("unknown", "all tests", "declared", "error left", "without this test larger by")
    words = "Unknowns with standard uncertainties, and the share of the declared one"
    return Table(header, rows, words, (3,))


def budget_table(result: RotorSystemResult) -> Table:
    """What the uncertainty of the least decrement rests on."""
    groups = {group.name for group in result.small_errors}
    rows = tuple(
        (f"small errors of {name.replace('_', ' ')}" if name in groups else name, number(100 * share, 2))
        for name, share in result.budget.items()
        if share > LEAST_SHARE
    )
    words = "Least log decrement: the share of its variance that would go if one source were known"
    return Table(("source", "share [%]"), rows, words, (1,))


def test_table(result: RotorSystemResult) -> Table:
    """Tests, how well the common rotor fits them, and what each pulls."""
    rows = tuple(
        (t.name, t.kind, f"{t.chi2:.1f} of {t.n}", number(t.probability, 2), t.pulled, f"{t.z:+.1f}")
        for t in result.tests
    )
    header = ("test", "kind", "chi-square", "probability", "pulls", "standard errors")
    return Table(header, rows, "Tests: a pull beyond 3 contradicts the others", (3, 5))


def vibration_figure(vibration: VibrationResult) -> Figure:
    """The vibration over speed as it is, and with the weights."""
    speed, ends = RPM * vibration.speed, (UM * vibration.low, UM * vibration.high)
    series = (
        curve("as it is", speed, UM * vibration.before, line="--"),
        curve("with the weights", speed, UM * vibration.after, 1, band=ends),
    )
    axis = Axis("rms of the probes", "um", logarithmic=True)
    caption = (
        "Vibration that is expected over speed, as it is and with the weights, the latter with its 95 % band."
    )
    chart = stack([Panel(Axis("speed", "rpm"), axis, series)], 3.0)
    return Figure(chart, caption, "Vibration before and after weights")


def campbell_figure(result: RotorSystemResult) -> Figure:
    """Natural frequencies and logarithmic decrements over speed with their 95 % bands."""
    diagram = result.campbell
    speed = RPM * diagram.speed
    top = 2.5 * float(diagram.speed[-1])
    shown = np.flatnonzero(np.any(diagram.frequency < top, axis=0)).tolist()

    def modes(values: FloatArray, errors: FloatArray) -> list[Series]:
        low, high = values - NORMAL * errors, values + NORMAL * errors
        bands = [(low[:, n], high[:, n]) for n in range(values.shape[1])]
        return [curve(f"mode {n + 1}", speed, values[:, n], *look(n), band=bands[n]) for n in shown]

    frequencies = modes(diagram.frequency, diagram.frequency_error)
    frequencies.append(curve("1x", speed, diagram.speed, -1, "--"))
    if result.criticals:
        at = [critical.speed for critical in result.criticals]
        frequencies.append(dots("critical speeds", [RPM * x for x in at], at, 6, marker="o"))
    if result.measured:
        turned, seen = zip(*result.measured, strict=True)
        frequencies.append(dots("measured", [RPM * x for x in turned], seen, 7, marker="s"))
    decrements = modes(drawn_decrements(diagram.log_decrement), diagram.log_decrement_error)
    decrements.append(level(LEAST_DECREMENT, -1, "--"))
    panels = [
        Panel(Axis("speed", "rpm"), axis, (*series, upright(RPM * result.operating)))
        for axis, series in (
            (Axis("natural frequency", "Hz", low=0.0, high=top), frequencies),
            (Axis("log decrement"), decrements),
        )
    ]
    caption = (
        "Natural frequencies, modes followed through crossings, and logarithmic decrements below 2 pi with "
        "95 % bands; dashed: the speed itself, and the decrement of .1 that API 617 asks for; upright: "
        "operating speed"
        f"{'; squares: what tests in the bearings measured' if result.measured else ''}."
    )
    words = "Natural frequencies and log decrements over speed, with bands"
    return Figure(stack(panels, 5.6), caption, words)


def unknown_figure(result: RotorSystemResult) -> Figure:
    """How far each unknown has moved from what was declared, in units of that uncertainty."""
    ungrouped = [unknown for unknown in result.unknowns if not unknown.group]
    place = np.arange(len(ungrouped), dtype=float)
    amounts = [(u.value - u.prior, u.error, u.prior_error) for u in ungrouped]
    off, left, declared = np.array(amounts).reshape(-1, 3).T
    moved, error = off / declared, left / declared
    bars = (moved - NORMAL * error, moved + NORMAL * error)
    series = (curve("all tests", place, moved, 0, "", marker="o", bars=bars), level(0.0))
    ticks = tuple((float(n), unknown.name) for n, unknown in enumerate(ungrouped))
    names = Axis("", ticks=ticks, low=-0.7, high=len(ungrouped) - 0.3)
    panel = Panel(names, Axis("moved by, in declared errors"), series)
    caption = "How far the tests move the unknowns, in declared standard uncertainties; bars: 95 %."
    return Figure(stack([panel], 3.4), caption, "Unknowns relative to their declared values")


def cover(result: RotorSystemResult) -> dict[str, str]:
    """The least decrement and the first critical speed."""
    facts = {"least log decrement": with_error(result.decrement[0], result.decrement[1])}
    if result.criticals:
        facts["first critical speed"] = plain_text(result.criticals[0].speed, "Hz", 4)
    return facts


ROTOR_SYSTEM = PipelineSection(
    words="One rotor from all its tests: unknowns, critical speeds, stability, balance weights.",
    settings=RotorSystemSettings,
    standalone=True,
    run=run_rotor_system,
    record=RotorSystemResult,
    entry=NAME,
    outcome=outcome,
    findings=findings,
    parameters=list_parameters,
    report=sections,
    cover=cover,
    terminal=lines,
)
