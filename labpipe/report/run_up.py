"""Report of run-ups: measurements, predictions and coefficients of every method, identifiability, figures."""

from __future__ import annotations

from collections.abc import Sequence

from labpipe.records.identification import Identification
from labpipe.records.run_up_result import HELD_OUT, MetamodelResult, RunUpMethod, RunUpResult
from labpipe.report.document import Block, Paragraph, Section
from labpipe.report.run_up_coefficients import coefficient_figure, convergence_figure, spread_figure, surface_figures
from labpipe.report.run_up_figures import best_method, bode_figure, cascade_figure, orbit_figure, polar_figure, speeds_figure
from labpipe.report.run_up_tables import (
    coefficient_table,
    doubt_blocks,
    measured_table,
    parameter_table,
    speed_blocks,
    validation_table,
)

FRAME = (
    "x lies along the static load, y a quarter turn further with the spin. The critical speed is that of the largest displacement on the "
    "orbit, read between the measured speeds; the threshold is the onset speed of instability."
)


def cover_facts(result: RunUpResult) -> dict[str, str]:
    """The rotor, and its runs with their loads."""
    return {"rig": result.rotor, "run-ups": ", ".join(f"{run.name} ({run.load:.3g} N, {run.role})" for run in result.runs)}


def run_up_sections(result: RunUpResult, _identification: Identification) -> tuple[Section, ...]:
    """Sections on measurements, both speeds, identifiability, coefficients, metamodels, and the response of every run."""
    return (
        Section(f"Run-ups: {result.rotor}", _measured(result)),
        Section("Critical speed and threshold", (speeds_figure(result), *speed_blocks(result), *_cautions(result))),
        Section("Identifiability of the coefficients", _doubt(result)),
        Section("Journal coefficients", _coefficients(result)),
        *([Section("Metamodels", _metamodels(result))] if result.metamodels else []),
        Section("Response of every run", tuple(bode_figure(result, run) for run in result.runs)),
    )


def _measured(result: RunUpResult) -> tuple[Block, ...]:
    method = best_method(result)
    description = f"{result.rotor}, on its {result.bearing}. {FRAME}"
    cascades = [cascade_figure(run, cascade) for run in result.runs for cascade in run.cascades]
    return (Paragraph(description), measured_table(result), polar_figure(result, method), orbit_figure(result, method), *cascades)


def _cautions(result: RunUpResult) -> tuple[Block, ...]:
    """Limits of predictions and reasons of missing ones."""
    notes = _notes(result.methods)
    held_out = {run.name for run in result.runs if run.role == HELD_OUT}
    return tuple(
        Paragraph(f"{text} ({', '.join(runs)}).", "warning" if held_out & set(runs) and "outside the loads" in text else "note")
        for text, runs in notes.items()
    )


def _notes(owners: Sequence[RunUpMethod | MetamodelResult]) -> dict[str, list[str]]:
    """Every distinct note with its runs."""
    notes: dict[str, list[str]] = {}
    for owner in owners:
        for prediction in owner.predictions:
            for text in prediction.notes:
                notes.setdefault(f"{owner.title}: {text}", []).append(prediction.run)
    return notes


def _doubt(result: RunUpResult) -> tuple[Block, ...]:
    searches: list[Block] = []
    for method in result.methods:
        searches += [convergence_figure(method, search) for search in method.convergence]
        searches += [spread_figure(method, spread) for spread in method.spreads]
    return (*doubt_blocks(result), *searches)


def _coefficients(result: RunUpResult) -> tuple[Block, ...]:
    method = best_method(result)
    blocks: list[Block] = [] if method is None or not method.parameters else [parameter_table(method)]
    for run in result.runs:
        blocks.append(coefficient_figure(result, run))
        table = None if method is None else coefficient_table(method, run)
        blocks += [] if table is None else [table]
    return tuple(blocks)


def _metamodels(result: RunUpResult) -> tuple[Block, ...]:
    basis = (
        f"Fitted to the coefficients of {result.metamodels_of} at the trained loads; the physical fit is (c). A metamodel is no "
        "better than these: a small leave-one-out error means that the coefficients are smooth, not that they are right."
    )
    blocks: list[Block] = [Paragraph(basis), validation_table(result.metamodels)]
    blocks += [Paragraph(f"{text} ({', '.join(runs)}).", "note") for text, runs in _notes(result.metamodels).items()]
    for model in result.metamodels:
        blocks += [Paragraph(f"{model.title}: {' '.join(model.remarks)}")] if model.remarks else []
        blocks += surface_figures(model)
    return tuple(blocks)
