"""Models with expected coefficients, and what a force spectrum tells about them: Fisher information.

Residual e = F - M_s A - D(theta) X. Noise densities S_F, S_X, S_A (one-sided) give its density Lambda =
(S_F^2 + M_s^2 S_A^2) I + S_X^2 D D^H, and T seconds with the mean-square force spectrum Phi = F F^H / 2 and X
= H F tell I_ij = 2 T sum_l Re tr[(E_i H)^H Lambda^-1 (E_j H) Phi_l]. That is the information of errors in
variables with a deterministic input (Pintelon and Schoukens 2012, System Identification, sec. 9.10), linear
in the spectrum and in time.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, SettingError
from labpipe.estimation.model import DynamicModel, Setup
from labpipe.estimation.settings import MODELS, FitSettings, model_kind
from labpipe.records.response import Port
from labpipe.records.rig import AXIS_ANGLES
from labpipe.records.settings import ESTIMATE
from labpipe.spectra.settings import SPECTRA

AXES = ("x", "y")
# Of a stator against its shaft.
FLOATING = "dynamic-stiffness"
UNITS = {"k": "N/m", "c": "N.s/m", "m": "kg"}
# A coefficient expected to be zero, or nearly so, is compared with this share of the largest of its kind.
LEAST_SHARE = 0.01


@dataclass(frozen=True)
class PlannedModel:
    """A model linear in its coefficients, with the values *expected* (n_coefficient,) [N/m, N.s/m, kg] of
    those in *names*, in *units*.

    elements (n_coefficient, 3, n_dof, n_dof) [1]: places of each coefficient in K, C and M, complex of a
    structural damping; given (3, n_dof, n_dof) [N/m, N.s/m, kg]: the rest of D; stator_mass [kg]: M_s of the
    balance, zero where no acceleration is measured.
    """

    kind: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    expected: FloatArray
    elements: FloatArray
    given: FloatArray
    stator_mass: float = 0.0

    @property
    def n_dof(self) -> int:
        return self.given.shape[-1]

    @property
    def by_spectra(self) -> bool:
        """Whether fits of the spectra of all channels have these coefficients: shakers may run at once."""
        return self.names == matrix_names("kcm" if UNITS["m"] in self.units else "kc")

    @property
    def scales(self) -> FloatArray:
        """What relative errors refer to, (n_coefficient,) [N/m, N.s/m, kg]: the expected size, at least 1 %
        of the largest of its kind.
        """
        sizes = np.abs(self.expected)
        units = np.array(self.units)
        largest = np.array([sizes[units == unit].max() for unit in units])
        return np.maximum(sizes, LEAST_SHARE * np.where(largest > 0, largest, 1.0))

    def elements_at(self, omega: FloatArray) -> ComplexArray:
        """E_i(jw) (n_line, n_coefficient, n_dof, n_dof) [N/m per coefficient] at omega (n_line,) [rad/s]."""
        return np.einsum("lk,nkij->lnij", _powers(omega), self.elements)

    def stiffness(self, omega: FloatArray) -> ComplexArray:
        """D(jw) = K + jwC - w^2 M, (n_line, n_dof, n_dof) [N/m], at omega (n_line,) [rad/s]."""
        whole = self.given + np.einsum("n,nkij->kij", self.expected, self.elements)
        return np.einsum("lk,kij->lij", _powers(omega), whole)

    def receptance(self, omega: FloatArray) -> ComplexArray:
        """X = (D - w^2 M_s)^-1 F, (n_line, n_dof, n_dof) [m/N], at omega (n_line,) [rad/s]. The rotor of a
        floating rig held still.
        """
        inertia = omega[:, None, None] ** 2 * self.stator_mass * np.eye(self.n_dof)
        return np.linalg.inv(self.stiffness(omega) - inertia)

    @property
    def free_motion(self) -> FloatArray | None:
        """A of z' = A z, z = (X, X'), (2 n_dof, 2 n_dof) [1/s, 1/s^2], free; None where it does not decay."""
        stiffness, damping, mass = self.given + np.einsum("n,nkij->kij", self.expected, self.elements)
        mass = mass + self.stator_mass * np.eye(self.n_dof)
        if np.any(np.linalg.eigvals(mass).real <= 0):
            return None
        inverse, none = np.linalg.inv(mass), np.zeros_like(mass)
        free = np.block([[none, np.eye(self.n_dof)], [-inverse @ stiffness, -inverse @ damping]])
        if np.iscomplexobj(free):
            # A complex stiffness is that of positive frequencies: its modes, and their conjugates.
            poles, states = np.linalg.eig(free)
            poles, states = poles[poles.imag > 0], states[:, poles.imag > 0]
            if poles.size != self.n_dof:
                return None
            both = np.hstack([states, states.conj()])
            free = (both * np.concatenate([poles, poles.conj()]) @ np.linalg.inv(both)).real
        return free if np.all(np.linalg.eigvals(free).real < 0) else None

    def with_known_mass(self) -> PlannedModel:
        """The model with all masses given at their expected values."""
        kept = np.array([unit != UNITS["m"] for unit in self.units])
        given = self.given + np.einsum("n,nkij->kij", self.expected[~kept], self.elements[~kept])
        names, units = (tuple(compress(of_all, kept)) for of_all in (self.names, self.units))
        parts = {"expected": self.expected[kept], "elements": self.elements[kept], "given": given}
        return replace(self, names=names, units=units, **parts)

    def with_values(self, values: FloatArray) -> PlannedModel:
        """The model with other expected values (n_coefficient,) [N/m, N.s/m, kg]."""
        return replace(self, expected=np.asarray(values, float))


def _powers(omega: FloatArray) -> ComplexArray:
    """1, jw, -w^2 of every line, (n_line, 3)."""
    return np.stack([np.ones_like(omega), 1j * omega, -(omega**2)], axis=-1)


def excitable_models() -> tuple[str, ...]:
    """The models that forces of a plan identify: those linear in their coefficients, of plug-ins as well."""
    kinds = {name: model_kind(name) for name in MODELS}
    return tuple(name for name, kind in kinds.items() if kind.equations is not None and not kind.of_base)


def is_floating(name: str) -> bool:
    """Whether a model balances the forces of all channels, as of a stator against its shaft."""
    return model_kind(name).of == SPECTRA


def axes_of_model(name: str, expected: Collection[str], n_shaker: int = 1) -> tuple[str, ...]:
    """The directions of a model: x alone, or x and y where it takes no single one, several shakers run, or
    coefficients are *expected* that one direction does not have.
    """
    if is_floating(name):
        return AXES
    by_axes = {}
    for axes in (AXES[:1], AXES):
        try:
            by_axes[axes] = set(_equations(name, 1.0, axes).names)
        except ConfigError:
            continue
    # A mass that is not given is a coefficient as well.
    wanted = set(expected) - {"m"}
    able = [axes for axes, names in by_axes.items() if len(axes) >= n_shaker and wanted <= names]
    return next(iter((*able, *by_axes)), AXES)


def planned_model(
    name: str, expected: Mapping[str, float], mass: float | None = None, axes: Sequence[str] = ()
) -> PlannedModel:
    """A model of fits with its *expected* coefficients [N/m, N.s/m, kg] and *mass* [kg], estimated where the
    model allows it. *axes*: its directions, by default those of `axes_of_model`. ConfigError for other names,
    without a mass that is needed, and where the forces of the model have factors of their own.
    """
    if is_floating(name):
        return _floating(name, expected, mass)
    axes = axes or axes_of_model(name, expected)
    try:
        model = _equations(name, mass, axes)
    except ConfigError as error:
        field, hint = ("mass", "for example mass: 0.92 kg") if mass is None else ("model", error.hint)
        raise SettingError(field, error.what, hint) from None
    parts = [term.matrices for term in model.terms]
    if any(np.any(part.force) for part in parts) or not np.allclose(model.constant.force, np.eye(len(axes))):
        what = f"model {name} has forces with factors of their own, which no plan knows"
        raise SettingError("model", what, f"known: {', '.join(excitable_models())}")
    elements, given = (
        np.array([[part.stiffness, part.damping, part.mass] for part in group])
        for group in (parts, [model.constant])
    )
    return PlannedModel(name, model.names, model.units, _values(expected, model.names), elements, given[0])


def _equations(name: str, mass: float | None, axes: Sequence[str]) -> DynamicModel:
    """The equations of a model linear in its coefficients, under one force along each axis."""
    ports = tuple(Port(axis, axis, axis, AXIS_ANGLES[axis]) for axis in axes)
    settings = FitSettings(name, mass=ESTIMATE if mass is None else mass)
    return model_kind(name).model(Setup(ports, ports, settings))


def _floating(name: str, expected: Mapping[str, float], mass: float | None) -> PlannedModel:
    """A floating stator of *mass* M_s [kg], F - M_s A = (K + jwC - w^2 M) X: eight coefficients, or twelve
    where masses are expected. ConfigError without the stator's mass, or for unknown coefficients.
    """
    if mass is None:
        what = f"model {name} needs the mass of the stator"
        raise SettingError("mass", what, "for example mass: 60 kg")
    letters = "kcm" if any(coefficient.startswith("m") for coefficient in expected) else "kc"
    names = matrix_names(letters)
    elements = np.eye(len(names), 12).reshape(-1, 3, 2, 2)
    units = tuple(UNITS[coefficient[0]] for coefficient in names)
    return PlannedModel(name, names, units, _values(expected, names), elements, np.zeros((3, 2, 2)), mass)


def matrix_names(letters: str) -> tuple[str, ...]:
    """Names of all coefficients of two-by-two matrices: k_xx, k_xy ... for the letters k, c, m."""
    return tuple(f"{letter}_{row}{column}" for letter in letters for row in AXES for column in AXES)


def _values(expected: Mapping[str, float], names: tuple[str, ...]) -> FloatArray:
    missing = [name for name in names if name not in expected]
    if missing:
        hint = "expected: {NAME: VALUE} of every coefficient"
        raise SettingError("expected", f"no value is expected for {', '.join(missing)}", hint)
    unknown = [name for name in expected if name not in names]
    if unknown:
        hint = "leave `mass` out to estimate m" if unknown == ["m"] else f"known: {', '.join(names)}"
        raise SettingError("expected", f"the model has no coefficient {', '.join(unknown)}", hint)
    return np.array([expected[name] for name in names])


@dataclass(frozen=True)
class SensorDensities:
    """One-sided densities of the sensors' white noise: force [N/sqrt(Hz)], displacement [m/sqrt(Hz)],
    acceleration [m/(s^2.sqrt(Hz))]. one_force: only the force that acts is recorded.
    """

    force: float = 0.0
    displacement: float = 0.0
    acceleration: float = 0.0
    one_force: bool = False

    def __post_init__(self) -> None:
        if min(self.force, self.displacement, self.acceleration) < 0:
            raise SettingError("noise", "a noise is negative")
        if max(self.force, self.displacement) == 0:
            what = "no sensor has noise, any excitation would do"
            raise SettingError("noise", what, "state the noise of force and displacement")

    @classmethod
    def of_samples(
        cls, force: float, displacement: float, acceleration: float, sample_rate: float
    ) -> SensorDensities:
        """From standard deviations per sample [N, m, m/s^2], S = s sqrt(2 / f_s). Equation (plan-noise)."""
        factor = float(np.sqrt(2 / sample_rate))
        return cls(force * factor, displacement * factor, acceleration * factor)


def sensitivities(
    model: PlannedModel, noise: SensorDensities, omega: FloatArray, forces: ComplexArray | None = None
) -> ComplexArray:
    """L^-1 E_i H theta_i with L L^H = Lambda, (n_line, n_coefficient, n_dof, n_dof) [1/N.sqrt(Hz)], at omega
    (n_line,) [rad/s]; *forces* as of `residual_whitener`.

    A relative change of coefficient i changes the residual of a force u by that times u, in units of the
    residual's noise. Equation (plan-sensitivity).
    """
    changed = model.elements_at(omega) @ model.receptance(omega)[:, None] * model.scales[:, None, None]
    return residual_whitener(model, noise, omega, forces)[:, None] @ changed


def residual_whitener(
    model: PlannedModel, noise: SensorDensities, omega: FloatArray, forces: ComplexArray | None
) -> ComplexArray:
    """L^-1 of the noise density Lambda = L L^H, (n_line, n_dof, n_dof) [sqrt(Hz)/N], at omega [rad/s]. Where
    one force alone is recorded, its noise is along *forces* (n_line, n_dof) [N], unless all other is zero.
    """
    stiffness, unit = model.stiffness(omega), np.eye(model.n_dof)
    recorded = unit
    if noise.one_force and forces is not None and noise.displacement > 0:
        along = forces / np.linalg.norm(forces, axis=1, keepdims=True)
        recorded = along[:, :, None] * along[:, None].conj()
    moved = noise.displacement**2 * stiffness @ stiffness.conj().swapaxes(-1, -2)
    plain = noise.force**2 * recorded + (model.stator_mass * noise.acceleration) ** 2 * unit
    density = plain + moved
    return np.linalg.inv(np.linalg.cholesky(density))


def vector_information(sensitivity: ComplexArray, forces: ComplexArray) -> FloatArray:
    """Information per second of force amplitudes *forces* (n_line, n_dof) [N], (n_line, n_coefficient,
    n_coefficient) [1/s].

    sensitivity (n_line, n_coefficient, n_dof, n_dof) [1/N.sqrt(Hz)]; of relative coefficients. Equation
    (plan-vector).
    """
    change = np.einsum("lnij,lj->lni", sensitivity, forces)
    return np.einsum("lni,lmi->lnm", change.conj(), change).real


def relative_errors(information: FloatArray) -> FloatArray:
    """Smallest standard errors sqrt((I^-1)_ii) (n_coefficient,) [1]; infinite where the information (n, n)
    [1] is singular.

    A coefficient without information, or a condition beyond 1e13, is not determined. Equation (plan-errors).
    """
    diagonal = np.diagonal(information)
    if np.any(diagonal <= 0):
        return np.full(diagonal.size, np.inf)
    root = np.sqrt(diagonal)
    scaled = information / np.outer(root, root)
    values, vectors = np.linalg.eigh(scaled)
    if values[0] < 1e-13 * values[-1]:
        return np.full(diagonal.size, np.inf)
    return np.sqrt(np.sum(vectors**2 / values, axis=1)) / root
