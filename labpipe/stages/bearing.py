"""bearing: a bearing file -> stiffness and damping at its load and speed, alone or over a sweep of one entry."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from labpipe import __version__
from labpipe.artefacts.writing import OutputFolder
from labpipe.bearings.coefficients import BearingCoefficients, BearingKind
from labpipe.config.faults import Faults
from labpipe.config.reader import read_settings
from labpipe.errors import ConfigError, LabpipeError
from labpipe.formats.frf_csv import write_frf_csv
from labpipe.marked_yaml import Marked, load_marked, set_entry
from labpipe.registry import Registry, nearest
from labpipe.stages.sweep import Sweep

SCHEMA = "labpipe/bearing/1"
BEARINGS = Registry(
    "bearing",
    {
        "ball-bearing": "labpipe.bearings.rolling_kinds:BALL",
        "roller-bearing": "labpipe.bearings.rolling_kinds:ROLLER",
        "journal-bearing": "labpipe.bearings.journal_kind:JOURNAL_KIND",
        "magnetic-bearing": "labpipe.bearings.magnetic_kind:MAGNETIC_KIND",
    },
)


@dataclass(frozen=True)
class BearingFile:
    """A bearing file that is being read: its path, kind, and the tree of its entries."""

    path: Path
    kind_name: str
    kind: BearingKind
    tree: Marked

    def settings(self) -> Any:
        """The settings as the file has them now; ConfigErrors with every fault at its place."""
        faults = Faults()
        settings = read_settings(self.kind.settings, self.tree, "", faults)
        faults.raise_any()
        return settings

    def coefficients(self, settings: list[Any]) -> list[BearingCoefficients]:
        """The coefficients of every settings; errors say which file."""
        try:
            return self.kind.coefficients(settings)
        except LabpipeError as error:
            error.where = error.where or str(self.path)
            raise


def open_bearing(path: Path, overrides: Iterable[str] = ()) -> BearingFile:
    """The bearing file with its kind known; ConfigError where the file or its kind cannot be read."""
    tree = load_marked(path)
    for assignment in overrides:
        set_entry(tree, assignment)
    faults = Faults()
    entries = faults.mapping(tree, "")
    faults.raise_any()
    if "kind" not in entries:
        raise ConfigError("kind: is missing", where=tree.place, hint=f"known: {', '.join(BEARINGS.names())}")
    name = entries["kind"].text
    if name not in BEARINGS.names():
        raise ConfigError(f"kind: unknown bearing '{name}'", where=entries["kind"].place, hint=nearest(name, BEARINGS.names()))
    kind: BearingKind = BEARINGS.load(name)
    for key, unit in kind.bare_units.items():
        if key in entries and isinstance(entries[key].content, (int, float)):
            entries[key].text += f" {unit}"
    return BearingFile(path, name, kind, tree)


def swept(file: BearingFile, sweep: Sweep) -> list[BearingCoefficients]:
    """The coefficients at every value of the sweep, in its order."""
    settings = []
    for value in sweep.values:
        set_entry(file.tree, f"{sweep.key}={float(value)!r} {sweep.unit}")
        settings.append(file.settings())
    return file.coefficients(settings)


def bearing_entry(file: BearingFile, name: str, found: BearingCoefficients) -> dict[str, Any]:
    """What --json writes: kind, dofs, stiffness, damping, equilibrium, and where known the range over a ball passage. SI units."""
    equilibrium = {amount.name: amount.value for amount in found.rest}
    equilibrium |= {key: values.tolist() for key, values in found.element_state.items()}
    entry: dict[str, Any] = {
        "schema": SCHEMA,
        "labpipe": __version__,
        "kind": file.kind_name,
        "name": name,
        "dofs": list(found.dofs),
        "stiffness": found.stiffness.tolist(),
        "damping": found.damping.tolist(),
        "equilibrium": equilibrium,
        "model": {amount.name: amount.value for amount in found.notes} | dict(found.words),
        "warnings": [{"code": finding.code, "message": finding.message} for finding in found.findings],
    }
    if found.shares:
        entry["shares"] = {amount.name: amount.value for amount in found.shares}
    if found.poles is not None:
        entry["poles"] = [[float(pole.real), float(pole.imag)] for pole in found.poles]
    if found.shaft:
        entry["shaft"] = {amount.name: amount.value for amount in found.shaft}
    if found.lowest is not None and found.highest is not None:
        entry["passage"] = {"stiffness_min": found.lowest.tolist(), "stiffness_max": found.highest.tolist()}
    return entry


def bearing_json(entry: dict[str, Any]) -> str:
    return json.dumps(entry, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write_bearing(file: BearingFile, name: str, found: BearingCoefficients, output: OutputFolder) -> list[str]:
    """bearing.json, the heat map of the stiffness matrix, a film's pressure, a shaft's transfer matrix as FRF table; the files' names."""
    from labpipe.document.saving import canvas_of, svg_text
    from labpipe.report.bearing_figures import stiffness_figure
    from labpipe.report.film_figure import film_figure

    output.write_path("bearing.json").write_text(bearing_json(bearing_entry(file, name, found)), encoding="utf-8")
    output.write_path("stiffness.svg").write_text(svg_text(canvas_of(stiffness_figure(name, found).graphic)), encoding="utf-8")
    names = ["bearing.json", "stiffness.svg"]
    if found.film is not None:
        output.write_path("pressure.svg").write_text(svg_text(canvas_of(film_figure(name, found.film).graphic)), encoding="utf-8")
        names.append("pressure.svg")
    response = file.kind.response and file.kind.response(file.settings(), found)
    if response is not None:
        write_frf_csv(output.write_path("transfer.csv"), response)
        names.append("transfer.csv")
    return names


def write_sweep(name: str, sweep: Sweep, found: list[BearingCoefficients], output: OutputFolder) -> list[str]:
    """sweep.csv with every coefficient, and their curves; the names of the files."""
    from labpipe.document.saving import canvas_of, svg_text
    from labpipe.report.bearing_figures import sweep_figures

    columns = sweep_columns(sweep, found)
    with output.write_path("sweep.csv").open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(",".join(columns) + "\n")
        for row in zip(*columns.values(), strict=True):
            stream.write(",".join(value if isinstance(value, str) else f"{value:.9g}" for value in row) + "\n")
    names = ["sweep.csv"]
    for kind, figure in sweep_figures(name, sweep.label, sweep.values, found).items():
        output.write_path(f"sweep-{kind}.svg").write_text(svg_text(canvas_of(figure.graphic)), encoding="utf-8")
        names.append(f"sweep-{kind}.svg")
    return names


def sweep_columns(sweep: Sweep, found: list[BearingCoefficients]) -> dict[str, Any]:
    """Title -> values: the swept entry, k_i_j and c_i_j (where there is damping), shares, rest position, the codes of the warnings."""
    columns: dict[str, Any] = {f"{sweep.key} [{sweep.unit}]": sweep.values}
    dofs = found[0].dofs
    for symbol, attribute, per_speed in (("k", "stiffness", ""), ("c", "damping", ".s")):
        matrices = np.stack([getattr(each, attribute) for each in found])
        if symbol == "c" and not matrices.any():
            continue
        for (i, row), (j, column) in ((r, c) for r in enumerate(dofs) for c in enumerate(dofs)):
            force, _, motion = found[0].unit(i, j).partition("/")
            columns[f"{symbol}_{row}_{column} [{force}{per_speed}/{motion}]"] = matrices[:, i, j]
    for number, amount in enumerate(found[0].shares):
        columns[f"share_{amount.name} [{amount.unit}]"] = np.array([each.shares[number].value for each in found])
    for number, amount in enumerate(found[0].rest):
        columns[f"{amount.name} [{amount.unit}]"] = np.array([each.rest[number].value for each in found])
    columns["warnings"] = [" ".join(finding.code for finding in each.findings) for each in found]
    return columns
