"""Reading a rig file: what the rig IS; no processing parameter is known here."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from labpipe.errors import ConfigError
from labpipe.project import calibrations
from labpipe.project.derived_channels import SumReader, expand, read_constants
from labpipe.project.marked_yaml import Marked, load_marked, text_of
from labpipe.project.settings_reader import Faults, join, read_settings, shorten_number
from labpipe.quantities import QUANTITIES, Unit, UnitError, parse_unit, parse_value, readings, unit_of
from labpipe.raw_files.frf_csv import port_of
from labpipe.records.recording import ROLES, Channel, SumTerm
from labpipe.records.rig import AXIS_ANGLES, Rig, RigChannel
from labpipe.records.settings import FileKind, Settings, Uncertainties, choice, flag, quantity, setting, text
from labpipe.records.uncertain import split_uncertainty
from labpipe.registry import nearest

# Beside the plain entries of a rig file.
PARTS = ("channels", "constants", "derived")
# Entries of a recorded channel that a sum of channels does not have.
RECORDED_ONLY = (
    *("unit", "column", "sensitivity", "invert", "delay", "response", "range", "uncertainty", "doubt"),
)
DEFAULT_ROLES = {"force": "input", "displacement": "output", "velocity": "output", "acceleration": "output"}


@dataclass(frozen=True)
class RigSettings(Settings):
    """The plain entries of a rig file (its channels are read by themselves)."""

    name: str = text("name of the rig, as the report shows it")
    description: str = text("what a reader should know of the rig")
    sample_rate: float | None = quantity("sampling rate, where no time column or file gives it", "Hz", None)
    time: str | None = text('time column, for example "t [s]"', None)
    resample: float | None = quantity(
        "rate to which channels at several rates of one file (MDF, LVM) are brought, by cubic splines: that "
        "of the fastest used, or more",
        "Hz",
        None,
    )
    mass: float | None = quantity("mass that moves with the response", "kg", None)
    uncertainties: Uncertainties = ()


@dataclass(frozen=True, kw_only=True)
class ChannelSettings(Settings):
    """One entry below ``channels:``."""

    quantity: str = choice("what is measured", tuple(QUANTITIES))
    unit: str = text("unit of the recorded numbers; default: SI")
    column: str = text("column of the file; default: the channel's key")
    role: str = choice("input (force), output (response) or reference, as members of sums are", ROLES, "")
    dof: str = text("x, y, z, any name, or an angle from x such as '45 deg'")
    position: float | None = setting(
        "value", "place along the axis, where magnets and sensors are apart", "m", None
    )
    sensitivity: str = text(
        "of the sensor, for example '8 V/mm' or '8 V/mm +- 1 %'; or {certificate: FILE, quantity: NAME}"
    )
    invert: bool = flag("turn the sign around")
    delay: float = setting("value", "delay of the sensor chain, taken out of the FRF", "s", 0.0)
    response: str = text("CSV table of the sensor's frequency response, taken out of the FRF")
    range: tuple[float, float] | None = text(
        "recorded values at which the logger clips, e.g. '-10 V .. 10 V'", None
    )
    uncertainty: calibrations.ChainUncertaintySettings | None = setting(
        "section",
        "uncertainty of the whole chain",
        section=calibrations.ChainUncertaintySettings,
        default=None,
        before="doubt",
    )
    derived: str = text("sum of other channels in place of a column, for example 'f_x - m_s * a_x'")
    uncertainties: Uncertainties = ()


def load_rig(path: Path, overrides: Iterable[str] = ()) -> Rig:
    """The rig of a rig file; ConfigErrors with every fault at its place."""
    tree = load_marked(path, overrides)
    faults = Faults()
    rig = read_rig(tree, faults)
    faults.raise_any()
    assert rig is not None
    return rig


def override_channels(path: Path, entry: Marked, faults: Faults, key: str) -> Rig | None:
    """The rig of *path* in which a recording's own ``channels:`` entries take the place of the rig file's."""
    tree = load_marked(path)
    top = tree.content if isinstance(tree.content, dict) else {}
    parts = [top[part].content for part in ("channels", "derived") if part in top]
    written = {name: part for part in parts if isinstance(part, dict) for name in part}
    for name, node in faults.mapping(entry, key).items():
        own = faults.mapping(node, join(key, name))
        if name not in written:
            hint = nearest(name, written)
            faults.add(node, join(key, name), "the rig has no such channel", hint)
        elif isinstance((there := written[name][name]).content, dict):
            written[name][name] = replace(there, content={**there.content, **own})
    return read_rig(tree, faults)


def move(rig: Rig, dofs: Mapping[str, str]) -> Rig:
    """The rig with channels in other dofs, by channel; `output` and `input` stand for the only one of that
    role. ConfigError for a name that is not a channel.
    """
    places: dict[str, str] = {}
    names = [channel.name for channel in rig.all_channels]
    for name, dof in dofs.items():
        of_role = [channel.name for channel in rig.all_channels if channel.role == name]
        if name not in names and len(of_role) != 1:
            what = f"the rig has {len(of_role)} channels of the role {name}"
            what = what if of_role else f"'{name}' is not a channel of the rig"
            raise ConfigError(what, hint=nearest(name, names))
        places[name if name in names else of_role[0]] = dof

    def move(channel: Channel) -> Channel:
        dof = places.get(channel.name)
        if dof is None:
            return channel
        # A channel that is mounted anew has another error of its direction.
        before, after = (f"{channel.name}.dof {place}" for place in (channel.dof, dof))
        uncertainties = tuple(
            replace(part, uncertainty=replace(part.uncertainty, source=after))
            if part.uncertainty.source == before
            else part
            for part in channel.uncertainties
        )
        return replace(channel, dof=dof, angle=port_of(dof).angle, uncertainties=uncertainties)

    channels = tuple(replace(recorded, channel=move(recorded.channel)) for recorded in rig.channels)
    return replace(rig, channels=channels, derived=tuple(map(move, rig.derived)))


def read_rig(tree: Marked, faults: Faults) -> Rig | None:
    """The rig of a marked tree; None and faults where it cannot be read."""
    before = len(faults)
    entries = faults.mapping(tree, "")
    settings = read_settings(RigSettings, replace(tree, content=entries).without(*PARTS), "", faults)
    listed = _with_listed_sums(entries, faults)
    channels, derived = _read_channels(listed, entries.get("constants"), tree, faults)
    if settings is not None:
        stated = [name for name in ("sample_rate", "time", "resample") if getattr(settings, name) is not None]
        if len(stated) > 1:
            what = f"one of {stated[0]} and {stated[1]} is needed, not both"
            faults.add(entries[stated[1]], stated[0], what, "leave one of them out")
        for name in ("sample_rate", "resample", "mass"):
            if (value := getattr(settings, name)) is not None and value <= 0:
                faults.add_at(entries, "", name, "must be positive")
    if len(faults) > before or settings is None:
        return None
    same = ("name", "description", "sample_rate", "time", "resample", "mass")
    return Rig(
        channels=tuple(channels),
        derived=derived,
        mass_uncertainty=dict(settings.uncertainties).get("mass"),
        **{name: getattr(settings, name) for name in same},
    )


def _with_listed_sums(entries: dict[str, Marked], faults: Faults) -> Marked | None:
    """The channels, with sums under ``derived:``: {sum: {f: 1, a: -30 kg +- 0.1 kg}, quantity: force}."""
    channels = entries.get("channels")
    if channels is None or "derived" not in entries or not isinstance(channels.content, dict):
        return channels
    together = dict(channels.content)
    for name, node in faults.mapping(entries["derived"], "derived").items():
        key = join("derived", name)
        listed = faults.mapping(node, key).get("sum")
        if name in together:
            faults.add(node, key, "is a channel already", "give it another name")
        elif listed is None or not isinstance(listed.content, dict):
            what = "a mapping of channels to factors is needed"
            faults.add(listed or node, join(key, "sum"), what, "sum: {f: 1, a: -30 kg +- 0.1 kg}")
        else:
            factors = {member: shorten_number(factor).text for member, factor in listed.content.items()}
            text = " + ".join(f"{factor} * {member}" for member, factor in factors.items())
            as_text = replace(listed, content=text, text=text)
            together[name] = replace(node, content={**node.without("sum").content, "derived": as_text})
    return replace(channels, content=together)


def _read_channels(
    node: Marked | None, constants: Marked | None, tree: Marked, faults: Faults
) -> tuple[list[RigChannel], tuple[Channel, ...]]:
    if node is None:
        faults.add(tree, "channels", "is missing", "name each channel with its column, quantity and unit")
        return [], ()
    entries = faults.mapping(node, "channels")
    mappings = {name: entry.content for name, entry in entries.items() if isinstance(entry.content, dict)}
    sums = {name: entries[name] for name, content in mappings.items() if "derived" in content}
    channels = _read_recorded({name: entry for name, entry in entries.items() if name not in sums}, faults)
    stated = {name: text_of(content, "quantity") for name, content in mappings.items()}
    quantities = {name: quantity for name, quantity in stated.items() if quantity in QUANTITIES}
    reader = SumReader(quantities, read_constants(constants, entries, faults))
    derived = _read_sums(sums, reader, channels, faults)
    members = {term.channel for channel in derived for term in channel.terms}

    def as_member(recorded: RigChannel) -> RigChannel:
        """A force in a sum is not a force of its own unless the file says so."""
        name = recorded.channel.name
        if name not in members or "role" in entries[name].content:
            return recorded
        return replace(recorded, channel=replace(recorded.channel, role="reference"))

    return list(map(as_member, channels)), derived


def _read_recorded(entries: dict[str, Marked], faults: Faults) -> list[RigChannel]:
    channels: list[RigChannel] = []
    columns: dict[str, str] = {}
    for name, entry in entries.items():
        channel = _read_channel(name, entry, join("channels", name), faults)
        if channel is None:
            continue
        if channel.column in columns:
            what = f"takes the column '{channel.column}' of channel '{columns[channel.column]}'"
            faults.add(entry, join("channels", name), what)
        columns[channel.column] = name
        channels.append(channel)
    return channels


def _read_sums(
    sums: dict[str, Marked], reader: SumReader, recorded: list[RigChannel], faults: Faults
) -> tuple[Channel, ...]:
    settings: dict[str, ChannelSettings] = {}
    terms: dict[str, tuple[SumTerm, ...]] = {}
    for name, entry in sums.items():
        for key in RECORDED_ONLY:
            if key in entry.content:
                what = "belongs to a recorded channel, this is a sum"
                faults.add_at(entry.content, join("channels", name), key, what, "leave it out")
        read = read_settings(ChannelSettings, entry, join("channels", name), faults)
        if read is None:
            continue
        settings[name] = read
        with faults.of_unit(entry.content["derived"], join("channels", name, "derived")):
            terms[name] = reader.terms(read.derived, name)
    names = {*terms, *(channel.channel.name for channel in recorded)}
    whole = {name: sum_ for name, sum_ in terms.items() if all(term.channel in names for term in sum_)}
    channels = (_sum_channel(name, sums[name], settings[name], whole, recorded, faults) for name in whole)
    return tuple(channel for channel in channels if channel is not None)


def _sum_channel(
    name: str,
    entry: Marked,
    settings: ChannelSettings,
    sums: dict[str, tuple[SumTerm, ...]],
    recorded: list[RigChannel],
    faults: Faults,
) -> Channel | None:
    """A sum with its members' common delay and response. Where they differ the FRF refuses it."""
    key = join("channels", name)
    terms: tuple[SumTerm, ...] = ()
    with faults.of_unit(entry.content["derived"], join(key, "derived")):
        terms = expand(sums, name)
    by_name = {channel.channel.name: channel.channel for channel in recorded}
    members = [by_name[term.channel] for term in terms if term.channel in by_name]
    chains = {(member.delay, member.response) for member in members}
    delay, response = chains.pop() if len(chains) == 1 else (0.0, ())
    if split_uncertainty(settings.dof)[1]:
        what = "a sum has no uncertainty of its direction"
        faults.add_at(entry.content, key, "dof", what, "state it at the channels that are summed")
    dof, angle = _direction(settings.dof or name, entry, key, faults)
    member = any(term.channel == name for other in sums.values() for term in other)
    role = settings.role or ("reference" if member else DEFAULT_ROLES.get(settings.quantity, "reference"))
    channel = Channel(name, settings.quantity, role, dof, angle, delay, response, terms)
    return replace(channel, position=settings.position)


def _with_certificate(node: Marked, key: str, faults: Faults) -> tuple[Marked, calibrations.Certified | None]:
    """A channel with the number of its certificate in place of the reference, and what that states."""
    entry = node.content.get("sensitivity") if isinstance(node.content, dict) else None
    if entry is None or not isinstance(entry.content, dict) or "certificate" not in entry.content:
        return node, None
    folder = node.folder_of("sensitivity")
    certified = calibrations.certified_sensitivity(entry, folder, join(key, "sensitivity"), faults)
    if certified is None:
        return node, None
    if certified.response and "response" in node.content:
        faults.add_at(node.content, key, "response", "the certificate states it", "leave it out")
    number = replace(entry, content=certified.text, text=certified.text)
    return replace(node, content={**node.content, "sensitivity": number}), certified


def _read_channel(name: str, node: Marked, key: str, faults: Faults) -> RigChannel | None:
    before = len(faults)
    node, certified = _with_certificate(node, key, faults)
    if len(faults) > before:
        return None
    settings = read_settings(ChannelSettings, node, key, faults)
    if settings is None:
        return None
    scale, offset = _calibration(settings, node, key, faults)
    limits = _limits(settings, node, key, faults)
    dof, angle = _direction(split_uncertainty(settings.dof)[0] or name, node, key, faults)
    response = _response(settings, node, key, faults) or (certified.response if certified else ())
    chain, of_certificate = settings.uncertainty, certified.uncertainties if certified else ()
    texts = settings.sensitivity, settings.dof
    written = calibrations.Written(name, node, *texts, settings.uncertainties, chain, of_certificate)
    # Of a number that cannot be read there is one fault, not a second one of its uncertainty.
    uncertainties = calibrations.channel_uncertainties(written, key, faults) if len(faults) == before else ()
    if len(faults) > before:
        return None
    sign = -1.0 if settings.invert else 1.0
    role = settings.role or DEFAULT_ROLES.get(settings.quantity, "reference")
    channel = Channel(name, settings.quantity, role, dof, angle, settings.delay, response)
    channel = replace(channel, uncertainties=uncertainties, position=settings.position)
    column, unit = settings.column or name, settings.unit or channel.unit
    return RigChannel(channel, column, unit, sign * scale, sign * offset, limits)


def _direction(dof: str, node: Marked, key: str, faults: Faults) -> tuple[str, float | None]:
    """dof label and angle [rad] from x; "45 deg" is an angle, x and y are the angles 0 and 90 deg."""
    if dof in AXIS_ANGLES:
        return dof, AXIS_ANGLES[dof]
    if re.match(r"^\s*[+-]?[\d.]", dof) and " " in dof.strip():
        with faults.of_unit(node.content.get("dof", node), join(key, "dof")):
            return dof, parse_value(dof, "rad")
    return dof, None


def _response(
    settings: ChannelSettings, node: Marked, key: str, faults: Faults
) -> tuple[tuple[float, float, float], ...]:
    if settings.response:
        with faults.of_unit(node.content["response"], join(key, "response")):
            return calibrations.read_sensor_response(node.folder_of("response") / settings.response)
    return ()


def _calibration(settings: ChannelSettings, node: Marked, key: str, faults: Faults) -> tuple[float, float]:
    """(scale, offset) from the recorded number to SI: directly by the unit, or through the sensitivity."""
    si_unit = QUANTITIES[settings.quantity].si_unit
    text, unit_node = settings.unit or si_unit, node.content.get("unit", node)
    with faults.of_unit(unit_node, join(key, "unit")):
        unit = parse_unit(text)
        if settings.sensitivity:
            with faults.of_unit(node.content["sensitivity"], join(key, "sensitivity")):
                stated = split_uncertainty(settings.sensitivity)[0]
                return unit.factor / _sensitivity(stated, unit, si_unit, node), 0.0
            return 1.0, 0.0
        try:
            unit = unit_of(text, si_unit)
        except UnitError as error:
            error.hint = f"or state the sensor's 'sensitivity: 10 {text}/({si_unit})'"
            raise
        return unit.factor, unit.offset
    return 1.0, 0.0


def _sensitivity(text: str, unit: Unit, si_unit: str, node: Marked) -> float:
    """Recorded SI unit per SI unit of the quantity: "8 V/mm", the reciprocal "5.8 N/V", or FILE#FIT."""
    if "#" in text:
        slope = calibrations.calibrated_slope(text, node.folder_of("sensitivity"))
        text = f"{slope.value!r} {slope.unit}"
    match = re.match(r"^\s*(\S+)\s+(.+)$", text)
    if match is None:
        raise UnitError(f"'{text}' is not a sensitivity", "for example '8 V/mm'")
    wanted = tuple(u - q for u, q in zip(unit.dimension, parse_unit(si_unit).dimension, strict=True))
    number = parse_value(text, match[2])
    if number == 0:
        raise UnitError(f"the sensitivity '{text}' is zero")
    for reading in readings(match[2]):
        if reading.dimension == wanted:
            return number * reading.factor
        if reading.dimension == tuple(-w for w in wanted):
            return 1.0 / (number * reading.factor)
    what = f"'{match[2]}' does not lead from the channel's unit to {si_unit}"
    raise UnitError(what, "write recorded unit per quantity, e.g. 'V/mm'")


def _limits(settings: ChannelSettings, node: Marked, key: str, faults: Faults) -> tuple[float, float] | None:
    """The recorded values at which the logger clips, in the recorded unit; "10 V" means -10 V .. 10 V."""
    if settings.range is None:
        return None
    low, dots, high = str(settings.range).partition("..")
    unit = settings.unit or QUANTITIES[settings.quantity].si_unit
    with faults.of_unit(node.content["range"], join(key, "range")):
        upper = parse_value((high if dots else low).strip(), unit)
        lower = parse_value(low.strip(), unit) if dots else -upper
        if lower >= upper:
            faults.add_at(node.content, key, "range", "must rise", "for example '-10 V .. 10 V'")
        return lower, upper
    return None


RIG_FILE = FileKind(load_rig)
