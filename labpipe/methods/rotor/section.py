"""The section unbalance: the directional response of a rotor over speed, healthy and worn, its figures and
rules.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.display import with_error
from labpipe.errors import ConfigError, SettingError
from labpipe.methods.journal_bearing.kind import Wear
from labpipe.methods.rotor.response import forward_backward_motion, unbalance_response
from labpipe.methods.rotor.rig import RotorRig
from labpipe.project.judging import CompareNumber
from labpipe.project.rules import Rule
from labpipe.records.finding import Parameter
from labpipe.records.identification import Identification, ListedParameter, RuleOutcome
from labpipe.records.sections import PipelineSection
from labpipe.records.settings import Settings, quantity, setting, text
from labpipe.registry import nearest
from labpipe.report import chart
from labpipe.report.document import Block, Figure, Paragraph, Section, Table


@dataclass(frozen=True)
class PeakChange:
    """Changes of the largest radii [m] and of their speeds [Hz], with their sign, by one standard uncertainty
    of a *source*.
    """

    source: str
    forward_peak: float
    forward_speed: float
    backward_peak: float
    backward_speed: float


@dataclass(frozen=True)
class UnbalanceCase:
    """One state of the bearing: wear *depth* [m] at *angle* [rad]; radii [m] of the forward and the backward
    circle at every speed.

    changes: of the largest of them by the uncertainties of the bearings' numbers.
    """

    name: str
    depth: float
    angle: float
    forward: tuple[float, ...]
    backward: tuple[float, ...]
    changes: tuple[PeakChange, ...] = ()

    def error(self, name: str) -> float | None:
        """Standard uncertainty of a largest radius [m] or its speed [Hz] by all sources, such as
        `forward_peak`; None without any.
        """
        return math.sqrt(sum(getattr(change, name) ** 2 for change in self.changes)) if self.changes else None


@dataclass(frozen=True)
class UnbalanceRuns:
    """All cases of one rotor over the same *speed* [Hz]; *node*: of the displacements; *bearing*: the worn
    bearing.
    """

    rotor: str
    bearing: str
    node: int
    speed: tuple[float, ...]
    cases: tuple[UnbalanceCase, ...]

    def values(self, case: UnbalanceCase) -> dict[str, tuple[float, str]]:
        """The largest radii [m] of a case and their speeds [Hz], by name, each with its unit."""
        peaks = {}
        for name, radius in (("forward", case.forward), ("backward", case.backward)):
            largest = max(radius)
            peaks[f"{name}_peak"] = (largest, "m")
            peaks[f"{name}_speed"] = (self.speed[radius.index(largest)], "Hz")
        return peaks


MOST_SPEEDS = 2000
STEP_OF_SPEED = "step of the speeds"


@dataclass(frozen=True)
class UnbalanceSettings(Settings):
    """The ``unbalance:`` section of a pipeline; *rig*: contents of `rotor`."""

    rotor: str = setting(
        "file", "rotor file with its unbalances, relative to the pipeline file", file_kind="rotor", into="rig"
    )
    speeds: tuple[float, float] = setting("band", "range of speeds", "Hz")
    cases: tuple[tuple[str, Wear], ...] = setting(
        "sections",
        "states of wear by name, for example {healthy: {depth: 0 um}}",
        section=Wear,
        default=(),
        needed=True,
    )
    step: float = quantity("step of speed", "Hz", 0.5)
    bearing: str = text("name of the worn bearing; default: the last one")
    rig: RotorRig | None = None

    def __post_init__(self) -> None:
        if not self.cases:
            raise SettingError("cases", "cases: are missing", "for example cases: {healthy: {depth: 0 um}}")
        if not 0 < self.speeds[0] < self.speeds[1]:
            raise ConfigError("'speeds' must rise from above zero", hint="for example speeds: 40-65 Hz")
        if not 0 < self.step <= self.speeds[1] - self.speeds[0]:
            raise ConfigError("'step' must be positive and no longer than the range of speeds")
        if (self.speeds[1] - self.speeds[0]) / self.step > MOST_SPEEDS:
            raise ConfigError(f"more than {MOST_SPEEDS} speeds", hint="take a longer step")
        if self.rig is None:
            return
        if not any(self.rig.amounts.values()):
            raise SettingError("rotor", "the rotor has no unbalance", "add unbalances: to the rotor file")
        for _, case in self.cases:
            self.rig.with_bearings(
                (self.rig.place(self.bearing).name,), wear_depth=case.depth, wear_angle=case.angle
            )

    @property
    def speed(self) -> FloatArray:
        """Every speed of the range (n_speed,) [Hz], the last one at most its end."""
        low, high = self.speeds
        return low + self.step * np.arange(int(np.floor((high - low) / self.step + 1e-9)) + 1)


def unbalance_runs(settings: UnbalanceSettings) -> UnbalanceRuns:
    """The response of every case at every speed, the films' coefficients those of that speed."""
    rig = settings.rig
    if rig is None:
        raise ConfigError("no rotor was read", hint="name it with unbalance.rotor")
    worn = rig.place(settings.bearing).name
    cases = []
    for name, case in settings.cases:
        worn_rig = rig.with_bearings((worn,), wear_depth=case.depth, wear_angle=case.angle)
        forward, backward = _radii(worn_rig, settings.speed).tolist()
        changes = [_changes(worn_rig, settings.speed, source.source) for source in worn_rig.sources]
        if changes:
            # A peak lies anywhere within half a step of its speed: limits of a rectangular distribution.
            within = settings.step / np.sqrt(12.0)
            changes.append(PeakChange(STEP_OF_SPEED, 0.0, within, 0.0, within))
        cases.append(
            UnbalanceCase(name, case.depth, case.angle, tuple(forward), tuple(backward), tuple(changes))
        )
    return UnbalanceRuns(rig.name, worn, rig.response, tuple(settings.speed.tolist()), tuple(cases))


def _radii(rig: RotorRig, speeds: FloatArray) -> FloatArray:
    return np.abs([orbit(rig.at_speed(float(speed))) for speed in speeds]).T


def _changes(rig: RotorRig, speeds: FloatArray, source: str) -> PeakChange:
    """Half the differences of the peaks with the numbers of a *source* a standard uncertainty above and below
    (GUM 5.1.3, note 2).
    """
    changes = np.zeros(4)
    for pair in rig.ends(source):
        above, below = (np.ravel([_peak(speeds, radius) for radius in _radii(end, speeds)]) for end in pair)
        changes += (above - below) / 2
    return PeakChange(source, *changes.tolist())


def _peak(speeds: FloatArray, radius: FloatArray) -> FloatArray:
    """Largest radius [m] and its speed [Hz], (2,), by a parabola through three speeds, which tells less than
    a step; an end as it is.
    """
    at = int(np.argmax(radius))
    if not 0 < at < radius.size - 1:
        return np.array([radius[at], speeds[at]])
    before, top, after = radius[at - 1 : at + 2]
    shift = 0.5 * (before - after) / (before - 2 * top + after)
    return np.array(
        [top - 0.25 * (before - after) * shift, speeds[at] + shift * (speeds[at + 1] - speeds[at])]
    )


def orbit(rig: RotorRig) -> ComplexArray:
    """Phasors of the forward and the backward circle (2,) [m], 0-to-peak, at the rig's response node and
    speed.
    """
    outputs = rig.rotor.dofs(rig.response)
    motion = unbalance_response(rig.rotor, rig.supports(), np.array([rig.omega]), rig.amounts, outputs)
    return forward_backward_motion(motion)[0]


MM = 1e3
HEIGHT = 2.9
LOOKS = {"shaft": (chart.GREY, 0.3), "sleeve": (5, 0.8), "disc": (4, 0.8), "bearing": (0, 0.55)}
# Where words stand, as parts of the largest radius: names of bearings, numbers of nodes, arrows of force and
# response.
NAMES, ODD_NUMBERS, EVEN_NUMBERS, TAIL, TIP = 1.25, 1.75, 2.05, 1.55, 1.02
PLACES = 1
# A bearing is drawn so thick, as part of the largest radius.
BEARING_WALL = 0.4


@dataclass(frozen=True)
class Ring:
    """A tube along the shaft [mm]: *part*: 'shaft', 'sleeve', 'disc' or 'bearing', *left* its left end."""

    part: str
    left: float
    length: float
    inner: float
    outer: float

    @property
    def boxes(self) -> tuple[tuple[float, float], ...]:
        """(bottom, height) [mm] of its section: above and below its bore, or once where it has none."""
        if self.inner <= 0:
            return ((-self.outer / 2, self.outer),)
        height = (self.outer - self.inner) / 2
        return ((self.inner / 2, height), (-self.outer / 2, height))


def rotor_sections(identification: Identification) -> tuple[Section, ...]:
    """The section on the rotors of the fits, if any."""
    figures = tuple(rotor_figures(identification.settings))
    return (Section("Rotor", figures),) if figures else ()


def rotor_figures(settings: Mapping[str, Any]) -> list[Figure]:
    """One sketch for every rotor that an identification's settings name, each once: of its fits and of its
    response to unbalance.
    """
    owners = [fit.get("model_settings") or {} for fit in settings.get("identify", [])]
    rigs = [owner["rig"] for owner in (*owners, settings.get("unbalance", {})) if owner.get("rig")]
    distinct = [rig for number, rig in enumerate(rigs) if rig not in rigs[:number]]
    return [rotor_figure(rig) for rig in distinct]


def rotor_figure(rig: Mapping[str, Any]) -> Figure:
    """A rotor from its entries in SI units, lengths in mm, nodes numbered from 1."""
    caption = (
        f"{rig['name']}: the rotor, its nodes numbered from the left. Diameters are drawn larger than "
        "lengths."
    )
    if rig["rotor"]["discs"]:
        caption += " Discs have the outline of a cylinder with their mass and moments of inertia."
    # The rotor over the length of the shaft [mm]; parts that lie within others are drawn on them
    rings, stations = rotor_rings(rig), MM * np.array(node_positions(rig["rotor"]))
    reach, n = _reach(rings), stations.size
    low = -reach * np.resize([ODD_NUMBERS, EVEN_NUMBERS], n)
    centres = [stations[place["node"] - 1] for place in rig["bearings"]]
    names = [place["name"] for place in rig["bearings"]]
    series = [
        *(line for ring in rings for line in _draw(ring)),
        chart.level(0.0, chart.INK, "-.", width=0.6),
        chart.dots("node", stations, np.zeros(n), chart.INK, size=2.0),
        chart.labels(stations, low, [str(number) for number in range(1, n + 1)], size=6.0),
        chart.labels(centres, [-NAMES * reach] * len(names), names),
    ]
    for name in ("force", "response"):
        x = stations[rig[name] - 1]
        series += [
            chart.arrow((x, TAIL * reach), (x, TIP * reach), PLACES),
            chart.labels([x], [(TAIL + 0.15) * reach], [name], PLACES),
        ]
    along = chart.Axis("along the shaft", "mm", -0.03 * stations[-1], 1.03 * stations[-1])
    across = chart.Axis("radius", "mm", -2.3 * reach, 2.1 * reach)
    return Figure(
        chart.stack([chart.Panel(along, across, tuple(series))], HEIGHT, "above"),
        caption,
        f"Drawing of the rotor {rig['name']} with its bearings",
    )


def _draw(ring: Ring) -> list[chart.Series]:
    colour, opacity = LOOKS[ring.part]
    right = ring.left + ring.length
    x = [ring.left, right, right, ring.left]
    return [
        chart.outline(ring.part, x, [low, low, low + height, low + height], colour, opacity, width=0.7)
        for low, height in ring.boxes
    ]


def _reach(rings: Sequence[Ring]) -> float:
    return max(ring.outer / 2 for ring in rings if ring.part != "bearing")


def rotor_rings(rig: Mapping[str, Any]) -> list[Ring]:
    """Shaft elements, sleeves, discs and bearings of a rotor file."""
    rotor, stations, rings = rig["rotor"], node_positions(rig["rotor"]), list[Ring]()

    def add(part: str, left: float, length: float, inner: float, outer: float) -> None:
        rings.append(Ring(part, *(MM * size for size in (left, length, inner, outer))))

    for on, left in zip(rotor["elements"], stations, strict=False):
        add("shaft", left, on["length"], on["inner_diameter"], on["outer_diameter"])
    for sleeve in rotor["sleeves"]:
        on, left = rotor["elements"][sleeve["element"] - 1], stations[sleeve["element"] - 1]
        add("sleeve", left, on["length"], on["outer_diameter"], sleeve["outer_diameter"])
    for disc in rotor["discs"]:
        inner, outer, length = disc_dimensions(disc, shaft_diameter(rotor, disc["node"]))
        add("disc", stations[disc["node"] - 1] - length / 2, length, inner, outer)
    wall = BEARING_WALL * _reach(rings) / MM
    for place in rig["bearings"]:
        bore, length = bearing_dimensions(place["bearing"], shaft_diameter(rotor, place["node"]))
        add("bearing", stations[place["node"] - 1] - length / 2, length, bore, bore + wall)
    return rings


def bearing_dimensions(bearing: Mapping[str, Any], shaft: float) -> tuple[float, float]:
    """(bore, length) [m] as the bearing's entries have them. Of a kind without such entries the *shaft*'s
    diameter [m], and half of it.
    """
    entries = bearing.get("settings", bearing)
    return entries.get("diameter") or shaft, entries.get("length") or shaft / 2


def node_positions(rotor: Mapping[str, Any]) -> list[float]:
    """Position of every node along the shaft [m], the first at zero."""
    return [0.0, *np.cumsum([entry["length"] for entry in rotor["elements"]]).tolist()]


def shaft_diameter(rotor: Mapping[str, Any], node: int) -> float:
    """The larger of the shaft's diameters at a node [m]."""
    return max(float(entry["outer_diameter"]) for entry in rotor["elements"][max(node - 2, 0) : node])


def disc_dimensions(disc: Mapping[str, Any], bore: float) -> tuple[float, float, float]:
    """(bore, outer diameter, length) [m] of the hollow cylinder with a disc's mass and inertia. From I_p =
    m/8 (D^2 + d^2) and I_t = I_p/2 + m l^2/12; a disc of less inertia is drawn a little larger than its bore,
    to be seen.
    """
    outer = np.sqrt(max(8 * disc["polar_inertia"] / disc["mass"] - bore**2, 0.0))
    length = np.sqrt(max(12 * (disc["transverse_inertia"] - disc["polar_inertia"] / 2) / disc["mass"], 0.0))
    return bore, max(float(outer), 1.2 * bore), float(length)


UM = 1e6
HEADER = ("case", "depth [um]", "angle [deg]", "forward [um]", "at [Hz]", "backward [um]", "at [Hz]", "ratio")
EXPLAINED = (
    "An unbalance turns with the shaft. Bearings that are alike in all directions answer with a forward "
    "circle only; the backward circle measures how unlike they are, and wear of one bearing enlarges it. "
    "Radii of the circles, 0-to-peak, once per revolution."
)


def unbalance_blocks(runs: UnbalanceRuns) -> tuple[Block, ...]:
    rows = []
    for case in runs.cases:
        wear = (f"{UM * case.depth:.4g}", f"{np.degrees(case.angle):.4g}") if case.depth else ("0", "")
        peaks = []
        for name, (value, unit) in runs.values(case).items():
            factor, error = UM if unit == "m" else 1.0, case.error(name)
            peaks.append(
                f"{factor * value:.4g}" if error is None else with_error(factor * value, factor * error)
            )
        ratio = max(case.backward) / max(case.forward)
        rows.append((case.name, *wear, *peaks, f"{ratio:.3f}"))
    caption = (
        f"Largest radii over {len(runs.speed)} speeds from {runs.speed[0]:g} to {runs.speed[-1]:g} "
        "Hz, and backward over forward"
    )
    if any(case.changes for case in runs.cases):
        caption += (
            "; standard uncertainties by the uncertainties of the bearings' numbers and the step of "
            "the speeds"
        )
    return (
        Paragraph(EXPLAINED),
        Table(HEADER, tuple(rows), caption, tuple(range(1, 8))),
        unbalance_figure(runs),
    )


def unbalance_figure(runs: UnbalanceRuns) -> Figure:
    panels = []
    for name in ("forward", "backward"):
        radii = [UM * np.array(getattr(case, name)) for case in runs.cases]
        series = tuple(
            chart.curve(case.name, runs.speed, radius, *chart.look(number), width=1.5)
            for number, (case, radius) in enumerate(zip(runs.cases, radii, strict=True))
        )
        panels.append(
            chart.Panel(chart.Axis("speed", "Hz"), chart.Axis(name, "um", logarithmic=True), series)
        )
    caption = (
        f"{runs.rotor}: response to unbalance at node {runs.node}, wear of {runs.bearing}; forward "
        "circle above, backward below."
    )
    words = f"Forward and backward response to unbalance of {runs.rotor} over speed"
    return Figure(chart.stack(panels, 5.0), caption, words)


def listed_peaks(runs: UnbalanceRuns) -> Iterator[ListedParameter]:
    """Peaks [m] and their speeds [Hz] of every state of wear."""
    for case in runs.cases:
        for name, (value, unit) in runs.values(case).items():
            parameter = Parameter(name, value, unit, derived=True, std_error=case.error(name))
            yield ListedParameter(fit="unbalance", parameter=parameter, test=case.name, model="unbalance")


def unbalance_outcome(rule: Rule, runs: UnbalanceRuns, compare_number: CompareNumber) -> RuleOutcome:
    """The outcome of a rule on one case; ConfigError at its place when there is no such case or value."""
    name, _, item = rule.item.rpartition(".")
    cases = {case.name: case for case in runs.cases}
    if name not in cases:
        raise rule.fault("no such case of unbalance", nearest(name, cases))
    values = runs.values(cases[name])
    if item not in values:
        raise rule.fault(f"a case of unbalance has no '{item}'", nearest(item, values))
    return rule.outcome(*compare_number(rule, *values[item], cases[name].error(item)))


UNBALANCE = PipelineSection(
    words="The model's response to unbalance over speed.",
    settings=UnbalanceSettings,
    standalone=True,
    run=lambda settings, _work: unbalance_runs(settings),
    record=UnbalanceRuns,
    entry="unbalance",
    outcome=unbalance_outcome,
    parameters=listed_peaks,
    report=lambda runs, _: (Section(f"Unbalance: {runs.rotor}", unbalance_blocks(runs)),),
)
