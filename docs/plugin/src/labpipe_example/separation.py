"""A section of a pipeline: how far the identified natural frequencies lie from what the running machine
excites.

The margin of a natural frequency against an order n of the speed is its distance from the band n (low ...
high), over the nearer end of that band. What is required follows from the amplification AF = 1 / (2 zeta),
after API 617 (7th edition, 2.6.2.10): none below AF = 2.5; else 17 (1 - 1 / (AF - 1.5)) %, at most 16 %,
where the speed lies above, and 10 % more, at most 26 %, where it lies below.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from labpipe.errors import ConfigError
from labpipe.project.rules import Rule
from labpipe.project.work import Work
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import Fit, Identification, ListedParameter, RuleOutcome
from labpipe.records.sections import PipelineSection
from labpipe.records.settings import Settings, setting
from labpipe.registry import nearest
from labpipe.report.document import Paragraph, Section, Table

CRITICALLY_DAMPED = 2.5
# Holds a number against a rule: (rule, number, its SI unit) -> what was found, and whether the rule holds.
Compare = Callable[[Rule, float | None, str], tuple[float | None, bool, str]]
LEAST, KEPT = "least", "kept"


@dataclass(frozen=True)
class SeparationSettings(Settings):
    """The ``separation:`` section."""

    speeds: tuple[float, float] = setting("band", "range of operating speeds, in Hz or rpm", unit="Hz")
    orders: tuple[float, ...] = setting(
        "values", "orders of the speed that excite", unit="1", default=(1.0, 2.0)
    )

    def __post_init__(self) -> None:
        if not 0 < self.speeds[0] <= self.speeds[1]:
            raise ConfigError("'speeds' must rise from above zero", hint="for example speeds: 2400-3000 rpm")
        if not self.orders or min(self.orders) <= 0:
            raise ConfigError("'orders' must be above zero", hint="for example orders: [1, 2]")


@dataclass(frozen=True)
class Margin:
    """One natural frequency [Hz] against one order: *margin* [-] with its standard error, zero within the
    band; *required* [-].
    """

    name: str
    test: str
    frequency: float
    damping_ratio: float
    order: float
    margin: float
    std_error: float | None
    required: float

    @property
    def kept(self) -> bool:
        return self.margin >= self.required


@dataclass(frozen=True)
class Separation:
    """All margins over the *speeds* [Hz]."""

    speeds: tuple[float, float]
    margins: tuple[Margin, ...]

    @property
    def kept(self) -> bool:
        return all(margin.kept for margin in self.margins)

    @property
    def least(self) -> float:
        return min(margin.margin for margin in self.margins)


def run(settings: SeparationSettings, work: Work) -> Separation:
    """The margins of all fits so far; ConfigError where none gives a natural frequency."""
    margins = [
        margin_of(fit, *mode, order, settings.speeds)
        for fit in work.fits
        for mode in natural_frequencies(fit)
        for order in settings.orders
    ]
    if not margins:
        raise ConfigError(
            "separation: no fit gives a natural frequency",
            where=str(work.pipeline.path),
            hint="identify one, as sdof does",
        )
    return Separation(settings.speeds, tuple(margins))


def natural_frequencies(fit: Fit) -> Iterator[tuple[Parameter, Parameter]]:
    """(f_n, zeta) of every mode of a fit: "f_n" and "zeta" of one mass, "f_n_1" and "zeta_1" ...

    of several.
    """
    by_name = {parameter.name: parameter for parameter in fit.parameters}
    for name, parameter in by_name.items():
        ratio = by_name.get(name.replace("f_n", "zeta", 1))
        if name.partition("f_n")[0] == "" and ratio is not None:
            yield parameter, ratio


def margin_of(
    fit: Fit, frequency: Parameter, ratio: Parameter, order: float, speeds: tuple[float, float]
) -> Margin:
    """The margin of one mode against one order."""
    f, low, high = frequency.value, order * speeds[0], order * speeds[1]
    edge = min(max(f, low), high)
    # Within the band there is no distance whose error could be given.
    error = None if edge == f or frequency.std_error is None else frequency.std_error / edge
    name = f"{fit.name}.{frequency.name}.{order:g}x"
    return Margin(
        name,
        fit.test,
        f,
        ratio.value,
        order,
        abs(f - edge) / edge,
        error,
        required(ratio.value, above=f > high),
    )


def required(damping_ratio: float, above: bool) -> float:
    """The margin that API 617 asks for, of a natural frequency *above* or below the speeds [-]."""
    amplification = 1 / (2 * damping_ratio)
    if amplification < CRITICALLY_DAMPED:
        return 0.0
    below = 0.17 * (1 - 1 / (amplification - 1.5))
    return min(0.26, below + 0.10) if above else min(0.16, below)


def outcome(rule: Rule, record: Separation, compare: Compare) -> RuleOutcome:
    """Rules: separation.kept, separation.least, separation.FIT.f_n.1x.

    Of several tests all must hold, the least is shown.
    """
    if rule.item == KEPT:
        word = str(record.kept).lower()
        return rule.outcome(word, word == rule.bound)
    named = [
        margin.margin
        for margin in record.margins
        if rule.item in (LEAST, margin.name) and rule.which in ("", margin.test)
    ]
    if not named:
        hint = nearest(rule.item, [KEPT, LEAST, *(margin.name for margin in record.margins)])
        raise ConfigError(f"{rule.section}.{rule.address}: no such margin", where=rule.place, hint=hint)
    outcomes = [compare(rule, margin, "1") for margin in sorted(named)]
    return rule.outcome_of_all(outcomes)


def findings(record: Separation) -> Iterator[tuple[str, Finding]]:
    """A warning for every margin that is not kept."""
    for margin in record.margins:
        if not margin.kept:
            words = (
                f"{margin.name}: {100 * margin.margin:.1f} % where {100 * margin.required:.1f} % are "
                "required."
            )
            yield "separation", Finding("separation", words)


def parameters(record: Separation) -> Iterator[ListedParameter]:
    """The margins as `labpipe list -p` shows them."""
    for margin in record.margins:
        parameter = Parameter(
            f"margin_{margin.order:g}x", margin.margin, "1", std_error=margin.std_error, derived=True
        )
        fit = f"separation.{margin.name.partition('.')[0]}"
        yield ListedParameter(fit=fit, parameter=parameter, test=margin.test, model="separation")


def report(record: Separation, _identification: Identification) -> tuple[Section, ...]:
    """Verdict and table."""
    low, high = record.speeds
    verdict = "All separation margins are kept." if record.kept else "Separation margins are missed."
    header = ("natural frequency", "f [Hz]", "damping ratio", "order", "margin [%]", "required [%]", "kept")
    caption = f"Natural frequencies against the orders of {low:g} to {high:g} Hz"
    table = Table(header, tuple(_row(margin) for margin in record.margins), caption, (1, 2, 3, 4, 5))
    return (
        Section("Separation margins", (Paragraph(verdict, "passed" if record.kept else "failed"), table)),
    )


def _row(margin: Margin) -> tuple[str, ...]:
    error = "" if margin.std_error is None else f" ± {100 * margin.std_error:.2g}"
    name = f"{margin.name.rpartition('.')[0]} {margin.test}".strip()
    numbers = (f"{margin.frequency:.5g}", f"{margin.damping_ratio:.3g}", f"{margin.order:g}x")
    return (
        name,
        *numbers,
        f"{100 * margin.margin:.1f}{error}",
        f"{100 * margin.required:.1f}",
        "yes" if margin.kept else "no",
    )


def terminal(record: Separation) -> Iterator[str]:
    """One line for each margin."""
    yield f"separation margins at {record.speeds[0]:g} to {record.speeds[1]:g} Hz"
    for margin in record.margins:
        kept = "kept" if margin.kept else "MISSED"
        yield (
            f"  {margin.name:<22}{100 * margin.margin:>7.1f} %, {100 * margin.required:.1f} % required: "
            f"{kept}"
        )


SEPARATION = PipelineSection(
    words="How far identified natural frequencies lie from orders of the speed.",
    settings=SeparationSettings,
    run=run,
    record=Separation,
    entry="separation",
    outcome=outcome,
    findings=findings,
    parameters=parameters,
    report=report,
    terminal=terminal,
)
