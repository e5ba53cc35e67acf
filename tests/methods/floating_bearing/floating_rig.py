"""A floating stator in the frequency domain, written down anew: forces, stator, bearing, baseline, rotor on
flexible supports, noise.

(-w^2 M_s + Z_b + H) X_s - H X_r = F,  (-w^2 M_r + Z_r + H) X_r - H X_s = 0; measured are F, D = X_s - X_r and
A = -w^2 X_s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from labpipe.records.recording import Channel, SumTerm
from labpipe.records.spectra import ChannelSpectra, UncertainFactor

CHANNELS = tuple(
    Channel(f"{letter}{axis}", quantity, role, axis)
    for letter, quantity, role in (
        ("f", "force", "input"),
        ("d", "displacement", "output"),
        ("a", "acceleration", "output"),
    )
    for axis in "xy"
)
Stiffness = Callable[[np.ndarray], np.ndarray]


def kcm(k: list[list[float]], c: list[list[float]], m: list[list[float]] | None = None) -> Stiffness:
    """K + jwC - w^2 M."""
    stiffness, damping, mass = np.array(k), np.array(c), np.array(m if m is not None else np.zeros((2, 2)))
    return lambda w: stiffness + 1j * w[:, None, None] * damping - w[:, None, None] ** 2 * mass


# Water seal, after the size of Kanki and Kawakami 1984 (clearance 0.5 mm, 1000 rpm and more): strong added
# mass and cross coupling.
SEAL = {
    "k": [[5.0e6, 2.4e6], [-2.4e6, 5.0e6]],
    "c": [[4.2e4, 8.0e3], [-8.0e3, 4.2e4]],
    "m": [[45.0, 2.0], [-2.0, 45.0]],
}
# Plain journal bearing: no symmetry, large damping.
JOURNAL = {
    "k": [[6.0e7, 1.0e7], [-8.0e7, 9.0e7]],
    "c": [[3.0e5, -6.0e4], [-6.0e4, 5.5e5]],
    "m": [[12.0, 0.0], [0.0, 20.0]],
}
# Tilting pads: little cross coupling, pads with inertia of their own, natural frequency inside the band.
PADS = {"k": [[1.2e8, 1e6], [-1e6, 1.4e8]], "c": [[9e4, 2e3], [-2e3, 1.1e5]]}
PAD_R0, PAD_R1, PAD_F, PAD_ZETA = (
    np.array([[-4e7, 1e6], [2e6, -5e7]]),
    np.array([[6e4, 0.0], [0.0, 5e4]]),
    120.0,
    0.6,
)


def pads(w: np.ndarray) -> np.ndarray:
    s, w0 = 1j * w[:, None, None], 2 * np.pi * PAD_F
    return kcm(**PADS)(w) + (PAD_R0 + s * PAD_R1) / (1 + 2 * PAD_ZETA * s / w0 + s**2 / w0**2)


@dataclass(frozen=True)
class FloatingRig:
    """What the virtual bench is made of [SI units]; noise: standard deviations of one averaged line over the
    channel's r.m.s. signal.
    """

    bearing: Stiffness
    mass: float = 60.0
    baseline: Stiffness = field(
        default_factory=lambda: kcm([[1.5e6, 0.0], [0.0, 1.2e6]], [[900.0, 0.0], [0.0, 700.0]])
    )
    rotor_mass: float = 80.0
    rotor: Stiffness = field(default_factory=lambda: kcm([[9e7, 0.0], [0.0, 8e7]], [[2e4, 0.0], [0.0, 2e4]]))
    frequency: np.ndarray = field(default_factory=lambda: np.arange(20.0, 200.0, 2.0))
    force: float = 500.0
    noise: float = 0.01
    excitation: str = "hadamard"
    conditions: dict[str, str] = field(default_factory=dict)
    name: str = "run"

    @property
    def omega(self) -> np.ndarray:
        return 2 * np.pi * self.frequency

    def forces(self) -> np.ndarray:
        """(n_line, n_run, 2), Schroeder phases."""
        n = self.frequency.size
        line = self.force * np.exp(-1j * np.pi * np.arange(n) ** 2 / n)
        none = np.zeros(n)
        if self.excitation == "zipper":
            odd = np.arange(n) % 2
            return np.stack([line * odd, line * (1 - odd)], axis=-1)[:, None]
        runs = (
            [(line, none), (none, line)]
            if self.excitation == "alternating"
            else [(line, line), (line, -line)]
        )
        return np.stack([np.stack(run, axis=-1) for run in runs], axis=1)

    def clean(self) -> np.ndarray:
        """z (n_line, n_run, 6) without noise."""
        w = self.omega[:, None, None]
        h, zb, zr = self.bearing(self.omega), self.baseline(self.omega), self.rotor(self.omega)
        eye = np.eye(2)
        whole = np.block([[zb + h - w**2 * self.mass * eye, -h], [-h, zr + h - w**2 * self.rotor_mass * eye]])
        forces = self.forces()
        right = np.concatenate([forces, np.zeros_like(forces)], axis=-1)
        x = np.linalg.solve(whole[:, None], right[..., None])[..., 0]
        return np.concatenate([forces, x[..., :2] - x[..., 2:], -(w**2) * x[..., :2]], axis=-1)

    def std(self) -> np.ndarray:
        """Standard deviation of each channel's complex noise (6,), the same at all lines."""
        clean = self.clean()
        power = np.sqrt(np.mean(np.abs(clean) ** 2, axis=(0, 1)))
        return self.noise * np.repeat(np.sqrt(np.mean(power.reshape(3, 2) ** 2, axis=1)), 2)

    def draw(self, rng: np.random.Generator, nu: int = 0, share: int = 1) -> ChannelSpectra:
        """Noisy spectra.

        Covariance known, or from *nu* degrees of freedom, *share* neighbouring lines and all runs having one.
        """
        clean, std = self.clean(), self.std()
        noisy = clean + std * complex_normal(rng, clean.shape)
        covariance = np.broadcast_to(np.diag(std**2).astype(complex), (*clean.shape, 6))
        if nu:
            groups = -(-clean.shape[0] // share)
            samples = std * complex_normal(rng, (groups, nu, 6))
            estimated = np.einsum("gni,gnj->gij", samples, samples.conj()) / nu
            covariance = np.broadcast_to(
                np.repeat(estimated, share, axis=0)[: clean.shape[0], None], covariance.shape
            )
        return self.spectra(noisy, covariance, float(nu) if nu else float("inf"))

    def spectra(
        self, vectors: np.ndarray, covariance: np.ndarray, dof: float = float("inf")
    ) -> ChannelSpectra:
        runs = tuple(f"run {n}" for n in range(vectors.shape[1]))
        return ChannelSpectra(
            self.frequency,
            vectors,
            covariance,
            CHANNELS,
            runs,
            covariance_dof=dof,
            name=self.name,
            conditions=self.conditions,
        )

    def dry(self) -> FloatingRig:
        """The same stator without the bearing."""
        return replace(self, bearing=kcm([[0.0, 0.0]] * 2, [[0.0, 0.0]] * 2), name="dry")


def complex_normal(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


def less_inertia(spectra: ChannelSpectra, mass: float, uncertainty: float) -> ChannelSpectra:
    """Forces less mass times acceleration, as derived channels give: beside the measured ones, the mass a
    factor with its uncertainty.
    """
    effect = np.vstack([np.eye(6), np.zeros((2, 6))])
    slope = np.zeros((8, 8))
    for n in (0, 1):
        effect[6 + n, n], effect[6 + n, 4 + n], slope[6 + n, 4 + n] = 1.0, -mass, -1.0
    sums = tuple(
        Channel(
            f"f{axis}_eff",
            "force",
            "input",
            axis,
            terms=(SumTerm(f"f{axis}", 1.0), SumTerm(f"a{axis}", -mass)),
        )
        for axis in "xy"
    )
    return replace(
        spectra,
        channels=(*spectra.channels, *sums),
        vectors=spectra.vectors @ effect.T,
        covariance=effect @ spectra.covariance @ effect.T,
        factors=(UncertainFactor("fx_eff: ax", mass, uncertainty, "kg", slope),),
    )


def truth(matrices: dict[str, list[list[float]]]) -> dict[str, float]:
    """k_xx ... m_yy."""
    return {
        f"{letter}_{row}{column}": matrices[letter][i][j]
        for letter in matrices
        for i, row in enumerate("xy")
        for j, column in enumerate("xy")
    }
