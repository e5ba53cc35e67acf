"""The section identify: the fits of every test."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from labpipe.errors import ConfigError, LabpipeError
from labpipe.identify.fitting import identify
from labpipe.identify.levels import with_level_findings
from labpipe.identify.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse
from labpipe.registry import nearest
from labpipe.stages.work import Work


def run_fits(settings: Sequence[FitSettings], work: Work) -> list[Fit]:
    """Every fit on every test that it names; fits already made test by test are reused."""
    fits: list[Fit] = []
    conditions = {response.name: response.conditions for response in work.responses}
    for fit in settings:
        if fit.name in work.test_fits:
            made = list(work.test_fits[fit.name])
        else:
            check_tested(fit, [response.name for response in work.responses])
            made = fits_of(work.responses, fit.kind.begin(fit, fits), work.pipeline.path)
        fits.extend(with_level_findings(made, conditions))
    return fits


def fits_of(responses: Sequence[FrequencyResponse], settings: FitSettings, pipeline_path: Path) -> list[Fit]:
    """The fits of the responses whose test the settings name, or of all; LabpipeError names fit and test."""
    fits: list[Fit] = []
    for response in responses:
        if settings.test and response.name not in settings.test:
            continue
        try:
            response_fits = identify(response, settings)
        except LabpipeError as error:
            test = f", test {response.name}" if response.name else ""
            error.where = error.where or f"{pipeline_path}: identify.{settings.name}{test}"
            raise
        fits.extend(dataclasses.replace(fit, test=response.name) for fit in response_fits)
    return fits


def check_tested(settings: FitSettings, test_names: Sequence[str]) -> None:
    """ConfigError when a fit names a test that is not *test_names*."""
    for name in settings.test:
        if name not in test_names:
            raise ConfigError(f"identify.{settings.name}.test: no test '{name}'", hint=nearest(name, test_names))
