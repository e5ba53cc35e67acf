"""Limits of the rolling-bearing model: loads that a bearing cannot carry, and their error messages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.bearings.rolling import DOFS, Contacts, RollingBearing
from labpipe.errors import ConfigError, FitError
from labpipe.registry import nearest

LOADS = ("x", "y", "z", "mx", "my")
UNITS = ("N", "N", "N", "N m", "N m")


def check_request(
    bearing: RollingBearing, loads: FloatArray, displacements: FloatArray, fixed_dofs: Sequence[str], cage_angle: FloatArray
) -> None:
    """ConfigError for an ill-posed request: wrong shapes, missing numbers, dofs without support by rollers.

    loads (n_case, 5) [N, N m], displacements (n_case, 5) [m, rad], cage_angle scalar or (n_case,) [rad].
    """
    for name in fixed_dofs:
        if name not in DOFS:
            raise ConfigError(f"no displacement '{name}'", hint=nearest(name, DOFS))
    if loads.shape[-1] != len(DOFS) or displacements.shape[-1] != len(DOFS):
        raise ConfigError(f"a load case has {len(DOFS)} loads and displacements, found {loads.shape[-1]} and {displacements.shape[-1]}")
    sizes = {len(loads), len(displacements), cage_angle.size}
    if cage_angle.ndim > 1 or len(sizes - {1}) > 1:
        numbers = f"{len(loads)} load cases, {len(displacements)} of displacements and {cage_angle.size} cage angles"
        raise ConfigError(f"{numbers} do not go together", hint="one, or as many as load cases")
    for what, values in (("load", loads), ("displacement", displacements), ("cage angle", cage_angle)):
        if not np.all(np.isfinite(values)):
            raise ConfigError(f"a {what} is not a finite number")
    if not bearing.is_ball:
        _check_rollers(bearing, loads, fixed_dofs)


def _check_rollers(bearing: RollingBearing, loads: FloatArray, fixed_dofs: Sequence[str]) -> None:
    """Rollers at a fixed contact angle resist three motions (two at 0 deg): the other dofs must be fixed."""
    loose = [name for name in ("bx", "by") if name not in fixed_dofs]
    if loose:
        raise ConfigError(
            f"rollers at a fixed contact angle leave the tilt {loose[0]} without support", hint=f"hold it: displacements.{loose[0]}"
        )
    if bearing.contact_angle == 0 and "z" not in fixed_dofs:
        if np.any(loads[:, 2] != 0):
            raise ConfigError("rollers at contact angle 0 carry no axial load", hint="remove loads.z, or give a contact angle")
        raise ConfigError("rollers at contact angle 0 leave z without support", hint="hold it: displacements.z")


def check_carried(bearing: RollingBearing, at: Contacts) -> None:
    """FitError where the deflection exceeds the range of Hertzian contact, or the contact angle exceeds 90 deg."""
    beyond = at.deflection > bearing.reach
    if np.any(beyond):
        case, element = (int(n) for n in np.argwhere(beyond)[0])
        raise FitError(
            f"{_case(case, len(beyond))}element {element + 1} is pressed in by {1e6 * at.deflection[case, element]:.4g} um",
            hint=f"the model holds up to {1e6 * bearing.reach:.4g} um: check loads and displacements",
        )
    inside = (at.deflection > 0) & (at.cos < 0)
    if np.any(inside):
        case, element = (int(n) for n in np.argwhere(inside)[0])
        raise FitError(
            f"{_case(case, len(inside))}element {element + 1} carries at a contact angle beyond 90 deg: the rings have come apart",
            hint="the bearing cannot carry this load",
        )


def explain_failure(bearing: RollingBearing, loads: FloatArray, case: int) -> None:
    """Raise the FitError of a load case without equilibrium; *loads* (n_case, 5) [N, N m]."""
    acting = ", ".join(f"{name} {amount:.4g} {unit}" for name, amount, unit in zip(LOADS, loads[case], UNITS, strict=True) if amount)
    hint = "the load does not press the elements onto their tracks" if not bearing.is_ball else "check the size of the loads"
    raise FitError(f"{_case(case, len(loads))}no rest position: the bearing cannot carry {acting or 'no load'}", hint=hint)


def _case(case: int, n_case: int) -> str:
    return f"load case {case + 1}: " if n_case > 1 else ""
