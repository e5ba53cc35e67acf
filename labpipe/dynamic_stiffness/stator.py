"""Forces on the stator, its motion against the shaft and its acceleration in x and y, of the channels of a test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import ConfigError, FitError
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.recording import Channel
from labpipe.records.rig import AXIS_ANGLES
from labpipe.registry import nearest
from labpipe.spectra.bands import lines_in

FORCE, DISPLACEMENT, ACCELERATION = "force", "displacement", "acceleration"
QUANTITIES = (FORCE, DISPLACEMENT, ACCELERATION)
ROLES = {FORCE: "input", DISPLACEMENT: "output", ACCELERATION: "output"}
LEAST_LINES = 3
# Sine of the angle below which two directions are one.
PARALLEL = 1e-3


@dataclass(frozen=True)
class Stator:
    """Spectra of the stator on the lines of a fit.

    omega (n_line,) [rad/s]; channels (n_line, n_run, n_channel) and their covariance (n_line, n_run, n_channel, n_channel): all that was
    measured [SI units]; to_axes (6, n_channel) [1]: [F_x, F_y, D_x, D_y, A_x, A_y] = to_axes @ channels [N, m, m/s^2], rows of zeros
    without accelerations. shared, shared_power: factor of the noise that lines share on the variance of a sum over lines, and of powers.
    """

    omega: FloatArray
    channels: ComplexArray
    covariance: ComplexArray
    to_axes: FloatArray
    spectra: ChannelSpectra
    shared: float = 1.0
    shared_power: float = 1.0

    @property
    def accelerated(self) -> bool:
        """Whether accelerations were measured."""
        return bool(np.any(self.to_axes[4:]))

    @property
    def axes(self) -> ComplexArray:
        """(n_line, n_run, 6) [N, m, m/s^2]: forces, displacements, accelerations in x and y."""
        return self.channels @ self.to_axes.T

    @property
    def axes_covariance(self) -> ComplexArray:
        """(n_line, n_run, 6, 6) [products of N, m, m/s^2]."""
        return self.to_axes @ self.covariance @ self.to_axes.T


def stator_of(spectra: ChannelSpectra, band: tuple[float, float] | None, inputs: Sequence[str], outputs: Sequence[str]) -> Stator:
    """The stator's spectra in a band [Hz]; *inputs*: names of the forces, *outputs*: of displacements and accelerations, all without names.

    ConfigError for channels that give no motion in x and y, FitError for too few lines.
    """
    chosen = {quantity: _chosen(spectra, quantity, inputs if quantity == FORCE else outputs) for quantity in QUANTITIES}
    _check_names(spectra, inputs, [FORCE], "input")
    _check_names(spectra, outputs, [DISPLACEMENT, ACCELERATION], "output")
    to_axes = np.zeros((6, len(spectra.channels)))
    for number, quantity in enumerate(QUANTITIES):
        columns = chosen[quantity]
        if columns or quantity != ACCELERATION:
            to_axes[2 * number : 2 * number + 2, columns] = _to_axes(spectra, columns, quantity)
    lines: BoolArray = np.ones(spectra.frequency.size, bool) if band is None else lines_in(spectra.frequency, band)
    if np.count_nonzero(lines) < LEAST_LINES:
        raise FitError(f"{np.count_nonzero(lines)} lines in the band", hint=f"{LEAST_LINES} or more: widen `band`")
    shared = _shared(spectra, lines)
    omega = 2 * np.pi * spectra.frequency[lines]
    return Stator(omega, spectra.vectors[lines], spectra.covariance[lines], to_axes, spectra, *shared)


def _measured(spectra: ChannelSpectra, quantity: str) -> list[int]:
    """Columns of a quantity in its role; accelerations that stand in sums only, as references, where no others are there."""
    columns = spectra.columns(quantity, ROLES[quantity])
    return columns or (spectra.columns(quantity, "reference") if quantity == ACCELERATION else [])


def _chosen(spectra: ChannelSpectra, quantity: str, names: Sequence[str]) -> list[int]:
    """Columns of a quantity that are named, or all; a channel that stands in a chosen sum only acts through that, unless it is named."""
    columns = _measured(spectra, quantity)
    if names:
        return [n for n in columns if {spectra.channels[n].name, spectra.channels[n].dof} & set(names)]
    summed = {term.channel for n in columns for term in spectra.channels[n].terms}
    return [n for n in columns if spectra.channels[n].name not in summed]


def _check_names(spectra: ChannelSpectra, names: Sequence[str], quantities: Sequence[str], key: str) -> None:
    """ConfigError for a name that no channel has."""
    columns = [n for quantity in quantities for n in _measured(spectra, quantity)]
    places = {text for n in columns for text in (spectra.channels[n].name, spectra.channels[n].dof)}
    for name in names:
        if name not in places:
            what = " or ".join(quantities)
            raise ConfigError(f"no {what} channel '{name}'", hint=nearest(name, sorted(places)), field=key)


def _to_axes(spectra: ChannelSpectra, columns: Sequence[int], quantity: str) -> FloatArray:
    """(2, n) [1] from the channels of a quantity to x and y: forces add up, motions are projections of it."""
    channels = [spectra.channels[n] for n in columns]
    if not channels:
        raise ConfigError(f"there is no {quantity} channel with role {ROLES[quantity]}", hint=_needed(quantity))
    angles = np.array([direction(channel) for channel in channels])
    _check_once(channels, quantity)
    directions = np.stack([np.cos(angles), np.sin(angles)])
    directions[np.abs(directions) < 1e-15] = 0.0
    if quantity == FORCE:
        return directions
    if np.linalg.svd(directions, compute_uv=False)[-1] < PARALLEL or len(channels) < 2:
        listed = ", ".join(f"{channel.name} ({channel.dof})" for channel in channels)
        raise ConfigError(f"{quantity} channels {listed} do not give the motion in x and in y", hint=_needed(quantity))
    return np.asarray(np.linalg.pinv(directions.T))


def _needed(quantity: str) -> str:
    what = {FORCE: "the forces on the stator", DISPLACEMENT: "displacements of the stator against the shaft in x and y"}
    return f"the balance of the stator needs {what.get(quantity, 'its accelerations in x and y')}"


def direction(channel: Channel) -> float:
    """Angle [rad] from x towards y of a channel; ConfigError where the rig does not tell."""
    angle = channel.angle if channel.angle is not None else AXIS_ANGLES.get(channel.dof)
    if angle is None:
        raise ConfigError(f"the direction of channel '{channel.name}' is not known", hint="dof: x, y, or an angle from x such as 45 deg")
    return angle


def _check_once(channels: Sequence[Channel], quantity: str) -> None:
    """ConfigError for two channels of one direction: a raw force and the same force with the inertia taken out must not be added."""
    seen: dict[str, str] = {}
    for channel in channels:
        if channel.dof in seen:
            key = "input" if quantity == FORCE else "output"
            hint = f"name those of the balance in `{key}`"
            raise ConfigError(f"{quantity} channels '{seen[channel.dof]}' and '{channel.name}' have one dof, {channel.dof}", hint=hint)
        seen[channel.dof] = channel.name


def _shared(spectra: ChannelSpectra, lines: BoolArray) -> tuple[float, float]:
    """1 + 2 sum Re c_d and 1 + 2 sum |c_d|^2 of the correlation c of lines that lie side by side, as far as both are in the band."""
    correlation = np.array(spectra.line_correlation, np.complex128)
    if not correlation.size:
        return 1.0, 1.0
    n = int(np.count_nonzero(lines))
    pairs = np.maximum(n - np.arange(1, correlation.size + 1), 0) / n
    return max(1 + 2 * float(np.sum(pairs * correlation.real)), 1.0), 1 + 2 * float(np.sum(pairs * np.abs(correlation) ** 2))
