"""Every key of every file changed, one at a time: the run into the old folder ends as one into a new folder
does.

The keys and their kinds come from the declared settings, so that a new key is tested without anyone thinking
of it. Both runs may refuse the change: then they say the same, and the old result stays as it was.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from labpipe.errors import LabpipeError
from labpipe.estimation.settings import FitSettings
from labpipe.methods.floating_bearing.settings import DynamicStiffnessSettings
from labpipe.methods.magnetic_bearing.limits import LoopCertificateSettings
from labpipe.methods.magnetic_bearing.settings import MagnetSettings
from labpipe.methods.ring_down.fit import DecaySettings
from labpipe.methods.rotor.rotor_file import RotorSettings
from labpipe.project.pipeline_file import UncertaintySettings
from labpipe.project.rig_file import ChannelSettings, RigSettings
from labpipe.records.sections import sections
from labpipe.records.settings import Setting, settings_of
from labpipe.spectra.settings import FreeDecaySettings, FrfSettings
from tests.project.laboratory import ALONE, RIG, contents, done, recording

# A walk over everything: it runs with the long tests.
pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
# Within the noise of the recording: fits of wrong models, which some changes make, take six times as long.
RESPONSE_TABLE = "frequency_hz,gain,phase_deg\n0,1,0\n50,1.00001,-0.001\n"
OTHER_TABLE = "frequency_hz,gain,phase_deg\n0,1,0\n50,1.2,-5\n"

# Where the settings of a file's mappings are declared: (file, path of keys) -> dataclass; * stands for any
# name or number.
DECLARED: dict[tuple[str, tuple[str, ...]], type] = {
    ("rig.yaml", ()): RigSettings,
    ("rig.yaml", ("channels", "*")): ChannelSettings,
    ("pipeline.yaml", ("frf",)): FrfSettings,
    ("pipeline.yaml", ("uncertainty",)): UncertaintySettings,
    ("pipeline.yaml", ("frf", "decay")): FreeDecaySettings,
    ("pipeline.yaml", ("identify", "*")): FitSettings,
    ("pipeline.yaml", ("identify", "*", "decay")): DecaySettings,
    ("pipeline.yaml", ("identify", "*", "dynamic_stiffness")): DynamicStiffnessSettings,
    ("pipeline.yaml", ("identify", "*", "magnet")): MagnetSettings,
    ("pipeline.yaml", ("compare", "*", "certificate")): LoopCertificateSettings,
    **{("pipeline.yaml", (name,)): entry.settings for name, entry in sections() if not entry.named},
    **{
        ("pipeline.yaml", (name, "*")): entry.settings
        for name, entry in sections()
        if entry.named and name != "identify"
    },
    ("rotor.yaml", ()): RotorSettings,
}


def other_value(declared: Setting, value: Any) -> Any:
    """Another valid value of the setting, if its kind has one at hand; None else."""
    unit = declared.unit if declared.unit not in ("", "1") else ""
    if declared.kind == "choice":
        return next((choice for choice in declared.choices if choice != value), None)
    if declared.kind == "flag":
        return not bool(value)
    if declared.kind == "integer":
        return (value or 1) + 1
    return {
        "value": f"0.13 {unit}".strip(),
        "uncertain": f"0.13 {unit} +- 1 %",
        "band": f"12-33 {unit}",
        "bands": [f"12-33 {unit}"],
        "values": [f"0.13 {unit}".strip()],
        "mass": "0.81 kg",
        "text": "words",
        "names": ["y"],
    }.get(declared.kind)


def changes(name: str, tree: Any, at: tuple[str, ...] = ()) -> Iterator[tuple[str, tuple[str, ...], Any]]:
    """(file, keys, new value) for every key that stands in a mapping and every key that could, by its
    declaration.
    """
    if isinstance(tree, list):
        # Of entries with the same keys the first one.
        entries = {
            frozenset(entry) if isinstance(entry, dict) else n: n for n, entry in reversed([*enumerate(tree)])
        }
        for number in sorted(entries.values()):
            yield from changes(name, tree[number], (*at, str(number)))
        return
    if not isinstance(tree, dict):
        return
    pattern = next((keys for file, keys in DECLARED if file == name and matches(keys, at)), None)
    declared = (
        {}
        if pattern is None
        else {key: setting for key, (setting, _) in settings_of(DECLARED[name, pattern]).items()}
    )
    for key, setting in declared.items():
        value = other_value(setting, tree.get(key))
        if value is not None:
            yield name, (*at, key), value
    for key, value in tree.items():
        yield name, (*at, key), None
        yield from changes(name, value, (*at, key))


def matches(pattern: tuple[str, ...], keys: tuple[str, ...]) -> bool:
    return len(pattern) == len(keys) and all(
        part in ("*", key) for part, key in zip(pattern, keys, strict=True)
    )


def changed(tree: Any, keys: tuple[str, ...], value: Any) -> Any:
    """A copy of the tree with one entry set, or removed for None."""
    key: Any = int(keys[0]) if isinstance(tree, list) else keys[0]
    copy = list(tree) if isinstance(tree, list) else dict(tree)
    if len(keys) > 1:
        copy[key] = changed(copy[key], keys[1:], value)
    elif value is None:
        del copy[key]
    else:
        copy[key] = value
    return copy


def outcome(lab: Path, out: Path) -> tuple[str, dict[str, bytes]]:
    """The refusal in words, or nothing, and what lies in the folder."""
    try:
        done(lab / "pipeline.yaml", out)
    except LabpipeError as error:
        return str(error).replace(str(out), "OUT"), {}
    return "", contents(out)


def same_as_a_new_folder(finished: Path, files: dict[str, str], tmp_path: Path) -> None:
    """The files changed in a copy of a finished laboratory: old folder and new folder end alike."""
    lab = tmp_path / "lab"
    shutil.copytree(finished, lab)
    for name, text in files.items():
        (lab / name).write_text(text)
    before = contents(lab / "out")
    old, new = outcome(lab, lab / "out"), outcome(lab, lab / "new")
    shutil.rmtree(tmp_path / "lab" / "new", ignore_errors=True)
    assert old[0] == new[0]
    if new[0]:
        assert contents(lab / "out") == before
        return
    # What a changed name leaves behind of the old run may stay; what the new run gives must be there byte for
    # byte.
    assert {name: old[1].get(name) for name in new[1]} == new[1]


BASIC = {
    "rig.yaml": RIG.replace("role: output, dof: y", "role: output, dof: y, response: probe.csv"),
    "pipeline.yaml": ALONE,
    "probe.csv": RESPONSE_TABLE,
    "soft.csv": recording(18e3),
}
BASIC_CHANGES = [
    change
    for name in ("rig.yaml", "pipeline.yaml")
    for change in changes(name, yaml.safe_load(BASIC[name]))
    # Of two channels and of two fits of one model one takes every key, and both lose theirs.
    if change[1][:2] not in (("identify", "plain"), ("channels", "f")) or change[2] is None
]


def described(change: tuple[str, tuple[str, ...], Any]) -> str:
    name, keys, value = change
    return f"{name.removesuffix('.yaml')}:{'.'.join(keys)}={'(none)' if value is None else value}"


def finished_laboratory(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).write_text(text)
    done(folder / "pipeline.yaml", folder / "out")
    return folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished_laboratory(tmp_path_factory.mktemp("basic"), BASIC)


@pytest.mark.parametrize("change", BASIC_CHANGES, ids=described)
def test_a_changed_key_reaches_the_result(
    finished: Path, change: tuple[str, tuple[str, ...], Any], tmp_path: Path
) -> None:
    name, keys, value = change
    tree = changed(yaml.safe_load(BASIC[name]), keys, value)
    same_as_a_new_folder(finished, {name: yaml.safe_dump(tree, sort_keys=False)}, tmp_path)


@pytest.mark.parametrize(
    ("name", "text"),
    [("probe.csv", OTHER_TABLE), ("soft.csv", recording(18.3e3)), ("soft.csv", recording(18e3, seed=2))],
)
def test_a_changed_file_reaches_the_result(finished: Path, name: str, text: str, tmp_path: Path) -> None:
    same_as_a_new_folder(finished, {name: text}, tmp_path)


def test_every_declared_setting_of_the_basic_files_is_changed() -> None:
    """The list above would be short if a declaration were missed."""
    seen = {(name, keys[-1]) for name, keys, value in BASIC_CHANGES if value is not None}
    for owner, name in (
        (ChannelSettings, "rig.yaml"),
        (FrfSettings, "pipeline.yaml"),
        (FitSettings, "pipeline.yaml"),
    ):
        testable = {
            key for key, (setting, _) in settings_of(owner).items() if other_value(setting, None) is not None
        }
        assert {(name, key) for key in testable} <= seen, owner
    assert len(BASIC_CHANGES) > 80


def test_the_sensitivity_of_a_probe_reaches_the_damping(tmp_path: Path) -> None:
    """By hand: a sensitivity of 12 instead of 8 V/mm makes every motion 8/12 as large, and k and c 12/8 as
    large.
    """
    rig = (
        RIG.replace('"y [um]"', '"y [V]"')
        .replace("unit: um,", "unit: V, sensitivity: 8 V/mm,")
        .replace("mass: 0.79 kg\n", "")
    )
    pipeline = ALONE.replace("model: sdof,", "model: sdof, mass: estimate,")
    files = {
        "rig.yaml": rig,
        "pipeline.yaml": pipeline,
        "soft.csv": recording(18e3).replace("y [um]", "y [V]"),
    }
    lab = finished_laboratory(tmp_path, files)
    first = done(lab / "pipeline.yaml", lab / "out").fits[0]
    (lab / "rig.yaml").write_text(rig.replace("8 V/mm", "12 V/mm"))
    second = done(lab / "pipeline.yaml", lab / "out").fits[0]
    for name in ("k", "c", "m"):
        assert second.parameter(name).value == pytest.approx(1.5 * first.parameter(name).value, rel=1e-9)


def test_the_window_of_ready_responses_reaches_their_fits(tmp_path: Path) -> None:
    """Noise that neighbouring lines share by a window changes no value, but the standard errors."""
    w = 2 * np.pi * np.arange(15.0, 35.0, 0.25)
    rng = np.random.default_rng(5)
    h = 1 / (18e3 - 0.79 * w**2 + 20j * w) + 1e-6 * (rng.normal(size=w.size) + 1j * rng.normal(size=w.size))
    rows = "".join(
        f"{f:g},{value.real:.9g},{value.imag:.9g}\n" for f, value in zip(w / (2 * np.pi), h, strict=True)
    )
    text = (
        "title: t\nfrfs: {file: h.csv}\nidentify: {a: {model: sdof, mass: 0.79 kg}}\nreport: {formats: []}\n"
    )
    files = {"h.csv": f"# form: receptance\nfrequency_hz,y/f:re,y/f:im\n{rows}", "pipeline.yaml": text}
    lab = finished_laboratory(tmp_path, files)
    (plain,) = done(lab / "pipeline.yaml", lab / "out").fits
    (lab / "pipeline.yaml").write_text(text.replace("h.csv}", "h.csv, window: flattop}"))
    old, new = (done(lab / "pipeline.yaml", lab / folder).fits[0] for folder in ("out", "new"))
    assert old.parameters == new.parameters != plain.parameters
    assert old.parameter("k").as_fitted.value == plain.parameter("k").as_fitted.value


# Other sections, each in a small pipeline of its own.

SECTIONS = {
    "calibrate": {
        "pipeline.yaml": "title: lines\ncalibrate:\n  probe: {table: line.csv, x: 'x [um]', y: 'y "
        "[V]'}\nreport: {formats: []}\n",
        "line.csv": "x [um],y [V]\n0,0.01\n10,0.08\n20,0.17\n30,0.24\n",
    },
    "unbalance": {
        "pipeline.yaml": "title: u\nunbalance: {rotor: rotor.yaml, speeds: 40-42 Hz, step: 2 Hz, cases: "
        "{healthy: {depth: 0 um}}}\n"
        "report: {formats: []}\n",
        "rotor.yaml": (ROOT / "configs/rotors/laval.yaml").read_text(encoding="utf-8"),
    },
    "study": {
        "pipeline.yaml": "title: s\nstudy: {rig: virtual.yaml, noise: [2 %], repeats: 10}\n"
        "identify:\n  ml: {model: mdof, mass: [1 kg, 2 kg, 3 kg], symmetric: true, estimator: ls}\nreport: "
        "{formats: []}\n",
        "virtual.yaml": (ROOT / "configs/three-dof.yaml").read_text(encoding="utf-8"),
    },
}
SECTION_CHANGES = [
    (section, change)
    for section, files in SECTIONS.items()
    for name, text in files.items()
    if name.endswith(".yaml")
    for change in changes(name, yaml.safe_load(text))
    # The default number of repeats takes ten seconds; another number is tried as well.
    if change[1] != ("study", "repeats") or change[2] is not None
]


@pytest.fixture(scope="module")
def laboratories(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {
        section: finished_laboratory(tmp_path_factory.mktemp(section), files)
        for section, files in SECTIONS.items()
    }


@pytest.mark.parametrize(
    ("section", "change"),
    [
        pytest.param(section, change, id=f"{section} {described(change)}")
        for section, change in SECTION_CHANGES
    ],
)
def test_a_changed_key_of_a_section_reaches_the_result(
    laboratories: dict[str, Path], section: str, change: tuple[str, tuple[str, ...], Any], tmp_path: Path
) -> None:
    name, keys, value = change
    tree = changed(yaml.safe_load(SECTIONS[section][name]), keys, value)
    same_as_a_new_folder(laboratories[section], {name: yaml.safe_dump(tree, sort_keys=False)}, tmp_path)


# Free decays: the keys of their two sections.

RING_DOWN = {
    "rig.yaml": "name: r\nsample_rate: 256 Hz\nchannels:\n"
    "  y: {column: 'y [um]', quantity: displacement, unit: um, role: output, dof: y}\n",
    "pipeline.yaml": "title: r\nrig: rig.yaml\nrecordings: ring.csv\nfrf: {excitation: decay, decay: "
    "{settle: 50 ms, trigger: 20 %}}\n"
    "identify:\n  ring: {model: decay, decay: {modes: 1}}\nreport: {formats: []}\n",
    "ring.csv": "y [um]\n"
    + "".join(f"{100 * np.exp(-0.01 * n) * np.cos(0.5 * n) + n % 3:.4f}\n" for n in range(512)),
}
RING_DOWN_CHANGES = [
    change
    for change in changes("pipeline.yaml", yaml.safe_load(RING_DOWN["pipeline.yaml"]))
    if "decay" in change[1]
]


@pytest.fixture(scope="module")
def ring_down(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished_laboratory(tmp_path_factory.mktemp("ring-down"), RING_DOWN)


@pytest.mark.parametrize("change", RING_DOWN_CHANGES, ids=described)
def test_a_changed_key_of_free_decays_reaches_the_result(
    ring_down: Path, change: tuple[str, tuple[str, ...], Any], tmp_path: Path
) -> None:
    tree = changed(yaml.safe_load(RING_DOWN["pipeline.yaml"]), change[1], change[2])
    same_as_a_new_folder(ring_down, {"pipeline.yaml": yaml.safe_dump(tree, sort_keys=False)}, tmp_path)


# A floating bearing: the keys of its section.


def floating_stator(sign: float) -> str:
    """Forces of five lines on k = 1 MN/m, c = 1 kN.s/m, k_xy = -k_yx = 0.2 MN/m without inertia, periods of 1
    s, with noise.
    """
    rng, time = np.random.default_rng(int(2 + sign)), np.arange(8 * 128) / 128
    force, motion, acceleration = (np.zeros((time.size, 2)) for _ in range(3))
    for frequency in (12.0, 16.0, 20.0, 24.0, 28.0):
        w = 2 * np.pi * frequency
        push = np.array([1.0, sign]) * np.exp(1j * frequency**2)
        answer = np.linalg.solve(np.array([[1e6 + 1e3j * w, 2e5], [-2e5, 1e6 + 1e3j * w]]), 100 * push)
        turn = np.exp(1j * w * time)[:, None]
        force, motion = force + (100 * push * turn).real, motion + (answer * turn).real
        acceleration = acceleration - (w**2 * answer * turn).real
    columns = np.hstack([force, motion, acceleration]) * (1 + 1e-3 * rng.normal(size=(time.size, 6)))
    rows = "".join(",".join(f"{value:.8g}" for value in row) + "\n" for row in columns)
    return f"fx,fy,dx,dy,ax,ay\n{rows}"


FLOATING = {
    "rig.yaml": "name: r\nsample_rate: 128 Hz\nchannels:\n"
    + "".join(
        f"  {letter}{axis}: {{quantity: {quantity}, unit: {unit}, role: {role}, dof: {axis}}}\n"
        for letter, quantity, unit, role in (
            ("f", "force", "N", "input"),
            ("d", "displacement", "m", "output"),
        )
        for axis in "xy"
    )
    + "  ax: {quantity: acceleration, unit: m/s^2, role: output, dof: x}\n"
    + "  ay: {quantity: acceleration, unit: m/s^2, role: output, dof: y}\n",
    "pipeline.yaml": "title: r\nrig: rig.yaml\nrecordings: [plus.csv, minus.csv]\n"
    "frf: {excitation: periodic, period: 1 s, result: spectra, band: 10-30 Hz}\n"
    "identify:\n  seal: {model: dynamic-stiffness, dynamic_stiffness: {form: kc, speed: 20 Hz}}\nreport: "
    "{formats: []}\n",
    "plus.csv": floating_stator(1.0),
    "minus.csv": floating_stator(-1.0),
}
FLOATING_CHANGES = [
    change
    for change in changes("pipeline.yaml", yaml.safe_load(FLOATING["pipeline.yaml"]))
    if "dynamic_stiffness" in change[1]
]


@pytest.fixture(scope="module")
def floating(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished_laboratory(tmp_path_factory.mktemp("floating"), FLOATING)


@pytest.mark.parametrize("change", FLOATING_CHANGES, ids=described)
def test_a_changed_key_of_a_floating_bearing_reaches_the_result(
    floating: Path, change: tuple[str, tuple[str, ...], Any], tmp_path: Path
) -> None:
    tree = changed(yaml.safe_load(FLOATING["pipeline.yaml"]), change[1], change[2])
    same_as_a_new_folder(floating, {"pipeline.yaml": yaml.safe_dump(tree, sort_keys=False)}, tmp_path)


# A levitated rotor: the keys of its magnet and of its certificate.


def levitated_rotor() -> str:
    """Ten lines of r added behind a PD controller that holds 4 kg x'' = 80 N/A i + 200 kN/m x, periods of 1
    s, with noise.
    """
    rng, time = np.random.default_rng(4), np.arange(8 * 256) / 256
    signals = np.zeros((time.size, 4))
    for frequency in np.arange(8.0, 108.0, 10.0):
        w = 2 * np.pi * frequency
        plant = 80 / (-4 * w**2 - 2e5)
        current = np.exp(1j * frequency**2) / (1 + plant * (5000 + 12j * w))
        vector = np.array([current, plant * current, current, np.exp(1j * frequency**2)])
        signals = signals + (vector * np.exp(1j * w * time)[:, None]).real
    columns = signals + rng.normal(size=signals.shape) * [2e-3, 1e-7, 2e-3, 1e-9]
    return "i,x,u,r\n" + "".join(",".join(f"{value:.9g}" for value in row) + "\n" for row in columns)


LEVITATED = {
    "rig.yaml": "name: r\nsample_rate: 256 Hz\nmass: 4 kg +- 4 g\nchannels:\n"
    "  i: {quantity: current, unit: A, role: output, dof: x}\n"
    "  x: {quantity: displacement, unit: m, role: output, dof: x}\n"
    "  u: {quantity: current, unit: A, role: output, dof: u}\n"
    "  r: {quantity: current, unit: A, role: input, dof: r}\n",
    "pipeline.yaml": "title: r\nrig: rig.yaml\nrecordings: run.csv\n"
    "frf: {excitation: periodic, period: 1 s, result: spectra, band: 5-110 Hz}\n"
    "identify:\n  magnet: {model: magnet, input: i, magnet: {coupling: direct}}\n"
    "compare:\n  loop: {kind: certificate, certificate: {after: u}}\n"
    "report: {formats: []}\n",
    "run.csv": levitated_rotor(),
}
LEVITATED_CHANGES = [
    change
    for change in changes("pipeline.yaml", yaml.safe_load(LEVITATED["pipeline.yaml"]))
    if change[1][2:3] in (("magnet",), ("certificate",))
]


@pytest.fixture(scope="module")
def levitated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished_laboratory(tmp_path_factory.mktemp("levitated"), LEVITATED)


@pytest.mark.parametrize("change", LEVITATED_CHANGES, ids=described)
def test_a_changed_key_of_a_levitated_rotor_reaches_the_result(
    levitated: Path, change: tuple[str, tuple[str, ...], Any], tmp_path: Path
) -> None:
    tree = changed(yaml.safe_load(LEVITATED["pipeline.yaml"]), change[1], change[2])
    same_as_a_new_folder(levitated, {"pipeline.yaml": yaml.safe_dump(tree, sort_keys=False)}, tmp_path)


def test_every_declared_setting_of_a_levitated_rotor_is_changed() -> None:
    seen = {keys[-1] for _, keys, value in LEVITATED_CHANGES if value is not None}
    for owner in (MagnetSettings, LoopCertificateSettings):
        assert {
            key for key, (setting, _) in settings_of(owner).items() if other_value(setting, None) is not None
        } <= seen
