"""The doubts of a channel of a rig file: of its sensitivity, delay, phase and direction."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.json_file import read_digested
from labpipe.config.faults import Faults, join
from labpipe.marked_yaml import Marked
from labpipe.quantities import UnitError
from labpipe.records.doubt import ChannelDoubt, doubt_of
from labpipe.records.settings import Doubts, Settings, setting
from labpipe.records.uncertain import Uncertain, parse_uncertain, split_doubt
from labpipe.registry import nearest


@dataclass(frozen=True)
class DoubtSettings(Settings):
    """Standard uncertainties of a channel's chain beside those of its numbers; how else they are meant stands in brackets."""

    gain: str = setting("text", "of the whole chain, relative: 1 %, or 2 % (k=2), or 1 % (rectangular)", default="")
    phase: str = setting("text", "of the whole chain, at every frequency alike: 0.5 deg", default="")


@dataclass(frozen=True)
class Written:
    """What a rig file says of one channel's doubts: *entries* of the file, *sensitivity* and *dof* as texts, *doubts* of its numbers."""

    name: str
    entries: Mapping[str, Marked]
    sensitivity: str
    dof: str
    doubts: Doubts
    chain: DoubtSettings | None


def channel_doubts(written: Written, node: Marked, key: str, faults: Faults) -> tuple[ChannelDoubt, ...]:
    """All doubts of a channel that are not zero; faults at their entries."""
    readers: dict[str, Callable[[Written, Path], Iterator[ChannelDoubt]]] = {
        "sensitivity": _of_sensitivity,
        "delay": _of_delay,
        "dof": _of_direction,
        "doubt": _of_chain,
    }
    folder = Path(node.where.rsplit(":", 2)[0]).parent
    doubts: list[ChannelDoubt] = []
    for entry, read in readers.items():
        try:
            doubts.extend(read(written, folder))
        except UnitError as error:
            faults.add_unit(written.entries.get(entry, node), join(key, entry), error)
    return tuple(doubt for doubt in doubts if doubt.doubt.std_error > 0)


def _of_sensitivity(written: Written, folder: Path) -> Iterator[ChannelDoubt]:
    """Relative doubt of a sensitivity: as typed, or that of the slope of the calibration fit that it names."""
    text, doubt = split_doubt(written.sensitivity)
    if "#" in text:
        slope = calibrated_slope(text, folder)
        if slope.std_error:
            number = Uncertain(1.0, abs(slope.std_error / slope.value), dof=slope.dof)
            yield ChannelDoubt("gain", doubt_of(number, f"{written.name}.sensitivity {text}", "1"))
    if doubt:
        number = _relative(text, doubt)
        yield ChannelDoubt("gain", doubt_of(number, f"{written.name}.sensitivity {text}", "1"))


def _relative(text: str, doubt: str) -> Uncertain:
    """A doubt relative to its number: "8 V/mm", "1 %" or "0.08 V/mm"."""
    value, _, unit = text.strip().partition(" ")
    number = parse_uncertain(f"{value} {unit} +- {doubt}", unit)
    return Uncertain(1.0, number.std_error / abs(number.value), dof=number.dof, shape=number.shape, source=number.source)


def _of_delay(written: Written, folder: Path) -> Iterator[ChannelDoubt]:  # noqa: ARG001 (one signature for all readers)
    for name, number in written.doubts:
        if name == "delay":
            yield ChannelDoubt("delay", doubt_of(number, f"{written.name}.delay", "s"))


def _of_direction(written: Written, folder: Path) -> Iterator[ChannelDoubt]:  # noqa: ARG001
    """Doubt of an angle: "45 deg +- 0.5 deg", "x +- 0.5 deg"."""
    _, doubt = split_doubt(written.dof)
    if doubt:
        yield ChannelDoubt("direction", doubt_of(parse_uncertain(f"0 rad +- {doubt}", "rad"), f"{written.name}.dof", "rad"))


def _of_chain(written: Written, folder: Path) -> Iterator[ChannelDoubt]:  # noqa: ARG001
    if written.chain is None:
        return
    if written.chain.gain:
        yield ChannelDoubt("gain", doubt_of(parse_uncertain(f"1 +- {written.chain.gain}", "1"), f"{written.name}.gain", "1"))
    if written.chain.phase:
        yield ChannelDoubt("phase", doubt_of(parse_uncertain(f"0 rad +- {written.chain.phase}", "rad"), f"{written.name}.phase", "rad"))


@dataclass(frozen=True)
class Slope:
    """Slope of a calibration fit [unit] with its standard error and degrees of freedom; no error where the fit has none."""

    value: float
    unit: str
    std_error: float
    dof: float | None


def calibrated_slope(reference: str, folder: Path) -> Slope:
    """The slope of a calibration fit; the reference is FILE#FIT, relative to the rig file. UnitError where there is none."""
    file, _, fit_name = reference.partition("#")
    try:
        fits: dict[str, Mapping[str, Any]] = {fit["name"]: fit for fit in read_digested(folder / file, "identification.json")["fits"]}
        slopes = [parameter for parameter in fits.get(fit_name, {"parameters": ()})["parameters"] if parameter["name"] == "slope"]
        if slopes:
            return _slope(slopes[0], fits[fit_name].get("dof"))
    except DamagedError as error:
        raise UnitError(f"'{file}' is not a readable identification.json of a calibration: {error.what}", error.hint) from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise UnitError(f"'{file}' is not a readable identification.json of a calibration") from None
    raise UnitError(f"'{file}' holds no calibration fit '{fit_name}'", nearest(fit_name, fits))


def _slope(parameter: Mapping[str, Any], dof: Any) -> Slope:
    """The slope of its entry; TypeError or ValueError for an entry that is none."""
    value, error = float(parameter["value"]), float(parameter.get("std_error") or 0.0)
    if not (math.isfinite(value) and math.isfinite(error) and value and error >= 0):
        raise ValueError("no slope")
    return Slope(value, str(parameter["unit"]), error, None if dof is None else float(dof))
