"""The card of a file: what stands in it, that it opens offline, and that nothing is left behind where it
cannot be made.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from labpipe.artefacts.header import Header
from labpipe.artefacts.measured_files import write_decays
from labpipe.project.inspect import inspect
from labpipe.records.recording import Overview
from labpipe.records.response import FrequencyResponse, Port
from labpipe.report.card import phase_figure
from tests.methods.ring_down.records_of_decay import record

RIG = """name: Test rig
channels:
  f: {column: f, quantity: force, unit: N, role: input, dof: y}
  y: {column: "y [um]", quantity: displacement, unit: um, role: output, dof: y}
sample_rate: 500 Hz
"""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> Path:
    """A table without a time column: a sine of 50 Hz at 500 Hz under an amplitude of 2, and noise.

    Clipped.
    """
    monkeypatch.chdir(tmp_path)
    sine = 2 * np.sin(2 * np.pi * 50 / 500 * np.arange(20_000))
    pd.DataFrame({"f": np.minimum(sine, 1.0), "y [um]": rng.normal(size=sine.size)}).to_csv(
        "run.csv", index=False
    )
    (tmp_path / "rig.yaml").write_text(RIG)
    return tmp_path


def test_the_overview_holds_levels_envelope_and_spectrum(run: Path) -> None:
    """Closed form: a clipped sine has its line at 50 Hz, its extremes at -1.9 and 1."""
    from labpipe.project.rig_file import load_rig

    seen = inspect(run / "run.csv", load_rig(run / "rig.yaml"))
    assert isinstance(seen, Overview)
    force = seen.channels[0]
    assert (force.minimum, force.maximum) == (pytest.approx(-2, abs=0.1), 1.0) and force.about == "f: input y"
    assert force.spectrum.frequency[np.argmax(force.spectrum.density)] == pytest.approx(50, abs=0.2)
    assert force.envelope.step == 32 and force.envelope.high.max() == 1.0
    assert [finding.code for finding in seen.findings] == ["clipped"] and seen.contradictions == ()
    assert inspect(run / "run.csv").sample_rate is None


@pytest.mark.parametrize("suffix", ["html", "md", "pdf"])
def test_a_card_is_written_in_every_format(run: Path, labpipe, suffix: str) -> None:
    ended = labpipe("inspect", "run.csv", "-r", "rig.yaml", "-o", f"card.{suffix}")
    assert (
        ended.code == 0 and "20000 rows, 2 columns" in ended.out and ended.err == f"written: card.{suffix}\n"
    )
    assert (run / f"card.{suffix}").stat().st_size > 500


@pytest.mark.long
def test_nobody_signs_a_card(run: Path, labpipe) -> None:
    """A report's PDF has a cover page to sign; this card is one page in all."""
    labpipe("inspect", "run.csv", "-o", "card.pdf")
    labpipe("inspect", "run.csv", "-o", "card.md")
    assert re.findall(rb"/Count (\d+)", (run / "card.pdf").read_bytes())[0] == b"1"
    assert "Signature" not in (run / "card.md").read_text()


def test_the_card_says_what_is_in_the_file_and_fetches_nothing(run: Path, labpipe) -> None:
    labpipe("inspect", "run.csv", "-r", "rig.yaml", "-o", "card.html")
    page = (run / "card.html").read_text()
    assert (
        "clipped: channel f" in page
        and "File and rig file agree" in page
        and "500 Hz" in page
        and "40 s" in page
    )
    assert page.count("<figure") == 2 and "over time" in page and "Signature" not in page
    assert "default-src &#x27;none&#x27;" in page and 'src="http' not in page


def test_the_card_names_what_a_rig_file_contradicts(run: Path, labpipe) -> None:
    (run / "other.yaml").write_text(RIG.replace("column: f", "column: force").replace("unit: um", "unit: mm"))
    ended = labpipe("inspect", "run.csv", "-r", "other.yaml", "-o", "card.html")
    assert ended.code == 0 and "warning rig: no column 'force'" in ended.out
    assert "no column &#x27;force&#x27;" in (run / "card.html").read_text()


def test_the_card_of_a_response_shows_magnitude_phase_and_uncertainty(
    tmp_path: Path, labpipe, root: Path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    labpipe("frf", "-c", root / "pipelines/pedestal.yaml", "-o", "out")
    (response,) = (tmp_path / "out").glob("*.frf.parquet")
    assert labpipe("inspect", response, "-o", "card.html").code == 0
    page = (tmp_path / "card.html").read_text()
    assert (
        "Phase of the receptance" in page and "signal-to-noise ratio" in page and "receptance [m/N]" in page
    )


def test_phases_stand_between_half_turns_with_a_mark_at_every_quarter() -> None:
    """-1, i and 1: 180, 90 and 0 deg."""
    port, shares = (Port("a", "a", "a"),), np.array([-1, 1j, 1])
    response = FrequencyResponse(np.array([1.0, 2.0, 3.0]), shares[:, None, None], port, port)
    (panel,) = phase_figure(response).graphic.panels
    np.testing.assert_allclose(np.abs(panel.series[0].y), [180, 90, 0])
    assert (panel.series[0].name, panel.y.unit, panel.x.unit) == ("a/a", "deg", "Hz")
    assert [tick for tick, _ in panel.y.ticks] == [-180, -90, 0, 90, 180]
    assert panel.y.ticks[0][1] == "-180" and -190 < panel.y.low < -180 and panel.y.high == -panel.y.low


def test_calibrated_recordings_have_cards(tmp_path: Path, labpipe, root: Path) -> None:
    labpipe(
        "ingest", root / "sample_data/hmb/axial.csv", "-r", root / "configs/hmb-axial.yaml", "-o", tmp_path
    )
    assert labpipe("inspect", tmp_path / "axial.recording.parquet", "-o", tmp_path / "card.md").code == 0
    assert "input z" in (tmp_path / "card.md").read_text()


def test_free_decays_are_looked_at_one_after_the_other(tmp_path: Path, labpipe) -> None:
    """Of 2 and 3 s at 1024 Hz: 5120 samples, whose least and largest values are those of both."""
    first, second = np.linspace(-1.0, 2.0, 2048), np.linspace(-3.0, 1.0, 3072)
    path = tmp_path / "a.decay.parquet"
    write_decays(path, record([first, second]), Header("decay", {}, inputs=()))
    seen = inspect(path)
    (channel,) = seen.channels
    assert (seen.n_sample, seen.sample_rate, seen.rate) == (5120, 1024.0, "1024 Hz, 2 decay(s) of 2 s to 3 s")
    assert (channel.minimum, channel.maximum, channel.unit, channel.about) == (-3.0, 2.0, "m", "output y")
    ended = labpipe("inspect", path)
    assert ended.code == 0 and ended.out.startswith(
        "free decays a.decay.parquet: 5120 samples, 1024 Hz, 2 decay"
    )


@pytest.mark.parametrize("rows", [1, 3])
def test_very_short_and_constant_files_have_cards(tmp_path: Path, labpipe, rows: int) -> None:
    (tmp_path / "r.csv").write_text("a,b\n" + "1,2\n" * rows)
    assert labpipe("inspect", tmp_path / "r.csv", "-o", tmp_path / "c.html").code == 0


@pytest.mark.parametrize(
    ("file", "card", "said"),
    [("run.csv", "c.docx", "no report format"), ("none.csv", "c.html", "no such file")],
)
def test_what_cannot_be_made_leaves_nothing(run: Path, labpipe, file: str, card: str, said: str) -> None:
    ended = labpipe("inspect", file, "-o", card)
    assert ended.code == 2 and said in ended.err and not (run / card).exists()
