"""run_ups: the run-ups of a rotor -> journal coefficients by several methods, critical and threshold speeds, uncertainties."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from labpipe.artefacts.writing import OutputFolder
from labpipe.records.run_up_result import RunUpResult
from labpipe.run_ups.result import run_up_result
from labpipe.run_ups.settings import RunUpSettings
from labpipe.stages.run_ups_reading import read_run
from labpipe.stages.work import Work

Tell = Callable[[str], None]


def run_run_ups(settings: RunUpSettings, work: Work) -> RunUpResult:
    """The section run_ups: every run read, all methods fitted to the trained runs and compared on every run."""
    return identify_run_ups(settings, work.output, work.pipeline.folder, work.tell)


def identify_run_ups(settings: RunUpSettings, output: OutputFolder, folder: Path, tell: Tell = lambda _: None) -> RunUpResult:
    """All methods of the section, fitted to the trained runs and compared on every run. *folder*: of the pipeline file."""
    rig = settings.rig
    assert rig is not None
    probes = settings.probes.doubts
    return run_up_result(settings, rig, [read_run(run_settings, rig, output, folder, probes) for run_settings in settings.runs], tell)
