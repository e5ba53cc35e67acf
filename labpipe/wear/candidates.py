"""Operating points of a worn rotor, and what a test at each would tell of its wear: the Fisher information of its receptance.

With white forces of one-sided density S_F in y and then in z, each for T seconds, and noise densities S_n of the probes and S_m of the
force transducer, I_ij = 2 T sum over terms of the integral of S_F Re(h_i* h_j) / (S_n + |H|^2 S_m) over the band, h_i the derivatives of
the receptance H by the parameters (Pintelon and Schoukens 2012, System Identification, sec. 9.10).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.bearings.journal import journal_equilibrium
from labpipe.bearings.journal_mesh import FilmMesh
from labpipe.bearings.kinds import OperatingPoint
from labpipe.rigs.rotor_rig import BearingPlace, RotorRig
from labpipe.rotors.parts import Support
from labpipe.rotors.reduction import reduced_rotor
from labpipe.rotors.worn import VaryingSupport, response_with_slopes
from labpipe.wear.measured import PLACES
from labpipe.wear.model import BETA_STEP
from labpipe.wear.settings import ANGLE, DEPTH
from labpipe.wear.tables import film_slopes

MESH = FilmMesh(240, 30)


@dataclass(frozen=True)
class ResponseTest:
    """One test: rms *force* [N], *seconds* [s] under each of two directions, lines *spacing* [Hz] apart, without *exclude* [Hz].

    displacement [m/sqrt(Hz)], force_noise [N/sqrt(Hz)]: one-sided densities of the sensors' noise.
    """

    force: float
    seconds: float
    spacing: float
    displacement: float
    force_noise: float
    exclude: tuple[tuple[float, float], ...] = ()

    def lines(self, band: tuple[float, float]) -> FloatArray:
        """Frequencies (n_line,) [Hz] of a band that tell something."""
        low, high = (round(end / self.spacing) for end in band)
        lines = np.arange(max(low, 1), high + 1) * self.spacing
        left_out = [(lines >= first) & (lines <= last) for first, last in self.exclude]
        return np.asarray(lines[~np.any(left_out, axis=0)] if left_out else lines)


@dataclass(frozen=True)
class ExpectedWear:
    """A rotor with the expected *values* [SI] of the parameters, wear_depth and wear_angle of the *bearing* first."""

    rig: RotorRig
    bearing: str
    values: Mapping[str, float]

    def at(self, speed: float, node: int, load: float) -> ExpectedWear:
        """At another speed [Hz] and with another vertical static force [N] at a node, positive up."""
        others = tuple(part for part in self.rig.loads if part[0] != node)
        return replace(self, rig=replace(self.rig, speed=speed, loads=(*others, (node, 0.0, load))))

    def receptance_and_slopes(self, lines: FloatArray, mesh: FilmMesh = MESH) -> tuple[ComplexArray, ComplexArray]:
        """H (n_line, 2, 2) [m/N] at lines (n_line,) [Hz], and its derivatives (n, n_line, 2, 2) by the parameters [m/N per SI unit]."""
        loads = self.rig.static_loads()
        supports = [self._support(place, loads[place.name], mesh) for place in self.rig.bearings]
        response, slopes = self._response(lines, supports, self.beta)
        if "beta" in self.values:
            step = BETA_STEP * self.beta
            ends = [self._response(lines, supports, self.beta + move)[0] for move in (step, -step)]
            slopes[tuple(self.values).index("beta")] = (ends[0] - ends[1]) / (2 * step)
        return response, slopes

    @property
    def beta(self) -> float:
        """Damping of the shaft in proportion to its stiffness [s]."""
        return float(self.values.get("beta", self.rig.rotor.beta))

    def _response(self, lines: FloatArray, supports: Sequence[VaryingSupport], beta: float) -> tuple[ComplexArray, ComplexArray]:
        nodes = (*(place.node for place in self.rig.bearings), self.rig.force, self.rig.response)
        free = reduced_rotor(replace(self.rig.rotor, beta=beta), nodes, lines, self.rig.omega)
        return response_with_slopes(free, supports, self.rig.response, self.rig.force)

    def _support(self, place: BearingPlace, load: tuple[float, float], mesh: FilmMesh) -> VaryingSupport:
        """A bearing with the derivatives of its coefficients by the parameters."""
        slopes = np.zeros((2, len(self.values), 2, 2))
        if not place.is_film:
            fixed = place.bearing.at(OperatingPoint(load, self.rig.omega, self.rig.omega))
            return VaryingSupport(Support(place.node, fixed.stiffness, fixed.damping), *slopes)
        names = [name for name in self.values if name != "beta" and (place.name == self.bearing or name not in (DEPTH, ANGLE))]
        bearing = replace(place.film("wear"), **{name: self.values[name] for name in names})
        film = journal_equilibrium(bearing, load, self.rig.omega, mesh)
        for name, slope in film_slopes(film, names).items():
            slopes[:, tuple(self.values).index(name)] = slope
        return VaryingSupport(Support(place.node, film.stiffness, film.damping), *slopes)


def information(expected: ExpectedWear, testing: ResponseTest, band: tuple[float, float], terms: str = "full") -> FloatArray:
    """What a test in a *band* [Hz] tells of the parameters, (n, n) [1/SI units squared], from these *terms* of the receptance.

    Equation (plan-wear).
    """
    lines = testing.lines(band)
    response, slopes = expected.receptance_and_slopes(lines)
    density = testing.force**2 / (band[1] - band[0])
    noise = testing.displacement**2 + (testing.force_noise * np.abs(response)) ** 2
    weight = np.zeros((lines.size, 4))
    chosen = list(PLACES[terms])
    weight[:, chosen] = (2 * testing.seconds * testing.spacing * density / noise).reshape(-1, 4)[:, chosen]
    flat = slopes.reshape(len(slopes), lines.size, 4)
    return np.asarray(np.einsum("ilt,lt,jlt->ij", flat.conj(), weight, flat).real)
