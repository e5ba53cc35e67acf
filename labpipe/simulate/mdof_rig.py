"""A virtual rig of masses, springs and dampers whose FRF is given directly, with noise of known size on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.records.response import FrequencyResponse, Port, uncorrelated
from labpipe.records.settings import Settings, setting
from labpipe.simulate.virtual_rigs import Simulation, VirtualRigKind

KIND = "virtual-mdof-rig"


@dataclass(frozen=True)
class Lines(Settings):
    """Equally spaced frequency lines."""

    first: float = setting("value", "lowest frequency", unit="Hz")
    last: float = setting("value", "highest frequency", unit="Hz")
    count: int = setting("integer", "number of lines")


@dataclass(frozen=True)
class VirtualMdofRig(Settings):
    """M q'' + C q' + K q = f on dofs 1, 2, ..., a force and a response on each."""

    kind: str = setting("choice", "which virtual rig", choices=(KIND,))
    stiffness: tuple[tuple[float, ...], ...] = setting("matrix", "stiffness matrix K", unit="N/m")
    damping: tuple[tuple[float, ...], ...] = setting("matrix", "damping matrix C", unit="N.s/m")
    mass: tuple[float, ...] | tuple[tuple[float, ...], ...] = setting("mass", "masses, or the mass matrix M", unit="kg")
    lines: Lines = setting("section", "frequency lines of the FRF", section=Lines)
    noise: float = setting("value", "standard deviation on the real and on the imaginary part, as a share of the largest |H|", unit="1")
    name: str = setting("text", "name of the rig", default="Virtual rig of masses, springs and dampers")

    def __post_init__(self) -> None:
        n = len(self.stiffness)
        for name in ("stiffness", "damping"):
            if np.shape(getattr(self, name)) != (n, n):
                raise ConfigError(f"{name} is not a {n} x {n} matrix")
        # A list of masses, or of rows; both, or rows of other lengths, have no shape.
        if not isinstance(self.mass, tuple) or len(self.mass) != n or {np.shape(row) for row in self.mass} not in ({()}, {(n,)}):
            raise ConfigError(f"mass does not fit {n} dofs", hint="a list of masses, or a matrix")
        if self.noise < 0:
            raise ConfigError("noise must not be negative")
        if self.lines.count < 2 or not 0 <= self.lines.first < self.lines.last:
            raise ConfigError("lines: two or more from `first` up to `last` are needed")

    @property
    def frequency(self) -> FloatArray:
        """(n_line,) [Hz]."""
        return np.linspace(self.lines.first, self.lines.last, self.lines.count)


def exact_receptance(rig: VirtualMdofRig) -> ComplexArray:
    """(K + j w C - w^2 M)^-1 on the rig's lines, (n_line, n_dof, n_dof) [m/N]. Equation (sim-mdof)."""
    w = 2 * np.pi * rig.frequency[:, None, None]
    mass = np.array(rig.mass, float)
    mass = np.diag(mass) if mass.ndim == 1 else mass
    h: ComplexArray = np.linalg.inv(np.array(rig.stiffness) + 1j * w * np.array(rig.damping) - w**2 * mass)
    return h


def simulated_response(rig: VirtualMdofRig, rng: np.random.Generator | None) -> FrequencyResponse:
    """The FRF with circular white noise of known variance; without noise for no *rng*, its variance stated all the same.

    Equation (sim-mdof-noise).
    """
    exact = exact_receptance(rig)
    std = rig.noise * float(np.max(np.abs(exact)))
    noise = 0.0 if rng is None else std * (rng.standard_normal(exact.shape) + 1j * rng.standard_normal(exact.shape))
    dofs = [str(number + 1) for number in range(exact.shape[1])]
    return FrequencyResponse(
        frequency=rig.frequency,
        matrix=exact + noise,
        outputs=tuple(Port(dof, dof, dof) for dof in dofs),
        inputs=tuple(Port(dof, dof, dof) for dof in dofs),
        covariance=uncorrelated(np.full(exact.shape, 2 * std**2)) if std > 0 else None,
        name=rig.name,
    )


def truth(rig: VirtualMdofRig) -> dict[str, float]:
    """k_i_j [N/m], c_i_j [N.s/m] and m_i_j [kg] by name."""
    mass = np.array(rig.mass, float)
    matrices = {"k": np.array(rig.stiffness), "c": np.array(rig.damping), "m": np.diag(mass) if mass.ndim == 1 else mass}
    return {f"{letter}_{i + 1}_{j + 1}": float(value) for letter, m in matrices.items() for (i, j), value in np.ndenumerate(m)}


def _simulate(rig: VirtualMdofRig, seed: int, _runs: Sequence[str]) -> Simulation:
    """One FRF table: this rig has no recordings."""
    return Simulation({"frf": simulated_response(rig, np.random.default_rng(seed))}, {"truth": truth(rig)})


def _response(rig: VirtualMdofRig, seeds: Sequence[int] | None) -> FrequencyResponse:
    return simulated_response(rig, None if seeds is None else np.random.default_rng(tuple(seeds)))


MDOF_RIG = VirtualRigKind(
    settings=VirtualMdofRig,
    runs=lambda _rig: (),
    simulate=_simulate,
    parameters=lambda rig, _runs: truth(rig),
    noisy=lambda rig, level: replace(rig, noise=level),
    response=_response,
    with_lines=lambda rig, count: replace(rig, lines=replace(rig.lines, count=count)),
)
