"""A virtual rig of run-ups: a flexible shaft in pinned ends on one loaded journal bearing that differs from
the rotor file's in one of three ways (TRUTHS); speeds and noise are chosen here, the loads are printed by
Falah and Khorshid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, SettingError
from labpipe.methods.rotor.pinned import CoefficientsAtSpeed
from labpipe.methods.rotor.response import GROWTH_TOLERANCE
from labpipe.methods.run_ups.joint import family_about
from labpipe.methods.run_ups.records import RunUp, Shaker
from labpipe.methods.run_ups.rotor import BOUND, RunUpRotor, as_eight, as_matrices
from labpipe.methods.run_ups.run_up_csv import write_run_up_csv
from labpipe.records.settings import Settings, choice, flag, integer, quantity, section, setting, settings_of
from labpipe.records.uncertain import Uncertain
from labpipe.simulate import virtual_rigs

KIND = "virtual-unbalance-rig"
# factors: every coefficient times a smooth field of its own over load and speed; inside: the family of the
# joint fit; outside: not.
TRUTHS = ("factors", "inside", "outside")
LOWEST_FACTOR, HIGHEST_FACTOR = 0.72, 1.27
# Parameters of the truth inside the family, logarithms as in FilmFamily.
INSIDE = np.array([-0.15, -0.2, 0.05, 0.03, 0.06, -0.05, 0.04, -0.07, -0.05, 0.06, -0.03, 0.07])
# Pound-force: the loads are printed in pounds.
POUND = 4.4482216
MOST_SPEEDS = 1000


@dataclass(frozen=True)
class RunUpNoise(Settings):
    """Standard deviations of readings: relative for amplitude and threshold."""

    amplitude: float = quantity("of the amplitude itself", "1", 0.01)
    phase: float = quantity("of the phase", "rad", float(np.deg2rad(1)))
    threshold: float = quantity("of the threshold speed itself", "1", 0.002)

    def __post_init__(self) -> None:
        # Fits weigh by it.
        self.require_positive(*settings_of(RunUpNoise))


@dataclass(frozen=True, kw_only=True)
class VirtualUnbalanceRig(Settings):
    """The rotor of a rotor file, with its unbalances, and a model error; *rig*: contents of `rotor`. Entries
    marked 'outside' belong to the truth of that name.
    """

    kind: str = choice("which virtual rig", (KIND,))
    rotor: str = setting(
        "file", "rotor file with pins, relative to this file", file_kind="run-up-rotor", into="rig"
    )
    name: str = setting("text", "name of the rig", default="Virtual unbalance rig")
    truth: str = choice("how the bearing differs from the rotor file's", TRUTHS, "outside")
    viscosity_error: float = quantity("outside: true viscosity over the rotor file's, less one", "1", -0.15)
    clearance_error: float = quantity("outside: true clearance over the rotor file's, less one", "1", 0.05)
    groove_width: float = quantity("outside: true width of the grooves", "rad", float(np.deg2rad(30)))
    heating: float = quantity(
        "outside: viscosity lost at the highest speed, going with the speed squared", "1", 0.1
    )
    loads: tuple[float, ...] = setting(
        "values",
        "static loads of the run-ups",
        "N",
        tuple(POUND * pounds for pounds in (0.823, 1.321, 1.817, 2.316)),
    )
    held_out: float = quantity("load of the run-up that no fit sees", "N", 3.808 * POUND)
    speeds: tuple[float, float] = setting("band", "range of speeds", "Hz", (400 / 60, 3000 / 60))
    count: int = integer("number of speeds", 27)
    second_unbalance: bool = flag("also a run-up of every load with the unbalance at the last plane alone")
    shaker: bool = flag("also a run-up of every load under a force that does not turn")
    shaker_force: float = quantity("amplitude of that force, along x at the first plane", "N", 2.0)
    shaker_ratio: float = quantity("its frequency over the shaft's", "1", 0.95)
    noise: RunUpNoise = section("measuring noise", RunUpNoise, RunUpNoise())
    rig: RunUpRotor | None = None

    def __post_init__(self) -> None:
        if self.rig is not None and not self.rig.unbalances:
            raise SettingError("rotor", "the rotor has no unbalances", "add unbalances: to the rotor file")
        if not 2 <= self.count <= MOST_SPEEDS or not 0 < self.speeds[0] < self.speeds[1]:
            raise ConfigError(f"a run-up has 2 to {MOST_SPEEDS} speeds that rise from above zero")
        self.require_positive("loads", "held_out")
        if not max(abs(self.viscosity_error), abs(self.clearance_error)) < 0.5 or not 0 <= self.heating < 0.5:
            raise ConfigError(
                "viscosity_error and clearance_error lie between -50 % and 50 %, heating between 0 and 50 %"
            )
        self.require_positive("shaker_force", "shaker_ratio")

    @property
    def omega(self) -> FloatArray:
        """Speeds (n_speed,) [rad/s]."""
        return 2 * np.pi * np.linspace(*self.speeds, self.count)

    @property
    def nominal(self) -> RunUpRotor:
        """The rotor file's rotor, searched over its run-ups unless it says where; ConfigError without one."""
        if self.rig is None:
            raise ConfigError("no rotor was read for this virtual rig", hint="name it with rotor:")
        if self.rig.speeds is not None:
            return self.rig
        return replace(self.rig, speeds=(float(self.omega[0]), float(self.omega[-1])))

    @property
    def load_of_run(self) -> dict[str, float]:
        """Load [N] of every run by its name."""
        by_name = {f"load-{number}": load for number, load in enumerate(self.loads, 1)}
        extra = {f"{name}-second": load for name, load in by_name.items()} if self.second_unbalance else {}
        extra |= {f"{name}-shaker": load for name, load in by_name.items()} if self.shaker else {}
        return by_name | {"held-out": self.held_out} | extra


def true_coefficients(virtual: VirtualUnbalanceRig, load: float) -> CoefficientsAtSpeed:
    """K and C (n_speed, 2, 2) of the true bearing, over speed [rad/s] under a *load* [N]."""
    if virtual.truth == "factors":
        loads = (min(*virtual.loads, virtual.held_out), max(*virtual.loads, virtual.held_out))
        speeds = (float(virtual.omega[0]), float(virtual.omega[-1]))

        def coefficients(speed: FloatArray) -> tuple[FloatArray, FloatArray]:
            start = as_eight(*virtual.nominal.start_coefficients(load, speed))
            return as_matrices(start * smooth_factors(load, speed, loads, speeds))

        return coefficients
    if virtual.truth == "inside":
        return family_about(virtual.nominal, virtual.loads, "a virtual run-up").at_load(INSIDE, load)
    return _outside(virtual, load)


def smooth_factors(
    load: float, speed: FloatArray, loads: tuple[float, float], speeds: tuple[float, float]
) -> FloatArray:
    """Of the eight coefficients (n_speed, 8) [-], within LOWEST_FACTOR and HIGHEST_FACTOR: half a wave to one
    over each range, the phases fixed by the golden ratio. Equation (sim-factors).
    """
    u = (np.asarray(speed) - speeds[0]) / (speeds[1] - speeds[0])
    # One load alone lies at the lower end.
    v = (load - loads[0]) / ((loads[1] - loads[0]) or 1.0)
    phase = 2 * np.pi * np.mod(np.arange(1, 25) * 0.6180339887, 1).reshape(3, 8)
    wave = (
        np.cos(1.5 * np.pi * u[:, None] + phase[0])
        + np.cos(np.pi * v + phase[1])
        + np.cos(np.pi * (u[:, None] - v) + phase[2])
    ) / 3
    return (HIGHEST_FACTOR + LOWEST_FACTOR) / 2 + (HIGHEST_FACTOR - LOWEST_FACTOR) / 2 * wave


def _outside(virtual: VirtualUnbalanceRig, load: float) -> CoefficientsAtSpeed:
    film = virtual.nominal.place.film("a virtual run-up")
    clearance = film.clearance * (1 + virtual.clearance_error)
    highest = 2 * np.pi * virtual.speeds[1]

    def coefficients(speed: FloatArray) -> tuple[FloatArray, FloatArray]:
        thinner = (1 + virtual.viscosity_error) * (
            1 - virtual.heating * np.minimum(np.asarray(speed) / highest, 1.2) ** 2
        )
        # The viscosity enters by the Sommerfeld number alone: speeds are scaled in its place, damping back.
        bearing = replace(film, clearance=clearance, groove_width=virtual.groove_width)
        rig = replace(virtual.nominal, place=replace(virtual.nominal.place, bearing=bearing), tabulated=None)
        stiffness, damping = rig.start_coefficients(load, np.asarray(speed) * thinner)
        return stiffness, damping * thinner[..., None, None]

    return coefficients


def run_ups(virtual: VirtualUnbalanceRig, seed: int, names: Sequence[str] | None = None) -> tuple[RunUp, ...]:
    """The named runs, or all, with independent noise, at the speeds where the rotor is stable."""
    chosen = virtual_rigs.chosen_runs(virtual, names)
    return tuple(_run(virtual, name, virtual_rigs.generator(seed, name)) for name in chosen)


def _run(virtual: VirtualUnbalanceRig, name: str, rng: np.random.Generator) -> RunUp:
    rig, load = virtual.nominal, virtual.load_of_run[name]
    coefficients = true_coefficients(virtual, load)
    speed = virtual.omega
    speed = speed[rig.stability.growth(speed, *coefficients(speed)) <= GROWTH_TOLERANCE]
    if speed.size == 0:
        raise ConfigError(f"the rotor is unstable at every speed of run '{name}'", hint="lower the speeds")
    shape = (speed.size, len(rig.planes), 2)
    excitation = _excitation(virtual, name)
    exact = rig.condense(speed, *excitation).response(*coefficients(speed)).reshape(shape)
    noise = virtual.noise
    noisy = exact * (1 + noise.amplitude * rng.standard_normal(shape))
    noisy = noisy * np.exp(1j * noise.phase * rng.standard_normal(shape))
    return RunUp(
        name,
        load,
        speed,
        rig.plane_names,
        noisy,
        amplitude_error=noise.amplitude * np.abs(noisy),
        phase_error=np.full(shape, noise.phase),
        unbalance=excitation[0],
        shaker=excitation[1],
        threshold=_threshold(virtual, name, coefficients, rng),
    )


def _excitation(virtual: VirtualUnbalanceRig, name: str) -> tuple[dict[str, complex], Shaker | None]:
    rig = virtual.nominal
    if name.endswith("-shaker"):
        return {}, Shaker(rig.plane_names[0], virtual.shaker_force, 0.0, virtual.shaker_ratio)
    if name.endswith("-second"):
        return {rig.plane_names[-1]: max(np.abs(list(rig.known_unbalance.values()))) + 0j}, None
    return rig.known_unbalance, None


def _threshold(
    virtual: VirtualUnbalanceRig, name: str, coefficients: CoefficientsAtSpeed, rng: np.random.Generator
) -> Uncertain | None:
    if name.endswith(("-second", "-shaker")):
        return None
    exact = virtual.nominal.threshold(coefficients)
    if exact is None:
        return None
    error = virtual.noise.threshold
    return Uncertain(exact * (1 + error * rng.standard_normal()), exact * error)


def truth(virtual: VirtualUnbalanceRig) -> dict[str, Any]:
    rig, loads = virtual.nominal, {}
    for name, load in virtual.load_of_run.items():
        if name.endswith(("-second", "-shaker")):
            continue
        coefficients = true_coefficients(virtual, load)
        eight = as_eight(*coefficients(virtual.omega))
        loads[name] = {
            "load": load,
            "critical_speed": rig.critical_speed(coefficients),
            "resonance_speed": rig.resonance(coefficients),
            "threshold": rig.threshold(coefficients),
            "coefficients": [[float(f"{value:.6g}") for value in row] for row in eight],
        }
    bounds = {"inside": dict(zip(("logarithms", "bounds"), (INSIDE.tolist(), BOUND.tolist()), strict=True))}
    return {
        "kind": virtual.truth,
        "speeds": virtual.omega.tolist(),
        **bounds.get(virtual.truth, {}),
        "loads": loads,
    }


def _simulate(virtual: VirtualUnbalanceRig, seed: int, runs: Sequence[str]) -> virtual_rigs.Simulation:
    files = {run.name: virtual_rigs.LoggedFile(run, write_run_up_csv) for run in run_ups(virtual, seed, runs)}
    return virtual_rigs.Simulation(files, {"truth": truth(virtual)})


def _parameters(virtual: VirtualUnbalanceRig, runs: Sequence[str]) -> virtual_rigs.Truth:
    coefficients = true_coefficients(virtual, virtual.load_of_run[runs[0]])
    speeds = {"critical_speed": virtual.nominal.critical_speed(coefficients)}
    threshold = virtual.nominal.threshold(coefficients)
    return speeds if threshold is None else {**speeds, "threshold": threshold}


UNBALANCE_RIG = virtual_rigs.VirtualRigKind(
    settings=VirtualUnbalanceRig,
    runs=lambda virtual: tuple(virtual.load_of_run),
    simulate=_simulate,
    parameters=_parameters,
)
