"""Declaring a parameter once: the frozen dataclass of a stage feeds the YAML reader, the schema, the help and
the docs.

One converter for each kind of setting; texts carry their unit, bare numbers are SI. UnitError says what is
wrong. Files and Python scripts go through the same converters.
"""

from __future__ import annotations

import cmath
import dataclasses
import functools
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import KW_ONLY, MISSING, dataclass, replace
from numbers import Complex, Integral, Real
from pathlib import Path
from typing import Any

from labpipe.errors import SettingError, shorten
from labpipe.quantities import UnitError, parse_value
from labpipe.records.uncertain import Uncertain, is_uncertain, parse_uncertain
from labpipe.registry import nearest


@dataclass(frozen=True)
class FileKind:
    """*load*: the content of a file, ConfigError where it cannot be read; *files*: the file and every file
    that it names itself.
    """

    load: Callable[[Path], Any]
    files: Callable[[Path], tuple[Path, ...]] = lambda path: (path,)


# Roots of polynomials as texts: "-100", "-100+300j", and "-100 +- 300j" for the pair.

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_ROOT = re.compile(rf"^(?P<real>[+-]?{_NUMBER})?(?:(?P<sign>\+-|[+-])?(?P<imaginary>{_NUMBER})?[ij])?$")
EXAMPLE = "for example [-100, -50 +- 300j], in rad/s"


def to_roots(
    value: Any,
    setting: Any,  # noqa: ARG001 (one signature for the whole table)
) -> tuple[complex, ...]:
    """A list of real and complex numbers; a pair of conjugates may be written as one, "-50 +- 300j"."""
    if isinstance(value, (str, Complex)):
        value = [value]
    if not isinstance(value, Iterable) or isinstance(value, Mapping):
        raise UnitError("a list of roots is needed", EXAMPLE)
    return tuple(root for entry in value for root in _roots(entry))


def _roots(entry: Any) -> tuple[complex, ...]:
    if isinstance(entry, Complex) and not isinstance(entry, bool):
        return (complex(entry),)
    text = "".join(str(entry).replace("±", "+-").replace("rad/s", "").split())
    match = _ROOT.match(text)
    if match is None or not text:
        raise UnitError(f"'{shorten(str(entry))}' is not a root", EXAMPLE)
    real = float(match["real"] or 0.0)
    if text[-1] not in "ij":
        return (complex(real),)
    if match["sign"] is None and match["real"] is not None:
        # "300j" alone: what was read as the real part is the imaginary one.
        return (complex(0.0, real),)
    imaginary = float(match["imaginary"] or 1.0)
    if match["sign"] == "+-":
        return (complex(real, imaginary), complex(real, -imaginary))
    return (complex(real, -imaginary if match["sign"] == "-" else imaginary),)


# The unit of a coefficient by the first letter of its name.
COEFFICIENT_UNITS = {"k": "N/m", "c": "N.s/m", "m": "kg", "b": "1", "h": "N/m"}
ESTIMATE = "estimate"
# No count of a test rig comes near it.
LARGEST_INTEGER = 10**9
_VALUE = r"(\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?)"
_BAND = re.compile(rf"^\s*{_VALUE}\s*((?!to\b)[^\d\s.–-][^\s–]*?)?\s*(?:-|–|\.\.|to)\s*{_VALUE}\s*(.*?)\s*$")

Band = tuple[float, float]


@dataclass(frozen=True)
class Setting:
    """Declaration of a settings field: its kind, SI unit, choices, and one line of help.

    A file: *file_kind* says what it holds ("rotor"), and its content is read into the field *into* of the
    same dataclass. *needed*: a file must give it, although the dataclass has a default. *may_be_empty*: a
    list of nothing says something else than no list. *before*: its key in the version before, which is still
    read.
    """

    kind: str
    help: str
    _: KW_ONLY
    unit: str = ""
    choices: tuple[str, ...] = ()
    section: type | None = None
    file_kind: str = ""
    into: str = ""
    needed: bool = False
    may_be_empty: bool = False
    before: str = ""


def to_value(value: Any, setting: Setting) -> float:
    """ "15 Hz" -> 15.0; the dimension is checked. A number is SI."""
    if isinstance(value, Real) and not isinstance(value, bool):
        if math.isnan(value):
            raise UnitError("not-a-number is not a value")
        return float(value)
    return parse_value(_text(value, f"a value with its unit, for example '1 {setting.unit}'"), setting.unit)


def to_uncertain(value: Any, setting: Setting) -> Uncertain:
    """ "134.5 kN/m +- 0.4 kN/m" or "... +- 1 %" -> value and standard error."""
    if isinstance(value, Uncertain):
        return value
    if isinstance(value, Real) and not isinstance(value, bool):
        return Uncertain(to_value(value, setting))
    return parse_uncertain(_text(value, "a value with its unit"), setting.unit)


def to_band(value: Any, setting: Setting) -> Band:
    """ "1-250 Hz" -> (1.0, 250.0)."""
    if _is_pair_of_numbers(value):
        low, high = (float(end) for end in value)
        text = f"{low:g}-{high:g} {setting.unit}"
    else:
        text = _text(value, _band_example(setting))
        low, high = _parsed_band(text, setting)
    if not low < high:
        raise UnitError(f"the band '{text}' is empty", "the lower frequency comes first")
    return low, high


def _band_example(setting: Setting) -> str:
    return f"a band, for example '10-20 {setting.unit}'"


def _parsed_band(text: str, setting: Setting) -> Band:
    match = _BAND.match(text)
    if match is None:
        raise UnitError(f"'{text}' is not a band", f"write {_band_example(setting)}")
    high_unit = match[4]
    low = parse_value(f"{match[1]} {match[2] or high_unit}".strip(), setting.unit)
    return low, parse_value(f"{match[3]} {high_unit}".strip(), setting.unit)


def to_bands(value: Any, setting: Setting) -> tuple[Band, ...]:
    """A list of bands, or one."""
    several = _is_list(value) and not _is_pair_of_numbers(value)
    return tuple(to_band(entry, setting) for entry in (value if several else [value]))


def to_peaks(value: Any, setting: Setting) -> tuple[tuple[str, tuple[Band, ...]], ...]:
    """{x: 700-1100 Hz, z: [300-500 Hz, 900-950 Hz]} -> (("x", ((700.0, 1100.0),)), ...)."""
    pairs = _pairs(value, "dofs to bands", "{x: 700-1100 Hz}")
    return tuple((name, to_bands(entry, setting)) for name, entry in pairs)


def to_integer(value: Any, setting: Setting) -> int:  # noqa: ARG001 (one signature for the whole table)
    """A whole number from zero to LARGEST_INTEGER."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 0:
        raise UnitError(f"'{_text_of(value)}' is not a whole number of at least 0")
    if int(value) > LARGEST_INTEGER:
        raise UnitError(f"'{_text_of(value)}' is beyond what can be counted here", f"up to {LARGEST_INTEGER}")
    return int(value)


def to_flag(value: Any, setting: Setting) -> bool:  # noqa: ARG001
    """true or false."""
    if not isinstance(value, bool):
        raise UnitError(f"'{_text_of(value)}' is neither true nor false")
    return value


def to_text(value: Any, setting: Setting) -> str:  # noqa: ARG001
    return _text(value, "a text")


def to_choice(value: Any, setting: Setting) -> str:
    """One of the setting's choices."""
    text = _text(value, f"one of {', '.join(setting.choices)}")
    if text not in setting.choices:
        hint = nearest(text, setting.choices)
        raise UnitError(
            f"unknown choice '{shorten(text)}'",
            hint if hint.startswith("known") else f"{hint} (known: {', '.join(setting.choices)})",
        )
    return text


def to_names(value: Any, setting: Setting) -> tuple[str, ...]:
    """One name or a list of names."""
    return tuple(_name(entry, setting) for entry in (value if _is_list(value) else [value]))


def _name(value: Any, setting: Setting) -> str:
    name = to_text(value, setting)
    if not name:
        raise UnitError("a text is missing")
    return name


def to_mass(value: Any, setting: Setting) -> Any:
    """ "0.92 kg", a list (diagonal matrix), a list of lists (matrix), or `estimate`."""
    if _is_list(value):
        return tuple(to_values(row, setting) if _is_list(row) else to_mass(row, setting) for row in value)
    if value == ESTIMATE:
        return ESTIMATE
    mass = to_value(value, setting)
    if mass < 0:
        raise UnitError(f"the mass '{value}' is negative")
    return mass


def to_span(value: Any, setting: Setting) -> tuple[int, int]:
    """60 or "2-60": from 1, or from where it is written, to the end."""
    ends = value if isinstance(value, (tuple, list)) else str(value).split("-")
    if (
        isinstance(value, bool)
        or len(ends) not in (1, 2)
        or not all(str(end).strip().isdigit() for end in ends)
    ):
        raise UnitError(f"'{_text_of(value)}' is not a whole number, nor two of them", "write 60, or 2-60")
    return (int(ends[0]) if len(ends) > 1 else 1), to_integer(int(ends[-1]), setting)


def to_values(value: Any, setting: Setting) -> tuple[float, ...]:
    """One value or a list of values; a choice in their place, such as `auto`, is none."""
    if isinstance(value, str) and value in setting.choices:
        return ()
    return tuple(to_value(entry, setting) for entry in (value if _is_list(value) else [value]))


def to_matrix(value: Any, setting: Setting) -> tuple[tuple[float, ...], ...]:
    """A list of rows of equal length."""
    if not _is_list(value) or not all(_is_list(row) for row in value):
        what = f"'{_text_of(value)}' is not a matrix"
        raise UnitError(what, f"write rows, for example [[2 {setting.unit}, 0], [0, 2 {setting.unit}]]")
    rows = tuple(to_values(row, setting) for row in value)
    if len({len(row) for row in rows}) != 1:
        raise UnitError("the rows of the matrix are not equally long")
    return rows


def to_coefficients(value: Any, setting: Setting) -> tuple[tuple[str, float], ...]:
    """{k_1_2: 0 N/m, c_1_2: 0 N.s/m} -> (("k_1_2", 0.0), ...).

    The unit follows from the first letter of a name.
    """
    coefficients = []
    for name, entry in _pairs(value, "coefficients", "{k_1_3: 0 N/m}"):
        unit = COEFFICIENT_UNITS.get(name[:1]) if name[1:2] in ("", "_") else None
        if unit is None:
            raise UnitError(f"'{name}' is not a coefficient", "their names begin with k_, c_, m_, b_ or h_")
        coefficients.append((name, to_value(entry, replace(setting, unit=unit))))
    return tuple(coefficients)


def to_series(value: Any, setting: Setting) -> tuple[tuple[str, tuple[float, ...]], ...]:
    """{ls: [0.03, 0.2]} -> (("ls", (0.03, 0.2)),)."""
    pairs = _pairs(value, "names to lists of values")
    return tuple((name, to_values(entry, setting)) for name, entry in pairs)


def to_texts(value: Any, setting: Setting) -> tuple[tuple[str, str], ...]:  # noqa: ARG001
    """{d1: 3 y} -> (("d1", "3 y"),)."""
    pairs = _pairs(value, "names to texts", "{NAME: TEXT}")
    return tuple((str(name), _text(str(text), "a text")) for name, text in pairs)


def to_phasors(value: Any, setting: Setting) -> tuple[tuple[str, complex], ...]:
    """{disc 1: 50 g.mm at 60 deg} -> (("disc 1", 2.5e-5 + 4.3e-5j),); the angle is zero unless given."""
    pairs = _pairs(value, "names to phasors", f"{{disc 1: 50 {setting.unit} at 60 deg}}")
    return tuple((name, _phasor(name, entry, setting)) for name, entry in pairs)


def _phasor(name: str, value: Any, setting: Setting) -> complex:
    if isinstance(value, (complex, float, int)) and not isinstance(value, bool):
        return complex(value)
    try:
        return parse_phasor(_text(value, "a size with its unit"), setting.unit)
    except UnitError as error:
        raise UnitError(f"{name}: {error.what}", error.hint) from None


def parse_phasor(text: str, unit: str) -> complex:
    """ "50 g.mm at 60 deg" in the SI unit, complex with its angle, which is zero unless given.

    UnitError where it cannot be read.
    """
    size_text, _, angle_text = (part.strip() for part in text.partition(" at "))
    angle = parse_value(angle_text, "rad") if angle_text else 0.0
    return parse_value(size_text, unit) * cmath.exp(1j * angle)


def to_groups(value: Any, setting: Setting) -> tuple[tuple[str, ...], ...]:
    """A list of lists of names, or one list."""
    if not _is_list(value):
        what = f"'{_text_of(value)}' is not a list of names"
        raise UnitError(what, "write for example [[k_xx, k_yy], [c_xx, c_yy]]")
    entries = list(value)
    if all(_is_list(entry) for entry in entries):
        return tuple(to_names(entry, setting) for entry in entries)
    return (to_names(entries, setting),)


def to_section(value: Any, setting: Setting) -> Any:
    """The settings of a section: as they are, or from a mapping of its entries."""
    assert setting.section is not None
    if isinstance(value, setting.section):
        return value
    if not isinstance(value, Mapping):
        what = f"'{_text_of(value)}' is not a section of settings"
        raise UnitError(what, f"give a {setting.section.__name__} or a mapping of its entries")
    try:
        return setting.section(**value)
    except TypeError as error:
        raise UnitError(str(error).removeprefix(f"{setting.section.__name__}.__init__() ")) from None


def to_sections(value: Any, setting: Setting) -> tuple[tuple[str, Any], ...]:
    """Sections by name: {worn: {depth: 20 um}} -> (("worn", Wear(...)),)."""
    return tuple((name, to_section(entry, setting)) for name, entry in _pairs(value, "names to sections"))


def to_entries(value: Any, setting: Setting) -> tuple[Any, ...]:
    """A list of sections; a section may make its entries from an object of another package."""
    value = getattr(setting.section, "entries_from", lambda entries: entries)(value)
    if not _is_list(value):
        raise UnitError(f"'{_text_of(value)}' is not a list of sections", "each entry begins with '- '")
    return tuple(to_section(entry, setting) for entry in value)


CONVERTERS: dict[str, Callable[[Any, Setting], Any]] = {
    "value": to_value,
    "uncertain": to_uncertain,
    "band": to_band,
    "bands": to_bands,
    "peaks": to_peaks,
    "integer": to_integer,
    "span": to_span,
    "flag": to_flag,
    "text": to_text,
    "file": to_text,
    "choice": to_choice,
    "names": to_names,
    "mass": to_mass,
    "values": to_values,
    "matrix": to_matrix,
    "coefficients": to_coefficients,
    "groups": to_groups,
    "series": to_series,
    "texts": to_texts,
    "phasors": to_phasors,
    "section": to_section,
    "sections": to_sections,
    "entries": to_entries,
    "roots": to_roots,
}


# A list of nothing would be taken for one left out, which often means all.
EMPTY = "is empty", "leave it out, or fill it"


def is_empty(value: Any, declared: Setting) -> bool:
    """Whether a field that needs an entry has none."""
    no_entry = isinstance(value, (list, tuple, dict)) and not value
    return no_entry and declared.kind != "section" and not declared.may_be_empty


def _text(value: Any, wanted: str) -> str:
    if not isinstance(value, str):
        raise UnitError(f"'{_text_of(value)}' is not {wanted}")
    return value


def _is_list(value: Any) -> bool:
    return isinstance(value, Iterable) and not isinstance(value, (str, Mapping))


def _is_pair_of_numbers(value: Any) -> bool:
    return (
        _is_list(value)
        and len(value) == 2
        and all(isinstance(end, Real) and not isinstance(end, bool) for end in value)
    )


def _pairs(value: Any, of: str, example: str = "") -> list[tuple[str, Any]]:
    """The pairs of a mapping *of* names to something, or of a tuple of pairs; UnitError for anything else."""
    if isinstance(value, Mapping):
        return list(value.items())
    if isinstance(value, tuple) and all(
        isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[0], str) for pair in value
    ):
        return list(value)
    hint = f"write for example {example}" if example else ""
    raise UnitError(f"'{_text_of(value)}' is not a mapping of {of}", hint)


def _text_of(value: Any) -> str:
    if value is None:
        return "(nothing)"
    return (
        "(a mapping)"
        if isinstance(value, Mapping)
        else "(a list)"
        if _is_list(value)
        else shorten(str(value))
    )


__all__ = ["Setting", "Settings", "Uncertain", "setting", "settings_of"]


# Numbers of settings that carry an uncertainty, by the names of their fields.
Uncertainties = tuple[tuple[str, Uncertain], ...]


class Settings:
    """Base of every settings dataclass: its values are converted and checked at birth, whoever makes it.

    FrfSettings("periodic", period="1 s") and FrfSettings("periodic", period=1.0) are the same. ConfigError
    names the field that is wrong.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Convert to SI before the checks of the class."""
        super().__init_subclass__(**options)
        check = cls.__dict__.get("__post_init__")
        if check is None:
            return

        @functools.wraps(check)
        def convert_and_check(self: Settings) -> None:
            convert_fields(self)
            check(self)

        cls.__post_init__ = convert_and_check  # type: ignore[method-assign]

    def __post_init__(self) -> None:
        convert_fields(self)

    def require_positive(self, *names: str) -> None:
        """ConfigError for the first of the entries that holds a number not above zero."""
        for name in names:
            if not all(number > 0 for number in self._numbers(name)):
                raise SettingError(name, f"{name} must be positive")

    def require_not_negative(self, *names: str) -> None:
        """ConfigError for the first of the entries that holds a number below zero."""
        for name in names:
            if any(number < 0 for number in self._numbers(name)):
                raise SettingError(name, f"{name} must not be negative")

    def require_share(self, *names: str, or_none: bool = False) -> None:
        """ConfigError for the first of the entries that is no share of a whole: above zero, or zero too if it
        may be *or_none*, and below one.
        """
        for name in names:
            if not all(0 < number < 1 or (or_none and number == 0) for number in self._numbers(name)):
                what = "be at least 0 and below 100 %" if or_none else "lie between 0 and 100 %"
                raise SettingError(name, f"{name} must {what}")

    def _numbers(self, name: str) -> tuple[float, ...]:
        value = getattr(self, name)
        value = value.value if isinstance(value, Uncertain) else value
        return value if isinstance(value, tuple) else () if value is None else (value,)

    @property
    def written(self) -> list[str]:
        """Names of the declared settings that are not as they are by default."""
        return [name for name, default, _ in _declarations(type(self)) if getattr(self, name) != default]


def convert_fields(settings: Any) -> None:
    """Every declared field in SI units and of its type; ConfigError with the field's name."""
    owner = type(settings)
    for name, default, declared in _declarations(owner):
        value = getattr(settings, name)
        # A number in SI units is as it will be, but for not-a-number, which is not equal to itself.
        if value is default or (declared.kind == "value" and type(value) is float and value == value):
            continue
        try:
            if takes_uncertainty(owner, declared) and is_uncertain(value):
                value = _note(settings, name, parse_uncertain(value, declared.unit))
            if is_empty(value, declared):
                raise UnitError(*EMPTY)
            object.__setattr__(settings, name, CONVERTERS[declared.kind](value, declared))
        except UnitError as error:
            raise SettingError(name, f"{name}: {error.what}", error.hint) from None


# The declared fields of a class, looked up once: a fit makes its loop anew ten thousand times.
_DECLARED: dict[Any, tuple[tuple[str, Any, Setting], ...]] = {}


def _declarations(owner: type) -> tuple[tuple[str, Any, Setting], ...]:
    if owner not in _DECLARED:
        _DECLARED[owner] = tuple(
            (field.name, field.default, field.metadata["setting"])
            for field in dataclasses.fields(owner)
            if "setting" in field.metadata
        )
    return _DECLARED[owner]


def _note(settings: Any, name: str, number: Uncertain) -> float:
    others = tuple(pair for pair in settings.uncertainties if pair[0] != name)
    object.__setattr__(settings, "uncertainties", (*others, (name, number)))
    return number.value


def takes_uncertainty(owner: type, declared: Setting) -> bool:
    """Whether a number of these settings may carry its uncertainty: "0.92 kg +- 1 %".

    Those settings have a field *uncertainties*.
    """
    fields: Mapping[str, Any] = owner.__dataclass_fields__  # type: ignore[attr-defined]
    return declared.kind in ("value", "mass") and "uncertainties" in fields


def setting(kind: str, help: str, unit: str = "", default: Any = MISSING, **details: Any) -> Any:
    """A dataclass field that carries a Setting of a kind of CONVERTERS, with its *details* by their names.

    Without a default the YAML must give it.
    """
    if kind not in CONVERTERS:
        raise ValueError(f"unknown kind of setting '{kind}'")
    return dataclasses.field(default=default, metadata={"setting": Setting(kind, help, unit=unit, **details)})


def quantity(help: str, unit: str, default: Any = MISSING) -> Any:
    """A dataclass field of a number with an SI *unit*: a setting of the kind value."""
    return setting("value", help, unit, default)


def integer(help: str, default: Any = MISSING) -> Any:
    """A dataclass field of a whole number from zero on: a setting of the kind integer."""
    return setting("integer", help, default=default)


def flag(help: str) -> Any:
    """A dataclass field that is false unless it is set: a setting of the kind flag."""
    return setting("flag", help, default=False)


def text(help: str, default: str | None = "") -> Any:
    """A dataclass field of a text, empty by default: a setting of the kind text."""
    return setting("text", help, default=default)


def names(help: str, *, may_be_empty: bool = False) -> Any:
    """A dataclass field of one name or several, none by default: a setting of the kind names."""
    return setting("names", help, default=(), may_be_empty=may_be_empty)


def choice(help: str, choices: tuple[str, ...], default: Any = MISSING) -> Any:
    """A dataclass field of one of the *choices*: a setting of the kind choice."""
    return setting("choice", help, choices=choices, default=default)


def section(help: str, owner: type, default: Any = MISSING) -> Any:
    """A dataclass field of a mapping with the settings of *owner*: a setting of the kind section."""
    return setting("section", help, section=owner, default=default)


class StandardDeviations(Settings):
    """Settings all of which are standard deviations, none below zero."""

    def __post_init__(self) -> None:
        self.require_not_negative(*settings_of(type(self)))


def settings_of(owner: type) -> dict[str, tuple[Setting, bool]]:
    """Field name -> (its Setting, whether it must be given) of a settings dataclass, in order of
    declaration.
    """
    return {
        name: (declared, default is MISSING or declared.needed)
        for name, default, declared in _declarations(owner)
    }
