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


def bearing_entry(file: BearingFile, name: str, coefficients: BearingCoefficients) -> dict[str, Any]:
    """Entries of --json: kind, dofs, stiffness, damping, equilibrium, and where known the range over a ball passage. SI units."""
    equilibrium = {amount.name: amount.value for amount in coefficients.rest}
    equilibrium |= {key: values.tolist() for key, values in coefficients.element_state.items()}
    entry: dict[str, Any] = {
        "schema": SCHEMA,
        "labpipe": __version__,
        "kind": file.kind_name,
        "name": name,
        "dofs": list(coefficients.dofs),
        "stiffness": coefficients.stiffness.tolist(),
        "damping": coefficients.damping.tolist(),
        "equilibrium": equilibrium,
        "model": {amount.name: amount.value for amount in coefficients.notes} | dict(coefficients.words),
        "warnings": [{"code": finding.code, "message": finding.message} for finding in coefficients.findings],
    }
    if coefficients.shares:
        entry["shares"] = {amount.name: amount.value for amount in coefficients.shares}
    if coefficients.poles is not None:
        entry["poles"] = [[float(pole.real), float(pole.imag)] for pole in coefficients.poles]
    if coefficients.shaft:
        entry["shaft"] = {amount.name: amount.value for amount in coefficients.shaft}
    if coefficients.lowest is not None and coefficients.highest is not None:
        entry["passage"] = {"stiffness_min": coefficients.lowest.tolist(), "stiffness_max": coefficients.highest.tolist()}
    return entry


def bearing_json(entry: dict[str, Any]) -> str:
    return json.dumps(entry, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write_bearing(file: BearingFile, name: str, coefficients: BearingCoefficients, output: OutputFolder) -> list[str]:
    """bearing.json, the heat map of the stiffness matrix, a film's pressure, a shaft's transfer matrix as FRF table; the files' names."""
    from labpipe.document.saving import canvas_of, svg_text
    from labpipe.report.bearing_figures import stiffness_figure
    from labpipe.report.film_figure import film_figure

    output.write_path("bearing.json").write_text(bearing_json(bearing_entry(file, name, coefficients)), encoding="utf-8")
    output.write_path("stiffness.svg").write_text(svg_text(canvas_of(stiffness_figure(name, coefficients).graphic)), encoding="utf-8")
    names = ["bearing.json", "stiffness.svg"]
    if coefficients.film is not None:
        output.write_path("pressure.svg").write_text(svg_text(canvas_of(film_figure(name, coefficients.film).graphic)), encoding="utf-8")
        names.append("pressure.svg")
    response = file.kind.response and file.kind.response(file.settings(), coefficients)
    if response is not None:
        write_frf_csv(output.write_path("transfer.csv"), response)
        names.append("transfer.csv")
    return names


def write_sweep(name: str, sweep: Sweep, swept_coefficients: list[BearingCoefficients], output: OutputFolder) -> list[str]:
    """sweep.csv with every coefficient, and their curves; the names of the files."""
    from labpipe.document.saving import canvas_of, svg_text
    from labpipe.report.bearing_figures import sweep_figures

    columns = sweep_columns(sweep, swept_coefficients)
    with output.write_path("sweep.csv").open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(",".join(columns) + "\n")
        for row in zip(*columns.values(), strict=True):
            stream.write(",".join(value if isinstance(value, str) else f"{value:.9g}" for value in row) + "\n")
    names = ["sweep.csv"]
    for kind, figure in sweep_figures(name, sweep.label, sweep.values, swept_coefficients).items():
        output.write_path(f"sweep-{kind}.svg").write_text(svg_text(canvas_of(figure.graphic)), encoding="utf-8")
        names.append(f"sweep-{kind}.svg")
    return names


def sweep_columns(sweep: Sweep, swept_coefficients: list[BearingCoefficients]) -> dict[str, Any]:
    """Title -> values: the swept entry, k_i_j and c_i_j (where there is damping), shares, rest position, the codes of the warnings."""
    columns: dict[str, Any] = {f"{sweep.key} [{sweep.unit}]": sweep.values}
    dofs = swept_coefficients[0].dofs
    for symbol, attribute, per_speed in (("k", "stiffness", ""), ("c", "damping", ".s")):
        matrices = np.stack([getattr(point, attribute) for point in swept_coefficients])
        if symbol == "c" and not matrices.any():
            continue
        for (i, row), (j, column) in ((r, c) for r in enumerate(dofs) for c in enumerate(dofs)):
            force, _, motion = swept_coefficients[0].unit(i, j).partition("/")
            columns[f"{symbol}_{row}_{column} [{force}{per_speed}/{motion}]"] = matrices[:, i, j]
    for number, amount in enumerate(swept_coefficients[0].shares):
        columns[f"share_{amount.name} [{amount.unit}]"] = np.array([point.shares[number].value for point in swept_coefficients])
    for number, amount in enumerate(swept_coefficients[0].rest):
        columns[f"{amount.name} [{amount.unit}]"] = np.array([point.rest[number].value for point in swept_coefficients])
    columns["warnings"] = [" ".join(finding.code for finding in point.findings) for point in swept_coefficients]
    return columns
