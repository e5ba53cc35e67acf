"""Parameters, critical and threshold speeds of run-ups for lists of results."""

from __future__ import annotations

from collections.abc import Iterator

from labpipe.records.listed import ListedParameter
from labpipe.records.parameter import Parameter
from labpipe.records.run_up_result import Amount, MeasuredRun, MetamodelResult, RunPrediction, RunUpMethod, RunUpResult

MEASURED = "run_ups.measured"


def listed_speeds_and_parameters(result: RunUpResult) -> Iterator[ListedParameter]:
    """Of every method its parameters, and of every run its critical and threshold speed [rad/s], measured and predicted."""
    for run in result.runs:
        yield from _speeds(MEASURED, run.name, run, ())
    predictors: list[RunUpMethod | MetamodelResult] = [*result.methods, *result.metamodels]
    for predictor in predictors:
        fit = f"run_ups.{predictor.name}"
        codes = ("model-mismatch",) if getattr(predictor, "verdict", "") == "rejected" else ()
        for parameter in getattr(predictor, "parameters", ()):
            yield ListedParameter(fit=fit, parameter=parameter, model="run_ups", warnings=codes)
        for prediction in predictor.predictions:
            yield from _speeds(fit, prediction.run, prediction, codes)


def _speeds(fit: str, run: str, owner: MeasuredRun | RunPrediction, codes: tuple[str, ...]) -> Iterator[ListedParameter]:
    for name in ("critical_speed", "threshold"):
        speed: Amount | None = getattr(owner, name)
        if speed is not None:
            parameter = Parameter(name, speed.value, "rad/s", std_error=speed.std_error, t_ratio=None, ci95=speed.ci95, derived=True)
            yield ListedParameter(fit=fit, parameter=parameter, test=run, model="run_ups", warnings=codes)
