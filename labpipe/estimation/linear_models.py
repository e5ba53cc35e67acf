"""Models linear in their parameters: one mass, a rotor on two axes, many degrees of freedom, a moving base.

base: a mass on a spring and a damper whose base moves, m x'' = -k (x - b) - c (x' - b'). Absolute T = X / B =
(k + j w c) / (k + j w c - w^2 m), relative T_r = (X - B) / B = T - 1 = w^2 m / (k + j w c - w^2 m) (Thomson
and Dahleh, Theory of Vibration with Applications, sec. 3.5; den Hartog, sec. 2.11). So (T - 1) / w^2 = m / (k
+ j w c - w^2 m) [s^2] is the receptance of a mass under the force m, linear in k and c, in either case.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError
from labpipe.estimation.model import DynamicModel, Setup, Term, angle_of, entry_term, fixed_matrices, labels
from labpipe.estimation.settings import FitSettings, Mass, linear_kind
from labpipe.records.response import Port
from labpipe.records.settings import ESTIMATE
from labpipe.spectra.convert import DERIVATIVES, TRANSMISSIBILITY, FormView

# Least share of a force along a direction that excites it.
SMALLEST_SHARE = 1e-3
# Responses count as perpendicular when the cosine of the angle between them is below this (0.06 deg).
PERPENDICULAR = 1e-3


def _scalar_mass(mass: Mass) -> float | None:
    if mass == ESTIMATE:
        return None
    if not isinstance(mass, (int, float)):
        raise ConfigError("this model takes one mass", hint="for example mass: 0.92 kg")
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

    Of one force, or several of unknown direction, the factors b_x, b_y are estimated, which needs the known
    mass; of several of known direction b = (cos, sin) of each is given. The responses whose dof or label is x
    and y are x and y in any order; of other names, the first is x and the second y, whose own directions
    count. ConfigError where ports, mass or directions do not fit the model.
    """
    _need_ports(setup, "rotor-2dof", 2)
    axes = axes_of(setup.outputs)
    mass = _mass_or_error(setup)
    shape = (2, len(setup.inputs))
    places = list(zip("xy", np.argsort(axes).tolist(), strict=True))
    terms = [
        entry_term(f"{letter}_{row}{column}", kind, [(r, c)], shape)
        for letter, kind in (("k", "stiffness"), ("c", "damping"))
        for row, r in places
        for column, c in places
    ]
    force: FloatArray = np.zeros(shape)
    angles = [angle_of(port) for port in setup.inputs]
    if len(angles) > 1 and None not in angles:
        force = _directions(setup.outputs, axes, [angle for angle in angles if angle is not None])
    else:
        terms.extend(_force_factors(setup.inputs, shape, axes))
    return DynamicModel("rotor-2dof", tuple(terms), fixed_matrices(mass * np.eye(2), force))


def _force_factors(inputs: tuple[Port, ...], shape: tuple[int, int], axes: list[int]) -> list[Term]:
    suffixes = [""] if len(inputs) == 1 else [f"_{port.label}" for port in inputs]
    return [
        entry_term(f"b_{'xy'[axis]}{suffix}", "force", [(axes.index(axis), column)], shape, droppable=False)
        for column, suffix in enumerate(suffixes)
        for axis in (0, 1)
    ]


def rotor_2dof_direct(setup: Setup) -> DynamicModel:
    """Direct coefficients only: one spring and damper per axis, under the force's component F cos(a) or F
    sin(a) (Lim et al. 2009, eq. 21-22). ConfigError when the force's direction is not known, or has no part
    along a response.
    """
    if len(setup.outputs) not in (1, 2):
        what = f"rotor-2dof-direct takes one or two responses, found {labels(setup.outputs)}"
        raise ConfigError(what, hint="name them with `output`")
    mass = _mass_or_error(setup)
    angles = [angle_of(port) for port in setup.inputs]
    if None in angles:
        hint = "give its dof in the rig file as x, y or an angle such as '45 deg'"
        raise ConfigError(f"the direction of the force {labels(setup.inputs)} is unknown", hint=hint)
    axes = axes_of(setup.outputs)
    force = _directions(setup.outputs, axes, [angle for angle in angles if angle is not None])
    shape = (len(axes), len(setup.inputs))
    for row, axis in enumerate(axes):
        if np.max(np.abs(force[row])) < SMALLEST_SHARE:
            hint = "choose the other `output`, or excite this direction"
            raise ConfigError(f"no force acts in direction {'xy'[axis]}", hint=hint)
    terms = [
        entry_term(f"{letter}_{'xy'[axis] * 2}", kind, [(row, row)], shape)
        for row, axis in enumerate(axes)
        for letter, kind in (("k", "stiffness"), ("c", "damping"))
    ]
    return DynamicModel("rotor-2dof-direct", tuple(terms), fixed_matrices(mass * np.eye(len(axes)), force))


def _mass_or_error(setup: Setup) -> float:
    mass = _scalar_mass(setup.settings.mass)
    if mass is None:
        hint = "for example mass: 0.92 kg, here or in the rig file"
        raise ConfigError(f"{setup.settings.model} needs the known mass", hint=hint)
    return mass


def axes_of(outputs: tuple[Port, ...]) -> list[int]:
    """0 for x, 1 for y of every response: by its dof or label; of two other names the first is x."""
    axis_of = {"x": 0, "y": 1}
    named = [axis_of.get(port.dof, axis_of.get(port.label)) for port in outputs]
    if len(outputs) == 2 and None in named:
        other = [axis for axis in named if axis is not None]
        named = [0, 1] if not other else [1 - other[0] if axis is None else axis for axis in named]
    axes = [axis for axis in named if axis is not None]
    if len(axes) < len(outputs):
        what = f"response '{labels(outputs)}' is neither x nor y"
        raise ConfigError(what, hint="give its dof in the rig file")
    if len(set(axes)) < len(axes):
        what = f"the responses {labels(outputs)} have one direction"
        raise ConfigError(what, hint="one along x and one along y are needed")
    return axes


def _directions(outputs: tuple[Port, ...], axes: list[int], angles: list[float]) -> FloatArray:
    """Share of every force along every response, cos(force - response), (n_output, n_input), of sensors
    turned by 45 deg in their own directions; rounding next to zero is zero.
    """
    pairs = zip(outputs, axes, strict=True)
    response_angles = [axis * np.pi / 2 if port.angle is None else port.angle for port, axis in pairs]
    if len(response_angles) == 2 and abs(np.cos(response_angles[0] - response_angles[1])) > PERPENDICULAR:
        what = f"the responses {labels(outputs)} are not perpendicular"
        raise ConfigError(what, hint="the model needs two directions at 90 deg")
    force = np.cos(np.subtract.outer(response_angles, angles))
    return np.where(np.abs(force) < 1e-15, 0.0, force)


def _need_ports(setup: Setup, model: str, n_output: int) -> None:
    if len(setup.outputs) != n_output:
        hint = "name it with `output`" if n_output == 1 else "name them with `output`"
        raise ConfigError(f"{model} takes {n_output} response(s), found {labels(setup.outputs)}", hint=hint)


SDOF = linear_kind(
    sdof,
    "peaks",
    "damping",
    "residuals",
    by_likelihood=("residuals",),
    one_frf=True,
    one_mode=True,
    own_damping=True,
    one_direction=True,
    frees_mass=True,
)
ROTOR_2DOF = linear_kind(rotor_2dof, "tied", "damping", simpler="rotor-2dof-direct")
ROTOR_2DOF_DIRECT = linear_kind(rotor_2dof_direct, "tied", one_direction=True, richer="rotor-2dof")

MASS_SCALE = "mass_scale"


def mdof(setup: Setup) -> DynamicModel:
    """Stiffness k_i_j, damping c_i_j and, if unknown, mass m_i_j between the dofs i, j of the outputs.

    (K + j w C - w^2 M) H = B, for which one force is sufficient: every row has its own coefficients (Knaapen
    1997, ch. 4). *symmetric* settings give k_i_j = k_j_i. The mass is a list (diagonal), a matrix,
    `estimate`, or, with `scale_mass`, known up to a factor. ConfigError for a force on a dof without output,
    or a mass of the wrong size.
    """
    settings = setup.settings
    dofs = [port.dof or port.label for port in setup.outputs]
    if len(set(dofs)) < len(dofs):
        what = f"two of the responses {labels(setup.outputs)} have one dof"
        raise ConfigError(what, hint="choose with `output`")
    force = np.column_stack([force_direction(port, dofs, setup) for port in setup.inputs])
    shape, symmetric = setup.shape, settings.symmetric
    kinds = (("k", "stiffness"), ("c", "damping"))
    terms = [term for pair in kinds for term in _entries(*pair, dofs, shape, symmetric)]
    mass = _fixed_mass(settings.mass, len(dofs))
    if mass is None:
        _check_scale(force, dofs, settings)
        of_mass = _entries("m", "mass", dofs, shape, symmetric, droppable=False)
        terms += [t for t in of_mass if not settings.lumped_mass or np.any(np.diag(t.matrices.mass))]
        mass = np.zeros((len(dofs), len(dofs)))
    elif settings.scale_mass:
        term = entry_term(MASS_SCALE, "mass", [], shape, droppable=False)
        terms.append(replace(term, unit="1", matrices=replace(term.matrices, mass=mass)))
        mass = np.zeros_like(mass)
    return DynamicModel("mdof", tuple(terms), fixed_matrices(mass, force))


def _check_scale(force: FloatArray, dofs: list[str], settings: FitSettings) -> None:
    """ConfigError where rows of K, C and M without a force can be added to any row, times any factor."""
    unforced = [dof for dof, forces in zip(dofs, force, strict=True) if not np.any(forces)]
    if unforced and not (settings.symmetric or settings.tied or settings.fixed):
        what = f"without a mass, and without a force on {', '.join(unforced)}, the coefficients have no scale"
        raise ConfigError(what, hint="mass: [1 kg, ...], symmetric: true, or a force at every response")


def _entries(
    letter: str, kind: str, dofs: list[str], shape: tuple[int, int], symmetric: bool, droppable: bool = True
) -> list[Term]:
    terms = []
    for r in range(len(dofs)):
        for c in range(r if symmetric else 0, len(dofs)):
            places = [(r, c), (c, r)] if symmetric else [(r, c)]
            terms.append(entry_term(f"{letter}_{dofs[r]}_{dofs[c]}", kind, places, shape, droppable))
    return terms


def _fixed_mass(mass: Mass, n_dof: int) -> FloatArray | None:
    if mass == ESTIMATE:
        return None
    try:
        entries = np.array(mass, dtype=float)
    except ValueError:
        # Rows of several lengths.
        entries = np.empty(0)
    if entries.ndim == 0:
        return float(entries) * np.eye(n_dof)
    if entries.shape == (n_dof,):
        entries = np.diag(entries)
    if entries.shape != (n_dof, n_dof):
        hint = f"a list of {n_dof} masses, a {n_dof} x {n_dof} matrix, or `estimate`"
        raise ConfigError(f"the mass does not fit {n_dof} responses", hint=hint)
    if not np.allclose(entries, entries.T, rtol=1e-9, atol=0) or np.linalg.eigvalsh(entries)[0] < 0:
        raise ConfigError("the mass matrix is not symmetric with positive kinetic energy")
    return entries


def force_direction(port: Port, dofs: list[str], setup: Setup) -> FloatArray:
    """Distribution of a force (n_dof,) [1]: on the output of its dof, or by its angle on x and y."""
    angle = angle_of(port)
    angles = np.array([angle_of(output) for output in setup.outputs], dtype=float)
    there = np.array([output.place == port.place for output in setup.outputs])
    if port.dof in dofs:
        number = dofs.index(port.dof)
        # An error of its direction lets it act on the other outputs there too.
        turn = 0.0 if angle is None else np.cos(angle - angles) - np.cos(angles[number] - angles)
        return np.eye(len(dofs))[number] + np.nan_to_num(turn) * there
    if angle is None or np.any(np.isnan(angles)) or not np.any(there):
        hint = f"known dofs: {', '.join(dofs)}; measure there as well, or name forces with `input`"
        what = f"the force {port.label} acts on dof '{port.dof}', which has no response"
        raise ConfigError(what, hint=hint)
    shares = np.cos(angle - angles) * there
    return np.where(np.abs(shares) < 1e-15, 0.0, shares)


MDOF = linear_kind(
    mdof, "tied", "damping", "symmetric", "lumped_mass", "scale_mass", matrix_modes=True, frees_mass=True
)

BASE = "base"
# Coefficients of a mass that is not given, and their units.
PER_MASS = {"k": ("stiffness_per_mass", "1/s^2"), "c": ("damping_per_mass", "1/s")}


def stiffness_and_damping(names: Collection[str]) -> tuple[str, str]:
    """Which of the *names* are k and c, or k / m and c / m; "" for none."""
    k, c = (next((name for name in (key, PER_MASS[key][0]) if name in names), "") for key in "kc")
    return k, c


def form_view(form: str, settings: FitSettings) -> FormView:
    """The view of a model on a response of that *form*. ConfigError for a base without its motion, and for a
    transmissibility elsewhere.
    """
    if settings.kind.of_base and form != TRANSMISSIBILITY:
        other = f"and a motion as output; this FRF is of the form '{form}'"
        what = "this FRF is of a force" if form in DERIVATIVES else other
        hint = "in the rig file: role: input for the acceleration (velocity, displacement) of the base"
        what = f"model {BASE} needs the motion of the base as input, {what}"
        raise ConfigError(what, hint=f"{hint}; or model: sdof")
    if not settings.kind.of_base and form == TRANSMISSIBILITY:
        what = f"model {settings.model} needs a force as input, this FRF is of the motion of a base"
        raise ConfigError(what, hint=f"model: {BASE}")
    if form == TRANSMISSIBILITY:
        return FormView(form, 0.0 if settings.relative else 1.0)
    return FormView(form)


def base_excited_model(setup: Setup) -> DynamicModel:
    """(k + j w c - w^2 m) (T - 1) / w^2 = m; without a mass k / m and c / m, since a transmissibility knows
    no more. ConfigError for several responses or bases, or for a mass that is none. Equation (frf-base).
    """
    if setup.shape != (1, 1):
        ports = f"{labels(setup.outputs)} and {labels(setup.inputs)}"
        what = f"{BASE} takes one response and one base, found {ports}"
        raise ConfigError(what, hint="name them with `output` and `input`")
    given = setup.settings.mass
    if given != ESTIMATE and not (isinstance(given, float | int) and given > 0):
        hint = "for example mass: 0.92 kg; without it f_n and zeta are identified"
        raise ConfigError(f"{BASE} takes one positive mass", hint=hint)
    unit = np.ones((1, 1))
    terms = [entry_term(*pair, [(0, 0)], unit.shape) for pair in (("k", "stiffness"), ("c", "damping"))]
    if isinstance(given, float | int):
        return DynamicModel(BASE, tuple(terms), fixed_matrices(float(given) * unit, float(given) * unit))
    names = [PER_MASS[term.name] for term in terms]
    per_mass = (replace(term, name=n, unit=u) for term, (n, u) in zip(terms, names, strict=True))
    return DynamicModel(BASE, tuple(per_mass), fixed_matrices(unit, unit))


BASE_EXCITED = linear_kind(base_excited_model, "relative", one_mode=True, of_base=True)
