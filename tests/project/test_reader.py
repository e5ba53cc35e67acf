"""From a mapping to settings: every fault at its place, all in one pass, nothing half read."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from labpipe.errors import ConfigError, ConfigErrors
from labpipe.project.marked_yaml import parse_marked
from labpipe.project.settings_reader import DECIDE, Faults, join, read_settings
from labpipe.quantities import UnitError
from labpipe.records.settings import setting


@dataclass(frozen=True)
class Shift:
    """A moving band."""

    width: float = setting("value", "width of a band", unit="Hz")
    step: float = setting("value", "step from band to band", unit="Hz", default=1.0)


@dataclass(frozen=True)
class Fit:
    """Settings as a stage declares them."""

    model: str = setting("choice", "model", choices=("sdof", "mdof"))
    mass: float | None = setting("value", "moving mass", unit="kg", default=None)
    share: int = setting("integer", "bearings in parallel", default=1)
    sliding: Shift | None = setting("section", "moving band", section=Shift, default=None)
    name: str = ""

    def __post_init__(self) -> None:
        if self.share == 0:
            raise ConfigError("'share' is nought", hint="at least 1")


def read(text: str, **given: object) -> tuple[Fit | None, list[str]]:
    """(settings, every fault as people read it)."""
    faults = Faults()
    found = read_settings(Fit, parse_marked(text, "p.yaml"), "identify.direct", faults, **given)
    try:
        faults.raise_any()
    except ConfigErrors as error:
        return found, [str(fault) for fault in error.faults]
    return found, []


def test_what_is_given_is_read_and_the_rest_is_default() -> None:
    assert read("model: sdof\nmass: 920 g\n") == (Fit("sdof", 0.92), [])
    assert read("model: mdof\nsliding: {width: 15 Hz}\n") == (Fit("mdof", sliding=Shift(15.0, 1.0)), [])


def test_fields_that_no_file_holds_come_from_the_reader() -> None:
    assert read("model: sdof\n", name="direct") == (Fit("sdof", name="direct"), [])


def test_a_given_field_stands_in_for_a_missing_entry_and_gives_way_to_one() -> None:
    assert read("{}", model="mdof") == (Fit("mdof"), [])
    assert read("model: sdof\n", model="mdof") == (Fit("sdof"), [])


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (
            "modell: sdof\nmodel: sdof\n",
            "p.yaml:1:1: identify.direct.modell: unknown key; did you mean 'model'?",
        ),
        (
            "model: sdof\nmass: 3\n",
            "p.yaml:2:1: identify.direct.mass: '3' has no unit; write it with its unit, e.g. '3 kg'",
        ),
        ("mass: 3 kg\n", "p.yaml:1:1: identify.direct.model: is missing; model"),
        (
            "model: sdof\nsliding: {step: 3 Hz}\n",
            "p.yaml:2:1: identify.direct.sliding.width: is missing; width of a band",
        ),
        (
            "model: sdof\nsliding: 15 Hz\n",
            "p.yaml:2:1: identify.direct.sliding: a mapping of keys to values is needed",
        ),
        ("- sdof\n", "p.yaml:1:1: identify.direct: a mapping of keys to values is needed"),
        ("model: sdof\nshare: 0\n", "p.yaml:1:1: identify.direct: 'share' is nought; at least 1"),
        (f"model: {DECIDE}\n", "p.yaml:1:1: identify.direct.model: is still to be decided; model"),
    ],
)
def test_a_fault_stands_at_its_place(text: str, fault: str) -> None:
    found, faults = read(text)
    assert found is None and fault in faults


def test_all_faults_are_named_in_one_pass() -> None:
    found, faults = read("modle: sdof\nmass: 3 N\nshare: -1\nsliding: {width: 3 kg, stepp: 1 Hz}\n")
    assert found is None
    keys = ["modle", "model", "mass", "share", "sliding.stepp", "sliding.width"]
    assert sorted(fault.split(": ")[1] for fault in faults) == sorted(
        f"identify.direct.{key}" for key in keys
    )


def test_a_fault_elsewhere_does_not_make_sound_settings_faulty() -> None:
    """The reader counts its own faults only."""
    faults = Faults()
    faults.add(parse_marked("a: 1", "other.yaml"), "", "something else")
    assert read_settings(Fit, parse_marked("model: sdof", "p.yaml"), "", faults) == Fit("sdof")
    assert len(faults) == 1


# the collection itself


def test_no_faults_raise_nothing() -> None:
    Faults().raise_any()


def test_faults_are_raised_once_in_their_order() -> None:
    faults, tree = Faults(), parse_marked("a: 1\nb: 2\n", "p.yaml")
    faults.add(tree.content["b"], "b", "second")
    with faults.of_unit(tree.content["a"], "a"):
        raise UnitError("first", "a hint")
    with pytest.raises(ConfigErrors) as caught:
        faults.raise_any()
    assert str(caught.value) == "p.yaml:2:1: b: second\np.yaml:1:1: a: first; a hint"


def test_faults_of_another_file_are_taken_over_one_by_one() -> None:
    faults = Faults()
    faults.merge(
        ConfigErrors([ConfigError("one", where="rig.yaml:1:1"), ConfigError("two", where="rig.yaml:2:1")])
    )
    faults.merge(ConfigError("three", where="rotor.yaml"))
    assert len(faults) == 3
    with pytest.raises(ConfigErrors) as caught:
        faults.raise_any()
    assert [fault.where for fault in caught.value.faults] == ["rig.yaml:1:1", "rig.yaml:2:1", "rotor.yaml"]


@pytest.mark.parametrize(
    ("keys", "joined"),
    [(("a", "b"), "a.b"), (("", "b"), "b"), (("a", ""), "a"), ((), ""), (("a", "", "c"), "a.c")],
)
def test_dotted_keys(keys: tuple[str, ...], joined: str) -> None:
    assert join(*keys) == joined


def test_an_override_is_a_place_of_its_own() -> None:
    from labpipe.project.marked_yaml import set_entry

    tree, faults = parse_marked("model: sdof\n", "p.yaml"), Faults()
    set_entry(tree, "mass=3 N")
    assert read_settings(Fit, tree, "", faults) is None
    with pytest.raises(ConfigErrors, match="--set mass=3 N: mass: 'N' has the wrong dimension"):
        faults.raise_any()


@pytest.mark.parametrize(
    ("text", "unknown"),
    [
        ("model: sdof\nmodell: x\nmas: 1 kg\nshares: 2\n", ["modell", "mas", "shares"]),
        ("frf: 1\nrig: 2\nidentify: 3\nmodel: sdof\n", ["frf, rig and 1 more"]),
    ],
)
def test_a_file_of_another_kind_is_one_fault_and_typing_errors_are_one_each(
    text: str, unknown: list[str]
) -> None:
    faults = Faults()
    read_settings(Fit, parse_marked(text, "p.yaml"), "", faults)
    with pytest.raises(ConfigErrors) as caught:
        faults.raise_any()
    assert [str(fault).split(": ")[1] for fault in caught.value.faults] == unknown
