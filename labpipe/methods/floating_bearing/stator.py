"""Forces on the stator, its motion and acceleration; the dynamic stiffness line by line; what other
excitations would give.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, FitError, SettingError
from labpipe.methods.floating_bearing import likelihood
from labpipe.records.fit_details import OtherExcitation
from labpipe.records.recording import Channel
from labpipe.records.rig import AXIS_ANGLES
from labpipe.records.spectra import ChannelSpectra
from labpipe.registry import nearest

FORCE, DISPLACEMENT, ACCELERATION = "force", "displacement", "acceleration"
QUANTITIES = (FORCE, DISPLACEMENT, ACCELERATION)
ROLES = {FORCE: "input", DISPLACEMENT: "output", ACCELERATION: "output"}
# Sine of the angle below which two directions are one.
PARALLEL = 1e-3


@dataclass(frozen=True)
class Stator(likelihood.BalanceLines):
    """[F_x, F_y, D_x, D_y, A_x, A_y] [N, m, m/s^2] of the stator, rows of zeros of to_axes (6, n_channel) [1]
    without accelerations.
    """

    @property
    def accelerated(self) -> bool:
        return bool(np.any(self.to_axes[4:]))

    @property
    def axes_covariance(self) -> ComplexArray:
        """(n_line, n_run, 6, 6) [products of N, m, m/s^2]."""
        return self.to_axes @ self.covariance @ self.to_axes.T


def stator_of(
    spectra: ChannelSpectra, band: tuple[float, float] | None, inputs: Sequence[str], outputs: Sequence[str]
) -> Stator:
    """The stator's spectra in a band [Hz]; *inputs*: names of the forces, *outputs*: of displacements and
    accelerations, all without names.

    ConfigError for channels that give no motion in x and y, FitError for too few lines.
    """
    motions = [*_columns_of_quantity(spectra, DISPLACEMENT), *_columns_of_quantity(spectra, ACCELERATION)]
    check_names(spectra, _columns_of_quantity(spectra, FORCE), inputs, FORCE, "input")
    check_names(spectra, motions, outputs, f"{DISPLACEMENT} or {ACCELERATION}", "output")
    to_axes = np.zeros((6, len(spectra.channels)))
    for number, quantity in enumerate(QUANTITIES):
        columns = _chosen_columns(spectra, quantity, inputs if quantity == FORCE else outputs)
        if columns or quantity != ACCELERATION:
            to_axes[2 * number : 2 * number + 2, columns] = _to_axes(spectra, columns, quantity)
    return Stator.of(spectra, band, to_axes, likelihood.N_EQUATION)


def _columns_of_quantity(spectra: ChannelSpectra, quantity: str) -> list[int]:
    """Of accelerations else those of sums, as references."""
    columns = spectra.columns(quantity, ROLES[quantity])
    return columns or (spectra.columns(quantity, "reference") if quantity == ACCELERATION else [])


def _chosen_columns(spectra: ChannelSpectra, quantity: str, names: Sequence[str]) -> list[int]:
    """By name, else all that do not act through a chosen sum."""
    columns = _columns_of_quantity(spectra, quantity)
    if names:
        return named_columns(spectra, columns, names)
    summed = {term.channel for n in columns for term in spectra.channels[n].terms}
    return [n for n in columns if spectra.channels[n].name not in summed]


def check_names(
    spectra: ChannelSpectra, columns: Sequence[int], names: Sequence[str], what: str, key: str
) -> None:
    """ConfigError for a name that is neither that of a channel among *columns* nor its dof."""
    places = {text for n in columns for text in (spectra.channels[n].name, spectra.channels[n].dof)}
    for name in names:
        if name not in places:
            raise SettingError(key, f"no {what} channel '{name}'", nearest(name, sorted(places)))


def named_columns(spectra: ChannelSpectra, columns: Sequence[int], names: Sequence[str]) -> list[int]:
    return [n for n in columns if {spectra.channels[n].name, spectra.channels[n].dof} & set(names)]


def _to_axes(spectra: ChannelSpectra, columns: Sequence[int], quantity: str) -> FloatArray:
    """(2, n) [1] from the channels of a quantity to x and y: forces add up, motions are projections of it."""
    channels = [spectra.channels[n] for n in columns]
    if not channels:
        what = f"there is no {quantity} channel with role {ROLES[quantity]}"
        raise ConfigError(what, hint=_missing_channels(quantity))
    angles = np.array([direction(channel) for channel in channels])
    _check_once(channels, quantity)
    directions = np.stack([np.cos(angles), np.sin(angles)])
    directions[np.abs(directions) < 1e-15] = 0.0
    if quantity == FORCE:
        return directions
    if np.linalg.svd(directions, compute_uv=False)[-1] < PARALLEL or len(channels) < 2:
        listed = ", ".join(f"{channel.name} ({channel.dof})" for channel in channels)
        what = f"{quantity} channels {listed} do not give the motion in x and in y"
        raise ConfigError(what, hint=_missing_channels(quantity))
    return np.linalg.pinv(directions.T)


def _missing_channels(quantity: str) -> str:
    what = {
        FORCE: "the forces on the stator",
        DISPLACEMENT: "displacements of the stator against the shaft in x and y",
        ACCELERATION: "its accelerations in x and y",
    }
    return f"the balance of the stator needs {what[quantity]}"


def direction(channel: Channel) -> float:
    """Angle [rad] from x towards y of a channel; ConfigError where the rig does not tell."""
    angle = channel.angle if channel.angle is not None else AXIS_ANGLES.get(channel.dof)
    if angle is None:
        what = f"the direction of channel '{channel.name}' is not known"
        raise ConfigError(what, hint="dof: x, y, or an angle from x such as 45 deg")
    return angle


def _check_once(channels: Sequence[Channel], quantity: str) -> None:
    seen: dict[str, str] = {}
    for channel in channels:
        if channel.dof in seen:
            names = f"'{seen[channel.dof]}' and '{channel.name}'"
            what = f"{quantity} channels {names} have one dof, {channel.dof}"
            key = "input" if quantity == FORCE else "output"
            raise ConfigError(what, hint=f"name those of the balance in `{key}`")
        seen[channel.dof] = channel.name


# Condition number of the motions of all runs beyond which they are one direction.
ONE_DIRECTION = 1e3


@dataclass(frozen=True)
class LineStiffness:
    """H = G m^-1 (n_line, 2, 2) [N/m] at omega (n_line,) [rad/s]; inverse (n_line, n_run, 2) [1/m]: rows of
    m^-1, by run.

    *paired*: the vectors of two neighbouring lines taken together, each line having one only.
    """

    omega: FloatArray
    stiffness: ComplexArray
    inverse: ComplexArray
    paired: bool = False


def line_stiffness(balance: likelihood.Balance) -> LineStiffness:
    """H of every line from two or more runs; FitError where the runs of a line move in one direction.
    Equation (ds-line).
    """
    if balance.motion.shape[1] < 2:
        what = "least squares needs two runs with independent forces at every line, there is one"
        raise FitError(what, hint="estimator: ml needs one run only")
    motion = balance.motion.swapaxes(-1, -2)
    if np.any(np.linalg.cond(motion) > ONE_DIRECTION):
        what = "the runs move the stator in one direction at a line"
        raise FitError(what, hint="two independent directions of force, or estimator: ml")
    inverse = np.linalg.pinv(motion)
    return LineStiffness(balance.omega, balance.right.swapaxes(-1, -2) @ inverse, inverse)


def shown_stiffness(balance: likelihood.Balance, stiffness: ComplexArray) -> tuple[LineStiffness, FloatArray]:
    """H line by line and its variance (n_line, 2, 2) [(N/m)^2], lines left out that do not tell H; of one run
    by pairs of lines. stiffness (n_line, 2, 2) [N/m] of a model gives the noise of the balance, and the
    course between the two lines of a pair: H is the model in their middle and what both lines leave.
    """
    state = likelihood.whiten(balance, stiffness)
    noise = np.stack([state.l_xx**2, np.abs(state.l_yx) ** 2 + state.l_yy**2], axis=-1)
    residual = balance.right - likelihood.times(stiffness[:, None], balance.motion)
    motion, omega = balance.motion, balance.omega
    paired = motion.shape[1] < 2
    if paired:
        omega = _pairs(omega[:, None, None]).mean(axis=(1, 2))
        stiffness = _pairs(stiffness.reshape(-1, 1, 4)).mean(axis=1).reshape(-1, 2, 2)
        residual, motion, noise = _pairs(residual), _pairs(motion), _pairs(noise)
    vectors = motion.swapaxes(-1, -2)
    is_determined = np.linalg.cond(vectors) < ONE_DIRECTION
    inverse = np.linalg.pinv(vectors[is_determined])
    h = stiffness[is_determined] + residual[is_determined].swapaxes(-1, -2) @ inverse
    variance = np.einsum("lri,lrj->lij", noise[is_determined], np.abs(inverse) ** 2)
    return LineStiffness(omega[is_determined], h, inverse, paired), variance


def _pairs(values: NDArray[Any]) -> NDArray[Any]:
    """(n_line, 1, n) as (n_line // 2, 2, n): two neighbouring lines as two runs."""
    n = values.shape[0] // 2
    return values[: 2 * n].reshape(n, 2, values.shape[2])


# Share of the power of the forces below which a line or a direction does not act.
QUIET = 1e-4
SHAPES = (("amplitude ~ 1/f", -1), ("amplitude the same at all lines", 0), ("amplitude ~ f", 1))
LETTERS = ("k", "c", "m")


def other_excitations(
    stator: Stator, estimate: likelihood.Optimum, columns: FloatArray
) -> tuple[OtherExcitation, ...]:
    """Ratios of standard errors by noise to those of this test; columns (n_equation, n_parameter)
    [1/parameter unit] of the Jacobian.

    Equation (ds-excitation).
    """
    n_line, n_run = stator.channels.shape[:2]
    unit, _ = likelihood.unit_columns(columns)
    rows = unit.reshape(2, n_line, 2 * n_run, -1).transpose(1, 0, 2, 3).reshape(n_line, 4 * n_run, -1)
    information = rows.swapaxes(1, 2) @ rows
    power = np.sum(np.abs(stator.axes[..., :2]) ** 2, axis=(1, 2))
    acting = power > QUIET * power.max()
    per_power = information[acting] / power[acting, None, None]
    here = _errors(np.sum(information[acting], axis=0))
    letters = [name[0] for name in estimate.model.names]
    others = []
    for name, exponent in SHAPES:
        shape = stator.omega[acting] ** (2 * exponent)
        planned = shape * power[acting].sum() / shape.sum()
        others.append(_ratios(name, _errors(np.tensordot(planned, per_power, 1)) / here, letters))
    # Every run with forces in one direction only, and not all the same.
    by_run = np.sum(np.abs(stator.axes[..., :2]) ** 2, axis=0)
    single = np.min(by_run, axis=1) < QUIET * np.max(by_run, axis=1)
    if np.all(single) and np.unique(np.argmax(by_run, axis=1)).size == 2:
        others.append(_ratios("both forces at once, + + and + -", np.full(here.size, np.sqrt(0.5)), letters))
    return tuple(others)


def _errors(information: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum(np.diag(np.linalg.pinv(information, hermitian=True)), np.finfo(float).tiny))


def _ratios(name: str, ratios: FloatArray, letters: list[str]) -> OtherExcitation:
    there = tuple(letter for letter in LETTERS if letter in letters)
    means = (np.mean(np.log(ratios[np.array(letters) == letter])) for letter in there)
    return OtherExcitation(name, there, tuple(float(np.exp(mean)) for mean in means))


def motion_note(stator: Stator) -> str:
    size = np.sqrt(np.mean(np.sum(np.abs(stator.axes[..., 2:4]) ** 2, axis=0) / 2, axis=0))
    x, y = (f"{1e6 * value:.3g} um" for value in size)
    return (
        "dynamic-stiffness: the coefficients hold for motions of this size: r.m.s. of the displacements "
        f"{x} in x, {y} in y."
    )
