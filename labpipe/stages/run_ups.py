"""run_ups: the run-ups of a rotor -> journal coefficients by several methods, critical and threshold speeds, and their doubt."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from labpipe.artefacts.writing import OutputFolder
from labpipe.config.run_up_rotor import load_run_up_rotor
from labpipe.records.run_up_result import RunUpResult
from labpipe.run_ups.result import run_up_result
from labpipe.run_ups.settings import RunUpSettings
from labpipe.stages.run_ups_reading import read_run

Tell = Callable[[str], None]


def identify_run_ups(settings: RunUpSettings, output: OutputFolder, folder: Path, tell: Tell = lambda _: None) -> RunUpResult:
    """All methods that the section wants, on the trained runs, held against every run. *folder*: of the pipeline file."""
    rig = load_run_up_rotor(settings.rotor_path)
    return run_up_result(settings, rig, [read_run(one, rig, output, folder) for one in settings.runs], tell)
