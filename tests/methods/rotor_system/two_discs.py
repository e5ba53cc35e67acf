"""The rotor of the independent calculation: two discs, two sleeves, two bearings on pedestals, internal
damping, with its true values. Nodes of the calculation count from 0, its x and y are y and z here.
"""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import yaml

from labpipe.methods.rotor.rig import BearingPlace, RotorRig
from labpipe.methods.rotor.shaft import Disc, Material, Rotor, ShaftElement
from labpipe.methods.rotor_system.build import (
    Built,
    LinearBearing,
    Pedestal,
    RotorSystem,
    Sensors,
    SmallErrors,
    build,
)
from labpipe.methods.rotor_system.evidence import (
    Deflections,
    FreeModes,
    Responses,
    RunUpVectors,
    run_up_whitener,
)
from labpipe.methods.rotor_system.system_file import load_system

ROTOR = Path(__file__).parents[3] / "configs/rotors/two-discs.yaml"

STEEL = Material(7850.0, 2.1e11, 2.1e11 / 2.6, 0.3)
PROBES = ("2 y", "2 z", "10 y", "10 z")
# Unknowns that are not zero in truth: logarithms of factors, unbalance [kg m], phase [rad], mass [5 kg].
TRUTH = {
    "young": -0.015, "mass of disc 1": 0.02, "mass of disc 2": -0.025, "sleeve A": 0.5, "sleeve B": 0.15,
    "left k_yy": 0.2, "left k_zz": -0.15, "left c": 0.3, "pedestal left k": -0.2,
    "right k_yy": -0.25, "right k_zz": 0.1, "right c": -0.2, "pedestal right k": 0.3, "internal damping": 0.4,
    "unbalance 5 re": 0.00015, "unbalance 5 im": -0.0001, "unbalance 10 re": 8e-05,
    "unbalance 10 im": 0.00012,
    "gain run 2 y": 0.01, "gain run 2 z": -0.015, "gain run 10 y": 0.005, "gain run 10 z": 0.02,
    "element 3": 0.012, "element 7": -0.01, "J_t of disc 1": 0.06, "J_t of disc 2": -0.04,
    "left k_yy running": 0.08, "right k_zz running": -0.1, "apparent mass right y": 0.02,
    "phase run 10 y": 0.012,
}  # fmt: skip


def system(pedestals: bool = True) -> RotorSystem:
    """What is declared of the rotor."""
    shaft = Rotor(
        tuple(ShaftElement(0.1, 0.04, STEEL) for _ in range(12)),
        (Disc(5, 12.0, 0.06, 0.11), Disc(10, 9.0, 0.04, 0.07)),
    )
    places = tuple(
        BearingPlace(name, node, None, "linear-bearing") for name, node in (("left", 2), ("right", 12))
    )  # type: ignore[arg-type]
    linear = {
        name: LinearBearing(np.diag(k), 12000.0 * np.eye(2), 0.4 * np.eye(2), 0.5 * np.eye(2), "c")
        for name, k in (("left", (8e6, 1.2e7)), ("right", (9e6, 1.5e7)))
    }
    return RotorSystem(
        RotorRig("two discs", shaft, speed=100.0, bearings=places),
        {STEEL: 0.02},
        (0.03, 0.03),
        {"A": ((4, 5), 0.3, 0.3), "B": ((9, 10), 0.3, 0.3)},
        tuple(Pedestal(name, 8.0, 5e7, 600.0, 0.5) for name in ("left", "right")) if pedestals else (),
        (3e-5, 0.7),
        ((5, 0j, 2e-4), (10, 0j, 2e-4)),
        linear,
    )


# The same rotor on other bearings, as its file says it: oil of one can and clearances hardly known; a seal
# between the discs that may drive whirl or not; magnets whose pull and force per current are hardly known.
OIL = """{{kind: journal-bearing, name: {}, node: {}, diameter: 40 mm, length: 20 mm,
  clearance: 60 um +- 15 %, viscosity: 0.02 Pa.s +- 20 % (source=oil)}}"""
MAGNET = """{{kind: magnetic-bearing, name: {}, node: {}, mass: 17 kg,
  negative_stiffness: 2.5 MN/m +- 10 %, force_per_current: 200 N/A +- 5 %,
  loop: {{controller: [{{form: pid, proportional: 30000, derivative: 60 s, derivative_time: 0.1 ms}}],
    sensor: 1 V/m, amplifier: 1 A/V, bandwidth: 3 kHz, delay: 50 us}}}}"""
SEAL = """{{kind: linear-bearing, name: {}, node: {}, k_yy: 1 MN/m +- 30 %, c: 2 kN.s/m +- 30 %,
  k_cross: 0.5 MN/m +- 0.5 MN/m}}"""
VARIANTS = {"oil": OIL, "magnets": MAGNET, "seal": SEAL}


@cache
def variant(name: str) -> RotorSystem:
    """The rotor on the bearings of that name."""
    file = yaml.safe_load(ROTOR.read_text())
    if name == "seal":
        file["bearings"].append(yaml.safe_load(SEAL.format("seal", 7)))
    else:
        places = (("left", 2), ("right", 12))
        file["bearings"] = [yaml.safe_load(VARIANTS[name].format(*place)) for place in places]
        del file["pedestals"]
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "rotor.yaml"
        path.write_text(yaml.safe_dump(file))
        return load_system(path)


@cache
def built(
    pedestals: bool = True,
    alternative: str = "",
    sensors: bool = True,
    together: float = 0.0,
    bearings: str = "",
) -> Built:
    run = {"run": Sensors(PROBES, 0.02, True, True)} if sensors else {}
    if bearings:
        run["shaker at speed"] = Sensors((), 0.0, True)
    rotor = variant(bearings) if bearings else system(pedestals)
    return build(rotor, SmallErrors(together=together), run, alternative)


def true_values(of: Built) -> np.ndarray:
    return np.array([TRUTH.get(unknown.name, 0.0) for unknown in of.model.unknowns])


def dof(place: str) -> int:
    """Of a place of the calculation, its nodes from 0."""
    node, axis = place.split()
    return 4 * int(node) + "yz".index(axis)


def run_up(of: Built, rpm: np.ndarray, measured: np.ndarray | None = None) -> RunUpVectors:
    """1x vectors at four probes, noise .15 um and slow roll of .3 um in each component."""
    speed = rpm * np.pi / 30
    return RunUpVectors(
        "run",
        speed,
        tuple(dof(place) for place in PROBES),
        np.zeros((rpm.size, 4), complex) if measured is None else measured,
        run_up_whitener(np.full((4, rpm.size), 1.5e-7), 3e-7),
        planes=tuple(of.planes.values()),
        gains=of.gains["run"],
        phases=of.phases["run"],
    )


def four_tests(
    of: Built, values: np.ndarray, rng: np.random.Generator | None, top: float = 2300.0, turning: float = 0.0
) -> list:
    """The four tests of a rotor with these *values*, with noise of *rng*, none without. *turning* [Hz]: it
    does while it is shaken, and it is not bent, since there is no oil film at rest.
    """

    def noise(shape: tuple[int, ...]) -> np.ndarray:
        return np.zeros(shape) if rng is None else rng.standard_normal(shape)

    model = of.model
    blank = np.full(4, 1.0)
    free = FreeModes("hammer", np.arange(1, 5), blank, 0.001 * blank, blank, 0.05 * blank)
    ln, _ = free.predict(model, values)
    ln = ln + np.repeat([0.001, 0.05], 4) * noise((8,))
    free = FreeModes("hammer", np.arange(1, 5), np.exp(ln[:4]), 0.001 * blank, np.exp(ln[4:]), 0.05 * blank)
    omega = 2 * np.pi * np.arange(20.0, 260.0, 10.0)
    outputs = tuple(dof(f"{node} {axis}") for axis in "yz" for node in (2, 4, 9))
    shape = (omega.size, 6, 2)
    cross = np.kron(np.eye(2), np.ones((3, 1)))
    name, spin = ("shaker at speed", 2 * np.pi * turning) if turning else ("shaker", 0.0)
    shaker = Responses(
        name, omega, outputs, (dof("2 y"), dof("2 z")), np.zeros(shape, complex), np.ones(shape), spin=spin
    )
    true, _ = shaker.predict(model, values)
    # 1 % and .0005 1/kg of the accelerance.
    error = np.where(cross > 0, 0.01 * np.abs(true) + 0.0005 / omega[:, None, None] ** 2, np.nan)
    shaker = Responses(
        name, omega, outputs, shaker.inputs,
        true - np.nan_to_num(error) * (noise(shape) + 1j * noise(shape)), error, spin=spin,
    )  # fmt: skip
    run = run_up(of, np.linspace(700.0, top, 17))
    vectors, _, _ = run.readings(model, values)
    slow = 3e-7 * (noise((4,)) + 1j * noise((4,)))
    scatter = 1.5e-7 * (noise(vectors.shape) + 1j * noise(vectors.shape))
    run = run_up(of, np.linspace(700.0, top, 17), vectors + scatter + slow)
    stands = np.where(model.acting("static"), values, 0.0)
    places = () if turning else (dof("4 z"), dof("9 z"))
    forces = np.eye(model.n_dof)[:, list(places)]
    deflection = (
        np.zeros((0, 0))
        if turning
        else model.response(stands, np.zeros(1), np.zeros(1), forces, places)[0][0].real
    )
    spread = 0.015 * np.abs(deflection)
    deflection = deflection + spread * noise(deflection.shape)
    mass = float(np.log(mass_of(of, stands)) + 0.002 * noise((1,))[0])
    static = Deflections("static", places, places, deflection, spread, mass, 0.002)
    return [free, shaker, run, static]


def mass_of(of: Built, values: np.ndarray) -> float:
    """Mass of the rotor [kg]."""
    whole = of.model.matrices(values, 0.0, supported=False).mass
    return float(whole[0 : of.model.n_shaft : 4, 0 : of.model.n_shaft : 4].sum())


def drawn(of: Built, rng: np.random.Generator) -> np.ndarray:
    """A truth drawn from what is declared."""
    return of.model.means + of.model.errors * rng.standard_normal(of.model.means.size)
