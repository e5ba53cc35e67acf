"""What calibrates a channel: sensitivity, calibration fit, certificate, response; and its uncertainties."""

from __future__ import annotations

import csv
import datetime
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.json_file import read_digested
from labpipe.project.marked_yaml import Marked
from labpipe.project.settings_reader import Faults, join, read_settings
from labpipe.quantities import UnitError, parse_value
from labpipe.raw_files.certificate import FREQUENCY, CertifiedQuantity, read_certificate
from labpipe.records.settings import Settings, Uncertainties, setting, text
from labpipe.records.uncertain import (
    ChannelUncertainty,
    Uncertain,
    Uncertainty,
    parse_uncertain,
    split_uncertainty,
    uncertainty_of,
)
from labpipe.registry import nearest


@dataclass(frozen=True)
class ChainUncertaintySettings(Settings):
    """Standard uncertainties of a channel's whole chain; in brackets, how else they are meant."""

    gain: str = text("of the whole chain, relative: 1 %, or 2 % (k=2), or 1 % (rectangular)")
    phase: str = text("of the whole chain, at every frequency alike: 0.5 deg")


@dataclass(frozen=True)
class Written:
    """What a rig file says of one channel's uncertainties: its *node* in the file, *sensitivity* and *dof* as
    texts, *uncertainties* of its numbers, those that a certificate states.
    """

    name: str
    node: Marked
    sensitivity: str
    dof: str
    uncertainties: Uncertainties
    chain: ChainUncertaintySettings | None
    certified: tuple[ChannelUncertainty, ...] = ()


def channel_uncertainties(written: Written, key: str, faults: Faults) -> tuple[ChannelUncertainty, ...]:
    """All uncertainties of a channel that are not zero; faults at their entries."""
    uncertainties: list[ChannelUncertainty] = []
    for entry, read in READERS.items():
        with faults.of_unit(written.node.content.get(entry, written.node), join(key, entry)):
            uncertainties.extend(read(written))
    return tuple(uncertainty for uncertainty in uncertainties if uncertainty.uncertainty.std_error > 0)


def _sensitivity_uncertainty(written: Written) -> Iterator[ChannelUncertainty]:
    yield from written.certified
    text, uncertainty = split_uncertainty(written.sensitivity)
    if "#" in text:
        slope = calibrated_slope(text, written.node.folder_of("sensitivity"))
        # All channels with this slope have its error.
        source, size = f"sensitivity {text}", abs(slope.std_error / slope.value)
        yield ChannelUncertainty("gain", Uncertainty(source, size, "1", slope.dof))
    if uncertainty:
        yield _channel_uncertainty(written, "gain", _relative(text, uncertainty), f"sensitivity {text}")


def _channel_uncertainty(written: Written, effect: str, number: Uncertain, source: str) -> ChannelUncertainty:
    unit = {"gain": "1", "delay": "s"}.get(effect, "rad")
    uncertainty = uncertainty_of(number, f"{written.name}.{source}", unit)
    return ChannelUncertainty(effect, uncertainty)


def _relative(text: str, uncertainty: str) -> Uncertain:
    value, _, unit = text.strip().partition(" ")
    number = parse_uncertain(f"{value} {unit} +- {uncertainty}", unit)
    return replace(number, value=1.0, std_error=number.std_error / abs(number.value))


def _delay_uncertainty(written: Written) -> Iterator[ChannelUncertainty]:
    if (number := dict(written.uncertainties).get("delay")) is not None:
        yield _channel_uncertainty(written, "delay", number, f"delay {1e6 * number.value:g} us")


def _direction_uncertainty(written: Written) -> Iterator[ChannelUncertainty]:
    text, uncertainty = split_uncertainty(written.dof)
    if uncertainty:
        number = parse_uncertain(f"0 rad +- {uncertainty}", "rad")
        yield _channel_uncertainty(written, "direction", number, f"dof {text}")


def _chain_uncertainty(written: Written) -> Iterator[ChannelUncertainty]:
    for effect, number, unit in (("gain", "1", "1"), ("phase", "0 rad", "rad")):
        if size := getattr(written.chain, effect, ""):
            yield _channel_uncertainty(written, effect, parse_uncertain(f"{number} +- {size}", unit), effect)


# What reads the uncertainties of an entry.
READERS = {
    "sensitivity": _sensitivity_uncertainty,
    "delay": _delay_uncertainty,
    "dof": _direction_uncertainty,
    "uncertainty": _chain_uncertainty,
}


@contextmanager
def readable_result(path: Path, unreadable: str) -> Iterator[dict[str, Any]]:
    """The entries of an identification.json; UnitError where they are not there, or not such as are read."""
    try:
        yield read_digested(path, "identification.json")
    except DamagedError as error:
        raise UnitError(f"{unreadable}: {error.what}", error.hint) from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise UnitError(unreadable) from None


@dataclass(frozen=True)
class Slope:
    """Slope of a calibration fit [unit], its standard error, 0 where the fit has none, degrees of freedom."""

    value: float
    unit: str
    std_error: float
    dof: float | None


def calibrated_slope(reference: str, folder: Path) -> Slope:
    """The slope of a calibration fit by FILE#FIT, relative to the *folder*. UnitError for none."""
    file, _, fit_name = reference.partition("#")
    with readable_result(
        folder / file, f"'{file}' is not a readable identification.json of a calibration"
    ) as result:
        entries = result["fits"]
        fits = [fit for fit in entries if fit["name"] == fit_name]
        pairs = [(entry, fit.get("dof")) for fit in fits for entry in fit["parameters"]]
        slopes = [_slope(entry, dof) for entry, dof in pairs if entry["name"] == "slope"]
        names = [fit["name"] for fit in entries]
    if len(slopes) > 1:
        what = f"'{file}' holds {len(slopes)} calibration fits '{fit_name}'"
        raise UnitError(what, "one for each group; one without a group is needed")
    if not slopes and fits:
        what = f"the fit '{fit_name}' of '{file}' has no slope: it is no line of `calibrate:`"
        raise UnitError(what, "write the number with its uncertainty, as 2.31 mV/N +- 0.3 %")
    if not slopes:
        raise UnitError(f"'{file}' holds no calibration fit '{fit_name}'", nearest(fit_name, names))
    return slopes[0]


def _slope(parameter: Mapping[str, Any], dof: Any) -> Slope:
    value, error = float(parameter["value"]), float(parameter.get("std_error") or 0.0)
    if not (math.isfinite(value) and math.isfinite(error) and value and error >= 0):
        raise ValueError("no slope")
    return Slope(value, str(parameter["unit"]), error, None if dof is None else float(dof))


COLUMNS = ("frequency_hz", "gain", "phase_deg")


def read_sensor_response(path: Path) -> tuple[tuple[float, float, float], ...]:
    """Rows (frequency [Hz], gain [1], phase [rad]) of a table: what the sensor shows over what there is,
    relative to its sensitivity; lines that begin with # are left out. UnitError for a file that is no such
    table, fewer than two rows, a gain not above zero, or frequencies that do not increase.
    """
    try:
        text = path.read_text(encoding="utf-8-sig").splitlines()
        lines = [line for line in text if line.strip() and not line.startswith("#")]
    except OSError:
        hint = "paths are relative to the file that names them"
        raise UnitError(f"no such file '{path.name}'", hint) from None
    except UnicodeDecodeError:
        raise UnitError(f"'{path.name}' is not a text table", f"columns: {', '.join(COLUMNS)}") from None
    rows = list(csv.reader(lines, skipinitialspace=True))
    if not rows or tuple(cell.strip() for cell in rows[0]) != COLUMNS:
        raise UnitError(f"'{path.name}' has other columns", f"columns: {', '.join(COLUMNS)}")
    table = tuple(_row(row, path.name) for row in rows[1:])
    if len(table) < 2 or any(later[0] <= earlier[0] for earlier, later in pairwise(table)):
        raise UnitError(f"'{path.name}' does not hold two or more increasing frequencies")
    return table


def _row(row: list[str], name: str) -> tuple[float, float, float]:
    try:
        frequency, gain, phase = (float(cell) for cell in row)
    except ValueError:
        raise UnitError(f"'{name}': '{','.join(row)}' is not a frequency, gain and phase") from None
    if not (math.isfinite(frequency) and math.isfinite(phase) and frequency >= 0 and 0 < gain < math.inf):
        raise UnitError(f"'{name}': impossible: {frequency:g} Hz, gain {gain:g}, phase {phase:g} deg")
    return frequency, gain, math.radians(phase)


@dataclass(frozen=True, kw_only=True)
class CertificateSettings(Settings):
    """The certificate of a sensitivity, in place of its number."""

    certificate: str = setting("text", "DCC (.xml) or table of certificates (.csv), relative to the rig file")
    quantity: str = setting("text", "id, refType or name of the quantity that is the sensitivity")
    number: str = text("number of the certificate, where a table holds several")
    serial: str = text("serial number of the sensor, which the certificate must name")
    date: str = text("day of the measurement, on which it must be valid; default: today")
    sha256: str = text("digest of the file, so that no change of it goes unnoticed")
    over: str = text("quantity with the frequencies of a sensitivity over frequency")
    at: float | None = setting(
        "value", "frequency at which the sensitivity is stated, that of a response of 1", "Hz", None
    )
    phase: str = text("quantity with the phase over the same frequencies")


@dataclass(frozen=True)
class Certified:
    """What a certificate gives: the sensitivity as a *text*, its uncertainties, and rows (frequency [Hz],
    gain [1], phase [rad]) of the response over frequency, if it states one.
    """

    text: str
    uncertainties: tuple[ChannelUncertainty, ...]
    response: tuple[tuple[float, float, float], ...] = ()


def certified_sensitivity(node: Marked, folder: Path, key: str, faults: Faults) -> Certified | None:
    """The sensitivity of a channel by its certificate in a *folder*; None and a fault without."""
    settings = read_settings(CertificateSettings, node, key, faults)
    with faults.of_unit(node, key):
        return None if settings is None else _certify(settings, folder)
    return None


def _certify(settings: CertificateSettings, folder: Path) -> Certified:
    certificate = read_certificate(folder / settings.certificate, settings.number, settings.sha256)
    named = f"certificate '{certificate.number}'"
    if certificate.refused:
        raise UnitError(f"{named}: {certificate.refused}")
    _check_day(settings, certificate.valid_until, named)
    stated = certificate.quantity(settings.quantity)
    serials = stated.serials or certificate.serials
    if settings.serial and settings.serial not in serials:
        what = f"{named} is not of serial number '{settings.serial}'"
        what += f" in '{settings.quantity}'" if stated.serials else ""
        raise UnitError(what, f"it names: {', '.join(serials) or 'none'}")
    if stated.std_errors is None:
        raise UnitError(f"{named} states no uncertainty of '{settings.quantity}'")
    if not all(stated.values):
        raise UnitError(f"{named} states a sensitivity of zero")
    source = f"certificate {certificate.number}"
    relative = max(u / abs(value) for u, value in zip(stated.std_errors, stated.values, strict=True))
    gain = ChannelUncertainty("gain", Uncertainty(source, relative, "1"))
    if not settings.over:
        if len(stated.values) > 1:
            hint = f"over: {FREQUENCY}, at: 80 Hz"
            raise UnitError(f"'{settings.quantity}' has {len(stated.values)} values, no single one", hint)
        if settings.phase or settings.at is not None:
            raise UnitError("'at' and 'phase' belong to a sensitivity over frequency", "add over: frequency")
        return Certified(f"{stated.values[0]!r} {stated.unit}", (gain,) if relative else ())
    frequencies = certificate.quantity(settings.over, stated.table)
    phases = certificate.quantity(settings.phase, stated.table) if settings.phase else None
    at, response = _course_over_frequency(settings, stated, frequencies, phases)
    uncertainties = [gain] if relative else []
    if phases is not None:
        if phases.std_errors is None:
            raise UnitError(f"{named} states no uncertainty of '{settings.phase}'")
        error = max(parse_value(f"{u!r} {phases.unit}", "rad") for u in phases.std_errors)
        of_phase = Uncertainty(f"{source}, phase", error, "rad")
        uncertainties.append(ChannelUncertainty("phase", of_phase))
    return Certified(f"{at!r} {stated.unit}", tuple(uncertainties), response)


def _check_day(settings: CertificateSettings, valid_until: datetime.date | None, named: str) -> None:
    """UnitError where the certificate is not valid on the day, on which no number depends."""
    try:
        day = datetime.date.fromisoformat(settings.date) if settings.date else datetime.date.today()
    except ValueError:
        raise UnitError(f"date: '{settings.date}' is not a day", "write it as 2026-11-03") from None
    if valid_until is not None and day > valid_until:
        hint = "" if settings.date else "say when was measured, date: 2026-11-03, if it was valid then"
        raise UnitError(f"{named} has expired: it was valid until {valid_until}", hint)


def _course_over_frequency(
    settings: CertificateSettings,
    stated: CertifiedQuantity,
    frequencies: CertifiedQuantity,
    phases: CertifiedQuantity | None,
) -> tuple[float, tuple[tuple[float, float, float], ...]]:
    count = len(stated.values)
    columns = [column for column in (frequencies, phases) if column is not None]
    if count < 2 or any(len(column.values) != count for column in columns):
        raise UnitError(f"'{settings.over}' or '{settings.phase}' does not have {count} values, two at least")
    hertz = [parse_value(f"{f!r} {frequencies.unit}", "Hz") for f in frequencies.values]
    if any(later <= earlier for earlier, later in pairwise(hertz)) or hertz[0] < 0:
        raise UnitError(f"the frequencies '{settings.over}' do not increase from zero")
    if any(value * stated.values[0] <= 0 for value in stated.values):
        raise UnitError(f"'{settings.quantity}' changes its sign over frequency", "state the phase beside it")
    if settings.at not in hertz:
        listed = ", ".join(f"{f:g} Hz" for f in hertz[:12])
        raise UnitError("'at' is not among the frequencies of the certificate", f"one of {listed}")
    place = hertz.index(settings.at)
    radians = [0.0] * count
    if phases is not None:
        radians = [parse_value(f"{phase!r} {phases.unit}", "rad") for phase in phases.values]
    rows = zip(hertz, stated.values, radians, strict=True)
    return stated.values[place], tuple((f, s / stated.values[place], phase) for f, s, phase in rows)
