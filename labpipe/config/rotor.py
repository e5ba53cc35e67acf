"""Reading a rotor file: shaft elements, discs, sleeves, bearings, loads, damping; what the rotor IS."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from labpipe.bearings.journal_kind import JournalSettings
from labpipe.config.faults import Faults, join
from labpipe.config.reader import read_settings
from labpipe.errors import ConfigError
from labpipe.identify.settings import FitSettings
from labpipe.marked_yaml import Marked, load_marked, set_entry
from labpipe.records.settings import setting
from labpipe.registry import nearest
from labpipe.rigs.rotor_rig import BearingPlace, RotorRig, Unbalance
from labpipe.rotors.parts import ALUMINIUM, STEEL, Disc, Material, Rotor, ShaftElement, Sleeve
from labpipe.simulate.journal_rig import VirtualJournalRig
from labpipe.wear.settings import WearSettings

MATERIALS = {"steel": STEEL, "aluminium": ALUMINIUM}
MOST_COPIES = 1000

Owner = TypeVar("Owner")
Built = TypeVar("Built")
Named = TypeVar("Named", WearSettings, VirtualJournalRig)


@dataclass(frozen=True)
class RotorSettings:
    """The plain entries of a rotor file (its lists are read by themselves)."""

    speed: float = setting("value", "speed of the shaft, in Hz or rpm", unit="Hz")
    name: str = setting("text", "name of the rotor, as the report shows it", default="")
    description: str = setting("text", "what a reader should know of the rotor", default="")
    force: int = setting("integer", "node on which the rig is excited", default=1)
    response: int = setting("integer", "node at which displacements are measured", default=1)


@dataclass(frozen=True)
class MaterialSettings:
    """One entry below ``materials:``."""

    density: float = setting("value", "density", unit="kg/m^3")
    elastic_modulus: float = setting("value", "Young's modulus", unit="Pa")
    shear_modulus: float = setting("value", "shear modulus", unit="Pa")
    poisson: float = setting("value", "Poisson's ratio, for the shear coefficient", unit="1", default=0.3)


@dataclass(frozen=True)
class ElementSettings:
    """One entry of ``elements:``, from left to right."""

    length: float = setting("value", "length", unit="m")
    diameter: float = setting("value", "outer diameter", unit="m")
    inner_diameter: float = setting("value", "bore", unit="m", default=0.0)
    material: str = setting("text", "steel, aluminium or one of materials", default="steel")
    count: int = setting("integer", "equal elements in a row", default=1)

    def __post_init__(self) -> None:
        if not 1 <= self.count <= MOST_COPIES:
            raise ConfigError(f"count: from 1 to {MOST_COPIES}, not {self.count}")


@dataclass(frozen=True)
class DiscSettings:
    """One entry of ``discs:``, by its dimensions and material or by its mass and moments of inertia."""

    node: int = setting("integer", "node it sits on")
    outer_diameter: float | None = setting("value", "outer diameter", unit="m", default=None)
    inner_diameter: float = setting("value", "bore", unit="m", default=0.0)
    length: float | None = setting("value", "length along the shaft", unit="m", default=None)
    material: str = setting("text", "steel, aluminium or one of materials", default="steel")
    mass: float | None = setting("value", "mass, instead of dimensions", unit="kg", default=None)
    polar_inertia: float | None = setting("value", "moment of inertia about the shaft", unit="kg.m^2", default=None)
    transverse_inertia: float | None = setting("value", "moment of inertia about a diameter", unit="kg.m^2", default=None)

    def __post_init__(self) -> None:
        if (self.mass is None) == (self.outer_diameter is None):
            raise ConfigError("one of mass and outer_diameter is needed", hint="a disc is given by its mass, or by its dimensions")
        if self.outer_diameter is not None and self.length is None:
            raise ConfigError("length: is missing", hint="a disc of dimensions needs its length along the shaft")
        if self.mass is not None and None in (self.polar_inertia, self.transverse_inertia):
            raise ConfigError("polar_inertia and transverse_inertia are needed with mass")

    def disc(self, material: Material) -> Disc:
        if self.mass is not None:
            return Disc(self.node, self.mass, self.transverse_inertia or 0.0, self.polar_inertia or 0.0)
        return Disc.of_dimensions(self.node, self.inner_diameter, self.outer_diameter or 0.0, self.length or 0.0, material)


@dataclass(frozen=True)
class SleeveSettings:
    """One entry of ``sleeves:``: a ring that adds mass and inertia along an element, no stiffness."""

    element: int = setting("integer", "number of the element it surrounds, from 1")
    outer_diameter: float = setting("value", "outer diameter", unit="m")
    material: str = setting("text", "steel, aluminium or one of materials", default="steel")


@dataclass(frozen=True)
class DampingSettings:
    """Proportional damping of the shaft, C = alpha M + beta K."""

    alpha: float = setting("value", "part of the mass matrix", unit="1/s", default=0.0)
    beta: float = setting("value", "part of the stiffness matrix", unit="s", default=0.0)


@dataclass(frozen=True, kw_only=True)
class RotorBearingSettings(JournalSettings):
    """One entry of ``bearings:``: a journal bearing and its node; its load follows from the rotor."""

    node: int = setting("integer", "node it sits on")


@dataclass(frozen=True)
class LoadSettings:
    """One entry of ``loads:``: a constant force beside the weight."""

    node: int = setting("integer", "node it acts on")
    y: float = setting("value", "horizontal force", unit="N", default=0.0)
    z: float = setting("value", "vertical force, positive up", unit="N", default=0.0)


@dataclass(frozen=True)
class UnbalanceSettings:
    """One entry of ``unbalances:``."""

    node: int = setting("integer", "node it sits on")
    size: float = setting("value", "mass times eccentricity", unit="kg.m")
    phase: float = setting("value", "phase from the keyphasor, with the spin", unit="rad", default=0.0)


LISTS: dict[str, type] = {
    "elements": ElementSettings,
    "discs": DiscSettings,
    "sleeves": SleeveSettings,
    "bearings": RotorBearingSettings,
    "loads": LoadSettings,
    "unbalances": UnbalanceSettings,
}
SECTIONS = (*LISTS, "materials", "damping")


def load_rotor(path: Path, overrides: Iterable[str] = ()) -> RotorRig:
    """The rotor of a rotor file; ConfigErrors with every fault at its place."""
    tree = load_marked(path)
    for assignment in overrides:
        set_entry(tree, assignment)
    faults = Faults()
    rig = read_rotor(tree, path.stem, faults)
    faults.raise_any()
    assert rig is not None
    return rig


def read_rotor(tree: Marked, stem: str, faults: Faults) -> RotorRig | None:
    """The rotor of a marked tree; None and faults where it cannot be read."""
    before = len(faults)
    entries = faults.mapping(tree, "")
    if "pins" in entries:
        faults.add(entries["pins"], "pins", "this rotor runs between pins, for run-ups", "here one in journal bearings is needed")
        return None
    plain = Marked({k: v for k, v in entries.items() if k not in SECTIONS}, tree.where)
    known = read_settings(RotorSettings, plain, "", faults)
    materials = _materials(entries.get("materials"), faults)
    lists = {key: _entries(owner, entries.get(key), key, faults) for key, owner in LISTS.items()}
    for key in ("elements", "bearings"):
        if key not in entries:
            faults.add(tree, key, "is missing", "a list; each entry begins with '- '")
    damping = read_settings(DampingSettings, entries["damping"], "damping", faults) if "damping" in entries else DampingSettings()
    rotor = None if len(faults) > before else _rotor(lists, materials, damping, tree, faults)
    if rotor is None or known is None:
        return None
    places = tuple(BearingPlace(one.name or str(number), one.node, one.bearing()) for number, (_, one) in enumerate(lists["bearings"], 1))
    loads = tuple((one.node, one.y, one.z) for _, one in lists["loads"])
    unbalances = tuple(Unbalance(one.node, one.size, one.phase) for _, one in lists["unbalances"])
    _check_nodes(lists, rotor, faults)
    name = known.name or stem
    return _tried(lambda: RotorRig(name, rotor, known.speed, places, loads, unbalances, known.force, known.response), tree, "", faults)


def _entries(owner: type[Owner], node: Marked | None, key: str, faults: Faults) -> list[tuple[Marked, Any]]:
    """The entries of a list that can be read, with their place."""
    if node is None:
        return []
    if not isinstance(node.content, list):
        faults.add(node, key, "a list is needed", "each entry begins with '- '")
        return []
    found = [(entry, read_settings(owner, entry, f"{key}.{number}", faults)) for number, entry in enumerate(node.content, 1)]
    return [(entry, one) for entry, one in found if one is not None]


def _materials(node: Marked | None, faults: Faults) -> dict[str, Material]:
    materials = dict(MATERIALS)
    for name, entry in (faults.mapping(node, "materials") if node is not None else {}).items():
        key = join("materials", name)
        one = read_settings(MaterialSettings, entry, key, faults)
        if one is not None:
            made = _tried(lambda one=one: Material(one.density, one.elastic_modulus, one.shear_modulus, one.poisson), entry, key, faults)
            materials |= {} if made is None else {name: made}
    return materials


def _rotor(
    lists: dict[str, list[tuple[Marked, Any]]],
    materials: dict[str, Material],
    damping: DampingSettings | None,
    tree: Marked,
    faults: Faults,
) -> Rotor | None:
    """The shaft with all that is on it; None and faults, each at the part's own place."""
    before = len(faults)

    def material(entry: Marked, one: Any) -> Material:
        if one.material not in materials:
            faults.add(entry.content["material"], "material", f"unknown material '{one.material}'", nearest(one.material, materials))
        return materials.get(one.material, STEEL)

    shaft: list[ShaftElement] = []
    for entry, one in lists["elements"]:
        steel = material(entry, one)
        piece = _tried(lambda one=one, steel=steel: ShaftElement(one.length, one.diameter, steel, one.inner_diameter), entry, "", faults)
        shaft.extend([piece] * one.count if piece is not None else [])
    discs = [_tried(lambda e=e, one=one: one.disc(material(e, one)), e, "", faults) for e, one in lists["discs"]]
    sleeves = [Sleeve(one.element, one.outer_diameter, material(entry, one)) for entry, one in lists["sleeves"]]
    if len(faults) > before or damping is None:
        return None
    parts = tuple(disc for disc in discs if disc is not None)
    return _tried(lambda: Rotor(tuple(shaft), parts, tuple(sleeves), damping.alpha, damping.beta), tree, "", faults)


def _check_nodes(lists: dict[str, list[tuple[Marked, Any]]], rotor: Rotor, faults: Faults) -> None:
    """A fault at every entry that sits on no node."""
    for key in ("bearings", "loads", "unbalances"):
        for entry, one in lists[key]:
            _tried(lambda one=one, key=key: rotor.check_node(one.node, f"this entry of {key}"), entry.content["node"], key, faults)


def _tried(make: Callable[[], Built], node: Marked, key: str, faults: Faults) -> Built | None:
    """What *make* makes; a fault at the node's place where it refuses."""
    try:
        return make()
    except ConfigError as error:
        faults.add(node, key, error.what, error.hint)
        return None


def with_rotor(fit: FitSettings, entry: Marked, folder: Path, key: str, faults: Faults) -> FitSettings:
    """A fit with the rotor that its section wear: names; a fault where that cannot be read."""
    if fit.wear is None:
        return fit
    return replace(fit, wear=on_rotor(fit.wear, entry.content["wear"], folder, faults, join(key, "wear")))


def on_rotor(settings: Named, node: Marked, folder: Path, faults: Faults, key: str = "") -> Named:
    """Settings with a *rotor* file and a *bearing* in it, and the rotor read; a fault where that cannot be done."""
    try:
        rig = load_rotor(folder / settings.rotor)
        rig.place(settings.bearing)
        return replace(settings, rig=rig)
    except ConfigError as error:
        if error.what == "no such file":
            hint = "paths are relative to the file that names them"
            faults.add(node.content["rotor"], join(key, "rotor"), f"no such file '{settings.rotor}'", hint)
        elif error.what.startswith("no bearing"):
            faults.add(node.content["bearing"], join(key, "bearing"), error.what, error.hint)
        else:
            faults.merge(error)
    return settings
