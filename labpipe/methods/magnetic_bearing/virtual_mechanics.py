"""The virtual magnetic-bearing rig: its settings, and its dynamic stiffness over frequency."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import SettingError
from labpipe.methods.magnetic_bearing.loop import ControlLoop, dynamic_stiffness, inferred_negative_stiffness
from labpipe.records.settings import Settings, StandardDeviations, choice, integer, quantity, section, text
from labpipe.simulate import linear

KIND = "virtual-magnetic-rig"
LAWS = ("relaxation", "control-loop")


@dataclass(frozen=True)
class Levitation(Settings):
    """One magnetic bearing: static stiffness k_0, and the law by which it changes with frequency.

    relaxation: k(w) + j w c(w) = k_0 + k_1 j w tau / (1 + j w tau), tau = 1 / (2 pi f_c): causal and passive,
    and like the measured bearings soft at 2 Hz and stiffer by far at 250 Hz. control-loop: the loop alone,
    k_0 + K (G(jw) - G(0)); K = probe * amplifier * force-current factor [N/m].
    """

    law: str = choice("how stiffness changes with frequency", LAWS, "relaxation")
    static: float = quantity("static stiffness k_0 of one bearing", "N/m", 1694.0)
    dynamic: float = quantity("stiffness gained far above the corner, k_1", "N/m", 110e3)
    corner: float = quantity("corner frequency f_c", "Hz", 150.0)
    bearings: int = integer("equal bearings in parallel", 2)
    loop: ControlLoop = section("the position control (law control-loop)", ControlLoop, ControlLoop())

    def __post_init__(self) -> None:
        self.require_positive("bearings", "corner")
        others = ("loop",) if self.law == "relaxation" else ("dynamic", "corner")
        for name in others:
            if name in self.written:
                raise SettingError(name, f"'{name}' is not of the law {self.law}", "leave it out")


@dataclass(frozen=True)
class LevitationNoise(StandardDeviations):
    displacement: float = quantity("displacement sensors", "m", 0.3e-6)
    force: float = quantity("force transducer", "N", 0.02)
    hover: float = quantity("slow wander of the levitated rotor", "m", 1e-6)


@dataclass(frozen=True)
class VirtualMagneticRig(Settings):
    """Pedestal, rotor in two magnetic bearings, sensors."""

    kind: str = choice("which virtual rig", (KIND,))
    _: KW_ONLY
    name: str = text("name of the rig", "Virtual magnetic-bearing rig")
    pedestal_mass: float = quantity("mass of the pedestal alone", "kg", 0.79)
    rotor_mass: float = quantity("mass of pedestal and rotor, moving radially", "kg", 0.92)
    axial_mass: float = quantity("mass moving axially", "kg", 0.13)
    pedestal_stiffness: float = quantity("springs of the pedestal", "N/m", 134.5e3)
    pedestal_damping: float = quantity("guides of the pedestal", "N.s/m", 3.682)
    axial_stiffness: float = quantity("passive axial stiffness", "N/m", 2471.0)
    axial_damping: float = quantity("axial damping", "N.s/m", 3.108)
    actuator_gain: float = quantity("force per control voltage at the centre", "N/V", 5.8)
    speed: float = quantity("shaft speed of the rotating run", "Hz", 8000 / 60)
    unbalance: float = quantity("1x amplitude of the rotating run", "m", 4e-6)
    radial_force: float = quantity("rms force of the shaker in radial runs", "N", 2.0)
    levitation: Levitation = section("the magnetic bearings", Levitation, Levitation())
    noise: LevitationNoise = section("measuring noise", LevitationNoise, LevitationNoise())

    def __post_init__(self) -> None:
        self.require_positive("pedestal_mass", "rotor_mass", "axial_mass", "radial_force", "actuator_gain")
        self.require_positive("pedestal_stiffness", "axial_stiffness")
        self.require_not_negative("pedestal_damping", "axial_damping", "speed", "unbalance")
        if self.rotor_mass <= self.pedestal_mass:
            raise SettingError("rotor_mass", "rotor_mass, with the pedestal, is above pedestal_mass")


# Two force directions are tested on coefficients that differ in every place, as a fluid-film bearing's do.
COUPLED_STIFFNESS = np.array([[180e3, 25e3], [-18e3, 210e3]])
COUPLED_DAMPING = np.array([[120.0, 15.0], [-10.0, 150.0]])


PERIODS = 5


@dataclass(frozen=True)
class Timing:
    """Sampling of a periodic run: *sample_rate* [Hz], line *spacing* [Hz], number of *transient* periods."""

    sample_rate: float
    spacing: float
    transient: int

    @property
    def n_sample(self) -> int:
        """Samples of one period."""
        return round(self.sample_rate / self.spacing)

    @property
    def periods(self) -> int:
        return self.transient + PERIODS


def relaxation(levitation: Levitation, omega: FloatArray) -> ComplexArray:
    """k_0 + k_1 j w tau / (1 + j w tau) at *omega* [rad/s], (n_line,) [N/m]. Equation (sim-relaxation)."""
    relative: ComplexArray = 1j * omega / (2 * np.pi * levitation.corner)
    return levitation.static + levitation.dynamic * relative / (1 + relative)


def negative_stiffness(levitation: Levitation) -> float:
    """Pull of the bias field per displacement, k_n = K G(0) - k_0 of one bearing [N/m]."""
    return inferred_negative_stiffness(levitation.loop, levitation.static)


def levitation_stiffness(levitation: Levitation, omega: FloatArray) -> ComplexArray:
    """k(w) + j w c(w) of all bearings together at *omega* [rad/s], (n_line,) [N/m]: K G(jw) - k_n of each
    under position control, Lim et al. (2009), eq. 7 and table 1.
    """
    if levitation.law == "relaxation":
        return levitation.bearings * relaxation(levitation, omega)
    pull = negative_stiffness(levitation)
    return levitation.bearings * dynamic_stiffness(levitation.loop, pull, omega)


def levitated_stiffness(rig: VirtualMagneticRig, omega: FloatArray) -> ComplexArray:
    """Pedestal and levitated rotor in one direction at *omega*, (n_line,) [N/m]. Equation (sim-levitated)."""
    pedestal = linear.dynamic_stiffness(rig.rotor_mass, rig.pedestal_stiffness, rig.pedestal_damping, omega)
    return pedestal + levitation_stiffness(rig.levitation, omega)
