"""bearing: a bearing file -> stiffness and damping at its load and speed, alone or over a sweep of one entry."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from labpipe import __version__
from labpipe.artefacts.writing import OutputFolder
from labpipe.bearings.coefficients import BearingCoefficients
from labpipe.config.bearing import BearingFile
from labpipe.formats.frf_csv import write_frf_csv
from labpipe.marked_yaml import set_entry
from labpipe.stages.sweep import Sweep

SCHEMA = "labpipe/bearing/1"


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
