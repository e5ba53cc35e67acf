"""A pipeline's fits as cases: one fit of one band to one test each, with the worlds that it is drawn in."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.artefacts.writing import output_folder
from labpipe.estimation.fitting import identify, sliding_bands
from labpipe.estimation.settings import FitSettings
from labpipe.project.measured import MeasuredTest
from labpipe.project.pipeline_file import Pipeline
from labpipe.project.run import Manner, measure_tests
from labpipe.records.fit_details import DynamicStiffness
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse
from labpipe.records.spectra import ChannelSpectra, FreeDecays
from tests.draws.responses import response_worlds
from tests.draws.usual import Errors, with_given_off, with_usual_mass, with_usual_uncertainties


@dataclass(frozen=True)
class Case:
    """One fit of one band to one test; *worlds* record the test anew, *fit* is that of the measurement.

    term: as fits of peaks have it.
    """

    name: str
    settings: FitSettings
    worlds: Any
    fit: Fit
    test: str = ""
    term: str = ""

    def fitted(self, errors: Errors, rng: np.random.Generator | None, fits: Sequence[Fit]) -> tuple[Fit, ...]:
        settings = with_given_off(self.settings, errors)
        settings = settings.kind.begin(settings, fits)
        found = identify(self.worlds.recorded(errors, rng), settings, judging=False)
        return tuple(replace(fit, test=self.test, term=self.term) for fit in found)


def cases_of(pipeline: Pipeline, most: int) -> list[Case]:
    """All cases of a pipeline, at most *most* of one fit, evenly chosen."""
    tests = measured_tests(pipeline)
    cases: list[Case] = []
    for settings in pipeline.fits:
        cases.extend(cases_of_fit(settings, tests, most, [case.fit for case in cases]))
    return cases


def cases_of_fit(
    settings: FitSettings, tests: Sequence[MeasuredTest], most: int, before: Sequence[Fit] = ()
) -> list[Case]:
    """The cases of one fit to the *tests*, at most *most*; *before*: fits that it may begin with."""
    fits, cases = list(before), []
    chosen = [
        one
        for test in tests
        if not settings.test or test.name in settings.test
        for one in _singles(settings, test)
    ]
    for place in np.unique(np.linspace(0, len(chosen) - 1, min(most, len(chosen))).round().astype(int)):
        label, alone, test, term = chosen[place]
        single = replace(with_usual_mass(alone), monte_carlo=0, bootstrap=0)
        single = single.kind.begin(single, fits)
        found = identify(test, single, judging=False)
        if not found or not _of_measured_terms(test, found[0]):
            continue
        worlds, fit = _worlds(test, single)
        fit = replace(fit, test=test.name)
        fits.append(fit)
        cases.append(Case(label, with_usual_mass(_free(alone, fit)), worlds, fit, test.name, term))
    return cases


def _of_measured_terms(test: MeasuredTest, fit: Fit) -> bool:
    """Whether the fitted curve is one of the measured terms: of a directional FRF it is not, and no world can
    be made about it.
    """
    if not isinstance(test, FrequencyResponse) or fit.curve is None:
        return True
    labels = {port.label for port in (*test.outputs, *test.inputs)}
    return labels >= {*fit.curve.outputs, *fit.curve.inputs} and fit.curve.form == test.form


def _free(settings: FitSettings, fit: Fit) -> FitSettings:
    """The fit without what only describes it; where forms are compared, the one that was chosen."""
    if settings.compare and fit.detail(DynamicStiffness) is not None:
        settings = replace(
            settings, model_settings=replace(settings.model_settings, form=fit.detail(DynamicStiffness).form)
        )
    return replace(settings, compare=False, monte_carlo=0, bootstrap=0)


def measured_tests(pipeline: Pipeline) -> tuple[MeasuredTest, ...]:
    """What was measured in every test, with uncertainties of usual size on all sensors."""
    with (
        tempfile.TemporaryDirectory() as scratch,
        output_folder(Path(scratch)) as folder,
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        tests = measure_tests(pipeline, folder, Manner()).tests
    return tuple(with_usual_uncertainties(test) for test in tests)


def _singles(
    settings: FitSettings, test: MeasuredTest
) -> Iterator[tuple[str, FitSettings, MeasuredTest, str]]:
    """The fits of one band each that a fit of peaks, bands or sliding bands is."""
    name = f"{settings.name}[{test.name}]" if test.name else settings.name
    if settings.peaks:
        for dof, bands in settings.peaks:
            for band in bands:
                yield (
                    f"{name}.{dof}",
                    replace(settings, peaks=(), band=band, input=(dof,), output=(dof,)),
                    test,
                    dof,
                )
    elif settings.sliding is not None or settings.bands:
        bands = settings.bands
        if settings.sliding is not None:
            whole = settings.band or (float(test.frequency[0]), float(test.frequency[-1]))
            bands = tuple(sliding_bands(whole, settings.sliding.width, settings.sliding.step))
        for band in bands:
            yield (
                f"{name}[{np.mean(band):g} Hz]",
                replace(settings, sliding=None, bands=(), band=band),
                test,
                "",
            )
    else:
        yield name, settings, test, ""


def _worlds(test: MeasuredTest, settings: FitSettings) -> tuple[Any, Fit]:
    """The worlds of a test about the fit, and the fit to the measurement itself."""
    if isinstance(test, FreeDecays):
        from tests.draws.decays import decay_worlds

        return decay_worlds(test, settings)
    if isinstance(test, ChannelSpectra):
        from tests.draws.spectra import spectra_worlds

        return spectra_worlds(test, settings)
    worlds = response_worlds(test, settings)
    return worlds[0], identify(worlds[0].response, settings, judging=False)[0]
