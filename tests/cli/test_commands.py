"""The commands together: stages alone and in one, freshness, rules and exit codes, overrides, provenance,
exports.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import yaml

from labpipe.artefacts.header import commit
from labpipe.cli.main import COMMANDS

PEDESTAL = "pipelines/pedestal.yaml"


@pytest.fixture(autouse=True)
def in_root(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(root)


@pytest.fixture
def labpipe(labpipe_without_report):
    """Reports are drawn only where a test looks at one."""
    return labpipe_without_report


def contents(folder: Path) -> dict[str, bytes]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


def test_the_stages_one_by_one_give_what_run_gives(tmp_path: Path, labpipe) -> None:
    assert labpipe("frf", "-c", PEDESTAL, "-o", tmp_path / "a").code == 0
    assert labpipe("identify", "-c", PEDESTAL, "-o", tmp_path / "a").code == 0
    assert labpipe("report", tmp_path / "a", "-o", tmp_path / "a/report.html").code == 0
    assert labpipe("report", tmp_path / "a/identification.json", "-o", tmp_path / "a/report.md").code == 0
    assert labpipe("run", PEDESTAL, "-o", tmp_path / "b", "--set", "report.formats=[html, md]").code == 0
    staged, whole = contents(tmp_path / "a"), contents(tmp_path / "b")
    assert staged.keys() == whole.keys()
    assert staged["frf.frf.parquet"] == whole["frf.frf.parquet"]
    fits = [json.loads(side["identification.json"])["fits"] for side in (staged, whole)]
    assert fits[0] == fits[1]
    # Done, but a rule fails.
    ended = labpipe("identify", "-c", PEDESTAL, "-o", tmp_path / "a", "--set", "accept.pedestal.gof=>= 1.5")
    assert ended.code == 1 and "accept: pedestal.gof >= 1.5: FAILED" in ended.out


def test_same_input_same_bytes_and_what_is_fresh_is_left_alone(tmp_path: Path, labpipe) -> None:
    for name in ("a", "b"):
        assert labpipe("run", PEDESTAL, "-o", tmp_path / name, "--set", "report.formats=[html]").code == 0
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    stamps = {p: p.stat().st_mtime_ns for p in (tmp_path / "a").rglob("*.parquet")}
    stamps[tmp_path / "a/identification.json"] = (tmp_path / "a/identification.json").stat().st_mtime_ns
    labpipe("run", PEDESTAL, "-o", tmp_path / "a")
    assert {p: p.stat().st_mtime_ns for p in stamps} == stamps
    labpipe("run", PEDESTAL, "-o", tmp_path / "a", "--set", "identify.pedestal.band=55-75 Hz")
    changed = {p.name for p in stamps if p.stat().st_mtime_ns != stamps[p]}
    assert changed == {"identification.json"}


def test_set_overrides_and_a_failing_rule_is_exit_code_1(tmp_path: Path, labpipe) -> None:
    ended = labpipe("run", PEDESTAL, "-o", tmp_path / "o", "--set", "accept.pedestal.gof=>= 0.9999999")
    assert ended.code == 1 and "accept: pedestal.gof >= 0.9999999: FAILED" in ended.out
    ended = labpipe("run", PEDESTAL, "-o", tmp_path / "o", "--set", "identify.pedestal.mass=0.9 kg")
    assert ended.code == 1 and "expect: pedestal.k 134.5 kN/m +- 0.1 %: FAILED" in ended.out
    assert labpipe("check", PEDESTAL).code == 0
    ended = labpipe("check", PEDESTAL, "--set", "identify.pedestal.mass=0.9 kg")
    assert ended.code == 1 and "expect: pedestal.k" in ended.out


def test_a_check_keeps_its_results_where_asked(tmp_path: Path, labpipe) -> None:
    shutil.copy("pipelines/pedestal.yaml", tmp_path / "pedestal.yaml")
    ended = labpipe("check", PEDESTAL, tmp_path / "pedestal.yaml", "-o", tmp_path / "results")
    assert ended.code == 2 and "two pipelines of this name" in ended.err
    assert not (tmp_path / "results").exists()
    assert labpipe("check", PEDESTAL, "-o", tmp_path / "results").code == 0
    result = tmp_path / "results/pedestal/identification.json"
    before = result.stat().st_mtime_ns
    # A run into the same folder finds it up to date.
    assert labpipe("run", PEDESTAL, "-o", result.parent, "--set", "report.formats=[]").code == 0
    assert result.stat().st_mtime_ns == before


def test_identification_json_has_the_agreed_shape(tmp_path: Path, labpipe) -> None:
    labpipe("run", "pipelines/radial-direct.yaml", "-o", tmp_path)
    result = json.loads((tmp_path / "identification.json").read_text())
    assert result["schema"] == "labpipe/identification/2"
    assert set(result["sources"][0]) == {"path", "sha256"} and len(result["sources"][0]["sha256"]) == 64
    (fit,) = result["fits"]
    agreed = (
        "name test model estimator band_hz centre_hz lines equations dof gof condition_number converged "
        "iterations parameters correlation"
    )
    assert set(agreed.split()) <= set(fit)
    assert {"r2", "r2_adjusted", "chi2_reduced", "chi2_p"} == set(fit["gof"])
    assert {"name", "value", "unit", "std_error", "t_ratio", "ci95", "significant", "vif"} <= set(
        fit["parameters"][0]
    )
    assert [p["name"] for p in fit["parameters"]][:4] == ["k_xx", "c_xx", "k_yy", "c_yy"]
    assert (fit["band_hz"], fit["centre_hz"], fit["lines"], fit["equations"]) == ([65.0, 80.0], 72.5, 16, 64)
    assert {"code", "message"} == set(fit["warnings"][0])
    assert result["accept"] == [
        {"rule": "direct.gof >= 0.95", "value": pytest.approx(fit["gof"]["r2_adjusted"]), "passed": True}
    ]


def test_ingest_calibrates_to_si_with_the_source_s_checksum(tmp_path: Path, labpipe) -> None:
    ended = labpipe(
        "ingest", "sample_data/hmb/radial-0rpm.parquet", "-r", "configs/hmb-radial.yaml", "-o", tmp_path
    )
    assert ended.code == 0 and "12000 samples, 2000 Hz, 6 s" in ended.out
    stored = pq.read_table(tmp_path / "radial-0rpm.recording.parquet")
    raw = pq.read_table("sample_data/hmb/radial-0rpm.parquet")
    # 8 V/mm: 1 V is 0.125 mm.
    np.testing.assert_allclose(stored["y"], np.array(raw["y [V]"], np.float64) * 0.125e-3, rtol=1e-12)
    np.testing.assert_allclose(stored["x"], np.array(raw["x [um]"], np.float64) * 1e-6, rtol=1e-12)
    header = json.loads(
        pq.ParquetFile(tmp_path / "radial-0rpm.recording.parquet").metadata.metadata[b"labpipe"]
    )
    assert (
        header["inputs"][0]["sha256"]
        == hashlib.sha256(Path("sample_data/hmb/radial-0rpm.parquet").read_bytes()).hexdigest()
    )
    ended = labpipe(
        "frf",
        "-c",
        "pipelines/radial-direct.yaml",
        "-o",
        tmp_path,
        tmp_path / "radial-0rpm.recording.parquet",
    )
    assert ended.code == 0 and "2 x 1 receptance, 250 lines, 1-250 Hz" in ended.out


def test_a_parquet_file_saved_again_by_another_program_is_refused(tmp_path: Path, labpipe) -> None:
    labpipe("frf", "-c", PEDESTAL, "-o", tmp_path)
    table = pq.read_table(tmp_path / "frf.frf.parquet")
    pq.write_table(table.replace_schema_metadata({}), tmp_path / "other.frf.parquet")
    ended = labpipe("identify", "-c", PEDESTAL, "-o", tmp_path, tmp_path / "other.frf.parquet")
    assert ended.code == 2 and "has no labpipe header" in ended.err and "saved it again" in ended.err


def test_frf_as_csv_goes_out_and_comes_in_again(tmp_path: Path, labpipe) -> None:
    labpipe("run", "pipelines/radial-two-directions.yaml", "-o", tmp_path)
    assert (
        labpipe("export", tmp_path / "frf.frf.parquet", "--to", "csv", "-o", tmp_path / "frf.csv").code == 0
    )
    lines = (tmp_path / "frf.csv").read_text().splitlines()
    assert lines[0] == "# form: receptance" and lines[1].startswith("frequency_hz,x/x:re,x/x:im,x/x:var")
    (tmp_path / "p.yaml").write_text(
        "title: From FRFs\nfrfs: frf.csv\nidentify:\n  eight: {model: rotor-2dof, mass: 0.92 kg, output: "
        "[x, y], band: 40-120 Hz}\n"
        "expect:\n  eight.k_xy: 25 kN/m +- 0.5 kN/m\n  eight.k_yx: -18 kN/m +- 0.5 kN/m\n"
    )
    ended = labpipe("run", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert ended.code == 0, ended


@pytest.mark.parametrize(
    ("artefact", "head"),
    [
        ("identification.json", "fit,test,term,centre_hz"),
        ("recordings/pedestal.recording.parquet", "t [s],f [N],y [m]"),
    ],
)
def test_exports_for_other_programs(tmp_path: Path, labpipe, artefact: str, head: str) -> None:
    labpipe("run", PEDESTAL, "-o", tmp_path)
    assert labpipe("export", tmp_path / artefact, "--to", "csv", "-o", tmp_path / "x.csv").code == 0
    assert (tmp_path / "x.csv").read_text().startswith(head)
    assert labpipe("export", tmp_path / artefact, "--to", "parquet", "-o", tmp_path / "x.parquet").code == 0
    assert pq.read_table(tmp_path / "x.parquet").num_rows > 0


def test_init_makes_a_project_that_runs_as_it_is(tmp_path: Path, labpipe) -> None:
    assert labpipe("init", tmp_path / "p").code == 0
    assert labpipe("run", tmp_path / "p/pipeline.yaml", "-o", tmp_path / "p/out").code == 0
    assert labpipe("init", tmp_path / "p").code == 2


def test_inspect_shows_levels_of_raw_and_calibrated_files(tmp_path: Path, labpipe) -> None:
    ended = labpipe("inspect", "sample_data/hmb/pedestal.csv")
    assert (
        ended.code == 0
        and "16000 rows, 3 columns, 1000 Hz by 't [s]'" in ended.out
        and "no gaps, no clipping" in ended.out
    )
    labpipe("ingest", "sample_data/hmb/axial.csv", "-r", "configs/hmb-axial.yaml", "-o", tmp_path)
    assert "f [N] input z" in labpipe("inspect", tmp_path / "axial.recording.parquet").out


@pytest.mark.parametrize("suffix", ["csv", "parquet", "wav"])
def test_excite_writes_a_signal_and_prints_its_crest_factor(tmp_path: Path, labpipe, suffix: str) -> None:
    path = tmp_path / f"s.{suffix}"
    schroeder = labpipe("excite", "-o", path, "--rate", "1 kHz")
    optimised = labpipe("excite", "-o", path, "--rate", "1 kHz", "--phases", "optimised")
    crest = [float(ended.out.rsplit(" ", 1)[1]) for ended in (schroeder, optimised)]
    assert crest[0] == pytest.approx(1.766, abs=0.001) and crest[1] < crest[0] and path.stat().st_size > 0


def test_calibrate_gives_slopes_that_a_rig_file_can_name(tmp_path: Path, labpipe) -> None:
    rows = "".join(f"{d},{8.2e-3 * d + 0.1:.6g}\n" for d in range(0, 200, 10))
    (tmp_path / "probe.csv").write_text("displacement [um],output [V]\n" + rows)
    (tmp_path / "c.yaml").write_text(
        'title: Probe\ncalibrate:\n  probe_y: {table: probe.csv, x: "displacement [um]", y: "output [V]"}\n'
    )
    assert labpipe("calibrate", "-c", tmp_path / "c.yaml", "-o", tmp_path / "cal").code == 0
    from labpipe.project.rig_file import load_rig

    (tmp_path / "rig.yaml").write_text(
        "name: R\nsample_rate: 1 kHz\nchannels:\n"
        "  y: {quantity: displacement, unit: V, sensitivity: 'cal/identification.json#probe_y'}\n  f: "
        "{quantity: force}\n"
    )
    assert load_rig(tmp_path / "rig.yaml").channels[0].scale == pytest.approx(1 / 8200.0, rel=1e-6)


def test_simulate_is_deterministic_and_the_shipped_data_are_what_it_makes(
    tmp_path: Path, labpipe, root: Path
) -> None:
    assert labpipe("simulate", "configs/virtual-hmb.yaml", "-o", tmp_path, "--seed", "1").code == 0
    made = json.loads((tmp_path / "truth.json").read_text())
    assert made == json.loads((root / "sample_data/hmb/truth.json").read_text())
    for path in sorted(tmp_path.glob("*.csv")):
        ours, shipped = (
            np.loadtxt(p, delimiter=",", skiprows=1) for p in (path, root / "sample_data/hmb" / path.name)
        )
        np.testing.assert_allclose(ours, shipped, rtol=1e-5, atol=1e-6 * np.max(np.abs(shipped)))
    for path in sorted(tmp_path.glob("*.parquet")):
        ours, shipped = (
            pq.read_table(p).to_pandas().to_numpy() for p in (path, root / "sample_data/hmb" / path.name)
        )
        np.testing.assert_allclose(ours, shipped, rtol=1e-5, atol=1e-6 * np.max(np.abs(shipped)))


@pytest.mark.parametrize("pipeline", ["pedestal.yaml", "levitated.yaml", "radial-direct.yaml"])
def test_a_shipped_pipeline_meets_its_expectations(labpipe, pipeline: str) -> None:
    """`.ci/run` checks every one."""
    ended = labpipe("check", f"pipelines/{pipeline}")
    assert ended.code == 0, ended
    assert "0 of 0" not in ended.out


def test_sample_data_are_small(root: Path) -> None:
    assert sum(p.stat().st_size for p in (root / "sample_data").rglob("*") if p.is_file()) < 20e6


@pytest.mark.parametrize("command", list(COMMANDS))
def test_every_command_explains_itself(labpipe, command: str) -> None:
    ended = labpipe(command, "--help")
    assert ended.code == 0 and ended.out.startswith(f"Usage: labpipe {command}")
    # The mark before examples, which keep their lines; within a line it would be printed.
    assert "\b" not in ended.out


def test_help_is_quick_because_heavy_imports_wait(root: Path) -> None:
    heavy = "{'numpy', 'scipy', 'pandas', 'pyarrow', 'matplotlib', 'yaml'}"
    code = (
        "import sys; from labpipe.cli.main import run_command; run_command(['--help']); "
        f"print(sorted({heavy} & set(sys.modules)))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.strip().endswith("[]")


def test_version_and_python_dash_m(root: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "labpipe", "--version"], capture_output=True, text=True, check=True
    )
    known = commit()
    assert ended.stdout == "labpipe, version 0.1.0" + (f" (commit {known})" if known else "") + "\n"


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    """Peak memory [MiB] of `labpipe frf` on 8 million samples against that for half a million: the longer
    recording itself holds 16 bytes a sample more.
    """
    (tmp_path / "rig.yaml").write_text(
        "name: R\nsample_rate: 10 kHz\nchannels:\n  f: {quantity: force}\n  x: {quantity: displacement}\n"
    )
    (tmp_path / "p.yaml").write_text(
        "title: T\nrig: rig.yaml\nrecordings: run.parquet\nfrf: {excitation: random, block: 0.1 s}\n"
    )
    import pyarrow as pa

    peaks = []
    for n in (500_000, 8_000_000):
        noise = np.random.default_rng(1).normal(size=n).astype(np.float32)
        pq.write_table(
            pa.table({"f": noise, "x": np.roll(noise, 3)}), tmp_path / "run.parquet", row_group_size=1 << 18
        )
        code = (
            "from pathlib import Path; from labpipe.cli.main import run_command; "
            f"assert run_command(['frf', '-c', r'{tmp_path}/p.yaml', '-o', r'{tmp_path}/{n}']) == 0; "
            "print(Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])"
        )
        ended = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ}, check=True
        )
        peaks.append(int(ended.stdout.split()[-1]) / 1024)
    assert peaks[1] - peaks[0] < 40, f"{peaks} MiB; the longer recording holds 114 MiB of float64"


def test_progress_is_told_on_request_only(tmp_path: Path, labpipe) -> None:
    assert labpipe("run", PEDESTAL, "-o", tmp_path / "a").err == ""
    assert "identify  Stiffness and damping" in labpipe("run", PEDESTAL, "-o", tmp_path / "b", "-v").err
    ended = labpipe("run", PEDESTAL, "-o", tmp_path / "c", "-q")
    assert (ended.out, ended.err) == ("", "")


def test_no_clock_in_any_artefact(tmp_path: Path, labpipe) -> None:
    labpipe("run", PEDESTAL, "-o", tmp_path, "--set", "report.formats=[html]")
    year = time.strftime("%Y-%m")
    assert (
        year not in (tmp_path / "identification.json").read_text()
        and year not in (tmp_path / "report.html").read_text()
    )


@pytest.mark.parametrize(
    "arguments",
    [
        ["ingest", "sample_data/hmb/axial.csv", "-r", "configs/hmb-axial.yaml", "-o", "OUT"],
        ["frf", "-c", PEDESTAL, "-o", "OUT"],
        ["calibrate", "-c", "pipelines/actuator-gain.yaml", "-o", "OUT"],
        ["simulate", "configs/virtual-hmb.yaml", "--run", "static", "-o", "OUT"],
        ["run", PEDESTAL, "-o", "OUT"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_quiet_and_verbose(tmp_path: Path, labpipe, arguments: list[str]) -> None:
    quiet = labpipe(*(a.replace("OUT", str(tmp_path / "q")) for a in arguments), "-q")
    loud = labpipe(*(a.replace("OUT", str(tmp_path / "v")) for a in arguments), "-v")
    # The points of the calibration bend, which is said in every case.
    bend = "  warning model-mismatch: the points bend" if arguments[0] == "calibrate" else ""
    assert (quiet.code, quiet.out[: len(bend)], quiet.err) == (0, bend, "") and quiet.out.count("\n") == bool(
        bend
    )
    assert loud.code == 0 and loud.err.split()[0] in ("ingest", "calibrate", "simulate")


def test_a_report_of_an_earlier_result_goes_when_identify_gives_another(tmp_path: Path, labpipe) -> None:
    pipeline = ("-c", PEDESTAL, "-o", tmp_path)
    assert labpipe("run", PEDESTAL, "-o", tmp_path, "--set", "report.formats=[md]").code == 0
    assert labpipe("identify", *pipeline, "--set", "identify.pedestal.band=60-71 Hz").code == 0
    assert not (tmp_path / "report.md").exists()
    # Both would be fits of one name and no test, as bands of a sliding fit are.
    frf = tmp_path / "frf.frf.parquet"
    ended = labpipe("identify", "-c", PEDESTAL, "-o", tmp_path / "two", frf, frf)
    assert ended.code == 2 and "two of the files are of one test" in ended.err
    # A misspelt parameter is not a parameter without a difference.
    ended = labpipe("compare", tmp_path, tmp_path, "-p", "kk")
    assert ended.code == 2 and "--parameter: 'kk' is not in both results; did you mean 'k'?" in ended.err


def test_two_results_that_differ_end_a_comparison_with_one_if_asked(tmp_path: Path, labpipe) -> None:
    """Against itself, with a mass 1 % larger (k in proportion), and with a fit of another name."""
    one, other = tmp_path / "one", tmp_path / "other"
    for out, extra in ((one, ()), (other, ("--set", "identify.pedestal.mass=0.7979 kg"))):
        labpipe("run", PEDESTAL, "-o", out, "--set", "report.formats=[md]", *extra)
    assert labpipe("compare", one, one, "--exit-code").code == 0
    assert labpipe("compare", one, other).code == 0
    ended = labpipe("compare", one, other, "--exit-code")
    assert ended.code == 1 and "differs" in ended.out and not ended.err
    assert labpipe("compare", one, other, "-p", "f_n", "--exit-code").code == 0
    assert labpipe("compare", one, other, "-p", "k", "--exit-code").code == 1
    result = json.loads((one / "identification.json").read_text("utf-8"))
    del result["digest"], result["fits"][0]["parameters"][0]
    (tmp_path / "less.json").write_text(json.dumps(result), "utf-8")
    assert labpipe("compare", one, tmp_path / "less.json", "--exit-code").code == 1
    assert labpipe("compare", one, tmp_path / "less.json", "-p", "c", "--exit-code").code == 0


def test_options_of_another_kind_of_signal_are_refused(tmp_path: Path, labpipe) -> None:
    signal = ("excite", "-o", tmp_path / "s.csv")
    ended = labpipe(*signal, "--sweep", "linear", "--leave-out", "4")
    assert ended.code == 2 and "--leave-out: is of a multisine" in ended.err
    ended = labpipe(*signal, "--length", "60 s")
    assert ended.code == 2 and "--length: is of a swept sine" in ended.err
    assert not (tmp_path / "s.csv").exists()


@pytest.mark.parametrize(
    ("command", "option", "value", "of"),
    [
        ("verify .", "--crl", "lab.crl", "certificates that somebody vouches for"),
        ("verify .", "--set", "rig=other.yaml", "a second run"),
        ("verify report.signed.pdf", "-c", "pipeline.yaml", "a folder or an archive"),
        ("sign report.pdf --key me.p12", "--token", "card", "a token"),
        ("orders run.csv -o out --speed 3000rpm", "--pulses", "4", "a tacho"),
    ],
)
def test_an_option_of_something_that_is_not_there_is_refused(
    labpipe, command: str, option: str, value: str, of: str
) -> None:
    ended = labpipe(*command.split(), option, value)
    assert ended.code == 2 and f"{option}: is of {of}" in ended.err


def test_signatures_of_results_elsewhere_are_not_passed_over(labpipe) -> None:
    ended = labpipe("verify", "s3://bench/out", "--signed", "approved")
    assert ended.code == 2 and "signatures are verified here only" in ended.err


def test_a_bearing_on_standard_output_has_its_folder_as_well(tmp_path: Path, labpipe) -> None:
    ended = labpipe("bearing", "configs/bearings/skf-6203.yaml", "--json", "-", "-o", tmp_path)
    assert ended.code == 0 and json.loads(ended.out)["kind"] == "ball-bearing" and any(tmp_path.iterdir())


def test_identify_refuses_responses_that_were_made_with_other_settings(tmp_path: Path, labpipe) -> None:
    """The result would state settings that its numbers do not have."""
    stage = ("-c", PEDESTAL, "-o", tmp_path)
    assert labpipe("frf", *stage).code == 0
    ended = labpipe("identify", *stage, "--set", "frf.exclude=[64-66 Hz]")
    assert ended.code == 2 and "was made with another `frf:` than there is now (exclude)" in ended.err
    ended = labpipe("identify", *stage, "--set", "conditions={preload: 1 N}")
    assert ended.code == 2 and "another `conditions:` than there is now (preload)" in ended.err
    assert not (tmp_path / "identification.json").exists()
    assert labpipe("identify", *stage).code == 0


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_identify_refuses_responses_of_another_rig_or_recording(tmp_path: Path, labpipe, suffix: str) -> None:
    """Calibrated before they are measured (CSV), or measured as they are read (Parquet). The mass changes no
    response.
    """
    rig, recording = tmp_path / "rig.yaml", tmp_path / f"run.{suffix}"
    text = Path("configs/hmb-pedestal.yaml").read_text("utf-8")
    rig.write_text(text, "utf-8")
    table = pd.read_csv("sample_data/hmb/pedestal.csv")[:40000]
    write = partial(pd.DataFrame.to_csv if suffix == "csv" else pd.DataFrame.to_parquet, index=False)
    write(table, recording)
    pipeline = yaml.safe_load(Path(PEDESTAL).read_text("utf-8"))
    fits = {"pedestal": pipeline["identify"]["pedestal"]}
    changed = {"rig": "rig.yaml", "recordings": recording.name, "identify": fits, "expect": {}, "accept": {}}
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(pipeline | changed), "utf-8")
    stage = ("-c", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert labpipe("frf", *stage).code == 0
    rig.write_text(text.replace("0.79 kg", "0.8 kg"), "utf-8")
    assert labpipe("identify", *stage).code == 0
    rig.write_text(text.replace("8 V/mm", "4 V/mm"), "utf-8")
    ended = labpipe("identify", *stage)
    assert ended.code == 2 and "another `rig:` than there is now (channels)" in ended.err
    rig.write_text(text, "utf-8")
    # The same samples written anew are the same recording.
    content = recording.read_bytes()
    recording.write_bytes(content)
    assert labpipe("identify", *stage).code == 0
    write(table[:-1], recording)
    ended = labpipe("identify", *stage)
    assert ended.code == 2 and f"was made before '{recording.name}' was changed" in ended.err


def test_a_calibrated_copy_that_is_gone_leaves_the_rig_of_the_next_to_that(tmp_path: Path, labpipe) -> None:
    """Of two recordings by two rigs: the other one is compared with its own, and still refused by another."""
    text = Path("configs/hmb-pedestal.yaml").read_text("utf-8")
    table = pd.read_csv("sample_data/hmb/pedestal.csv")
    recordings = []
    for name, volts, rows in (("a", 8, slice(0, 12000)), ("b", 4, slice(4000, 16000))):
        (tmp_path / f"{name}.yaml").write_text(text.replace("8 V/mm", f"{volts} V/mm"), "utf-8")
        part = table[rows].assign(**{"y [V]": table["y [V]"][rows] * volts / 8})
        part.to_csv(tmp_path / f"{name}.csv", index=False)
        recordings.append({"file": f"{name}.csv", "rig": f"{name}.yaml"})
    pipeline = yaml.safe_load(Path(PEDESTAL).read_text("utf-8"))
    fits = {"pedestal": pipeline["identify"]["pedestal"]}
    changed = {"recordings": recordings, "identify": fits, "expect": {}, "accept": {}}
    (tmp_path / "p.yaml").write_text(yaml.safe_dump({**pipeline, **changed, "rig": "a.yaml"}), "utf-8")
    stage = ("-c", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert labpipe("frf", *stage).code == 0
    (tmp_path / "out/recordings/a.recording.parquet").unlink()
    assert labpipe("identify", *stage).code == 0
    (tmp_path / "b.yaml").write_text(text, "utf-8")
    ended = labpipe("identify", *stage)
    assert ended.code == 2 and "another `rig:` than there is now (channels)" in ended.err


def test_a_calibrated_recording_keeps_to_its_rig(tmp_path: Path, labpipe) -> None:
    """The sensitivity that the rig file states now would do nothing."""
    rig = tmp_path / "rig.yaml"
    text = Path("configs/hmb-pedestal.yaml").read_text("utf-8")
    rig.write_text(text, "utf-8")
    assert labpipe("ingest", "sample_data/hmb/pedestal.csv", "-r", rig, "-o", tmp_path).code == 0
    rig.write_text(text.replace("8 V/mm", "4 V/mm"), "utf-8")
    calibrated = tmp_path / "pedestal.recording.parquet"
    sets = [f"--set=rig={rig}", f"--set=recordings={calibrated}"]
    ended = labpipe("frf", "-c", PEDESTAL, "-o", tmp_path / "out", *sets)
    assert ended.code == 2 and "another `rig:` than there is now (channels)" in ended.err
    rig.write_text(text, "utf-8")
    assert labpipe("frf", "-c", PEDESTAL, "-o", tmp_path / "out", *sets).code == 0
