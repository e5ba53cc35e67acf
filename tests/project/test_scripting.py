"""What scripts and notebooks call: one door for files, pipelines, things by name, and how results read and
tabulate.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat, wavfile

import labpipe
from labpipe.bearings.kinds import BEARINGS
from labpipe.raw_files.frf_csv import write_frf_csv
from labpipe.raw_files.uff_write import write_frf_uff
from labpipe.records.finding import Finding
from labpipe.records.identification import Fit, Goodness
from labpipe.simulate.virtual_rigs import VIRTUAL_RIGS

ROOT = Path(__file__).parents[2]
PEDESTAL = ROOT / "sample_data/hmb/pedestal.csv"
RIG = ROOT / "configs/hmb-pedestal.yaml"
RATE = 500.0


def samples(rng: np.random.Generator) -> np.ndarray:
    return np.round(rng.standard_normal((400, 2)), 3)


@pytest.fixture(scope="module")
def recording() -> labpipe.Recording:
    return labpipe.read(PEDESTAL, rig=RIG)  # type: ignore[return-value]


@pytest.fixture(scope="module")
def response(recording: labpipe.Recording) -> labpipe.FrequencyResponse:
    return labpipe.measure([recording], labpipe.FrfSettings("periodic", period="2 s", skip=3))


@pytest.fixture(scope="module")
def fit(response: labpipe.FrequencyResponse) -> Fit:
    (found,) = labpipe.fit(
        response, labpipe.FitSettings("sdof", mass="0.79 kg", band="60-70 Hz", name="pedestal")
    )
    return found


def test_every_public_name_is_there_and_documented() -> None:
    for name in labpipe.__all__:
        assert name == "__version__" or (getattr(labpipe, name).__doc__ or "").strip(), name
    assert len(labpipe.__all__) < 40
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = labpipe.nothing


def test_a_raw_file_with_its_rig_is_calibrated(recording: labpipe.Recording) -> None:
    """y is recorded in volts at 8 V/mm; the first rows of the file by hand."""
    table = pd.read_csv(PEDESTAL, nrows=5)
    np.testing.assert_allclose(recording.samples[:5, 0], table["force [N]"])
    np.testing.assert_allclose(recording.samples[:5, 1], table["y [V]"] / 8000.0)
    assert recording.sample_rate == pytest.approx(1000.0)


def test_volts_alone_are_not_guessed() -> None:
    with pytest.raises(
        labpipe.LabpipeError, match=r"does not say quantity, unit or sensitivity of 'y \[V\]'"
    ):
        labpipe.read(PEDESTAL)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".csv.gz"])
def test_a_file_that_states_its_units_needs_no_rig(
    suffix: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    path, values = tmp_path / f"run{suffix}", samples(rng)
    frame = pd.DataFrame(
        {"t [ms]": 1e3 * np.arange(400) / RATE, "force [kN]": values[:, 0], "x [um]": values[:, 1]}
    )
    frame.to_parquet(path) if suffix == ".parquet" else frame.to_csv(path, index=False)
    found = labpipe.read(path)
    assert isinstance(found, labpipe.Recording) and found.sample_rate == pytest.approx(RATE)
    np.testing.assert_allclose(found.samples, values * [1e3, 1e-6])
    assert [(channel.quantity, channel.role) for channel in found.channels] == [
        ("force", "input"),
        ("displacement", "output"),
    ]


def test_the_g_of_an_acceleration_is_no_gram(tmp_path: Path) -> None:
    """Two rows of 1 g: standard gravity, 9.80665 m/s^2 (CGPM 1901)."""
    (tmp_path / "a.csv").write_text("t [s],acc [g]\n0,1\n0.1,1\n0.2,2\n")
    np.testing.assert_allclose(labpipe.read(tmp_path / "a.csv").samples[:, 0], [9.80665, 9.80665, 19.6133])


def test_a_file_without_time_or_units_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("force [N],x [um]\n1,2\n3,4\n2,9\n")
    with pytest.raises(labpipe.LabpipeError, match="no sampling rate and has no time column"):
        labpipe.read(tmp_path / "a.csv")
    wavfile.write(tmp_path / "a.wav", 1000, np.zeros(10, np.int16))
    with pytest.raises(labpipe.LabpipeError, match="does not say quantity"):
        labpipe.read(tmp_path / "a.wav")
    savemat(tmp_path / "a.mat", {"force": np.zeros(5), "x": np.ones(5)})
    with pytest.raises(labpipe.LabpipeError, match=r"a\.mat"):
        labpipe.read(tmp_path / "a.mat")


def test_frequency_responses_of_every_form_of_file(
    response: labpipe.FrequencyResponse, tmp_path: Path
) -> None:
    write_frf_csv(tmp_path / "h.csv", response)
    write_frf_uff(tmp_path / "h.uff", response)
    for name in ("h.csv", "h.uff"):
        again = labpipe.read(tmp_path / name)
        assert isinstance(again, labpipe.FrequencyResponse)
        np.testing.assert_allclose(again.matrix, response.matrix, rtol=1e-6)


def test_run_up_tables_and_results(tmp_path: Path) -> None:
    run = labpipe.read(ROOT / "sample_data/falah/load-1.csv")
    assert run.load == pytest.approx(3.66088639) and run.planes == ("disc 1", "disc 2")
    made = labpipe.run(ROOT / "pipelines/axial.yaml", tmp_path / "out", overrides=["report.formats=md"])
    assert sorted(path.name for path in (tmp_path / "out").glob("report.*")) == ["report.md"]
    for path in (tmp_path / "out", tmp_path / "out/identification.json"):
        again = labpipe.read(path)
        assert [f.parameters for f in again.fits] == [f.parameters for f in made.fits]
    (frf,) = (tmp_path / "out").glob("*.frf.parquet")
    (calibrated,) = (tmp_path / "out/recordings").glob("*.parquet")
    assert isinstance(labpipe.read(frf), labpipe.FrequencyResponse) and isinstance(
        labpipe.read(calibrated), labpipe.Recording
    )


def test_a_run_without_a_folder_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made = labpipe.run(ROOT / "pipelines/axial.yaml", overrides=["expect={axial.k: '>= 1 GN/m'}"])
    assert not made.accepted and not list(tmp_path.iterdir())
    with pytest.raises(labpipe.LabpipeError, match="no such file"):
        labpipe.run(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("none.csv", "no such file"),
        ("a.xyz", "cannot be read"),
        ("a.yaml", "settings file"),
        ("a.json", "not a readable"),
    ],
)
def test_what_cannot_be_read_is_named(name: str, said: str, tmp_path: Path) -> None:
    if name.startswith("a"):
        (tmp_path / name).write_text("words")
    with pytest.raises(labpipe.LabpipeError) as caught:
        labpipe.read(tmp_path / name)
    assert said in str(caught.value) and name in str(caught.value)


def test_a_bearing_by_its_kind_is_that_of_its_file() -> None:
    """INTERFACE's journal bearing, and the shipped ball bearing at another load."""
    path = ROOT / "configs/bearings/mendes-journal.yaml"
    of_file = labpipe.bearing(path, load="58.82 N")
    by_kind = labpipe.bearing(
        "journal-bearing",
        diameter="31 mm",
        length="18 mm",
        clearance="90 um",
        viscosity="0.1044 Pa.s",
        speed="50 Hz",
        load="58.82 N",
    )
    assert by_kind.dofs == of_file.dofs == ("y", "z")
    heavier = labpipe.bearing(str(ROOT / "configs/bearings/nsk-6208.yaml"), **{"loads.z": "701 N"})
    lighter = labpipe.bearing(ROOT / "configs/bearings/nsk-6208.yaml")
    assert heavier.stiffness[2, 2] > lighter.stiffness[2, 2]
    with pytest.raises(
        labpipe.LabpipeError, match="unknown bearing 'jurnal-bearing'; did you mean 'journal-bearing'"
    ):
        labpipe.bearing("jurnal-bearing")
    assert "journal-bearing" in BEARINGS


def test_rotors_and_virtual_rigs_by_name() -> None:
    assert type(labpipe.rotor(ROOT / "configs/rotors/mendes.yaml")).__name__ == "RotorRig"
    assert type(labpipe.rotor(ROOT / "configs/rotors/falah.yaml")).__name__ == "RunUpRotor"
    rig = labpipe.virtual_rig(
        "virtual-white-noise-rig",
        stiffness=[["1 MN/m", 0], [0, "2 MN/m"]],
        damping=[[100.0, 0], [0, 100.0]],
        mass="5 kg",
    )
    assert rig == replace(rig, stiffness=((1e6, 0.0), (0.0, 2e6))) and rig.kind in VIRTUAL_RIGS
    assert labpipe.virtual_rig(ROOT / "configs/virtual-white-noise.yaml", blocks=2).blocks == 2
    (run,) = labpipe.recordings(replace(rig, blocks=1), seed=1, runs=["along-x"])
    assert isinstance(run, labpipe.Recording)


def test_a_fit_is_one_line_in_a_list_and_a_table_in_print(fit: Fit) -> None:
    line, text = repr(fit), str(fit)
    assert "\n" not in line and len(line) < 300
    assert line.startswith("<Fit pedestal: sdof, ml, 60-70 Hz, G.o.F 0.9999; k = 134.4983 +- 0.0087 kN/m")
    assert [row.split()[0] for row in text.splitlines() if row[:2] in ("k ", "c ", "f_", "ze")] == [
        "k",
        "c",
        "f_n",
        "zeta",
    ]
    assert "134.4808 to 134.5159" in text and "40 degrees of freedom" in text
    html = fit._repr_html_()
    assert html.count("<tr>") == 5 and "<td>134.4983</td>" in html


def test_words_of_other_hands_are_escaped_in_a_notebook(fit: Fit) -> None:
    evil = replace(fit, name="<script>alert(1)</script>", findings=(Finding("collinear", "<b>k</b> & c"),))
    html = evil._repr_html_()
    assert "<script>" not in html and "&lt;b&gt;k&lt;/b&gt; &amp; c" in html
    assert "warnings: collinear" in repr(evil) and "warning collinear: <b>k</b> & c" in str(evil)


def test_correlations_beyond_a_half_are_named(fit: Fit) -> None:
    correlated = replace(
        fit, correlation=np.array([[1.0, -0.93], [-0.93, 1.0]]), converged=False, gof=Goodness(0.9, 0.8)
    )
    assert "correlation of k and c: -0.93" in str(correlated) and "NOT CONVERGED" in str(correlated)
    assert "correlation" not in str(replace(fit, correlation=np.eye(2)))


def test_other_records_are_one_line(recording, response, fit) -> None:
    assert repr(recording) == "<Recording pedestal: f [N], y [m]; 1000 Hz, 16 s>"
    assert repr(response).startswith(
        "<FrequencyResponse response: receptance, 1 x 1 (outputs x inputs), 199 lines 1-100 Hz"
    )
    result = labpipe.Identification((fit,), "Pedestal", responses=(response,))
    assert repr(result) == "<Identification Pedestal: 1 fits; no rules>" and str(fit) in str(result)


def test_tables_hold_the_numbers_of_the_records(recording, response, fit) -> None:
    frame = fit.to_frame()
    assert (
        list(frame["parameter"]) == ["k", "c", "f_n", "zeta"]
        and frame["value"][0] == fit.parameter("k").value
    )
    assert tuple(frame.loc[0, ["ci_low", "ci_high"]]) == fit.parameter("k").ci95
    whole = labpipe.Identification((fit, fit), "t").to_frame()
    assert len(whole) == 8
    over_frequency = response.to_frame()
    np.testing.assert_array_equal(over_frequency["y/f"], response.matrix[:, 0, 0])
    np.testing.assert_allclose(over_frequency["y/f:std"] ** 2, response.variance[:, 0, 0])
    over_time = recording.to_frame()
    assert list(over_time.columns) == ["f [N]", "y [m]"] and over_time.index[1] == pytest.approx(1e-3)


def test_xarray_is_named_where_it_is_missing(
    response: labpipe.FrequencyResponse, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(labpipe.LabpipeError, match="to_xarray needs the package xarray"):
        response.to_xarray()


def test_a_response_as_xarray(response: labpipe.FrequencyResponse) -> None:
    pytest.importorskip("xarray")
    dataset = response.to_xarray()
    np.testing.assert_array_equal(dataset["response"].sel(output="y", input="f"), response.matrix[:, 0, 0])
    assert dataset.attrs["form"] == "receptance" and dataset["variance"].dims == (
        "frequency",
        "output",
        "input",
    )
