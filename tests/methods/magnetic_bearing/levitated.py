"""A levitated rotor written down anew in the frequency domain: what controller, injection and noise make of
currents and displacements.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from labpipe.records.recording import Channel
from labpipe.records.spectra import ChannelSpectra

AXES = "xy"


@dataclass(frozen=True)
class Rotor:
    """M x'' = K_i i - K_s x under i = r - C x with C = p + d s; the rest as in the closed-loop examples."""

    k_i: np.ndarray = field(default_factory=lambda: np.array([[80.0]]))
    k_s: np.ndarray = field(default_factory=lambda: np.array([[-2e5]]))
    mass: float = 4.0
    frequency: np.ndarray = field(default_factory=lambda: np.arange(5.0, 301.0, 5.0))
    reference: float = 0.02
    noise_i: float = 2e-5
    noise_x: float = 2e-8

    @property
    def n(self) -> int:
        return len(self.k_i)

    @property
    def omega(self) -> np.ndarray:
        return 2 * np.pi * self.frequency

    def clean(self) -> np.ndarray:
        """(n_line, n_run, 2 n): one run per axis."""
        w = self.omega[:, None, None]
        plant = np.linalg.solve(self.k_s - w**2 * self.mass * np.eye(self.n), self.k_i.astype(complex))
        control = (5000.0 + 12j * w) * np.eye(self.n)
        current = np.linalg.inv(np.eye(self.n) + control @ plant) * self.reference
        return np.concatenate([current, plant @ current], axis=1).swapaxes(1, 2)

    def std(self) -> np.ndarray:
        return np.repeat([self.noise_i, self.noise_x], self.n)

    def spectra(self, rng: np.random.Generator | None = None, periods: int = 0) -> ChannelSpectra:
        """Known covariance, or that of so many periods, from which it is estimated."""
        clean, std = self.clean(), self.std()
        covariance = np.broadcast_to(np.diag(std**2).astype(complex), (*clean.shape[:2], std.size, std.size))
        if rng is None:
            return self.record(clean, covariance)
        if not periods:
            return self.record(clean + circular(rng, clean.shape) * std, covariance)
        draws = clean + circular(rng, (periods, *clean.shape)) * std * np.sqrt(periods)
        rest = draws - draws.mean(axis=0)
        scatter = np.einsum("plrc,plrd->lrcd", rest, rest.conj()) / (periods * (periods - 1))
        return self.record(draws.mean(axis=0), scatter, periods - 1.0)

    def record(
        self, vectors: np.ndarray, covariance: np.ndarray, dof: float = float("inf"), **more: object
    ) -> ChannelSpectra:
        labels = AXES[: self.n]
        angles = (0.0, np.pi / 2)
        channels = [Channel(f"i{a}", "current", "input", a, angles[k]) for k, a in enumerate(labels)]
        channels += [Channel(a, "displacement", "output", a, angles[k]) for k, a in enumerate(labels)]
        runs = tuple(f"run {a}" for a in labels)[: vectors.shape[1]]
        return ChannelSpectra(
            self.frequency, vectors, covariance, tuple(channels), runs, covariance_dof=dof, **more
        )  # type: ignore[arg-type]


def circular(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Circular complex noise of unit variance."""
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


COUPLED = Rotor(k_i=np.array([[80.0, 2.0], [-3.0, 76.0]]), k_s=np.array([[-2e5, 2e4], [-1.5e4, -1.8e5]]))
