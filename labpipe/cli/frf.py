"""labpipe frf -c PIPELINE -o DIR [RECORDING...]"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from labpipe.cli import options
from labpipe.cli.many import echo_failed, manner
from labpipe.cli.output import echo
from labpipe.config.pipeline import Pipeline, load_pipeline
from labpipe.config.recordings import SourceFile
from labpipe.config.tests import Test
from labpipe.errors import ConfigError
from labpipe.pipeline.run import measure_tests
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.finding import WARNING, of_level
from labpipe.records.free_decay import FreeDecays
from labpipe.records.response import FrequencyResponse
from labpipe.stages.measured import MeasuredTest


@click.command()
@click.argument("recordings", nargs=-1, metavar="[RECORDING...]", type=options.PATH)
@options.pipeline_file
@options.out_folder
@options.jobs
@options.cluster
@options.overrides
@options.quiet
@options.verbose
def frf(
    recordings: tuple[Path, ...],
    pipeline_path: Path,
    output: Path,
    jobs: int,
    cluster: str | None,
    overrides: tuple[str, ...],
    quiet: bool,
    verbose: bool,
) -> int:
    """Turn recordings into frequency responses: DIR/<test>.frf.parquet; or cut out
    free decays (excitation: decay): DIR/<test>.decay.parquet; or take all channels
    side by side (result: spectra): DIR/<test>.spectra.parquet.

    RECORDING... (raw or calibrated) replace those of the pipeline and together give one FRF matrix.
    """
    pipeline = load_pipeline(pipeline_path, overrides)
    if recordings:
        pipeline = with_recordings(pipeline, recordings)
    with options.results_folder(output) as folder:
        measured = measure_tests(pipeline, folder, manner(quiet, verbose, jobs, cluster))
    for test in measured.tests:
        echo_measured(test, quiet)
    echo_failed(measured.failed)
    return 2 if measured.failed else 0


def with_recordings(pipeline: Pipeline, recordings: tuple[Path, ...]) -> Pipeline:
    """The pipeline with a single test of these recordings."""
    rig = pipeline.rig or next((source.rig for test in pipeline.tests for source in test.recordings), None)
    if rig is None:
        raise ConfigError("rig: is missing", where=str(pipeline.path), hint="add rig: FILE")
    test = Test("", tuple(SourceFile(path, rig) for path in recordings))
    return replace(pipeline, tests=(test,), sections={name: part for name, part in pipeline.sections.items() if name != "calibrate"})


def echo_measured(measured: MeasuredTest, quiet: bool) -> None:
    """One line on a response, on free decays or on spectra, and its findings."""
    if not quiet:
        echo(_line(measured))
    for finding in of_level(WARNING, measured.findings) if quiet else measured.findings:
        echo(f"  {finding.level} {finding.code}: {finding.message}")


def _line(measured: MeasuredTest) -> str:
    if isinstance(measured, FreeDecays):
        return _decays_line(measured)
    return _spectra_line(measured) if isinstance(measured, ChannelSpectra) else _response_line(measured)


def _spectra_line(spectra: ChannelSpectra) -> str:
    names = ", ".join(channel.name for channel in spectra.channels)
    band = f"{spectra.frequency[0]:g}-{spectra.frequency[-1]:g} Hz"
    runs = f"{len(spectra.runs)} run{'s' if len(spectra.runs) > 1 else ''}"
    return f"{spectra.name or 'spectra'}: spectra of {names}; {runs}, {spectra.frequency.size} lines, {band}"


def _response_line(response: FrequencyResponse) -> str:
    size = f"{len(response.outputs)} x {len(response.inputs)} {response.form}"
    band = f"{response.frequency[0]:g}-{response.frequency[-1]:g} Hz"
    return f"{response.name or 'frf'}: {size}, {response.n_frequency} lines, {band}"


def _decays_line(decays: FreeDecays) -> str:
    outputs = ", ".join(port.label for port in decays.outputs)
    return f"{decays.name or 'decay'}: {len(decays.decays)} free decay(s) of {outputs} at {decays.sample_rate:g} Hz"
