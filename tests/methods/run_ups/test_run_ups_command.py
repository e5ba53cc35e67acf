"""A pipeline with run_ups: by the command line: run, fresh results, report, rules, faults.

And a run-up table from a recording.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from labpipe.artefacts.identification_file import read_identification, write_identification
from labpipe.methods.run_ups.run_up_csv import read_run_up_csv

ROOT = Path(__file__).parents[3]
TEXT = """title: Two loads
run_ups:
  rotor: {root}/configs/rotors/falah.yaml
  methods: [points, joint]
  runs:
    - {{file: load-1.csv}}
    - {{file: {root}/sample_data/falah/load-4.csv}}
    - {{file: {root}/sample_data/falah/held-out.csv, role: held-out}}
report: {{formats: [md]}}
expect:
  run_ups.joint[held-out].critical_speed: 1740.03 rpm +- .3 %
  run_ups.points.verdict: not determined
"""


@pytest.fixture
def pipeline(tmp_path: Path) -> Path:
    (tmp_path / "load-1.csv").write_bytes((ROOT / "sample_data/falah/load-1.csv").read_bytes())
    path = tmp_path / "p.yaml"
    path.write_text(TEXT.format(root=ROOT), encoding="utf-8")
    return path


def test_run_leaves_result_and_report_and_is_fresh(labpipe, pipeline: Path, tmp_path: Path) -> None:
    ended = labpipe("run", pipeline, "-o", tmp_path / "out", "--set", "report.formats=[md]")
    assert ended.code == 0, ended
    assert "run_ups.joint[held-out].critical_speed 1740.03 rpm +- .3 %: passed" in ended.out
    assert (
        "(b) complex, point by point: not determined, rank 4 of 8" in ended.out
        and "warning collinear" in ended.out
    )
    path = tmp_path / "out/identification.json"
    found = read_identification(path)
    assert "run_ups" in found.sections and [Path(one["path"]).name for one in found.sources] == [
        "falah.yaml",
        "load-1.csv",
        "load-4.csv",
        "held-out.csv",
    ]
    write_identification(tmp_path / "again.json", found)
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()
    report = (tmp_path / "out/report.md").read_text("utf-8")
    assert "Run-ups: Two-disc rotor after Falah and Khorshid" in report and "Orbits of 1x below" in report
    assert "Read the warnings before using: run-ups (collinear)." in report.replace("\\", "")
    listed = labpipe("list", tmp_path)
    assert "collinear, extrapolated" in listed.out, listed
    # Nothing changed: nothing is computed. A run-up that did is computed again.
    again = labpipe("run", pipeline, "-o", tmp_path / "out", "-v")
    assert again.code == 0 and "run-ups   joint" not in again.out + again.err
    table = tmp_path / "load-1.csv"
    table.write_text(
        table.read_text("utf-8").replace("# load: 3.66088639 N", "# load: 3.7 N"), encoding="utf-8"
    )
    changed = labpipe("run", pipeline, "-o", tmp_path / "out", "-v")
    assert "run-ups   joint" in changed.out + changed.err


@pytest.mark.parametrize(
    ("override", "code", "said"),
    [
        ("expect={run_ups.points.rank: '>= 8'}", 1, "run_ups.points.rank >= 8"),
        ("expect={'run_ups.joint[held-in].critical_speed': '>= 1 rpm'}", 2, "there is no run 'held-in'"),
        ("run_ups.rotor=none.yaml", 2, "no such file 'none.yaml'"),
        ("run_ups.bound=0 %", 2, "'bound' lies between"),
        ("run_ups.plane=disc 9", 2, "no plane 'disc 9'"),
        ("run_ups.known=clearance", 2, "known: 'known' is of joint, which is not among the methods"),
        ("run_ups.search=cobyqa", 2, "search: 'search' is of amplitudes, which is not among the methods"),
    ],
)
def test_rules_and_faults(
    labpipe, pipeline: Path, tmp_path: Path, override: str, code: int, said: str
) -> None:
    ended = labpipe(
        "run", pipeline, "-o", tmp_path / "out", "--set", override, "--set", "run_ups.methods=points"
    )
    assert ended.code == code and said in ended.out + ended.err and "Traceback" not in ended.err, ended
    assert (tmp_path / "out").exists() is (code == 1)


def test_schema_knows_the_section(labpipe) -> None:
    section = json.loads(labpipe("schema", "pipeline").out)["properties"]["run_ups"]
    assert {"rotor", "runs"} <= set(section["required"]) and "metamodels" in section["properties"]
    run = section["properties"]["runs"]["items"]["properties"]
    assert (
        run["role"] == {"enum": ["trained", "held-out"], "description": "fits see trained runs only"}
        and "unbalance" in run
    )


@pytest.fixture
def labpipe(labpipe_without_report):
    """Reports are drawn only where a test looks at one."""
    return labpipe_without_report


@pytest.fixture
def command(tmp_path: Path) -> list[object]:
    files = [ROOT / "sample_data/hmb-loop/run-up.parquet", "-r", ROOT / "configs/hmb-run-up.yaml"]
    return [
        "orders",
        *files,
        "--tacho",
        "n",
        "-o",
        tmp_path / "out",
        "--save-run-up",
        tmp_path / "run-up.csv",
    ]


@pytest.mark.usefixtures("undrawn")
def test_a_recording_becomes_a_run_up_table(command: list[object], tmp_path: Path, labpipe) -> None:
    ended = labpipe(
        *command, "--load", "3 N", "--unbalance", "front=1 g.mm at 30 deg", "--unbalance", "rear=2 g.mm"
    )
    assert ended.code == 0 and "run-up.csv, 38 speeds" in ended.out, ended
    run = read_run_up_csv(tmp_path / "run-up.csv")
    assert run.planes == ("front", "rear") and run.load == 3 and run.n_speed == 38
    assert abs(run.unbalance["front"]) == pytest.approx(1e-6) and run.unbalance["rear"] == pytest.approx(2e-6)
    # Amplitudes as `orders` itself writes them.
    largest = float(abs(run.response[:, 0, 0]).max())
    assert f"front.x  largest {1e6 * largest:.4g} um" in ended.out


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "--save-run-up needs --load and --unbalance"),
        (("--load", "3 N"), "--save-run-up needs --load and --unbalance"),
        (("--load", "3 m", "--unbalance", "front=1 g.mm"), "--load: 'm' has the wrong dimension"),
        (("--load", "3 N", "--unbalance", "front=1 g"), "--unbalance front=1 g: 'g' has the wrong dimension"),
        (
            ("--load", "3 N", "--unbalance", "middle=1 g.mm"),
            "excited at 'middle', which is not among its planes",
        ),
        (("--load", "3 N", "--unbalance", "front=1 g.mm", "--order", "2"), "a run-up is of order 1, not 2"),
        (
            ("--load", "3 N", "--unbalance", "rear=1 g.mm", "--unbalance", "rear = 2 g.mm"),
            "--unbalance: 'rear' is named twice",
        ),
    ],
)
def test_what_a_recording_does_not_say_is_asked_for(
    command: list[object], tmp_path: Path, arguments: tuple[str, ...], message: str, labpipe
) -> None:
    ended = labpipe(*command, *arguments)
    assert ended.code == 2 and message in ended.err, ended
    assert not (tmp_path / "run-up.csv").exists() and not (tmp_path / "out").exists()
