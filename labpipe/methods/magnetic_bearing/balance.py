"""The balance of a levitated rotor, M x'' = K_i i - K_s x, from currents and displacements of a test: B z = 0
with z = [I, X].

Smooth currents: B = [-K_i, K_s - w^2 M + j w C]. Behind a held output the current between samples is not
smooth; then exactly, with A = M^-1 K_s, x[k+1] + x[k-1] - 2 cos(sqrt(A) T) x[k] = the integral of sin(sqrt(A)
(T - |t|)) / sqrt(A) M^-1 K_i i(t) over -T ... T.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, SettingError
from labpipe.methods.floating_bearing.likelihood import BalanceLines
from labpipe.methods.floating_bearing.stator import check_names, named_columns
from labpipe.methods.magnetic_bearing.settings import BEARING, FULL, MagnetSettings
from labpipe.records.recording import Channel
from labpipe.records.rig import AXIS_ANGLES
from labpipe.records.spectra import ChannelSpectra

CURRENT, DISPLACEMENT = "current", "displacement"
# Relative distance of two places along the axis below which they are one.
SAME_PLACE = 1e-9


@dataclass(frozen=True)
class LevitationBalance(BalanceLines):
    """Currents [A], then displacements at the magnets [m], by to_axes (2 n, n_channel) [1], and the rotor
    that ties them: mass (n, n) [kg] at the magnets.

    Planes: numbers of the axes of every plane. labels (n,) of the axes; bearing (n,): number of the bearing
    of each.
    """

    mass: FloatArray
    currents: tuple[Channel, ...]
    planes: tuple[tuple[int, ...], ...]
    labels: tuple[str, ...]
    bearing: tuple[int, ...]

    @property
    def n_axis(self) -> int:
        return len(self.labels)


def levitation_of(
    spectra: ChannelSpectra,
    band: tuple[float, float] | None,
    names: tuple[Sequence[str], Sequence[str]],
    mass: FloatArray | float,
    settings: MagnetSettings,
) -> LevitationBalance:
    """The levitated rotor of a test in a band [Hz]; *mass* [kg], or (n, n).

    *names* of the currents and of the displacements, all without names.
    ConfigError for channels that do not pair or whose places are not known, FitError for too few lines.
    """
    currents = _choose(spectra, CURRENT, ("input", "output"), names[0], "input")
    displacements = _choose(spectra, DISPLACEMENT, ("output",), names[1], "output")
    displacements = _pair(spectra.channels, currents, displacements)
    chosen = [spectra.channels[n] for n in currents]
    n = len(currents)
    to_axes = np.zeros((2 * n, len(spectra.channels)))
    to_axes[:n, currents] = np.eye(n)
    sensors = [spectra.channels[k] for k in displacements]
    to_axes[n:, displacements], bearing, planes = _displacements_at_magnets(chosen, sensors)
    cure = ", or raise the level, since lines at which no current exceeds its noise are left out"
    return LevitationBalance.of(
        spectra,
        band,
        to_axes,
        n,
        cure,
        mass=mass_matrix(chosen, planes, mass, settings),
        currents=tuple(chosen),
        planes=planes,
        labels=tuple(channel.dof for channel in chosen),
        bearing=bearing,
    )


def _choose(
    spectra: ChannelSpectra, quantity: str, roles: Sequence[str], names: Sequence[str], key: str
) -> list[int]:
    columns = [n for role in roles for n in spectra.columns(quantity, role)]
    check_names(spectra, columns, names, quantity, key)
    columns = named_columns(spectra, columns, names) if names else columns
    if not columns:
        hint = f"quantity: {quantity}, role: {roles[0]}, dof: x in the rig file"
        raise SettingError(key, f"there is no {quantity} channel", hint)
    dofs = [spectra.channels[n].dof for n in columns]
    if len(set(dofs)) < len(dofs):
        dof = next(dof for dof in dofs if dofs.count(dof) > 1)
        raise SettingError(key, f"two {quantity} channels have the dof {dof}", f"name one of them in `{key}`")
    return columns


def _pair(channels: Sequence[Channel], currents: Sequence[int], displacements: Sequence[int]) -> list[int]:
    of_dof = {channels[n].dof: n for n in displacements}
    missing = [channels[n] for n in currents if channels[n].dof not in of_dof]
    if missing:
        hint = (
            f"displacements have {', '.join(sorted(of_dof))}; give current and displacement of an axis "
            "the same dof"
        )
        what = f"the current {missing[0].name} of dof {missing[0].dof} has no displacement"
        raise SettingError("output", what, hint)
    return [of_dof[channels[n].dof] for n in currents]


def _displacements_at_magnets(
    currents: Sequence[Channel], sensors: Sequence[Channel]
) -> tuple[FloatArray, tuple[int, ...], tuple[tuple[int, ...], ...]]:
    """Displacements at the magnets by the sensors' (n, n) [1], the bearing of each axis, axes by plane."""
    planes: dict[float | str, list[int]] = {}
    for number, channel in enumerate(currents):
        planes.setdefault(_plane(channel), []).append(number)
    matrix = np.eye(len(currents))
    for axes in planes.values():
        if len(axes) == 1:
            continue
        if len(axes) > 2:
            what = f"{len(axes)} currents act in one plane: {', '.join(currents[k].name for k in axes)}"
            raise SettingError("input", what)
        magnets, probes = (_places([channels[k] for k in axes]) for channels in (currents, sensors))
        matrix[np.ix_(axes, axes)] = magnets @ np.linalg.inv(probes)
    places = [channel.position for channel in currents]
    ordered = sorted({place for place in places if place is not None})
    bearing = tuple(0 if place is None else ordered.index(place) for place in places)
    return matrix, bearing, tuple(tuple(axes) for axes in planes.values())


def _plane(channel: Channel) -> float | str:
    """What axes of one plane share: the angle, or the last letter of a name such as ax and bearing2.y."""
    if channel.angle is not None:
        return round(channel.angle, 9)
    return AXIS_ANGLES.get(channel.dof[-1:], channel.dof)


def _places(channels: Sequence[Channel]) -> FloatArray:
    """Displacement (2, 2) [1, m] of two places in one plane by that at the origin and the slope."""
    for channel in channels:
        if channel.position is None:
            what = f"two bearings act in one plane, and the place of channel '{channel.name}' is not known"
            raise ConfigError(what, hint="position: 120 mm, along the axis")
    matrix = np.column_stack([np.ones(2), np.array([channel.position for channel in channels], float)])
    if abs(np.linalg.det(matrix)) <= SAME_PLACE * np.max(np.abs(matrix)):
        what = f"channels {channels[0].name} and {channels[1].name} of one plane have one position"
        raise ConfigError(what, hint="two places")
    return matrix


def mass_matrix(
    currents: Sequence[Channel],
    planes: Sequence[Sequence[int]],
    mass: FloatArray | float,
    settings: MagnetSettings,
) -> FloatArray:
    """Mass (n, n) [kg] of the rigid rotor at the magnets, T^-T diag(m, J) T^-1 in a plane with two of them.

    *mass* [kg] of the rotor, or the matrix itself. ConfigError without the moment of inertia where it counts,
    with one where it does not, and for a mass that no rotor has.
    """
    n, whole = len(currents), not isinstance(mass, float)
    given = [name for name in ("inertia", "centre") if getattr(settings, name)]
    if given and (whole or all(len(axes) == 1 for axes in planes)):
        of = "one mass of a rotor" if whole else "a rotor"
        raise SettingError(given[0], f"'{given[0]}' belongs to {of} on two bearings", "leave it out")
    if not isinstance(mass, float):
        return _whole_matrix(np.asarray(mass, float), n)
    if not mass > 0:
        raise SettingError("mass", f"the mass of the rotor is above zero, not {mass:g} kg")
    matrix = np.zeros((n, n))
    for axes in planes:
        if len(axes) == 1:
            matrix[axes[0], axes[0]] = mass
            continue
        if settings.inertia is None:
            hint = "inertia: 0.02 kg.m^2 +- 1 %, about the centre of gravity"
            raise SettingError("inertia", "a rotor on two bearings needs its moment of inertia", hint)
        from_centre = np.array([[1.0, -settings.centre], [0.0, 1.0]])
        back = np.linalg.inv(_places([currents[k] for k in axes]) @ from_centre)
        matrix[np.ix_(axes, axes)] = back.T @ np.diag([mass, settings.inertia.value]) @ back
    return matrix


def _whole_matrix(mass: FloatArray, n: int) -> FloatArray:
    """The mass matrix as it was given; ConfigError where it is not one of *n* axes."""
    if mass.shape != (n, n):
        what = f"the mass has {mass.shape[0]} axes, the currents {n}"
        raise SettingError("mass", what, "one number, or a row per axis")
    if not np.allclose(mass, mass.T) or np.min(np.linalg.eigvalsh(mass)) <= 0:
        hint = "symmetric, and positive for every motion"
        raise SettingError("mass", "the mass matrix is that of no rotor", hint)
    return mass


# Powers of A T^2, the square of the pole times the sampling interval, beyond which rounding is larger.
POWERS = 6
NODES = 24
STEP = 1e-5
UNITS = {"k_i": "N/A", "k_s": "N/m", "c": "N.s/m"}


@dataclass(frozen=True)
class Between:
    """The current between samples: held at *rate* [Hz], behind an amplifier of *bandwidth* [Hz] or none."""

    rate: float
    bandwidth: float | None = None

    def moments(self, omega: FloatArray) -> ComplexArray:
        """n_j(w), (n_power, n_line) [s^(2 j)]: (1/T^2) integral of (T - |t|)^(2 j + 1) / (2 j + 1)! i(t) /
        i_0 over -T ... T. Equation (mag-moments).
        """
        interval = 1 / self.rate
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        t, weights = interval * (nodes + 1) / 2, interval * weights / 2
        later = np.zeros_like(t)
        if self.bandwidth is not None:
            corner = 2 * np.pi * self.bandwidth
            later = np.expm1(-corner * t) / np.expm1(-corner * interval)
        z = np.exp(1j * np.asarray(omega) * interval)[:, None]
        ahead, behind = (1 - later) + z * later, (1 - later) / z + later
        of_powers = [
            ((interval - t) ** power * ahead + t**power * behind) @ weights / factorial(power)
            for power in range(1, 2 * POWERS, 2)
        ]
        return np.asarray(self.rate**2 * np.array(of_powers))


@dataclass(frozen=True)
class MagnetModel:
    """Parameters K_i, K_s and C by their places (row, column), in the order of *names*; *mass* (n, n) [kg].

    places: (kind, row, column) of every parameter; *between* None for smooth currents.
    """

    names: tuple[str, ...]
    places: tuple[tuple[str, int, int], ...]
    mass: FloatArray
    between: Between | None = None

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(UNITS[kind] for kind, _, _ in self.places)

    def matrices(self, values: FloatArray) -> dict[str, FloatArray]:
        """K_i [N/A], K_s [N/m] and C [N.s/m], (n, n), of values (n_parameter,)."""
        n = len(self.mass)
        matrices: dict[str, FloatArray] = {kind: np.zeros((n, n)) for kind in UNITS}
        for (kind, row, column), value in zip(self.places, values, strict=True):
            matrices[kind][row, column] = value
        return matrices

    def rows(self, values: FloatArray, omega: FloatArray, mass: FloatArray | None = None) -> ComplexArray:
        """B (n_line, n, 2 n) [N/A, N/m] of values (n_parameter,) at omega (n_line,) [rad/s]; another *mass*
        (n, n) [kg] in its place. Equation (mag-balance).
        """
        mass = self.mass if mass is None else mass
        matrices, w = self.matrices(values), np.asarray(omega)[:, None, None]
        if self.between is None:
            current = np.broadcast_to(-matrices["k_i"].astype(np.complex128), (len(omega), *mass.shape))
            return np.concatenate([current, matrices["k_s"] - w**2 * mass + 1j * w * matrices["c"]], axis=2)
        interval = 1 / self.between.rate
        a = np.linalg.solve(mass, matrices["k_s"])
        powers = [np.linalg.matrix_power(-a, j) for j in range(POWERS + 1)]
        moments = self.between.moments(omega)
        pushed = (
            mass
            @ sum(moments[j][:, None, None] * powers[j] for j in range(POWERS))
            @ np.linalg.solve(mass, matrices["k_i"])
        )
        # 2 (cos(w T) - cos(sqrt(A) T)) / T^2, the one of both cosines taken from both series.
        turned = 2 * sum(powers[j] * interval ** (2 * j - 2) / factorial(2 * j) for j in range(1, POWERS + 1))
        moved = -4 * np.sin(w * interval / 2) ** 2 / interval**2 * mass - mass @ turned
        return np.concatenate([-pushed, moved + 1j * np.sin(w * interval) / interval * matrices["c"]], axis=2)

    def slopes(self, values: FloatArray, omega: FloatArray) -> ComplexArray:
        """dB/dp (n_parameter, n_line, n, 2 n) [N/A, N/m per parameter unit], by differences."""
        # Sizes of parameters that count, from the inertia at the middle of the band.
        middle = float(np.median(omega))
        inertia = float(np.max(np.abs(self.mass))) * middle**2
        sizes = {"k_i": 1.0, "k_s": inertia, "c": inertia / middle}
        scale = np.maximum(np.abs(values), [sizes[kind] for kind, _, _ in self.places])
        return np.array(
            [
                (self.rows(values + step, omega) - self.rows(values - step, omega)) / (2 * step.sum())
                for step in np.diag(STEP * scale)
            ]
        )


def magnet_model(
    labels: tuple[str, ...],
    bearing: tuple[int, ...],
    mass: FloatArray,
    coupling: str,
    damping: bool,
    between: Between | None,
) -> MagnetModel:
    """The model of axes *labels* on their bearings, mass (n, n) [kg]: which terms are estimated."""
    n = len(labels)
    pairs = [
        (row, column)
        for row in range(n)
        for column in range(n)
        if row == column or coupling == FULL or (coupling == BEARING and bearing[row] == bearing[column])
    ]
    kinds = [kind for kind in UNITS if kind != "c" or damping]
    places = tuple((kind, row, column) for kind in kinds for row, column in pairs)
    glue = "" if all(len(label) == 1 for label in labels) else "_"
    names = tuple(
        kind if n == 1 else f"{kind}_{labels[row]}{glue}{labels[column]}" for kind, row, column in places
    )
    return MagnetModel(names, places, mass, between)
