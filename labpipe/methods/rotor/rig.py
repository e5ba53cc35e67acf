"""A rotor on its bearings: shaft, bearings with their static loads, speed, and where it is excited and
measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from itertools import zip_longest

import numpy as np

from labpipe.bearings.kinds import Bearing, BearingCoefficients, LinearBearingSettings, OperatingPoint
from labpipe.errors import ConfigError
from labpipe.methods.journal_bearing import bearing as journal
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.shaft import NodeSupport, Rotor, bearing_loads
from labpipe.records.uncertain import Uncertainty
from labpipe.registry import nearest


@dataclass(frozen=True)
class UncertainBearing:
    """A bearing with one number a standard uncertainty *above* its *value* [its unit], and *below* it.
    *uncertainty* of the number, *key*: its entry.
    """

    uncertainty: Uncertainty
    above: Bearing
    below: Bearing
    value: float = 0.0
    key: str = ""


@dataclass(frozen=True)
class BearingPlace:
    """A bearing on a node of the rotor; *kind*: that of its file. *uncertainties* of the numbers in its
    entry.
    """

    name: str
    node: int
    bearing: Bearing
    kind: str = "journal-bearing"
    uncertainties: tuple[UncertainBearing, ...] = ()

    @property
    def is_film(self) -> bool:
        """True for an oil film, whose parameters can be changed and estimated."""
        return isinstance(self.bearing, journal.JournalBearing)

    @property
    def is_seal(self) -> bool:
        """True for a linear bearing with the cross-coupling of a seal, which carries no weight."""
        settings = getattr(self.bearing, "settings", None)
        return isinstance(settings, LinearBearingSettings) and settings.k_cross is not None

    def with_film(self, method: str, changes: Mapping[str, float]) -> BearingPlace:
        """The place with other numbers in its oil film, uncertain or not. A number that is changed has no
        uncertainty any more.
        """

        def change(bearing: Bearing) -> journal.JournalBearing:
            return replace(replace(self, bearing=bearing).film(method), **changes)

        ends = [replace(e, above=change(e.above), below=change(e.below)) for e in self.uncertainties]
        uncertain = tuple(entry for entry in ends if entry.above != entry.below)
        return replace(self, bearing=change(self.bearing), uncertainties=uncertain)

    def support(
        self, load: tuple[float, float], speed: float, mesh: FilmMesh = journal.DEFAULT_MESH
    ) -> NodeSupport:
        """The bearing as springs and dampers under a *load* in y and z [N], its motion at the frequency of
        the *speed* [rad/s]; *mesh*: of an oil film.
        """
        if isinstance(self.bearing, journal.JournalBearing):
            return self.springs(journal.journal_equilibrium(self.bearing, load, speed, mesh))
        return self.springs(self.bearing.at(OperatingPoint(load, speed, speed)))

    def springs(self, at: journal.JournalEquilibrium | BearingCoefficients) -> NodeSupport:
        """Coefficients of the bearing as springs and dampers on its node."""
        return NodeSupport(self.node, at.stiffness, at.damping)

    def film(self, method: str) -> journal.JournalBearing:
        """The journal bearing. ConfigError that names the *method* which needs its oil film, where there is
        none.
        """
        if isinstance(self.bearing, journal.JournalBearing):
            return self.bearing
        raise ConfigError(
            f"{method} needs an oil film, bearing '{self.name}' is a {self.kind}",
            hint="name a journal-bearing",
        )


@dataclass(frozen=True)
class Unbalance:
    """Mass times eccentricity [kg m] on a node; *phase* [rad] from the keyphasor, with the spin."""

    node: int
    size: float
    phase: float = 0.0


@dataclass(frozen=True)
class RotorRig:
    """A rotor file: *speed* [Hz]; *loads*: static forces (node, in y, in z) [N] beside the weight; *force*,
    *response*: nodes. ConfigError where bearings, loads or unbalances sit on no node, or two bearings have
    one name or node.
    """

    name: str
    rotor: Rotor
    _: KW_ONLY
    speed: float
    bearings: tuple[BearingPlace, ...]
    loads: tuple[tuple[int, float, float], ...] = ()
    unbalances: tuple[Unbalance, ...] = ()
    force: int = 1
    response: int = 1

    def __post_init__(self) -> None:
        if self.speed < 0 or (self.speed == 0 and any(place.is_film for place in self.bearings)):
            raise ConfigError(f"speed: oil films need a speed above zero, not {self.speed:g} Hz")
        if len(self.bearings) < 2:
            raise ConfigError("bearings: a rotor rests on at least two", hint="name each with its node")
        for label in ("name", "node"):
            if len({getattr(place, label) for place in self.bearings}) < len(self.bearings):
                raise ConfigError(f"bearings: two bearings have one {label}")
        places = [(f"bearing '{place.name}'", place.node) for place in self.bearings]
        places += [("a load", node) for node, _, _ in self.loads] + [
            ("an unbalance", part.node) for part in self.unbalances
        ]
        for label, node in [*places, ("the force", self.force), ("the response", self.response)]:
            self.rotor.check_node(node, label)

    @property
    def omega(self) -> float:
        """Spin speed [rad/s]."""
        return 2 * np.pi * self.speed

    def place(self, name: str) -> BearingPlace:
        """The bearing of that name; the last one without a name. ConfigError with the nearest known name on a
        miss.
        """
        if not name:
            return self.bearings[-1]
        by_name = {bearing.name: bearing for bearing in self.bearings}
        if name not in by_name:
            raise ConfigError(f"no bearing '{name}' in {self.name}", hint=nearest(name, by_name))
        return by_name[name]

    @property
    def amounts(self) -> dict[int, complex]:
        """Unbalance [kg m] by node, complex with its angle."""
        amounts: dict[int, complex] = {}
        for part in self.unbalances:
            amounts[part.node] = amounts.get(part.node, 0j) + part.size * np.exp(1j * part.phase)
        return amounts

    def static_loads(self) -> dict[str, tuple[float, float]]:
        """Load of every bearing by name, in y and z [N]; none of a seal beside two that carry."""
        forces: dict[int, tuple[float, float]] = {}
        for node, y, z in self.loads:
            before = forces.get(node, (0.0, 0.0))
            forces[node] = (before[0] + y, before[1] + z)
        carrying = [place for place in self.bearings if not place.is_seal]
        carrying = carrying if len(carrying) > 1 else list(self.bearings)
        reactions = bearing_loads(self.rotor, [place.node for place in carrying], forces)
        # Rounding would turn a vertical load by 1e-13 rad, and tables of coefficients could not be shared.
        scale = 1e-9 * float(np.abs(reactions).max())
        return dict.fromkeys([place.name for place in self.bearings], (0.0, 0.0)) | {
            place.name: (float(y) if abs(y) > scale else 0.0, float(z) if abs(z) > scale else 0.0)
            for place, (y, z) in zip(carrying, reactions, strict=True)
        }

    def supports(self, mesh: FilmMesh = journal.DEFAULT_MESH) -> list[NodeSupport]:
        """The bearings as springs and dampers, their motion at the frequency of the rig's speed; *mesh*: of
        oil films.
        """
        loads = self.static_loads()
        return [place.support(loads[place.name], self.omega, mesh) for place in self.bearings]

    def at_speed(self, speed: float) -> RotorRig:
        """The same rig at another speed [Hz]."""
        return replace(self, speed=speed)

    @property
    def sources(self) -> tuple[Uncertainty, ...]:
        """The uncertainties in the bearings' entries, each source once."""
        uncertainties: dict[str, Uncertainty] = {}
        for place in self.bearings:
            for entry in place.uncertainties:
                uncertainties.setdefault(entry.uncertainty.source, entry.uncertainty)
        return tuple(uncertainties.values())

    def ends(self, source: str) -> list[tuple[RotorRig, RotorRig]]:
        """The rig with a number of a *source* in every bearing a standard uncertainty above, and below; once
        for each that a bearing has, whose changes add up.
        """
        rigs = []
        of_source = (
            [entry for entry in place.uncertainties if entry.uncertainty.source == source]
            for place in self.bearings
        )
        for entries in zip_longest(*of_source):
            pairs = list(zip(self.bearings, entries, strict=True))
            above = [replace(place, bearing=entry.above) if entry else place for place, entry in pairs]
            below = [replace(place, bearing=entry.below) if entry else place for place, entry in pairs]
            rigs.append((replace(self, bearings=tuple(above)), replace(self, bearings=tuple(below))))
        return rigs

    def with_bearings(self, names: Iterable[str] = (), **changes: float) -> RotorRig:
        """The rig with *changes* (wear_depth, viscosity, ...) in the oil films of these *names*; in all,
        where none is named. ConfigError for a bearing without an oil film.
        """
        names = tuple(names) or tuple(place.name for place in self.bearings if place.is_film)
        chosen = [self.place(name) for name in names]
        purpose = f"a change of {', '.join(changes)}"
        places = (place.with_film(purpose, changes) if place in chosen else place for place in self.bearings)
        return replace(self, bearings=tuple(places))


def worn_place(rig: RotorRig, name: str) -> BearingPlace:
    """The worn bearing by its name, the last one without a name. ConfigError where there is none, or none
    with an oil film.
    """
    try:
        place = rig.place(name)
        place.film("wear")
    except ConfigError as error:
        error.field = "bearing" if name else "rotor"
        raise
    return place
