"""labpipe plan as a user meets it: files, prediction, refusals, and a test carried out as planned on a
simulated rig.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pytest
import yaml
from scipy.signal import cont2discrete, lfilter

from labpipe.artefacts.json_file import entry_of
from labpipe.errors import DataError
from labpipe.estimation.settings import MODELS
from labpipe.methods.floating_bearing.virtual_rig import FilmCondition, FloatingRig, coefficients, motions
from labpipe.methods.journal_bearing.kind import JournalSettings
from labpipe.methods.planning.model import planned_model
from labpipe.methods.planning.plan_file import read_plan
from labpipe.methods.planning.records import Plan
from labpipe.quantities import parse_value
from tests.conftest import Command

ROOT = Path(__file__).parents[3]
BALL, MENDES = str(ROOT / "configs/bearings/nsk-6208.yaml"), str(ROOT / "configs/rotors/mendes.yaml")
PEDESTAL = {
    "model": "sdof",
    "mass": "0.79 kg",
    "expected": {"k": "134.5 kN/m", "c": "3.682 N.s/m"},
    "noise": {"force": "20 mN", "displacement": "0.3 um"},
    "sample_rate": "1 kHz",
    "band": "60-72 Hz",
    "period": "2 s",
    "force_limit": "1 N",
    "duration": "40 s",
}
ROTOR = {
    "model": "rotor-2dof",
    "mass": "0.92 kg",
    "expected": {
        **{"k_xx": "180 kN/m", "k_xy": "25 kN/m", "k_yx": "-18 kN/m", "k_yy": "210 kN/m"},
        **{"c_xx": "120 N.s/m", "c_xy": "15 N.s/m", "c_yx": "-10 N.s/m", "c_yy": "150 N.s/m"},
    },
    "noise": {"force": "20 mN", "displacement": "0.3 um"},
    "sample_rate": "1 kHz",
    "band": "40-100 Hz",
    "period": "0.5 s",
    "force_limit": "1 N",
    "duration": "20 s",
    "floor": "40 %",
}


# Of fits to FRFs, which take one shaker after the other.
DIRECT = {
    **ROTOR,
    "model": "rotor-2dof-direct",
    "expected": {"k_xx": "180 kN/m", "k_yy": "210 kN/m", "c_xx": "120 N.s/m", "c_yy": "150 N.s/m"},
}
CHAIN = {
    **ROTOR,
    "model": "mdof",
    "expected": {
        **{"k_x_x": "180 kN/m", "k_x_y": "-25 kN/m", "k_y_x": "-25 kN/m", "k_y_y": "210 kN/m"},
        **{"c_x_x": "120 N.s/m", "c_x_y": "-15 N.s/m", "c_y_x": "-15 N.s/m", "c_y_y": "150 N.s/m"},
    },
}
LIMITED = (("force", "N"), ("displacement", "m"))


def _write(folder: Path, entries: dict[str, object]) -> Path:
    path = folder / "plan.yaml"
    path.write_text(yaml.safe_dump({"title": "Planned", "plan": entries}), encoding="utf-8")
    return path


def _carry_out(plan: Plan, folder: Path, seed: int) -> None:
    """Recordings of the plan's signal files on the expected rig, in its steady state, with the noise that the
    plan assumes.
    """
    expected = {c.name: c.expected for c in plan.coefficients}
    model = planned_model(plan.model, expected, plan.mass)
    rng = np.random.default_rng(seed)
    (folder / "recordings").mkdir()
    for test in plan.tests:
        applied = [pc.read_csv(folder / name)["f [N]"].to_numpy() for name in test.files]
        n_sample = applied[0].size
        forces = np.zeros((model.n_dof, n_sample))
        for shaker, signal in zip(test.shakers, applied, strict=True):
            forces[("x", "y").index(shaker)] = signal
        frequency = np.fft.rfftfreq(n_sample, 1 / plan.sample_rate)
        moved = np.fft.irfft(
            np.einsum("lij,jl->il", model.receptance(2 * np.pi * frequency), np.fft.rfft(forces)), n_sample
        )
        names = ["f"] if len(test.shakers) == 1 else ["f_1", "f_2"]
        columns = {
            f"{name} [N]": signal + 0.02 * rng.normal(size=n_sample)
            for name, signal in zip(names, applied, strict=True)
        }
        columns |= {
            f"{axis} [m]": row + 0.3e-6 * rng.normal(size=n_sample)
            for axis, row in zip("xy"[: model.n_dof], moved, strict=True)
        }
        pc.write_csv(pa.table(columns), folder / "recordings" / f"{test.name}.csv")


@pytest.mark.parametrize(
    ("entries", "scheme"),
    [
        pytest.param(PEDESTAL, "one by one", marks=pytest.mark.long),
        pytest.param(ROTOR, "interleaved", marks=pytest.mark.long),
        pytest.param(ROTOR, "together", marks=pytest.mark.long),
        pytest.param(DIRECT, "one by one", marks=pytest.mark.long),
        pytest.param(CHAIN, "one by one", marks=pytest.mark.long),
    ],
)
def test_a_test_carried_out_as_planned(
    labpipe: Command, tmp_path: Path, entries: dict[str, object], scheme: str
) -> None:
    # The truth is what was expected; the stated errors are those predicted, the noise being estimated from
    # the periods.
    folder = tmp_path / "planned"
    ended = labpipe("plan", _write(tmp_path, {**entries, "scheme": scheme}), "-o", folder)
    assert ended.code == 0, ended.err
    plan = read_plan(folder / "plan.json")
    assert plan.scheme == scheme
    _carry_out(plan, folder, 7)
    ended = labpipe("run", folder / "pipeline.yaml", "-o", tmp_path / "out")
    assert ended.code == 0, ended.err
    (fit,) = json.loads((tmp_path / "out" / "identification.json").read_text("utf-8"))["fits"]
    found = {p["name"]: p for p in fit["parameters"]}
    for c in plan.coefficients:
        assert abs(found[c.name]["value"] - c.expected) < 4.5 * c.error_weighted * c.scale
        assert found[c.name]["std_error"] == pytest.approx(c.error * c.scale, rel=0.3)
    # The result is what is expected of the next test.
    again = {name: value for name, value in entries.items() if name != "expected"} | {
        "earlier": "out/identification.json"
    }
    ended = labpipe("plan", _write(tmp_path, {**again, "scheme": scheme}), "-o", tmp_path / "second")
    assert ended.code == 0, ended.err
    second = read_plan(tmp_path / "second" / "plan.json")
    assert all(
        c.error_range is not None and c.error_range[0] <= c.error <= c.error_range[1]
        for c in second.coefficients
    )
    assert second.gain_range is not None
    values = {c.name: c.expected for c in second.coefficients}
    assert values == pytest.approx({c.name: found[c.name]["value"] for c in plan.coefficients})


@pytest.mark.parametrize("mass", ["0.79 kg +- 5 g", ""])
def test_a_model_of_a_plugin_is_planned_and_evaluated(
    labpipe: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mass: str
) -> None:
    """The structural damping of the page on models, F = (k + jh - w^2 m) X, in the place of one that the
    table has. Recordings are the closed form of the planned lines with white noise; their fits state the
    errors that were predicted, and hold. The poles of free motion are j sqrt((k + jh) / m) and its conjugate.
    """
    page = (ROOT / "docs/pages/extend/estimator.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n([^`]*def structural.*?)```", page, re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)
    monkeypatch.setitem(MODELS._loaded, "sdof", names["structural"])
    truth = {"k": 134.5e3, "h": 1.9e3} | ({} if mass else {"m": 0.79})
    units = {"k": "N/m", "h": "N/m", "m": "kg"}
    expected = {name: f"{value} {units[name]}" for name, value in truth.items()}
    entries = {**PEDESTAL, "expected": expected} | ({"mass": mass} if mass else {})
    if not mass:
        del entries["mass"]
    folder = tmp_path / "planned"
    ended = labpipe("plan", _write(tmp_path, entries), "-o", folder)
    assert ended.code == 0, ended.err
    plan = read_plan(folder / "plan.json")
    (test,) = plan.tests
    free = planned_model("sdof", truth, 0.79 if mass else None).free_motion
    assert free is not None and np.isrealobj(free)
    pole = 1j * np.sqrt((134.5e3 + 1.9e3j) / 0.79)
    np.testing.assert_allclose(sorted(np.linalg.eigvals(free), key=np.imag), [pole.conj(), pole], rtol=1e-9)
    (applied,) = (pc.read_csv(folder / name)["f [N]"].to_numpy() for name in test.files)
    w = 2 * np.pi * np.fft.rfftfreq(applied.size, 1 / plan.sample_rate)
    moved = np.fft.irfft(np.fft.rfft(applied) / (134.5e3 + 1.9e3j - 0.79 * w**2), applied.size)
    rng = np.random.default_rng(3)
    columns = {"f [N]": 0.02, "x [m]": 0.3e-6}
    samples = {
        name: row + sigma * rng.normal(size=row.size)
        for (name, sigma), row in zip(columns.items(), (applied, moved), strict=True)
    }
    (folder / "recordings").mkdir()
    pc.write_csv(pa.table(samples), folder / "recordings" / f"{test.name}.csv")
    ended = labpipe("run", folder / "pipeline.yaml", "-o", tmp_path / "out")
    assert ended.code == 0, ended.err
    (fit,) = json.loads((tmp_path / "out" / "identification.json").read_text("utf-8"))["fits"]
    found = {p["name"]: p for p in fit["parameters"]}
    assert [c.name for c in plan.coefficients] == list(truth)
    if mass:
        # Z = k + jh - w^2 m: at the resonance k errs by w^2 dm = k dm / m, h not at all.
        k, h = (c.systematic for c in plan.coefficients)
        assert k == pytest.approx(0.005 / 0.79, rel=0.01) and h is not None and h < 1e-5
    for c in plan.coefficients:
        assert abs(found[c.name]["value"] - truth[c.name]) < 4 * found[c.name]["std_error"]
        assert found[c.name]["std_error"] == pytest.approx(c.error * c.scale, rel=0.3)


@pytest.mark.long
def test_files_and_words(labpipe: Command, tmp_path: Path) -> None:
    path = _write(tmp_path, {**PEDESTAL, "goal": {"c": "0.01 %"}, "displacement_limit": "20 um"})
    ended = labpipe("plan", path, "-o", tmp_path / "out")
    assert ended.code == 0, ended.err
    assert "The goals are NOT met: they need" in ended.out
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "pipeline.yaml",
        "plan.json",
        "report.html",
        "rig.yaml",
        "x.csv",
    ]
    plan = read_plan(tmp_path / "out" / "plan.json")
    (test,) = plan.tests
    force = pc.read_csv(tmp_path / "out" / "x.csv")["f [N]"].to_numpy()
    assert force.size == (test.periods + test.skip) * 2000
    assert np.abs(force).max() <= test.peak_force[0] <= 1.0
    assert test.peak_displacement[0] <= 20e-6
    assert plan.efficiency >= 0.999
    assert plan.duration == 40.0
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "Certificate" in page and "goals are NOT met" in page
    sure = float(page.partition("efficiency of at least ")[2].partition(" %")[0])
    assert 100 * plan.efficiency - 0.01 < sure <= 100 * plan.efficiency
    assert "134.5 kN/m" in page and "3.682 N.s/m" in page
    assert entry_of(read_plan(tmp_path / "out" / "plan.json")) == entry_of(plan)


def integrated(rig: tuple[np.ndarray, ...], applied: np.ndarray, step: float) -> np.ndarray:
    """Outputs (n_step, n_output) of y' = A y + B u, C y + D u from rest, u (n_step, n_input) straight between
    samples: its eigenvectors part the discrete system, as scipy discretises it, into filters of first order.
    """
    a, b, c, d, _ = cont2discrete(rig, step, "foh")
    roots, vectors = np.linalg.eig(a)
    drive = applied @ np.linalg.solve(vectors, b).T
    parted = [lfilter([0, 1], [1, -root], each) for root, each in zip(roots, drive.T, strict=True)]
    return np.asarray((np.transpose(parted) @ (c @ vectors).T).real + applied @ d.T)


@pytest.mark.long
@pytest.mark.parametrize(
    "changes",
    [
        {**PEDESTAL, "sample_rate": "145 Hz"},
        {
            **PEDESTAL,
            "mass": "2.1 kg",
            "expected": {"k": "160 kN/m", "c": "9 N.s/m"},
            "band": "20-47 Hz",
            "displacement_limit": "60 um",
        },
        {**PEDESTAL, "displacement_limit": "60 um", "force_limit": "3 N", "sample_rate": "3 kHz", "skip": 0},
        {
            **ROTOR,
            "displacement_limit": "20 um",
            "force_limit": "5 N",
            "scheme": "together",
            "sample_rate": "4.096 kHz",
        },
        {
            **ROTOR,
            "shakers": ["20 deg", "100 deg"],
            "force_limit": "3 N",
            "scheme": "interleaved",
            "sample_rate": "202 Hz",
        },
    ],
)
def test_what_is_written_obeys_the_limits(
    labpipe: Command, tmp_path: Path, changes: dict[str, object]
) -> None:
    # Sampled finer by sines, and on the expected rig from rest to rest: an integration in time that knows
    # nothing of lines.
    assert labpipe("plan", _write(tmp_path, changes), "-o", tmp_path / "out").code == 0
    plan = read_plan(tmp_path / "out" / "plan.json")
    force_limit, displacement_limit = (
        parse_value(str(changes.get(f"{name}_limit", f"1 {unit}")), unit) for name, unit in LIMITED
    )
    model = planned_model(plan.model, {c.name: c.expected for c in plan.coefficients}, plan.mass)
    n_period, n_dof, fine = (
        round(plan.period * plan.sample_rate),
        model.n_dof,
        int(np.ceil(6400 / plan.sample_rate)),
    )
    stiffness, damping, mass = (
        model.given + np.einsum("n,nkij->kij", model.expected, model.elements)
    ) * np.ones((3, n_dof, n_dof))
    inverse = np.linalg.inv(mass)
    states = np.block([[np.zeros((n_dof, n_dof)), np.eye(n_dof)], [-inverse @ stiffness, -inverse @ damping]])
    for test in plan.tests:
        forces, size = np.zeros((n_dof, n_period * (test.periods + test.skip) * fine)), n_period * fine
        for name, shaker, told in zip(test.files, test.shakers, test.peak_force, strict=True):
            written = pc.read_csv(tmp_path / "out" / name)["f [N]"].to_numpy()
            spectrum = np.fft.rfft(written[:n_period]) / n_period
            period, finer = (np.fft.irfft(spectrum * n, n) for n in (size, 8 * size))
            assert np.abs(written).max() <= told <= force_limit
            # 512 samples and more per period of the highest line leave at most 2e-5 of the peak between them.
            assert np.cos(np.pi / 192) * (1 - 2e-5) * told <= np.abs(finer).max() <= told
            angle = {"x": 0.0, "y": np.pi / 2}.get(
                shaker, np.radians(float(shaker.removesuffix(" deg")) if "deg" in shaker else 0.0)
            )
            forces += np.outer(
                (np.cos(angle), np.sin(angle))[:n_dof], np.tile(period, test.periods + test.skip)
            )
        step = 1 / plan.sample_rate / fine
        rest = np.zeros((n_dof, round(1.0 / step)))
        inputs, outputs = np.vstack([np.zeros((n_dof, n_dof)), inverse]), np.eye(n_dof, 2 * n_dof)
        applied = np.hstack([forces, rest]).T
        moved = integrated((states, inputs, outputs, np.zeros((n_dof, n_dof))), applied, step)
        assert np.all(np.abs(moved).max(axis=0) <= np.array(test.peak_displacement) * (1 + 1e-4))
        assert max(test.peak_displacement) <= displacement_limit


@pytest.mark.long
def test_a_floating_bearing_expected_from_theory(labpipe: Command, tmp_path: Path) -> None:
    """The written signals on the virtual rig, whose shaft moves along: coefficients end within the predicted
    errors of the rig's own.
    """
    condition = FilmCondition(film="journal", load=5e3, speed=50.0)
    rig = FloatingRig(
        "virtual-floating-rig",
        stator_mass=60.0,
        shaft_mass=50.0,
        conditions=(("oil", condition),),
        journal=JournalSettings(
            kind="journal-bearing", diameter=0.1, length=0.05, clearance=1e-4, viscosity=0.03
        ),
    )
    noise = {"force": 3.0, "displacement": 1e-7, "acceleration": 0.1}
    entries = {
        "model": "dynamic-stiffness",
        "mass": "60 kg",
        "expected": {
            "bearing": str(ROOT / "configs/bearings/floating-journal.yaml"),
            "load": "5 kN",
            "speed": "3000 rpm",
        },
        "noise": {"force": "3 N", "displacement": "0.1 um", "acceleration": "0.1 m/s^2"},
        "sample_rate": "500 Hz",
        "band": "20-100 Hz",
        "period": "0.5 s",
        "force_limit": "1 kN",
        "duration": "10 s",
        "scheme": "interleaved",
    }
    folder = tmp_path / "planned"
    ended = labpipe("plan", _write(tmp_path, entries), "-o", folder)
    assert ended.code == 0, ended.err
    plan = read_plan(folder / "plan.json")
    (test,) = plan.tests
    forces = np.stack([pc.read_csv(folder / name)["f [N]"].to_numpy() for name in test.files], axis=1)
    frequency = np.fft.rfftfreq(len(forces), 1 / plan.sample_rate)[1:]
    applied = np.fft.rfft(forces, axis=0)[1:]
    stator, shaft = motions(rig, condition, frequency, np.hstack([applied, np.zeros_like(applied)]))
    seen = np.hstack([applied, stator - shaft, -((2 * np.pi * frequency[:, None]) ** 2) * stator])
    clean = np.fft.irfft(np.vstack([np.zeros(6), seen]), len(forces), axis=0)
    rng = np.random.default_rng(3)
    names = ["f_1 [N]", "f_2 [N]", "x [m]", "y [m]", "a_x [m/s^2]", "a_y [m/s^2]"]
    noisy = clean + rng.normal(size=clean.shape) * np.repeat(list(noise.values()), 2)
    (folder / "recordings").mkdir()
    pc.write_csv(pa.table(dict(zip(names, noisy.T, strict=True))), folder / "recordings" / f"{test.name}.csv")
    for stage in ("frf", "identify"):
        ended = labpipe(stage, "-c", folder / "pipeline.yaml", "-o", tmp_path / "out")
        assert ended.code == 0, ended.err
    (fit,) = json.loads((tmp_path / "out" / "identification.json").read_text("utf-8"))["fits"]
    found = {p["name"]: p for p in fit["parameters"]}
    true = dict(
        zip((c.name for c in plan.coefficients), np.ravel(coefficients(rig, condition)[:2]), strict=True)
    )
    for c in plan.coefficients:
        # Theory on its usual mesh and the rig's converged film differ by tenths of a per cent.
        assert c.expected == pytest.approx(true[c.name], rel=0.02)
        assert abs(found[c.name]["value"] - true[c.name]) < 4 * c.error_weighted * c.scale
        assert found[c.name]["std_error"] == pytest.approx(c.error * c.scale, rel=0.3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shakers": ["45 deg"]}, "determines 4 of 8 coefficients"),
        ({"shakers": ["up"]}, "'up' is not a direction"),
        ({"duration": "0.5 s", "band": "60-80 Hz"}, "a duration of"),
        ({"goal": {"k_zz": "2 %"}}, "the model has no coefficient k_zz"),
        ({"mass": "0.92 N"}, "wrong dimension"),
        ({"band": "600-700 Hz"}, "needs more than 1400 Hz of sampling rate"),
        ({"noise": {}}, "no sensor has noise"),
        ({"noise_density": {"force": "1 mN/Hz^0.5"}}, "one of 'noise' and 'noise_density'"),
        ({"floor": "100 %"}, "leaves nothing to plan"),
        ({"period": "1e7 s"}, "a period of 1e+07 s has 6e+08 lines in the band"),
        ({"expected": {"k_xx": "1 N/m"}}, "no value is expected for k_xy"),
        ({"earlier": "none.json"}, "no such file"),
        ({"combine_earlier": True}, "there is no earlier result to combine"),
        ({"expected": {"bearing": "none.yaml"}}, "none.yaml"),
        ({"expected": {"bearing": BALL, "load": "1 N"}}, "a file of a ball-bearing has no 'load'"),
        ({"expected": {"rotor": MENDES, "load": "1 N"}}, "the load follows from the rotor"),
        ({"expected": {"rotor": MENDES, "name": "bearing 9"}}, "no bearing 'bearing 9'"),
        ({"speeed": "50 Hz"}, "did you mean 'speed'"),
        ({"exclude": ["49-51 kHz"]}, "'exclude' of 49000-51000 Hz leaves nothing out of the band"),
    ],
)
def test_refusals_name_place_and_remedy(
    labpipe: Command, tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    alike = {
        **ROTOR["expected"],
        "k_yy": "180 kN/m",
        "k_xy": "0 N/m",
        "k_yx": "0 N/m",
        "c_yy": "120 N.s/m",
        "c_xy": "0 N.s/m",
    }
    entries = {
        **ROTOR,
        "expected": {**alike, "c_yx": "0 N.s/m"},
        "period": "0.25 s",
        "scheme": "interleaved",
        **changes,
    }
    ended = labpipe("plan", _write(tmp_path, entries), "-o", tmp_path / "out")
    assert ended.code == 2
    assert message in ended.err and "plan.yaml" in ended.err and "Traceback" not in ended.err
    assert not (tmp_path / "out").exists()


def test_a_single_shaker_moves_its_own_direction(labpipe: Command, tmp_path: Path) -> None:
    entries = {**PEDESTAL, "shakers": ["z"]}
    ended = labpipe("plan", _write(tmp_path, entries), "-o", tmp_path / "out")
    assert ended.code == 0, ended.err
    channels = yaml.safe_load((tmp_path / "out" / "rig.yaml").read_text())["channels"]
    assert [channel["dof"] for channel in channels.values()] == ["z", "z"]


def test_another_file_is_no_plan(tmp_path: Path) -> None:
    (tmp_path / "plan.json").write_text('{"schema": "labpipe/identification/1"}', encoding="utf-8")
    with pytest.raises(DataError, match="is not a readable plan"):
        read_plan(tmp_path / "plan.json")
    with pytest.raises(DataError, match="run `labpipe plan` first"):
        read_plan(tmp_path / "none.json")
