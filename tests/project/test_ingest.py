"""Raw files become calibrated recordings: SI by hand calculation, findings with their place, freshness,
contradictions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from scipy.io import savemat

from labpipe.artefacts.recording_file import StoredRecording
from labpipe.artefacts.writing import output_folder
from labpipe.errors import ConfigError, DataError
from labpipe.project.ingest import (
    SourceFile,
    contradictions,
    ingest,
    ingest_all,
    is_recording,
    raw_recording,
    recording_refs,
    unique_names,
)
from labpipe.project.rig_file import load_rig
from labpipe.raw_files.table import open_table
from labpipe.records.rig import Span
from labpipe.spectra.channels import checked_blocks

TIMED = 'name: R\ntime: "t [s]"\nchannels:\n'
RATED = "name: R\nsample_rate: 100 Hz\nchannels:\n"
PLAIN = (
    '  f: {column: "force [N]", quantity: force, unit: N}\n  y: {column: "y [um]", quantity: '
    "displacement, unit: um}\n"
)


def rig_file(folder: Path, channels: str = PLAIN, head: str = RATED) -> Path:
    (folder / "rig.yaml").write_text(head + channels)
    return folder / "rig.yaml"


def csv_file(folder: Path, names: Sequence[str], rows: np.ndarray, name: str = "run.csv") -> Path:
    path = folder / name
    path.write_text(
        ",".join(names)
        + "\n"
        + "".join(",".join(f"{number!r}" for number in row) + "\n" for row in rows.tolist())
    )
    return path


def ingested(folder: Path, raw: Path, rig: Path, *span: Span) -> StoredRecording:
    source = SourceFile(raw, load_rig(rig), (), "", *span)
    with output_folder(folder / "out") as output:
        ingest(source, output, "run", folder)
    with output_folder(folder / "out") as output:
        return ingest(source, output, "run", folder)


TWO = ("force [N]", "y [um]")


# a part of a recording


@pytest.mark.parametrize("head", [RATED, TIMED])
@pytest.mark.parametrize(
    ("start", "end", "rows"), [(0.0, 1.0, (0, 100)), (0.5, None, (50, 700)), (1.23, 5.0, (123, 500))]
)
def test_a_part_of_a_recording_is_the_rows_between_its_ends(
    tmp_path: Path, head: str, start: float, end: float | None, rows: tuple[int, int]
) -> None:
    """100 Hz: row n is n / 100 s after the first, also of times that begin elsewhere and are rounded."""
    values = np.random.default_rng(5).normal(size=(700, 2))
    times = np.round(7.3 + np.arange(700) / 100, 2)
    raw = csv_file(tmp_path, ("t [s]", *TWO), np.column_stack([times, values]))
    part = ingested(tmp_path, raw, rig_file(tmp_path, head=head), Span(start, end))
    expected = values[slice(*rows)] * [1.0, 1e-6]
    np.testing.assert_allclose(part.in_memory().samples, expected, rtol=1e-12)
    assert part.sample_rate == pytest.approx(100, rel=1e-6)
    (cut,) = part.findings
    until = 7 if end is None else end
    assert (cut.code, cut.message) == (
        "cut",
        f"run.csv: of 7 s the part from {start:g} to {until:g} s counts",
    )


def test_a_part_beyond_the_recording_is_refused_with_its_length(tmp_path: Path) -> None:
    raw = csv_file(tmp_path, TWO, np.ones((700, 2)))
    rig = rig_file(tmp_path)
    for span, at in ((Span(0, 7.01), "end: 7.01 s"), (Span(7.0), "start: 7 s")):
        with pytest.raises(DataError) as caught:
            ingested(tmp_path, raw, rig, span)
        assert caught.value.what == f"lasts 7 s, and `{at}` lies beyond"
    assert ingested(tmp_path, raw, rig, Span(0, 7.0)).n_sample == 700


# calibration


@pytest.mark.parametrize(
    ("entry", "recorded", "si"),
    [
        ("quantity: displacement, unit: um", 90.0, 90e-6),
        ("quantity: displacement, unit: V, sensitivity: 8 V/mm", 4.0, 0.5e-3),
        ("quantity: displacement, unit: V, sensitivity: 8 V/mm, invert: true", 4.0, -0.5e-3),
        ("quantity: force, unit: mV, sensitivity: 22.5 mV/N", 45.0, 2.0),
        ("quantity: force, unit: V, sensitivity: 5.8 N/V", 2.0, 11.6),
        ("quantity: acceleration, unit: gn", 2.0, 19.6133),
        ("quantity: temperature, unit: degC", 20.0, 293.15),
        ("quantity: temperature, unit: degC, invert: true", 20.0, -293.15),
        ("quantity: pressure, unit: bar", 1.5, 1.5e5),
        ("quantity: current, unit: mA", 250.0, 0.25),
    ],
)
def test_a_recorded_number_becomes_si(tmp_path: Path, entry: str, recorded: float, si: float) -> None:
    raw = csv_file(tmp_path, ["a"], np.full((4, 1), recorded) + np.arange(4)[:, None] * 0.0)
    stored = ingested(tmp_path, raw, rig_file(tmp_path, f"  a: {{{entry}}}\n"))
    np.testing.assert_allclose(stored.in_memory().samples, si, rtol=1e-12)


@settings(max_examples=6, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(1e-3, 1e3), st.floats(-10, 10))
def test_calibration_is_linear(tmp_path_factory: pytest.TempPathFactory, factor: float, shift: float) -> None:
    """Scaled and shifted recorded numbers give scaled and shifted SI values."""
    folder = tmp_path_factory.mktemp("linear")
    rows = np.random.default_rng(3).normal(size=(20, 2))
    plain = ingested(folder, csv_file(folder, TWO, rows), rig_file(folder)).in_memory().samples
    other = (
        ingested(folder, csv_file(folder, TWO, factor * rows + shift), rig_file(folder)).in_memory().samples
    )
    np.testing.assert_allclose(other, factor * plain + shift * np.array([1.0, 1e-6]), rtol=1e-9, atol=1e-15)


def test_columns_that_the_rig_does_not_name_are_left_out_and_order_is_the_rig_s(tmp_path: Path) -> None:
    rows = np.arange(20.0).reshape(5, 4)
    raw = csv_file(tmp_path, ["spare", "y [um]", "n", "force [N]"], rows)
    stored = ingested(tmp_path, raw, rig_file(tmp_path))
    assert [channel.name for channel in stored.channels] == ["f", "y"]
    np.testing.assert_allclose(
        stored.in_memory().samples, np.column_stack([rows[:, 3], rows[:, 1] * 1e-6]), rtol=1e-15
    )


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_the_format_of_the_file_does_not_matter(tmp_path: Path, kind: str) -> None:
    rows = np.random.default_rng(5).normal(size=(50, 2))
    if kind == "csv":
        raw = csv_file(tmp_path, TWO, rows)
    else:
        raw = tmp_path / "run.parquet"
        pq.write_table(pa.table(dict(zip(TWO, rows.T, strict=True))), raw)
    np.testing.assert_array_equal(
        ingested(tmp_path, raw, rig_file(tmp_path)).in_memory().samples, rows * [1.0, 1e-6]
    )


# rate and time


@pytest.mark.parametrize(("unit", "step"), [("s", 1e-3), ("ms", 1.0), ("us", 1000.0)])
def test_the_rate_comes_from_the_time_column_in_its_unit(tmp_path: Path, unit: str, step: float) -> None:
    rows = np.column_stack([np.arange(50) * step, np.zeros((50, 2))])
    raw = csv_file(tmp_path, [f"t [{unit}]", *TWO], rows)
    rig = rig_file(tmp_path, head=f'name: R\ntime: "t [{unit}]"\nchannels:\n')
    assert ingested(tmp_path, raw, rig).sample_rate == pytest.approx(1000.0, rel=1e-9)


def test_rates_of_file_and_rig_agree(tmp_path: Path) -> None:
    """Times at 1 kHz under sample_rate: 100 Hz made every frequency ten times too low."""
    rows = np.column_stack([np.arange(50) * 1e-3, np.zeros((50, 2))])
    raw = csv_file(tmp_path, ["t [s]", *TWO], rows)
    with pytest.raises(DataError, match=r"is sampled at 1000 Hz by its column 't .s.', at 100 Hz by the rig"):
        ingested(tmp_path, raw, rig_file(tmp_path))
    # Times of one digit have a median step of zero, a gap of 9 s makes the mean one longer: no other rate.
    for times in (np.arange(50) // 10 / 10, np.arange(50) / 100 + np.repeat([0.0, 9.0], 25)):
        rows[:, 0] = times
        assert (
            ingested(tmp_path, csv_file(tmp_path, ["t [s]", *TWO], rows), rig_file(tmp_path)).n_sample == 50
        )
    # A rate of the file itself beside its times.
    savemat(tmp_path / "m.mat", {"t": np.arange(50) / 500, "f": np.ones(50), "fs": 1000.0})
    rig = rig_file(tmp_path, "  f: {quantity: force, unit: N}\n", "name: R\ntime: t\nchannels:\n")
    with pytest.raises(DataError, match="is sampled at 1000 Hz by the file itself, at 500 Hz by its times"):
        ingested(tmp_path, tmp_path / "m.mat", rig)


def test_a_stated_rate_is_taken(tmp_path: Path) -> None:
    assert (
        ingested(tmp_path, csv_file(tmp_path, TWO, np.zeros((3, 2))), rig_file(tmp_path)).sample_rate == 100.0
    )


@pytest.mark.parametrize(("place", "said"), [(0, "1"), (25, "26"), (48, "49")])
def test_a_gap_in_time_is_named_by_its_sample(tmp_path: Path, place: int, said: str) -> None:
    t = np.arange(50) / 100
    t[place + 1 :] += 0.05
    raw = csv_file(tmp_path, ["t [s]", *TWO], np.column_stack([t, np.zeros((50, 2))]))
    with pytest.raises(DataError, match=rf"not equal.*sample {said}\b"):
        ingested(tmp_path, raw, rig_file(tmp_path, head=TIMED))
    assert not (tmp_path / "out").exists()


def test_lost_rows_beside_a_stated_rate_are_named(tmp_path: Path) -> None:
    """Of a clock in the file, though the rig file states the rate; in the raw file as it is read as well."""
    n = np.arange(90)
    rows = np.delete(np.column_stack([n / 100, np.sin(n), np.cos(n)]), 40, axis=0)
    recording = ingested(tmp_path, csv_file(tmp_path, ["t [s]", *TWO], rows), rig_file(tmp_path))
    pq.write_table(pa.table(dict(zip(["t [s]", *TWO], rows.T, strict=True))), tmp_path / "run.parquet")
    raw = raw_recording(tmp_path / "run.parquet", load_rig(tmp_path / "rig.yaml"), tmp_path)
    assert recording.sample_rate == 100.0 and raw is not None
    for findings in (recording.findings, raw.findings):
        (gap,) = findings
        assert gap.code == "gap" and "1 sample(s) are lost, the first before sample 40 (0.41)" in gap.message


def test_a_missing_number_is_named_by_its_own_file(tmp_path: Path) -> None:
    t, y = np.arange(90) / 100, np.where(np.arange(90) == 40, np.nan, np.arange(90.0))
    paths = [
        csv_file(tmp_path, ["t [s]", name], np.column_stack([t, column]), f"{name[0]}.csv")
        for name, column in zip(TWO, (np.sin(t), y), strict=True)
    ]
    with output_folder(tmp_path / "out") as output:
        rig = load_rig(rig_file(tmp_path, head=TIMED))
        joined = ingest(SourceFile(paths[0], rig, tuple(paths[1:])), output, "run", tmp_path)
        with pytest.raises(DataError, match=r"y\.csv: channel 'y' of 'f' has no number at sample 40 "):
            list(checked_blocks(joined))


def test_time_that_runs_backwards_is_refused(tmp_path: Path) -> None:
    t = np.arange(50)[::-1] / 100
    raw = csv_file(tmp_path, ["t [s]", *TWO], np.column_stack([t, np.zeros((50, 2))]))
    with pytest.raises(DataError):
        ingested(tmp_path, raw, rig_file(tmp_path, head=TIMED))


def test_without_any_rate_both_cures_are_named(tmp_path: Path) -> None:
    raw = csv_file(tmp_path, TWO, np.zeros((3, 2)))
    with pytest.raises(
        DataError,
        match='one of sample_rate and time is needed in the rig file; write sample_rate: 20 kHz or time: "t',
    ):
        ingested(tmp_path, raw, rig_file(tmp_path, head="name: R\nchannels:\n"))


# findings


def codes(stored: StoredRecording) -> list[str]:
    return [finding.code for finding in stored.findings]


def test_clipping_at_the_logger_s_limits_is_found_in_the_recorded_unit(tmp_path: Path) -> None:
    """5 V is the limit of a probe of 8 V/mm: three samples stand there."""
    rows = np.column_stack([np.sin(np.arange(200.0)), 4 * np.sin(np.arange(200.0) / 7)])
    rows[50:53, 1] = 5.0
    probe = (
        "  f: {quantity: force}\n  y: {quantity: displacement, unit: V, sensitivity: 8 V/mm, range: 5 V}\n"
    )
    stored = ingested(tmp_path, csv_file(tmp_path, ("f", "y"), rows), rig_file(tmp_path, probe))
    assert codes(stored) == ["clipped"] and "y" in stored.findings[0].message
    rows[50:53, 1] = 4.9
    again = ingested(tmp_path, csv_file(tmp_path, ("f", "y"), rows, "other.csv"), rig_file(tmp_path, probe))
    assert codes(again) == []


def test_a_sound_recording_has_no_findings(tmp_path: Path) -> None:
    rows = np.random.default_rng(8).normal(size=(500, 2))
    assert codes(ingested(tmp_path, csv_file(tmp_path, TWO, rows), rig_file(tmp_path))) == []


# freshness


def test_a_shaft_at_rest_is_no_dead_channel(tmp_path: Path) -> None:
    """Neither pulses nor a speed vary at rest; a displacement that does not is named."""
    channels = "".join(
        f"  {name}: {{quantity: {quantity}, unit: {unit}}}\n"
        for name, quantity, unit in (
            ("key", "tacho", "V"),
            ("n", "speed", "rpm"),
            ("x", "displacement", "um"),
            ("y", "displacement", "um"),
        )
    )
    rows = np.zeros((50, 4))
    rows[:, 3] = np.sin(np.arange(50.0))
    recording = ingested(
        tmp_path, csv_file(tmp_path, ["key", "n", "x", "y"], rows), rig_file(tmp_path, channels)
    )
    (found,) = recording.findings
    assert (found.code, found.message) == ("constant", "channel x does not vary at all")


def test_a_fresh_recording_is_left_alone_and_a_stale_one_is_made_again(tmp_path: Path) -> None:
    rows = np.random.default_rng(8).normal(size=(20, 2))
    raw, rig = csv_file(tmp_path, TWO, rows), rig_file(tmp_path)
    ingested(tmp_path, raw, rig)
    path = tmp_path / "out/run.recording.parquet"
    number, content = path.stat().st_ino, path.read_bytes()
    ingested(tmp_path, raw, rig)
    assert path.stat().st_ino == number
    csv_file(tmp_path, TWO, rows + 1)
    ingested(tmp_path, raw, rig)
    assert path.stat().st_ino != number and path.read_bytes() != content


def test_a_calibrated_recording_is_taken_as_it_is(tmp_path: Path) -> None:
    stored = ingested(tmp_path, csv_file(tmp_path, TWO, np.zeros((5, 2))), rig_file(tmp_path))
    with output_folder(tmp_path / "elsewhere") as output:
        again = ingest(SourceFile(stored.path, load_rig(tmp_path / "rig.yaml")), output, "x", tmp_path)
    assert again == stored and not (tmp_path / "elsewhere").exists()


def test_the_reference_of_a_recording_is_its_raw_file(tmp_path: Path) -> None:
    raw = csv_file(tmp_path, TWO, np.zeros((5, 2)))
    stored = ingested(tmp_path, raw, rig_file(tmp_path))
    assert [reference.path for reference in recording_refs(stored, tmp_path)] == ["run.csv"]


def test_what_is_a_recording_of_ours(tmp_path: Path) -> None:
    stored = ingested(tmp_path, csv_file(tmp_path, TWO, np.zeros((5, 2))), rig_file(tmp_path))
    renamed = tmp_path / "renamed.parquet"
    renamed.write_bytes(stored.path.read_bytes())
    pq.write_table(pa.table({"f": [1.0]}), tmp_path / "raw.parquet")
    assert is_recording(stored.path) and is_recording(renamed)
    assert not is_recording(tmp_path / "raw.parquet") and not is_recording(tmp_path / "run.csv")


# many files


@given(st.lists(st.sampled_from(["a", "b", "a-2", "c"]), min_size=1, max_size=6))
def test_names_of_many_files_differ_and_keep_their_stems(stems: list[str]) -> None:
    names = unique_names([Path(f"folder{number}/{stem}.csv") for number, stem in enumerate(stems)])
    assert len(set(names)) == len(stems)
    assert all(name == stem or name.startswith(f"{stem}-") for name, stem in zip(names, stems, strict=True))
    assert names[0] == stems[0]


def test_names_of_calibrated_recordings_lose_their_whole_ending() -> None:
    assert unique_names([Path("a.recording.parquet"), Path("a.csv"), Path("a.b.csv")]) == ["a", "a-2", "a.b"]


def test_many_files_of_one_rig(tmp_path: Path) -> None:
    raws = [csv_file(tmp_path, TWO, np.full((4, 2), float(n)), f"run{n}.csv") for n in range(3)]
    with output_folder(tmp_path / "out") as output:
        stored = ingest_all(raws, load_rig(rig_file(tmp_path)), output, tmp_path)
        assert [float(one.in_memory().samples[0, 0]) for one in stored] == [0.0, 1.0, 2.0]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        f"run{n}.recording.parquet" for n in range(3)
    ]


# file against rig


@pytest.mark.parametrize(
    ("head", "channels", "names", "said"),
    [
        (RATED, PLAIN, TWO, []),
        (RATED, PLAIN, ("force [N]", "y [mm]"), ["no column 'y [um]'"]),
        (TIMED, PLAIN, TWO, ["no column 't [s]'"]),
        ("name: R\nchannels:\n", PLAIN, TWO, ["states no sampling rate"]),
        (
            RATED,
            PLAIN.replace("unit: um", "unit: mm"),
            TWO,
            ["column 'y [um]' is in um by the file's own header, in mm by the rig file"],
        ),
        (RATED, PLAIN, ("Force [N]", "y [mm]"), ["no column 'force [N]'", "no column 'y [um]'"]),
    ],
)
def test_every_contradiction_of_file_and_rig_is_named(
    tmp_path: Path, head: str, channels: str, names: tuple[str, ...], said: list[str]
) -> None:
    raw = csv_file(tmp_path, names, np.zeros((3, 2)))
    found = contradictions(open_table(raw), load_rig(rig_file(tmp_path, channels, head)))
    assert len(found) == len(said), [str(one) for one in found]
    assert all(words in str(one) for words, one in zip(said, found, strict=True)), [str(one) for one in found]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_samples_that_are_no_number_are_found_with_their_place(tmp_path: Path, bad: float) -> None:
    """They are kept as they are, and said: whoever goes on to spectra must not go on with them unawares."""
    rows = np.random.default_rng(8).normal(size=(100, 2))
    rows[40, 1] = bad
    stored = ingested(tmp_path, csv_file(tmp_path, TWO, rows), rig_file(tmp_path))
    assert (
        codes(stored) == ["gap"]
        and "sample 40" in stored.findings[0].message
        and "y" in stored.findings[0].message
    )


def test_channels_at_two_rates_in_one_recording(tmp_path: Path) -> None:
    """By hand: a ramp at 5 Hz beside one at 10 Hz, both straight lines, whose splines are exact."""
    header = "LabVIEW Measurement\t\nSeparator\tTab\n***End_of_Header***\t\n\t\nChannels\t2\t\t\n"
    header += "Samples\t9\t5\t\nY_Unit_Label\tNewtons\tum\t\nX_Dimension\tTime\tTime\t\nDelta_X\t0.1\t0.2\t\n"
    rows = [f"\t{n}\t{20 * n if n < 5 else ''}\n" for n in range(9)]
    (tmp_path / "r.lvm").write_text(
        header + "***End_of_Header***\t\t\t\nX_Value\tforce [N]\ty [um]\tComment\n" + "".join(rows)
    )
    with pytest.raises(
        DataError,
        match=r"'y \[um\]' lies in another group .* or has another rate; resample: RATE in the rig file",
    ):
        ingested(tmp_path, tmp_path / "r.lvm", rig_file(tmp_path))
    rig = rig_file(tmp_path, head="name: R\nresample: 10 Hz\nchannels:\n")
    recording = ingested(tmp_path, tmp_path / "r.lvm", rig)
    assert recording.sample_rate == 10.0 and [finding.code for finding in recording.findings] == ["resampled"]
    (block,) = recording.blocks(100)
    np.testing.assert_allclose(block, [[n, 10e-6 * n] for n in range(9)], rtol=1e-12, atol=1e-18)


def test_a_rig_has_one_rate(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="one of sample_rate and resample is needed, not both"):
        load_rig(rig_file(tmp_path, head="name: R\nsample_rate: 10 Hz\nresample: 10 Hz\nchannels:\n"))


@pytest.mark.parametrize(
    ("head", "titles"),
    [("time: t", "t,f\nms,N"), ('time: "t [msec]"', "t [msec],f"), ("resample: 1 kHz", "t [ms],f")],
)
def test_the_unit_of_the_time_is_that_of_the_file(tmp_path: Path, head: str, titles: str) -> None:
    """A step of one millisecond is 1000 Hz, wherever the unit stands."""
    (tmp_path / "run.csv").write_text(f"{titles}\n" + "".join(f"{n},{n % 7}\n" for n in range(40)))
    rig = rig_file(tmp_path, "  f: {quantity: force}\n", f"{head}\nchannels:\n")
    recording = ingested(tmp_path, tmp_path / "run.csv", rig)
    assert (recording.sample_rate, recording.n_sample) == (1000.0, 40)


def test_a_time_in_a_unit_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("t,f\nmm,N\n" + "".join(f"{n},{n % 7}\n" for n in range(40)))
    rig = rig_file(tmp_path, "  f: {quantity: force}\n", "time: t\nchannels:\n")
    with pytest.raises(DataError, match=r"run\.csv: 't' is in mm, which is not a unit of time"):
        ingested(tmp_path, tmp_path / "run.csv", rig)


def test_times_of_day_are_seconds_whatever_their_column_is_called(tmp_path: Path) -> None:
    rows = "".join(f"10:00:00.{n:02d},{n % 7}\n" for n in range(40))
    (tmp_path / "run.csv").write_text("time [h],f\n" + rows)
    rig = rig_file(tmp_path, "  f: {quantity: force}\n", 'time: "time [h]"\nchannels:\n')
    assert ingested(tmp_path, tmp_path / "run.csv", rig).sample_rate == 100.0


def test_joined_files_are_not_resampled(tmp_path: Path) -> None:
    raw = csv_file(tmp_path, ["t [s]", "f"], np.column_stack([np.arange(9) / 10, np.arange(9)]))
    rig = load_rig(rig_file(tmp_path, "  f: {quantity: force}\n", "resample: 10 Hz\nchannels:\n"))
    with output_folder(tmp_path / "out") as output, pytest.raises(DataError, match="these files are joined"):
        ingest(SourceFile(raw, rig, (raw,)), output, "run", tmp_path)
