"""The model dynamic-stiffness: its settings, what is given of the stator's balance with its uncertainty, and
what finite blocks of random data leak into it.

F - M_s A - Z_b X_s = H D with the absolute motion X_s = -A / w^2 of the stator. To subtract Z_b from H
instead is wrong by Z_b X_r D^-1 as soon as the shaft moves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import SettingError
from labpipe.estimation.causes import stated_findings
from labpipe.estimation.diagnostics import ENOUGH_LINES, FEWEST_LINES, round_up
from labpipe.estimation.leakage import Leakage, leakage_of
from labpipe.estimation.settings import FitSettings, ModelKind
from labpipe.estimation.statistics import Pulls
from labpipe.methods.floating_bearing.forms import BANDS, FORMS, NAMES, StiffnessModel
from labpipe.methods.floating_bearing.likelihood import Balance, Whitened, real_rows, times, unit_columns
from labpipe.methods.floating_bearing.stator import ONE_DIRECTION, Stator
from labpipe.records.finding import Finding
from labpipe.records.fit_details import GivenUncertainty
from labpipe.records.identification import Fit
from labpipe.records.settings import Settings, choice, quantity, setting, text
from labpipe.records.spectra import ChannelSpectra
from labpipe.records.uncertain import Uncertain, Uncertainty, uncertainty_of
from labpipe.registry import nearest
from labpipe.spectra.settings import SPECTRA

MASS = "mass of the stator"

Respond = Callable[[ComplexArray], NDArray[Any]]


@dataclass(frozen=True)
class Baseline:
    """Dynamic stiffness of what holds the stator beside the bearing: values (n,) [parameter units] of a
    *model*, with *uncertainties*; *test* and *band* [Hz]: those of the fit which they are from.
    """

    model: StiffnessModel
    values: FloatArray
    uncertainties: tuple[GivenUncertainty, ...]
    test: str = ""
    band: tuple[float, float] = (0.0, np.inf)

    def stiffness(self, omega: FloatArray) -> ComplexArray:
        """Z_b (n_line, 2, 2) [N/m] at omega (n_line,) [rad/s]."""
        return self.model.stiffness(self.values, omega)


@dataclass(frozen=True)
class Given:
    """The given part of the balance. *absolute*: the model moves with the stator's absolute motion, as a
    baseline does.
    """

    mass: Uncertain | None = None
    baseline: Baseline | None = None
    absolute: bool = False

    @property
    def accelerated(self) -> bool:
        return self.mass is not None or self.baseline is not None

    def side(self, omega: FloatArray) -> ComplexArray:
        """What stands before A in the force side: -M_s I + Z_b / w^2 (n_line, 2, 2) [kg]. Equation
        (ds-balance).
        """
        mass = 0.0 if self.mass is None else self.mass.value
        side = np.broadcast_to(-mass * np.eye(2, dtype=np.complex128), (omega.size, 2, 2))
        if self.baseline is None:
            return side
        return side + self.baseline.stiffness(omega) / omega[:, None, None] ** 2


def projection(stator: Stator, given: Given) -> ComplexArray:
    """(n_line, 4, 6) [SI units]: from [F; D; A] to [G; m]."""
    matrix = np.zeros((stator.omega.size, 4, 6), np.complex128)
    matrix[:, :2, :2] = np.eye(2)
    absolute = stator.omega[:, None, None] ** 2
    if stator.accelerated:
        matrix[:, :2, 4:] = given.side(stator.omega)
    elif given.accelerated:
        # Only where the displacement is the absolute motion itself: A = -w^2 D.
        matrix[:, :2, 2:4] = -absolute * given.side(stator.omega)
    if given.absolute and stator.accelerated:
        matrix[:, 2:, 4:] = -np.eye(2) / absolute
    else:
        matrix[:, 2:, 2:4] = np.eye(2)
    return matrix


def balance_of(stator: Stator, given: Given) -> Balance:
    """Force side and motion of the stator with what is given."""
    to_balance = projection(stator, given)[:, None]
    sides = (to_balance @ stator.axes[..., None])[..., 0]
    covariance = to_balance @ stator.axes_covariance @ to_balance.conj().swapaxes(-1, -2)
    return Balance(
        stator.omega,
        sides[..., :2],
        sides[..., 2:],
        covariance[..., :2, :2],
        covariance[..., 2:, :2],
        covariance[..., 2:, 2:],
    )


def smoothed_channels(stator: Stator, given: Given, stiffness: ComplexArray, state: Whitened) -> ComplexArray:
    """All channels (n_line, n_run, n_channel) [SI units] without the noise that the residual tells: z - C_z
    B^H S^-1 e. Equation (ds-smoothed).
    """
    to_balance = projection(stator, given) @ stator.to_axes
    rows = to_balance[:, :2] - stiffness @ to_balance[:, 2:]
    pulled = (rows.conj().swapaxes(-1, -2)[:, None] @ state.weight()[..., None])[..., 0]
    return stator.channels - (stator.covariance @ pulled[..., None])[..., 0]


def given_errors(
    stator: Stator, given: Given, stiffness: ComplexArray, clean: ComplexArray
) -> list[tuple[Uncertainty, ComplexArray]]:
    """By source, the change of e [N] by one standard deviation of the given number, (n, n_line, n_run, 2) for
    n independent ones. stiffness (n_line, 2, 2) [N/m] of the model, *clean* (n_line, n_run, n_channel) [SI
    units] the channels with as little noise as may be.
    """
    axes = clean @ stator.to_axes.T
    omega = stator.omega[:, None, None]
    acceleration = axes[..., 4:] if stator.accelerated else -(omega**2) * axes[..., 2:4]
    errors: list[tuple[Uncertainty, ComplexArray]] = []
    if given.mass is not None and given.mass.std_error > 0:
        of_mass = uncertainty_of(given.mass, mass_source(given.mass), "kg")
        errors.append((of_mass, -given.mass.std_error * acceleration[None]))
    if given.baseline is not None:
        slopes = given.baseline.model.jacobian(given.baseline.values, stator.omega) / omega**2
        by_value = times(slopes[:, :, None], acceleration)
        for number in given.baseline.uncertainties:
            of_number = Uncertainty(number.source, number.std_error, number.unit)
            errors.append((of_number, np.tensordot(number.changes, by_value, 1)))
    to_balance = projection(stator, given) @ stator.to_axes
    rows = to_balance[:, :2] - stiffness @ to_balance[:, 2:]
    by_factors = factor_errors(stator.spectra, stator.omega, rows, clean)
    return join([*errors, *((of_factor, error[None]) for of_factor, error in by_factors)])


def factor_errors(
    spectra: ChannelSpectra, omega: FloatArray, rows: ComplexArray, clean: ComplexArray
) -> Iterator[tuple[Uncertainty, ComplexArray]]:
    """Changes (n_line, n_run, n) [N] of the residual *rows* (n_line, n, n_channel) [N per SI unit] @ *clean*
    (n_line, n_run, n_channel) [SI units] by one standard deviation of every factor of the channels; omega
    (n_line,) [rad/s].
    """
    for factor in spectra.factors:
        moved = (rows[:, None] @ (clean @ factor.derivative.T)[..., None])[..., 0]
        error = factor.std_error * omega[:, None, None] ** factor.power * moved
        if np.any(error):
            yield Uncertainty(factor.source, factor.std_error, factor.unit), error


def join(errors: Sequence[tuple[Uncertainty, ComplexArray]]) -> list[tuple[Uncertainty, ComplexArray]]:
    """Errors (..., n_line, n_run, n) [N] of one source added with their signs, each source once."""
    sources: dict[str, tuple[Uncertainty, ComplexArray]] = {}
    for uncertainty, error in errors:
        first, before = sources.get(uncertainty.source, (uncertainty, 0.0))
        sources[uncertainty.source] = (first, before + error)
    return list(sources.values())


def changes_by_given(
    stator: Stator, given: Given, model: StiffnessModel, values: FloatArray, state: Whitened
) -> ComplexArray:
    """All changes of e [N] by given numbers (n, n_line, n_run, 2), of whatever source, at values
    (n_parameter,) of a model.
    """
    stiffness = model.stiffness(values, stator.omega)
    errors = given_errors(stator, given, stiffness, smoothed_channels(stator, given, stiffness, state))
    none = np.empty((0, *stator.channels.shape[:2], 2), np.complex128)
    return np.concatenate([none, *(error for _, error in errors)])


def given_uncertainties(
    errors: Sequence[tuple[Uncertainty, ComplexArray]], respond: Respond
) -> tuple[GivenUncertainty, ...]:
    """What given numbers do to the estimates, by source; *respond*: (n, n_parameter) by changes of e (n,
    n_line, n_run, 2) [N].
    """
    return tuple(
        GivenUncertainty(number.source, respond(error), std_error=number.std_error, unit=number.unit)
        for number, error in errors
    )


def response_of(whiten: Respond, columns: FloatArray) -> Callable[[ComplexArray], FloatArray]:
    """dp = -(J^T J)^-1 J^T L^-1 de of the most likely estimates; *whiten*: L^-1 of forces, *columns* J
    (n_equation, n_parameter) [1/parameter unit]. Equation (ds-given).
    """
    unit, scale = unit_columns(columns)
    gain = -np.linalg.pinv(unit) / scale[:, None]

    def respond(errors: ComplexArray) -> FloatArray:
        return real_rows(whiten(errors).reshape(len(errors), -1)) @ gain.T

    return respond


def mass_source(mass: Uncertain) -> str:
    """The same number with the same uncertainty is the same error, in whichever fit it stands."""
    return f"{MASS}, {mass.value:g} kg +- {mass.std_error:g} kg"


def contradictions(
    given: Given, uncertainties: Sequence[GivenUncertainty], pulls: Pulls
) -> tuple[tuple[GivenUncertainty, ...], tuple[Finding, ...]]:
    """The uncertainties, of numbers that the data contradict as large as the distance to what they ask for,
    and the findings that name these numbers.

    pulls: of all independent errors of all sources, one after the other.
    """
    counts = [len(number.changes) for number in uncertainties]
    sources = [
        Uncertainty(number.source, number.std_error, number.unit)
        for number, count in zip(uncertainties, counts, strict=True)
        for _ in range(count)
    ]
    factors = np.split(pulls.factors, np.cumsum(counts)[:-1])
    widened = tuple(
        replace(number, changes=number.changes * factor[:, None])
        for number, factor in zip(uncertainties, factors, strict=True)
    )
    values = {} if given.mass is None else {mass_source(given.mass): given.mass.value}
    return widened, tuple(stated_findings(sources, pulls, values))


# H (n_line, 2, 2) [N/m] at omega (n_line,) [rad/s].
Stiffness = Callable[[FloatArray], ComplexArray]
# Frequencies at which the resonance of the stator is looked for.
N_SOUGHT = 20_000


@dataclass(frozen=True)
class SmearedBalance:
    """What blocks of random data do to the balance of a *stator* with what is *given*; *leakage* of the lines
    of the fit. ratio (n_line, 2, 2) [1/s^2]: acceleration per motion of the model, at the lines.
    """

    stator: Stator
    given: Given
    leakage: Leakage
    ratio: ComplexArray

    def motion_per_force(self, stiffness: Stiffness, omega: FloatArray, ratio: ComplexArray) -> ComplexArray:
        """(H - side * ratio)^-1 (n, 2, 2) [m/N] at omega (n,) [rad/s]; *ratio* (n, 2, 2) [1/s^2] there."""
        return np.linalg.inv(stiffness(omega) - self.given.side(omega) @ ratio)

    def smear(self, stiffness: Stiffness) -> ComplexArray:
        """The dynamic stiffness (n_line, 2, 2) [N/m] that the averages over blocks show of H. Equation
        (ds-smeared).
        """
        omega, place = self.leakage.grid
        lines, weights = self.stator.omega, self.leakage.kernel.weights
        squared = (omega[place] / lines[:, None]) ** 2
        (n_line, n_point), flat = place.shape, omega[place].ravel()
        ratio = (self.ratio[:, None] * squared[..., None, None]).reshape(-1, 2, 2)
        motion = self.motion_per_force(stiffness, flat, ratio)
        side = np.repeat(self.given.side(lines), n_point, axis=0) - self.given.side(flat)
        forces = (stiffness(flat) @ motion + side @ ratio @ motion).reshape(n_line, n_point, 2, 2)
        moved = motion.reshape(n_line, n_point, 2, 2)
        # The motion may be that of the accelerometers over -w^2.
        accelerated = self.given.absolute and self.stator.accelerated
        seen = squared if accelerated else np.ones_like(squared)
        mean_force = np.einsum("p,lpij->lij", weights, forces)
        return mean_force @ np.linalg.inv(np.einsum("p,lp,lpij->lij", weights, seen, moved))

    def correct(self, balance: Balance, stiffness: Stiffness) -> Balance:
        leaked = self.smear(stiffness) - stiffness(balance.omega)
        return replace(balance, right=balance.right - times(leaked[:, None], balance.motion))

    def finding(self, stiffness: Stiffness, modelled: bool) -> tuple[Finding, ...]:
        """A warning where the blocks are too short for the resonance of the stator in the band; *modelled*:
        what leaks is part of the fit.
        """
        lines = self.stator.omega
        omega = np.linspace(lines[0], lines[-1], N_SOUGHT)
        elements = self.ratio.real.reshape(lines.size, 4).T
        ratio = np.stack([np.interp(omega, lines, element) for element in elements], axis=1)
        motion = self.motion_per_force(stiffness, omega, ratio.reshape(-1, 2, 2).astype(np.complex128))
        peaks = (_half_power(omega, np.abs(motion[:, axis, axis])) for axis in range(2))
        widths = [peak for peak in peaks if peak is not None]
        if not widths:
            return ()
        frequency, width = min(widths, key=lambda peak: peak[1])
        length = self.leakage.kernel.blocks.length
        enough = FEWEST_LINES if modelled else ENOUGH_LINES
        if length * width >= enough:
            return ()
        why, cure = "its damping comes from the window's leakage more than from the measurement", ""
        if not modelled:
            why = "it shifts stiffness and damping, which no standard error shows"
            cure = ", or the estimator ml, which takes the leakage into the model"
        message = (
            f"the stator's resonance at {frequency:.4g} Hz is {width:.2g} Hz wide (half power), "
            f"{length * width:.2g} lines of blocks of {length:.3g} s: {why}; use blocks of at least "
            f"{round_up(enough / width):g} s{cure}"
        )
        return (Finding("leakage", message),)


def _half_power(omega: FloatArray, size: FloatArray) -> tuple[float, float] | None:
    """Frequency and half-power width [Hz] of the highest maximum of *size* (n,) at omega (n,) [rad/s]."""
    top = int(np.argmax(size))
    below = np.flatnonzero(size < size[top] / np.sqrt(2))
    before, after = below[below < top], below[below > top]
    if not before.size or not after.size:
        return None
    return float(omega[top] / (2 * np.pi)), float((omega[after[0]] - omega[before[-1]]) / (2 * np.pi))


def smeared_balance(stator: Stator, given: Given, balance: Balance) -> SmearedBalance | None:
    leakage = leakage_of(stator.spectra.blocks, stator.omega / (2 * np.pi), np.empty(0), 0)
    if leakage is None:
        return None
    ratio = np.asarray(-(stator.omega**2)[:, None, None] * np.eye(2), np.complex128)
    if not given.absolute and stator.accelerated and balance.motion.shape[1] > 1:
        # The shaft moves too: acceleration per motion against it, where both runs tell it.
        motion = balance.motion.swapaxes(-1, -2)
        tells = np.linalg.cond(motion) < ONE_DIRECTION
        ratio[tells] = stator.axes[tells, :, 4:].swapaxes(-1, -2) @ np.linalg.pinv(motion[tells])
    return SmearedBalance(stator, given, leakage, ratio)


MOTIONS = ("relative", "absolute")
SYMMETRIES = ("none", "seal", "direct")
OF_SOMMERFELD = ("viscosity", "diameter", "length")
COMPARED = ("kc", "kcm", "relaxation", "pad")


@dataclass(frozen=True)
class DynamicStiffnessSettings(Settings):
    """What is identified and what is given; *fitted_baseline*: that of `baseline`, once it is made."""

    form: str | None = choice("course over frequency; default: kcm, or with `compare` the best", NAMES, None)
    _: KW_ONLY
    symmetry: str = choice(
        "none; seal: k_xx = k_yy, k_xy = -k_yx; direct: no cross terms", SYMMETRIES, "none"
    )
    motion: str = choice("that it acts on: against the shaft, or absolute (baseline)", MOTIONS, "relative")
    stator_mass: Uncertain | None = setting(
        "uncertain", "mass of the stator with its uncertainty; default: `mass`", "kg", None
    )
    baseline: str = text("an earlier fit of what holds the stator, or its test")
    baseline_stiffness: Uncertain | None = setting(
        "uncertain", "of what holds the stator, in x and y", "N/m", None
    )
    baseline_damping: Uncertain | None = setting(
        "uncertain", "of what holds the stator, in x and y", "N.s/m", None
    )
    band_width: float | None = quantity(
        "form bands: about the width of one, all alike; default: a tenth", "Hz", None
    )
    forms: tuple[str, ...] = setting(
        "names", "forms that `compare` holds against each other", default=COMPARED
    )
    speed: float | None = quantity(
        "speed of the shaft, from x to y; default: the test's condition `speed`", "Hz", None
    )
    rotor_mass: Uncertain | None = setting(
        "uncertain", "mass on the bearing, for the onset speed of whirl of a rotor on it", "kg", None
    )
    rotor_stiffness: float | None = quantity("stiffness of that rotor; default: rigid", "N/m", None)
    load: float | None = quantity(
        "for coefficients without dimension; default: the condition `load`", "N", None
    )
    clearance: float | None = quantity("radial clearance, for coefficients without dimension", "m", None)
    viscosity: float | None = quantity("for the Sommerfeld number", "Pa.s", None)
    diameter: float | None = quantity("for the Sommerfeld number", "m", None)
    length: float | None = quantity("for the Sommerfeld number", "m", None)
    fitted_baseline: Baseline | None = None

    def __post_init__(self) -> None:
        if self.baseline and (self.baseline_stiffness or self.baseline_damping):
            raise SettingError("baseline", "'baseline' is given twice", "a fit, or numbers")
        self.require_not_negative("stator_mass")
        self.require_positive(
            "rotor_mass", "band_width", "rotor_stiffness", "load", "clearance", *OF_SOMMERFELD
        )
        for name, of, other in (
            ("rotor_stiffness", "a rotor's mass", "rotor_mass"),
            *((name, "a clearance", "clearance") for name in ("load", *OF_SOMMERFELD)),
            *((name, f"a {other}", other) for name in OF_SOMMERFELD for other in OF_SOMMERFELD),
        ):
            if getattr(self, name) is not None and getattr(self, other) is None:
                raise SettingError(name, f"'{name}' goes with {of}", f"give {other}, or leave it out")
        for form in self.forms:
            if form not in FORMS:
                raise SettingError("forms", f"'forms': '{form}' cannot be compared", nearest(form, FORMS))
        if self.band_width is not None and self.form != BANDS:
            raise SettingError("band_width", "'band_width' goes with form: bands", "leave it out")


def _fit(spectra: ChannelSpectra, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.methods.floating_bearing.fit import dynamic_stiffness_fits

    return dynamic_stiffness_fits(spectra, settings)


def _begin(settings: FitSettings, fits: Sequence[Fit]) -> FitSettings:
    from labpipe.methods.floating_bearing.fit import with_baseline

    return with_baseline(settings, fits)


DYNAMIC_STIFFNESS = ModelKind(
    _fit,
    "dynamic_stiffness",
    DynamicStiffnessSettings,
    "dynamic_stiffness: {form: kcm}",
    optional=True,
    earlier=lambda settings: settings.model_settings.baseline,
    begin=_begin,
    of=SPECTRA,
    keys=("mass", "input", "output", "bands", "compare"),
    by_likelihood=("compare",),
    estimators=("ml", "ls"),
)
