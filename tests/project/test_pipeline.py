"""Pipeline files: what they name, what they override, and the schema made from the same settings."""

from __future__ import annotations

from pathlib import Path

import pytest

from labpipe.errors import ConfigErrors
from labpipe.estimation.settings import Sliding
from labpipe.project.marked_yaml import load_marked
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.schema import SCHEMAS
from labpipe.records.uncertain import Uncertain, parse_uncertain

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "rig.yaml").write_text(
        "name: R\nsample_rate: 1 kHz\nmass: 2 kg\nchannels:\n  f: {quantity: force, dof: x}\n  x: "
        "{quantity: displacement}\n"
    )
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text("f,x\n1,2\n")
    return tmp_path


def load(folder: Path, text: str, *overrides: str):  # type: ignore[no-untyped-def]
    (folder / "p.yaml").write_text(text)
    return load_pipeline(folder / "p.yaml", overrides)


FRF = "frf: {excitation: periodic, period: 1 s}\n"


def test_globs_lists_and_overridden_channels(folder: Path) -> None:
    (test,) = load(folder, "rig: rig.yaml\nrecordings: '*.csv'\n" + FRF).tests
    assert [source.path.name for source in test.recordings] == ["a.csv", "b.csv"]
    text = "rig: rig.yaml\nrecordings: [a.csv, {file: b.csv, channels: {f: {dof: y}}}]\n" + FRF
    (test,) = load(folder, text).tests
    assert [source.rig.channels[0].channel.dof for source in test.recordings] == ["x", "y"]


def test_several_tests_with_conditions(folder: Path) -> None:
    text = (
        "rig: rig.yaml\ntests:\n  - {name: 1, recordings: a.csv, conditions: {preload: 427 N}}\n  - "
        "{name: 2, recordings: b.csv}\n"
    ) + FRF
    tests = load(folder, text).tests
    assert [(t.name, t.conditions) for t in tests] == [("1", {"preload": "427 N"}), ("2", {})]


def test_a_fit_takes_the_rig_s_mass_unless_it_says_its_own(folder: Path) -> None:
    text = "rig: rig.yaml\nrecordings: a.csv\n" + FRF
    fits = load(
        folder,
        text + "identify:\n  a: {model: sdof}\n  b: {model: sdof, mass: estimate}\n  c: "
        "{model: sdof, mass: 1 kg}\n",
    ).fits
    assert [fit.mass for fit in fits] == [2.0, "estimate", 1.0]


def test_all_of_a_fit_s_settings(folder: Path) -> None:
    text = (
        "rig: rig.yaml\nrecordings: a.csv\n" + FRF + "identify:\n  a:\n    model: rotor-2dof-direct\n    "
        "estimator: ls\n    output: [x]\n"
        "    band: 1-0.25 kHz\n    sliding: {width: 15 Hz, step: 3 Hz}\n    share: 2\n    eliminate: true\n"
        "    subtract: {stiffness: 134.5 kN/m +- 1 %, damping: 2 N.s/m}\n"
    )
    with pytest.raises(ConfigErrors, match=r"the band '1-0\.25 kHz' is empty"):
        load(folder, text)
    (fit,) = load(folder, text, "identify.a.band=1 Hz-0.25 kHz").fits
    assert (fit.band, fit.sliding, fit.share, fit.eliminate, fit.output) == (
        (1.0, 250.0),
        Sliding(15.0, 3.0),
        2,
        True,
        ("x",),
    )
    assert (fit.subtract.stiffness, fit.subtract.damping) == (Uncertain(134500.0, 1345.0), Uncertain(2.0))


def test_rules_may_be_several_and_stand_at_their_place(folder: Path) -> None:
    text = (
        "rig: rig.yaml\nrecordings: a.csv\n"
        + FRF
        + "identify: {a: {model: sdof}}\nexpect:\n  a.f_n: ['>= 65 Hz', '<= 66 Hz']\n  a[72 Hz].k: 3 N/m +- "
        "1 %\n"
    )
    first, second, third = load(folder, text).rules
    assert (first.kind, first.bound, second.kind) == (">=", "65 Hz", "<=")
    assert (third.fit, third.which, third.item, third.kind) == ("a", "72 Hz", "k", "+-")
    assert third.place.endswith("p.yaml:7:3")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("title: T\n", "nothing to work on"),
        ("rig: rig.yaml\nrecordings: a.csv\n", "frf: is missing"),
        ("recordings: a.csv\n" + FRF, "recordings: no rig file is named"),
        (
            "rig: rig.yaml\nrecordings: a.csv\n" + FRF + "report: {formats: [htm]}\n",
            "report.formats: unknown format 'htm'; did you mean 'html'?",
        ),
        (
            "rig: rig.yaml\nrecordings: a.csv\n" + FRF + "acept: {}\n",
            "p.yaml:4:1: acept: unknown key; did you mean 'accept'?",
        ),
        (
            "rig: rig.yaml\nrecordings: {file: a.csv, channels: {g: {dof: y}}}\n" + FRF,
            "channels.g: the rig has no such channel",
        ),
        (
            "rig: rig.yaml\ntests: [{name: a, recordings: a.csv}, {name: a, recordings: b.csv}]\n" + FRF,
            "a second test named 'a'",
        ),
        (
            "rig: rig.yaml\nrecordings: a.csv\nfrf: {excitation: periodic, period: 1 s, mask: {harmonics: "
            "3}}\n",
            "one of 'speed' and 'tacho' is needed",
        ),
        ("calibrate: {g: {table: none.csv, x: a, y: b}}\n", "calibrate.g.table: no such file 'none.csv'"),
    ],
)
def test_faults_of_pipelines(folder: Path, text: str, fault: str) -> None:
    with pytest.raises(ConfigErrors) as caught:
        load(folder, text)
    assert any(fault in str(found) for found in caught.value.faults), [
        str(found) for found in caught.value.faults
    ]


def test_tolerances() -> None:
    assert parse_uncertain("45.2 kN/m +- 1 %", "N/m") == Uncertain(45200.0, pytest.approx(452.0))
    assert parse_uncertain("45.2 kN/m ± 0.3 kN/m", "N/m") == Uncertain(45200.0, pytest.approx(300.0))
    assert parse_uncertain("-18 kN/m +- 10 %", "N/m").std_error == pytest.approx(1800.0)


def check_against(schema: dict, value: object, path: str = "") -> list[str]:  # type: ignore[type-arg]
    """A small independent reading of the schema: unknown keys, missing keys and enums of nested objects."""
    if "anyOf" in schema:
        faults = [check_against(option, value, path) for option in schema["anyOf"]]
        return [] if [] in faults else faults[0]
    found: list[str] = []
    if isinstance(value, dict) and "properties" in schema:
        known = schema["properties"]
        found += [f"{path}.{key}" for key in value if key not in known]
        found += [f"{path}.{key} missing" for key in schema.get("required", []) if key not in value]
        for key, entry in value.items():
            found += check_against(known.get(key, {}), entry, f"{path}.{key}")
    elif isinstance(value, dict) and isinstance(schema.get("additionalProperties"), dict):
        for key, entry in value.items():
            found += check_against(schema["additionalProperties"], entry, f"{path}.{key}")
    elif "enum" in schema and value not in schema["enum"]:
        found.append(f"{path}={value}")
    return found


SHIPPED = {
    "pipeline": (ROOT / "pipelines").glob("*.yaml"),
    "rig": (ROOT / "configs").glob("hmb-*.yaml"),
    "bearing": (ROOT / "configs/bearings").glob("*.yaml"),
    "plan": (ROOT / "configs").glob("plan-*.yaml"),
}


@pytest.mark.parametrize(
    ("kind", "path"),
    # Named by the file: a place in the list changes with every file that is added.
    [
        pytest.param(kind, path, id=f"{kind}-{path.stem}")
        for kind, paths in SHIPPED.items()
        for path in sorted(paths)
    ],
)
def test_shipped_files_meet_the_schema_that_editors_use(kind: str, path: Path) -> None:
    schema = SCHEMAS.load(kind)()
    assert set(SCHEMAS) == set(SHIPPED)
    assert check_against(schema, load_marked(path).plain()) == []
    assert check_against(schema, {"titel": "x"}) != []


@pytest.mark.parametrize(
    ("name", "verdict", "hint"),
    [
        ("preload-series.yaml", "axial-trend.verdict: risng", "did you mean 'rising'?"),
        ("preload-series.yaml", "radial-ratio.verdict: 1.12", "known: stiffer than theory, softer"),
        ("repeatability.yaml", "stiffness.verdict: setting differs", "did you mean 'settings differ'?"),
        ("rotating-vs-stationary.yaml", "rotation.verdict: no diference", "did you mean 'no difference'?"),
        ("reciprocity.yaml", "reciprocity.verdict: reciprocl", "did you mean 'reciprocal'?"),
        ("magnetic-sensitivity.yaml", "sensitivity.verdict: C", "known: zone A, zone B, zone C, zone D"),
        ("levitated-certificate.yaml", "certificate.verdict: acepted", "did you mean 'accepted'?"),
        ("journal-unbalance.yaml", "run_ups.joint.verdict: not rejectd", "did you mean 'not rejected'?"),
    ],
)
def test_a_misspelt_verdict_is_a_fault_at_its_line(
    tmp_path: Path, name: str, verdict: str, hint: str
) -> None:
    """The rule would fail, whatever is measured."""
    address, _, word = verdict.partition(": ")
    lines = (ROOT / "pipelines" / name).read_text().replace("../", f"{ROOT}/").splitlines()
    (number,) = (n for n, line in enumerate(lines) if line.strip().startswith(f"{address}:"))
    lines[number] = f"  {verdict}"
    (tmp_path / name).write_text("\n".join(lines))
    with pytest.raises(ConfigErrors) as faults:
        load_pipeline(tmp_path / name)
    (fault,) = faults.value.faults
    assert fault.where == f"{tmp_path / name}:{number + 1}:3"
    assert f"unknown verdict '{word}'" in fault.what and fault.hint.startswith(hint)
