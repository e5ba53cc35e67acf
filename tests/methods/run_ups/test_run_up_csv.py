"""Run-ups as CSV: round trip, units, and what is refused and how."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.methods.run_ups.records import RunUp, Shaker
from labpipe.methods.run_ups.run_up_csv import read_run_up_csv, write_run_up_csv
from labpipe.records.uncertain import Uncertain

TABLE = """# load: 3.66 N
# unbalance disc 1: 50 g.mm at 90 deg
# threshold: 2772 rpm +- 6 rpm
# amplitude error: 1 %
# phase error: 1 deg
# recorded by: the lab
speed [rpm],disc 1 x amplitude [um],disc 1 x phase [deg],disc 1 y amplitude [um],disc 1 y phase [deg]
600,10,90,20,0
1200,30,-90,40,180
"""


def made(rng: np.random.Generator, **changes: object) -> RunUp:
    response = rng.standard_normal((5, 2, 2)) + 1j * rng.standard_normal((5, 2, 2))
    fields = {
        "name": "run",
        "load": 5.9,
        "speed": np.array([50.0, 60, 70, 80, 90]),
        "planes": ("disc 1", "disc 2"),
        "response": 1e-5 * response,
        "amplitude_error": 1e-7 * rng.uniform(1, 2, (5, 2, 2)),
        "phase_error": rng.uniform(0.01, 0.02, (5, 2, 2)),
        "unbalance": {"disc 1": 5e-5 + 0j, "disc 2": 3e-5j},
        "threshold": Uncertain(290.0, 0.6),
    }
    return RunUp(**(fields | changes))  # type: ignore[arg-type]


def same(found: RunUp, run: RunUp) -> None:
    assert (found.name, found.planes, found.shaker) == (run.name, run.planes, run.shaker)
    np.testing.assert_allclose(found.load, run.load)
    for name in ("speed", "response", "amplitude_error", "phase_error"):
        np.testing.assert_allclose(getattr(found, name), getattr(run, name), rtol=2e-5)
    assert found.unbalance.keys() == run.unbalance.keys()
    np.testing.assert_allclose(
        list(found.unbalance.values()), list(run.unbalance.values()), rtol=1e-7, atol=1e-15
    )


def test_what_is_written_is_read(tmp_path: Path, rng: np.random.Generator) -> None:
    run = made(rng)
    write_run_up_csv(tmp_path / "run.csv", run)
    found = read_run_up_csv(tmp_path / "run.csv")
    same(found, run)
    assert found.threshold is not None
    np.testing.assert_allclose([found.threshold.value, found.threshold.std_error], [290, 0.6], rtol=1e-7)


def test_errors_that_are_one_value_stand_above_the_table(tmp_path: Path, rng: np.random.Generator) -> None:
    run = made(rng)
    run = dataclasses.replace(
        run, amplitude_error=0.01 * np.abs(run.response), phase_error=np.full((5, 2, 2), np.deg2rad(1))
    )
    write_run_up_csv(tmp_path / "run.csv", run)
    text = (tmp_path / "run.csv").read_text()
    assert "# amplitude error: 1 %" in text and "# phase error: 1 deg" in text and "error [" not in text
    same(read_run_up_csv(tmp_path / "run.csv"), run)


def test_a_run_under_a_shaker_is_written_and_read(tmp_path: Path, rng: np.random.Generator) -> None:
    run = made(rng, unbalance={}, shaker=Shaker("disc 2", 2.0, -1.0, 0.95), threshold=None)
    write_run_up_csv(tmp_path / "run.csv", run)
    found = read_run_up_csv(tmp_path / "run.csv")
    same(found, run)
    assert found.threshold is None


def test_a_table_by_hand(tmp_path: Path) -> None:
    """600 rpm = 20 pi rad/s; 10 um at 90 deg = 10j um; 1 % of 30 um.

    The logger's own remark is passed over.
    """
    path = tmp_path / "by-hand.csv"
    path.write_text(TABLE)
    run = read_run_up_csv(path)
    assert (run.name, run.load, run.planes) == ("by-hand", 3.66, ("disc 1",))
    np.testing.assert_allclose(run.speed, [20 * np.pi, 40 * np.pi])
    np.testing.assert_allclose(run.response, 1e-6 * np.array([[[10j, 20]], [[-30j, -40]]]), atol=1e-18)
    np.testing.assert_allclose(run.amplitude_error[1, 0], [0.3e-6, 0.4e-6])
    np.testing.assert_allclose(run.phase_error, np.deg2rad(1))
    np.testing.assert_allclose(run.unbalance["disc 1"], 5e-5j, atol=1e-18)


def test_an_uncertainty_of_the_threshold_in_per_cent(tmp_path: Path) -> None:
    """As in a pipeline file: 0.5 % of 2772 rpm are 13.86 rpm, and +-: a twelfth of that as k=12."""
    path = tmp_path / "run.csv"
    for said, rpm in (("0.5 %", 13.86), ("0.5 % (k=12)", 1.155)):
        path.write_text(TABLE.replace("6 rpm", said))
        threshold = read_run_up_csv(path).threshold
        assert threshold is not None and threshold.std_error * 30 / np.pi == pytest.approx(rpm)


def test_other_units_of_the_lab(tmp_path: Path) -> None:
    path = tmp_path / "mils.csv"
    path.write_text(
        TABLE.replace("[um]", "[mil]").replace("[rpm]", "[Hz]").replace("600,", "10,").replace("1200,", "20,")
    )
    run = read_run_up_csv(path)
    np.testing.assert_allclose(run.speed, [20 * np.pi, 40 * np.pi])
    np.testing.assert_allclose(run.response[0, 0, 0], 254e-6j, atol=1e-15)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("# load: 3.66 N\n", "", "the load is missing"),
        ("# recorded", "# Unbalance disc 2: 3 g.mm\n# recorded", "unknown entry 'Unbalance disc 2'"),
        ("# recorded", "# unblance disc 2: 3 g.mm\n# recorded", "unknown entry 'unblance disc 2'"),
        ("# recorded", "\n # unbalance disc 7: 3 g.mm at 0 deg\n# recorded", "excited at 'disc 7'"),
        (
            "y phase [deg]\n600,10,90,20,0\n1200,30,-90,40,180",
            "y phase [deg],disc 1 y phase error [deg]\n600,10,90,20,0,1\n1200,30,-90,40,180,1",
            "the phase error is stated twice",
        ),
        ("3.66 N", "3.66 um", "load: .*wrong dimension"),
        ("3.66 N", "-1 N", "the load of run .* is positive"),
        ("# load", "# laod", "unknown entry 'laod'; did you mean 'load'"),
        ("# threshold: 2772", "# load: 1 N\n# threshold: 2772", "'load' appears twice"),
        (" +- 6 rpm", "", "its uncertainty is missing"),
        ("50 g.mm at 90 deg", "50 g.mm", "not a size and an angle"),
        ("unbalance disc 1", "unbalance disc 7", "not among its planes"),
        ("# unbalance disc 1: 50 g.mm at 90 deg\n", "", "either an unbalance or a shaker"),
        ("# phase error: 1 deg\n", "", "the phase error is missing"),
        ("speed [rpm]", "speed", "'speed' has no unit"),
        ("speed [rpm]", "rate [rpm]", "does not belong to a run-up"),
        ("x amplitude [um]", "x amplitude [N]", "wrong dimension"),
        ("y phase [deg]", "y phased [deg]", "does not belong to a run-up"),
        ("600,10", "600,", "a number is missing in row 1"),
        ("1200,30", "1200,ten", "is not a number"),
        ("1200,", "500,", "must rise"),
        ("amplitude error: 1 %", "amplitude error: 0 %", "not positive everywhere"),
        ("600,10,90,20", "600,10,90,0", "y amplitude.*: the amplitude in row 1 of the table is not above"),
        ("1200,30", "1200,-30", "x amplitude.*: the amplitude in row 2 of the table is not above zero"),
        ("y amplitude [um]", "x amplitude [mm]", "x amplitude .*x amplitude .* hold one quantity"),
        ("disc 1 y amplitude [um]", "speed [Hz]", "it has 2 column 'speed' where one is needed"),
        ("# recorded", "# shaker frequency: 0.9\n# recorded", "shaker frequency: there is no shaker"),
        (
            ",disc 1 y phase [deg]\n600,10,90,20,0\n1200,30,-90,40,180",
            "\n600,10,90,20\n1200,30,-90,40",
            "no column 'disc 1 y phase'",
        ),
    ],
)
def test_what_cannot_be_used_is_refused_in_plain_words(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "broken.csv"
    assert old in TABLE
    path.write_text(TABLE.replace(old, new))
    with pytest.raises(DataError) as caught:
        read_run_up_csv(path)
    assert caught.value.where.startswith(str(path))
    assert re.search(said, str(caught.value))


def test_a_load_that_the_table_does_not_state(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text(TABLE.replace("# load: 3.66 N\n", ""))
    assert read_run_up_csv(path, load=5.0).load == 5.0
    path.write_text(TABLE)
    assert read_run_up_csv(path, load=5.0).load == 3.66


def test_a_probe_that_stands_still_has_no_phase(rng: np.random.Generator) -> None:
    """60 rad/s are 573 rpm."""
    response = made(rng).response.copy()
    response[1, 0, 1] = 0
    with pytest.raises(DataError, match=r"does not move at 573 rpm"):
        made(rng, response=response)


def test_a_fault_above_the_table_is_named_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "broken.csv"
    path.write_text(TABLE.replace("2772 rpm", "2772 um"))
    with pytest.raises(DataError) as caught:
        read_run_up_csv(path)
    assert caught.value.where == f"{path}:3"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("# shaker: 2 N at disc 1", "not a force at a plane"),
        ("# shaker: 2 N in x, 0 N in y at disc 1", "shaker frequency is missing"),
        ("# shaker: 2 N in x, 0 N in y at disc 1\n# shaker frequency: 0", "must be positive"),
    ],
)
def test_shakers_that_cannot_be_are_refused(tmp_path: Path, line: str, said: str) -> None:
    path = tmp_path / "broken.csv"
    path.write_text(TABLE.replace("# unbalance disc 1: 50 g.mm at 90 deg", line))
    with pytest.raises(DataError, match=said):
        read_run_up_csv(path)


@pytest.mark.parametrize(
    ("text", "said"), [("", "the file is empty"), ("# load: 1 N\n", "no row of numbers")]
)
def test_files_without_a_table(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "nothing.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=said):
        read_run_up_csv(path)
    with pytest.raises(DataError, match="no such file"):
        read_run_up_csv(tmp_path / "none.csv")
