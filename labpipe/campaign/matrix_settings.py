"""The parameters of one matrix of tests; *name* is its key under ``matrix:``."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, setting


@dataclass(frozen=True, kw_only=True)
class MatrixTheorySettings(Settings):
    """A theory beside the measured points: a bearing file, or a table of another program."""

    bearing: str = setting("file", "bearing file, relative to this file", file_kind="bearing", default="")
    entries: tuple[str, ...] = setting("names", "entries of the bearing file that `over` sets, `none` where there is none", default=())
    axes: tuple[str, ...] = setting("names", "dofs of the bearing that are x and y of the rig, e.g. [-z, y]", default=())
    table: str = setting(
        "file", "CSV table with a column for every condition and coefficient, e.g. 'speed [rpm]', 'k_xx [N/m]'", default=""
    )

    def __post_init__(self) -> None:
        if bool(self.bearing) == bool(self.table):
            raise ConfigError("one of 'bearing' and 'table' is needed", hint="bearing: FILE, or table: FILE.csv")
        if self.table and (self.entries or self.axes):
            raise ConfigError("'entries' and 'axes' belong to a bearing file", hint="name the columns of the table as the conditions")
        if self.axes and len({axis.lstrip("-") for axis in self.axes}) != 2:
            raise ConfigError("'axes' names two dofs, those that are x and y", hint="for example axes: [-z, y]")


@dataclass(frozen=True, kw_only=True)
class EquilibriumSettings(Settings):
    """The rest position of the shaft over the load."""

    load: str = setting("text", "condition that is the load, one of `over`")
    x: str = setting("text", "condition that is the mean displacement in x")
    y: str = setting("text", "condition that is the mean displacement in y")
    direction: float = setting("value", "direction of the load on the shaft, from x towards y", unit="rad", default=0.0)
    centre: tuple[float, ...] = setting("values", "centre of the bearing (x, y) as the probes show it", unit="m", default=(0.0, 0.0))
    clearance: float | None = setting("value", "radial clearance, the circle that the shaft can move in", unit="m", default=None)
    support: float = setting("value", "stiffness of what carries a share of the load beside the bearing", unit="N/m", default=0.0)

    def __post_init__(self) -> None:
        if len(self.centre) != 2:
            raise ConfigError("'centre' has two coordinates", hint="centre: [0 um, 0 um]")
        if self.clearance is not None and self.clearance <= 0:
            raise ConfigError("'clearance' must be positive")


@dataclass(frozen=True, kw_only=True)
class MatrixSettings(Settings):
    """One entry under ``matrix:``."""

    fit: str = setting("text", "fit whose coefficients fill the matrix")
    over: tuple[str, ...] = setting(
        "names", "conditions: along the abscissa, the second as one line per level, more as one figure per level"
    )
    parameters: tuple[str, ...] = setting("names", "coefficients; default: all that every test has", default=())
    beside: tuple[str, ...] = setting("names", "conditions shown beside, such as leakage or temperature", default=())
    tolerance: float = setting("value", "values of a condition closer than this share of the largest are one level", unit="1", default=0.02)
    level: float = setting("value", "level of significance of tests", unit="1", default=0.05)
    theory: MatrixTheorySettings | None = setting("section", "theory beside the points", section=MatrixTheorySettings, default=None)
    path: EquilibriumSettings | None = setting("section", "static equilibrium over the load", section=EquilibriumSettings, default=None)
    name: str = ""

    def __post_init__(self) -> None:
        if not self.over:
            raise ConfigError("'over' names no condition", hint="over: [speed, load]")
        for names, what in ((self.over, "over"), (self.beside, "beside"), (self.parameters, "parameters")):
            twice = next((name for name in names if names.count(name) > 1), None)
            if twice is not None:
                raise ConfigError(f"'{what}' names '{twice}' twice", field=what)
        if self.path is not None and self.path.load not in self.over:
            raise ConfigError(f"the load '{self.path.load}' of the path is none of 'over'", hint=f"over: {', '.join(self.over)}")
        if not 0 <= self.tolerance < 1:
            raise ConfigError("'tolerance' must be at least 0 and below 100 %")
        if not 0 < self.level < 1:
            raise ConfigError("'level' must lie between 0 and 100 %")
        if self.theory is not None and self.theory.bearing and len(self.theory.entries) != len(self.over):
            hint = "for example over: [speed, load] with entries: [speed, load]"
            raise ConfigError(f"'theory.entries' names one entry for each of {len(self.over)} conditions", hint=hint)
