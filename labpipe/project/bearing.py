"""bearing: a bearing file -> stiffness and damping at its load and speed, alone or over a sweep."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from labpipe import __version__
from labpipe.arrays import FloatArray
from labpipe.artefacts.json_file import named_entries, without_nan
from labpipe.artefacts.writing import OutputFolder
from labpipe.bearings.kinds import Amount, BearingCoefficients, BearingUncertainties, bearing_uncertainties
from labpipe.project.bearing_file import BearingFile, BearingSweep, setting_at
from labpipe.project.marked_yaml import set_entry
from labpipe.quantities import display_unit, to_display
from labpipe.raw_files.frf_csv import write_frf_csv
from labpipe.records.uncertain import uncertainty_of
from labpipe.report.chart import PALETTE_SIZE, Axis, Chart, Panel, Series, cells, curve, named_ticks, stack
from labpipe.report.document import Figure
from labpipe.report.figures import scale_of
from labpipe.report.wording import unit_text

DASHES = ("-", "--", ":", "-.")
# Below this part of sqrt(K_ii K_jj) a coefficient is zero by structure and rounding.
STRUCTURAL_ZERO = 1e-9


def stiffness_figure(name: str, bearing: BearingCoefficients) -> Figure:
    """Heat map of the stiffness: the colour is K_ij / sqrt(K_ii K_jj), the number K_ij in its unit."""
    n, ticks = len(bearing.dofs), named_ticks(bearing.dofs)
    texts = [[_coefficient_text(bearing, row, column) for column in range(n)] for row in range(n)]
    matrix = cells(bearing.relative, texts, "k_ij / sqrt(k_ii k_jj)")
    panel = Panel(Axis("displacement in", ticks=ticks), Axis("load in", ticks=ticks), (matrix,))
    chart = Chart((panel,), size=(1.15 * n + 1.3, 0.62 * n + 0.9))
    colour = "Colour: coupling relative to the diagonal, so that all units compare."
    return Figure(chart, f"{name}: stiffness matrix. {colour}", f"Stiffness matrix of {name} as a heat map")


def _coefficient_text(bearing: BearingCoefficients, row: int, column: int) -> str:
    if abs(bearing.relative[row, column]) < STRUCTURAL_ZERO:
        return "0"
    unit = bearing.unit(row, column)
    return f"{to_display(bearing.stiffness[row, column], display_unit(unit)):.4g}\n{unit_text(unit)}"


def sweep_figures(
    title: str, label: str, values: FloatArray, swept: Sequence[BearingCoefficients]
) -> dict[str, Figure]:
    """The figures "stiffness" and, if any, "damping" over *values* (n,) [unit of *label*: "speed [Hz]"]."""
    figures = {"stiffness": _sweep_figure(title, label, values, swept, "stiffness")}
    if any(bearing.damping.any() for bearing in swept):
        figures["damping"] = _sweep_figure(title, label, values, swept, "damping")
    return figures


def _sweep_figure(
    title: str, label: str, values: FloatArray, swept: Sequence[BearingCoefficients], kind: str
) -> Figure:
    groups = _coefficients_by_unit(swept, np.stack([getattr(bearing, kind) for bearing in swept]))
    name, _, unit = label.rstrip("]").partition(" [")
    panels = []
    for si_unit, entries in groups.items():
        series = [_curve(values, swept, kind, entry, number) for number, entry in enumerate(entries)]
        shown = display_unit(si_unit)
        shown = shown.replace("/", ".s/") if kind == "damping" else shown
        panels.append(Panel(Axis(name, unit), Axis(kind, shown), tuple(series)))
    ranged = kind == "stiffness" and swept[0].lowest is not None
    band = "; shaded: range over one passage of a rolling element" if ranged else ""
    caption = f"{title}: {kind} over {label}{band}. Coefficients that are zero throughout are left out."
    alternative = f"{kind.capitalize()} coefficients of {title} over {label}"
    return Figure(stack(panels, 0.7 + 2.3 * len(panels)), caption, alternative)


def _coefficients_by_unit(
    swept: Sequence[BearingCoefficients], matrices: FloatArray
) -> dict[str, list[tuple[int, int]]]:
    """unit -> the (row, column) that are not zero throughout, one of each pair that symmetry makes equal."""
    relative = np.max([np.abs(bearing.relative) for bearing in swept], axis=0)
    least = 1e-9 * np.abs(matrices).max()
    symmetric = np.allclose(matrices, np.swapaxes(matrices, 1, 2), rtol=1e-9, atol=least)
    groups: dict[str, list[tuple[int, int]]] = {}
    for (row, column), size in np.ndenumerate(relative):
        if (size >= STRUCTURAL_ZERO or row == column) and not (symmetric and column < row):
            groups.setdefault(swept[0].unit(row, column), []).append((row, column))
    return groups


def _curve(
    values: FloatArray, swept: Sequence[BearingCoefficients], kind: str, entry: tuple[int, int], number: int
) -> Series:
    dofs, factor = swept[0].dofs, scale_of(swept[0].unit(*entry))

    def sweep_values(name: str) -> FloatArray:
        return factor * np.array([getattr(bearing, name)[entry] for bearing in swept])

    ends = (end for bearing in swept for end in (bearing.lowest, bearing.highest))
    ranged = kind == "stiffness" and all(end is not None for end in ends)
    band = (sweep_values("lowest"), sweep_values("highest")) if ranged else None
    title = f"{'k' if kind == 'stiffness' else 'c'} {dofs[entry[0]]},{dofs[entry[1]]}"
    line = DASHES[number % len(DASHES)]
    return curve(title, values, sweep_values(kind), number % PALETTE_SIZE, line, width=1.5, band=band)


SCHEMA = "labpipe/bearing/1"


@dataclass(frozen=True)
class Evaluated:
    """The coefficients of a bearing, and what the *uncertainties* of its numbers leave of them, if any."""

    coefficients: BearingCoefficients
    uncertainties: BearingUncertainties | None = None


def evaluate(file: BearingFile) -> Evaluated:
    """The coefficients of the file as it is now, with their uncertainties; errors say which file."""
    (whole,) = _evaluate(file, [""], file.uncertainties)
    return whole


def sweep_bearing(file: BearingFile, sweep: BearingSweep) -> list[Evaluated]:
    """The coefficients at every value of the sweep, without the uncertainty of the swept entry itself."""
    entries = [f"{sweep.key}={float(value)!r} {sweep.unit}" for value in sweep.values]
    return _evaluate(file, entries, [key for key in file.uncertainties if key != sweep.key])


def _evaluate(file: BearingFile, entries: Sequence[str], keys: Collection[str]) -> list[Evaluated]:
    """The file with each of the *entries* set: all settings in one go, since kinds evaluate many at once."""
    settings = []
    for entry in entries:
        if entry:
            set_entry(file.tree, entry)
        settings.append(file.settings())
        for key in keys:
            settings.extend(file.ends(key))
    coefficients = file.coefficients(settings)
    if not keys:
        return [Evaluated(point) for point in coefficients]
    units = {key: setting_at(file.kind.settings, key).unit for key in keys}
    sources = [uncertainty_of(file.uncertainties[key], key, unit) for key, unit in units.items()]
    size = 1 + 2 * len(keys)
    rows = [coefficients[start : start + size] for start in range(0, len(coefficients), size)]
    return [
        Evaluated(row[0], bearing_uncertainties(sources, list(zip(row[1::2], row[2::2], strict=True))))
        for row in rows
    ]


def bearing_entry(file: BearingFile, name: str, whole: Evaluated) -> dict[str, Any]:
    """The entries of --json, in SI units: the coefficients and all that is known beside them."""
    coefficients = whole.coefficients
    equilibrium = _values(coefficients.rest)
    equilibrium |= {key: values.tolist() for key, values in coefficients.element_state.items()}
    entry: dict[str, Any] = {
        "schema": SCHEMA,
        "labpipe": __version__,
        "kind": file.kind_name,
        "name": name,
        **named_entries(coefficients, "dofs", "stiffness", "damping"),
        "equilibrium": equilibrium,
        "model": _values(coefficients.notes) | dict(coefficients.words),
        "warnings": [named_entries(finding, "code", "message") for finding in coefficients.findings],
    }
    if coefficients.shares:
        entry["shares"] = _values(coefficients.shares)
    if coefficients.poles is not None:
        entry["poles"] = [[float(pole.real), float(pole.imag)] for pole in coefficients.poles]
    if coefficients.shaft:
        entry["shaft"] = _values(coefficients.shaft)
    if coefficients.lowest is not None and coefficients.highest is not None:
        ends = {"min": coefficients.lowest, "max": coefficients.highest}
        entry["passage"] = {f"stiffness_{name}": matrix.tolist() for name, matrix in ends.items()}
    if whole.uncertainties is not None:
        entry["uncertainty"] = _uncertainty_entry(whole.uncertainties, coefficients)
    return entry


def _values(amounts: Sequence[Amount]) -> dict[str, Any]:
    return {amount.name: amount.value for amount in amounts}


def _uncertainty_entry(
    uncertainties: BearingUncertainties, coefficients: BearingCoefficients
) -> dict[str, Any]:
    names = [amount.name for amount in coefficients.rest]
    changes = zip(
        uncertainties.sources, uncertainties.stiffness, uncertainties.damping, uncertainties.rest, strict=True
    )
    return {
        "stiffness": uncertainties.error("stiffness").tolist(),
        "damping": uncertainties.error("damping").tolist(),
        "equilibrium": dict(zip(names, uncertainties.error("rest").tolist(), strict=True)),
        "sources": [
            {
                **named_entries(source, "source", "std_error", "unit"),
                "stiffness": stiffness.tolist(),
                "damping": damping.tolist(),
                "equilibrium": dict(zip(names, rest.tolist(), strict=True)),
            }
            for source, stiffness, damping, rest in changes
        ],
    }


def bearing_json(entry: dict[str, Any]) -> str:
    """The entry as text; null where an amount has no end."""
    return json.dumps(without_nan(entry), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write_bearing(file: BearingFile, name: str, whole: Evaluated, output: OutputFolder) -> list[str]:
    """Write bearing.json, figures, and a shaft's transfer matrix; the names of the files."""
    coefficients = whole.coefficients
    entry = bearing_json(bearing_entry(file, name, whole))
    output.write_path("bearing.json").write_text(entry, encoding="utf-8")
    figures = {"stiffness.svg": stiffness_figure(name, coefficients)}
    figures |= file.kind.figures(name, coefficients) if file.kind.figures else {}
    names = ["bearing.json", *_write_figures(figures, output)]
    response = file.kind.response and file.kind.response(file.settings(), coefficients)
    if response is not None:
        write_frf_csv(output.write_path("transfer.csv"), response)
        names.append("transfer.csv")
    return names


def write_sweep(name: str, sweep: BearingSweep, points: list[Evaluated], output: OutputFolder) -> list[str]:
    """sweep.csv with every coefficient, and their curves; the names of the files."""
    columns = sweep_columns(sweep, points)
    with output.write_path("sweep.csv").open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(",".join(columns) + "\n")
        for row in zip(*columns.values(), strict=True):
            cells = (value if isinstance(value, str) else f"{value:.9g}" for value in row)
            stream.write(",".join(cells) + "\n")
    figures = sweep_figures(name, sweep.label, sweep.values, [point.coefficients for point in points])
    of_kinds = {f"sweep-{kind}.svg": figure for kind, figure in figures.items()}
    return ["sweep.csv", *_write_figures(of_kinds, output)]


def _write_figures(figures: Mapping[str, Figure], output: OutputFolder) -> list[str]:
    from labpipe.document.charts import svg_file

    for name, figure in figures.items():
        output.write_path(name).write_text(svg_file(figure), encoding="utf-8")
    return [*figures]


def sweep_columns(sweep: BearingSweep, points: list[Evaluated]) -> dict[str, Any]:
    """Title -> values: the swept entry, k_i_j and c_i_j (where there is damping), shares, rest position, with
    uncertainties u_k_i_j and u_c_i_j, and the codes of the warnings.
    """
    columns: dict[str, Any] = {f"{sweep.key} [{sweep.unit}]": sweep.values}
    coefficients = [point.coefficients for point in points]
    for symbol, attribute in (("k", "stiffness"), ("c", "damping")):
        matrices = np.stack([getattr(point, attribute) for point in coefficients])
        if symbol == "k" or matrices.any():
            columns |= _name_elements(symbol, coefficients[0], matrices)
    for prefix, attribute in (("share_", "shares"), ("", "rest")):
        for number, amount in enumerate(getattr(coefficients[0], attribute)):
            values = [getattr(point, attribute)[number].value for point in coefficients]
            columns[f"{prefix}{amount.name} [{amount.unit}]"] = np.array(values)
    uncertainties = [point.uncertainties for point in points if point.uncertainties is not None]
    for symbol, attribute in (("u_k", "stiffness"), ("u_c", "damping")):
        errors = np.array([point.error(attribute) for point in uncertainties])
        if uncertainties and (symbol == "u_k" or errors.any()):
            columns |= _name_elements(symbol, coefficients[0], errors)
    columns["warnings"] = [" ".join(finding.code for finding in point.findings) for point in coefficients]
    return columns


def _name_elements(symbol: str, first: BearingCoefficients, matrices: FloatArray) -> dict[str, FloatArray]:
    kind = "damping" if symbol.endswith("c") else "stiffness"
    return {
        f"{symbol}_{row}_{column} [{first.unit(i, j, kind)}]": matrices[:, i, j]
        for i, row in enumerate(first.dofs)
        for j, column in enumerate(first.dofs)
    }
