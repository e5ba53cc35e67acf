"""The ``calibrate:`` section: straight lines through calibration tables."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path

from labpipe.records.settings import Settings, setting


@dataclass(frozen=True)
class CalibrationSettings(Settings):
    """One straight-line fit: a table's column *y* over its column *x*, once per value of *group* if given."""

    table: str = setting("file", "table file (CSV), relative to this file", file_kind="path", into="path")
    x: str = setting("text", "column of the known or set value")
    y: str = setting("text", "column of the answer")
    _: KW_ONLY
    x_unit: str = setting("text", "unit of x; default: in brackets behind the column's name", default="")
    y_unit: str = setting("text", "unit of y; default: in brackets behind the column's name", default="")
    group: str = setting("text", "column by which the table falls into several lines", default="")
    x_power: int = setting("integer", "x enters as this power: 2 for a string's force over its frequency", default=1)
    through_origin: bool = setting("flag", "force the line through the origin", default=False)
    tolerance: float | None = setting("value", "slope change allowed in the linear range", unit="1", default=None)
    name: str = ""
    path: Path = Path()
