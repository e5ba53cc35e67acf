"""labpipe calibrate -c FILE [-o DIR]"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from labpipe.artefacts.header import source_ref
from labpipe.artefacts.writing import output_folder
from labpipe.cli import options
from labpipe.cli.terminal import echo_identification
from labpipe.config.pipeline import load_pipeline
from labpipe.errors import ConfigError
from labpipe.stages.identify import identify_stage


@click.command()
@options.pipeline_file
@options.out_folder
@options.overrides
@options.quiet
@options.verbose
def calibrate(pipeline_path: Path, output: Path, overrides: tuple[str, ...], quiet: bool, verbose: bool) -> int:
    """Fit the straight lines of a file's calibrate: section: DIR/identification.json.

    A rig file can then name a fitted slope as a sensitivity: `sensitivity: results/identification.json#probe_y`.
    """
    pipeline = load_pipeline(pipeline_path, overrides)
    calibrations = pipeline.sections.get("calibrate", ())
    if not calibrations:
        raise ConfigError("calibrate: is missing", where=str(pipeline_path), hint="name a table with its x and y columns")
    options.teller(quiet, verbose)(f"calibrate {pipeline.title}")
    names = {calibration.name for calibration in calibrations}
    rules = tuple(rule for rule in pipeline.rules if rule.fit in names)
    lines = replace(pipeline, tests=(), sections={"calibrate": calibrations}, rules=rules)
    sources = [source_ref(calibration.path, pipeline.folder) for calibration in calibrations]
    with output_folder(output) as folder:
        identification = identify_stage(lines, (), sources, folder)
    echo_identification(identification, quiet)
    return 0 if identification.accepted else 1
