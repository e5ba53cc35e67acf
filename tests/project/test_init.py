"""A project from a recording's own metadata, or from a shipped example: to a report with no edit beyond the
marked lines.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import pyuff
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat, wavfile

from labpipe.artefacts.identification_file import read_identification
from labpipe.cli.start import examples
from labpipe.project.first_guess import STANDS_OUT, guess_channels, peaks_of, time_columns
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.proposals import pattern_of_names
from labpipe.project.scaffold import MARK
from labpipe.project.settings_reader import DECIDE

RATE, PERIOD, REPEATS = 1000.0, 1000, 6
K, C, MASS = 80e3, 40.0, 2.0


def signals() -> tuple[np.ndarray, np.ndarray]:
    """Force [N] and displacement [m] of a mass on a spring, periodic with 1 s, lines 5-80 Hz.

    A little noise, seed pinned.
    """
    rng = np.random.default_rng(7)
    lines = np.arange(5, 81)
    omega = 2 * np.pi * lines
    phasors = np.exp(
        1j * (np.outer(np.arange(PERIOD * REPEATS) / RATE, omega) - np.pi * lines * (lines - 1) / lines.size)
    )
    y = (phasors / (K - MASS * omega**2 + 1j * omega * C)).real.sum(1)
    force = phasors.real.sum(1)
    return force + 1e-3 * np.std(force) * rng.normal(size=force.size), y + 1e-3 * np.std(y) * rng.normal(
        size=y.size
    )


def tdms(path: Path) -> None:
    force, y = signals()
    common = {"wf_increment": 1 / RATE, "wf_samples": force.size, "wf_start_offset": 0.0}
    channels = [
        ChannelObject("run", "Hammer force", force, {**common, "unit_string": "N"}),
        ChannelObject("run", "Probe Y", 1e6 * y, {**common, "unit_string": "um"}),
    ]
    with TdmsWriter(path) as writer:
        writer.write_segment(channels)


def mat(path: Path) -> None:
    force, y = signals()
    savemat(path, {"fs": RATE, "force": force, "probe_y": 8000 * y})


def uff(path: Path, labpipe) -> None:
    """Written by labpipe itself: units in record 164, rate in the record's header."""
    force, y = signals()
    t = np.arange(force.size) / RATE
    raw = path.parent / "raw.csv"
    raw.write_text(
        "t [s],f [N],y [m]\n"
        + "".join(f"{a:.4f},{b:.9g},{c:.9g}\n" for a, b, c in zip(t, force, y, strict=True))
    )
    (path.parent / "raw.yaml").write_text(
        'time: "t [s]"\nchannels:\n'
        '  force_y: {column: "f [N]", quantity: force, unit: N, dof: y}\n'
        '  y: {column: "y [m]", quantity: displacement, unit: m, dof: y}\n'
    )
    assert labpipe("ingest", raw, "-r", path.parent / "raw.yaml", "-o", path.parent / "raw").code == 0
    assert (
        labpipe("export", path.parent / "raw/raw.recording.parquet", "--to", "uff58b", "-o", path).code == 0
    )


def decide(folder: Path, answers: dict[str, str]) -> None:
    """Edit the marked lines only: on the line of a channel, the first DECIDE for each answer."""
    path = folder / "rig.yaml"
    lines = path.read_text().splitlines()
    for number, line in enumerate(lines):
        if MARK in line and not line.lstrip().startswith("#"):
            for key in ("quantity", "unit", "sensitivity", "sample_rate"):
                name = line.split(":")[0].strip()
                lines[number] = lines[number].replace(
                    f"{key}: {DECIDE}", f"{key}: {answers.get(f'{name}.{key}', '')}"
                )
    path.write_text("\n".join(lines) + "\n")


def assert_found(folder: Path, labpipe) -> None:
    ended = labpipe("run", folder / "pipeline.yaml", "-o", folder / "out")
    assert ended.code == 0, ended.err
    assert (folder / "out/report.html").stat().st_size > 10_000
    (fit,) = json.loads((folder / "out/identification.json").read_text())["fits"]
    found = {parameter["name"]: parameter for parameter in fit["parameters"]}
    for name, truth in (("k", K), ("c", C), ("m", MASS)):
        assert found[name]["value"] == pytest.approx(truth, abs=4 * found[name]["std_error"])
        assert found[name]["value"] == pytest.approx(truth, rel=0.01)


def test_a_tdms_file_says_all_by_itself(tmp_path: Path, labpipe) -> None:
    tdms(tmp_path / "run.tdms")
    ended = labpipe("init", tmp_path / "rig", tmp_path / "run.tdms")
    assert ended.code == 0 and "decided" not in ended.out
    text = (tmp_path / "rig/pipeline.yaml").read_text()
    assert "excitation: periodic" in text and "period: 1 s" in text and "band: 5-80 Hz" in text
    assert_found(tmp_path / "rig", labpipe)


def test_a_mat_file_needs_its_units(tmp_path: Path, labpipe) -> None:
    mat(tmp_path / "run.mat")
    ended = labpipe("init", tmp_path / "rig", tmp_path / "run.mat")
    assert ended.code == 0 and "to be decided" in ended.out
    ended = labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out")
    assert ended.code == 2 and ended.err.count("is still to be decided") == 2
    assert "rig.yaml:4" in ended.err and "rig.yaml:5" in ended.err
    decide(tmp_path / "rig", {"force.unit": "N", "probe_y.unit": "V, sensitivity: 8 V/mm"})
    assert_found(tmp_path / "rig", labpipe)


def test_a_universal_file_says_all_by_itself(tmp_path: Path, labpipe) -> None:
    uff(tmp_path / "run.uff", labpipe)
    assert labpipe("init", tmp_path / "rig", tmp_path / "run.uff").code == 0
    decide(tmp_path / "rig", {})
    assert_found(tmp_path / "rig", labpipe)


def test_several_recordings_become_several_tests(tmp_path: Path, labpipe) -> None:
    for name in ("one", "two"):
        tdms(tmp_path / f"{name}.tdms")
    assert labpipe("init", tmp_path / "rig", tmp_path / "one.tdms", tmp_path / "two.tdms").code == 0
    assert labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out").code == 0
    fits = json.loads((tmp_path / "out/identification.json").read_text())["fits"]
    assert [fit["test"] for fit in fits] == ["one", "two"]


@pytest.mark.parametrize(
    ("names", "pattern"),
    [
        (["run_01", "run_02"], "run_{run}"),
        (["1", "2", "10"], "{number}"),
        (["500rpm_1", "500rpm_2", "1000rpm_1"], "{speed}_{}"),
        (["500rpm_run1", "1000rpm_run2"], "{speed}_run{}"),
        (["speed500_load2kN_x", "speed1000_load1kN_x"], "speed{speed}_load{load}_x"),
        (["427N-up", "427N-down", "1kN-up"], "{load}-{case}"),
        (["0.5mm 20°C", "1.0mm 30°C"], "{gap} {temperature}"),
        (["T20C_1", "T30C_1"], "T{T}C_1"),
        (["1500_rpm", "2000_rpm"], "{speed}_rpm"),
        (["up 10Hz", "up 20Hz"], "up {frequency}"),
        (["one", "two"], ""),
        (["run_1", "run_2_bad"], ""),
        (["a{1}", "a{2}"], ""),
    ],
)
def test_numbers_in_names_are_conditions(names: list[str], pattern: str) -> None:
    assert pattern_of_names(names) == pattern


def campaign(folder: Path, stiffness: dict[str, float]) -> None:
    """Recordings of one mass on springs of different *stiffness* [N/m] by name, 5-80 Hz, 0.1 % noise."""
    rng, lines = np.random.default_rng(9), np.arange(5, 81)
    folder.mkdir()
    time, omega = np.arange(PERIOD * REPEATS) / RATE, 2 * np.pi * lines
    phasors = np.exp(1j * (np.outer(time, omega) - np.pi * lines * (lines - 1) / lines.size))
    for name, k in stiffness.items():
        y = 1e6 * (phasors / (k - MASS * omega**2 + 1j * omega * C)).real.sum(1)
        columns = [time, *(x + 1e-3 * x.std() * rng.normal(size=x.size) for x in (phasors.real.sum(1), y))]
        rows = "\n".join(",".join(f"{value:.8g}" for value in row) for row in zip(*columns, strict=True))
        (folder / f"{name}.csv").write_text(f"time [s],force [N],y [um]\n{rows}\n")


@pytest.mark.parametrize("kind", ["numbered", "speeds", "table", "one of a table"])
def test_a_folder_of_recordings_is_a_campaign(tmp_path: Path, labpipe, kind: str) -> None:
    """Stiffness of every test within four standard errors, whose resonances lie from 29 to 43 Hz; the band of
    the first alone would not hold those of the others.
    """
    names = {
        "numbered": [f"run_{n:02d}" for n in range(1, 6)],
        "speeds": [f"{speed}rpm_{n}" for speed in (500, 1000) for n in (1, 2)],
        "table": ["b17", "c4", "a99"],
        "one of a table": ["b17"],
    }[kind]
    stiffness = {name: 70e3 + 90e3 * n / len(names) for n, name in enumerate(names)}
    campaign(tmp_path / "data", stiffness)
    (tmp_path / "data/README.txt").write_text("by hand\n")
    if kind.endswith("table"):
        rows = (f"{name}.csv;{500 * n};0,{n + 1}" for n, name in enumerate(names))
        table = "\n".join(("file;speed [rpm];load (kN)", *rows))
        (tmp_path / "data/conditions.csv").write_text(table)
    ended = labpipe("init", tmp_path / "rig", tmp_path / "data")
    assert ended.code == 0 and "left out: README.txt: " in ended.out and "decided" not in ended.out
    text = (tmp_path / "rig/pipeline.yaml").read_text()
    each = {"numbered": ("../data/run_*.csv", "run_{run}"), "speeds": ("../data/*.csv", "{speed}_{}")}.get(
        kind
    )
    assert each is None or (f'each: "{each[0]}"' in text and f'pattern: "{each[1]}"' in text)
    assert labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out").code == 0
    result = read_identification(tmp_path / "out/identification.json")
    assert {fit.test for fit in result.fits} == set(names)
    for fit in result.fits:
        k = fit.parameter("k")
        assert abs(k.value - stiffness[fit.test]) < 4 * k.std_error < 0.01 * k.value
    (last,) = (response for response in result.responses if response.name == names[-1])
    assert (
        dict(last.conditions)
        == {
            "numbered": {"run": "05"},
            "speeds": {"speed": "1000rpm"},
            "table": {"speed": "1000 rpm", "load": "0.3 kN"},
            "one of a table": {"speed": "0 rpm", "load": "0.1 kN"},
        }[kind]
    )


def test_a_folder_without_a_recording_is_refused(tmp_path: Path, labpipe) -> None:
    (tmp_path / "empty").mkdir()
    ended = labpipe("init", tmp_path / "rig", tmp_path / "empty")
    assert ended.code == 2 and "holds no recording that can be read" in ended.err
    assert not (tmp_path / "rig").exists()


def test_frfs_need_no_rig_file(tmp_path: Path, labpipe) -> None:
    frequency = np.arange(5.0, 80.0, 0.5)
    omega = 2 * np.pi * frequency
    h = 1 / (K - MASS * omega**2 + 1j * omega * C)
    rows = "".join(f"{f},{v.real:.16g},{v.imag:.16g}\n" for f, v in zip(frequency, h, strict=True))
    (tmp_path / "h.csv").write_text("# form: receptance\nfrequency_hz,y/f:re,y/f:im\n" + rows)
    assert labpipe("init", tmp_path / "rig", tmp_path / "h.csv").code == 0
    assert not (tmp_path / "rig/rig.yaml").exists()
    ended = labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out")
    assert ended.code == 0, ended.err
    (fit,) = json.loads((tmp_path / "out/identification.json").read_text())["fits"]
    assert fit["estimator"] == "ls" and fit["parameters"][0]["value"] == pytest.approx(K, rel=1e-9)


def frf_table(path: Path) -> None:
    """An accelerance in g/N with a line at 0 Hz, as an analyser writes it."""
    frequency = np.arange(0.0, 80.0, 0.5)
    omega = 2 * np.pi * frequency
    h = -(omega**2) / (K - MASS * omega**2 + 1j * omega * C) / 9.80665
    rows = "".join(f"{f:g}\t{v.real:.12e}\t{v.imag:.12e}\n" for f, v in zip(frequency, h, strict=True))
    path.write_text("Beam, 3 averages\nFrequency [Hz]\tReal [g/N]\tImaginary [g/N]\n" + rows)


def first_fit(folder: Path) -> dict:
    (fit,) = json.loads((folder / "identification.json").read_text())["fits"]
    return fit


def test_a_table_of_an_frf_becomes_a_pipeline_of_frfs(tmp_path: Path, labpipe) -> None:
    """Columns and unit from the header; nothing is left to decide, and the band begins above 0 Hz."""
    frf_table(tmp_path / "h.txt")
    ended = labpipe("init", tmp_path / "rig", tmp_path / "h.txt")
    assert ended.code == 0 and "to be decided" not in ended.out and not (tmp_path / "rig/rig.yaml").exists()
    assert labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out").code == 0
    assert first_fit(tmp_path / "out")["parameters"][0]["value"] == pytest.approx(K, rel=1e-6)


def receptance(frequency: np.ndarray) -> np.ndarray:
    omega = 2 * np.pi * frequency
    return np.asarray(1 / (K - MASS * omega**2 + 1j * omega * C))


def variables(name: str) -> dict[str, object]:
    """FRFs as variables of an analyser, in layouts that public files have."""
    frequency = np.arange(0.5, 80.0, 0.5)
    h, time = receptance(frequency), {"x": np.random.default_rng(1).normal(size=900), "fs": 200.0}
    return {
        "beside": {"Freq_domain": frequency, "Recep": h, "PSD": np.abs(h), "Cross_spec": h**2, **time},
        "in one matrix": {"recep_1": np.stack([frequency, h], axis=1)},
        "parts": {"X_recep_Ampl": frequency, "recep_Ampl": np.abs(h), "recep_Phase": np.angle(h), **time},
    }[name]


@pytest.mark.parametrize("layout", ["beside", "in one matrix", "parts"])
def test_frfs_among_variables_are_read_without_a_decision(tmp_path: Path, labpipe, layout: str) -> None:
    """Closed form: K from the FRF that the variables hold; its form is in their name."""
    savemat(tmp_path / "h.mat", variables(layout))
    ended = labpipe("init", tmp_path / "rig", tmp_path / "h.mat")
    text = (tmp_path / "rig/pipeline.yaml").read_text()
    assert ended.code == 0 and "to be decided" not in ended.out and "# a guess, receptance" in text
    ended = labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out")
    assert ended.code == 0, ended
    assert first_fit(tmp_path / "out")["parameters"][0]["value"] == pytest.approx(K, rel=1e-6)


def test_a_table_without_a_header_whose_first_column_counts_hertz(tmp_path: Path, labpipe) -> None:
    frequency = np.arange(0.0, 80.0)
    h = receptance(frequency)
    np.savetxt(tmp_path / "h.txt", np.column_stack([frequency, h.real, h.imag]))
    ended = labpipe("init", tmp_path / "rig", tmp_path / "h.txt")
    assert ended.out.count("pipeline.yaml:") == 1
    text = (tmp_path / "rig/pipeline.yaml").read_text()
    assert "# a guess, frequency [Hz], real and imaginary part" in text
    text = re.sub(f"unit: {DECIDE}.*", "form: receptance", text)
    (tmp_path / "rig/pipeline.yaml").write_text(text)
    assert labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out").code == 0
    # A mode: a table of numbers alone says nothing of points, and without a form there is no stiffness.
    f_n = first_fit(tmp_path / "out")["parameters"][0]
    assert (f_n["name"], f_n["value"]) == ("f_n_1", pytest.approx(np.sqrt(K / MASS) / 2 / np.pi, rel=1e-6))
    np.savetxt(tmp_path / "t.txt", np.column_stack([frequency / 1000, h.real, h.imag]))
    assert labpipe("init", tmp_path / "time", tmp_path / "t.txt").code == 0
    assert (tmp_path / "time/rig.yaml").exists()


def test_a_spike_of_noise_is_no_peak(tmp_path: Path, labpipe) -> None:
    """A mode at 30 Hz beside a higher line of noise at 6 Hz: closed form, the band is that of the mode."""
    f = np.arange(1.0, 60.0, 0.1)
    h = 1e-3 / (30.0**2 - f**2 + 2j * 0.02 * 30.0 * f)
    h[50] = 3e-5
    lines = [f"{a:.1f};{b.real:.9g};{b.imag:.9g}" for a, b in zip(f, h, strict=True)]
    (tmp_path / "h.csv").write_text("f [Hz];re;im\n" + "\n".join(lines) + "\n", encoding="utf-8")
    assert labpipe("init", tmp_path / "p", tmp_path / "h.csv").code == 0
    low, high = re.search(r"band: ([\d.]+)-([\d.]+) Hz", (tmp_path / "p/pipeline.yaml").read_text()).groups()
    assert 24 < float(low) < 30 < float(high) < 36


@pytest.mark.parametrize("n", [50, 900, 5000])
def test_peaks_are_those_of_scipy(n: int) -> None:
    """Of noise, smoothed and not, seeds pinned: by find_peaks with the same prominence and distance."""
    from scipy.signal import find_peaks

    rng = np.random.default_rng(n)
    for smooth in (1, 3, 9):
        mobility = np.convolve(np.exp(2 * rng.normal(size=n)), np.ones(smooth), "same")
        expected, _ = find_peaks(np.log(mobility), prominence=STANDS_OUT, distance=max(n // 400, 1))
        np.testing.assert_array_equal(peaks_of(mobility), expected)


def test_universal_records_of_open_form_take_it_from_their_title(tmp_path: Path, labpipe) -> None:
    """What their label says is not a unit of it, so the unit is asked for; the numbers are those of `K`."""
    frequency = np.arange(1.0, 80.0)
    head = "    -1\n    58\nFrequency Response H1(Desl,Force)\n" + 4 * "NONE\n"
    head += "    4         0    0         0 NONE               1   0 NONE               1   0\n"
    head += f"         5{frequency.size:10d}         1  1.00000E+00  1.00000E+00  0.00000E+00\n"
    for kind, label in ((18, "NONE"), (0, "Volts"), (12, "NONE"), (0, "NONE")):
        head += f"{kind:10d}    0    0    0 {label:<21}{'V' if label == 'Volts' else 'NONE'}\n"
    values = "".join(f"{h.real:13.5e}{h.imag:13.5e}\n" for h in receptance(frequency))
    (tmp_path / "h.uff").write_text(head + values + "    -1\n")
    ended = labpipe("init", tmp_path / "rig", tmp_path / "h.uff")
    text = (tmp_path / "rig/pipeline.yaml").read_text()
    assert ended.code == 0 and "form: receptance" in text and "the records say V" in text
    (tmp_path / "rig/pipeline.yaml").write_text(re.sub(f"unit: {DECIDE}.*", "unit: m/N", text))
    assert labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out").code == 0
    assert first_fit(tmp_path / "out")["parameters"][0]["value"] == pytest.approx(K, rel=1e-4)


@pytest.mark.parametrize("layout", ["lists", "info", "names of a matrix"])
def test_units_and_names_beside_the_channels_are_read(tmp_path: Path, labpipe, layout: str) -> None:
    """As analysers export them: nothing is left to decide, and the fit is that of the recording."""
    force, y = signals()
    info = "Signal X1, Real EU N\nSignal X2, Real EU um"
    beside = {
        "lists": {"X1": force, "X2": 1e6 * y, "Unit": np.array(["N", "um"], object)},
        "info": {"X1": force, "X2": 1e6 * y, "DP_Info": info},
        "names of a matrix": {
            "signals": np.stack([force, 1e6 * y], axis=1),
            "channel_names": np.array(["hammer", "probe"], object),
            "units": np.array(["N", "um"], object),
        },
    }[layout]
    savemat(tmp_path / "run.mat", {**beside, "fs": RATE})
    ended = labpipe("init", tmp_path / "rig", tmp_path / "run.mat")
    assert ended.code == 0 and "to be decided" not in ended.out
    ended = labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out")
    assert ended.code == 0, ended
    k = first_fit(tmp_path / "out")["parameters"][0]
    assert k["ci95"][0] <= K <= k["ci95"][1]


def test_a_channel_with_the_shape_of_hits_is_a_hammer(tmp_path: Path, labpipe) -> None:
    force = np.zeros(8000)
    force[[100, 4100]] = 50.0
    ringing = np.convolve(force, np.exp(-np.arange(900) / 90) * np.sin(np.arange(900) / 3))[:8000]
    savemat(tmp_path / "run.mat", {"ch1": force, "ch2": ringing, "fs": 1000.0})
    assert labpipe("init", tmp_path / "rig", tmp_path / "run.mat").code == 0
    lines = (tmp_path / "rig/rig.yaml").read_text().splitlines()
    (first,) = [line for line in lines if line.startswith("  ch1:")]
    assert "quantity: force" in first and "a force by its hits, which is a guess" in first
    assert "excitation: impact" in (tmp_path / "rig/pipeline.yaml").read_text()


def test_the_tracks_of_a_sound_file_ask_for_their_sensors(tmp_path: Path, labpipe) -> None:
    """A hammer and the acceleration of a mass in closed form as shares of full scale: what each share is, and
    what the second track measures, is all that is asked for.
    """
    w = 2 * np.pi * np.fft.rfftfreq(32_000, 1 / RATE)
    force = np.convolve(np.arange(32_000) % 4000 == 200, [50.0, 100.0, 50.0])[:32_000]
    acceleration = np.fft.irfft(-(w**2) / (K - MASS * w**2 + 1j * w * C) * np.fft.rfft(force))
    shares = 0.5 / np.max(np.abs(np.stack([force, acceleration])), axis=1)
    noise = 2e-5 * np.random.default_rng(2).normal(size=(force.size, 2))
    tracks = np.column_stack([force, acceleration]) * shares + noise
    wavfile.write(tmp_path / "run.wav", int(RATE), np.int16(tracks * 32767))
    assert labpipe("init", tmp_path / "rig", tmp_path / "run.wav").code == 0
    rig, pipeline = tmp_path / "rig/rig.yaml", tmp_path / "rig/pipeline.yaml"
    text = rig.read_text().replace(f"quantity: {DECIDE}", "quantity: acceleration")
    for share, unit in zip(shares, ("N", "(m/s^2)"), strict=True):
        text = text.replace(f"sensitivity: {DECIDE}", f"sensitivity: {share} 1/{unit}", 1)
    rig.write_text(text)
    assert MARK not in pipeline.read_text()
    assert labpipe("run", pipeline, "-o", tmp_path / "out").code == 0
    assert first_fit(tmp_path / "out")["parameters"][0]["value"] == pytest.approx(K, rel=2e-3)


def test_inspect_takes_a_first_column_of_even_steps_for_the_time(tmp_path: Path, labpipe) -> None:
    np.savetxt(
        tmp_path / "r.csv",
        np.column_stack([np.arange(500) / 250, np.sin(np.arange(500))]),
        delimiter=",",
        header="abscissa,y [um]",
        comments="",
    )
    assert "250 samples per unit of 'abscissa'" in labpipe("inspect", tmp_path / "r.csv").out


def test_tables_of_several_points_ask_where_the_dofs_stand(tmp_path: Path, labpipe) -> None:
    for name in ("h_x_f.txt", "h_y_g.txt"):
        frf_table(tmp_path / name)
    assert labpipe("init", tmp_path / "rig", tmp_path / "h_x_f.txt", tmp_path / "h_y_g.txt").code == 0
    text = (tmp_path / "rig/pipeline.yaml").read_text()
    assert 'each: ["../h_x_f.txt", "../h_y_g.txt"]' in text and f"pattern: {DECIDE}" in text


@pytest.mark.parametrize(
    ("names", "pattern"),
    [
        (("h_x_f", "h_y_f"), "h_{output}_f"),
        (("9", "10", "11"), "{output}"),
        (("run p9", "run p10"), "run p{output}"),
        (("1", "1a"), "{output}"),
    ],
)
def test_names_that_differ_in_one_part_are_its_dofs(
    tmp_path: Path, labpipe, names: Sequence[str], pattern: str
) -> None:
    for name in names:
        frf_table(tmp_path / f"{name}.txt")
    assert labpipe("init", tmp_path / "rig", *(tmp_path / f"{name}.txt" for name in names)).code == 0
    text = (tmp_path / "rig/pipeline.yaml").read_text()
    assert f'pattern: "{pattern}"' in text and DECIDE not in text.replace("unit: DECIDE", "")
    text = re.sub(rf"unit: {DECIDE}.*", "unit: um/N", text)
    (tmp_path / "rig/pipeline.yaml").write_text(text)
    assert labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out").code == 0


def test_what_an_analyser_stored_beside_the_channels_is_named_as_not_used(tmp_path: Path, labpipe) -> None:
    force, y = signals()
    windowed = y * np.exp(-np.arange(y.size) / 500)
    savemat(
        tmp_path / "run.mat",
        {"fs": RATE, "force": force, "probe_y": y, "probe_y_window": windowed, "coherence": np.ones(99)},
    )
    assert labpipe("init", tmp_path / "rig", tmp_path / "run.mat").code == 0
    text = (tmp_path / "rig/rig.yaml").read_text()
    assert "# not used: probe_y_window: a windowed copy of probe_y" in text
    assert (
        f"# not used: coherence: 99 values, the channels have {y.size}" in text and text.count("column:") == 2
    )


@pytest.mark.parametrize(
    ("column", "window", "warned"), [("y", True, True), ("y", False, False), ("y_window", True, False)]
)
def test_a_window_that_only_the_copy_of_a_channel_has_is_named(
    tmp_path: Path, labpipe, column: str, window: bool, warned: bool
) -> None:
    """The damping comes out as C on the raw channel without `windowed`, and on its copy with it; the window
    of 0.2 s takes 2 m / 0.2 s off it where only the copy has it.
    """
    t = np.arange(2000) / RATE
    force = np.where((t > 0.05) & (t < 0.053), 1000.0, 0.0)
    omega, decay = np.sqrt(K / MASS - (C / 2 / MASS) ** 2), C / 2 / MASS
    y = np.convolve(force / RATE, np.exp(-decay * t) * np.sin(omega * t) / MASS / omega)[: t.size]
    window_of_analyser = np.exp(-(t - 0.05) / 0.2)
    files = {"fs": RATE, "f": force * window_of_analyser, "y": y, "y_window": y * window_of_analyser}
    savemat(tmp_path / "run.mat", files)
    (tmp_path / "rig.yaml").write_text(
        "name: Bench\nchannels:\n  f: {quantity: force, unit: N, role: input, dof: x}\n"
        f"  y: {{column: {column}, quantity: displacement, unit: m, role: output, dof: x}}\n"
    )
    stated = ", windowed: {exponential: 0.2 s}" if window else ""
    (tmp_path / "p.yaml").write_text(
        "title: Hit\nrig: rig.yaml\nrecordings: run.mat\n"
        f"frf: {{excitation: impact, block: 2 s, band: 5-100 Hz{stated}}}\n"
        "identify: {fit: {model: sdof, input: f, output: y, band: 20-45 Hz}}\n"
    )
    ended = labpipe("run", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert ended.code == 0, ended
    assert ("not-windowed" in ended.out + ended.err) == warned
    c = first_fit(tmp_path / "out")["parameters"][1]["value"]
    assert c == pytest.approx(C - 2 * MASS / 0.2 if warned else C, rel=0.03)


@pytest.mark.parametrize(("sign", "model"), [(1, "sdof"), (-1, "modal")])
def test_a_response_whose_phase_denies_one_point_is_a_mode(
    tmp_path: Path, labpipe, sign: int, model: str
) -> None:
    """A sensor the wrong way round, or at another place: the frequency is right, nothing is unphysical."""
    force, y = signals()
    savemat(
        tmp_path / "run.mat", {"X1": force, "X2": sign * y, "Unit": np.array(["N", "m"], object), "fs": RATE}
    )
    assert labpipe("init", tmp_path / "rig", tmp_path / "run.mat").code == 0
    assert f"model: {model}" in (tmp_path / "rig/pipeline.yaml").read_text()
    ended = labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out")
    assert ended.code == 0 and "unphysical" not in ended.out + ended.err
    (f_n,) = [p for p in first_fit(tmp_path / "out")["parameters"] if p["name"] in ("f_n", "f_n_1")]
    assert f_n["ci95"][0] <= np.sqrt(K / MASS) / 2 / np.pi <= f_n["ci95"][1]


def test_responses_that_die_away_without_a_force_are_a_ring_down(tmp_path: Path, labpipe) -> None:
    """Two releases of the mass on its spring: nothing is left to decide, and the pole is that of C and K."""
    t, omega, decay = np.arange(4000) / RATE, np.sqrt(K / MASS), C / 2 / MASS
    one = np.exp(-decay * t) * np.cos(np.sqrt(omega**2 - decay**2) * t)
    y = np.tile(one, 2) + 1e-4 * np.random.default_rng(5).normal(size=8000)
    table = np.column_stack([np.arange(8000) / RATE, y])
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header="t [s],probe [mm]", comments="")
    ended = labpipe("init", tmp_path / "rig", tmp_path / "r.csv")
    assert ended.code == 0 and "to be decided" not in ended.out
    assert labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out").code == 0
    f_n, zeta = first_fit(tmp_path / "out")["parameters"][:2]
    assert f_n["value"] == pytest.approx(omega / 2 / np.pi, rel=1e-3)
    assert zeta["value"] == pytest.approx(decay / omega, rel=0.02)


def test_a_run_with_a_tacho_and_no_force_is_followed_by_orders(tmp_path: Path, labpipe) -> None:
    """A run-up through a resonance dies away after its peak, and is no ring-down."""
    t = np.arange(8000) / RATE
    turns = 5 * t + 2 * t**2
    y = np.sin(2 * np.pi * turns) / (1 + (turns / t.max() / 10 - 1) ** 2)
    table = np.column_stack([t, y, np.where(turns % 1 < 0.2, 5.0, 0.0)])
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header="t [s],probe [um],tacho [V]", comments="")
    ended = labpipe("init", tmp_path / "rig", tmp_path / "r.csv")
    assert ended.code == 0 and f"next: labpipe orders {tmp_path / 'r.csv'} -r" in ended.out
    text = (tmp_path / "rig/pipeline.yaml").read_text()
    assert (
        "labpipe orders ../r.csv -r rig.yaml --tacho tacho -o orders" in text and "model: decay" not in text
    )


def test_runs_of_roving_sensors_are_one_matrix_by_the_dofs_in_their_files(tmp_path: Path, labpipe) -> None:
    """Two masses on three springs k, accelerances in closed form: modes at w0 and w0 sqrt 3, one of the runs
    for each mass. A second recording of the same point is a test of its own.
    """
    w, zeta = 2 * np.pi * np.arange(5.0, 100.0, 0.1), 0.01
    modes = [-(w**2) / (w0**2 - w**2 + 2j * zeta * w0 * w) / 2 for w0 in 60 * np.pi * np.sqrt([1, 3])]
    records = [
        {
            "type": 58, "func_type": 4, "rsp_node": node, "rsp_dir": 3, "ref_node": 1, "ref_dir": 3,
            "data": data, "x": w / 2 / np.pi, "abscissa_spacing": 1, "abscissa_spec_data_type": 18,
            "ordinate_spec_data_type": 12, "orddenom_spec_data_type": 13,
        }
        for node, data in ((1, modes[0] + modes[1]), (2, modes[0] - modes[1]), (1, modes[0] + modes[1]))
    ]  # fmt: skip
    files = [tmp_path / f"run{number}.uff" for number in (1, 2, 3)]
    for file, record in zip(files, records, strict=True):
        pyuff.UFF(str(file)).write_sets([record], "add")
    ended = labpipe("init", tmp_path / "rig", *files[:2])
    assert ended.code == 0 and "to be decided" not in ended.out
    assert labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out").code == 0
    values = {one["name"]: one["value"] for one in first_fit(tmp_path / "out")["parameters"]}
    assert [values["f_n_1"], values["f_n_2"]] == pytest.approx([30.0, 30 * np.sqrt(3)], rel=1e-6)
    assert labpipe("init", tmp_path / "again", files[0], files[2]).code == 0
    assert "tests:" in (tmp_path / "again/pipeline.yaml").read_text()


def test_conjugate_frfs_and_responses_without_a_mode_are_seen(tmp_path: Path, labpipe) -> None:
    """Accelerance of one mode at 30 Hz in closed form, stored as its conjugate, beside a channel of noise."""
    f, rng = np.arange(1.0, 100.0, 0.1), np.random.default_rng(8)
    h = -(f**2) / (30.0**2 - f**2 + 2j * 0.01 * 30.0 * f)
    noise = 1e-3 * rng.normal(size=(f.size, 2)) @ [1, 1j]
    contents = {"Freq_domain": f, "Hf_chan_2": h.conj() + noise, "Hf_chan_3": noise[::-1]}
    savemat(tmp_path / "h.mat", contents)
    assert labpipe("init", tmp_path / "p", tmp_path / "h.mat").code == 0
    path = tmp_path / "p/pipeline.yaml"
    text = path.read_text()
    assert "  conjugate: true" in text and "# no peak of 3 looks like a mode" in text
    path.write_text(re.sub(f"unit: {DECIDE}.*", "unit: m/(N.s^2)", text))
    assert labpipe("run", path, "-o", tmp_path / "out").code == 0
    f_n, zeta = first_fit(tmp_path / "out")["parameters"][:2]
    assert f_n["value"] == pytest.approx(30.0, rel=1e-4) and zeta["value"] == pytest.approx(0.01, rel=0.01)


def test_channels_of_one_quantity_are_one_decision(tmp_path: Path, labpipe) -> None:
    """Two accelerometers on a mass that is released, without a unit: one marked line."""
    t, omega, decay = np.arange(4000) / RATE, np.sqrt(K / MASS), C / 2 / MASS
    a = np.exp(-decay * t) * np.cos(np.sqrt(omega**2 - decay**2) * t)
    a = a + 1e-4 * np.random.default_rng(5).normal(size=a.size)
    savemat(tmp_path / "r.mat", {"fs": RATE, "acc_1": a, "acc_2": 0.7 * a + 0.1 * a[::-1]})
    ended = labpipe("init", tmp_path / "rig", tmp_path / "r.mat")
    assert "to be decided" in ended.out and ended.out.count("rig.yaml:") == 1
    path = tmp_path / "rig/rig.yaml"
    path.write_text(path.read_text().replace(DECIDE, "m/s^2"))
    channels = load_pipeline(tmp_path / "rig/pipeline.yaml").tests[0].recordings[0].rig.channels
    assert [channel.unit for channel in channels] == 2 * ["m/s^2"]


@pytest.mark.parametrize(("axes", "model"), [("x", "sdof"), ("xy", "dynamic-stiffness")])
def test_displacement_and_acceleration_of_one_force_run_as_they_are(
    tmp_path: Path, labpipe, axes: str, model: str
) -> None:
    """The acceleration of a mass beside its displacement is a reference, which may be of one point; k
    is the closed form's. In two directions they are those of a stator.
    """
    force, y = signals()
    columns = {"t [s]": np.arange(y.size) / RATE, "force [N]": force}
    for axis, motion in zip(axes, (y, y - 0.1 * force / K), strict=False):
        acceleration = np.gradient(np.gradient(motion)) * RATE**2
        columns |= {f"disp {axis} [m]": motion, f"acc {axis} [m/s^2]": acceleration}
    rows = np.column_stack(list(columns.values()))
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header=",".join(columns), comments="")
    assert labpipe("init", tmp_path / "rig", tmp_path / "run.csv").code == 0
    pipeline = tmp_path / "rig/pipeline.yaml"
    assert f"model: {model}" in pipeline.read_text()
    assert ("# Not among the FRFs: acc_x," in pipeline.read_text()) == (model == "sdof")
    if model == "sdof":
        assert labpipe("run", pipeline, "-o", tmp_path / "out").code == 0
        assert first_fit(tmp_path / "out")["parameters"][0]["value"] == pytest.approx(K, rel=1e-3)


def noise_through(h: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """60 s of noise, and what the responses *h* (n_channel, n_line) make of its whole record."""
    force = rng.normal(size=60_000)
    motion = np.fft.irfft(h * np.fft.rfft(force), force.size)
    return force, (motion + 1e-4 * np.std(motion) * rng.normal(size=motion.shape)).T


def test_sensors_in_one_direction_are_one_modal_test(tmp_path: Path, labpipe) -> None:
    """Two modes at four points in closed form, all measured along z: one fit of all, no decision."""
    w, rng = 2 * np.pi * np.fft.rfftfreq(60_000, 1 / RATE), np.random.default_rng(3)
    h = np.zeros((4, w.size), complex)
    for f_n, shape in ((40.0, [1, 0.8, 0.6, 0.4]), (90.0, [1, -0.5, -0.8, 0.6])):
        pole = (2 * np.pi * f_n) ** 2 - w**2 + 2j * 0.01 * 2 * np.pi * f_n * w
        h += np.outer(shape, -(w**2) / pole)
    force, motion = noise_through(h, rng)
    names = ["t [s]", "force [N]", *(f"P{number}+Z [m/s^2]" for number in range(1, 5))]
    rows = np.column_stack([np.arange(force.size) / RATE, force, motion])
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header=",".join(names), comments="", fmt="%.8g")
    ended = labpipe("init", tmp_path / "rig", tmp_path / "run.csv")
    assert "to be decided" not in ended.out
    assert labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out").code == 0
    values = {one["name"]: one["value"] for one in first_fit(tmp_path / "out")["parameters"]}
    assert [values["f_n_1"], values["f_n_2"]] == pytest.approx([40.0, 90.0], rel=1e-4)
    channels = load_pipeline(tmp_path / "rig/pipeline.yaml").tests[0].recordings[0].rig.channels
    assert len({channel.channel.dof for channel in channels}) == 5


def test_an_acceleration_that_is_a_base_by_its_name_drives(tmp_path: Path, labpipe) -> None:
    """Transmissibility of a mass on a spring in closed form: its frequency without a decision."""
    w, rng = 2 * np.pi * np.fft.rfftfreq(60_000, 1 / RATE), np.random.default_rng(3)
    spring = K + 1j * w * C
    base, (mass,) = (part.T for part in noise_through((spring / (spring - MASS * w**2))[None], rng))
    columns = {"Table acc [m/s^2]": base, "Top acc [m/s^2]": mass, "t [s]": np.arange(base.size) / RATE}
    rows = np.column_stack(list(columns.values()))
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header=",".join(columns), comments="", fmt="%.8g")
    ended = labpipe("init", tmp_path / "rig", tmp_path / "run.csv")
    assert "to be decided" not in ended.out
    assert labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out").code == 0
    values = {one["name"]: one["value"] for one in first_fit(tmp_path / "out")["parameters"]}
    assert values["f_n"] == pytest.approx(np.sqrt(K / MASS) / (2 * np.pi), rel=1e-3)


def test_dwells_at_one_frequency_after_another_are_a_stepped_sine(tmp_path: Path, labpipe) -> None:
    """The steady motion of a mass on a spring in closed form, 8 s at each of 13 frequencies."""
    t, rng = np.arange(8000) / RATE, np.random.default_rng(6)
    rows = []
    for omega in 2 * np.pi * np.arange(26.0, 39.0):
        sine = np.exp(1j * omega * t)
        rows.append(np.stack([sine.imag, (sine / (K - MASS * omega**2 + 1j * C * omega)).imag], axis=1))
    signals = np.concatenate(rows)
    signals += rng.normal(size=signals.shape) * [1e-3, 1e-7]
    savemat(tmp_path / "r.mat", {"fs": RATE, "force": signals[:, 0], "probe": signals[:, 1]})
    assert labpipe("init", tmp_path / "rig", tmp_path / "r.mat").code == 0
    decide(tmp_path / "rig", {"force.unit": "N", "probe.unit": "m"})
    pipeline = tmp_path / "rig/pipeline.yaml"
    assert "excitation: stepped-sine     # 13 dwells" in pipeline.read_text()
    assert labpipe("run", pipeline, "-o", tmp_path / "out").code == 0
    assert first_fit(tmp_path / "out")["parameters"][0]["value"] == pytest.approx(K, rel=1e-3)


def test_two_forces_along_two_responses_are_a_rotor(tmp_path: Path, labpipe) -> None:
    """Noise in both directions on coupled springs, motion by the closed form of the whole record: all that is
    asked for is the mass.
    """
    stiffness, rng = np.array([[K, 8e3], [-8e3, 1.2 * K]]), np.random.default_rng(4)
    force, omega = rng.normal(size=(60_000, 2)), 2 * np.pi * np.fft.rfftfreq(60_000, 1 / RATE)[:, None, None]
    dynamic = stiffness + (1j * omega * C - omega**2 * MASS) * np.eye(2)
    motion = np.fft.irfft(np.linalg.solve(dynamic, np.fft.rfft(force, axis=0)[..., None])[..., 0], axis=0)
    motion += 1e-9 * rng.normal(size=motion.shape)
    columns = dict(zip(("Fx", "Fy", "x", "y"), np.hstack([force, motion]).T, strict=True))
    savemat(tmp_path / "r.mat", {"fs": RATE, **columns})
    assert labpipe("init", tmp_path / "rig", tmp_path / "r.mat").code == 0
    rig, pipeline = tmp_path / "rig/rig.yaml", tmp_path / "rig/pipeline.yaml"
    units = rig.read_text().replace("&displacement DECIDE", "m").replace("*displacement", "m")
    rig.write_text(units.replace("&force DECIDE", "N").replace("*force", "N"))
    pipeline.write_text(pipeline.read_text().replace("mass: DECIDE", f"mass: {MASS} kg"))
    assert labpipe("run", pipeline, "-o", tmp_path / "out").code == 0
    values = {one["name"]: one["value"] for one in first_fit(tmp_path / "out")["parameters"]}
    found = [values[name] for name in ("k_xx", "k_xy", "k_yx", "k_yy")]
    assert found == pytest.approx(stiffness.ravel().tolist(), rel=0.01)


def test_one_force_after_the_other_gives_one_matrix(tmp_path: Path, labpipe) -> None:
    """Shaken along x, then along y, the sensor of the idle force shows noise: the two files are one rotor's
    FRFs, not tests of which each lacks half. Motion as above.
    """
    stiffness, rng = np.array([[K, 3e3], [-3e3, 1.2 * K]]), np.random.default_rng(5)
    omega = 2 * np.pi * np.fft.rfftfreq(60_000, 1 / RATE)[:, None, None]
    dynamic = stiffness + (1j * omega * C - omega**2 * MASS) * np.eye(2)
    files = [tmp_path / "b.npz", tmp_path / "a.npz"]
    for direction, file in enumerate(files):
        force = rng.normal(size=(60_000, 2)) * np.eye(2)[direction]
        motion = np.fft.irfft(np.linalg.solve(dynamic, np.fft.rfft(force, axis=0)[..., None])[..., 0], axis=0)
        force += 1e-3 * rng.normal(size=force.shape)
        columns = zip(("fx", "fy", "x", "y"), np.hstack([force, motion]).T, strict=True)
        np.savez(file, fs=RATE, **dict(columns))
    assert labpipe("init", tmp_path / "rig", *files).code == 0
    rig, pipeline = tmp_path / "rig/rig.yaml", tmp_path / "rig/pipeline.yaml"
    units = rig.read_text().replace("&displacement DECIDE", "m").replace("*displacement", "m")
    rig.write_text(units.replace("&force DECIDE", "N").replace("*force", "N"))
    text = pipeline.read_text().replace("mass: DECIDE", f"mass: {MASS} kg")
    assert 'recordings: ["../b.npz", "../a.npz"]' in text and "tests:" not in text
    pipeline.write_text(text)
    assert labpipe("run", pipeline, "-o", tmp_path / "out").code == 0
    values = {one["name"]: one["value"] for one in first_fit(tmp_path / "out")["parameters"]}
    found = [values[name] for name in ("k_xx", "k_xy", "k_yx", "k_yy")]
    assert found == pytest.approx(stiffness.ravel().tolist(), rel=0.01)


@pytest.mark.parametrize("same", [True, False])
def test_two_periodic_forces_need_both_recordings_and_a_force_of_its_own_a_test(
    tmp_path: Path, labpipe, same
):
    """[u, v] and [u, -v] are a matrix of forces of rank two, either alone of rank one. Files with the column
    of one force each are of two kinds, which one rig file cannot hold: tests.
    """
    noise = np.random.default_rng(6)
    periods = np.tile(noise.normal(size=(PERIOD, 2)), (REPEATS, 1))
    files = [tmp_path / f"{name}.npz" for name in ("plus", "minus")]
    for number, file in enumerate(files):
        forces = dict(zip(("fx", "fy"), (periods * [1, 1 - 2 * number]).T, strict=True))
        motion = {"x": periods[:, 0], "y": periods[:, 1] * (1 - 2 * number)}
        np.savez(file, fs=RATE, **(forces if same else {("fx", "fy")[number]: periods[:, 0]}), **motion)
    assert labpipe("init", tmp_path / "rig", *files).code == 0
    text = (tmp_path / "rig/pipeline.yaml").read_text()
    assert ('recordings: ["../plus.npz", "../minus.npz"]' in text) is same and ("tests:" in text) is not same


def test_blocks_of_random_excitation_are_long_enough_for_the_peak(tmp_path: Path, labpipe) -> None:
    """1024 samples at 10 Hz of a mode 0.08 Hz wide: sixteenths of the record have 0.2 Hz between lines.

    The response by the exact step of the mode under a force that is held, 1 / (0.04 s^2 + 0.02 s + 1).
    """
    from scipy.signal import cont2discrete, lfilter

    rng = np.random.default_rng(3)
    force = rng.normal(size=1024)
    b, a, _ = cont2discrete(([1.0], [0.04, 0.02, 1.0]), 0.1)
    y = lfilter(np.ravel(b), a, np.concatenate([rng.normal(size=500), force]))[500:]
    savemat(tmp_path / "r.mat", {"x": y, "f": force, "dt": 0.1})
    assert labpipe("init", tmp_path / "rig", tmp_path / "r.mat").code == 0
    assert "block: 20 s" in (tmp_path / "rig/pipeline.yaml").read_text()


def test_a_drift_below_short_decays_hides_no_mode(tmp_path: Path, labpipe) -> None:
    """Ten taps of a mode at 20 Hz and 5 %, on a drift that is larger: the band is around the mode."""
    t, omega = np.arange(1500) / RATE, 2 * np.pi * 20.0
    tap = np.exp(-0.05 * omega * t) * np.cos(omega * np.sqrt(1 - 0.05**2) * t)
    drift = np.cumsum(np.random.default_rng(2).normal(size=10 * t.size)) / 50
    y = np.tile(tap, 10) + drift + 1e-4 * np.random.default_rng(5).normal(size=10 * t.size)
    table = np.column_stack([np.arange(y.size) / RATE, y])
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header="t [s],probe [mm]", comments="")
    assert "to be decided" not in labpipe("init", tmp_path / "rig", tmp_path / "r.csv").out
    band = re.search(r"band: ([\d.]+)-([\d.]+) Hz", (tmp_path / "rig/pipeline.yaml").read_text())
    assert band is not None and float(band[1]) < 20 < float(band[2]) < 40


def test_a_band_around_a_short_decay_has_the_lines_that_its_fit_asks_for(tmp_path: Path, labpipe) -> None:
    """7.9 Hz with 4.5 % of damping, gone in 23 periods: 18 lines lay in the band of two fifths to either
    side, and the fit refused them.
    """
    t, omega, rng = np.arange(10241) / 2048, 2 * np.pi * 7.9, np.random.default_rng(3)
    y = 130 * np.exp(-0.045 * omega * t) * np.cos(omega * t) + rng.normal(size=t.size)
    np.savetxt(
        tmp_path / "r.csv", np.column_stack([t, y]), delimiter=",", header="t [s],acc [m/s^2]", comments=""
    )
    assert "to be decided" not in labpipe("init", tmp_path / "rig", tmp_path / "r.csv").out
    ran = labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out")
    assert ran.code == 0 and "7.90" in ran.out  # 7.9 sqrt(1 + .045^2) = 7.908 Hz


def test_what_cannot_be_read_is_refused_and_nothing_is_written(tmp_path: Path, labpipe) -> None:
    (tmp_path / "notes.txt").write_text("no numbers here\n")
    for path, what in (
        (tmp_path / "notes.txt", "no row of numbers"),
        (tmp_path / "gone.csv", "no such file"),
    ):
        ended = labpipe("init", tmp_path / "rig", path)
        assert ended.code == 2 and what in ended.err and not (tmp_path / "rig").exists()


NAMES = [
    ("Force [N]", "N", ("force", "N", "input", "")),
    ("y [V]", "V", ("displacement", "V", "output", DECIDE)),
    ("acc_x", "", ("acceleration", DECIDE, "output", "")),
    ("Voltage_0", "V", ("voltage", "V", "reference", "")),
    ("tacho", "", ("tacho", "V", "reference", "")),
    ("1+Z", "m/s^2", ("acceleration", "m/s^2", "output", "")),
    ("channel 3", "", (DECIDE, DECIDE, "", "")),
    ("T oil", "degC", ("temperature", "degC", "reference", "")),
    ("x", "furlong", ("displacement", "furlong", "output", "")),
]


@pytest.mark.parametrize(("name", "unit", "expected"), NAMES)
def test_what_a_name_and_a_unit_say(name: str, unit: str, expected: tuple[str, ...]) -> None:
    (channel,) = guess_channels([name], {name: unit} if unit else {})
    assert (channel.quantity, channel.unit, channel.role, channel.sensitivity) == expected


def test_directions_and_keys_come_from_the_names() -> None:
    names = ["Acc X", "Acc Y", "Hammer (modal) [N]", "3", "acc x"]
    channels = guess_channels(names, {})
    assert [channel.key for channel in channels] == ["acc_x", "acc_y", "hammer", "ch_3", "acc_x_2"]
    assert [channel.dof for channel in channels] == ["x", "y", "hammer", "ch_3", "x"]
    force, _ = guess_channels(["force", "probe z"], {"force": "N", "probe z": "um"})
    assert force.dof == "z"


def test_time_axes_are_columns_of_even_steps() -> None:
    t = np.arange(50) / 20
    rows = np.column_stack([t, np.sin(t), t**2, t[::-1]])
    assert time_columns(["t", "sin", "square", "down"], rows) == ["t"]


def test_the_samples_of_every_example_are_part_of_the_package(root: Path) -> None:
    listed = (root / "pyproject.toml").read_text()
    for folder in (path for path in (root / "sample_data").iterdir() if path.is_dir()):
        assert f'"share/labpipe/sample_data/{folder.name}"' in listed


def test_examples_are_listed_and_an_unknown_one_is_refused(tmp_path: Path, labpipe) -> None:
    ended = labpipe("init", "--example", "list")
    assert ended.code == 0 and re.search(r"^hmb: .*pedestal", ended.out, re.M)
    assert labpipe("init").err == "error: Missing argument 'DIR'; see 'labpipe init --help'\n"
    ended = labpipe("init", tmp_path / "x", "--example", "hnb")
    assert ended.code == 2 and "did you mean 'hmb'?" in ended.err and not (tmp_path / "x").exists()
    ended = labpipe("init", tmp_path / "x", "a.csv", "--example", "hmb")
    assert ended.code == 2 and "has its own recordings" in ended.err


@pytest.mark.parametrize("name", sorted(examples()))
def test_every_example_is_whole_where_it_is_copied(tmp_path: Path, labpipe, name: str) -> None:
    assert labpipe("init", tmp_path / "x", "--example", name).code == 0
    copied = sorted((tmp_path / "x/pipelines").glob("*.yaml"))
    assert [path.name for path in copied] == sorted(path.name for path in examples()[name])
    for path in copied:
        load_pipeline(path)
    ended = labpipe("init", tmp_path / "x", "--example", name)
    assert ended.code == 2 and "already holds pipelines" in ended.err


def test_an_example_runs_as_it_is(tmp_path: Path, labpipe) -> None:
    labpipe("init", tmp_path / "x", "--example", "hmb")
    assert labpipe("check", tmp_path / "x/pipelines/pedestal.yaml").code == 0


def test_a_swept_sine_is_evaluated_as_one(tmp_path: Path, labpipe) -> None:
    """One linear sweep over the resonance of `signals`, whose motion is the closed form's; K is held."""
    n = np.arange(30000)
    force = np.where(n < 20000, np.sin(2 * np.pi * (5 * n / RATE + 70 / 20 * (n / RATE) ** 2 / 2)), 0.0)
    frequency = np.fft.rfftfreq(2 * n.size, 1 / RATE)
    y = np.fft.irfft(np.fft.rfft(force, 2 * n.size) * receptance(frequency))[: n.size]
    y += 0.01 * y.std() * np.random.default_rng(4).normal(size=y.size)
    savemat(tmp_path / "run.mat", {"F": force, "y": y, "fs": RATE, "Unit": np.array(["N", "m"], object)})
    ended = labpipe("init", tmp_path / "rig", tmp_path / "run.mat")
    text = (tmp_path / "rig/pipeline.yaml").read_text()
    assert "to be decided" not in ended.out and "excitation: sweep" in text and "block" not in text
    assert labpipe("run", tmp_path / "rig/pipeline.yaml", "-o", tmp_path / "out").code == 0
    k = first_fit(tmp_path / "out")["parameters"][0]
    assert k["ci95"][0] <= K <= k["ci95"][1]


def test_peaks_that_are_close_or_at_an_end_have_bands_that_a_modal_fit_takes(tmp_path: Path, labpipe) -> None:
    """Modes at lines 6, 150, 160, 170 and 388 of 400: bands of 26 lines and more, which hold their modes."""
    frequency = np.arange(1.0, 401.0)
    s = 2j * np.pi * frequency
    modes = [2 * np.pi * f * (-0.004 + 1j) for f in (6.0, 150.0, 160.0, 170.0, 388.0)]
    for point in (1, 2):
        h = sum(1 / (s - pole) + 1 / (s - np.conj(pole)) for pole in modes)
        columns = np.column_stack([frequency, (h * point).real, (h * point).imag])
        np.savetxt(tmp_path / f"{point}.txt", columns, header="freq[Hz] re[m/N] im[m/N]", comments="")
    assert labpipe("init", tmp_path / "rig", tmp_path / "1.txt", tmp_path / "2.txt").code == 0
    text = (tmp_path / "rig/pipeline.yaml").read_text()
    bands = [tuple(map(float, band)) for band in re.findall(r"band: ([\d.]+)-([\d.]+) Hz", text)]
    assert all(any(low < f < high for low, high in bands) for f in (6, 150, 160, 170, 388)), bands
    assert all(np.sum((frequency >= low) & (frequency <= high)) >= 24 for low, high in bands)


def test_a_force_and_its_response_in_two_files_are_one_run(tmp_path: Path, labpipe) -> None:
    """A vibrometer writes each signal to a file of its own, under one name; two forces are two tests."""
    files = tmp_path / "force.txt", tmp_path / "motion.txt"
    head = "Point Index:\t1\nSignal:\t{}\n\nTime\tTime Signal\n[ s ]\t[ {} ]\n"
    for file, unit, signal in zip(files, ("N", "m"), signals(), strict=True):
        rows = "".join(f"{n / RATE:g}\t{value:.8g}\n" for n, value in enumerate(signal))
        file.write_text(head.format(file.stem, unit) + rows, encoding="utf-8")
    assert labpipe("init", tmp_path / "one", *files).code == 0
    pipeline = (tmp_path / "one/pipeline.yaml").read_text()
    assert 'recordings: {join: ["../force.txt", "../motion.txt"]}' in pipeline and MARK not in pipeline
    assert labpipe("run", tmp_path / "one/pipeline.yaml", "-o", tmp_path / "out").code == 0
    result = json.loads((tmp_path / "out/identification.json").read_text())["fits"][0]["parameters"]
    value = {parameter["name"]: parameter["value"] for parameter in result}["f_n"]
    assert value == pytest.approx(np.sqrt(K / MASS) / (2 * np.pi), rel=1e-3)
    (tmp_path / "again.txt").write_bytes(files[0].read_bytes())
    assert labpipe("init", tmp_path / "two", files[0], tmp_path / "again.txt").code == 0
    assert "tests:" in (tmp_path / "two/pipeline.yaml").read_text()
