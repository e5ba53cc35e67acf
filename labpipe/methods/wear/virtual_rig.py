"""A virtual rotor in journal bearings, healthy or worn, under white noise in y, then in z."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import fft

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, SettingError
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.journal_bearing.kind import Wear
from labpipe.methods.rotor.response import ReducedRotor, reduced_rotor
from labpipe.methods.rotor.rig import RotorRig, worn_place
from labpipe.records.recording import Channel, Recording
from labpipe.records.settings import Settings, StandardDeviations, choice, quantity, section, setting, text
from labpipe.simulate.linear import shaken_rotor
from labpipe.simulate.virtual_rigs import Truth, force_and_displacements, kind_of_recordings

KIND = "virtual-journal-rig"
AXES = ("y", "z")
FILM = ("viscosity", "clearance", "cavitation_pressure")
HEALTHY = (("healthy", Wear()),)
# Lines that are solved at once: the free rotor has four equations per node.
LINES_AT_ONCE = 512


@dataclass(frozen=True)
class JournalNoise(StandardDeviations):
    """Measuring noise, white up to half the sampling rate."""

    displacement: float = quantity("displacement sensors", "m", 1e-6)
    force: float = quantity("force transducer", "N", 0.05)


@dataclass(frozen=True, kw_only=True)
class VirtualJournalRig(Settings):
    """The rotor of a rotor file with a model error, its shaker and its sensors; *rig*: that of `rotor`."""

    kind: str = choice("which virtual rig", (KIND,))
    rotor: str = setting("file", "rotor file, relative to this file", file_kind="rotor", into="rig")
    name: str = text("name of the rig", "Virtual rotor in journal bearings")
    bearing: str = text("name of the worn bearing; default: the last one")
    viscosity_error: float = quantity("true viscosity over the rotor file's, less one", "1", 0.0)
    clearance_error: float = quantity("true clearance over the rotor file's, less one", "1", 0.0)
    cavitation_pressure: float | None = quantity(
        "true pressure at which the films tear; default: the rotor file's", "Pa", None
    )
    states: tuple[tuple[str, Wear], ...] = setting(
        "sections", "states of the worn bearing by name", section=Wear, default=HEALTHY
    )
    cells_around: int = setting("integer", "cells of the oil film around the journal", default=480)
    cells_across: int = setting("integer", "cells of the oil film across the bearing", default=60)
    force: float = quantity("rms force of the shaker", "N", 30.0)
    bandwidth: float = quantity("the force is white up to here", "Hz", 120.0)
    lowest: float = quantity("and from here", "Hz", 0.0)
    sample_rate: float = quantity("sampling rate", "Hz", 256.0)
    duration: float = quantity("length of one run", "s", 60.0)
    unbalance: float = quantity("mass times eccentricity at the force's node", "kg.m", 1e-5)
    noise: JournalNoise = section("measuring noise", JournalNoise, JournalNoise())
    rig: RotorRig | None = None

    def __post_init__(self) -> None:
        assert self.mesh
        self.require_positive("force", "bandwidth", "sample_rate", "duration")
        self.require_not_negative("unbalance")
        if not self.bandwidth < self.sample_rate / 2:
            raise ConfigError(f"bandwidth must lie below half the sampling rate, {self.sample_rate / 2:g} Hz")
        if not 0 <= self.lowest < self.bandwidth:
            raise ConfigError("lowest must lie between 0 Hz and the bandwidth")
        if not self.excited.size:
            what = "no line of a run lies between 'lowest' and 'bandwidth'"
            raise SettingError("duration", what, "a longer one, or a wider band")
        for name in ("viscosity_error", "clearance_error"):
            if not abs(getattr(self, name)) < 0.5:
                raise ConfigError(f"{name} must lie between -50 % and 50 %")
        if self.rig is not None:
            worn_place(self.rig, self.bearing)
            self._check_states()

    def _check_states(self) -> None:
        for state, wear in self.states:
            try:
                true_rig(self, wear.depth, wear.angle)
            except SettingError as error:
                field = "states" if error.field == "wear" else error.field
                raise SettingError(field, f"state '{state}': {error.what}", error.hint) from None

    @property
    def runs(self) -> tuple[str, ...]:
        return tuple(f"{state}-{axis}" for state, _ in self.states for axis in AXES)

    def wear(self, run: str) -> Wear:
        return dict(self.states)[run.rpartition("-")[0]]

    @property
    def n_sample(self) -> int:
        return max(round(self.duration * self.sample_rate), 1)

    @property
    def excited(self) -> FloatArray:
        """Lines (n_line,) [Hz] at which the shaker acts."""
        lines = fft.rfftfreq(self.n_sample, 1 / self.sample_rate)[1:]
        return lines[(lines <= self.bandwidth) & (lines >= self.lowest)]

    @property
    def mesh(self) -> FilmMesh:
        return FilmMesh(self.cells_around, self.cells_across)


def true_rig(virtual: VirtualJournalRig, depth: float, angle: float) -> RotorRig:
    """The true rotor, with a wear of *depth* [m] at *angle* [rad]; ConfigError without a rotor."""
    if virtual.rig is None:
        raise ConfigError("no rotor was read for this virtual rig", hint="name it with rotor:")
    rig = virtual.rig
    for place in rig.bearings:
        if place.is_film:
            film = place.film("wear")
            pressure = virtual.cavitation_pressure
            rig = rig.with_bearings(
                [place.name],
                viscosity=film.viscosity * (1 + virtual.viscosity_error),
                clearance=film.clearance * (1 + virtual.clearance_error),
                cavitation_pressure=film.cavitation_pressure if pressure is None else pressure,
            )
    return rig.with_bearings([worn_place(rig, virtual.bearing).name], wear_depth=depth, wear_angle=angle)


def receptance(rig: RotorRig, frequency: FloatArray, mesh: FilmMesh) -> ComplexArray:
    """H (n, 2, 2) [m/N] in y and z between the rig's nodes at *frequency* (n,) [Hz], above zero."""
    supports = rig.supports(mesh)
    nodes = (*(place.node for place in rig.bearings), rig.force, rig.response)
    parts = [frequency[n : n + LINES_AT_ONCE] for n in range(0, frequency.size, LINES_AT_ONCE)]
    free: list[ReducedRotor] = [reduced_rotor(rig.rotor, nodes, part, rig.omega) for part in parts]
    return np.concatenate([part.on(supports).response(rig.response, rig.force) for part in free])


@lru_cache(maxsize=8)
def _response(virtual: VirtualJournalRig, wear: Wear) -> ComplexArray:
    """H on every excited line, at the shaft speed last, (n_line + 1, 2, 2) [m/N]."""
    rig = true_rig(virtual, wear.depth, wear.angle)
    return receptance(rig, np.append(virtual.excited, rig.speed), virtual.mesh)


def _run(virtual: VirtualJournalRig, name: str, rng: np.random.Generator) -> Recording:
    assert virtual.rig is not None
    n, axis, h = virtual.n_sample, name[-1], _response(virtual, virtual.wear(name))
    spectrum, at_lines = np.zeros(n // 2 + 1, np.complex128), np.zeros((n // 2 + 1, 2), np.complex128)
    first = round(virtual.excited[0] * n / virtual.sample_rate)
    excited = slice(first, first + h.shape[0] - 1)
    spectrum[excited] = rng.standard_normal(h.shape[0] - 1) + 1j * rng.standard_normal(h.shape[0] - 1)
    spectrum *= virtual.force * n / np.sqrt(2 * np.sum(np.abs(spectrum) ** 2))
    at_lines[excited] = h[:-1, :, AXES.index(axis)]
    channels = [
        Channel("f", "force", "input", axis),
        *(Channel(dof, "displacement", "output", dof) for dof in AXES),
    ]
    turning = h[-1], virtual.unbalance, virtual.rig.omega
    return shaken_rotor(virtual, name, channels, spectrum, at_lines, turning, rng)


def truth(virtual: VirtualJournalRig) -> dict[str, Any]:
    rig = true_rig(virtual, 0.0, 0.0)
    bearing = rig.place(virtual.bearing).bearing
    states = {state: {"wear_depth": wear.depth, "wear_angle": wear.angle} for state, wear in virtual.states}
    return {
        **{name: getattr(bearing, name) for name in FILM},
        "loads": {name: list(load) for name, load in rig.static_loads().items()},
        "states": states,
    }


def _parameters(virtual: VirtualJournalRig, runs: Sequence[str]) -> Truth:
    states = dict.fromkeys(virtual.wear(run) for run in runs)
    if len(states) != 1:
        hint = "for example runs: [healthy-y, healthy-z]"
        raise ConfigError("'runs' of one state of wear give one FRF matrix", hint=hint)
    (wear,), true_values = states, truth(virtual)
    film = {name: float(true_values[name]) for name in FILM}
    return {"wear_depth": wear.depth, "wear_angle": wear.angle, **film}


JOURNAL_RIG = kind_of_recordings(
    VirtualJournalRig,
    runs=lambda virtual: virtual.runs,
    record=_run,
    logged=force_and_displacements,
    truth=truth,
    parameters=_parameters,
)
