"""compare: the fits of all tests held against each other, and against the theory of a bearing file at each test's condition."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from labpipe.bearings.magnetic_kind import MAGNETIC, MagneticFile
from labpipe.bearings.rolling import DOFS
from labpipe.campaign.compare import Evidence, Theory, compare
from labpipe.campaign.prediction import MagneticTheory
from labpipe.campaign.settings import MAGNETIC_KINDS, CompareSettings, TheorySettings
from labpipe.campaign.theory import TheoryAt
from labpipe.config.bearing import BearingFile, open_bearing
from labpipe.errors import ConfigError, LabpipeError
from labpipe.marked_yaml import set_entry
from labpipe.records.comparison import Comparison, Comparisons
from labpipe.records.identification import Failed
from labpipe.stages.work import COMPARE_PREFIX, Work

# The condition is raised by this share for the slope of the theory.
STEP = 1e-3


def run_comparisons(settings: Sequence[CompareSettings], work: Work) -> Comparisons:
    """The section compare: every comparison in its order. One that lacks a failed test is named among the work's failures.

    Otherwise LabpipeError names the comparison.
    """
    conditions = {test.name: test.conditions for test in work.tests}
    evidence = Evidence(tuple(work.fits), tuple(work.responses), work.pipeline.fits, conditions=conditions, spectra=tuple(work.spectra))
    comparisons: list[Comparison] = []
    for comparison in settings:
        try:
            comparisons.append(_compared(work.pipeline.path, comparison, evidence))
        except LabpipeError as error:
            if not work.go_on:
                raise
            work.failed.append(Failed(COMPARE_PREFIX + comparison.name, str(error)))
    return tuple(comparisons)


def _compared(path: Path, settings: CompareSettings, evidence: Evidence) -> Comparison:
    named = settings.theory
    try:
        if named is None:
            return compare(settings, evidence)
        make_theory = magnetic_theory if settings.kind in MAGNETIC_KINDS else theory_of
        return compare(settings, evidence, make_theory(path.parent, named))
    except LabpipeError as error:
        error.where = error.where or f"{path}: compare.{settings.name}"
        raise


def theory_of(folder: Path, settings: TheorySettings) -> Theory:
    """The bearing file as a function of the condition [SI]; ConfigError for a bearing without five dofs, or without a shaft on it."""
    file = open_bearing(folder / settings.bearing)

    def at(conditions: Sequence[tuple[float, str]]) -> TheoryAt:
        # The error of setting is that of the first condition.
        raised = [(conditions[0][0] * (1 + STEP), conditions[0][1]), *conditions[1:]]
        low, high = (_settings_at(file, settings.entry, pairs) for pairs in (conditions, raised))
        here, near = file.coefficients([low, high])
        shaft = getattr(low, "shaft", None)
        if here.dofs != DOFS or shaft is None:
            hint = "a ball or roller bearing with shaft: {mass, inertia_x} is needed"
            raise ConfigError("the bearing file has no shaft on a bearing of five dofs", where=str(file.path), hint=hint)
        return TheoryAt(here.stiffness, near.stiffness, STEP, shaft.body)

    return at


def magnetic_theory(folder: Path, settings: TheorySettings) -> MagneticTheory:
    """The magnetic-bearing file as a function of the condition that sets one of its entries; ConfigError for another kind of bearing."""
    file = open_bearing(folder / settings.bearing)
    if file.kind_name != MAGNETIC:
        raise ConfigError(f"is of the kind {file.kind_name}", where=str(file.path), hint=f"a loop is predicted for the kind {MAGNETIC}")

    def at(condition: float | None, unit: str) -> MagneticFile:
        bearing: MagneticFile = file.settings() if condition is None else _settings_at(file, settings.entry, [(condition, unit)])
        return bearing

    return at


def _settings_at(file: BearingFile, entries: Sequence[str], conditions: Sequence[tuple[float, str]]) -> Any:
    for entry, (value, unit) in zip(entries, conditions, strict=True):
        set_entry(file.tree, f"{entry}={value!r} {unit}")
    return file.settings()
