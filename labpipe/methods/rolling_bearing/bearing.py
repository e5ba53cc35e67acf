"""Ball and roller bearings as kinds of bearing: from their settings to coefficients, a whole sweep at once,
and ball passage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike

from labpipe.arrays import FloatArray
from labpipe.bearings import kinds
from labpipe.methods.rolling_bearing.equilibrium import Equilibrium, equilibrium
from labpipe.methods.rolling_bearing.loads import (
    DOFS,
    LOAD_UNITS,
    LOADS,
    RADIAL,
    RollingBearing,
    modes,
    sdof_stiffness,
    theoretical_response,
)
from labpipe.methods.rolling_bearing.settings import (
    BallBearingSettings,
    RollerBearingSettings,
    RollingSettings,
)
from labpipe.records.finding import Finding
from labpipe.records.response import FrequencyResponse

POSITIONS = 24


@dataclass(frozen=True)
class Passage:
    """Stiffness (n_position, n_case, 5, 5) [N/m, N/rad, N m/rad] over one passage. cage_angle (n_position,)
    [rad]: equal steps over 2 pi / z without the end point, so that the mean over positions is the mean over
    time.
    """

    cage_angle: FloatArray
    stiffness: FloatArray

    @cached_property
    def lowest(self) -> FloatArray:
        """Smallest value of each coefficient, (n_case, 5, 5) [N/m, N/rad, N m/rad]."""
        return self.stiffness.min(axis=0)

    @cached_property
    def highest(self) -> FloatArray:
        """Largest value of each coefficient, (n_case, 5, 5) [N/m, N/rad, N m/rad]."""
        return self.stiffness.max(axis=0)


def ball_passage(
    bearing: RollingBearing,
    loads: ArrayLike,
    displacements: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0),
    fixed_dofs: Sequence[str] = (),
    positions: int = POSITIONS,
) -> Passage:
    """Equilibrium and stiffness at *positions* cage angles of one passage; arguments and errors as in
    `equilibrium`. Equation (roll-passage).
    """
    f, q = (np.atleast_2d(np.asarray(values, np.float64)) for values in (loads, displacements))
    n_case = max(len(f), len(q))
    angles = 2 * np.pi / bearing.elements * np.arange(positions) / positions
    cases = [
        np.tile(np.broadcast_to(values, (n_case, values.shape[-1])), (positions, 1)) for values in (f, q)
    ]
    state = equilibrium(bearing, cases[0], cases[1], fixed_dofs, np.repeat(angles, n_case))
    return Passage(angles, state.stiffness.reshape(positions, n_case, len(DOFS), len(DOFS)))


UNITS = ("m", "m", "m", "rad", "rad")


def rolling_coefficients(settings: Sequence[RollingSettings]) -> list[kinds.BearingCoefficients]:
    groups: dict[tuple[RollingBearing, tuple[str, ...]], list[int]] = {}
    for number, entry in enumerate(settings):
        groups.setdefault((entry.bearing(), entry.fixed_dofs), []).append(number)
    coefficients: dict[int, kinds.BearingCoefficients] = {}
    for group, numbers in groups.items():
        coefficients.update(zip(numbers, _group(*group, [settings[n] for n in numbers]), strict=True))
    return [coefficients[number] for number in range(len(settings))]


def _group(
    bearing: RollingBearing, fixed_dofs: tuple[str, ...], settings: Sequence[RollingSettings]
) -> list[kinds.BearingCoefficients]:
    loads = np.array([[getattr(entry.loads, load) or 0.0 for load in LOADS] for entry in settings])
    moves = np.array([[getattr(entry.displacements, dof) or 0.0 for dof in DOFS] for entry in settings])
    state = equilibrium(bearing, loads, moves, fixed_dofs, np.array([entry.cage_angle for entry in settings]))
    passage = ball_passage(bearing, loads, moves, fixed_dofs)
    return [_case(entry, state, passage, case) for case, entry in enumerate(settings)]


def _amounts(names: Sequence[str], values: FloatArray, units: Sequence[str]) -> list[kinds.Amount]:
    return [
        kinds.Amount(name, float(value), unit) for name, value, unit in zip(names, values, units, strict=True)
    ]


def _case(
    settings: RollingSettings, state: Equilibrium, passage: Passage, case: int
) -> kinds.BearingCoefficients:
    k, at = state.stiffness[case], state.contacts
    rest = _amounts(DOFS, state.displacement[case], UNITS)
    rest += _amounts([f"load_{name}" for name in LOADS], state.load[case], LOAD_UNITS)
    loaded = int(np.sum(at.load[case] > 0))
    warnings = []
    if state.mirrored[case]:
        message = (
            "elements carry at the opposite contact angle, across the groove: a bearing with one "
            "shoulder cannot carry this load"
        )
        warnings.append(Finding("mirrored", message))
    if not state.determinate[case]:
        message = (
            f"{loaded} of {state.bearing.elements} elements carry: the rest position is not "
            "unique, the stiffness is singular"
        )
        warnings.append(Finding("indeterminate", message))
    return kinds.BearingCoefficients(
        dofs=DOFS,
        stiffness=k,
        damping=settings.damping_factor * k,
        rest=(*rest, kinds.Amount("loaded_elements", float(loaded), "1")),
        element_state={
            "element_angle": state.angles[case],
            "element_load": at.load[case],
            "element_deflection": at.deflection[case],
            "contact_angle": state.contact_angle[case],
        },
        # The cage angle of the file need not be one of the positions.
        lowest=np.minimum(passage.lowest[case], k),
        highest=np.maximum(passage.highest[case], k),
        notes=_notes(settings),
        shaft=_shaft(settings, k),
        findings=tuple(warnings),
    )


def _notes(settings: RollingSettings) -> tuple[kinds.Amount, ...]:
    bearing, hertz = settings.bearing(), settings.hertz_constant()
    unit = "N/m^1.5" if bearing.is_ball else "N/m^(10/9)"
    constant = kinds.Amount("stiffness_constant", bearing.stiffness_constant, unit)
    return (constant,) if hertz is None else (constant, kinds.Amount("stiffness_constant_hertz", hertz, unit))


def _shaft(settings: RollingSettings, stiffness: FloatArray) -> tuple[kinds.Amount, ...]:
    if settings.shaft is None:
        return ()
    shaft_modes = modes(settings.shaft.body, stiffness)
    numbers = range(1, len(DOFS) + 1)
    amounts = _amounts([f"f_{n}" for n in numbers], shaft_modes.frequency, ["Hz"] * len(DOFS))
    if settings.damping_factor > 0:
        ratios = shaft_modes.damping_ratio(settings.damping_factor)
        amounts += _amounts([f"zeta_{n}" for n in numbers], ratios, ["1"] * len(DOFS))
    fitted = sdof_stiffness(settings.shaft.body, stiffness)
    units = ("N/m", "N/m", "N/m", "N.m/rad", "N.m/rad")
    return (*amounts, *_amounts([f"sdof_k_{dof}" for dof in DOFS], fitted, units))


def rolling_response(
    settings: RollingSettings, coefficients: kinds.BearingCoefficients
) -> FrequencyResponse | None:
    """The theoretical transfer matrix of the file's shaft on the bearing; None where there is no shaft."""
    if settings.shaft is None:
        return None
    shaft = settings.shaft
    lines = np.linspace(*shaft.band, shaft.lines)
    return theoretical_response(shaft.body, coefficients.stiffness, lines, settings.damping_factor)


@dataclass(frozen=True)
class RollingOnRotor:
    """A rolling bearing on a rotor: its x and y are the rotor's y and z, its axial load and moments are those
    of its settings.
    """

    settings: RollingSettings

    def at(self, point: kinds.OperatingPoint) -> kinds.BearingCoefficients:
        """Coefficients (2, 2) in y and z [N/m, N.s/m] under a radial load; they depend neither on speed nor
        on frequency.

        Dofs that the settings do not hold (axial, tilts) follow without force: K = K_aa - K_ab K_bb^-1 K_ba.
        """
        return _rotor_coefficients(self.settings, *point.load)


@lru_cache(maxsize=128)
def _rotor_coefficients(settings: RollingSettings, load_y: float, load_z: float) -> kinds.BearingCoefficients:
    (whole,) = rolling_coefficients([replace(settings, loads=replace(settings.loads, x=load_y, y=load_z))])
    free = [number for number, dof in enumerate(DOFS) if dof not in ("x", "y", *settings.fixed_dofs)]
    k, a = whole.stiffness, list(RADIAL)
    coupling = (
        np.linalg.lstsq(k[np.ix_(free, free)], k[np.ix_(free, a)], rcond=None)[0]
        if free
        else np.zeros((0, 2))
    )
    stiffness = k[np.ix_(a, a)] - k[np.ix_(a, free)] @ coupling
    return kinds.BearingCoefficients(
        ("y", "z"), stiffness, settings.damping_factor * stiffness, findings=whole.findings
    )


def _mount(settings: RollingSettings) -> kinds.Bearing:
    for section, direction in (
        ("loads", "x"),
        ("displacements", "x"),
        ("loads", "y"),
        ("displacements", "y"),
    ):
        if getattr(getattr(settings, section), direction) is not None:
            raise kinds.entry_of_rotor_error(f"{section}.{direction}")
    if settings.shaft is not None:
        raise kinds.entry_of_rotor_error("shaft")
    return RollingOnRotor(settings)


BALL = kinds.BearingKind(
    BallBearingSettings,
    rolling_coefficients,
    bare_units={"stiffness_constant": "N/m^1.5"},
    response=rolling_response,
    mount=_mount,
)
ROLLER = kinds.BearingKind(
    RollerBearingSettings,
    rolling_coefficients,
    bare_units={"stiffness_constant": "N/m^(10/9)"},
    response=rolling_response,
    mount=_mount,
)
