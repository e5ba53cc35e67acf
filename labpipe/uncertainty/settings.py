"""The parameters of comparisons and of matrices of tests, and the kinds of comparisons with what each of them
takes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray, IntArray
from labpipe.errors import ConfigError, SettingError
from labpipe.records.comparison import Comparison
from labpipe.records.settings import Settings, choice, names, quantity, section, setting, settings_of, text
from labpipe.records.uncertain import Uncertain
from labpipe.registry import Registry


def levels_of(values: FloatArray, tolerance: float) -> tuple[FloatArray, IntArray]:
    """Levels (n_level,) [as the values], the means of their members, and the level of every value, (n,).

    In ascending order a value begins a new level where it exceeds the one before by more than *tolerance* [1]
    of the largest magnitude. Equation (comp-levels).
    """
    order = np.argsort(values, kind="stable")
    step = np.diff(values[order], prepend=values[order[:1]])
    number = np.empty(values.size, np.intp)
    number[order] = np.cumsum(step > tolerance * np.max(np.abs(values), initial=0.0))
    return np.bincount(number, values) / np.bincount(number), number


# The parameters of one matrix of tests; *name* is its key under ``matrix:``.


@dataclass(frozen=True, kw_only=True)
class MatrixTheorySettings(Settings):
    """A theory beside the measured points: a bearing file, or a table of another program."""

    bearing: str = setting("file", "bearing file, relative to this file", file_kind="bearing", default="")
    entries: tuple[str, ...] = names(
        "entries of the bearing file that `over` sets, `none` where there is none"
    )
    axes: tuple[str, ...] = names("dofs of the bearing that are x and y of the rig, e.g. [-z, y]")
    table: str = setting(
        "file",
        "CSV table with a column for every condition and coefficient, e.g. 'speed [rpm]', 'k_xx [N/m]'",
        default="",
    )

    def __post_init__(self) -> None:
        if bool(self.bearing) == bool(self.table):
            what, hint = "one of 'bearing' and 'table' is needed", "bearing: FILE, or table: FILE.csv"
            raise ConfigError(what, hint=hint)
        if self.table and (self.entries or self.axes):
            what = "'entries' and 'axes' belong to a bearing file"
            raise ConfigError(what, hint="name the columns of the table as the conditions")
        if self.axes and len({axis.lstrip("-") for axis in self.axes}) != 2:
            what = "'axes' names two dofs, those that are x and y"
            raise ConfigError(what, hint="for example axes: [-z, y]")


@dataclass(frozen=True, kw_only=True)
class EquilibriumSettings(Settings):
    """The rest position of the shaft over the load."""

    load: str = setting("text", "condition that is the load, one of `over`")
    x: str = setting("text", "condition that is the mean displacement in x")
    y: str = setting("text", "condition that is the mean displacement in y")
    direction: float = quantity("direction of the load on the shaft, from x towards y", "rad", 0.0)
    centre: tuple[float, ...] = setting(
        "values", "centre of the bearing (x, y) as the probes show it", "m", (0.0, 0.0)
    )
    clearance: float | None = quantity("radial clearance, the circle that the shaft can move in", "m", None)
    support: float = quantity("stiffness of what carries a share of the load beside the bearing", "N/m", 0.0)

    def __post_init__(self) -> None:
        if len(self.centre) != 2:
            raise ConfigError("'centre' has two coordinates", hint="centre: [0 um, 0 um]")
        self.require_positive("clearance")


@dataclass(frozen=True, kw_only=True)
class MatrixSettings(Settings):
    """One entry under ``matrix:``."""

    fit: str = setting("text", "fit whose coefficients fill the matrix")
    over: tuple[str, ...] = setting(
        "names",
        "conditions: along the abscissa, the second as one line per level, more as one figure per level",
    )
    parameters: tuple[str, ...] = names("coefficients; default: all that every test has")
    beside: tuple[str, ...] = names("conditions shown beside, such as leakage or temperature")
    tolerance: float = quantity(
        "values of a condition closer than this share of the largest are one level", "1", 0.02
    )
    level: float = quantity("level of significance of tests", "1", 0.05)
    theory: MatrixTheorySettings | None = section("theory beside the points", MatrixTheorySettings, None)
    path: EquilibriumSettings | None = section("static equilibrium over the load", EquilibriumSettings, None)
    name: str = ""

    def __post_init__(self) -> None:
        for listed, what in ((self.over, "over"), (self.beside, "beside"), (self.parameters, "parameters")):
            twice = next((name for name in listed if listed.count(name) > 1), None)
            if twice is not None:
                raise SettingError(what, f"'{what}' names '{twice}' twice")
        if self.path is not None and self.path.load not in self.over:
            what = f"the load '{self.path.load}' of the path is none of 'over'"
            raise ConfigError(what, hint=f"over: {', '.join(self.over)}")
        self.require_share("tolerance", or_none=True)
        self.require_share("level")
        if self.theory is not None and self.theory.bearing and len(self.theory.entries) != len(self.over):
            what = f"'theory.entries' names one entry for each of {len(self.over)} conditions"
            raise ConfigError(what, hint="for example over: [speed, load] with entries: [speed, load]")


@dataclass(frozen=True)
class ComparisonKind:
    """What a comparison of the kind computes from its settings and the evidence, and what is true of it.

    keys: those, besides `kind`, that change what is computed; all others are refused; needs: those that must
    be given. verdicts: all that it may come to, by which rules are checked; none where rules may name any.
    conditions: over how many it goes at most. loop: its theory is a control loop, unchanged unless a
    condition sets an entry, whose unknowns may be estimated. section: key of the kind's own *settings*, a
    dataclass with defaults.
    """

    compare: Callable[[CompareSettings, Any], Comparison]
    keys: tuple[str, ...]
    needs: tuple[str, ...] = ()
    verdicts: tuple[str, ...] = ()
    conditions: int = 1
    loop: bool = False
    section: str = ""
    settings: type | None = None


# ComparisonKinds, or, of plug-ins, functions from settings and evidence to a Comparison, which may use every
# key.
COMPARISONS = Registry("comparison")
LOAD = "loads.z"
LAWS = ("line", "power")


@dataclass(frozen=True)
class TheorySettings(Settings):
    """The bearing file of the theory, and how the rig measures the bearing."""

    bearing: str = setting(
        "file", "bearing file with the shaft on it, relative to this file", file_kind="bearing"
    )
    entry: tuple[str, ...] = setting(
        "names", "entry of the bearing file that the condition sets; of two conditions two", default=(LOAD,)
    )
    shaft: Uncertain | None = setting(
        "uncertain", "radial stiffness of the bending shaft; default: rigid", "N/m", None
    )
    arm: float | None = quantity("tilts are measured as displacements at this distance", "m", None)

    def __post_init__(self) -> None:
        self.require_positive("shaft", "arm")


@dataclass(frozen=True, kw_only=True)
class CompareSettings(Settings):
    """One entry under ``compare:``; *name* is its key there, *kind_settings*: of the section that its kind
    has.
    """

    kind: str = choice("kind of comparison", tuple(COMPARISONS))
    fit: str = text("fit whose parameter is compared")
    term: str = text("diagonal term of a fit of peaks")
    parameter: str = text("parameter that is compared", "k")
    over: tuple[str, ...] = names("condition over which tests are ordered or paired, or two of them")
    tolerance: float = quantity("values closer than this share of the largest are one", "1", 1e-6)
    group: str = text("condition that makes the groups; default: each test is one")
    groups: tuple[str, ...] = names("the two groups, the second against the first")
    law: str = choice("straight line, or power law", LAWS, "line")
    setting_error: float = quantity("relative standard error of setting the condition", "1", 0.0)
    theory: TheorySettings | None = section("theory to compare with", TheorySettings, None)
    estimate: tuple[str, ...] = names("unknowns of the bearing file, fitted")
    before: str = text("response ahead of the sum at which the excitation is added", "before")
    after: str = text("response behind that sum", "after")
    level: float = quantity("level of significance of tests", "1", 0.05)
    name: str = ""
    kind_settings: Any = None

    def __post_init__(self) -> None:
        self._check_keys()
        self._check_over()
        self.require_share("tolerance", or_none=True)
        self.require_share("level")
        self.require_not_negative("setting_error")
        if self.estimate and self.theory is None:
            what = "'estimate' has no loop whose unknowns can be fitted"
            raise ConfigError(what, hint="theory: {bearing: FILE}")
        if len(set(self.estimate)) < len(self.estimate):
            hint = ", ".join(dict.fromkeys(self.estimate))
            raise ConfigError("'estimate' names an unknown twice", hint=hint)
        self._check_theory()

    def _check_keys(self) -> None:
        kind = comparison_kind(self.kind)
        for key in self.written:
            if key not in ("kind", *kind.keys):
                hint = f"leave it out; kinds that take it: {', '.join(takers(key))}"
                raise SettingError(key, f"'{key}' is not for the kind {self.kind}", hint)
        for needed in kind.needs:
            if not getattr(self, needed):
                raise ConfigError(f"'{needed}' is missing", hint=f"a comparison of kind {self.kind} needs it")
        if "groups" in kind.needs and not len(self.groups) == len(set(self.groups)) == 2:
            what = f"two groups are compared, not {', '.join(self.groups) or 'none'}"
            raise SettingError("groups", what, hint="for example groups: [up, down]")
        if kind.settings is not None and self.kind_settings is None:
            object.__setattr__(self, "kind_settings", kind.settings())
        if not isinstance(self.kind_settings, kind.settings or type(None)):
            raise ConfigError(f"kind_settings are not those of the kind {self.kind}", hint="leave them out")

    @property
    def condition(self) -> str:
        """The first condition, along the abscissa; empty where none is named."""
        return self.over[0] if self.over else ""

    @property
    def second(self) -> str:
        """The second condition; empty where there is none."""
        return self.over[1] if len(self.over) > 1 else ""

    def _check_over(self) -> None:
        most = comparison_kind(self.kind).conditions
        if len(self.over) > most:
            what = f"a comparison of kind {self.kind} goes over {most} condition(s), not {len(self.over)}"
            several = (name for name in COMPARISONS if comparison_kind(name).conditions > 1)
            raise SettingError("over", what, f"two: {', '.join(several)}; more: matrix")
        if len(set(self.over)) < len(self.over):
            raise SettingError("over", f"'over' names '{self.condition}' twice")

    def _check_theory(self) -> None:
        if self.theory is None:
            return
        loop = comparison_kind(self.kind).loop
        for name in ("shaft", "arm") if loop else ():
            if getattr(self.theory, name) is not None:
                what = f"'theory.{name}' is not for the kind {self.kind}"
                raise SettingError("theory", what, "leave it out")
        if not self.over:
            if not loop:
                raise ConfigError("'over' is missing", hint="the condition at which the theory is evaluated")
            return
        if loop and self.theory.entry == (LOAD,):
            hint = "for example theory: {bearing: FILE, entry: loop.proportional}"
            raise ConfigError(f"'theory.entry' is missing, the entry that '{self.condition}' sets", hint=hint)
        if len(self.theory.entry) != len(self.over):
            what = f"'theory.entry' names {len(self.theory.entry)} entries for {len(self.over)} conditions"
            raise ConfigError(what, hint="for example over: [speed, load] with entry: [speed, loads.z]")
        for entry in self.theory.entry:
            if entry.rpartition(".")[2] in self.estimate:
                what = f"'{entry}' is set by '{self.condition}', so it is not estimated"
                raise ConfigError(what, hint="leave one of them out")


def comparison_kind(name: str) -> ComparisonKind:
    """The kind of comparison of that name. A plug-in's function counts as one that takes every key, over one
    condition.
    """
    entry = COMPARISONS.load(name)
    if isinstance(entry, ComparisonKind):
        return entry
    return ComparisonKind(entry, tuple(settings_of(CompareSettings)))


def takers(key: str) -> tuple[str, ...]:
    """The kinds that take a key of a comparison."""
    return tuple(name for name in COMPARISONS if key in ("kind", *comparison_kind(name).keys))


def kinds_text(key: str) -> str:
    """Which kinds take a key of a comparison, as a help says it; empty where all do."""
    able = takers(key)
    return "" if len(able) == len(tuple(COMPARISONS)) else f" (kinds {', '.join(able)})"
