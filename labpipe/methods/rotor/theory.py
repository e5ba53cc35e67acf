"""labpipe rotor FILE: Campbell diagram, critical speeds, stability and unbalance response by theory alone.

Critical speeds and amplification factors are those of the unbalance response as API 684 reads them: the peak,
and the two speeds at .707 of it. Margins by the formulas of API 617 and 684, known second-hand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.artefacts.json_file import without_nan
from labpipe.errors import FitError
from labpipe.methods.rotor import response
from labpipe.methods.rotor.rig import RotorRig
from labpipe.methods.rotor.shaft import NodeSupport
from labpipe.report.chart import Axis, Panel, curve, look, stack, upright
from labpipe.report.document import Block, Document, Figure, Paragraph, Section, Table

# Difference of ln |lambda| between neighbouring speeds that makes two modes hardly one.
FREQUENCY_STEP = 0.15
# Modes that are followed.
MOST_MODES = 8
# Half-power points, speeds of the response, speeds about a peak that is sharper than these tell, and the part
# of a speed over which they end: there the peak is without damping.
HALF_POWER = np.sqrt(0.5)
FINE, CLOSER, SHARPEST = 1500, 201, 1e-8
# Speeds between two of them at which a top and half-power points are looked at.
BETWEEN = 9
# From speeds (n,) [Hz] to amplitudes (n,) [m].
AmplitudeAt = Callable[[FloatArray], FloatArray]
# Amplitudes [m] below which a point is at rest: what they are to the power of -2 is still a number.
AT_REST = 1e-150
# Share of the speeds that are peaks above which there is nothing but rounding, whose third are.
ROUNDED = 0.25
# Difference of ln speed up to which two peaks are one: of sharp ones, and at most.
ALIKE = 0.01, 0.03
# Amplification below which API 684 sees no critical speed.
LEAST_AMPLIFICATION = 2.5


def margin_below(amplification: float) -> float:
    """Separation [%] that a critical speed below the lowest operating speed must have (API 617, 684). 17 (1 -
    1 / (AF - 1.5)), at most 16; 0 for AF below 2.5.
    """
    return 0.0 if amplification < LEAST_AMPLIFICATION else min(16.0, 17 * (1 - 1 / (amplification - 1.5)))


def margin_above(amplification: float) -> float:
    """The same of one above the highest operating speed: 10 + 17 (1 - 1 / (AF - 1.5)), at most 26."""
    return 0.0 if amplification < LEAST_AMPLIFICATION else 10 + margin_below(amplification)


KEPT, BROKEN, UNDECIDED = DECISIONS = "kept", "broken", "undecided"
# Probability beyond which a limit counts as kept: its 95 % interval lies on one side.
SURE = 0.975


def decision(probability: float) -> str:
    """Whether a limit is kept, by the *probability* [1] that it is: undecided where its 95 % interval is on
    both sides.
    """
    return KEPT if probability >= SURE else BROKEN if probability <= 1 - SURE else UNDECIDED


@dataclass(frozen=True)
class Critical:
    """A peak of the unbalance response: *speed*, its half-power speeds *low*, *high* [Hz], *amplitude* [m] of
    the major semi-axis at *node*; None where the response does not fall to .707 of it within the speeds.
    """

    speed: float
    amplitude: float
    node: int
    low: float | None = None
    high: float | None = None

    @property
    def amplification(self) -> float | None:
        """AF = N_c / (N_2 - N_1)."""
        return None if self.low is None or self.high is None else self.speed / (self.high - self.low)

    def is_like(self, other: Critical) -> bool:
        """Whether two peaks are of one critical speed: within 3 %, of sharp ones two bandwidths but 1 %."""
        sharpest = max(self.amplification or 0.0, other.amplification or 0.0, 1.0)
        return abs(np.log(self.speed / other.speed)) <= np.clip(2 / sharpest, *ALIKE)

    def margin(self, operating: float) -> tuple[float, float] | None:
        """The separation from an *operating* speed [Hz] there is, and the one that is asked for, [%]; None
        where that is not known, and of a rotor at rest.
        """
        there, asked = self.margin_of((operating, operating)) if operating else (0.0, None)
        return None if asked is None else (there, asked)

    def margin_of(self, speeds: tuple[float, float]) -> tuple[float, float | None]:
        """The same of a range of operating *speeds* [Hz], of its nearer end: none is there within it; None
        where it is not known what is asked for.
        """
        low, high = speeds
        end, ask = (low, margin_below) if self.speed < low else (high, margin_above)
        there = 0.0 if low <= self.speed < high else 100 * abs(end - self.speed) / end
        return there, None if self.amplification is None else ask(self.amplification)


@dataclass(frozen=True)
class RotorTheory:
    """A rotor over *speed* (n_speed,) [Hz]: frequency (n_speed, n_mode) [Hz], log_decrement and whirl
    (n_speed, n_mode) [1] of the modes, followed; NaN where a mode does not oscillate.

    onset: [Hz], None within the speeds; least_decrement: at the file's speed [1], of the mode at
    least_frequency [Hz]; criticals of the unbalance response, whose *amplitude* (n_fine, n_node) [m] over
    *fine* (n_fine,) [Hz] is at *nodes*.
    """

    rig: RotorRig
    speed: FloatArray
    frequency: FloatArray
    log_decrement: FloatArray
    whirl: FloatArray
    onset: float | None
    least_decrement: float
    least_frequency: float
    crossings: tuple[tuple[float, float, float], ...]
    criticals: tuple[Critical, ...] = ()
    fine: FloatArray | None = None
    amplitude: FloatArray | None = None
    nodes: tuple[int, ...] = ()


def rotor_theory(rig: RotorRig, speeds: FloatArray) -> RotorTheory:
    """The theory of a rotor file over ascending *speeds* (n_speed,) [Hz]."""
    supports = [rig.at_speed(float(speed)).supports() for speed in speeds]
    at_speeds = [
        response.modes(rig.rotor, support, 2 * np.pi * speed)
        for support, speed in zip(supports, speeds, strict=True)
    ]
    frequency, decrement, whirl = follow_modes(
        at_speeds,
        [
            (solution.eigenvalues.imag / (2 * np.pi), decrements(solution.eigenvalues), solution.whirl)
            for solution in at_speeds
        ],
    )
    at = _supports_between(speeds, supports)
    try:
        onset = response.onset_speed(rig.rotor, lambda omega: at(omega / (2 * np.pi)), 2 * np.pi * speeds)
    except FitError:
        onset = 2 * np.pi * float(speeds[0])
    crossings = []
    for of_mode in zip(frequency.T, decrement.T, whirl.T, strict=True):
        excess, rows = of_mode[0] - speeds, np.array([speeds, *of_mode[1:]])
        for n in np.flatnonzero(np.sign(excess[:-1]) * np.sign(excess[1:]) < 0):
            share = excess[n] / (excess[n] - excess[n + 1])
            crossings.append(tuple(((1 - share) * rows[:, n] + share * rows[:, n + 1]).tolist()))
    # An integrating bearing has no coefficients at rest.
    at_speed = rig.supports() if rig.speed else supports[0]
    lowest = response.modes(rig.rotor, at_speed, rig.omega).eigenvalues[:MOST_MODES]
    least = min(zip(decrements(lowest), lowest.imag / (2 * np.pi), strict=True), default=(np.inf, np.nan))
    theory = RotorTheory(
        rig,
        speeds,
        frequency,
        decrement,
        whirl,
        None if onset is None else onset / (2 * np.pi),
        float(least[0]),
        float(least[1]),
        tuple(sorted(crossings)),
    )
    return _with_response(theory, at) if any(rig.amounts.values()) else theory


def decrements(roots: ComplexArray) -> FloatArray:
    """Logarithmic decrements -2 pi Re lambda / Im lambda (n_mode,) [1] of eigenvalues (n_mode,) [1/s]."""
    return -2 * np.pi * roots.real / roots.imag


def drawn_decrements(values: FloatArray) -> FloatArray:
    """Logarithmic decrements (n_speed, n_mode) [1] of motion that oscillates, below 2 pi; NaN for others,
    beside which those that matter could not be told from zero.
    """
    return np.where(values < 2 * np.pi, values, np.nan)


def follow_modes(
    each: Sequence[response.WhirlModes], amounts: Sequence[tuple[FloatArray, ...]]
) -> tuple[FloatArray, ...]:
    """The *amounts* (n_mode,) [any unit] of the modes at every speed as (n_speed, n_column) of modes that are
    followed; NaN where one is not there.
    """
    order = follow(each)
    return tuple(
        np.array([np.append(row, np.nan)[places] for row, places in zip(of_kind, order, strict=True)])
        for of_kind in zip(*amounts, strict=True)
    )


def _supports_between(
    speeds: FloatArray, supports: Sequence[Sequence[NodeSupport]]
) -> response.SupportsAtSpeed:
    nodes = [support.node for support in supports[0]]
    coefficients = np.array([[(support.stiffness, support.damping) for support in row] for row in supports])
    spline = scipy.interpolate.make_interp_spline(speeds, coefficients, k=min(3, speeds.size - 1))
    return lambda speed: [NodeSupport(node, k, c) for node, (k, c) in zip(nodes, spline(speed), strict=True)]


def follow(each: Sequence[response.WhirlModes]) -> FloatArray:
    """Numbers (n_speed, n_mode) [-] of the modes at every speed so that a column is one mode; -1: it is not
    there. A mode that begins to oscillate within the speeds, as oil whirl may, has a column as well.
    Neighbouring speeds are paired by the assurance criterion of their shapes times exp(-(d ln |lambda| /
    .15)^2 / 2), all pairs together (linear assignment).
    """
    n_mode = min(MOST_MODES, each[0].eigenvalues.size)
    order = np.full((len(each), n_mode), -1)
    order[0] = np.arange(n_mode)
    last = [(each[0].shapes[n].ravel(), each[0].eigenvalues[n]) for n in range(n_mode)]
    for number, now in enumerate(each[1:], 1):
        flat = now.shapes.reshape(now.eigenvalues.size, -1)
        likeness = np.array([_likeness(shape, root, flat, now.eigenvalues) for shape, root in last])
        rows, columns = scipy.optimize.linear_sum_assignment(-likeness)
        for row, column in zip(rows, columns, strict=True):
            if likeness[row, column] > 1e-3:
                order[number, row] = column
                last[row] = (flat[column], now.eigenvalues[column])
        for column in sorted(set(range(min(MOST_MODES, len(flat)))) - set(order[number].tolist())):
            order = np.column_stack([order, np.full(len(each), -1)])
            order[number, -1] = column
            last.append((flat[column], now.eigenvalues[column]))
    return order


def _likeness(shape: ComplexArray, root: complex, others: ComplexArray, roots: ComplexArray) -> FloatArray:
    overlap = np.abs(others.conj() @ shape) ** 2
    alike = overlap / (np.sum(np.abs(others) ** 2, axis=1) * np.sum(np.abs(shape) ** 2))
    near = np.log(np.abs(roots) / np.abs(root)) / FREQUENCY_STEP
    return alike * np.exp(-(near**2) / 2)


def _with_response(theory: RotorTheory, at: response.SupportsAtSpeed) -> RotorTheory:
    rig = theory.rig
    amounts = rig.amounts
    nodes = sorted({rig.response, *amounts, *(place.node for place in rig.bearings)})
    outputs = [dof for node in nodes for dof in rig.rotor.dofs(node)]

    def amplitudes(speeds: FloatArray) -> FloatArray:
        motion = np.array(
            [
                response.unbalance_response(
                    rig.rotor, at(speed), np.array([2 * np.pi * speed]), amounts, outputs
                )
                for speed in speeds.tolist()
            ]
        ).reshape(speeds.size, len(nodes), 2)
        # The major semi-axis of an orbit is the sum of its two circles.
        return np.sum(np.abs(response.forward_backward_motion(motion)), axis=2)

    def amplitude_of_node(n: int) -> AmplitudeAt:
        return lambda speeds: amplitudes(speeds)[:, n]

    fine = np.linspace(theory.speed[0], theory.speed[-1], FINE)
    amplitude = amplitudes(fine)
    criticals = [
        critical
        for n, node in enumerate(nodes)
        for critical in peaks(fine, amplitude[:, n], node, amplitude_of_node(n))
    ]
    # Peaks that are alike are one critical speed, told where it is sharpest
    kept: list[Critical] = []
    for critical in sorted(criticals, key=lambda c: -(c.amplification or 0.0)):
        if not any(critical.is_like(other) for other in kept):
            kept.append(critical)
    return replace(
        theory,
        criticals=tuple(sorted(kept, key=lambda critical: critical.speed)),
        fine=fine,
        amplitude=amplitude,
        nodes=tuple(nodes),
    )


def peaks(
    speed: FloatArray, amplitude: FloatArray, node: int = 0, finer: AmplitudeAt | None = None
) -> list[Critical]:
    """Peaks of a response *amplitude* (n,) [m] over *speed* (n,) [Hz] with their half-power speeds; none of a
    point at rest, be it but for rounding. With *finer* the top and the half-power points are looked at at
    speeds between, and what is sharper than the speeds tell at others.
    """
    places = np.flatnonzero((amplitude[1:-1] > amplitude[:-2]) & (amplitude[1:-1] >= amplitude[2:])) + 1
    if np.min(amplitude) < AT_REST or places.size > ROUNDED * speed.size:
        return []
    curve = scipy.interpolate.CubicSpline(speed, amplitude**-2.0)
    criticals = []
    for n in places.tolist():
        least = scipy.optimize.minimize_scalar(
            _closely(curve, finer, speed[n - 1], speed[n + 1]),
            bounds=(speed[n - 1], speed[n + 1]),
            method="bounded",
            options={"xatol": 1e-9 * speed[n]},
        )
        if least.fun <= 0 or amplitude[n] < HALF_POWER * least.fun**-0.5:
            near = speed[max(n - 2, 0) : n + 3]
            closer = np.linspace(near[0], near[-1], CLOSER)
            if finer is None or np.ptp(near) <= SHARPEST * speed[n]:
                criticals.append(Critical(float(speed[n]), float(amplitude[n]), node))
            else:
                criticals += peaks(closer, finer(closer), node, finer)
            continue
        top, height = float(least.x), float(least.fun) ** -0.5
        beyond = amplitude < HALF_POWER * height
        below, above = np.flatnonzero(beyond[:n]), np.flatnonzero(beyond[n:])
        low = high = None
        if below.size:
            low = _half_power(curve, finer, speed[below[-1] :][:2], float(least.fun))
        if above.size:
            high = _half_power(curve, finer, speed[n + above[0] - 1 :][:2], float(least.fun))
        criticals.append(Critical(top, height, node, low, high))
    return criticals


def _closely(curve: AmplitudeAt, finer: AmplitudeAt | None, low: float, high: float) -> AmplitudeAt:
    """1 / amplitude^2 [1/m^2] between two speeds [Hz]: by that of all, or by more of them."""
    between = np.linspace(low, high, BETWEEN)
    return curve if finer is None else scipy.interpolate.CubicSpline(between, finer(between) ** -2.0)


def _half_power(curve: AmplitudeAt, finer: AmplitudeAt | None, ends: FloatArray, least: float) -> float:
    """Where 1 / amplitude^2 is twice the *least* [1/m^2], between *ends* (2,) [Hz]."""
    near = _closely(curve, finer, *ends)
    return float(scipy.optimize.brentq(lambda speed: float(near(speed)) - 2 * least, *ends))


# Logarithmic decrement that API 617 level I asks for at the operating speed.
LEAST_DECREMENT = 0.1


def crossing_rows(theory: RotorTheory) -> Iterator[tuple[str, str, str]]:
    """Where a damped natural frequency is that of the speed."""
    for speed, decrement, whirl in theory.crossings:
        word = "forward" if whirl > 0.3 else "backward" if whirl < -0.3 else "mixed"
        yield f"{60 * speed:.0f} rpm ({speed:.4g} Hz)", f"log decrement {decrement:.3g}", word


def sentences(theory: RotorTheory) -> Iterator[str]:
    """Peaks of the unbalance response with their margins, and stability."""
    operating = theory.rig.speed
    for critical in theory.criticals:
        text = (
            f"unbalance response: peak at {60 * critical.speed:.0f} rpm, {1e6 * critical.amplitude:.3g} um "
            f"at node {critical.node}"
        )
        if critical.amplification is None:
            yield f"{text}; no half-power points within the speeds"
            continue
        text += f", amplification {critical.amplification:.3g}"
        margin = critical.margin(operating)
        if critical.amplification < LEAST_AMPLIFICATION:
            text += ": below 2.5, no critical speed"
        elif margin is not None:
            there, asked = margin
            word = "kept" if there >= asked else "NOT kept"
            text += f"; margin to {60 * operating:g} rpm {there:.1f} %, {asked:.1f} % asked for: {word}"
        yield text
    least = theory.least_decrement
    word = "above" if least > LEAST_DECREMENT else "NOT above"
    of_mode = f" (mode of {theory.least_frequency:.4g} Hz)" if np.isfinite(least) else ""
    yield f"least log decrement at {60 * operating:g} rpm: {least:.3g}{of_mode}, {word} {LEAST_DECREMENT:g}"
    top = 60 * theory.speed[-1]
    yield (
        f"stable up to {top:.0f} rpm"
        if theory.onset is None
        else f"unstable from {60 * theory.onset:.0f} rpm on"
    )


def rotor_entry(theory: RotorTheory) -> dict[str, Any]:
    """The result as `labpipe rotor --json` writes it: speeds in Hz, null where a mode is gone."""
    operating = theory.rig.speed
    return {
        "schema": "labpipe/rotor/1",
        "name": theory.rig.name,
        "speed_hz": operating,
        "campbell": {
            "speed_hz": theory.speed.tolist(),
            "frequency_hz": without_nan(theory.frequency.tolist()),
            "log_decrement": without_nan(theory.log_decrement.tolist()),
            "whirl": without_nan(theory.whirl.tolist()),
        },
        "crossings": [
            {"speed_hz": speed, "log_decrement": decrement, "whirl": whirl}
            for speed, decrement, whirl in theory.crossings
        ],
        "critical_speeds": [
            {
                "speed_hz": critical.speed,
                "amplitude": critical.amplitude,
                "unit": "m",
                "node": critical.node,
                "amplification": critical.amplification,
                "margin_percent": None if (margin := critical.margin(operating)) is None else margin[0],
                "required_margin_percent": None if margin is None else margin[1],
            }
            for critical in theory.criticals
        ],
        "least_log_decrement": without_nan(theory.least_decrement),
        "least_log_decrement_frequency_hz": without_nan(theory.least_frequency),
        "onset_speed_hz": theory.onset,
    }


def rotor_document(theory: RotorTheory) -> Document:
    """The result as a report: what was found, Campbell diagram, damping and unbalance response over speed."""
    speed, operating = theory.speed, theory.rig.speed
    table = Table(
        ("critical speed", "damping", "whirl"), tuple(crossing_rows(theory)), "Where a mode meets the speed"
    )
    blocks: list[Block] = [Paragraph(line) for line in sentences(theory)]
    highest = float(2 * speed[-1])
    shown = [n for n in range(theory.frequency.shape[1]) if (theory.frequency[:, n] < highest).any()]
    frequencies, decrements = (
        [curve(f"mode {n + 1}", speed, values[:, n], *look(n)) for n in shown]
        for values in (theory.frequency, drawn_decrements(theory.log_decrement))
    )
    across = Axis("speed", "Hz")
    campbell = Panel(
        across,
        Axis("natural frequency", "Hz", low=0.0, high=highest),
        (*frequencies, curve("1x", speed, speed, -1, "--"), upright(operating)),
    )
    damping = Panel(across, Axis("log decrement"), (*decrements, upright(operating)))
    figures: list[Block] = [
        Figure(
            stack([campbell, damping], 5.2),
            "Campbell diagram, modes followed through crossings, and their logarithmic decrements below "
            "2 pi; dashed: the speed itself; upright: the operating speed.",
            "Natural frequencies and logarithmic decrements over speed",
        )
    ]
    if theory.fine is not None and theory.amplitude is not None:
        responses = [
            curve(f"node {node}", theory.fine, 1e6 * theory.amplitude[:, n], *look(n))
            for n, node in enumerate(theory.nodes)
        ]
        panel = Panel(
            across, Axis("major semi-axis", "um", logarithmic=True), (*responses, upright(operating))
        )
        caption = "Response to the unbalances of the file: the major semi-axis of the orbit."
        figures.append(Figure(stack([panel], 3.0), caption, "Unbalance response over speed"))
    sections = (Section("Result", (*blocks, table)), Section("Over speed", tuple(figures)))
    return Document(theory.rig.name, "Rotor by theory alone", sections, to_sign=False)
