"""Declaring a parameter once: the frozen dataclass of a stage feeds the YAML reader, the schema, the help and the docs."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import MISSING
from typing import Any

from labpipe.errors import ConfigError
from labpipe.quantities import UnitError
from labpipe.records.setting_values import CONVERTERS, Setting
from labpipe.records.uncertain import Uncertain, is_doubtful, parse_uncertain

__all__ = ["Setting", "Settings", "Uncertain", "setting", "settings_of"]


# Numbers of settings that carry a doubt, by the names of their fields.
Doubts = tuple[tuple[str, Uncertain], ...]


class Settings:
    """Base of every settings dataclass: its values are converted and checked at birth, whoever makes it.

    FrfSettings("periodic", period="1 s") and FrfSettings("periodic", period=1.0) are the same. ConfigError names the field that is wrong.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Convert to SI before the checks of the class."""
        super().__init_subclass__(**options)
        check = cls.__dict__.get("__post_init__")
        if check is None:
            return

        @functools.wraps(check)
        def convert_and_check(self: Settings) -> None:
            _convert(self)
            check(self)

        cls.__post_init__ = convert_and_check  # type: ignore[method-assign]

    def __post_init__(self) -> None:
        _convert(self)


def _convert(settings: Any) -> None:
    """Every declared field in SI units and of its type; ConfigError with the field's name."""
    for field in dataclasses.fields(settings):
        if "setting" not in field.metadata:
            continue
        value = getattr(settings, field.name)
        if value is field.default:
            continue
        declared: Setting = field.metadata["setting"]
        try:
            if takes_doubt(type(settings), declared) and is_doubtful(value):
                value = _noted(settings, field.name, parse_uncertain(value, declared.unit))
            object.__setattr__(settings, field.name, CONVERTERS[declared.kind](value, declared))
        except UnitError as error:
            raise ConfigError(f"{field.name}: {error.what}", hint=error.hint, field=field.name) from None


def _noted(settings: Any, name: str, number: Uncertain) -> float:
    """The value of a number with a doubt, which is noted among the settings' doubts."""
    others = tuple(pair for pair in settings.doubts if pair[0] != name)
    object.__setattr__(settings, "doubts", (*others, (name, number)))
    return number.value


def takes_doubt(owner: type, declared: Setting) -> bool:
    """Whether a number of these settings may carry its doubt: "0.92 kg +- 1 %"; those settings have a field *doubts*."""
    return declared.kind in ("value", "mass") and any(field.name == "doubts" for field in dataclasses.fields(owner))


def setting(
    kind: str,
    help: str,
    *,
    unit: str = "",
    default: Any = MISSING,
    choices: tuple[str, ...] = (),
    section: type | None = None,
    file_kind: str = "",
    into: str = "",
    needed: bool = False,
) -> Any:
    """A dataclass field that carries a Setting of a kind of CONVERTERS; without a default the YAML must give it."""
    if kind not in CONVERTERS:
        raise ValueError(f"unknown kind of setting '{kind}'")
    declared = Setting(kind, help, unit=unit, choices=choices, section=section, file_kind=file_kind, into=into, needed=needed)
    return dataclasses.field(default=default, metadata={"setting": declared})


def settings_of(owner: type) -> dict[str, tuple[Setting, bool]]:
    """Field name -> (its Setting, whether it must be given) of a settings dataclass, in order of declaration."""
    declared = [(field, field.metadata["setting"]) for field in dataclasses.fields(owner) if "setting" in field.metadata]
    return {field.name: (setting, field.default is MISSING or setting.needed) for field, setting in declared}
