"""A parameter is declared once: what the declaration says is what the readers, the help and the schema
get.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module

import pytest

from labpipe.project.schema import pipeline_schema, rig_schema
from labpipe.quantities import parse_unit
from labpipe.records.settings import CONVERTERS, Setting, Settings, setting, settings_of
from labpipe.records.uncertain import Uncertain


@dataclass(frozen=True)
class Inner(Settings):
    """A section of its own."""

    width: float = setting("value", "width of a band", unit="Hz")


@dataclass(frozen=True)
class Outer(Settings):
    """Settings of a stage."""

    name: str
    period: float = setting("value", "period of the excitation", unit="s")
    window: str = setting("choice", "window", choices=("hann", "none"), default="hann")
    sliding: Inner | None = setting("section", "moving band", section=Inner, default=None)
    note: str = ""


def test_settings_stand_in_the_order_of_their_declaration() -> None:
    assert list(settings_of(Outer)) == ["period", "window", "sliding"]


def test_plain_fields_are_no_settings() -> None:
    assert "name" not in settings_of(Outer) and "note" not in settings_of(Outer)


def test_what_has_no_default_must_be_given() -> None:
    assert {name: needed for name, (_, needed) in settings_of(Outer).items()} == {
        "period": True,
        "window": False,
        "sliding": False,
    }


def test_a_declaration_is_kept_whole() -> None:
    declared = {name: found for name, (found, _) in settings_of(Outer).items()}
    assert declared["period"] == Setting("value", "period of the excitation", unit="s")
    assert declared["window"] == Setting("choice", "window", choices=("hann", "none"))
    assert declared["sliding"] == Setting("section", "moving band", section=Inner)


def test_defaults_are_those_of_the_dataclass() -> None:
    made = Outer("n", 1.0)  # type: ignore[call-arg]
    assert (made.window, made.sliding, made.note) == ("hann", None, "")


def test_an_unknown_kind_is_refused_where_it_is_declared() -> None:
    with pytest.raises(ValueError, match="unknown kind of setting 'number'"):
        setting("number", "help")


def test_an_uncertain_value_is_exact_unless_it_says_otherwise() -> None:
    assert Uncertain(3.0).std_error == 0.0


STAGES = (
    "labpipe.project.rig_file:RigSettings",
    "labpipe.project.rig_file:ChannelSettings",
    "labpipe.methods.calibration.section:CalibrationSettings",
    "labpipe.spectra.settings:FrfSettings",
    "labpipe.estimation.settings:FitSettings",
    "labpipe.uncertainty.study:StudySettings",
    "labpipe.uncertainty.settings:CompareSettings",
)


def every_setting(owner: type) -> list[tuple[str, Setting]]:
    """All settings of a dataclass and of its sections."""
    below = [(f"{owner.__name__}.{name}", found) for name, (found, _) in settings_of(owner).items()]
    return [
        *below,
        *(pair for _, found in below if found.section is not None for pair in every_setting(found.section)),
    ]


@pytest.mark.parametrize("address", STAGES)
def test_every_declared_setting_can_be_read_and_explained(address: str) -> None:
    module, _, name = address.partition(":")
    for key, found in every_setting(getattr(import_module(module), name)):
        assert found.kind in CONVERTERS, key
        assert len(found.help) > 5 and found.help[0] != " " and not found.help.endswith("."), key
        assert (found.section is None) == (found.kind != "section"), key
        assert bool(found.choices) == (found.kind == "choice"), key
        parse_unit(found.unit or "1")


def described(schema: dict, path: str = "") -> list[tuple[str, dict]]:
    """(dotted key, its schema) of all properties."""
    found = [(f"{path}{name}", entry) for name, entry in schema.get("properties", {}).items()]
    below = [pair for name, entry in found for pair in described(entry, f"{name}.")]
    extra = schema.get("additionalProperties")
    return [*found, *below, *(described(extra, f"{path}*.") if isinstance(extra, dict) else [])]


@pytest.mark.parametrize("schema", [rig_schema(), pipeline_schema()], ids=["rig", "pipeline"])
def test_the_schema_knows_every_entry_and_lets_no_other_in(schema: dict) -> None:
    keys = dict(described(schema))
    assert len(keys) > 10
    for key, entry in keys.items():
        if "properties" in entry:
            assert entry["additionalProperties"] is False and set(entry.get("required", [])) <= set(
                entry["properties"]
            ), key


def test_the_schema_states_units_and_choices_as_declared() -> None:
    keys = dict(described(pipeline_schema()))
    assert keys["frf.period"]["description"].endswith("[s]")
    assert keys["identify.*.band"] == {
        "type": "string",
        "description": keys["identify.*.band"]["description"],
    }
    declared = settings_of(import_module("labpipe.spectra.settings").FrfSettings)["estimator"][0]
    assert keys["frf.estimator"]["enum"] == list(declared.choices)
