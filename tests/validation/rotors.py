"""Rotors: beams and discs in closed form, another program, the rig of Mendes, onset of instability, the
measured rotor of Falah.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from labpipe.methods.balancing.balance_file import permissible_unbalance
from labpipe.methods.balancing.influence import BalanceRun, Influence, ReadingNoise, best_weights, influence
from labpipe.methods.journal_bearing.bearing import JournalBearing, journal_equilibrium
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.response import WhirlModes, modes, onset_speed, unbalance_response
from labpipe.methods.rotor.rotor_file import load_rotor
from labpipe.methods.rotor.shaft import (
    STEEL,
    Disc,
    Material,
    NodeSupport,
    Rotor,
    ShaftElement,
    bearing_loads,
    free_rotor,
    supported_rotor,
)
from labpipe.methods.run_ups.rotor_file import load_run_up_rotor
from tests.methods.journal_bearing.short_bearing import short_bearing_coefficients
from tests.validation import peer_inputs as given
from tests.validation.claims import Claim, Method, within, worst
from tests.validation.gaps import gaps
from tests.validation.peers import recorded, words

CONFIGS = Path(__file__).parents[2] / "configs/rotors"
RIGID, NO_DAMPING = 1e13 * np.eye(2), np.zeros((2, 2))
RPM = np.pi / 30


def beam(length: float, diameter: float, n: int) -> Rotor:
    return Rotor(tuple(ShaftElement(length / n, diameter) for _ in range(n)))


def simply_supported(length: float, diameter: float, mode: int, spin: float) -> list[float]:
    """Backward and forward frequency [Hz] of a spinning pinned shaft from w = sin(m pi x / l) in the
    Timoshenko equations.

    With k = m pi / l: [kGA k^2 - rho A w^2, -kGA k; -kGA k, E I k^2 + kGA - rho I w^2 + 2 rho I Omega w]
    singular, w signed.
    """
    e = ShaftElement(length, diameter)
    shear = e.shear_coefficient * STEEL.shear_modulus * e.area
    k = mode * np.pi / length
    bending, mass, inertia = (
        STEEL.elastic_modulus * e.second_moment * k**2,
        STEEL.density * e.area,
        STEEL.density * e.second_moment,
    )
    first = np.polynomial.Polynomial([shear * k**2, 0, -mass])
    second = np.polynomial.Polynomial([bending + shear, 2 * inertia * spin, -inertia])
    roots = (first * second - (shear * k) ** 2).roots().real / (2 * np.pi)
    return sorted(abs(root) for root in roots[np.argsort(np.abs(roots))][:2])


def beams() -> list[Claim]:
    """48 elements: shear and rotary inertia lower mode 3 by 9 %, an error of the mesh of 3e-4 is accepted."""
    found, supports = [], [NodeSupport(node, RIGID, NO_DAMPING) for node in (1, 49)]
    for spin in (0.0, 3000.0):
        ours = modes(beam(1.0, 0.1, 48), supports, spin).eigenvalues.imag / (2 * np.pi)
        for mode in (1, 2, 3):
            each = [
                within(whirl, value, exact, 3e-4, "Hz", "closed form", "Timoshenko", relative=True)
                for whirl, value, exact in zip(
                    ("backward", "forward"),
                    ours[2 * mode - 2 : 2 * mode],
                    simply_supported(1.0, 0.1, mode, spin),
                    strict=True,
                )
            ]
            found.append(worst(each, f"pinned thick shaft at {spin:.0f} rad/s, mode {mode}"))
    return [*found, *free_beam(), cantilever()]


def free_beam() -> list[Claim]:
    """f = x^2 / (2 pi l^2) sqrt(E I / rho A) with cos x cosh x = 1 (Blevins); d / l = 1/200."""
    e = ShaftElement(2.0, 0.01)
    weak = [NodeSupport(node, 1e-3 * np.eye(2), NO_DAMPING) for node in (1, 13)]
    ours = modes(beam(2.0, 0.01, 12), weak, 0.0).eigenvalues.imag / (2 * np.pi)
    elastic = ours[ours > 0.3]
    found = []
    for mode, root in ((1, 4.730041), (2, 7.853205)):
        expected = (
            root**2
            / (2 * np.pi * 4)
            * np.sqrt(STEEL.elastic_modulus * e.second_moment / (STEEL.density * e.area))
        )
        found.append(
            within(
                f"free beam, mode {mode}",
                elastic[2 * mode - 2],
                expected,
                5e-4,
                "Hz",
                "closed form",
                "Blevins",
                relative=True,
            )
        )
    return found


def cantilever() -> Claim:
    """F l^3 / 3 E I + F l / kappa G A, exact in one element."""
    e = ShaftElement(0.1, 0.06)
    matrices = supported_rotor(Rotor((e,)), [])
    ours = np.linalg.solve(matrices.stiffness[4:, 4:], [1.0, 0, 0, 0])[0]
    exact = 0.1**3 / (3 * STEEL.elastic_modulus * e.second_moment) + 0.1 / (
        e.shear_coefficient * STEEL.shear_modulus * e.area
    )
    return within(
        "deflection of a short cantilever",
        1e9 * ours,
        1e9 * exact,
        1e-6,
        "nm/N",
        "closed form",
        "with shear",
        relative=True,
    )


def overhung_disc() -> list[Claim]:
    """Clamped massless shaft with a disc at its end: roots of the 2 x 2 determinant (Den Hartog), both whirl
    directions.
    """
    length, spin, mass, transverse, polar = 0.3, 600.0, 3.0, 0.01, 0.02
    e = ShaftElement(length, 0.015)
    phi = e.shear_parameter
    k = (
        STEEL.elastic_modulus
        * e.second_moment
        / (length**3 * (1 + phi))
        * np.array([[12, -6 * length], [-6 * length, (4 + phi) * length**2]])
    )

    def determinant(omega: float) -> float:
        z = k - np.diag([mass * omega**2, transverse * omega**2 - polar * spin * omega])
        return float(np.linalg.det(z / k[0, 0]))

    grid = np.linspace(-300, 300, 6001)
    signs = np.sign([determinant(w) for w in grid])
    roots = sorted(abs(brentq(determinant, grid[i], grid[i + 1])) for i in np.flatnonzero(np.diff(signs)))
    light = ShaftElement(
        length, 0.015, material=type(STEEL)(1e-3, STEEL.elastic_modulus, STEEL.shear_modulus)
    )
    clamped = [NodeSupport(1, RIGID, NO_DAMPING), NodeSupport(2, RIGID, NO_DAMPING)]
    rotor = Rotor(
        (ShaftElement(0.02, 0.5, material=light.material), light), (Disc(3, mass, transverse, polar),)
    )
    ours = modes(rotor, clamped, spin).eigenvalues.imag / (2 * np.pi)
    return [
        within(
            f"overhung disc at {spin:.0f} rad/s, {name}",
            value,
            root / (2 * np.pi),
            2e-3,
            "Hz",
            "closed form",
            "Den Hartog",
            relative=True,
        )
        for name, value, root in zip(("backward", "forward"), ours, roots, strict=False)
    ]


@cache
def two_discs() -> Rotor:
    material = Material(
        given.MATERIAL["density"],
        given.MATERIAL["elastic"],
        given.MATERIAL["shear"],
        given.MATERIAL["elastic"] / 2 / given.MATERIAL["shear"] - 1,
    )
    piece = ShaftElement(given.SHAFT["element"], given.SHAFT["diameter"], material)
    discs = tuple(
        Disc.of_dimensions(node, inner, outer, length, material) for node, inner, outer, length in given.DISCS
    )
    return Rotor((piece,) * int(given.SHAFT["number"]), discs)


def held(name: str) -> list[NodeSupport]:
    k_y, k_z, c = given.SUPPORTS[name]
    return [
        NodeSupport(node, np.diag([k_y, k_z]), c * np.eye(2)) for node in (1, int(given.SHAFT["number"]) + 1)
    ]


def of_ross() -> list[Claim]:
    """Eight lateral modes each, the worst of them: the same elements and the same shear coefficient, so that
    1e-6 is accepted.
    """
    kind, source, note = "peer program", recorded("ross")["program"], words("ross")
    found = []
    for name in given.SUPPORTS:
        for rpm in given.RPM:
            theirs = recorded("ross")["modes"][f"{name}, {rpm:.0f} rpm"]
            ours = modes(two_discs(), held(name), rpm * RPM)
            each = [
                within(f"mode {number}", value, peer, 1e-6, "Hz", kind, source, relative=True, recorded=note)
                for number, (value, peer) in enumerate(
                    zip(ours.eigenvalues.imag / (2 * np.pi), theirs["frequency"], strict=False), start=1
                )
            ]
            found.append(worst(each, f"frequency, {name} bearings, {rpm:.0f} rpm"))
            if name == "orthotropic":
                found.append(decrements(ours, theirs["log decrement"], f"{name} bearings, {rpm:.0f} rpm"))
    return [*found, *unbalance_of_ross()]


def decrements(ours: WhirlModes, theirs: list[float], where: str) -> Claim:
    ratio = ours.damping_ratio
    values = 2 * np.pi * ratio / np.sqrt(1 - ratio**2)
    each = [
        within(
            f"mode {number}",
            value,
            peer,
            1e-5,
            "1",
            "peer program",
            recorded("ross")["program"],
            relative=True,
            recorded=words("ross"),
        )
        for number, (value, peer) in enumerate(zip(values, theirs, strict=False), start=1)
    ]
    return worst(each, f"log decrement, {where}")


def unbalance_of_ross() -> list[Claim]:
    """1e-3 kg m on the first disc, amplitudes at it in both directions.

    ROSS takes its modes for it, so 1e-4 is accepted.
    """
    asked = given.UNBALANCE
    speed = np.array(asked["rpm"]) * RPM
    ours = np.abs(
        unbalance_response(
            two_discs(),
            held("orthotropic"),
            speed,
            {asked["node"]: asked["size"]},
            two_discs().dofs(asked["output"]),
        )
    )
    kind, source, note = "peer program", recorded("ross")["program"], words("ross")
    found = []
    for rpm, values, theirs in zip(asked["rpm"], ours, recorded("ross")["unbalance"], strict=True):
        each = [
            within(axis, 1e6 * value, 1e6 * peer, 1e-4, "um", kind, source, relative=True, recorded=note)
            for axis, value, peer in zip(("horizontal", "vertical"), values, theirs, strict=True)
        ]
        found.append(worst(each, f"unbalance response at {rpm:.0f} rpm"))
    return found


STIFF = Material(7800.0, 1e16, 4e15)
HEAVY = Rotor((ShaftElement(0.2, 0.05, STIFF), ShaftElement(0.2, 0.05, STIFF)), (Disc(2, 20.0, 0.05, 0.08),))
OIL = JournalBearing(diameter=0.05, length=0.0125, clearance=80e-6, viscosity=0.02)
Coefficients = Callable[[float], tuple[np.ndarray, np.ndarray]]


def half_weight() -> float:
    return -float(bearing_loads(HEAVY, [1, 3])[0, 1])


def short(speed: float) -> tuple[np.ndarray, np.ndarray]:
    return short_bearing_coefficients(OIL, half_weight(), speed)


def finite(speed: float) -> tuple[np.ndarray, np.ndarray]:
    film = journal_equilibrium(OIL, (0.0, -half_weight()), speed, FilmMesh(120, 12))
    return film.stiffness, film.damping


def lund_margin(coefficients: Coefficients, speed: float, mass: float) -> float:
    """m w^2 / k_e - 1 of a rigid rotor's half mass m on one journal: positive means unstable."""
    k, c = coefficients(speed)
    k_e = (k[0, 0] * c[1, 1] + k[1, 1] * c[0, 0] - k[0, 1] * c[1, 0] - k[1, 0] * c[0, 1]) / (
        c[0, 0] + c[1, 1]
    )
    whirl = ((k[0, 0] - k_e) * (k[1, 1] - k_e) - k[0, 1] * k[1, 0]) / (c[0, 0] * c[1, 1] - c[0, 1] * c[1, 0])
    return float(mass * whirl / k_e - 1)


def onset() -> list[Claim]:
    """Lund's threshold of a rigid rotor on two equal journals; .05 % is accepted."""
    shift = np.tile([1.0, 0, 0, 0], HEAVY.n_node)
    mass = float(shift @ free_rotor(HEAVY).mass @ shift) / 2
    found = []
    for name, coefficients in (("short film", short), ("finite film", finite)):
        expected = brentq(lambda speed, of=coefficients: lund_margin(of, speed, mass), 100, 2000)
        ours = onset_speed(
            HEAVY,
            lambda speed, of=coefficients: [NodeSupport(node, *of(speed)) for node in (1, 3)],
            np.linspace(100, 2000, 12),
        )
        assert ours is not None
        found.append(
            within(
                f"onset speed, {name}",
                ours,
                expected,
                5e-4,
                "rad/s",
                "closed form",
                "Lund 1974",
                relative=True,
            )
        )
    return found


def mendes() -> list[Claim]:
    """The healthy rig at 50 Hz: printed loads, modes of a separate calculation, and what was measured."""
    rig = load_rotor(CONFIGS / "mendes.yaml")
    loads, found = rig.static_loads(), modes(rig.rotor, rig.supports(), rig.omega)
    frequency, ratio = found.eigenvalues.imag / (2 * np.pi), found.damping_ratio
    swinging = (frequency > 10) & (frequency < 100) & (ratio < 0.5)
    source, separate = "Mendes 2017", "separate calculation"
    why = (
        "the loads of the source's text are not those of its tables, which give 35.42 and 58.86 N in a "
        "separate calculation too"
    )
    claims = [
        within(f"load of {name}", -loads[name][1], value, 0.005, "N", "printed calculation", source, why)
        for name, value in (("bearing 1", 35.38), ("bearing 2", 58.82))
    ]
    for value, reference in zip(frequency[swinging], (25.20, 25.48, 82.57, 82.71), strict=True):
        claims.append(
            within("damped frequency", value, reference, 0.05, "Hz", "independent calculation", separate)
        )
    for value, reference in zip(ratio[swinging], (0.226, 0.346, 0.0455, 0.0496), strict=True):
        claims.append(
            within(
                "damping ratio",
                value,
                reference,
                0.02,
                "1",
                "independent calculation",
                separate,
                relative=True,
            )
        )
    claims.append(
        within(
            "first bending, peak of the FRF",
            frequency[swinging][2:].mean(),
            82.0,
            1.0,
            "Hz",
            "printed measurement",
            source,
        )
    )
    claims.append(
        within(
            "oil whirl, peak of the FRF",
            frequency[swinging][:2].mean(),
            25.0,
            1.0,
            "Hz",
            "printed measurement",
            source,
        )
    )
    return claims


POUND = 4.4482216
# Static load [lb]; measured critical speed and instability threshold [rpm]: tables 2 and 3.
FALAH = (
    (0.823, 1317, 2838.37),
    (1.321, 1371, 2877.71),
    (1.817, 1312, 2805.32),
    (2.316, 1355, 2919.58),
    (3.808, 1420, 3164.02),
)


def falah() -> list[Claim]:
    """The rotor file's own film, nothing fitted, against what was measured: 5 % is accepted."""
    rig = load_run_up_rotor(CONFIGS / "falah.yaml")
    source, found = "Falah, Khorshid", []
    for load, critical, threshold in FALAH:
        film = rig.start(load * POUND)
        ours, onset_at = rig.critical_speed(film, "disc 2") / RPM, rig.threshold(film)
        assert onset_at is not None
        why = "nothing is fitted; discs and mounting are not printed and the rotor file's own"
        kind, share = "printed measurement", 0.05
        found.append(
            within(
                f"critical speed at {load} lb", ours, critical, share, "rpm", kind, source, why, relative=True
            )
        )
        found.append(
            within(
                f"threshold at {load} lb",
                onset_at / RPM,
                threshold,
                share,
                "rpm",
                kind,
                source,
                why,
                relative=True,
            )
        )
    return found


# Goodman (1964), table 1: zero-rotor data and response coefficients of three locations.
GOODMAN = np.array([[1, 3, -2], [-1, 5, -2], [0, 5, -3]], complex)
# Feese and Grazier (2004), table 1, at forward x and y, aft x and y [mil, deg]: baseline, 11.1 g at 35 deg
# aft, 3.7 g at 135 deg forward as well; residual vibrations as printed.
FEESE = (
    ((0.68, 32), (0.56, 86), (1.94, 231), (2.07, 335)),
    ((1.31, 1), (1.25, 75), (0.93, 251), (1.00, 342)),
    ((0.54, 9), (0.52, 75), (0.81, 196), (0.90, 296)),
)
FEESE_LEFT = ((0.08, 138), (0.09, 49), (0.05, 231), (0.05, 166))


# Kelm, Pavelek and Kelm (2016), an induced draft fan [mil, deg; oz in, deg]: as found, with a trial weight.
FAN = (5.6, 135), (3.3, 238), (74, 315)
# Feese and Grazier (2004), table 5, at 300 rpm [oz in / lb] by grade [mm/s].
GRADES = {6.3: (0.128, 0.0005), 16.0: (0.32, 0.005)}
OUNCE_INCHES_PER_POUND = 0.0254 / 16


def at(size: float, degrees: float) -> complex:
    return complex(size * np.exp(1j * np.radians(degrees)))


def vector_rows(
    name: str,
    value: complex,
    size: float,
    degrees: float,
    unit: str,
    last: float,
    source: str = "Feese, Grazier 2004",
) -> list[Claim]:
    """A vector within half of the *last* printed digit of its size, and of a degree."""
    turned = float(np.degrees(np.angle(value * np.exp(-1j * np.radians(degrees)))))
    kind = "printed calculation"
    return [
        within(f"{name}, size", abs(value), size, last / 2, unit, kind, source),
        within(f"{name}, angle", degrees + turned, degrees, 0.5, "deg", kind, source),
    ]


def balancing() -> list[Claim]:
    """Weights by influence coefficients, and what they leave, as the authors computed them."""
    known = Influence(GOODMAN, np.zeros((18, 18)))
    weights = best_weights(known.square)
    left = GOODMAN @ np.concatenate([[1.0], weights])
    kind, source = "printed calculation", "Goodman 1964"
    found = [
        within("two planes, three readings: weight 1", weights[0].real, 0.81, 0.005, "1", kind, source),
        within("two planes, three readings: weight 2", weights[1].real, 1.48, 0.005, "1", kind, source),
        within("rms residual", np.sqrt(np.mean(np.abs(left) ** 2)), 0.356, 0.0005, "1", kind, source),
    ]
    aft, forward = at(11.1, 35), at(3.7, 135)
    readings = [np.array([at(*reading) for reading in run]) for run in FEESE]
    both = np.array([[0, 0], [aft, 0], [aft, forward]])
    runs = [BalanceRun(str(number), *pair) for number, pair in enumerate(zip(both, readings, strict=True))]
    known = influence(runs, ReadingNoise(1e-9, 0.0))
    weights = best_weights(known.square)
    found += vector_rows("compressor at 17,500 rpm: aft weight", weights[0], 15.3, 3, "g", 0.1)
    found += vector_rows("compressor at 17,500 rpm: forward weight", weights[1], 6.6, 113, "g", 0.1)
    left = known.mean @ np.concatenate([[1.0], weights])
    names = ("forward x", "forward y", "aft x", "aft y")
    rows = [
        row
        for name, z, printed in zip(names, left, FEESE_LEFT, strict=True)
        for row in vector_rows(name, z, *printed, "mil", 0.01)
    ]
    found.append(worst(rows, "residual vibration"))
    source = "Kelm, Pavelek, Kelm 2016"
    first, second, trial = (at(*each) for each in FAN)
    runs = [
        BalanceRun("0", np.zeros(1), np.array([first])),
        BalanceRun("1", np.array([trial]), np.array([second])),
    ]
    known = influence(runs, ReadingNoise(1e-9, 0.0))
    found.append(
        within("fan: weight per vibration", 1 / abs(known.mean[0, 1]), 10.4, 0.05, "oz in/mil", kind, source)
    )
    found += vector_rows("fan: weight", best_weights(known.square)[0], 58, 341.9, "oz in", 1, source)
    for grade, (printed, half) in GRADES.items():
        ours = permissible_unbalance(1e-3 * grade, 1.0, 300 / 60) / OUNCE_INCHES_PER_POUND
        why = (
            "the printed value is 1.3 % above 6.3/16 of the one of G 16; it may come from a chart"
            if grade < 16
            else ""
        )
        name = f"permissible unbalance of G {grade:g} at 300 rpm"
        found.append(within(name, ours, printed, half, "oz in/lb", kind, "Feese, Grazier 2004", why))
    return found


METHOD = Method(
    "rotors",
    "Rotors",
    {
        "beams": beams,
        "overhung disc": overhung_disc,
        "ross": of_ross,
        "onset": onset,
        "mendes": mendes,
        "falah": falah,
        "balancing": balancing,
        "not tested": partial(gaps, "rotors"),
    },
)
