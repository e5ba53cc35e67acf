"""Reading what is known of a rotor and how well: a rotor file whose numbers carry uncertainties, with
pedestals, damping that turns with the shaft, and what else is to be estimated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import SettingError
from labpipe.methods.rotor.linear_bearing import LinearBearingSettings
from labpipe.methods.rotor.rig import BearingPlace, RotorRig
from labpipe.methods.rotor.rotor_file import read_entries, read_rotor
from labpipe.methods.rotor_system.build import COEFFICIENTS, LinearBearing, Pedestal, RotorSystem
from labpipe.project.marked_yaml import Marked, load_marked
from labpipe.project.settings_reader import Faults, join, read_settings
from labpipe.quantities import UnitError
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
    stiffness: Uncertain = setting("uncertain", "to ground, in y and z", unit="N/m")
    damping: float = quantity("to ground", "N.s/m", 0.0)

    def __post_init__(self) -> None:
        self.require_positive("mass", "stiffness")
        self.require_not_negative("damping")


@dataclass(frozen=True)
class InternalSettings(Settings):
    """Entry ``internal`` of ``damping:``."""

    internal: Uncertain = setting(
        "uncertain", "damping that turns with the shaft, C = internal K: 30 us +- 70 %", unit="s"
    )

    def __post_init__(self) -> None:
        self.require_not_negative("internal")


def load_system(path: Path, overrides: Iterable[str] = ()) -> RotorSystem:
    """The rotor of a file with what is known of it; ConfigErrors with every fault at its place."""
    tree = load_marked(path, overrides)
    faults = Faults(path.parent)
    entries = faults.mapping(tree, "")
    taken = {key: _take(entries.get(key), key, name, unit, faults) for key, name, unit in UNCERTAIN}
    pedestals = read_entries(PedestalSettings, entries.get("pedestals"), "pedestals", faults)
    internal = _internal(entries.get("damping"), faults)
    estimated = _estimates(entries.get("estimate"), faults)
    _free_films(entries.get("bearings"), estimated)
    plain = {key: node for key, node in entries.items() if key not in ("pedestals", "estimate")}
    if "damping" in plain and isinstance(plain["damping"].content, dict):
        rest = {key: node for key, node in plain["damping"].content.items() if key != "internal"}
        plain["damping"] = Marked(rest, plain["damping"].where, plain["damping"].key_where)
    rig = read_rotor(Marked(plain, tree.where), path.stem, faults)
    if rig is not None:
        bearings, carried = [place.name for place in rig.bearings], set[str]()
        for node, pedestal in pedestals:
            name = pedestal.bearing
            if name not in bearings:
                faults.add(node, "pedestals", f"no bearing '{name}'", nearest(name, bearings))
            if name in carried:
                faults.add(node, "pedestals", f"a second one of bearing '{name}'", "one carries a bearing")
            carried.add(name)
    faults.raise_any()
    assert rig is not None
    return _system(rig, entries, taken, [pedestal for _, pedestal in pedestals], internal, estimated)


def _listing(node: Marked | None) -> list[Marked]:
    return list(node.content) if node is not None and isinstance(node.content, list) else []


def _take(node: Marked | None, key: str, name: str, unit: str, faults: Faults) -> dict[str, Uncertain]:
    """Numbers with an uncertainty, by the name or number (from 1) of their entry; in the tree their values
    stand alone after that.
    """
    if node is None or not isinstance(node.content, dict | list):
        return {}
    entries = (
        node.content.items()
        if isinstance(node.content, dict)
        else ((str(n), entry) for n, entry in enumerate(node.content, 1))
    )
    taken = {}
    for label, entry in entries:
        number = entry.content.get(name) if isinstance(entry.content, dict) else None
        if number is None or not is_uncertain(number.text):
            continue
        try:
            taken[label] = parse_uncertain(number.text, unit)
        except UnitError as error:
            faults.add_unit(number, join(key, label, name), error)
            continue
        text = f"{taken[label].value!r} {'' if unit == '1' else unit}".strip()
        entry.content[name] = Marked(text, number.where, number.key_where, text)
    return taken


def _internal(node: Marked | None, faults: Faults) -> tuple[float, float]:
    if node is None or not isinstance(node.content, dict) or "internal" not in node.content:
        return 0.0, 0.0
    entry = Marked({"internal": node.content["internal"]}, node.where, node.key_where)
    settings = read_settings(InternalSettings, entry, "damping", faults)
    return (0.0, 0.0) if settings is None else (settings.internal.value, _relative(settings.internal))


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
        for name in FILM:
            number = entry.content.get(name) if isinstance(entry.content, dict) else None
            if name in estimated and number is not None and isinstance(number.content, str):
                text = number.text if is_uncertain(number.text) else f"{number.text} +- {ESTIMATED[name]:.0%}"
                entry.content[name] = Marked(text, number.where, number.key_where, text)


def _relative(number: Uncertain | None) -> float:
    return number.std_error / abs(number.value) if number is not None and number.value else 0.0


def _system(
    rig: RotorRig,
    entries: Mapping[str, Marked],
    taken: Mapping[str, Mapping[str, Uncertain]],
    pedestals: list[PedestalSettings],
    internal: tuple[float, float],
    estimated: tuple[str, ...],
) -> RotorSystem:
    def free(name: str, error: float) -> float:
        return error or (ESTIMATED[name] if name in estimated else 0.0)

    usual = [free(name, 0.0) for name in ("stiffness", "damping", "cross-coupling")]
    young = {
        material: free("young", _relative(taken["materials"].get(material.name)))
        for material in {element.material for element in rig.rotor.elements}
    }
    masses = tuple(
        free("masses", _relative(taken["discs"].get(str(n)))) for n in range(1, len(rig.rotor.discs) + 1)
    )
    return RotorSystem(
        rig,
        young,
        masses,
        _sleeves(rig, entries.get("sleeves"), taken["sleeves"], free("sleeves", 0.0)),
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
        (internal[0], free("internal", internal[1])),
        tuple(
            (
                part.node,
                part.size * complex(np.exp(1j * part.phase)),
                free(
                    "unbalance",
                    taken["unbalances"][str(n)].std_error if str(n) in taken["unbalances"] else 0.0,
                ),
            )
            for n, part in enumerate(rig.unbalances, 1)
        ),
        {
            place.name: _linear(place, settings, *usual)
            for place in rig.bearings
            if isinstance(settings := getattr(place.bearing, "settings", None), LinearBearingSettings)
        },
    )


def _sleeves(
    rig: RotorRig, node: Marked | None, taken: Mapping[str, Uncertain], default: float
) -> dict[str, tuple[tuple[int, ...], float, float]]:
    """Sleeves by name, their elements, ln of the stiffening and its uncertainty."""
    sleeves: dict[str, tuple[tuple[int, ...], float, float]] = {}
    for number, (entry, ring) in enumerate(zip(_listing(node), rig.rotor.sleeves, strict=True), 1):
        name = entry.content["name"].text if "name" in entry.content else str(number)
        error = _relative(taken.get(str(number))) or default
        elements, _, before = sleeves.get(name, ((), 0.0, 0.0))
        sleeves[name] = ((*elements, ring.element), float(np.log(ring.stiffening)), max(error, before))
    return sleeves


def _linear(
    place: BearingPlace,
    settings: LinearBearingSettings,
    stiffness_error: float,
    damping_error: float,
    cross_error: float,
) -> LinearBearing:
    """The bearing with the uncertainties of its coefficients, those of `estimate` where it has none."""
    stated = {entry.key: entry.uncertainty.std_error for entry in place.uncertainties}
    k, c = settings.stiffness, settings.damping
    bare = not (k[0, 1] or k[1, 0] or {"k_yz", "k_zy"} & stated.keys())
    skew = settings.k_cross is not None or (cross_error > 0 and bare)

    def errors(letter: str, values: FloatArray, default: float) -> FloatArray:
        names = [f"{letter}_{label}" for label in COEFFICIENTS]
        if letter == "k" and settings.k_zz is None:
            names[3] = "k_yy"
        if letter == "k" and skew:
            names[1] = names[2] = "k_cross"
        if letter == "c" and settings.c is not None:
            names[0] = names[3] = "c"
        # A direct coefficient keeps its sign, so that it is the logarithm that is uncertain.
        sizes = np.abs(values).ravel()
        units = np.where((sizes > 0) & np.array([True, False, False, True]), sizes, 1.0)
        usual = sizes * default / units
        if letter == "k" and skew:
            usual[1] = usual[2] = cross_error * float(np.mean(np.abs(np.diag(values))))
        coefficients = zip(names, units, usual, strict=True)
        errors = [stated[name] / unit if name in stated else error for name, unit, error in coefficients]
        return np.array(errors).reshape(2, 2)

    return LinearBearing(
        k, c, errors("k", k, stiffness_error), errors("c", c, damping_error), settings.c is not None, skew
    )


def check_unknown(system: RotorSystem) -> None:
    """ConfigError where nothing of a rotor is unknown."""
    if not system.is_uncertain:
        hint = f"write numbers with their uncertainty, or estimate: [{', '.join(ESTIMATED)}]"
        raise SettingError("rotor", "nothing of the rotor is unknown", hint)


ROTOR_SYSTEM_FILE = FileKind(load_system)
