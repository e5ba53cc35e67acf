"""Reading a rotor file: shaft elements, discs, sleeves, bearings, loads, damping."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from labpipe.bearings.kinds import Bearing
from labpipe.errors import ConfigError, SettingError
from labpipe.methods.rotor.rig import BearingPlace, RotorRig, Unbalance, UncertainBearing
from labpipe.methods.rotor.shaft import ALUMINIUM, STEEL, Disc, Material, Rotor, ShaftElement, Sleeve
from labpipe.project.bearing_file import kind_of, pop_uncertainties, setting_at
from labpipe.project.marked_yaml import Marked, load_marked, set_entry
from labpipe.project.settings_reader import Faults, join, read_setting, read_settings
from labpipe.records.settings import FileKind, Setting, Settings, integer, quantity, text
from labpipe.records.uncertain import uncertainty_of
from labpipe.registry import nearest

MOST_COPIES = 1000


@dataclass(frozen=True)
class RotorSettings(Settings):
    """The plain entries of a rotor file (its lists are read by themselves)."""

    speed: float = quantity("speed of the shaft, in Hz or rpm", "Hz")
    name: str = text("name of the rotor, as the report shows it")
    description: str = text("what a reader should know of the rotor")
    force: int = integer("node on which the rig is excited", 1)
    response: int = integer("node at which displacements are measured", 1)


def _material() -> Any:
    return text("steel, aluminium or one of materials", "steel")


@dataclass(frozen=True)
class MaterialSettings(Settings):
    """One entry below ``materials:``."""

    density: float = quantity("density", "kg/m^3")
    elastic_modulus: float = quantity("Young's modulus", "Pa")
    shear_modulus: float = quantity("shear modulus", "Pa")
    poisson: float = quantity("Poisson's ratio, for the shear coefficient", "1", 0.3)


@dataclass(frozen=True)
class ElementSettings(Settings):
    """One entry of ``elements:``, from left to right."""

    length: float = quantity("length", "m")
    diameter: float = quantity("outer diameter", "m")
    inner_diameter: float = quantity("bore", "m", 0.0)
    material: str = _material()
    count: int = integer("equal elements in a row", 1)

    def __post_init__(self) -> None:
        if not 1 <= self.count <= MOST_COPIES:
            raise ConfigError(f"count: from 1 to {MOST_COPIES}, not {self.count}")


@dataclass(frozen=True, kw_only=True)
class DiscSettings(Settings):
    """One entry of ``discs:``, by its dimensions and material or by its mass and moments of inertia."""

    node: int = integer("node it sits on")
    outer_diameter: float | None = quantity("outer diameter", "m", None)
    inner_diameter: float = quantity("bore", "m", 0.0)
    length: float | None = quantity("length along the shaft", "m", None)
    material: str = _material()
    mass: float | None = quantity("mass, instead of dimensions", "kg", None)
    polar_inertia: float | None = quantity("moment of inertia about the shaft", "kg.m^2", None)
    transverse_inertia: float | None = quantity("moment of inertia about a diameter", "kg.m^2", None)

    def __post_init__(self) -> None:
        if (self.mass is None) == (self.outer_diameter is None):
            hint = "a disc is given by its mass, or by its dimensions"
            raise ConfigError("one of mass and outer_diameter is needed", hint=hint)
        if self.outer_diameter is not None and self.length is None:
            hint = "a disc of dimensions needs its length along the shaft"
            raise ConfigError("length: is missing", hint=hint)
        by, idle = "dimensions", ["polar_inertia", "transverse_inertia"]
        if self.mass is not None:
            if self.polar_inertia is None or self.transverse_inertia is None:
                raise ConfigError("polar_inertia and transverse_inertia are needed with mass")
            # I_p = 2 I_t of a thin disc is the most that a body can have; rounding is not a fault.
            if self.polar_inertia > 2.01 * self.transverse_inertia:
                raise ConfigError("polar_inertia is more than twice transverse_inertia, which no body has")
            by, idle = "mass", ["inner_diameter", "length", "material"]
        for key in self.written:
            if key in idle:
                what = f"'{key}' changes nothing of a disc given by its {by}"
                raise SettingError(key, what, "leave it out")

    def disc(self, material: Material) -> Disc:
        if self.mass is not None:
            return Disc(self.node, self.mass, self.transverse_inertia or 0.0, self.polar_inertia or 0.0)
        return Disc.of_dimensions(
            self.node, self.inner_diameter, self.outer_diameter or 0.0, self.length or 0.0, material
        )


@dataclass(frozen=True)
class SleeveSettings(Settings):
    """One entry of ``sleeves:``: a ring that adds mass and inertia along an element, and stiffness as far as
    it is said.
    """

    element: int = integer("number of the element it surrounds, from 1")
    outer_diameter: float = quantity("outer diameter", "m")
    material: str = _material()
    stiffening: float = quantity("factor on the stiffness of the element", "1", 1.0)
    name: str = text("sleeves of one name have one unknown stiffening")


@dataclass(frozen=True)
class DampingSettings(Settings):
    """Proportional damping of the shaft, C = alpha M + beta K."""

    alpha: float = quantity("part of the mass matrix", "1/s", 0.0)
    beta: float = quantity("part of the stiffness matrix", "s", 0.0)


@dataclass(frozen=True)
class LoadSettings(Settings):
    """One entry of ``loads:``: a constant force beside the weight."""

    node: int = integer("node it acts on")
    y: float = quantity("horizontal force", "N", 0.0)
    z: float = quantity("vertical force, positive up", "N", 0.0)


@dataclass(frozen=True)
class UnbalanceEntry(Settings):
    """One entry of ``unbalances:``."""

    node: int = integer("node it sits on")
    size: float = quantity("mass times eccentricity", "kg.m")
    phase: float = quantity("phase from the keyphasor, with the spin", "rad", 0.0)


MATERIALS = {"steel": STEEL, "aluminium": ALUMINIUM}

Owner = TypeVar("Owner")
Built = TypeVar("Built")


LISTS: dict[str, type] = {
    "elements": ElementSettings,
    "discs": DiscSettings,
    "sleeves": SleeveSettings,
    "loads": LoadSettings,
    "unbalances": UnbalanceEntry,
}
NODE = Setting("integer", "node it sits on")
# Keys of a rotor file of other commands: what they are of, and what is right instead.
REFUSED = {
    "pins": ("this rotor runs between pins, for run-ups", "here one in journal bearings is needed"),
    **dict.fromkeys(
        ("pedestals", "estimate"),
        ("is of the tests of one rotor together", "name the file under rotor_system"),
    ),
}
# Keys that a rotor on its bearings needs, with hints.
NEEDED = dict.fromkeys(("elements", "bearings"), "a list; each entry begins with '- '")


def load_rotor(path: Path, overrides: Iterable[str] = ()) -> RotorRig:
    """The rotor of a rotor file; ConfigErrors with every fault at its place."""
    tree = load_marked(path, overrides)
    faults = Faults(path.parent)
    rig = read_rotor(tree, path.stem, faults)
    faults.raise_any()
    assert rig is not None
    return rig


def read_rotor(tree: Marked, stem: str, faults: Faults) -> RotorRig | None:
    """The rotor of a marked tree; None and faults where it cannot be read."""
    entries = faults.mapping(tree, "")
    for key, fault in REFUSED.items():
        if key in entries:
            faults.add(entries[key], key, *fault)
            return None
    settings, rotor, bearings, lists = read_parts(tree, entries, RotorSettings, tuple(LISTS), NEEDED, faults)
    if rotor is None or settings is None:
        return None
    places = tuple(place for _, place in bearings)
    loads = tuple((part.node, part.y, part.z) for _, part in lists["loads"])
    unbalances = tuple(Unbalance(part.node, part.size, part.phase) for _, part in lists["unbalances"])
    _check_nodes({**lists, "bearings": bearings}, rotor, faults)
    make_rig = partial(
        RotorRig,
        settings.name or stem,
        rotor,
        speed=settings.speed,
        bearings=places,
        loads=loads,
        unbalances=unbalances,
        force=settings.force,
        response=settings.response,
    )
    return try_making(make_rig, tree, "", faults)


def read_parts(
    tree: Marked,
    entries: Mapping[str, Marked],
    owner: type[Owner],
    listed: tuple[str, ...],
    needed: Mapping[str, str],
    faults: Faults,
) -> tuple[
    Owner | None, Rotor | None, list[tuple[Marked, BearingPlace]], dict[str, list[tuple[Marked, Any]]]
]:
    """The plain entries of a rotor file as an *owner*, its rotor, bearings, and the entries of its *listed*
    keys; faults for what cannot be read, and for *needed* keys (with their hints) that are missing.
    """
    before = len(faults)
    sections = (*listed, *needed, "bearings", "materials", "damping")
    plain = Marked({key: entry for key, entry in entries.items() if key not in sections}, tree.where)
    settings = read_settings(owner, plain, "", faults)
    materials = read_materials(entries.get("materials"), faults)
    lists = {key: read_entries(LISTS[key], entries.get(key), key, faults) for key in listed}
    bearings = read_bearings(entries.get("bearings"), faults)
    for key, hint in needed.items():
        if key not in entries:
            faults.add(tree, key, "is missing", hint)
    damping: DampingSettings | None = DampingSettings()
    if "damping" in entries:
        damping = read_settings(DampingSettings, entries["damping"], "damping", faults)
    rotor = None
    if damping is not None and len(faults) == before:
        rotor = build_rotor(lists, materials, damping, tree, faults)
    return settings, rotor, bearings, lists


def _listing(node: Marked | None, key: str, faults: Faults) -> list[Marked]:
    if node is None:
        return []
    if isinstance(node.content, list):
        return node.content
    faults.add(node, key, "a list is needed", "each entry begins with '- '")
    return []


def read_entries(
    owner: type[Owner], node: Marked | None, key: str, faults: Faults
) -> list[tuple[Marked, Any]]:
    """The entries of a list that can be read, with their place."""
    pairs = [
        (entry, read_settings(owner, entry, f"{key}.{number}", faults))
        for number, entry in enumerate(_listing(node, key, faults), 1)
    ]
    return [(entry, settings) for entry, settings in pairs if settings is not None]


def read_materials(node: Marked | None, faults: Faults) -> dict[str, Material]:
    materials = dict(MATERIALS)
    for name, entry in (faults.mapping(node, "materials") if node is not None else {}).items():
        key = join("materials", name)
        settings = read_settings(MaterialSettings, entry, key, faults)
        if settings is not None:
            moduli = settings.elastic_modulus, settings.shear_modulus, settings.poisson
            material = try_making(partial(Material, settings.density, *moduli, name), entry, key, faults)
            materials |= {} if material is None else {name: material}
    return materials


def build_rotor(
    lists: dict[str, list[tuple[Marked, Any]]],
    materials: dict[str, Material],
    damping: DampingSettings,
    tree: Marked,
    faults: Faults,
) -> Rotor | None:
    before = len(faults)

    def material(entry: Marked, part: Any) -> Material:
        if part.material not in materials:
            hint = nearest(part.material, materials)
            faults.add_at(entry.content, "", "material", f"unknown material '{part.material}'", hint)
        return materials.get(part.material, STEEL)

    shaft: list[ShaftElement] = []
    for entry, part in lists["elements"]:
        make_element = partial(
            ShaftElement, part.length, part.diameter, material(entry, part), part.inner_diameter
        )
        element = try_making(make_element, entry, "", faults)
        shaft.extend([element] * part.count if element is not None else [])
    discs = [
        try_making(partial(part.disc, material(entry, part)), entry, "", faults)
        for entry, part in lists["discs"]
    ]
    sleeves = [
        Sleeve(part.element, part.outer_diameter, material(entry, part), part.stiffening)
        for entry, part in lists["sleeves"]
    ]
    if len(faults) > before:
        return None
    parts = tuple(disc for disc in discs if disc is not None)
    return try_making(
        partial(Rotor, tuple(shaft), parts, tuple(sleeves), damping.alpha, damping.beta), tree, "", faults
    )


def _check_nodes(lists: dict[str, list[tuple[Marked, Any]]], rotor: Rotor, faults: Faults) -> None:
    for key in ("bearings", "loads", "unbalances"):
        for entry, part in lists[key]:
            check = partial(rotor.check_node, part.node, f"this entry of {key}")
            try_making(check, entry.content["node"], key, faults)


def try_making(make: Callable[[], Built], node: Marked, key: str, faults: Faults) -> Built | None:
    """Return value of *make*; None and a fault at the node's place for a ConfigError."""
    try:
        return make()
    except ConfigError as error:
        faults.add_of_field(error, node, key)
        return None


def read_bearings(node: Marked | None, faults: Faults) -> list[tuple[Marked, BearingPlace]]:
    """The bearings of a rotor file with their entries, named by their number where they have no name."""
    entries = enumerate(_listing(node, "bearings", faults), 1)
    places = [(entry, _bearing_place(entry, number, faults)) for number, entry in entries]
    return [(entry, place) for entry, place in places if place is not None]


def _bearing_place(entry: Marked, number: int, faults: Faults) -> BearingPlace | None:
    key, before = f"bearings.{number}", len(faults)
    entries = faults.mapping(entry, key)
    kind = kind_of(entry, key, faults) if entries else None
    if kind is None:
        return None
    node = read_setting(entries["node"], NODE, join(key, "node"), faults) if "node" in entries else None
    if "node" not in entries:
        faults.add(entry, join(key, "node"), "is missing", NODE.help)
    plain = Marked(
        {name: part for name, part in entries.items() if name != "node"}, entry.where, entry.key_where
    )
    for name in kind.operating:
        if name in entries:
            faults.add_at(entries, key, name, "follows from the rotor", "leave it out")
    # Load and speed come with every question to the bearing; until then they are any number above zero.
    owner = kind.on_rotor or kind.settings
    uncertainties = pop_uncertainties(plain, kind, "", owner, faults)

    def mount() -> tuple[str, Bearing | None]:
        settings = read_settings(owner, plain, key, faults, **dict.fromkeys(kind.operating, 1.0))
        if settings is None or len(faults) > before:
            return "", None
        return getattr(settings, "name", "") or str(number), try_making(
            lambda: kind.make(settings), entry, key, faults
        )

    name, bearing = mount()
    if bearing is None or node is None:
        return None
    places = []
    for entry_name, uncertain in uncertainties.items():
        unit = setting_at(owner, entry_name).unit
        above, below, _ = (
            _bearing_at_end(plain, entry_name, uncertain.value + sign * uncertain.std_error, unit, mount)
            for sign in (1.0, -1.0, 0.0)
        )
        if above is None or below is None:
            return None
        source = uncertainty_of(uncertain, f"{name}: {entry_name}", unit)
        places.append(UncertainBearing(source, above, below, uncertain.value, entry_name))
    return BearingPlace(name, node, bearing, entries["kind"].text, tuple(places))


def _bearing_at_end(
    plain: Marked, key: str, value: float, unit: str, mounted: Callable[[], tuple[str, Bearing | None]]
) -> Bearing | None:
    set_entry(plain, f"{key}={value!r} {unit}".rstrip())
    return mounted()[1]


ROTOR_FILE = FileKind(load_rotor)
