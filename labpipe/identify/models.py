"""Models of few degrees of freedom: which coefficients act between which of them. settings.MODELS is the table."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError
from labpipe.identify.model import DynamicModel, Term
from labpipe.identify.model_kinds import linear_kind
from labpipe.identify.settings import ESTIMATE, Mass
from labpipe.identify.setup import Setup, angle_of, entry_term, fixed_matrices, labels
from labpipe.records.response import Port
from labpipe.records.rig import AXIS_ANGLES

# Least share of a force along a direction that excites it.
SMALLEST_SHARE = 1e-3
# Responses count as perpendicular when the cosine of the angle between them is below this (0.06 deg).
PERPENDICULAR = 1e-3


def _scalar_mass(mass: Mass) -> float | None:
    """The mass [kg], or None when it is to be estimated."""
    if mass == ESTIMATE:
        return None
    if not isinstance(mass, (int, float)):
        raise ConfigError("this model takes one mass", hint="for example mass: 0.92 kg")
    if not mass >= 0:
        raise ConfigError(f"the mass is {mass:g} kg", hint="it must not be negative")
    return float(mass)


def sdof(setup: Setup) -> DynamicModel:
    """(k + j w c - w^2 m) Y = F: one mass on a spring and a damper (Lim et al. 2009, eq. 8-13)."""
    _need_ports(setup, "sdof", 1)
    if len(setup.inputs) != 1:
        raise ConfigError(f"sdof takes one force, found {labels(setup.inputs)}", hint="name it with `input`")
    mass = _scalar_mass(setup.settings.mass)
    shape = (1, 1)
    terms = [entry_term("k", "stiffness", [(0, 0)], shape), entry_term("c", "damping", [(0, 0)], shape)]
    if mass is None:
        terms.append(entry_term("m", "mass", [(0, 0)], shape, droppable=False))
    return DynamicModel("sdof", tuple(terms), fixed_matrices(np.array([[mass or 0.0]]), np.ones(shape)))


def rotor_2dof(setup: Setup) -> DynamicModel:
    """Eight coefficients of a rotor in its bearings, x and y coupled (Lim et al. 2009, eq. 16-20).

    One force: its factors b_x, b_y are estimated with the coefficients, which needs the known mass. Several forces of known
    direction: b = (cos, sin) of each is given; of unknown direction: b_x, b_y of each are estimated. The responses whose dof or
    label is x and y are x and y in whatever order they come; of other names, the first is x and the second y, and the directions
    of the forces are taken from the responses' own. ConfigError where ports, mass or directions do not fit the model.
    """
    _need_ports(setup, "rotor-2dof", 2)
    axes = _axes(setup.outputs)
    mass = _mass_or_error(setup)
    shape = (2, len(setup.inputs))
    terms = [
        entry_term(f"{letter}_{row}{column}", kind, [(r, c)], shape)
        for letter, kind in (("k", "stiffness"), ("c", "damping"))
        for row, r in sorted(zip("xy", np.argsort(axes).tolist(), strict=True))
        for column, c in sorted(zip("xy", np.argsort(axes).tolist(), strict=True))
    ]
    force: FloatArray = np.zeros(shape)
    angles = [angle_of(port) for port in setup.inputs]
    if len(angles) > 1 and None not in angles:
        force = _directions(setup.outputs, axes, [angle for angle in angles if angle is not None])
    else:
        terms.extend(_force_factors(setup.inputs, shape, axes))
    return DynamicModel("rotor-2dof", tuple(terms), fixed_matrices(mass * np.eye(2), force))


def _force_factors(inputs: tuple[Port, ...], shape: tuple[int, int], axes: list[int]) -> list[Term]:
    """b_x, b_y of every force; with the force's label where there are several."""
    suffixes = [""] if len(inputs) == 1 else [f"_{port.label}" for port in inputs]
    return [
        entry_term(f"b_{'xy'[axis]}{suffix}", "force", [(axes.index(axis), column)], shape, droppable=False)
        for column, suffix in enumerate(suffixes)
        for axis in (0, 1)
    ]


def rotor_2dof_direct(setup: Setup) -> DynamicModel:
    """Direct coefficients only: one spring and damper per axis, under the force's component (Lim et al. 2009, eq. 21-22).

    F_x = F cos(a), F_y = F sin(a). ConfigError when the force's direction is not known, or has no part along a response.
    """
    if len(setup.outputs) not in (1, 2):
        raise ConfigError(f"rotor-2dof-direct takes one or two responses, found {labels(setup.outputs)}", hint="name them with `output`")
    mass = _mass_or_error(setup)
    angles = [angle_of(port) for port in setup.inputs]
    if None in angles:
        hint = "give its dof in the rig file as x, y or an angle such as '45 deg'"
        raise ConfigError(f"the direction of the force {labels(setup.inputs)} is unknown", hint=hint)
    axes = _axes(setup.outputs)
    force = _directions(setup.outputs, axes, [angle for angle in angles if angle is not None])
    shape = (len(axes), len(setup.inputs))
    for row, axis in enumerate(axes):
        if np.max(np.abs(force[row])) < SMALLEST_SHARE:
            raise ConfigError(f"no force acts in direction {'xy'[axis]}", hint="choose the other `output`, or excite this direction")
    terms = [
        entry_term(f"{letter}_{'xy'[axis] * 2}", kind, [(row, row)], shape)
        for row, axis in enumerate(axes)
        for letter, kind in (("k", "stiffness"), ("c", "damping"))
    ]
    return DynamicModel("rotor-2dof-direct", tuple(terms), fixed_matrices(mass * np.eye(len(axes)), force))


def _mass_or_error(setup: Setup) -> float:
    mass = _scalar_mass(setup.settings.mass)
    if mass is None:
        raise ConfigError(f"{setup.settings.model} needs the known mass", hint="for example mass: 0.92 kg, here or in the rig file")
    return mass


def _axes(outputs: tuple[Port, ...]) -> list[int]:
    """0 for x, 1 for y of every response: by its dof or label; of two responses with other names the first is x."""
    named = [next(("xy".index(name) for name in (port.dof, port.label) if name in AXIS_ANGLES), None) for port in outputs]
    if len(outputs) == 2 and None in named:
        other = [axis for axis in named if axis is not None]
        named = [0, 1] if not other else [1 - other[0] if axis is None else axis for axis in named]
    axes = [axis for axis in named if axis is not None]
    if len(axes) < len(outputs):
        raise ConfigError(f"response '{labels(outputs)}' is neither x nor y", hint="give its dof in the rig file")
    if len(set(axes)) < len(axes):
        raise ConfigError(f"the responses {labels(outputs)} have one direction", hint="one along x and one along y are needed")
    return axes


def _directions(outputs: tuple[Port, ...], axes: list[int], angles: list[float]) -> FloatArray:
    """Share of every force along every response, cos(force - response), (n_output, n_input); rounding next to zero is zero.

    Responses along x and y have (cos, sin) of the force's angle; sensors turned by 45 deg see it in their own directions.
    """
    response_angles = [port.angle if port.angle is not None else axis * np.pi / 2 for port, axis in zip(outputs, axes, strict=True)]
    if len(response_angles) == 2 and abs(np.cos(response_angles[0] - response_angles[1])) > PERPENDICULAR:
        raise ConfigError(f"the responses {labels(outputs)} are not perpendicular", hint="the model needs two directions at 90 deg")
    force = np.cos(np.subtract.outer(response_angles, angles))
    return np.where(np.abs(force) < 1e-15, 0.0, force)


def _need_ports(setup: Setup, model: str, n_output: int) -> None:
    if len(setup.outputs) != n_output:
        hint = "name it with `output`" if n_output == 1 else "name them with `output`"
        raise ConfigError(f"{model} takes {n_output} response(s), found {labels(setup.outputs)}", hint=hint)


SDOF = linear_kind(sdof, "peaks", one_frf=True, one_mode=True, one_direction=True, frees_mass=True)
ROTOR_2DOF = linear_kind(rotor_2dof, "tied", "damping", simpler="rotor-2dof-direct")
ROTOR_2DOF_DIRECT = linear_kind(rotor_2dof_direct, "tied", one_direction=True, richer="rotor-2dof")
