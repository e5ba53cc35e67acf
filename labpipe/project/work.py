"""What the sections of a pipeline work on, and the section identify: the fits of every test."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

from numpy.linalg import LinAlgError

from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import ConfigError, FitError, LabpipeError, locate_errors
from labpipe.estimation.settings import FitSettings
from labpipe.project.measured import MeasuredTest
from labpipe.project.pipeline_file import Pipeline, read_fit
from labpipe.records.identification import Failed, Fit
from labpipe.records.response import FrequencyResponse
from labpipe.records.sections import PipelineSection
from labpipe.records.spectra import ChannelSpectra
from labpipe.registry import nearest

Tell = Callable[[str], None]
# What names a failed comparison, or a failed fit, among failed tests.
COMPARE_PREFIX, FIT_PREFIX = "compare.", "identify."


@dataclass(frozen=True)
class Work:
    """A pipeline whose recordings have been measured. digests: of the files of every test.
    test_fits: made already test by test, by their name in the pipeline. fits: of the sections so far. failed:
    missing tests, and comparisons that need them. *jobs*: processes of a study, 0 for one per processor.
    """

    pipeline: Pipeline
    tests: Sequence[MeasuredTest]
    output: OutputFolder
    _: KW_ONLY
    tell: Tell = lambda _: None
    jobs: int = 0
    digests: Mapping[str, frozenset[str]] = field(default_factory=dict)
    test_fits: Mapping[str, Sequence[Fit]] = field(default_factory=dict)
    fits: list[Fit] = field(default_factory=list)
    failed: list[Failed] = field(default_factory=list)

    @property
    def responses(self) -> list[FrequencyResponse]:
        return [test for test in self.tests if isinstance(test, FrequencyResponse)]

    @property
    def spectra(self) -> list[ChannelSpectra]:
        return [test for test in self.tests if isinstance(test, ChannelSpectra)]

    @property
    def conditions(self) -> dict[str, dict[str, str]]:
        return {test.name: test.conditions for test in self.tests}


SINGULAR = (
    "record more periods or blocks, look for channels that are silent or alike, or choose another "
    "band or fewer parameters"
)


def run_fits(settings: Sequence[FitSettings], work: Work) -> list[Fit]:
    """Every fit on every test that it names; those made already are reused. One that the measurement cannot
    support is named among the work's failures; FitError where none is left.
    """
    fits: list[Fit] = []
    faults: list[FitError] = []
    for fit in settings:
        if fit.name in work.test_fits:
            made = list(work.test_fits[fit.name])
        else:
            # A test that failed is named among the failures.
            check_tested(fit, [of_test.name for of_test in (*work.tests, *work.failed)])
            stated = {test.name: test.repeats for test in work.pipeline.tests}
            try:
                made = fits_of(work.tests, _begin(fit, fits, work), work.pipeline.path, stated)
            except FitError as error:
                faults.append(error)
                work.failed.append(Failed(FIT_PREFIX + fit.name, str(error)))
                continue
            if work.tests and not made and not work.failed:
                where = f"{work.pipeline.path}: identify.{fit.name}"
                what = "no test is left for it: none is fitted against its own baseline"
                raise ConfigError(what, where, "add the test that the baseline is for")
        from labpipe.estimation.levels import with_level_findings, with_orders_named

        fits.extend(with_orders_named(with_level_findings(made, work.conditions), work.conditions))
    if faults and not fits:
        raise faults[0]
    names = {parameter.name for fit in fits for parameter in fit.parameters}
    sources = () if work.failed else {source for fit in settings for source in fit.between}
    for source in sources:
        if source.parameter not in names:
            what = f"uncertainty.repeatability.{source.name}: no fit has a parameter '{source.parameter}'"
            raise ConfigError(what, work.pipeline.path, nearest(source.parameter, names))
    return fits


def _begin(settings: FitSettings, fits: Sequence[Fit], work: Work) -> FitSettings:
    """The settings with the result of the earlier fit that they begin with, or why it failed."""
    where = f"{work.pipeline.path}: identify.{settings.name}"
    earlier = settings.kind.earlier(settings)
    named = next((fit for fit in work.pipeline.fits if fit.name == earlier), None)
    if earlier and not any(earlier in (fit.name, fit.test) for fit in fits):
        tests = {earlier} if named is None else {*named.test} or {failure.name for failure in work.failed}
        tests = {*tests, FIT_PREFIX + earlier}
        for failure in work.failed:
            if failure.name in tests:
                what = f"it begins with '{earlier}', which has no result: {failure.message}"
                raise FitError(what, where, "correct that one first")
    with locate_errors(where):
        settings = settings.kind.begin(settings, fits)
        if named is not None:
            settings.kind.check_after(settings, named)
        return settings


def with_repeats_of(settings: FitSettings, repeats: str) -> FitSettings:
    """The settings with what a test says of its *repeats*, where it does and the model takes it."""
    takes = repeats and "repeats" in settings.kind.keys
    return replace(settings, repeats=repeats) if takes else settings


def fits_of(
    tests: Sequence[MeasuredTest],
    settings: FitSettings,
    pipeline_path: Path,
    repeats: Mapping[str, str] = MappingProxyType({}),
) -> list[Fit]:
    """The fits of the tests named, or of all; *repeats*: what tests say. LabpipeError names fit and test."""
    # What fits is not imported by a run that finds all its fits fresh.
    from labpipe.estimation.budget import with_repeat_sources
    from labpipe.estimation.fitting import identify

    fits: list[Fit] = []
    for measured in tests:
        if settings.test and measured.name not in settings.test:
            continue
        try:
            with_repeats = with_repeats_of(settings, repeats.get(measured.name, ""))
            scatter = settings.between, measured.name, measured.conditions, settings.coverage
            test_fits = [with_repeat_sources(fit, *scatter) for fit in identify(measured, with_repeats)]
        except (LabpipeError, LinAlgError) as error:
            test = f", test {measured.name}" if measured.name else ""
            where = f"{pipeline_path}: identify.{settings.name}{test}"
            if not isinstance(error, LabpipeError):
                what = f"the data leave a matrix of the fit without a solution ({error})"
                raise FitError(what, where, SINGULAR) from error
            error.where = error.where or where
            raise
        fits.extend(replace(fit, test=measured.name) for fit in test_fits)
    return fits


def check_tested(settings: FitSettings, test_names: Sequence[str]) -> None:
    """ConfigError when a fit names a test that is not *test_names*."""
    for name in settings.test:
        if name not in test_names:
            what = f"identify.{settings.name}.test: no test '{name}'"
            raise ConfigError(what, hint=nearest(name, test_names))


IDENTIFY = PipelineSection(
    words="One entry per fit, under a name of your choice.",
    settings=FitSettings,
    named=True,
    read=read_fit,
    run=run_fits,
    fits=True,
)
