"""Settings check and convert their values at birth, whoever makes them: every settings class of labpipe,
every field.
"""

from __future__ import annotations

import dataclasses
import inspect
import pkgutil
from importlib import import_module
from typing import Any

import pytest

import labpipe
from labpipe.errors import ConfigError
from labpipe.estimation.settings import FitSettings, Sliding, Support
from labpipe.quantities import UnitError
from labpipe.records.settings import CONVERTERS, Setting, Settings, convert_fields, setting, settings_of
from labpipe.records.uncertain import Uncertain
from labpipe.spectra.settings import FrfSettings


def all_settings() -> list[type]:
    """Every dataclass of labpipe that declares settings."""
    for module in pkgutil.walk_packages(labpipe.__path__, "labpipe."):
        import_module(module.name)
    owners, queue = [], [Settings]
    while queue:
        below = queue.pop().__subclasses__()
        queue.extend(below)
        owners.extend(owner for owner in below if _is_settings(owner))
    return sorted(set(owners), key=lambda owner: (owner.__module__, owner.__name__))


def _is_settings(owner: type) -> bool:
    return (
        owner.__module__.startswith("labpipe.")
        and dataclasses.is_dataclass(owner)
        and not inspect.isabstract(owner)
    )


OWNERS = all_settings()


def example(declared: Setting) -> Any:
    """A value of the setting's kind as people write it; a nested section that is not yet born."""
    if declared.kind == "section":
        return unchecked(declared.section) if declared.section is not None else None
    value = f"2 {declared.unit}" if declared.unit not in ("", "1") else "2"
    return {
        "value": value,
        "uncertain": f"{value} +- 1 %",
        "band": f"2-3 {declared.unit}",
        "bands": [f"2-3 {declared.unit}"],
        "peaks": {"x": f"2-3 {declared.unit}"},
        "integer": 2,
        "span": "2-60",
        "flag": True,
        "text": "words",
        "file": "file.yaml",
        "choice": declared.choices[0] if declared.choices else "",
        "names": ["a", "b"],
        "mass": "2 kg",
        "values": [value, value],
        "matrix": [[value, value], [value, value]],
        "coefficients": {"k_1": "2 N/m"},
        "series": {"a": [value]},
        "groups": [["a", "b"]],
        "roots": ["-100", "-50 +- 300j"],
        "phasors": {"disc": f"{value} at 90 deg"},
        "texts": {"disc": "3 y"},
    }.get(declared.kind)


def unchecked(owner: type, **fields: Any) -> Any:
    """An instance whose fields hold what is given or their defaults; not yet born."""
    instance = object.__new__(owner)
    for field in dataclasses.fields(owner):
        given = fields.get(field.name, field.default)
        if given is dataclasses.MISSING and "setting" in field.metadata:
            declared = field.metadata["setting"]
            given = {} if declared.kind == "entries" else example(declared)
        object.__setattr__(instance, field.name, given)
    return instance


def test_every_kind_of_setting_has_an_example_here() -> None:
    plain = [kind for kind in CONVERTERS if kind not in ("section", "sections", "entries")]
    assert all(example(Setting(kind, "", unit="m", choices=("a",))) is not None for kind in plain)
    assert {declared.kind for owner in OWNERS for declared, _ in settings_of(owner).values()} <= set(
        CONVERTERS
    )


def test_dataclasses_that_declare_settings_are_settings() -> None:
    """A class that forgets its base would take anything."""
    for module in pkgutil.walk_packages(labpipe.__path__, "labpipe."):
        for value in vars(import_module(module.name)).values():
            if isinstance(value, type) and dataclasses.is_dataclass(value) and settings_of(value):
                assert issubclass(value, Settings), value


@pytest.mark.parametrize("owner", OWNERS, ids=lambda owner: owner.__name__)
def test_a_field_of_the_wrong_type_is_named(owner: type) -> None:
    for name in settings_of(owner):
        with pytest.raises(ConfigError) as caught:
            convert_fields(unchecked(owner, **{name: object()}))
        assert str(caught.value).startswith(f"{name}: ") and caught.value.field == name


@pytest.mark.parametrize("owner", OWNERS, ids=lambda owner: owner.__name__)
def test_what_people_write_becomes_si_once(owner: type) -> None:
    """Converting again changes nothing: a copy made with dataclasses.replace is the same."""
    for name, (declared, _) in settings_of(owner).items():
        written = example(declared)
        if written is None:
            continue
        instance = unchecked(owner, **{name: written})
        convert_fields(instance)
        first = getattr(instance, name)
        convert_fields(instance)
        assert getattr(instance, name) == first
        assert declared.kind not in ("value", "values", "band", "uncertain", "mass") or not isinstance(
            first, str
        )


def test_units_are_welcome_from_python() -> None:
    """The same settings, in words and in SI."""
    combination_text = FitSettings(
        "sdof",
        mass="790 g",
        band="60-70 Hz",
        subtract=Support("134.5 kN/m +- 1 %"),
        sliding={"width": "15 Hz", "step": "3 Hz"},
    )
    in_si = FitSettings(
        "sdof",
        mass=0.79,
        band=(60.0, 70.0),
        subtract=Support(Uncertain(134.5e3, 1345.0)),
        sliding=Sliding(15.0, 3.0),
    )
    assert combination_text == in_si
    assert FrfSettings("periodic", period="500 ms", overlap="50 %") == FrfSettings(
        "periodic", period=0.5, overlap=0.5
    )


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"band": "60-70 Hx"}, "band: unknown unit 'Hx'; did you mean 'Hz'?"),
        ({"band": "70-60 Hz"}, "band: the band '70-60 Hz' is empty"),
        ({"band": (60.0, 50.0)}, "band: the band '60-50 Hz' is empty"),
        ({"band": 60.0}, "band: '60.0' is not a band"),
        ({"mass": "0.9 m"}, "mass: 'm' has the wrong dimension"),
        ({"mass": float("nan")}, "mass: not-a-number is not a value"),
        ({"estimator": "mll"}, "estimator: unknown choice 'mll'; did you mean 'ml'?"),
        ({"share": 1.5}, "share: '1.5' is not a whole number"),
        ({"share": -1}, "share: '-1' is not a whole number"),
        ({"symmetric": "yes"}, "symmetric: 'yes' is neither true nor false"),
        ({"input": [1]}, "input: '1' is not a text"),
        ({"sliding": "15 Hz"}, "sliding: '15 Hz' is not a section of settings"),
        (
            {"sliding": {"width": "15 Hz", "stepp": 3.0}},
            "sliding: got an unexpected keyword argument 'stepp'",
        ),
        ({"fixed": {"q_1": 3.0}}, "fixed: 'q_1' is not a coefficient"),
        ({"peaks": {}}, "peaks: is empty"),
        ({"tied": "k_1"}, "tied: 'k_1' is not a list of names"),
        *(
            ({key: []}, f"{key}: is empty")
            for key in ("input", "output", "test", "bands", "tied", "repeat_groups")
        ),
    ],
)
def test_faults_of_a_fit_made_in_python(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        FitSettings("sdof", **changes)
    assert said in str(caught.value)


def test_a_kind_that_nobody_reads_cannot_be_declared() -> None:
    with pytest.raises(ValueError, match="unknown kind of setting 'lenght'"):
        setting("lenght", "a typo")


def test_checks_of_a_class_see_si_numbers() -> None:
    @dataclasses.dataclass(frozen=True)
    class Length(Settings):
        length: float = setting("value", "a length", unit="m")

        def __post_init__(self) -> None:
            if self.length > 1:
                raise ConfigError("too long", field="length")

    assert Length("900 mm").length == pytest.approx(0.9)
    with pytest.raises(ConfigError, match="too long"):
        Length("2 m")


def test_phasors_and_matrices() -> None:
    unbalance = CONVERTERS["phasors"](
        {"disc": "50 g.mm at 90 deg", "rim": 1e-5}, Setting("phasors", "", unit="kg.m")
    )
    assert unbalance[0][1] == pytest.approx(5e-5j) and unbalance[1] == ("rim", 1e-5 + 0j)
    with pytest.raises(UnitError, match="disc: 'g' has the wrong dimension"):
        CONVERTERS["phasors"]({"disc": "50 g"}, Setting("phasors", "", unit="kg.m"))
    with pytest.raises(UnitError, match="not equally long"):
        CONVERTERS["matrix"]([["1 m"], ["1 m", "2 m"]], Setting("matrix", "", unit="m"))
    assert CONVERTERS["matrix"](((1.0, 2.0),), Setting("matrix", "", unit="m")) == ((1.0, 2.0),)
