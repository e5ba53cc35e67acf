"""A floating bearing on the command line: recordings of the virtual rig, a dry test as the baseline, the
coefficients, what is refused.
"""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from labpipe.cli.main import run_command

ROOT = Path(__file__).parents[3]
CHANNELS = "".join(
    f'  {letter}{axis}: {{column: "{letter}_{axis} [{unit}]", quantity: {quantity}, unit: {unit}, role: '
    f"{role}, dof: {axis}}}\n"
    for letter, quantity, unit, role in (
        ("f", "force", "mN", "input"),
        ("d", "displacement", "nm", "output"),
        ("a", "acceleration", "mm/s^2", "output"),
    )
    for axis in "xy"
)
RIG = f"name: Floating stator\nsample_rate: 1000 Hz\nchannels:\n{CHANNELS}"
PIPELINE = """title: Water seal
tests:
  - {name: dry, recordings: dry-*.parquet}
  - {name: seal, recordings: seal-*.parquet, conditions: {speed: 2000 rpm}}
rig: rig.yaml
frf: {excitation: periodic, period: 1 s, result: spectra, band: 10-100 Hz,
      remove: {speed: 2000 rpm, harmonics: 2}}
identify:
  hoses: {model: dynamic-stiffness, test: dry, motion: absolute, stator_mass: 60 kg +- 0.6 kg}
  seal: {model: dynamic-stiffness, baseline: hoses, compare: true, stator_mass: 60 kg +- 0.6 kg}
report: {formats: [html]}
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped virtual rig, one recording per condition (zipper)."""
    folder = tmp_path_factory.mktemp("floating")
    assert (
        run_command(
            [
                "simulate",
                str(ROOT / "configs/virtual-floating.yaml"),
                "-o",
                str(folder),
                "--set",
                "excitation=zipper",
            ]
        )
        == 0
    )
    (folder / "rig.yaml").write_text(RIG)
    (folder / "pipeline.yaml").write_text(PIPELINE)
    return folder


def test_the_truth_of_the_virtual_rig_comes_back(recorded: Path, tmp_path: Path, labpipe) -> None:
    """Within 4 standard errors each.

    The whirl frequency ratio 0.3520 is that of the true K, C and M (0.3505 without M).
    """
    ended = labpipe("run", recorded / "pipeline.yaml", "-o", tmp_path)
    assert ended.code == 0 and "best of 4 models by BIC: kcm" in ended.out
    fits = {fit["name"]: fit for fit in json.loads((tmp_path / "identification.json").read_text())["fits"]}
    assert set(fits) == {"hoses", "seal"} and 0.75 < fits["seal"]["gof"]["chi2_reduced"] < 1.25
    truth = json.loads((recorded / "truth.json").read_text())["truth"]
    found = {parameter["name"]: parameter for parameter in fits["seal"]["parameters"]}
    for name, value in truth["conditions"]["seal"].items():
        if name in found:
            assert abs(found[name]["value"] - value) < 4 * (
                found[name]["std_error_inflated"] or found[name]["std_error"]
            )
    assert found["whirl_frequency_ratio"]["value"] == pytest.approx(0.3520, abs=5e-4)
    dry = {parameter["name"]: parameter["value"] for parameter in fits["hoses"]["parameters"]}
    assert dry["k_xx"] == pytest.approx(truth["baseline"]["k_xx"], rel=1e-3) and dry["m_xx"] == pytest.approx(
        0, abs=0.05
    )


def test_effective_forces_as_derived_channels_give_the_same(recorded: Path, tmp_path: Path, labpipe) -> None:
    """f - m_s a with m_s of the rig file: the balance, and the same error in both tests, as with
    `stator_mass`.
    """
    derived = "".join(
        f"  e{axis}: {{quantity: force, derived: f{axis} - m_s * a{axis}, dof: {axis}}}\n" for axis in "xy"
    )
    plain = (
        RIG.replace(", role: input", "")
        .replace(", role: output", "")
        .replace("\nchannels", "\nconstants: {m_s: 60 kg +- 0.6 kg}\nchannels")
    )
    (recorded / "derived.yaml").write_text(plain + derived)
    text = (
        PIPELINE.replace("rig.yaml", "derived.yaml")
        .replace(", stator_mass: 60 kg +- 0.6 kg", "")
        .replace("compare: true", "form: kcm")
    )
    for name, pipeline in (("derived", text), ("given", PIPELINE.replace("compare: true", "form: kcm"))):
        (recorded / f"{name}-pipeline.yaml").write_text(pipeline.replace("[html]", "[]"))
        assert labpipe("run", recorded / f"{name}-pipeline.yaml", "-o", tmp_path / name).code == 0
    derived_fits, given_fits = (
        json.loads((tmp_path / name / "identification.json").read_text())["fits"]
        for name in ("derived", "given")
    )
    for one, other in zip(derived_fits, given_fits, strict=True):
        assert one["gof"]["chi2_reduced"] == pytest.approx(other["gof"]["chi2_reduced"], rel=1e-6)
        for a, b in zip(one["parameters"], other["parameters"], strict=True):
            assert a["value"] == pytest.approx(b["value"], rel=1e-5, abs=1e-4 * b["std_error"])
            assert (a["std_error_inflated"] or a["std_error"]) == pytest.approx(
                b["std_error_inflated"] or b["std_error"], rel=1e-3
            )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "result: spectra, ",
            "",
            "model dynamic-stiffness needs spectra of all channels, not an FRF; frf: {result: spectra}",
        ),
        (
            "dynamic-stiffness, test: dry, motion: absolute, stator_mass",
            "mdof, test: dry, mass",
            "mdof needs an FRF",
        ),
        (
            "baseline: hoses",
            "baseline: hose",
            "wrong.yaml: identify.seal: baseline: no earlier fit 'hose' of model dynamic-stiffness",
        ),
        ("compare: true", "form: kcc", "unknown choice 'kcc'; did you mean 'kc'?"),
        ("baseline: hoses,", "baseline: hoses, test: dry,", "no test is left for it"),
        # One message for one typing error: a key of the model beside those of all fits, and the model itself.
        (
            "stator_mass: 60 kg +- 0.6 kg}\nreport",
            "stator_mas: 60 kg}\nreport",
            "stator_mas: unknown key; did you mean 'stator_mass'?",
        ),
        (
            "seal: {model: dynamic-stiffness",
            "seal: {model: dynamic-stifness",
            "stifness'; did you mean 'dynamic-stiffness'?",
        ),
        ("stator_mass: 60 kg +- 0.6 kg}\nreport", "stator_mass: 60 mm}\nreport", "stator_mass"),
    ],
)
def test_what_is_wrong_is_said_where_it_is(
    recorded: Path, tmp_path: Path, labpipe, old: str, new: str, message: str
) -> None:
    text = PIPELINE.replace(old, new)
    assert text != PIPELINE
    (recorded / "wrong.yaml").write_text(text)
    ended = labpipe("run", recorded / "wrong.yaml", "-o", tmp_path)
    assert ended.code == 2 and message in ended.err.replace("+- 0.6 kg", ""), ended.err
    # Both fits need spectra.
    assert ended.err.count("error:") == (2 if "spectra" in old else 1)


def test_the_report_of_a_matrix_keeps_the_baseline(recorded: Path, tmp_path: Path, labpipe) -> None:
    """The dry test is at no point of the matrix: its fit has its page, those at the points are drawn on
    demand.
    """
    matrix = "matrix: {water: {fit: seal, over: [speed]}}\nreport: {formats: [md]}\n"
    text = PIPELINE.replace("compare: true", "form: kcm").replace("report: {formats: [html]}\n", matrix)
    (recorded / "matrix.yaml").write_text(text)
    assert labpipe("run", recorded / "matrix.yaml", "-o", tmp_path / "out").code == 0
    page = (tmp_path / "out/report.md").read_text("utf-8")
    assert "Test matrix: water" in page and "Result: hoses, test dry" in page and "Result: seal" not in page


def test_a_fit_whose_baseline_failed_says_why_that_failed(recorded: Path, tmp_path: Path, labpipe) -> None:
    """The dry test has no third force channel: its own cause is told, not that a name is missing."""
    text = PIPELINE.replace(
        "  - {name: seal", "  - {name: spare, recordings: seal-*.parquet}\n  - {name: seal"
    )
    text = text.replace("name: dry, recordings: dry-*.parquet", "name: dry, recordings: short-*.parquet")
    for path in recorded.glob("dry-*.parquet"):
        table = pq.read_table(path)
        pq.write_table(table.slice(0, 700), recorded / path.name.replace("dry-", "short-"))
    (recorded / "short.yaml").write_text(text)
    ended = labpipe("run", recorded / "short.yaml", "-o", tmp_path)
    assert ended.code == 2 and "no earlier fit" not in ended.err
    assert (
        "identify.seal: it begins with 'hoses', which has no result: " in ended.err and "period" in ended.err
    )
