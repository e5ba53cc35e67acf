"""Magnet of a homopolar hybrid magnetic bearing as a reluctance network: force-current factor and negative stiffness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, setting

MU_0 = 4e-7 * np.pi
RINGS = 2
# Poles of one ring in +x, -x, +y, -y; the coils of +x and -x carry the control current with and against the bias.
ALONG_X = np.array([1.0, -1.0, 0.0, 0.0])
ASSUMPTIONS = (
    "four poles per ring in two rings, coils on every pole, opposite coils in series",
    "no leakage, fringing or saturation; each gap has the area of its pole",
    "permanent magnet on a straight recoil line through its coercivity",
    "rotor and yoke without reluctance; of the pole, that of its iron path where one is given",
    "no eddy currents",
)


@dataclass(frozen=True, kw_only=True)
class Magnet(Settings):
    """Geometry of a radial hybrid magnet: four poles per ring, and between the two rings a permanent magnet."""

    turns: int = setting("integer", "turns of the coil on each pole")
    gap: float = setting("value", "effective air gap of the centred rotor", unit="m")
    pole_area: float = setting("value", "area of one pole", unit="m^2")
    bias_current: float = setting("value", "steady current that adds to the permanent magnet's flux", unit="A", default=0.0)
    coercivity: float = setting("value", "coercivity H_c of the permanent-magnet ring", unit="A/m", default=0.0)
    magnet_length: float = setting("value", "length of the permanent-magnet ring along its magnetisation", unit="m", default=0.0)
    magnet_area: float | None = setting("value", "area of the ring; by default its reluctance is neglected", unit="m^2", default=None)
    recoil: float = setting("value", "relative recoil permeability of the permanent magnet", unit="1", default=1.05)
    iron_path: float = setting("value", "length of the iron path of one pole", unit="m", default=0.0)
    iron_permeability: float = setting("value", "relative permeability of the iron", unit="1", default=4000.0)

    def __post_init__(self) -> None:
        positive = {"turns": self.turns, "gap": self.gap, "pole_area": self.pole_area, "recoil": self.recoil}
        positive |= {"iron_permeability": self.iron_permeability, "magnet_area": 1.0 if self.magnet_area is None else self.magnet_area}
        for name, amount in positive.items():
            if not amount > 0:
                raise ConfigError(f"{name}: must be above zero, not {amount:g}")
        for name in ("bias_current", "coercivity", "magnet_length", "iron_path"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name}: must not be negative")
        if not self.bias_current + self.coercivity * self.magnet_length > 0:
            raise ConfigError("magnet: without bias flux there is no force per current", hint="give bias_current, or coercivity and length")

    @property
    def magnet_reluctance(self) -> float:
        """R_m = l_m / (mu_0 mu_r A_m); zero where no area is given [A/Wb]."""
        return 0.0 if self.magnet_area is None else self.magnet_length / (MU_0 * self.recoil * self.magnet_area)

    @property
    def iron_length(self) -> float:
        """Length of air that has the reluctance of one pole's iron path [m]."""
        return self.iron_path / self.iron_permeability


@dataclass(frozen=True)
class MagnetFactors:
    """F = k_i i + k_n x of the centred rotor: *force_per_current* k_i [N/A], *negative_stiffness* k_n [N/m], bias flux density [T]."""

    force_per_current: float
    negative_stiffness: float
    bias_flux_density: float


def pole_fluxes(magnet: Magnet, displacement: float, current: float) -> FloatArray:
    """Flux of the four poles of one ring with the rotor at *displacement* [m] in x and the control *current* [A], (4,) [Wb].

    Both rings are equal, so each has half of the permanent magnet: phi_j = P_j (U + N i_j), P_j = mu_0 A / (g_j + l_iron), and
    H_c l_m = R_m sum_j phi_j + 2 U. Equation (mag-fluxes).
    """
    permeance = MU_0 * magnet.pole_area / (magnet.gap + magnet.iron_length - ALONG_X * displacement)
    coils = magnet.turns * (magnet.bias_current + ALONG_X * current)
    source = magnet.coercivity * magnet.magnet_length
    potential = (source - magnet.magnet_reluctance * (permeance @ coils)) / (RINGS + magnet.magnet_reluctance * permeance.sum())
    fluxes: FloatArray = permeance * (potential + coils)
    return fluxes


def magnet_force(magnet: Magnet, displacement: float, current: float) -> float:
    """Force on the rotor in x of both rings, F = 2 sum_j (+-) phi_j^2 / (2 mu_0 A) [N]. Equation (mag-force)."""
    fluxes = pole_fluxes(magnet, displacement, current)
    return float(RINGS * (ALONG_X @ fluxes**2) / (2 * MU_0 * magnet.pole_area))


def magnet_factors(magnet: Magnet) -> MagnetFactors:
    """k_i = 4 phi_0 N / g', k_n = 4 phi_0^2 / (mu_0 A g') of the centred rotor; g' = g + l_iron, phi_0 the bias flux of a pole.

    Neither x nor i changes the total flux of the ring to first order, so the permanent magnet acts through phi_0 alone.
    Equation (mag-factors).
    """
    length = magnet.gap + magnet.iron_length
    bias = float(pole_fluxes(magnet, 0.0, 0.0)[0])
    return MagnetFactors(
        2 * RINGS * bias * magnet.turns / length,
        2 * RINGS * bias**2 / (MU_0 * magnet.pole_area * length),
        bias / magnet.pole_area,
    )


def static_stiffness(factors: MagnetFactors, current_per_displacement: float) -> float:
    """k_0 = k_i di/dx - k_n of the closed loop at rest; *current_per_displacement* = probe * G(0) * amplifier [A/m] -> [N/m]."""
    return factors.force_per_current * current_per_displacement - factors.negative_stiffness


def inferred_pole_area(turns: int, gap: float, force_per_current: float, negative_stiffness: float) -> float:
    """A = k_i^2 g / (4 N^2 mu_0 k_n), the pole area at which the geometry has both factors, iron without reluctance [m^2].

    Equation (mag-area).
    """
    return force_per_current**2 * gap / (2 * RINGS * turns**2 * MU_0 * negative_stiffness)
