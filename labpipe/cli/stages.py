"""labpipe ingest, frf, identify, calibrate, study: the stages one by one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from labpipe.artefacts.header import source_ref
from labpipe.artefacts.identification_file import NAME
from labpipe.artefacts.writing import output_folder
from labpipe.cli import options
from labpipe.cli.many import manner
from labpipe.cli.output import echo, echo_findings
from labpipe.cli.terminal import echo_failed, echo_result
from labpipe.errors import ConfigError
from labpipe.project.identify import MeasuredTests, identify_stage
from labpipe.project.ingest import SourceFile, ingest_all
from labpipe.project.measured import MeasuredTest, load_measured
from labpipe.project.pipeline_file import Pipeline, load_pipeline
from labpipe.project.report import outdate_reports, write_reports
from labpipe.project.rig_file import load_rig
from labpipe.project.run import measure_tests, run
from labpipe.project.tests import Test
from labpipe.records.finding import WARNING, of_level
from labpipe.records.spectra import ChannelSpectra, FreeDecays


@click.command()
@click.argument("sources", nargs=-1, required=True, metavar="SOURCE...", type=options.PATH)
@click.option("-r", "--rig", "rig_path", required=True, type=options.PATH, help="Rig file (YAML).")
@options.out_folder
@options.usual
def ingest(
    sources: tuple[Path, ...],
    rig_path: Path,
    output: Path,
    overrides: tuple[str, ...],
    quiet: bool,
    verbose: bool,
) -> None:
    """Calibrate raw files to SI units: SOURCE... -> DIR/*.recording.parquet."""
    rig = load_rig(rig_path, overrides)
    options.teller(quiet, verbose)(f"ingest    {len(sources)} file(s)")
    with options.results_folder(output) as folder:
        recordings = ingest_all(sources, rig, folder, Path.cwd())
    for recording in recordings:
        if not quiet:
            n, rate = recording.n_sample, recording.sample_rate
            echo(f"{recording.name}: {n} samples, {rate:g} Hz, {n / rate:g} s")
        echo_findings(recording.findings)


@click.command()
@click.argument("recordings", nargs=-1, metavar="[RECORDING...]", type=options.PATH)
@options.pipeline_file
@options.out_folder
@options.jobs
@options.cluster
@options.usual
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
    rig = pipeline.first_rig
    if rig is None:
        raise ConfigError("rig: is missing", pipeline.path, "add rig: FILE")
    test = Test("", tuple(SourceFile(path, rig) for path in recordings))
    sections = {name: part for name, part in pipeline.sections.items() if name != "calibrate"}
    return replace(pipeline, tests=(test,), sections=sections)


def echo_measured(measured: MeasuredTest, quiet: bool) -> None:
    """One line on a response, on free decays or on spectra, and its findings."""
    if not quiet:
        echo(_line(measured))
    echo_findings(of_level(WARNING, measured.findings) if quiet else measured.findings)


def _line(measured: MeasuredTest) -> str:
    if isinstance(measured, FreeDecays):
        outputs = ", ".join(port.label for port in measured.outputs)
        number, rate = len(measured.decays), measured.sample_rate
        return f"{measured.name or 'decay'}: {number} free decay(s) of {outputs} at {rate:g} Hz"
    frequency = measured.frequency
    lines = f"{frequency.size} lines, {frequency[0]:g}-{frequency[-1]:g} Hz"
    if isinstance(measured, ChannelSpectra):
        names = ", ".join(channel.name for channel in measured.channels)
        runs = f"{len(measured.runs)} run{'s' if len(measured.runs) > 1 else ''}"
        return f"{measured.name or 'spectra'}: spectra of {names}; {runs}, {lines}"
    size = f"{len(measured.outputs)} x {len(measured.inputs)} {measured.form}"
    return f"{measured.name or 'frf'}: {size}, {lines}"


@click.command()
@click.argument("frfs", nargs=-1, metavar="[FRF...]", type=options.PATH)
@options.pipeline_file
@options.out_folder
@options.usual
def identify(
    frfs: tuple[Path, ...],
    pipeline_path: Path,
    output: Path,
    overrides: tuple[str, ...],
    quiet: bool,
    verbose: bool,
) -> int:
    """Identify parameters from frequency responses, or from free decays: DIR/identification.json.

    Without FRF... the responses of `labpipe frf` in DIR are used, or those under frfs: in the pipeline. Of
    very many tests the results are kept as a dataset, as `labpipe run` does.
    """
    pipeline = load_pipeline(pipeline_path, overrides)
    with options.results_folder(output) as folder:
        if frfs:
            options.teller(quiet, verbose)(f"identify  {pipeline.title}")
            tests = [load_measured(path) for path in frfs]
            if len({test.name for test in tests}) < len(tests):
                hint = "list them as `frfs:` of tests with names in the pipeline"
                raise ConfigError("two of the files are of one test, or of none", frfs[0].parent, hint)
            inputs = tuple(source_ref(path, path.parent) for path in frfs)
            sources = (*inputs, *(source_ref(path, pipeline.folder) for path in pipeline.side_files))
            identification = identify_stage(
                pipeline, MeasuredTests(tuple(tests), sources, inputs=inputs), folder
            )
        else:
            how = manner(quiet, verbose, jobs=1, cluster=None)
            identification = run(pipeline, folder, replace(how, measured_before=True))
        outdate_reports(folder, ())
    return echo_result(identification, quiet)


@click.command()
@options.pipeline_file
@options.out_folder
@options.usual
def calibrate(
    pipeline_path: Path, output: Path, overrides: tuple[str, ...], quiet: bool, verbose: bool
) -> int:
    """Fit the straight lines of a file's calibrate: section: DIR/identification.json.

    A rig file can then name a fitted slope as a sensitivity: `sensitivity:
    results/identification.json#probe_y`.
    """
    pipeline = load_pipeline(pipeline_path, overrides)
    calibrations = pipeline.sections.get("calibrate", ())
    if not calibrations:
        raise ConfigError("calibrate: is missing", pipeline_path, "name a table with its x and y columns")
    options.teller(quiet, verbose)(f"calibrate {pipeline.title}")
    names = {calibration.name for calibration in calibrations}
    rules = tuple(rule for rule in pipeline.rules if rule.fit in names)
    lines = replace(pipeline, tests=(), sections={"calibrate": calibrations}, rules=rules)
    sources = tuple(source_ref(calibration.path, pipeline.folder) for calibration in calibrations)
    with output_folder(output) as folder:
        identification = identify_stage(lines, MeasuredTests(sources=sources), folder)
        outdate_reports(folder, ())
    return echo_result(identification, quiet)


STUDY = "study"


@click.command()
@click.argument("pipeline_path", metavar="PIPELINE", type=options.PATH)
@options.out_folder
@click.option("-j", "--jobs", type=options.COUNT, default=0, help="Processes; default: one per processor.")
@options.usual
def study(
    pipeline_path: Path, output: Path, jobs: int, overrides: tuple[str, ...], quiet: bool, verbose: bool
) -> int:
    """Repeat the fits of PIPELINE on its virtual rig: bias, scatter against the Cramer-Rao bound, coverage,
    success.

    Writes identification.json, study.csv and the report. The same seed gives the same results on any number
    of processes.
    """
    # pandas and scipy.io, which the other stages do without.
    from labpipe.project.exports import write_study_csv

    pipeline = load_pipeline(pipeline_path, overrides)
    if STUDY not in pipeline.sections:
        raise ConfigError("study: is missing", pipeline_path, "name a virtual rig and noise levels")
    rules = tuple(rule for rule in pipeline.rules if rule.fit == STUDY)
    # The fits are repeated, not made.
    sections = {"identify": pipeline.fits, STUDY: pipeline.sections[STUDY]}
    alone = replace(pipeline, tests=(), rules=rules, sections=sections)
    with output_folder(output) as folder:
        identification = identify_stage(alone, MeasuredTests(), folder, options.teller(quiet, verbose), jobs)
        write_study_csv(folder.write_path("study.csv"), identification.sections[STUDY][0])
        outdate_reports(folder, pipeline.report.formats)
    write_reports(identification, output, pipeline.report.formats, options.teller(quiet, verbose))
    reports = [f"report.{name}" for name in pipeline.report.formats]
    return echo_result(identification, quiet, str(output), NAME, "study.csv", *reports)
