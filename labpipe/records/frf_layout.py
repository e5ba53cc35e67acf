"""How FRFs lie in a table or among the variables of a file, as the entry under ``frfs:`` describes it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

from labpipe.errors import ConfigError, SettingError
from labpipe.quantities import UnitError, parse_unit, unit_of
from labpipe.records.response import FORMS
from labpipe.records.settings import Settings, choice, flag, integer, names, quantity, section, setting, text


@dataclass(frozen=True)
class WindowedSettings(Settings):
    """Windows that hits, or the FRFs of hits, have already."""

    exponential: float = quantity("time constant of the exponential window that an analyser applied", "s")

    def __post_init__(self) -> None:
        self.require_positive("exponential")


# Windows of analysers by name.
WINDOWS = ("boxcar", "hann", "hamming", "blackman", "flattop")
# Forms that their units tell, and one that must be named.
MECHANICAL = ("receptance", "mobility", "accelerance")
NAMED = "transmissibility"
OF_AN_FRF = (
    "m/N, m/(N.s), m/(N.s^2) or multiples are; divide a response by the force at which it was measured"
)


def form_of_unit(unit: str) -> str:
    """The form of an FRF whose numbers may have a unit; '' for another or an unknown one."""
    for form in MECHANICAL:
        with suppress(UnitError):
            unit_of(unit, FORMS[form])
            return form
    return ""


AXES = ("frequency", "output", "input")
# Columns that together are a complex number.
PARTS = (
    ("re", "im"),
    ("complex",),
    ("amplitude", "phase_deg"),
    ("amplitude", "phase_rad"),
    ("amplitude_db", "phase_deg"),
    ("amplitude_db", "phase_rad"),
)
# Endings of universal files.
UNIVERSAL = (".uff", ".unv", ".uf")
PART_NAMES = ("re", "im", "complex", "amplitude", "amplitude_db", "phase_deg", "phase_rad")
_KNOWN_PARTS = "re and im, complex, or amplitude (amplitude_db) and phase_deg (phase_rad)"


@dataclass(frozen=True, kw_only=True)
class ElementColumns(Settings):
    """Columns (or variables) of one element of H, by name or by number from 1."""

    re: str = text("real part")
    im: str = text("imaginary part")
    complex: str = text("complex values such as 1+2j")
    amplitude: str = text("amplitude")
    amplitude_db: str = text("amplitude in decibels, 20 log10(|H| / unit)")
    phase_deg: str = text("phase in degrees")
    phase_rad: str = text("phase in radians")
    coherence: str = text("coherence")

    def __post_init__(self) -> None:
        if self.given and self.given not in PARTS:
            what = "alone is not" if len(self.given) == 1 else "together are not"
            hint = f"{_KNOWN_PARTS} are needed"
            raise ConfigError(f"{' and '.join(self.given)} {what} a complex number", hint=hint)

    @property
    def given(self) -> tuple[str, ...]:
        """The parts of the complex number that are named."""
        return tuple(name for name in PART_NAMES if getattr(self, name))


@dataclass(frozen=True, kw_only=True)
class FrfColumns(ElementColumns):
    """The frequency axis, and the columns of the only element, or the array that holds the whole matrix."""

    frequency: str = text("frequency, in Hz unless the file states another unit")
    omega: str = text("angular frequency in rad/s, instead of frequency")
    start: str = text("first frequency: a value such as '0 Hz', or a variable")
    step: str = text("distance of the lines: a value such as '0.5 Hz', or a variable")
    matrix: str = text("variable of the whole complex matrix, instead of one column for each element")

    def __post_init__(self) -> None:
        super().__post_init__()
        axis = [name for name in ("frequency", "omega") if getattr(self, name)]
        stepped = bool(self.start) + bool(self.step)
        if len(axis) + (stepped > 0) != 1 or stepped == 1:
            what = "one frequency axis is needed"
            raise ConfigError(what, hint="frequency, omega (rad/s), or start and step")
        if self.matrix and self.given:
            raise ConfigError(f"'matrix' and '{self.given[0]}' are both named", hint="leave one of them out")


@dataclass(frozen=True, kw_only=True)
class FrfLayout(Settings):
    """An entry under ``frfs:`` that describes its file."""

    file: str = text("the file, or a glob of files, each of which is a response of its own")
    each: tuple[str, ...] = names("files of one FRF matrix, one for each element, row or column")
    pattern: str = text("dofs in the names of the files, for example 'H_{output}_{input}'")
    columns: FrfColumns | None = section("columns of a table, by name or by number from 1", FrfColumns, None)
    variables: FrfColumns | None = section("variables of a .mat, .h5 or .npz file", FrfColumns, None)
    elements: tuple[tuple[str, ElementColumns], ...] = setting(
        "sections",
        "several elements in one file: {x/f: {re: 2, im: 3}, y/f: {re: 4, im: 5}}",
        section=ElementColumns,
        default=(),
    )
    axes: tuple[str, ...] = names("order of the dimensions of 'matrix'; default: found by their lengths")
    form: str = choice(
        "what is divided by the force, or transmissibility; default: as the unit says",
        (*MECHANICAL, NAMED),
        "",
    )
    unit: str = text("unit of the numbers, for example g/N; default: SI")
    output: tuple[str, ...] = names("dof of the response; of a matrix: of every row")
    input: tuple[str, ...] = names("dof of the force; of a matrix: of every column")
    conjugate: bool = flag("the numbers are the complex conjugate of H: their phase rises through a mode")
    averages: int = integer(
        "averages behind an H1, independent but for `overlap`: with its coherence they give the noise", 0
    )
    window: str = choice(
        "window of the analyser's blocks, through which neighbouring lines share noise", WINDOWS, ""
    )
    excitation: str = choice(
        "random: every block has another force, so that an H1 holds what leaks through the window; default: "
        "the same force",
        ("random",),
        "",
    )
    overlap: float = quantity("overlap of neighbouring blocks of random data", "1", 0.0)
    windowed: WindowedSettings | None = section(
        "window of the hits behind the FRF: its damping is taken out", WindowedSettings, None
    )

    def __post_init__(self) -> None:
        if bool(self.file) == bool(self.each):
            what = "one of 'file' and 'each' is needed"
            raise ConfigError(what, hint="file: h.txt, or each: 'points/*.txt' with a pattern")
        if self.columns is not None and self.variables is not None:
            what = "'columns' and 'variables' are both named"
            raise ConfigError(what, hint="columns for a table, variables for .mat, .h5 and .npz")
        stated = self.unit or self.form
        # The records of a universal file may leave open what they hold.
        if self.table is None and (
            self.elements or self.axes or self.conjugate or (stated and not self._are_universal)
        ):
            what = "neither 'columns' nor 'variables' say where the numbers stand"
            raise ConfigError(what, hint="columns: {frequency: 1, re: 2, im: 3}")
        self._check_blocks()
        if self.axes and sorted(self.axes) != sorted(AXES):
            raise SettingError("axes", "'axes' must name frequency, output and input once each")
        if self.table is not None:
            self._check_elements(self.table)
        if self.table is not None or self.unit:
            self._check_unit()

    def _check_blocks(self) -> None:
        if self.averages == 1:
            raise SettingError("averages", "the coherence of one average gives no noise")
        if self.averages and self.windowed is not None:
            what = "how the noise of a windowed hit goes on without its window is not known"
            raise SettingError("averages", what, "leave out 'averages' or 'windowed'")
        if self.excitation and (not self.window or self.windowed is not None):
            what = "of random data leaks through the window of their blocks, and through no other"
            raise SettingError("excitation", what, "window: hann beside it, and no 'windowed'")
        if self.overlap and not (self.excitation and 0 <= self.overlap < 1):
            what = "'overlap' is that of blocks of random data, at least 0 and below 100 %"
            raise SettingError("overlap", what, "excitation: random beside it")

    @property
    def _are_universal(self) -> bool:
        return all(name.lower().endswith(UNIVERSAL) for name in (self.file, *self.each) if name)

    @property
    def table(self) -> FrfColumns | None:
        """The described columns or variables."""
        return self.columns or self.variables

    def _check_elements(self, table: FrfColumns) -> None:
        holders = [bool(table.given), bool(table.matrix), bool(self.elements)]
        if sum(holders) != 1:
            where = "columns" if self.columns is not None else "variables"
            what = "name no element of H" if not any(holders) else "name an element beside 'elements'"
            raise SettingError(where, what, f"{_KNOWN_PARTS} are needed, or 'elements' for several")
        for name, element in self.elements:
            if not element.given:
                what = "elements"
                raise SettingError(what, f"the element '{name}' has no columns", f"{_KNOWN_PARTS} are needed")

    def _check_unit(self) -> None:
        if not self.form and not self.unit:
            hint = "form: accelerance, and unit: g/N where the numbers are not in SI units"
            raise ConfigError("form or unit is needed", hint=hint)
        try:
            self.scale  # noqa: B018 (raises)
        except UnitError as error:
            raise SettingError("unit", error.what, error.hint) from None

    @property
    def scale(self) -> tuple[str, float]:
        """(form, SI value per value of the file).

        UnitError for a unit that is none of the form, or of no form.
        """
        if not self.unit:
            return self.form, 1.0
        if self.form:
            return self.form, unit_of(self.unit, FORMS[self.form]).factor
        if form := form_of_unit(self.unit):
            return form, unit_of(self.unit, FORMS[form]).factor
        parse_unit(self.unit)
        raise UnitError(f"'{self.unit}' is not a unit of an FRF", OF_AN_FRF)
