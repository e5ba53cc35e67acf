"""Magnetic bearings as a kind of bearing: reluctance network, settings of their file, coefficients, poles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.kinds import Amount, BearingCoefficients, BearingKind, frequency_hz, synchronous
from labpipe.errors import ConfigError, SettingError
from labpipe.methods.magnetic_bearing.loop import (
    ControlLoop,
    inferred_negative_stiffness,
    loop_stiffness,
    stiffness_matrix,
    stiffness_shares,
)
from labpipe.methods.magnetic_bearing.sampled_loop import Suspended
from labpipe.methods.magnetic_bearing.stability import (
    PADE_ORDER,
    SensitivityPeak,
    closed_loop_poles,
    sensitivity_peak,
    unstable_poles,
)
from labpipe.records.finding import Finding
from labpipe.records.settings import Settings, choice, integer, names, quantity, section, settings_of, text
from labpipe.registry import nearest

MU_0 = 4e-7 * np.pi
RINGS = 2
# Poles of a ring in +x, -x, +y, -y; the coils of +x and -x carry the current with and against the bias.
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
    """Geometry of a radial hybrid magnet: four poles per ring, a permanent magnet between the two rings."""

    turns: int = integer("turns of the coil on each pole")
    gap: float = quantity("effective air gap of the centred rotor", "m")
    pole_area: float = quantity("area of one pole", "m^2")
    bias_current: float = quantity("steady current that adds to the permanent magnet's flux", "A", 0.0)
    coercivity: float = quantity("coercivity H_c of the permanent-magnet ring", "A/m", 0.0)
    magnet_length: float = quantity("length of the permanent-magnet ring along its magnetisation", "m", 0.0)
    magnet_area: float | None = quantity(
        "area of the ring; by default its reluctance is neglected", "m^2", None
    )
    recoil: float = quantity("relative recoil permeability of the permanent magnet", "1", 1.05)
    iron_path: float = quantity("length of the iron path of one pole", "m", 0.0)
    iron_permeability: float = quantity("relative permeability of the iron", "1", 4000.0)

    def __post_init__(self) -> None:
        self.require_positive("turns", "gap", "pole_area", "recoil", "iron_permeability", "magnet_area")
        self.require_not_negative("bias_current", "coercivity", "magnet_length", "iron_path")
        if not self.bias_current + self.coercivity * self.magnet_length > 0:
            hint = "give bias_current, or coercivity and magnet_length"
            raise ConfigError("magnet: without bias flux there is no force per current", hint=hint)
        if bool(self.coercivity) != bool(self.magnet_length):
            hint = "give both, or leave both out"
            raise ConfigError("magnet: coercivity and magnet_length belong together", hint=hint)
        if self.magnet_area is not None and not self.magnet_length:
            raise SettingError("magnet_area", "magnet_area goes with magnet_length", "leave it out")

    @property
    def magnet_reluctance(self) -> float:
        """R_m = l_m / (mu_0 mu_r A_m); zero where no area is given [A/Wb]."""
        return self.magnet_length / (MU_0 * self.recoil * (self.magnet_area or np.inf))

    @property
    def iron_length(self) -> float:
        """Length of air that has the reluctance of one pole's iron path [m]."""
        return self.iron_path / self.iron_permeability


@dataclass(frozen=True)
class MagnetFactors:
    """F = k_i i + k_n x of the centred rotor: k_i [N/A], k_n [N/m]."""

    force_per_current: float
    negative_stiffness: float


def pole_fluxes(magnet: Magnet, displacement: float, current: float) -> FloatArray:
    """Flux of the four poles of one ring with the rotor at *displacement* [m] in x and the control *current*
    [A], (4,) [Wb]. Both rings are equal, so each has half of the permanent magnet: phi_j = P_j (U + N i_j),
    P_j = mu_0 A / (g_j + l_iron), and H_c l_m = R_m sum_j phi_j + 2 U. Equation (mag-fluxes).
    """
    permeance = MU_0 * magnet.pole_area / (magnet.gap + magnet.iron_length - ALONG_X * displacement)
    coils = magnet.turns * (magnet.bias_current + ALONG_X * current)
    source = magnet.coercivity * magnet.magnet_length
    potential = (source - magnet.magnet_reluctance * (permeance @ coils)) / (
        RINGS + magnet.magnet_reluctance * permeance.sum()
    )
    return permeance * (potential + coils)


def magnet_force(magnet: Magnet, displacement: float, current: float) -> float:
    """Force on the rotor in x of both rings, 2 sum (+-) phi_j^2 / (2 mu_0 A) [N]. Equation (mag-force)."""
    fluxes = pole_fluxes(magnet, displacement, current)
    return float(RINGS * (ALONG_X @ fluxes**2) / (2 * MU_0 * magnet.pole_area))


def magnet_factors(magnet: Magnet) -> MagnetFactors:
    """k_i = 4 phi_0 N / g', k_n = 4 phi_0^2 / (mu_0 A g') of the centred rotor; g' = g + l_iron, phi_0 the
    bias flux of a pole. Equation (mag-factors).
    """
    length = magnet.gap + magnet.iron_length
    bias = float(pole_fluxes(magnet, 0.0, 0.0)[0])
    return MagnetFactors(
        2 * RINGS * bias * magnet.turns / length, 2 * RINGS * bias**2 / (MU_0 * magnet.pole_area * length)
    )


def inferred_pole_area(turns: int, gap: float, force_per_current: float, negative_stiffness: float) -> float:
    """A = k_i^2 g / (4 N^2 mu_0 k_n) [m^2] of both factors, iron without reluctance. Equation (mag-area)."""
    return force_per_current**2 * gap / (2 * RINGS * turns**2 * MU_0 * negative_stiffness)


MAGNETIC = "magnetic-bearing"
DOFS = ("x", "y")


@dataclass(frozen=True, kw_only=True)
class MagneticFile(Settings):
    """A magnetic-bearing file: the control loop, the magnet by its geometry or its factors, and the frequency
    of the motion. One of static_stiffness (from which the negative stiffness is inferred), negative_stiffness
    and magnet is required.
    """

    kind: str = choice("which kind of bearing", (MAGNETIC,))
    name: str = text("name of the bearing")
    mass: float = quantity("mass that this bearing carries, for poles and sensitivity", "kg")
    speed: float | None = quantity("speed of the shaft, in Hz or rpm", "Hz", None)
    frequency: float | None = quantity("frequency of the motion; default: the speed", "Hz", None)
    loop: ControlLoop = section("the position control", ControlLoop, ControlLoop())
    magnet: Magnet | None = section("geometry of the magnet; gives both factors unless given", Magnet, None)
    force_per_current: float | None = quantity(
        "force-current factor; default: the magnet's, without one the loop's", "N/A", None
    )
    negative_stiffness: float | None = quantity("pull of the bias field per displacement, k_n", "N/m", None)
    static_stiffness: float | None = quantity(
        "stiffness of the closed loop at rest; k_n is inferred", "N/m", None
    )
    inferred: tuple[str, ...] = names("entries neither published nor measured; stated with the result")

    def __post_init__(self) -> None:
        self.require_positive("mass")
        if self.frequency is None and self.speed is None:
            hint = "for example frequency: 50 Hz"
            raise ConfigError("frequency: is missing, and there is no speed", hint=hint)
        if not self.motion_frequency > 0:
            raise ConfigError(f"frequency: must be above zero, not {self.motion_frequency:g} Hz")
        entries = [name for owner in (MagneticFile, ControlLoop, Magnet) for name in settings_of(owner)]
        for name in self.inferred:
            if name not in entries:
                hint = nearest(name, entries)
                raise ConfigError(f"inferred: '{name}' is not an entry of a magnetic bearing", hint=hint)
        self._check_factors()

    def _check_factors(self) -> None:
        either = "leave one of them out"
        if self.negative_stiffness is not None and self.static_stiffness is not None:
            raise ConfigError("static_stiffness: negative_stiffness is given as well", hint=either)
        if self.negative_stiffness is None and self.static_stiffness is None and self.magnet is None:
            hint = "or give static_stiffness, or the geometry as magnet"
            raise ConfigError("negative_stiffness: is missing", hint=hint)
        if self.factor_of_loop or "force_per_current" not in self.loop.written:
            return
        given = "magnet" if self.force_per_current is None else "force_per_current"
        raise SettingError("loop", f"loop.force_per_current: '{given}' gives it as well", either)

    @property
    def factor_of_loop(self) -> bool:
        """Whether the force per current is that of the loop."""
        return self.force_per_current is None and self.magnet is None

    @property
    def motion_frequency(self) -> float:
        return float(self.speed or 0.0) if self.frequency is None else self.frequency

    def suspension(self) -> Suspended:
        """Control loop, negative stiffness and mass, from whichever entries the file has."""
        factor, pull, loop = self.force_per_current, self.negative_stiffness, self.loop
        if self.magnet is not None:
            factors = magnet_factors(self.magnet)
            factor = factors.force_per_current if factor is None else factor
            pull = factors.negative_stiffness if pull is None else pull
        if factor is not None:
            loop = replace(loop, force_per_current=factor)
        if self.static_stiffness is not None:
            pull = inferred_negative_stiffness(loop, self.static_stiffness)
        assert pull is not None
        return Suspended(loop, pull, self.mass)

    def assumptions(self) -> str:
        of_both = "mass and magnet alike in both directions"
        if self.loop.cross is None:
            of_both = "both directions alike, without coupling"
        poles = f"delay by Pade approximation of order {PADE_ORDER}"
        if self.loop.rate is not None:
            poles = f"of the loop sampled at {self.loop.rate:g} Hz, blocks of s by the bilinear transform"
        assumptions = [of_both, f"poles: {poles}"]
        if self.static_stiffness is not None:
            assumptions.append("negative stiffness inferred from the static stiffness")
        if self.inferred:
            assumptions.append(f"inferred, neither published nor measured: {', '.join(self.inferred)}")
        if self.magnet is not None:
            assumptions.extend(ASSUMPTIONS)
        return "; ".join(assumptions)


@dataclass(frozen=True)
class StabilityVerdict:
    """Stability of one setting: poles (n_pole,) [rad/s], number of unstable ones with the exact delay, the
    sensitivity's peak. *sampled*: the poles have the exact delay as well.
    """

    poles: ComplexArray
    unstable: int
    peak: SensitivityPeak
    sampled: bool = False


@lru_cache(maxsize=32)
def verdict(plant: Suspended) -> StabilityVerdict:
    sampled = plant.loop.rate is not None
    return StabilityVerdict(closed_loop_poles(plant), unstable_poles(plant), sensitivity_peak(plant), sampled)


def _coefficients(settings: MagneticFile) -> BearingCoefficients:
    plant, omega = settings.suspension(), 2 * np.pi * np.array([settings.motion_frequency])
    stability = verdict(plant)
    (total,) = stiffness_matrix(plant.loop, plant.negative_stiffness, omega)
    # The stiffness of an integrating controller at rest is infinite.
    at_rest = loop_stiffness(plant.loop) * plant.loop.at_rest - plant.negative_stiffness
    static = [Amount("static_stiffness", at_rest, "N/m")] if np.isfinite(at_rest) else []
    shares = stiffness_shares(plant.loop, plant.negative_stiffness, omega).items()
    words, peak = {"stability": "unstable"}, []
    # An unstable loop has no steady response, so its |S| has no meaning.
    if not stability.unstable:
        words = {"stability": "stable", "sensitivity_zone": stability.peak.zone}
        peak = [
            Amount("sensitivity_peak", stability.peak.value, "1"),
            Amount("sensitivity_frequency", stability.peak.frequency, "Hz"),
        ]
    return BearingCoefficients(
        dofs=DOFS,
        stiffness=total.real,
        damping=total.imag / omega[0],
        notes=(
            Amount("frequency", settings.motion_frequency, "Hz"),
            *static,
            Amount("negative_stiffness", plant.negative_stiffness, "N/m"),
            Amount("force_per_current", plant.loop.force_per_current, "N/A"),
            Amount("unstable_poles", float(stability.unstable), "1"),
            *peak,
        ),
        shares=(
            *(Amount(f"k_{name}", float(share.real), "N/m") for name, (share,) in shares),
            *(Amount(f"c_{name}", float(share.imag / omega[0]), "N.s/m") for name, (share,) in shares),
        ),
        poles=stability.poles,
        words={**words, "assumptions": settings.assumptions()},
        findings=stability_findings(stability),
    )


def stability_findings(stability: StabilityVerdict) -> tuple[Finding, ...]:
    """Warnings: an unstable loop; poles unstable only by the approximated delay; S beyond zone B."""
    right = stability.poles[stability.poles.real > 0]
    if stability.unstable:
        listed = ", ".join(f"{pole.real:.4g} {pole.imag:+.4g}j" for pole in right)
        delay = "" if stability.sampled else " (delay approximated)"
        what = f"the loop is unstable: {growing(stability.unstable)}; at {listed} rad/s{delay}"
        return (Finding("unstable-loop", what),)
    warnings = []
    if right.size and not stability.sampled:
        what = "the approximated delay gives poles that grow, the exact one gives none"
        warnings.append(Finding("delay-approximation", what))
    if stability.peak.zone in ("C", "D"):
        where = f"{stability.peak.value:.3g} at {stability.peak.frequency:.3g} Hz"
        what = f"sensitivity reaches {where}: zone {stability.peak.zone} of ISO 14839-3"
        warnings.append(Finding("sensitivity", f"{what}, not fit for long operation"))
    return tuple(warnings)


def growing(count: int) -> str:
    return "1 pole grows" if count == 1 else f"{count} poles grow"


def _dynamic(settings: MagneticFile, omega: FloatArray) -> ComplexArray:
    plant = settings.suspension()
    return stiffness_matrix(plant.loop, plant.negative_stiffness, omega)


MAGNETIC_KIND = BearingKind(
    MagneticFile,
    lambda settings: [_coefficients(entry) for entry in settings],
    operating={"speed": synchronous, "frequency": frequency_hz},
    lateral=("x", "y"),
    dynamic=_dynamic,
)
