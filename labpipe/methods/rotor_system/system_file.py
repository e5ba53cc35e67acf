"""Reading what is known of a rotor and how well: a rotor file whose numbers carry uncertainties, with
pedestals, damping that turns with the shaft, and what else is to be estimated.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labpipe.bearings.kinds import LinearBearingSettings
from labpipe.errors import SettingError
from labpipe.methods.rotor.rig import RotorRig
from labpipe.methods.rotor.rotor_file import read_entries, read_rotor
from labpipe.methods.rotor_system.build import Pedestal, RotorSystem, linear_bearing
from labpipe.project.marked_yaml import Marked, load_marked
from labpipe.project.settings_reader import Faults, join, read_settings, shorten_number
from labpipe.records.settings import FileKind, Settings, quantity, setting
from labpipe.records.uncertain import Uncertain, is_uncertain, parse_uncertain
from labpipe.registry import nearest

# What `estimate:` frees, with the standard uncertainty that it has then: of the logarithm, of each part of
# an unbalance [kg m], of a seal's cross-coupled stiffness as a share of its bearing's direct one; of a film's
# inputs (`FILM`) relative to them.
ESTIMATED = {
    "young": 0.02,
    "masses": 0.03,
    "sleeves": 0.3,
    "stiffness": 0.4,
    "damping": 0.5,
    "pedestals": 0.5,
    "cross-coupling": 0.1,
    "clearance": 0.15,
    "viscosity": 0.2,
    "internal": 0.7,
    "unbalance": 2e-4,
}
FILM = ("clearance", "viscosity")
# Numbers of lists and mappings that may carry an uncertainty: section, key, unit.
UNCERTAIN = (
    ("materials", "elastic_modulus", "Pa"),
    ("discs", "mass", "kg"),
    ("sleeves", "stiffening", "1"),
    ("unbalances", "size", "kg.m"),
)


@dataclass(frozen=True)
class PedestalSettings(Settings):
    """One entry of ``pedestals:``: what carries a bearing."""

    bearing: str = setting("text", "name of the bearing")
    mass: float = quantity("that moves with the bearing", "kg")
    stiffness: Uncertain = setting("uncertain", "to ground, in y and z", "N/m")
    damping: float = quantity("to ground", "N.s/m", 0.0)

    def __post_init__(self) -> None:
        self.require_positive("mass", "stiffness")
        self.require_not_negative("damping")


@dataclass(frozen=True)
class InternalSettings(Settings):
    """Entry ``internal`` of ``damping:``."""

    internal: Uncertain = setting(
        "uncertain", "damping that turns with the shaft, C = internal K: 30 us +- 70 %", "s"
    )

    def __post_init__(self) -> None:
        self.require_not_negative("internal")
        if self.internal.std_error and not self.internal.value:
            what = "'internal' of zero has no uncertainty: that is one of its logarithm"
            raise SettingError("internal", what, "30 us +- 70 %")


def load_system(path: Path, overrides: Iterable[str] = ()) -> RotorSystem:
    """The rotor of a file with what is known of it; ConfigErrors with every fault at its place."""
    tree = load_marked(path, overrides)
    faults = Faults(path.parent)
    entries = faults.mapping(tree, "")
    taken = {key: _take(entries.get(key), key, name, unit, faults) for key, name, unit in UNCERTAIN}
    pedestals = read_entries(PedestalSettings, entries.get("pedestals"), "pedestals", faults)
    estimated = _estimates(entries.get("estimate"), faults)
    _free_films(entries.get("bearings"), estimated)
    plain = {key: node for key, node in entries.items() if key not in ("pedestals", "estimate")}
    internal = Uncertain(0.0)
    damping = plain.get("damping")
    if damping is not None and isinstance(damping.content, dict) and "internal" in damping.content:
        rest = dict(damping.content)
        friction = Marked({"internal": rest.pop("internal")}, damping.where, damping.key_where)
        settings = read_settings(InternalSettings, friction, "damping", faults)
        internal = internal if settings is None else settings.internal
        plain["damping"] = Marked(rest, damping.where, damping.key_where)
    rig = read_rotor(Marked(plain, tree.where), path.stem, faults)
    system = None
    if rig is not None:
        bearings, carried = [place.name for place in rig.bearings], set[str]()
        for node, pedestal in pedestals:
            name = pedestal.bearing
            if name not in bearings:
                faults.add(node, "pedestals", f"no bearing '{name}'", nearest(name, bearings))
            if name in carried:
                faults.add(node, "pedestals", f"a second one of bearing '{name}'", "one carries a bearing")
            carried.add(name)
        stated = [pedestal for _, pedestal in pedestals]
        system = _system(rig, entries, taken, stated, internal, estimated, faults)
        numbers = {key: list(of_key.values()) for key, of_key in taken.items()}
        numbers |= {"pedestals": [pedestal.stiffness for pedestal in stated], "damping": [internal]}
        # Only the models of bearings know one error of several numbers
        named = [
            (key, number.source) for key, several in numbers.items() for number in several if number.source
        ]
        of_models = set[str]()
        for place in system.rig.bearings:
            sources = [entry.uncertainty.source for entry in place.uncertainties]
            if place.name in system.linear:
                named += [("bearings", source) for source in sources]
            else:
                of_models.update(sources)
        uses = Counter(source for _, source in named)
        for key, source in dict.fromkeys(named):
            if uses[source] > 1 or source in of_models:
                what = f"source={source}: only numbers of bearing models can have one error in common"
                faults.add(entries[key], key, what, "leave it out")
        _check_freed(system, estimated, entries.get("estimate", tree), faults)
    faults.raise_any()
    assert system is not None
    return system


def _check_freed(system: RotorSystem, estimated: tuple[str, ...], node: Marked, faults: Faults) -> None:
    rig = system.rig
    freed = {
        "young": True,
        "masses": rig.rotor.discs,
        "sleeves": rig.rotor.sleeves,
        "pedestals": system.pedestals,
        "internal": system.internal[0],
        "unbalance": rig.unbalances,
        **dict.fromkeys(FILM, any(place.is_film for place in rig.bearings)),
    }
    for name in estimated:
        if name in ESTIMATED and not freed.get(name, system.linear):
            faults.add(node, "estimate", f"the rotor has nothing that '{name}' frees")


def _listing(node: Marked | None) -> list[Marked]:
    return list(node.content) if node is not None and isinstance(node.content, list) else []


def _take(node: Marked | None, key: str, name: str, unit: str, faults: Faults) -> dict[str, Uncertain]:
    """Numbers with an uncertainty, by the name or number (from 1) of their entry; in the tree their values
    stand alone after that.
    """
    if node is None or not isinstance(node.content, dict | list):
        return {}
    entries, taken = node.content, {}
    if isinstance(entries, list):
        entries = {str(n): entry for n, entry in enumerate(entries, 1)}
    for label, entry in entries.items():
        if not isinstance(entry.content, dict) or name not in entry.content:
            continue
        number = shorten_number(entry.content[name])
        if not is_uncertain(number.text):
            continue
        with faults.of_unit(number, join(key, label, name)):
            taken[label] = parse_uncertain(number.text, unit)
            text = f"{taken[label].value!r} {'' if unit == '1' else unit}".strip()
            entry.content[name] = Marked(text, number.where, number.key_where, text)
    return taken


def _estimates(node: Marked | None, faults: Faults) -> tuple[str, ...]:
    if node is None:
        return ()
    names = [entry.text for entry in node.content] if isinstance(node.content, list) else [node.text]
    for name in names:
        if name not in ESTIMATED:
            faults.add(node, "estimate", f"unknown name '{name}'", nearest(name, ESTIMATED))
    return tuple(names)


def _free_films(node: Marked | None, estimated: tuple[str, ...]) -> None:
    """What `estimate:` frees of oil films gets its uncertainty in their entries, where it has none."""
    for entry in _listing(node):
        content = entry.content if isinstance(entry.content, dict) else {}
        if "kind" not in content or content["kind"].text != "journal-bearing":
            continue
        for name in FILM:
            number = content.get(name)
            if name in estimated and number is not None and isinstance(number.content, str):
                text = number.text if is_uncertain(number.text) else f"{number.text} +- {ESTIMATED[name]:.0%}"
                content[name] = Marked(text, number.where, number.key_where, text)


def _relative(number: Uncertain | None) -> float:
    return number.std_error / abs(number.value) if number is not None and number.value else 0.0


def _system(
    rig: RotorRig,
    entries: Mapping[str, Marked],
    taken: Mapping[str, Mapping[str, Uncertain]],
    pedestals: list[PedestalSettings],
    internal: Uncertain,
    estimated: tuple[str, ...],
    faults: Faults,
) -> RotorSystem:
    def free(name: str, error: float) -> float:
        return error or (ESTIMATED[name] if name in estimated else 0.0)

    usual = [free(name, 0.0) for name in ("stiffness", "damping", "cross-coupling")]
    materials = {element.material for element in rig.rotor.elements}
    young = {of: free("young", _relative(taken["materials"].get(of.name))) for of in materials}
    discs = [taken["discs"].get(str(n)) for n in range(1, len(rig.rotor.discs) + 1)]
    masses = tuple(free("masses", _relative(mass)) for mass in discs)
    unbalances: dict[int, tuple[complex, float]] = {}
    for n, part in enumerate(rig.unbalances, 1):
        error = free("unbalance", taken["unbalances"].get(str(n), Uncertain(0.0)).std_error)
        mean, before = unbalances.get(part.node, (0j, 0.0))
        mean += part.size * complex(np.exp(1j * part.phase))
        unbalances[part.node] = mean, float(np.hypot(before, error))
    return RotorSystem(
        rig,
        young,
        masses,
        _sleeves(rig, entries.get("sleeves"), taken["sleeves"], free("sleeves", 0.0), faults),
        tuple(
            Pedestal(
                pedestal.bearing,
                pedestal.mass,
                pedestal.stiffness.value,
                pedestal.damping,
                free("pedestals", _relative(pedestal.stiffness)),
            )
            for pedestal in pedestals
        ),
        (internal.value, free("internal", _relative(internal))),
        tuple((node, *unbalance) for node, unbalance in unbalances.items()),
        {
            place.name: linear_bearing(place, settings, *usual)
            for place in rig.bearings
            if isinstance(settings := getattr(place.bearing, "settings", None), LinearBearingSettings)
        },
    )


def _sleeves(
    rig: RotorRig, node: Marked | None, taken: Mapping[str, Uncertain], default: float, faults: Faults
) -> dict[str, tuple[tuple[int, ...], float, float]]:
    """Sleeves by name, their elements, ln of the stiffening and its uncertainty: the *default* where no
    sleeve of that name states one.
    """
    sleeves: dict[str, tuple[tuple[int, ...], float, float]] = {}
    for number, (entry, ring) in enumerate(zip(_listing(node), rig.rotor.sleeves, strict=True), 1):
        name = entry.content["name"].text if "name" in entry.content else str(number)
        mean, error = float(np.log(ring.stiffening)), _relative(taken.get(str(number)))
        elements, other, before = sleeves.get(name, ((), mean, error))
        if other != mean or (error and before and not np.isclose(error, before)):
            what = f"a second stiffening of sleeves '{name}'"
            faults.add(entry, "sleeves", what, "sleeves of one name have one")
        sleeves[name] = ((*elements, ring.element), mean, error or before)
    return {name: (elements, mean, error or default) for name, (elements, mean, error) in sleeves.items()}


ROTOR_SYSTEM_FILE = FileKind(load_system)
