"""Metamodels of the journal coefficients over load and speed, and their predictions for every run."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from labpipe.errors import LabpipeError
from labpipe.records.run_up import RunUp
from labpipe.records.run_up_result import REJECTED, LeftOut, MetamodelResult, RunPrediction, Surface
from labpipe.rigs.film_family import carried_beyond
from labpipe.rigs.run_up_rotor import RunUpRotor
from labpipe.rotors.threshold import CoefficientsAtSpeed
from labpipe.run_ups.joint_result import JointFit
from labpipe.run_ups.measured import column
from labpipe.run_ups.metamodels import (
    Extent,
    Grid,
    Metamodel,
    PhysicalFit,
    caution,
    fit_metamodel,
    leave_one_load_out,
    physical_without,
)
from labpipe.run_ups.metamodels import LeftOut as LeftOutOf
from labpipe.run_ups.methods import BEYOND, Solved
from labpipe.run_ups.predictions import AtLoad, predict, with_unbalance_of
from labpipe.run_ups.settings import RunUpSettings

# Name in a pipeline -> kind of labpipe.run_ups.metamodels.
KINDS = {"response-surface": "surface", "network": "network", "gaussian-process": "process", "physical": "physical"}
TITLES = {
    "response-surface": "second-order response surface",
    "network": "feed-forward network",
    "gaussian-process": "Gaussian process",
    "physical": "physical fit (c)",
}
# Grid of the drawn surfaces.
SURFACE_LOADS, SURFACE_SPEEDS = 11, 15


def metamodels(
    settings: RunUpSettings, rig: RunUpRotor, trained: Sequence[RunUp], runs: Sequence[RunUp], solved: Sequence[Solved]
) -> tuple[MetamodelResult, ...]:
    """Metamodels of the section in its order; LabpipeError names the metamodel that cannot be fitted."""
    if not settings.metamodels:
        return ()
    by_name = {method.method.name: method for method in solved}
    grid = _grid(by_name[settings.metamodels_of], trained)
    joint = by_name["joint"].anywhere if "joint" in by_name else None
    refitted = physical_without(rig, trained) if "physical" in settings.metamodels else None
    kinds = [KINDS[name] for name in settings.metamodels if name != "physical"]
    left_out = leave_one_load_out(grid, kinds, refitted, settings.seed)
    results = []
    for name in settings.metamodels:
        model = _fitted(name, grid, joint, settings.seed)
        rows = tuple(_left_out_row(method) for method in left_out if method.kind == KINDS[name])
        source = by_name["joint" if name == "physical" else settings.metamodels_of].method
        doubt = (f"of a fit that chi-square rejects, {source.title}",) if source.verdict == REJECTED else ()
        predictions = tuple(_prediction(model, rig, run, settings.plane, doubt) for run in runs)
        results.append(
            MetamodelResult(name, TITLES[name], _surface(model, runs), rows, predictions, (f"{model.statement}.",), model.to_entries())
        )
    return tuple(results)


def _grid(method: Solved, trained: Sequence[RunUp]) -> Grid:
    """The coefficients of a method: at its points, or at the loads and speeds of the trained runs."""
    if method.anywhere is None:
        return Grid.of(method.fits)
    longest = max(trained, key=lambda run: run.n_speed)
    return Grid.sampled(method.anywhere, dict.fromkeys(run.load for run in trained), longest.speed)


def _fitted(name: str, grid: Grid, joint: object, seed: int) -> Metamodel:
    try:
        if name == "physical":
            assert isinstance(joint, JointFit)
            return PhysicalFit.of(joint, Extent.of(grid).speeds)
        return fit_metamodel(KINDS[name], grid, seed)
    except LabpipeError as error:
        error.where = error.where or f"run_ups, metamodel {name}"
        raise


def _left_out_row(validation: LeftOutOf) -> LeftOut:
    return LeftOut(validation.load, column(validation.errors), validation.beyond, validation.failed)


def _at_speed(model: Metamodel, load: float) -> CoefficientsAtSpeed:
    """Beyond the measured speeds K and Omega C stay constant, except for the physical fit, which computes the film there."""
    return carried_beyond(partial(model.predict, load), *model.speeds)


def _prediction(model: Metamodel, rig: RunUpRotor, run: RunUp, plane: str, doubt: tuple[str, ...]) -> RunPrediction:
    run_rig = with_unbalance_of(rig, run)
    remark = caution(model, run.load)
    notes = (*doubt, *((remark,) if remark else ()), *(() if isinstance(model, PhysicalFit) else (BEYOND,)))
    eight = model.predict(run.load, run.speed)
    error = None if doubt else model.std_error(run.load, run.speed)
    return predict(run_rig, run, AtLoad(_at_speed(model, run.load), eight, error, notes=notes), plane, curves=False)


def _surface(model: Metamodel, runs: Sequence[RunUp]) -> Surface:
    """Coefficients over all loads, held-out loads included, and the speeds of the fit."""
    loads = [run.load for run in runs]
    load, speed = np.linspace(min(loads), max(loads), SURFACE_LOADS), np.linspace(*model.extent.speeds, SURFACE_SPEEDS)
    values = np.stack([model.predict(one_load, speed) for one_load in load])
    return Surface(column(load), column(speed), tuple(tuple(column(row) for row in values[:, :, n]) for n in range(8)))
