"""What the tests of a rotor measured, as residuals of a model with their derivatives: free-free modes,
frequency responses, run-ups, deflections and weight.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import ClassVar, Protocol, Self

import numpy as np
from scipy import linalg

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import FitError
from labpipe.estimation.leakage import Leakage
from labpipe.methods.rotor.posterior import Residual, ResidualEvidence
from labpipe.methods.rotor_system.model import Derivatives, SystemModel
from labpipe.methods.run_ups.records import RunUp

# Lines of a response that the first steps look at, about.
FEW_LINES = 48


class SystemEvidence(ResidualEvidence[SystemModel], Protocol):
    """A test of a rotor with all that carries it: its *kind* and *name*, and its residual."""

    kind: ClassVar[str]

    @property
    def name(self) -> str: ...

    def loosen(self, model: SystemModel, values: FloatArray, share: float) -> SystemEvidence:
        """The test at *values* (n_unknown,) [SI units] with this *share* of every amplitude, measured or of
        the model, added to its noise: for the first steps from a poor start.
        """
        ...


class _RobustTest:
    def loosen(self, model: SystemModel, values: FloatArray, share: float) -> Self:  # noqa: ARG002
        """The test itself at any *values* (n_unknown,) [SI units]: it leads on from a poor start."""
        return self


@dataclass(frozen=True)
class FreeModes(_RobustTest):
    """Bending modes of the free rotor at rest, numbered from 1: ln *frequency* (n_mode,) [Hz] with their
    standard *frequency_error*, and the same of their damping ratios, NaN where one is not known.
    """

    kind: ClassVar[str] = "modes"
    name: str
    numbers: IntArray
    frequency: FloatArray
    frequency_error: FloatArray
    damping: FloatArray
    damping_error: FloatArray

    def predict(self, model: SystemModel, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """ln f and ln zeta (2 n_mode,) [1] of the plane y, and their derivatives (2 n_mode, n_unknown).

        f = |lambda| / 2 pi and zeta = -Re lambda / |lambda| of the rotor without what carries it.
        """
        plane = np.flatnonzero(np.isin(np.arange(model.n_shaft) % 4, (0, 3)))
        roots = model.roots(values, 0.0, int(self.numbers.max()), dofs=plane, supported=False)
        if roots.values.size < self.numbers.max():
            there = f"{roots.values.size} bending modes, not {self.numbers.max()}"
            raise FitError(f"test '{self.name}': the rotor has {there}", hint="other `numbers`")
        eigenvalues, slopes = roots.values[self.numbers - 1], roots.slopes[self.numbers - 1]
        size, measured = np.abs(eigenvalues), np.isfinite(self.damping)
        if np.any(eigenvalues.real[measured] >= 0):
            what = f"test '{self.name}' has the damping of free modes, the rotor file none"
            hint = "damping: {internal: 30 us +- 70 %} there; or name the `frequencies` alone"
            raise FitError(what, hint=hint)
        decay = np.where(measured, -eigenvalues.real, 1.0)
        of_size = (eigenvalues.conj()[:, None] * slopes).real / size[:, None] ** 2
        of_damping = -slopes.real / decay[:, None] - of_size
        ln = np.concatenate([np.log(size / (2 * np.pi)), np.log(decay / size)])
        return ln, np.concatenate([of_size, of_damping])

    def residual(self, model: SystemModel, values: FloatArray) -> Residual:
        """(n,) [1] and (n, n_unknown) [1 over the unknown's unit], see SystemEvidence."""
        ln, slopes = self.predict(model, values)
        measured = np.log(np.concatenate([self.frequency, self.damping]))
        error = np.concatenate([self.frequency_error, self.damping_error])
        there = np.isfinite(measured)
        return ((measured - ln) / error)[there], lambda: (-slopes / error[:, None])[there]


def out_of_order(
    free: FreeModes, supported: FreeModes, planes: int, springs: int, added: int
) -> list[tuple[int, int, bool]]:
    """What no springs to ground can do to a rotor: (number of a supported mode, number of the free bending
    mode that it lies on the wrong side of, True if it lies below that one).

    With r springs >= 0 in a plane f_j(free) <= f_j(supported) <= f_(j+r)(free), the two rigid motions
    counted; modes of *planes* planes are in one sequence, pedestals *added* so many masses to each. Beyond
    two standard uncertainties of both. Equation (system-interlacing).
    """
    wrong = []
    error, spreads = (modes.frequency * modes.frequency_error for modes in (supported, free))
    for place, (f, error_of_f) in enumerate(zip(supported.frequency, error, strict=True), 1):
        for number, bending, spread in zip(free.numbers, free.frequency, spreads, strict=True):
            rank, apart = int(number) + 2, 2 * float(np.hypot(error_of_f, spread))
            # Of so many supported modes of a plane one is at least this far up.
            if -(-place // planes) - added >= rank and f < bending - apart:
                wrong.append((place, int(number), True))
            if -(-place // planes) + springs <= rank and f > bending + apart:
                wrong.append((place, int(number), False))
    return wrong


def as_real(values: ComplexArray) -> FloatArray:
    """Real parts, then imaginary parts, of (n, ...) values [any unit]: (2 n, ...)."""
    return np.concatenate([values.real, values.imag])


def calibration_errors(
    model: SystemModel, values: FloatArray, changes: Mapping[int, ComplexArray]
) -> tuple[ComplexArray | float, dict[int, ComplexArray]]:
    """What errors of calibrations add to what was measured (n_line, ...) [its unit], and its derivative by
    each of these unknowns: *changes* by one standard uncertainty.
    """
    by_unknown = {number: change / model.errors[number] for number, change in changes.items()}
    return sum((values[n] - model.means[n]) * slope for n, slope in by_unknown.items()), by_unknown


@dataclass(frozen=True)
class Responses:
    """Receptance *measured* (n_line, n_output, n_input) [m/N] at *omega* (n_line,) [rad/s] and a *spin* speed
    [rad/s], dofs of *outputs* and *inputs*, with its standard *error* of each component, real and imaginary
    alike (n_line, n_output, n_input), NaN where a path was not measured.

    supported: on its bearings, or free. gains: numbers of the unknowns of the outputs' gains. changes: by one
    standard uncertainty of unknowns of calibrations, by their numbers. shared: lines that have the noise of
    one in common, which the *error* allows for. leakage: of random data, where it is known.
    """

    kind: ClassVar[str] = "response"
    name: str
    omega: FloatArray
    outputs: tuple[int, ...]
    inputs: tuple[int, ...]
    measured: ComplexArray
    error: FloatArray
    _: KW_ONLY
    spin: float = 0.0
    supported: bool = True
    gains: tuple[int, ...] = ()
    changes: Mapping[int, ComplexArray] = field(default_factory=dict)
    shared: float = 1.0
    leakage: Leakage | None = None

    def predict(self, model: SystemModel, values: FloatArray) -> tuple[ComplexArray, Derivatives]:
        """H (n_line, n_output, n_input) [m/N] and its derivatives (n_unknown, ...); of random data of the
        expected H1.
        """
        omega = self.omega if self.leakage is None else self.leakage.grid[0]
        forces, spin = np.eye(model.n_dof)[:, list(self.inputs)], np.full(omega.size, self.spin)
        acting = np.where(model.acting(self.name), values, 0.0)
        motion, slopes, _ = model.response(acting, spin, omega, forces, self.outputs, self.supported)
        motion = self._select_shown(motion)
        gains = np.exp(acting[list(self.gains)])[:, None] if self.gains else 1.0
        modelled = motion * gains
        added, by_unknown = calibration_errors(model, values, self.changes)

        def derivatives() -> ComplexArray:
            moved = self._select_shown(slopes()) * gains
            for output, number in enumerate(self.gains):
                moved[number, :, output] += modelled[:, output]
            for number, change in by_unknown.items():
                moved[number] += change
            return moved

        return modelled + added, derivatives

    def _select_shown(self, values: ComplexArray) -> ComplexArray:
        return values if self.leakage is None else self.leakage.average(values)

    def residual(self, model: SystemModel, values: FloatArray) -> Residual:
        """(n,) [1] and (n, n_unknown) [1 over the unknown's unit], see SystemEvidence."""
        modelled, slopes = self.predict(model, values)
        there = np.isfinite(self.error)
        weight = 1 / self.error[there]
        residual = as_real((self.measured - modelled)[there] * weight)
        return residual, lambda: as_real((-slopes()[:, there] * weight).T) * model.acting(self.name)

    def loosen(self, model: SystemModel, values: FloatArray, share: float) -> Responses:
        """At *values* (n_unknown,) [SI units], see SystemEvidence."""
        few = slice(None, None, max(1, self.omega.size // FEW_LINES))
        thinned = replace(
            self,
            omega=self.omega[few],
            measured=self.measured[few],
            error=self.error[few],
            changes={number: change[few] for number, change in self.changes.items()},
            leakage=self.leakage and replace(self.leakage, numbers=self.leakage.numbers[few]),
        )
        size = np.maximum(np.abs(thinned.measured), np.abs(thinned.predict(model, values)[0]))
        return replace(thinned, error=np.hypot(thinned.error, share * size))


@dataclass(frozen=True)
class RunUpVectors:
    """1x vectors of a run-up: *measured* (n_speed, n_probe) [m] at *speed* (n_speed,) [rad/s], probes at dofs
    *outputs*, known *added* unbalance by dof of its plane's y [kg m].

    planes: (dof of y, numbers of the unknown real and imaginary unbalance). gains, phases: numbers of the
    unknowns of every probe. changes: as of Responses, (n_speed, n_probe) [m]. whitener (n_probe, n_speed,
    n_speed): of one real component of each probe, slow roll that was subtracted in it. net: the run as it
    was read, with its baseline, and `baseline_changes` at the probes, where one was subtracted.
    """

    kind: ClassVar[str] = "run-up"
    name: str
    speed: FloatArray
    outputs: tuple[int, ...]
    measured: ComplexArray
    whitener: FloatArray
    _: KW_ONLY
    planes: tuple[tuple[int, int, int], ...]
    added: tuple[tuple[int, complex], ...] = ()
    gains: tuple[int, ...] = ()
    phases: tuple[int, ...] = ()
    changes: Mapping[int, ComplexArray] = field(default_factory=dict)
    net: tuple[RunUp, ComplexArray] | None = None

    def by_baseline(self, slopes: FloatArray) -> FloatArray:
        """J^T dr (n_speed, n_reading, n_unknown) [1 over the unknown's unit] by one standard error of each
        reading of the baseline at each speed; *slopes* J (n_equation, n_unknown) of the residual.
        """
        assert self.net is not None
        n_speed, n_probe = self.measured.shape
        change = self.net[1].reshape(-1, n_speed, n_probe)
        parts, by = np.stack([change.real, change.imag]), slopes.reshape(2, n_speed, n_probe, -1)
        of_readings = np.einsum("cipu,pij,crjp->jrpu", by, self.whitener, parts, optimize=True)
        return of_readings.reshape(n_speed, -1, by.shape[-1])

    def readings(
        self, model: SystemModel, values: FloatArray
    ) -> tuple[ComplexArray, Derivatives, ComplexArray]:
        """Vectors (n_speed, n_probe) [m], derivatives (n_unknown, n_speed, n_probe), and influence
        (n_speed, n_probe, n_plane) [m/(kg m)].

        z = e^(g + j p) S D^-1 Omega^2 (e_y - j e_z) u. Equation (system-run-up).
        """
        acting = np.where(model.acting(self.name), values, 0.0)
        firsts = [first for first, _, _ in self.planes]
        turning = np.zeros((model.n_dof, len(firsts)), np.complex128)
        turning[firsts, np.arange(len(firsts))] = 1
        turning[[first + 1 for first in firsts], np.arange(len(firsts))] = -1j
        forces = self.speed[:, None, None] ** 2 * turning
        added = np.array([sum(u for dof, u in self.added if dof == first) for first in firsts])
        unbalance = added + [acting[real] + 1j * acting[imaginary] for _, real, imaginary in self.planes]
        exciting = forces @ unbalance[:, None]
        motion, slopes, left = model.response(acting, self.speed, self.speed, exciting, self.outputs)
        gains, phases = (acting[list(numbers)] if numbers else 0.0 for numbers in (self.gains, self.phases))
        probes = np.broadcast_to(np.exp(gains + 1j * phases), len(self.outputs))
        influence = (left @ forces) * probes[:, None]
        vectors = motion[:, :, 0] * probes
        shown, by_unknown = calibration_errors(model, values, self.changes)

        def derivatives() -> ComplexArray:
            moved = slopes()[..., 0] * probes
            for plane, (_, real, imaginary) in enumerate(self.planes):
                moved[real] += influence[:, :, plane]
                moved[imaginary] += 1j * influence[:, :, plane]
            for numbers, turn in ((self.gains, 1.0), (self.phases, 1j)):
                for probe, number in enumerate(numbers):
                    moved[number, :, probe] += turn * vectors[:, probe]
            for number, change in by_unknown.items():
                moved[number] += change
            return moved * model.acting(self.name)[:, None, None]

        return vectors + shown, derivatives, influence

    def residual(self, model: SystemModel, values: FloatArray) -> Residual:
        """(n,) [1] and (n, n_unknown) [1 over the unknown's unit], see SystemEvidence."""
        vectors, slopes, _ = self.readings(model, values)
        white = np.einsum("pij,jp->ip", self.whitener, self.measured - vectors).ravel()

        def jacobian() -> FloatArray:
            moved = np.einsum("pij,ujp->uip", self.whitener, -slopes())
            return as_real(moved.reshape(len(moved), -1).T)

        return as_real(white), jacobian

    def plan(
        self, speed: FloatArray, noise: FloatArray | float, added: tuple[tuple[int, complex], ...] = ()
    ) -> RunUpVectors:
        """A run that is not made yet, at other speeds (n_speed,) [rad/s], with an *added* unbalance and the
        *noise* (n_probe,) [m] of a component.
        """
        size = np.broadcast_to(np.reshape(noise, (-1, 1)), (len(self.outputs), speed.size))
        return replace(
            self,
            speed=speed,
            measured=np.zeros((speed.size, len(self.outputs)), complex),
            whitener=run_up_whitener(size, 0.0),
            added=added,
            changes={},
            net=None,
        )

    @property
    def noise(self) -> FloatArray:
        """Standard deviation of a component of each probe and speed, (n_probe, n_speed) [m]."""
        return 1 / np.linalg.norm(self.whitener, axis=2)

    def loosen(self, model: SystemModel, values: FloatArray, share: float) -> RunUpVectors:
        """At *values* (n_unknown,) [SI units], see SystemEvidence."""
        vectors = self.readings(model, values)[0]
        error = np.hypot(self.noise, share * np.maximum(np.abs(self.measured), np.abs(vectors)).T)
        return replace(self, whitener=np.eye(self.speed.size) / error[:, :, None])


def run_up_whitener(noise: FloatArray, slow_roll: float) -> FloatArray:
    """Inverse Cholesky factors (n_probe, n_speed, n_speed) [1/m] of diag(noise^2) + slow_roll^2 1 1^T:
    standard deviations of a real component, *noise* (n_probe, n_speed) [m], and of the *slow_roll* [m] that
    was left in it, alike at all speeds.
    """
    n = noise.shape[1]
    factors = [np.linalg.cholesky(np.diag(probe**2) + slow_roll**2 * np.ones((n, n))) for probe in noise]
    return np.stack([linalg.solve_triangular(factor, np.eye(n), lower=True) for factor in factors])


@dataclass(frozen=True)
class Deflections(_RobustTest):
    """Static flexibility *measured* (n_output, n_input) [m/N] between dofs, with its standard *error*, and
    where it was weighed ln *mass* [kg] of the rotor with its error; NaN where nothing was measured.
    """

    kind: ClassVar[str] = "static"
    name: str
    outputs: tuple[int, ...]
    inputs: tuple[int, ...]
    measured: FloatArray
    error: FloatArray
    mass: float = float("nan")
    mass_error: float = 1.0

    def residual(self, model: SystemModel, values: FloatArray) -> Residual:
        """(n,) [1] and (n, n_unknown) [1 over the unknown's unit], see SystemEvidence."""
        acting = np.where(model.acting(self.name), values, 0.0)
        parts: list[tuple[FloatArray, FloatArray]] = []
        if self.measured.size:
            forces, rest = np.eye(model.n_dof)[:, list(self.inputs)], np.zeros(1)
            motion, slopes, _ = model.response(acting, rest, rest, forces, self.outputs)
            there = np.isfinite(self.measured)
            error = self.error[there]
            misfit = (self.measured - motion[0].real)[there] / error
            parts.append((misfit, -(slopes()[:, 0].real[:, there] / error).T))
        if np.isfinite(self.mass):
            rigid = np.zeros((1, model.n_dof))
            rigid[0, 0 : model.n_shaft : 4] = 1
            mass = float((rigid @ model.matrices(acting, 0.0, supported=False).mass @ rigid.T)[0, 0])
            moved = model.slopes(acting, 0.0, rigid, rigid.T, 1.0, supported=False)[:, 0, 0].real / mass
            parts.append(((self.mass - np.log([mass])) / self.mass_error, -moved[None] / self.mass_error))
        residual, jacobian = (np.concatenate(both) for both in zip(*parts, strict=True))
        return residual, lambda: jacobian * model.acting(self.name)
