"""Reading one fit of the ``identify:`` section: its settings and those of its model."""

from __future__ import annotations

from typing import Any

from labpipe.config.faults import join
from labpipe.config.reader import read_settings
from labpipe.config.reading import Reading
from labpipe.identify.settings import MODELS, FitSettings, model_kind, takers
from labpipe.marked_yaml import Marked
from labpipe.records.settings import settings_of


def read_fit(node: Marked, key: str, name: str, reading: Reading) -> FitSettings | None:
    """The settings of a fit, `mass` by default that of the rig. None and faults where they cannot be read."""
    faults, before = reading.faults, len(reading.faults)
    entries = faults.mapping(node, key)
    presets: dict[str, Any] = {"name": name}
    section = _section_of(entries)
    entries = _in_section(entries) if not section else entries
    section = section or _section_of(entries)
    if section:
        model, entry = section
        if entries["model"].text != model:
            faults.add(entries[entry], join(key, entry), f"the section '{entry}' goes with model {model}", model_kind(model).example)
        else:
            presets["model_settings"] = _model_settings(entries[entry], join(key, entry), model, reading)
    rig = reading.rig
    if rig is not None and rig.mass is not None and _takes_mass(entries):
        presets |= {"mass": rig.mass, "doubts": () if rig.mass_doubt is None else (("mass", rig.mass_doubt),)}
    plain = Marked({entry: part for entry, part in entries.items() if not section or entry != section[1]}, node.where, node.key_where)
    return read_settings(FitSettings, plain, key, faults, **presets) if len(faults) == before else None


def _takes_mass(entries: dict[str, Marked]) -> bool:
    """Whether a fit has no mass of its own, and a model that takes one."""
    model = entries["model"].text if "model" in entries else ""
    return "mass" not in entries and model in takers("mass")


def _in_section(entries: dict[str, Marked]) -> dict[str, Marked]:
    """The entries with the settings of a model that needs no section, where they stand in the fit itself, moved into its section."""
    model = entries["model"].text if "model" in entries else ""
    kind = model_kind(model) if model in MODELS else None
    if kind is None or kind.settings is None or not kind.optional:
        return entries
    moved = [key for key in settings_of(kind.settings) if key in entries and key not in settings_of(FitSettings)]
    if not moved:
        return entries
    first = entries[moved[0]]
    inner = Marked({key: entries[key] for key in moved}, first.where, first.key_where)
    return {**{key: node for key, node in entries.items() if key not in moved}, kind.section: inner}


def _section_of(entries: dict[str, Marked]) -> tuple[str, str] | None:
    """(model, key) of the model's section among the entries of a fit."""
    for model in MODELS:
        kind = model_kind(model)
        if kind.section and kind.section in entries and "model" in entries:
            return model, kind.section
    return None


def _model_settings(node: Marked, key: str, model: str, reading: Reading) -> Any:
    owner = model_kind(model).settings
    assert owner is not None
    return read_settings(owner, node, key, reading.faults)
