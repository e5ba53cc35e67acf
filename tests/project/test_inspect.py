"""A first look at a file: levels by hand, rates, time columns, what the rig says of it.

And a card that is whole or absent.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.header import Header
from labpipe.artefacts.recording_file import RecordingWriter, recording_contents
from labpipe.errors import ConfigError, DataError
from labpipe.project.inspect import inspect
from labpipe.project.report import format_of
from labpipe.project.rig_file import load_rig
from labpipe.raw_files.frf_csv import write_frf_csv
from labpipe.records.recording import Channel, Overview
from labpipe.records.response import FrequencyResponse, Port

RIG = (
    'name: R\n{head}channels:\n  f: {{column: "force [N]", quantity: force}}\n  y: {{column: "y [um]", '
    "quantity: displacement, unit: um}}\n"
)
N = 2000


def table(folder: Path, time: str = "t [s]", step: float = 1e-3, name: str = "run.csv") -> Path:
    """A force of 3 N about 1 N at 50 Hz, a motion of 20 um at 125 Hz; 2 s at 1 kHz."""
    t = np.arange(N) / 1000
    columns = [np.arange(N) * step, 1 + 3 * np.sin(2 * np.pi * 50 * t), 20 * np.cos(2 * np.pi * 125 * t)]
    head = ",".join([*([time] if time else []), "force [N]", "y [um]"])
    rows = np.column_stack(columns if time else columns[1:])
    np.savetxt(folder / name, rows, delimiter=",", header=head, comments="", fmt="%.12g")
    return folder / name


def seen(path: Path, rig: Path | None = None) -> Overview:
    overview = inspect(path, None if rig is None else load_rig(rig))
    assert isinstance(overview, Overview)
    return overview


def test_levels_are_those_of_a_sine(tmp_path: Path) -> None:
    """1 + 3 sin: minimum -2, maximum 4, mean 1, rms about it 3 / sqrt 2; 20 cos: 20 / sqrt 2."""
    _, force, motion = seen(table(tmp_path)).channels
    assert (force.minimum, force.maximum, force.mean) == pytest.approx((-2.0, 4.0, 1.0), abs=1e-9)
    assert force.rms == pytest.approx(3 / np.sqrt(2)) and motion.rms == pytest.approx(20 / np.sqrt(2))
    assert (force.name, force.unit, force.label) == ("force [N]", "N", "force [N]")


def test_the_spectrum_has_its_peak_at_the_frequency(tmp_path: Path) -> None:
    _, force, motion = seen(table(tmp_path)).channels
    for channel, frequency in ((force, 50.0), (motion, 125.0)):
        spectrum = channel.spectrum
        spacing = spectrum.frequency[1] - spectrum.frequency[0]
        assert spectrum.frequency[int(np.argmax(spectrum.density))] == pytest.approx(frequency, abs=spacing)


def test_power_of_the_spectrum_is_that_of_the_signal(tmp_path: Path) -> None:
    """Integral of the density squared over frequency: the variance, 9 / 2 and 200 (Parseval)."""
    _, force, motion = seen(table(tmp_path)).channels
    for channel, power in ((force, 4.5), (motion, 200.0)):
        spectrum = channel.spectrum
        spacing = spectrum.frequency[1] - spectrum.frequency[0]
        assert np.sum(spectrum.density**2) * spacing == pytest.approx(power, rel=0.02)


def test_the_envelope_holds_every_sample(tmp_path: Path) -> None:
    _, force, _ = seen(table(tmp_path)).channels
    samples = 1 + 3 * np.sin(2 * np.pi * 50 * np.arange(N) / 1000)
    step = force.envelope.step
    for number, (low, high) in enumerate(zip(force.envelope.low, force.envelope.high, strict=True)):
        part = samples[number * step : (number + 1) * step]
        assert (low, high) == pytest.approx((part.min(), part.max()), abs=1e-9)


@pytest.mark.parametrize(
    ("time", "step"), [("t [s]", 1e-3), ("Time (ms)", 1.0), ("zeit [us]", 1000.0), ("t", 1e-3)]
)
def test_the_rate_of_a_time_column(tmp_path: Path, time: str, step: float) -> None:
    overview = seen(table(tmp_path, time, step))
    assert overview.sample_rate == pytest.approx(1000.0, rel=1e-9) and overview.time == time
    said = "1000 samples per unit of" if time == "t" else "1000 Hz by"
    assert overview.rate == f"{said} '{time}'"
    assert [channel.name for channel in overview.plotted] == ["force [N]", "y [um]"]


def test_without_a_time_column_the_rig_gives_the_rate(tmp_path: Path) -> None:
    path = table(tmp_path, "")
    (tmp_path / "rig.yaml").write_text(RIG.format(head="sample_rate: 1 kHz\n"))
    assert seen(path).sample_rate is None and seen(path).contradictions is None
    known = seen(path, tmp_path / "rig.yaml")
    assert known.sample_rate == 1000.0 and known.contradictions == ()
    assert [channel.about for channel in known.channels] == ["f: input f", "y: output y"]


def test_what_the_rig_says_otherwise_is_listed(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(RIG.format(head='time: "t [ms]"\n').replace("unit: um", "unit: mm"))
    found = seen(table(tmp_path), tmp_path / "rig.yaml").contradictions
    assert found is not None and len(found) == 2
    assert (
        "no column 't [ms]'" in found[0]
        and "is in um by the file's own header, in mm by the rig file" in found[1]
    )
    (tmp_path / "rig.yaml").write_text(RIG.format(head="sample_rate: 500 Hz\n"))
    (rate,) = seen(table(tmp_path), tmp_path / "rig.yaml").contradictions or ()
    assert "is sampled at 1000 Hz by its column 't [s]', at 500 Hz by the rig file" in rate


def test_a_calibrated_recording_shows_its_channels(tmp_path: Path) -> None:
    channels = (Channel("f", "force", "input", "y"), Channel("y", "displacement", "output", "y"))
    path = tmp_path / "a.recording.parquet"
    with RecordingWriter(path, channels) as writer:
        writer.write(np.column_stack([np.arange(10.0), np.full(10, 2e-6)]))
        writer.finish(Header("recording", {}, inputs=(), contents=recording_contents(channels, 5.0, "run 7")))
    overview = seen(path)
    assert (overview.file, overview.kind, overview.n_sample, overview.sample_rate) == (
        "run 7",
        "calibrated recording",
        10,
        5.0,
    )
    assert overview.rate == "5 Hz, 2 s" and [channel.about for channel in overview.channels] == [
        "input y",
        "output y",
    ]
    assert overview.channels[0].mean == 4.5 and overview.channels[0].unit == "N"


def test_a_response_is_shown_as_one(tmp_path: Path) -> None:
    port = (Port("x", "x", "x"),)
    write_frf_csv(
        tmp_path / "h.csv",
        FrequencyResponse(np.array([1.0, 2.0]), np.ones((2, 1, 1)), port, (Port("f", "f", "x"),)),
    )
    assert isinstance(inspect(tmp_path / "h.csv"), FrequencyResponse)


@pytest.mark.parametrize(("name", "said"), [("none.csv", "no such file"), ("", "is a folder")])
def test_what_cannot_be_read_is_said(tmp_path: Path, name: str, said: str) -> None:
    with pytest.raises(DataError, match=said):
        inspect(tmp_path / name)


def test_uneven_time_is_said_with_the_file(tmp_path: Path) -> None:
    path = table(tmp_path)
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([*lines[:100], *lines[110:]]))
    with pytest.raises(DataError, match="not equal") as caught:
        inspect(path)
    assert caught.value.where == str(path)


def test_a_channel_that_does_not_vary_is_found(tmp_path: Path) -> None:
    (tmp_path / "flat.csv").write_text("a,b\n" + "".join(f"{n},3\n" for n in range(50)))
    (finding,) = seen(tmp_path / "flat.csv").findings
    assert finding.code == "constant" and "'b'" in finding.message.replace("channel b", "channel 'b'")


@pytest.mark.parametrize("kind", ["html", "md"])
def test_a_card_shows_the_channels(tmp_path: Path, kind: str) -> None:
    from labpipe.project.inspect import write_card

    path = table(tmp_path)
    write_card(seen(path), path.name, tmp_path / f"card.{kind}")
    text = (tmp_path / f"card.{kind}").read_text("utf-8").replace("\\", "")
    assert "force [N]" in text and "y [um]" in text and "run.csv" in text


@pytest.mark.parametrize(
    ("name", "kind"), [("a.html", "html"), ("a.HTM", "html"), ("a.md", "md"), ("a.pdf", "pdf")]
)
def test_the_ending_says_the_format(name: str, kind: str) -> None:
    assert format_of(Path(name)) == kind


@pytest.mark.parametrize("name", ["a.docx", "a", "a.html.gz"])
def test_an_unknown_ending_is_refused_with_the_known_ones(name: str) -> None:
    with pytest.raises(
        ConfigError, match=r"no report format for the ending .*; known: \.html, \.htm, \.md, \.pdf"
    ):
        format_of(Path(name))
