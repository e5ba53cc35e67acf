"""The position control of a magnetic bearing: stiffness and damping over frequency, and margins of its loop.

A loop around an unstable plant has two gain margins: it becomes unstable by too much gain and by too little.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import SettingError
from labpipe.methods.magnetic_bearing.transfer import ControllerBlock, CrossControl, connect_series, rate_of
from labpipe.records.settings import Settings, quantity, section, setting

# Entries of the PID, which a controller of blocks takes the place of.
PID = ("proportional", "derivative", "derivative_time", "lag", "lag_time")


@dataclass(frozen=True, kw_only=True)
class ControlLoop(Settings):
    """The position control of one bearing: G(s) = (k_p + k_d s / (1 + s T_d) + k_i / (1 + s T_i)) e^{-s tau}
    / (1 + s / w_a). Gains as printed by Lim et al. (2009), table 1, except for the sign of k_i. With the
    printed +0.25 the lag reduces damping below 21 Hz for any other gains (c = -301 N.s/m per bearing at 2 Hz)
    and the rotor alone is unstable. Delay: one sampling interval of 20 kHz for computation, half of one for
    the hold. A *controller* of blocks in series takes the place of the PID, any transfer function of s or z;
    *cross* makes it a matrix of x and y.
    """

    proportional: float = quantity("proportional gain k_p", "1", 1.0)
    derivative: float = quantity("derivative gain k_d", "s", 6.5e-4)
    derivative_time: float = quantity("time constant T_d of the differentiator", "s", 1e-4)
    lag: float = quantity("gain k_i of the first-order lag", "1", -0.25)
    lag_time: float = quantity("time constant T_i of the lag", "s", 0.0318)
    sensor: float = quantity("sensitivity of the position probe", "V/m", 8000.0)
    amplifier: float = quantity("gain of the current amplifier", "A/V", 1.0)
    force_per_current: float = quantity("force-current factor of one bearing", "N/A", 5.8)
    bandwidth: float = quantity("-3 dB bandwidth w_a / 2 pi of the amplifier", "Hz", 1000.0)
    delay: float = quantity("delay tau of sampling and computing", "s", 75e-6)
    sensor_bandwidth: float | None = quantity(
        "-3 dB bandwidth of the probe; without it, unlimited", "Hz", None
    )
    controller: tuple[ControllerBlock, ...] = setting(
        "entries", "blocks in series, instead of the PID", section=ControllerBlock, default=()
    )
    cross: CrossControl | None = section("the other elements of a controller matrix", CrossControl, None)

    def __post_init__(self) -> None:
        self.require_not_negative("derivative_time", "lag_time", "delay")
        self.require_positive("bandwidth", "sensor_bandwidth")
        for name in ("sensor", "amplifier", "force_per_current"):
            if not getattr(self, name):
                raise SettingError(name, f"{name} must not be zero", "nothing closes the loop")
        self._check_blocks()

    def _check_blocks(self) -> None:
        written = [name for name in PID if name in self.written]
        if self.controller and written:
            what = f"{written[0]}: belongs to the PID, and there is a controller of blocks"
            raise SettingError(written[0], what, "leave it out, or put {form: pid, ...} among the blocks")
        if not self.controller and self.cross is not None:
            what, hint = "cross: needs the element x by x as controller", "controller: [{form: ...}]"
            raise SettingError("cross", what, hint)
        _ = self.rate

    def blocks(self, output: str = "x", input: str = "x") -> tuple[ControllerBlock, ...]:
        """Blocks of an element of the controller matrix; none of the PID, and of a coupling that is zero."""
        if self.cross is None or (output, input) == ("x", "x"):
            return self.controller if output == input else ()
        return getattr(self.cross, output + input) or (self.controller if output == input else ())

    @property
    def rate(self) -> float | None:
        """Sampling rate [Hz] of discrete blocks, None without one."""
        others = () if self.cross is None else (*self.cross.xy, *self.cross.yx, *self.cross.yy)
        return rate_of((*self.controller, *others))

    @property
    def at_rest(self) -> float:
        """G(0) [1] of x by x, k_p + k_i of the PID; infinite for an integrator."""
        if not self.controller:
            return self.proportional + self.lag
        continuous, discrete = connect_series(self.controller)
        return continuous.at_rest * discrete.at_rest

    @property
    def corners(self) -> tuple[float, ...]:
        """Time constants of the amplifier's and, where it is limited, the probe's first-order lag [s]."""
        limits = (self.bandwidth, self.sensor_bandwidth)
        return tuple(1 / (2 * np.pi * limit) for limit in limits if limit is not None)


def controller_terms(loop: ControlLoop, omega: FloatArray) -> dict[str, ComplexArray]:
    """The three terms of the PID by name at *omega* [rad/s], (n_line,) [1] each; of blocks the one."""
    if loop.controller:
        return {"controller": _multiply_blocks(loop.controller, omega)}
    s = 1j * omega
    return {
        "proportional": np.full(omega.shape, loop.proportional, np.complex128),
        "derivative": loop.derivative * s / (1 + s * loop.derivative_time),
        "lag": loop.lag / (1 + s * loop.lag_time),
    }


def _multiply_blocks(blocks: tuple[ControllerBlock, ...], omega: FloatArray) -> ComplexArray:
    continuous, discrete = connect_series(blocks)
    return continuous.response(omega) * discrete.response(omega)


def chain_factors(loop: ControlLoop, omega: FloatArray) -> dict[str, ComplexArray]:
    """Factors of the loop besides the PID, by name: delay, amplifier and probe, each (n_line,) [1]."""
    s = 1j * omega
    factors = {"delay": np.exp(-s * loop.delay)}
    for name, corner in zip(("amplifier", "sensor"), loop.corners, strict=False):
        factors[name] = 1 / (1 + s * corner)
    return factors


def controller(loop: ControlLoop, omega: FloatArray) -> ComplexArray:
    """G(jw) of controller (x by x), delay, amplifier and probe, (n_line,) [1]. Equation (mag-controller)."""
    total = np.sum(list(controller_terms(loop, omega).values()), axis=0)
    for factor in chain_factors(loop, omega).values():
        total = total * factor
    return total


def controller_matrix(loop: ControlLoop, omega: FloatArray) -> ComplexArray:
    """G(jw) of both directions with its cross-coupled elements, [output, input], (n_line, 2, 2) [1]."""
    direct = controller(loop, omega)
    matrix = np.zeros((direct.size, 2, 2), np.complex128)
    matrix[:, 0, 0] = matrix[:, 1, 1] = direct
    if loop.cross is not None:
        chain = np.prod(list(chain_factors(loop, omega).values()), axis=0)
        for row, column in ((0, 1), (1, 0), (1, 1)):
            blocks = loop.blocks("xy"[row], "xy"[column])
            matrix[:, row, column] = chain * _multiply_blocks(blocks, omega) if blocks else 0.0
    return matrix


def loop_stiffness(loop: ControlLoop) -> float:
    """Force per displacement at unit controller gain, K = probe * amplifier * force-current factor [N/m]."""
    return loop.sensor * loop.amplifier * loop.force_per_current


def inferred_negative_stiffness(loop: ControlLoop, static: float) -> float:
    """Negative stiffness of the bias field from the *static* stiffness, k_n = K G(0) - k_0 [N/m]; ConfigError
    for an integrator. Equation (mag-static).
    """
    if not np.isfinite(loop.at_rest):
        what = "static_stiffness: the controller integrates, so the loop is rigid at rest"
        raise SettingError("static_stiffness", what, "give negative_stiffness")
    return loop_stiffness(loop) * loop.at_rest - static


def dynamic_stiffness(loop: ControlLoop, negative_stiffness: float, omega: FloatArray) -> ComplexArray:
    """K_eq + j w C_eq = K G(jw) - k_n at *omega* [rad/s], (n_line,) [N/m]. Equation (mag-stiffness)."""
    return loop_stiffness(loop) * controller(loop, omega) - negative_stiffness


def stiffness_matrix(loop: ControlLoop, negative_stiffness: float, omega: FloatArray) -> ComplexArray:
    """K G(jw) - k_n I of both directions at *omega* [rad/s], (n_line, 2, 2) [N/m]."""
    return loop_stiffness(loop) * controller_matrix(loop, omega) - negative_stiffness * np.eye(2)


def stiffness_shares(
    loop: ControlLoop, negative_stiffness: float, omega: FloatArray
) -> dict[str, ComplexArray]:
    """Contribution of each element to K_eq + j w C_eq, by name, each (n_line,) [N/m]; their sum is
    dynamic_stiffness.

    The terms of the PID with an ideal chain; then the change by each element of the chain, in the order
    delay, amplifier, probe; the negative stiffness of the bias field, -k_n. Equation (mag-shares).
    """
    shares = {name: loop_stiffness(loop) * term for name, term in controller_terms(loop, omega).items()}
    total = np.sum(list(shares.values()), axis=0)
    for name, factor in chain_factors(loop, omega).items():
        shares[name] = total * (factor - 1)
        total = total * factor
    shares["bias_field"] = np.full(omega.shape, -negative_stiffness, np.complex128)
    return shares


LINES, LOWEST = 1201, 1e-6
# Rounds of finer lines within those, and their number: a step of 1e-2 becomes one of 1e-8, and a straight
# line does the rest.
FINER, WITHIN = 4, 33
LoopTransfer = Callable[[FloatArray], ComplexArray]


@dataclass(frozen=True)
class Margins:
    """Factors of the gain (1) down to and up to the border of stability, phase [rad], delay [s], disk [1],
    peak of |S| [1], its place [Hz]. gain_lower 0 and gain_upper, phase, delay infinite where the loop never
    gets there. disk: the balanced (symmetric) disk margin 1 / max|S - 1/2|: gain and phase may change
    together within it (Seiler, Packard and Gahinet 2020, IEEE Control Systems 40:78).
    """

    gain_lower: float
    gain_upper: float
    phase: float
    delay: float
    disk: float
    peak: float
    peak_frequency: float


def margins(loop: LoopTransfer, highest: float) -> Margins:
    """Margins of a stable *loop*, L of omega (n_line,) [rad/s], to *highest* [Hz]. Equation (mag-margins)."""
    omega = 2 * np.pi * np.concatenate([[0.0], np.geomspace(LOWEST * highest, highest, LINES)])
    values = loop(omega)
    finite = np.isfinite(values)
    omega, values = omega[finite], values[finite]
    gains = _gains(loop, omega, values)
    turns, delays = _phases(loop, omega, values)
    sensitivity = 1 / (1 + values)
    peak, at = _largest(lambda w: np.abs(1 / (1 + loop(w))), omega, np.abs(sensitivity))
    widest, _ = _largest(lambda w: np.abs(1 / (1 + loop(w)) - 0.5), omega, np.abs(sensitivity - 0.5))
    return Margins(
        gain_lower=max((gain for gain in gains if gain < 1), default=0.0),
        gain_upper=min((gain for gain in gains if gain > 1), default=float("inf")),
        phase=min(turns, default=float("inf")),
        delay=min(delays, default=float("inf")),
        disk=1 / widest,
        peak=peak,
        peak_frequency=at / (2 * np.pi),
    )


def _gains(loop: LoopTransfer, omega: FloatArray, values: ComplexArray) -> list[float]:
    places = _roots(lambda w: loop(w).imag, omega, values.imag)
    real = [*values[omega == 0].real, *(loop(np.array([place]))[0].real for place in places)]
    return [float(-1 / at) for at in real if at < 0]


def _phases(loop: LoopTransfer, omega: FloatArray, values: ComplexArray) -> tuple[list[float], list[float]]:
    """Phase from -180 deg [rad], and the delay that takes it there [s], where |L| is 1."""
    turns, delays = [], []
    for place in _roots(lambda w: np.log(np.abs(loop(w))), omega, np.log(np.abs(values))):
        angle = float(np.angle(-loop(np.array([place]))[0]))
        turns.append(abs(angle))
        delays.append(angle % (2 * np.pi) / place)
    return turns, delays


def _roots(
    function: Callable[[FloatArray], FloatArray], omega: FloatArray, values: FloatArray
) -> list[float]:
    """Where *values* (n_line,) at *omega* (n_line,) change their sign, by finer lines to 1e-12."""
    places = np.flatnonzero((values[:-1] * values[1:] < 0) & (omega[:-1] > 0))
    if places.size == 0:
        return []
    low, high = omega[places], omega[places + 1]
    for _ in range(FINER):
        points = np.linspace(low, high, WITHIN, axis=1)
        at = function(points.ravel()).reshape(points.shape)
        rows, n = np.arange(places.size), np.argmax(at[:, :-1] * at[:, 1:] <= 0, axis=1)
        low, high = points[rows, n], points[rows, n + 1]
    first, last = at[rows, n], at[rows, n + 1]
    return [float(crossing) for crossing in low + (high - low) * first / (first - last)]


def _largest(
    function: Callable[[FloatArray], FloatArray], omega: FloatArray, values: FloatArray
) -> tuple[float, float]:
    """The largest of the *function* and its place [rad/s], near the largest of its *values* (n_line,) at
    *omega* (n_line,): by finer lines and the parabola through the last three.
    """
    at, points = values, omega
    for rounds in range(FINER):
        top = int(np.argmax(at))
        if top in (0, at.size - 1):
            return float(at[top]), float(points[top])
        if rounds < FINER - 1:
            points = np.linspace(points[top - 1], points[top + 1], WITHIN)
            at = function(points)
    before, middle, after = at[top - 1 : top + 2]
    bend = before - 2 * middle + after
    shift = 0.5 * (before - after) / bend if bend else 0.0
    place = points[top] + shift * (points[top + 1] - points[top])
    return float(middle - 0.25 * (before - after) * shift), float(place)
