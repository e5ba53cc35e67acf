"""Worlds of calibrations: points that scatter about the fitted lines as those of the table do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.methods.calibration.section import CalibrationSettings, Line, fit_line, line_fit
from labpipe.quantities import parse_unit
from labpipe.raw_files.table import open_table
from labpipe.records.finding import Parameter
from tests.draws.usual import Errors


@dataclass(frozen=True)
class LineWorlds:
    """Points at *x* (n_point,), each y off the true *line* by itself, with the scatter [y unit] of the
    measured ones.
    """

    name: str
    x: np.ndarray
    line: Line
    through_origin: bool

    @property
    def values(self) -> np.ndarray:
        slope, *rest = self.line.values
        return np.asarray(slope * self.x + (rest[0] if rest else 0.0))

    def truth(self) -> dict[str, float]:
        return {
            f"{self.name}.{name}": float(value)
            for name, value in zip(("slope", "intercept"), self.line.values, strict=False)
        }

    def amounts(self, _: Errors, rng: np.random.Generator | None) -> dict[str, Parameter]:
        scatter = float(np.sqrt(np.sum(self.line.residual**2) / self.line.dof))
        y = self.values if rng is None else self.values + scatter * rng.standard_normal(self.x.size)
        fit = line_fit("", "", fit_line(self.x, y, through_origin=self.through_origin), ("1", "1"), self.x, y)
        return {f"{self.name}.{one.name}": one for one in fit.parameters}


def line_worlds(settings: CalibrationSettings) -> list[LineWorlds]:
    """Every line of a calibration."""
    table = open_table(settings.path)
    names = [settings.x, settings.y, *([settings.group] if settings.group else [])]
    columns = np.concatenate(list(table.chunks(names))).T
    x, y = (
        values * parse_unit(table.units[name]).factor
        for name, values in zip(names, columns[:2], strict=False)
    )
    groups = columns[2] if settings.group else np.zeros(x.size)
    worlds = []
    for group in np.unique(groups):
        chosen = groups == group
        name = f"{settings.name}[{group:g}]" if settings.group else settings.name
        powered = x[chosen] ** settings.x_power
        line = fit_line(powered, y[chosen], through_origin=settings.through_origin)
        worlds.append(LineWorlds(name, powered, line, settings.through_origin))
    return worlds
