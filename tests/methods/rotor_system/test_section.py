"""The section from its files: the shipped pipeline, faults at their place, the file as declared."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import yaml

from labpipe.errors import ConfigError, SettingError
from labpipe.methods.rotor_system import predictions
from labpipe.methods.rotor_system.build import Sensors, SmallErrors, build
from labpipe.methods.rotor_system.evaluate import (
    check_counts_once,
    evidence_of,
    explained_text,
    free_modes_of,
    limits_of,
    measured_in_band,
    sensors_of,
    system_result,
)
from labpipe.methods.rotor_system.model import Unknown
from labpipe.methods.rotor_system.posterior import Explanation, SystemPosterior, fit_system
from labpipe.methods.rotor_system.settings import RotorSystemSettings, SystemTest
from labpipe.methods.rotor_system.system_file import load_system
from labpipe.methods.rotor_system.virtual_rig import KIND, RotorTestRig, record
from labpipe.methods.run_ups.records import ProbeError, RunUp
from labpipe.methods.run_ups.settings import RunSettings
from labpipe.project.exports import parameter_table
from labpipe.project.judging import judge
from labpipe.project.marked_yaml import parse_marked
from labpipe.project.rules import read_rules
from labpipe.project.settings_reader import Faults
from labpipe.project.work import Work
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.records.uncertain import ChannelUncertainty, Uncertain, Uncertainty
from tests.methods.rotor_system.two_discs import OIL, system

ROOT = Path(__file__).parents[3]
# Of a rotor as declared: its interval is many times wider than they can move it.
FEW_DRAWS = 100


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory):
    """The shipped pipeline from its raw recordings, shaken in one direction and with fewer draws."""
    import labpipe

    folder = tmp_path_factory.mktemp("rotor")
    text = (ROOT / "pipelines/rotor-system.yaml").read_text()
    pipeline = yaml.safe_load(text.replace("../", f"{ROOT}/"))
    del pipeline["tests"][2], pipeline["rotor_system"]["tests"][2]
    pipeline["rotor_system"]["tests"][2]["name"] = "coast-down"
    pipeline["rotor_system"]["draws"] = 20
    # Two bearings on two pedestals bring at most four modes below the first of the free rotor.
    pipeline["rotor_system"]["tests"][0]["frequencies"] = ["111 Hz +- 0.2 Hz"]
    pipeline["rotor_system"]["tests"][1]["frequencies"] = [f"{f} Hz +- 1 Hz" for f in (44, 60, 80, 95, 105)]
    pipeline["accept"] = {
        "rotor_system.least_decrement": ">= 0.02",
        "rotor_system.decrement_probability": "<= 0.5",
        "rotor_system.decrement": "broken",
        "rotor_system.vibration_left": "< 1 um",
        "rotor_system.warnings": "not tests-disagree",
    }
    (folder / "pipeline.yaml").write_text(yaml.safe_dump(pipeline, sort_keys=False))
    return labpipe.run(folder / "pipeline.yaml", folder / "out"), folder


@pytest.mark.long
def test_unknowns_of_the_raw_recordings_hold_the_truth(result) -> None:
    """The recordings were made with values drawn from what the rotor file declares; 13 unknowns of one rotor
    are within 4 of their errors, and all but the free ones told at least ten times better than declared.
    """
    found, _ = result
    truth = json.loads((ROOT / "sample_data/rotor-system/truth.json").read_text())["truth"]
    system = found.sections["rotor_system"]
    own = [
        u
        for u in system.unknowns
        if not u.group and u.name in truth and not u.name.startswith(("gain", "phase"))
    ]
    assert len(own) == 17
    for unknown in own:
        if unknown.unit == "kg.m":
            z = (unknown.value - truth[unknown.name]) / unknown.error
        else:
            nominal = 1.0 if unknown.name.startswith("sleeve") else unknown.prior
            z = (math.log(unknown.value / nominal) - truth[unknown.name]) * unknown.value / unknown.error
        assert abs(z) < 4, unknown.name
    assert all(test.probability > 1e-3 for test in system.tests)
    # Speeds that nobody states are 5 % to 150 % of the file's.
    assert system.campbell.speed[[0, -1]] == pytest.approx([0.05 * 70, 1.5 * 70])


def test_rules_address_it_and_the_report_shows_it(result) -> None:
    found, folder = result
    assert found.accepted and len(found.outcomes) == 8
    # By the test, not by the file: files of two tests may have one name.
    assert (folder / "out/recordings/coast-down.recording.parquet").exists()
    page = (folder / "out/report.html").read_text()
    for words in (
        "What follows for the rotor",
        "the share of its variance that would go if one source were known",
        "small errors of bearings",
        "apparent mass [kg]",
        "phase [rad]",
        "without this test larger by",
        "least log decrement at 4200 rpm (mode of ",
        "no test tells" if "no test tells" in page else "declared",
    ):
        assert words in page
    assert "probability 100 %" not in page and "probability 0 %" not in page
    assert found.sections["rotor_system"].measured == tuple((0.0, f) for f in (44, 60, 80, 95, 105))
    assert "squares: what tests in the bearings measured" in page and "amplitude there [um]" in page
    # Exported as well, where every number has its row.
    table = parameter_table(folder / "out/identification.json")
    assert table[table.fit == "rotor_system"].value.tolist() == found.to_frame().value.tolist()
    frame = found.to_frame()
    assert {"young", "least_decrement", "onset"} <= set(frame[frame.fit == "rotor_system"].parameter)


def test_an_order_of_modes_that_no_springs_make_is_named(result) -> None:
    findings = result[0].sections["rotor_system"].findings
    (said,) = [finding.message for finding in findings if finding.code == "interlacing"]
    assert "mode 5 at 105 Hz lies below bending mode 1 of test 'free', 111 Hz" in said


def test_weights_calm_the_rotor_that_was_recorded(result) -> None:
    """A twentieth of the vibration, in the independent calculation's rotors 2.4 % in the median."""
    balance = result[0].sections["rotor_system"].balance
    assert balance.after < 0.05 * balance.before and balance.interval[0] < balance.after < balance.interval[1]
    # Over the speeds that the weights are made for it is the same vibration.
    course = balance.vibration
    within = [28 < speed < 39 for speed in course.speed]
    before, after = (np.array(part)[within] for part in (course.before, course.after))
    assert before.min() < balance.before < before.max() and np.all(after < 0.1 * before)
    # And no peak is narrower than the steps about it.
    drawn = np.array(course.speed)
    for critical in result[0].sections["rotor_system"].criticals:
        if drawn[0] < critical.speed < drawn[-1] and critical.amplification:
            near = np.abs(drawn - critical.speed) < critical.speed / critical.amplification
            assert np.count_nonzero(near) >= 5
    page = (result[1] / "out/report.html").read_text()
    assert "with the weights" in page


def test_trial_runs_are_taken_together_with_it(result, labpipe, tmp_path) -> None:
    """`labpipe balance` by the model alone has the weights of the section, which takes draws in place of
    derivatives; a run with these weights that leaves nothing narrows what one more would leave.
    """
    balance, model = result[0].sections["rotor_system"].balance, result[1] / "out/identification.json"
    planes = [f"node {weight.node}" for weight in balance.weights]
    file = {"model": str(model), "planes": planes, "repeatability": "1 %", "noise": "0.1 um"}
    (tmp_path / "b.yaml").write_text(yaml.safe_dump(file))
    ended = labpipe("balance", tmp_path / "b.yaml", "--json", tmp_path / "b.json")
    alone = json.loads((tmp_path / "b.json").read_text())
    assert ended.code == 0 and len(alone["readings"]) == 12
    for ours, theirs in zip(alone["weights"], balance.weights, strict=True):
        assert ours["size"] == pytest.approx(theirs.size, rel=0.05)
        assert ours["angle"] == pytest.approx(theirs.angle, abs=0.05)
    weights = {w["plane"]: f"{1e6 * w['size']} g.mm at {w['angle']} rad" for w in alone["weights"]}
    readings = {r["name"]: "0.1 um at 0 deg" for r in alone["readings"]}
    file["runs"] = [{"name": "weights", "weights": weights, "readings": readings}]
    (tmp_path / "b.yaml").write_text(yaml.safe_dump(file))
    assert labpipe("balance", tmp_path / "b.yaml", "--json", tmp_path / "b.json").code == 0
    trimmed = json.loads((tmp_path / "b.json").read_text())
    assert trimmed["residual"]["ci95"][1] < alone["residual"]["ci95"][1]
    for change, said in (
        ({"planes": ["node 6"]}, "no plane 'node 6'"),
        ({"model": "b.yaml"}, "no influence"),
    ):
        (tmp_path / "b.yaml").write_text(yaml.safe_dump({**file, "runs": [], **change}))
        refused = labpipe("balance", tmp_path / "b.yaml")
        assert refused.code == 2 and said in refused.err


@pytest.mark.parametrize(
    ("change", "where", "said"),
    [
        ({"rotor_system": {"tests": []}}, "rotor_system", "tests: is empty"),
        ({"tests.0.test": "fre"}, "rotor_system", "no FRF 'fre'; did you mean 'free'?"),
        ({"tests.2.test": "shaken y"}, "rotor_system.tests", "'shaken y' and 'shaken z' are one measurement"),
        ({"tests.4.fit": "x"}, "rotor_system.tests", "'fit' is of kind modes or response"),
        ({"tests.4.mass": "33 kg"}, "rotor_system.tests", "'mass' needs its uncertainty"),
        ({"tests.1.speed": "-10 Hz"}, "rotor_system.tests.2.speed", "speed must not be negative"),
        ({"rotor_system": {"speeds": "0-100 Hz"}}, "rotor_system.speeds", "must be positive"),
        ({"tests.1.places": {"d9": "3 y"}}, "rotor_system", "test 'shaken y': places: no dof or plane 'd9'"),
        ({"tests.1.frequencies": ["60 Hz +- 1 Hz", "44 Hz +- 1 Hz"]}, "frequencies", "begin with the lowest"),
        (
            {"tests.1.frequencies": ["44 Hz +- 1 Hz"], "tests.1.fit": "modal"},
            "rotor_system.tests.2.fit",
            "natural frequencies are those of 'fit' or 'frequencies'",
        ),
        (
            {"tests.4.deflections": {"5 z / 10 z": "0.3 um/N +- 1 %", "5z/10z": "0.4 um/N +- 1 %"}},
            "rotor_system.tests.5.deflections",
            "'5z/10z' appears twice",
        ),
        ({"rotor_system": {"balance_speeds": ["0 Hz"]}}, "rotor_system.balance_speeds", "must be positive"),
        ({"rotor_system": {"small_errors": {"phase": "-1 deg"}}}, "phase", "must not be negative"),
    ],
)
def test_faults_are_said_at_their_place(tmp_path: Path, labpipe, change: dict, where: str, said: str) -> None:
    pipeline = yaml.safe_load((ROOT / "pipelines/rotor-system.yaml").read_text().replace("../", f"{ROOT}/"))
    for key, value in change.items():
        if key == "rotor_system":
            pipeline["rotor_system"] |= value
        else:
            _, number, name = key.split(".")
            pipeline["rotor_system"]["tests"][int(number)][name] = value
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(pipeline, sort_keys=False))
    ended = labpipe("run", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert ended.code == 2 and where in ended.err and said in ended.err
    assert not (tmp_path / "out/identification.json").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("estimate: [yong]", "unknown name 'yong'; did you mean 'young'?"),
        ("pedestals: [{bearing: leftt, mass: 8 kg, stiffness: 50 MN/m}]", "no bearing 'leftt'"),
        (
            "pedestals: [{bearing: left, mass: 8 kg, stiffness: 50 MN/m}, "
            "{bearing: left, mass: 8 kg, stiffness: 50 MN/m}]",
            "pedestals: a second one of bearing 'left'",
        ),
        ("pedestals: [{bearing: left, mass: 0 kg, stiffness: 50 MN/m}]", "mass must be positive"),
        ("pedestals: [{bearing: left, mass: 8 kg, stiffness: -1 MN/m}]", "stiffness must be positive"),
        ("damping: {internl: 30 us}", "damping.internl: unknown key"),
        ("damping: {internal: -30 us}", "internal must not be negative"),
        ("damping: {internal: 0 us +- 30 us}", "damping.internal: 'internal' of zero has no uncertainty"),
        ("{damping: {alpha: 1 1/s}, estimate: [internal]}", "the rotor has nothing that 'internal' frees"),
        ("{pedestals: [], estimate: [masses, pedestals]}", "the rotor has nothing that 'pedestals' frees"),
        ("estimate: clearance", "the rotor has nothing that 'clearance' frees"),
        (
            "sleeves: [{element: 4, outer_diameter: 50 mm, stiffening: 1.2 +- 30 %, name: A}, "
            "{element: 5, outer_diameter: 50 mm, stiffening: 1.4 +- 30 %, name: A}]",
            "a second stiffening of sleeves 'A'",
        ),
        (
            "sleeves: [{element: 4, outer_diameter: 50 mm, stiffening: 1.2 +- 30 %, name: A}, "
            "{element: 5, outer_diameter: 50 mm, stiffening: 1.2 +- 10 %, name: A}]",
            "a second stiffening of sleeves 'A'",
        ),
        (
            "discs: [{node: 5, mass: 12 kg +- 3 % (source=scale), transverse_inertia: 0.06 kg.m^2, "
            "polar_inertia: 0.11 kg.m^2}, {node: 10, mass: 9 kg +- 3 % (source=scale), "
            "transverse_inertia: 0.04 kg.m^2, polar_inertia: 0.07 kg.m^2}]",
            "discs: source=scale: only numbers of bearing models can have one error in common",
        ),
    ],
)
def test_faults_of_a_rotor_file(tmp_path: Path, labpipe, text: str, said: str) -> None:
    whole = yaml.safe_load((ROOT / "configs/rotors/two-discs.yaml").read_text()) | yaml.safe_load(text)
    (tmp_path / "rotor.yaml").write_text(yaml.safe_dump(whole, sort_keys=False))
    ended = labpipe("rotor", tmp_path / "rotor.yaml")
    assert ended.code == 2 and said in ended.err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("unbalances: [{node: 5, size: 20 g.mm}]", "the unbalance at node 5 has no uncertainty"),
        (
            "bearings: [{kind: journal-bearing, name: left, node: 2, diameter: 40 mm, length: 20 mm, "
            "clearance: 90 um, viscosity: 0.05 Pa.s}, "
            "{kind: linear-bearing, name: right, node: 12, k_yy: 9 MN/m}]",
            "test 'shaken y' is at rest, where bearing 'left' has no oil film",
        ),
    ],
)
def test_what_tests_of_a_rotor_cannot_take_is_refused(tmp_path: Path, labpipe, text: str, said: str) -> None:
    whole = yaml.safe_load((ROOT / "configs/rotors/two-discs.yaml").read_text()) | yaml.safe_load(text)
    (tmp_path / "rotor.yaml").write_text(yaml.safe_dump(whole, sort_keys=False))
    pipeline = yaml.safe_load((ROOT / "pipelines/rotor-system.yaml").read_text().replace("../", f"{ROOT}/"))
    pipeline["rotor_system"]["rotor"] = "rotor.yaml"
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(pipeline, sort_keys=False))
    ended = labpipe("run", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert ended.code == 2 and said in ended.err


HAMMER = """title: t
rotor_system:
  rotor: {root}/configs/rotors/two-discs.yaml
  draws: 20
  small_errors: {{elements: 0, inertia: 0, bearings: 0, apparent_mass: 0, phase: 0}}
  tests:
    - {{name: hammer, kind: modes, frequencies: [111 Hz +- 1 Hz, 240 Hz +- 3 Hz], numbers: {numbers}}}
"""


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ("[0, 1]", "'numbers' are whole, from 1 on"),
        ("[1, 2.5]", "'numbers' are whole, from 1 on"),
        ("[2, 1]", "'numbers' are whole, from 1 on, and rise"),
        ("[1, 99]", "bending modes, not 99"),
    ],
)
def test_modes_that_a_rotor_has_not(tmp_path: Path, labpipe, numbers: str, said: str) -> None:
    (tmp_path / "p.yaml").write_text(HAMMER.format(root=ROOT, numbers=numbers))
    ended = labpipe("run", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert ended.code == 2 and said in ended.err


def test_two_unbalances_on_a_node_are_one(tmp_path: Path) -> None:
    """Their sum, with the root of the sum of the squares of their uncertainties."""
    whole = yaml.safe_load((ROOT / "configs/rotors/two-discs.yaml").read_text())
    whole["unbalances"] = [
        {"node": 5, "size": "100 g.mm +- 30 g.mm"},
        {"node": 5, "size": "100 g.mm +- 40 g.mm", "phase": "90 deg"},
    ]
    (tmp_path / "rotor.yaml").write_text(yaml.safe_dump(whole))
    ((node, mean, error),) = load_system(tmp_path / "rotor.yaml").unbalances
    assert (node, mean, error) == (5, pytest.approx(1e-4 + 1e-4j), pytest.approx(5e-5))


def test_what_a_rotor_file_states_is_not_what_it_estimates(tmp_path: Path) -> None:
    """A mass in its long form, limits of .9 kg: .9 / sqrt(3) kg. A sleeve of two rings, one of which states
    its stiffening to 10 %, does not get the usual 30 % by `estimate`. One k_yy in both directions
    is one unknown, as c is.
    """
    whole = yaml.safe_load((ROOT / "configs/rotors/two-discs.yaml").read_text())
    whole["discs"][0]["mass"] = {"value": "12 kg", "limits": "0.9 kg"}
    ring = {"element": 4, "outer_diameter": "50 mm", "stiffening": "1.35", "name": "A"}
    whole["sleeves"] = [ring | {"stiffening": "1.35 +- 10 %"}, ring | {"element": 5}, ring | {"name": "B"}]
    whole["estimate"] = ["sleeves"]
    whole["bearings"][0].pop("k_zz")
    (tmp_path / "rotor.yaml").write_text(yaml.safe_dump(whole))
    found = load_system(tmp_path / "rotor.yaml")
    names = [unknown.name for unknown in build(found, SURE, {}).model.unknowns]
    assert [name for name in names if "left" in name or "right k" in name] == [
        *("left k_yy", "left c", "pedestal left k", "right k_yy", "right k_zz", "pedestal right k")
    ]
    assert found.masses == pytest.approx((0.9 / math.sqrt(3) / 12, 0.03))
    assert [error for _, _, error in found.sleeves.values()] == pytest.approx([0.1, 0.3])


def test_pedestals_that_are_known_are_nothing_unknown(tmp_path: Path, labpipe) -> None:
    whole = (ROOT / "configs/rotors/two-discs.yaml").read_text()
    for share in ("2", "3", "30", "40", "50", "70"):
        whole = whole.replace(f" +- {share} %", "")
    (tmp_path / "rotor.yaml").write_text(whole.replace(" +- 200 g.mm", ""))
    text = HAMMER.format(root=ROOT, numbers="[1, 2]").replace(
        f"{ROOT}/configs/rotors/two-discs.yaml", "rotor.yaml"
    )
    (tmp_path / "p.yaml").write_text(text)
    ended = labpipe("run", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert ended.code == 2 and "nothing of the rotor is unknown" in ended.err


def test_a_decrement_that_is_known_is_above_its_limit_or_is_not() -> None:
    """Without any uncertainty of it, the probability is none or all."""
    of = system(False)
    linear = {
        name: replace(b, stiffness_error=0 * b.stiffness, damping_error=0 * b.damping)
        for name, b in of.linear.items()
    }
    of = replace(of, young={}, masses=(), sleeves={}, internal=(0.0, 0.0), linear=linear, unbalances=())
    for alpha, probability in ((400.0, 1.0), (0.1, 0.0)):
        damped = replace(of, rig=replace(of.rig, rotor=replace(of.rig.rotor, alpha=alpha)))
        built = build(damped, SmallErrors(0, 0, 0, 0, 0, 0), {"t": Sensors(("a",), 0.01)})
        posterior = fit_system(built.model, [], estimate_sizes=False)
        found = system_result(damped, built, posterior, np.array([40.0, 41.0]), 20, 1)
        assert found.decrement[1:] == (0.0, probability) and (found.decrement[0] > 0.1) == bool(probability)
        (rule,) = read_rules(
            "accept", parse_marked("rotor_system.decrement: brokn", "p.yaml"), Faults(), ("rotor_system",), {}
        )
        with pytest.raises(ConfigError, match=r"unknown decision 'brokn'; did you mean 'broken'\?"):
            judge([rule], (), {"rotor_system": found})


def test_a_rotor_file_without_speed_asks_for_no_margin() -> None:
    # Without internal damping there is no onset to follow through 80 draws.
    of = replace(system(False), internal=(0.0, 0.0))
    built = build(of, SmallErrors(), {})
    posterior = fit_system(built.model, [], estimate_sizes=False)
    for speed in (0.0, 100.0):
        rig = replace(of.rig, speed=speed)
        found = system_result(replace(of, rig=rig), built, posterior, np.array([40.0, 50.0]), 2, 1)
        assert all((critical.margin is None) == (not speed) for critical in found.criticals)
    assert found.criticals


def test_limits_of_a_standard_that_is_asked_for_are_findings() -> None:
    """A critical speed 5 % below 6000 rpm with AF 8: 17 (1 - 1 / 6.5) = 14.4 % are asked for."""
    far, near, unsure = (
        SimpleNamespace(speed=speed, margin=(100 - speed, 14.38), met=met)
        for speed, met in ((60.0, 1.0), (95.0, 0.0), (86.0, 0.6))
    )
    least = SimpleNamespace(speed=30.0, margin=(70.0, 0.0), met=None)
    result = SimpleNamespace(
        operating=100.0, criticals=(least, far, near, unsure), decrement=(0.04, 0.004, 0.0)
    )
    broken, undecided, decrement = limits_of("API 617", result)
    assert [of.level for of in (broken, undecided, decrement)] == ["warning", "note", "warning"]
    assert "5700 rpm at 6000 rpm is 5.0 %, where 14.4 % are asked for" in broken.message
    assert "probability of 60 %: undecided" in undecided.message
    assert "log decrement at 6000 rpm is 0.04, where more than 0.1" in decrement.message


def test_a_standard_needs_a_speed_of_the_rotor() -> None:
    of = system()
    standing = replace(of, rig=replace(of.rig, speed=0.0))
    tests = (SystemTest(name="scales", kind="static", mass="34 kg +- 0.1 kg"),)
    with pytest.raises(SettingError, match="at its speed, and the rotor file has none") as fault:
        RotorSystemSettings(rotor="r.yaml", tests=tests, standard="API 617", system=standing)
    assert fault.value.field == "standard"


def test_a_fit_of_several_bands_is_no_test_of_modes() -> None:
    fits = [SimpleNamespace(name="modes", detail=lambda _: object())] * 2
    with pytest.raises(ConfigError, match="there are 2 modal fits 'modes'"):
        free_modes_of(
            SystemTest(name="hammer", kind="modes", fit="modes"), cast("Work", SimpleNamespace(fits=fits))
        )


@pytest.mark.parametrize("band", [None, (100.0, 300.0), (120.0, 300.0)])
def test_modes_of_a_fit_beside_lines_of_its_frf_count_once(band: tuple[float, float] | None) -> None:
    """Before, such modes were known twice as well in variance. Lines beyond those of the fit are others."""
    work = cast("Work", SimpleNamespace(fits=[SimpleNamespace(name="m", test="free", band_hz=(20.0, 120.0))]))
    tests = [
        SystemTest(name="hammer", kind="modes", fit="m"),
        SystemTest(name="strings", kind="response", test="free", band=band),
    ]
    if band == (120.0, 300.0):
        check_counts_once(tests, work)
    else:
        with pytest.raises(ConfigError, match="'hammer' is a fit of the FRF of 'strings'; its lines count"):
            check_counts_once(tests, work)


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        ({"kind": "response", "test": "a"}, {"kind": "response", "test": "a", "band": (5.0, 9.0)}, True),
        ({"kind": "response", "test": "a", "band": (9.0, 12.0)}, {"kind": "response", "test": "a"}, True),
        ({"kind": "response", "test": "a", "band": (1.0, 5.0)}, {"test": "a", "band": (5.0, 9.0)}, False),
        ({"kind": "response", "test": "a"}, {"kind": "response", "test": "b"}, False),
        ({"kind": "modes", "fit": "m"}, {"kind": "modes", "fit": "m"}, True),
        ({"kind": "modes", "frequencies": ("9 Hz +- 1 Hz",)}, {"frequencies": ("9 Hz +- 1 Hz",)}, False),
        ({"kind": "static", "mass": Uncertain(9.0, 0.1)}, {"mass": Uncertain(9.0, 0.1)}, False),
    ],
)
def test_a_measurement_that_is_entered_twice_counts_once(first: dict, second: dict, same: bool) -> None:
    one, other = (SystemTest(name=n, **{**first, **entry}) for n, entry in (("x", first), ("y", second)))
    assert one.counts_as(other) == other.counts_as(one) == same


@pytest.mark.long
def test_critical_speeds_without_a_run_up(tmp_path: Path, labpipe_without_report) -> None:
    """No unbalance in the middle, as the file declares it, has no response; that of its uncertainty has."""
    (tmp_path / "p.yaml").write_text(HAMMER.format(root=ROOT, numbers="[1, 2]"))
    ended = labpipe_without_report("run", tmp_path / "p.yaml", "-o", tmp_path / "out")
    assert ended.code == 0 and "critical speed" in ended.out


@pytest.mark.long
def test_modes_of_a_modal_fit_are_a_test(tmp_path: Path) -> None:
    """The rotor on strings by a modal fit in place of its responses: the same free modes."""
    import labpipe

    pipeline = yaml.safe_load((ROOT / "pipelines/rotor-system.yaml").read_text().replace("../", f"{ROOT}/"))
    pipeline["tests"] = pipeline["tests"][:1]
    strings = {"model": "modal", "band": "60-290 Hz", "test": "free"}
    pipeline["identify"] = {"strings": strings}
    modes = {"name": "hammer", "kind": "modes", "fit": "strings"}
    pipeline["rotor_system"]["tests"] = [modes, *pipeline["rotor_system"]["tests"][3:]]
    pipeline["rotor_system"]["tests"][2]["name"] = "coast-down"
    pipeline["rotor_system"]["draws"] = 20
    del pipeline["expect"]
    pipeline["report"] = {"formats": []}
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(pipeline, sort_keys=False))
    result = labpipe.run(tmp_path / "p.yaml", tmp_path / "out").sections["rotor_system"]
    hammer = next(test for test in result.tests if test.name == "hammer")
    assert hammer.n >= 2 and hammer.probability > 1e-4


@pytest.mark.long
def test_a_rotor_as_declared_has_wide_intervals(tmp_path: Path, labpipe, monkeypatch) -> None:
    """Bearings known to 40 % leave the critical speed open to some hundred rpm."""
    monkeypatch.setattr(predictions, "DRAWS", FEW_DRAWS)
    path = tmp_path / "declared.json"
    ended = labpipe("rotor", ROOT / "configs/rotors/two-discs.yaml", "--json", path, "--speeds", "20-80 Hz")
    assert ended.code == 0 and "as declared" in ended.out
    low, high = json.loads(path.read_text())["criticals"][0]["speed_interval"]
    assert 60 * (high - low) > 300


@pytest.mark.long
def test_a_rotor_in_oil_films_by_theory(tmp_path: Path, labpipe, monkeypatch) -> None:
    """Its critical speed and the onset of whirl have intervals by clearance and viscosity; stiffness is not
    symmetric there.
    """
    monkeypatch.setattr(predictions, "DRAWS", FEW_DRAWS)
    whole = yaml.safe_load((ROOT / "configs/rotors/two-discs.yaml").read_text())
    oil = {"kind": "journal-bearing", "diameter": "40 mm", "length": "20 mm", "clearance": "60 um"}
    whole["bearings"] = [
        oil | {"name": "left", "node": 2, "viscosity": "20 mPa.s"},
        oil | {"name": "right", "node": 12, "viscosity": "20 mPa.s"},
    ]
    del whole["pedestals"]
    whole["estimate"] = ["clearance", "viscosity"]
    (tmp_path / "rotor.yaml").write_text(yaml.safe_dump(whole, sort_keys=False))
    path = tmp_path / "declared.json"
    ended = labpipe("rotor", tmp_path / "rotor.yaml", "--json", path, "--speeds", "20-80 Hz")
    assert ended.code == 0
    said = json.loads(path.read_text())
    unknowns = {unknown["name"]: unknown for unknown in said["unknowns"]}
    assert unknowns["left clearance"]["unit"] == "m" and unknowns["left clearance"]["error"] == pytest.approx(
        9e-6
    )
    speed, error = said["onset"]
    critical = said["criticals"][0]["speed"]
    assert critical < speed < 2.2 * critical and 0.001 < error < 0.2
    low, high = said["criticals"][0]["speed_interval"]
    assert low < critical < high


@pytest.mark.parametrize(
    ("probes", "band", "said"),
    [
        ((3.5,), (10.0, 300.0), "whole numbers of nodes"),
        ((), (10.0, 300.0), "probes: is empty"),
        ((3.0, 3.0), (10.0, 300.0), "each once"),
        ((14.0,), (10.0, 300.0), "from 1 to 13"),
        ((3.0,), (10.2, 10.8), "no line every 1 Hz, or one at 0 Hz, lies in the band"),
        ((3.0,), (0.0, 300.0), "or one at 0 Hz"),
    ],
)
def test_a_virtual_rotor_that_cannot_be_tested_is_refused(
    probes: tuple[float, ...], band: tuple[float, float], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        RotorTestRig(KIND, "rotor.yaml", 3, (3.0,), probes, (5.0, 50.0), band=band, system=system())


def test_runs_that_a_virtual_rotor_has_not(tmp_path: Path) -> None:
    """No film carries it at rest, and nothing drives a run-up without an unbalance."""
    own = system()
    rig = RotorTestRig(KIND, "rotor.yaml", 3, (3.0,), (3.0,), (5.0, 50.0), system=replace(own, unbalances=()))
    with pytest.raises(ConfigError, match="nothing excites the run-up"):
        record(rig, "run-up", np.random.default_rng(0))
    whole = yaml.safe_load((ROOT / "configs/rotors/two-discs.yaml").read_text())
    whole["bearings"][0] = yaml.safe_load(OIL.format("left", 2))
    (tmp_path / "rotor.yaml").write_text(yaml.safe_dump(whole))
    rig = replace(rig, system=load_system(tmp_path / "rotor.yaml"))
    with pytest.raises(ConfigError, match="the rotor rests in run 'shaken-y', where no oil film carries it"):
        record(rig, "shaken-y", np.random.default_rng(0))


def test_a_period_of_a_virtual_rotor_is_whole() -> None:
    """Of 2000 Hz / 3 Hz samples, the lines would lie elsewhere."""
    with pytest.raises(ConfigError, match=r"a period of 666.667 samples"):
        RotorTestRig(KIND, "rotor.yaml", 3, (3.0,), (3.0,), (5.0, 50.0), spacing=3.0)


def test_a_report_that_cannot_be_drawn_leaves_nothing(tmp_path: Path, labpipe) -> None:
    ended = labpipe(
        "rotor",
        ROOT / "configs/rotors/two-discs.yaml",
        "--json",
        tmp_path / "r.json",
        "-o",
        tmp_path / "r.docx",
    )
    assert ended.code == 2 and not list(tmp_path.iterdir())


# Its disc, on which it is shaken and balanced, has 12 of 31.7 kg; nothing is in doubt but what a test adds.
PLAIN = """speed: 4200 rpm
elements: [{length: 200 mm, diameter: 40 mm, count: 10}]
discs: [{node: 6, mass: 12 kg +- 3 %, transverse_inertia: 0.06 kg.m^2, polar_inertia: 0.11 kg.m^2}]
bearings:
  - {kind: linear-bearing, name: left, node: 1, k_yy: 8 MN/m, c: 12 kN.s/m}
  - {kind: linear-bearing, name: right, node: 11, k_yy: 8 MN/m, c: 12 kN.s/m}
unbalances: [{node: 6, size: 0 g.mm +- 200 g.mm}]
"""
SURE = SmallErrors(elements=0, inertia=0, bearings=0, apparent_mass=0, phase=0)


def error_by(folder: Path, test: SystemTest, reading, name: str) -> tuple[float, float, float]:
    """Value and standard error of an unknown by one test, chi-square over the number of its data."""
    (folder / "rotor.yaml").write_text(PLAIN)
    own = load_system(folder / "rotor.yaml")
    built = build(own, SURE, {test.name: sensors_of(test, reading)})
    found = fit_system(built.model, [evidence_of(test, built, own, cast(Work, None), reading)])
    at = built.model.number(name)
    return float(found.values[at]), float(found.standard_errors[at]), found.chi2[test.name][1]


def calibrated(effect: str, size: float, source: str) -> tuple[ChannelUncertainty, ...]:
    return (ChannelUncertainty(effect, Uncertainty(source, size, "1")),)


@pytest.mark.parametrize("form", ["receptance", "accelerance"])
def test_what_a_rig_file_states_of_its_sensors_counts(tmp_path: Path, form: str) -> None:
    """Far below its first bending mode a free rotor is 1 / (-m w^2): a force known to 5 % tells its mass m to
    5 %, beside the 3 % of the disc's m_d: u = (1 / .03^2 + (m_d / m)^2 / .05^2)^-1/2 of ln m_d. Lines that
    share a quarter of their noise are fewer: 1 + 2 / 4 (n - 1) / n of n lines have that of one.
    """
    frequency = np.arange(2.0, 4.0, 0.25)
    (tmp_path / "rotor.yaml").write_text(PLAIN)
    model = build(load_system(tmp_path / "rotor.yaml"), SURE, {}).model
    omega, force = 2 * np.pi * frequency, np.eye(model.n_dof)[:, [20]]
    matrix, _, _ = model.response(model.means, 0 * omega, omega, force, [20], supported=False)
    matrix = matrix * (1.0 if form == "receptance" else -(omega[:, None, None] ** 2))
    variance = 2e-6 * np.abs(matrix) ** 2
    measured = FrequencyResponse(
        frequency, matrix, (Port("6y", "a", "6y"),), (Port("6y", "f", "6y"),), form=form,
        covariance=diagonal_covariance(variance), line_correlation=(0.25,),
    )  # fmt: skip
    test = SystemTest(name="free", kind="response", test="free", free=True)
    mass = float(model.matrices(model.means, 0.0, supported=False).mass[0::4, 0::4].sum())
    part, told = 12 / mass, 0.03**-2
    lines = 8 / (1 + 0.5 * 7 / 8)
    _, error, n = error_by(tmp_path, test, measured_in_band(test, measured), "mass of disc 1")
    # Two parts of every line, 1e-3 each.
    assert error == pytest.approx((told + (part / 1e-3) ** 2 * lines) ** -0.5, rel=0.02)
    assert n == round(2 * lines)
    stated = replace(measured, inputs=(Port("6y", "f", "6y", None, calibrated("gain", 0.05, "force")),))
    _, error, _ = error_by(tmp_path, test, measured_in_band(test, stated), "mass of disc 1")
    assert error == pytest.approx((told + part**2 / (0.05**2 + 1e-6 / lines)) ** -0.5, rel=0.02)


@pytest.mark.filterwarnings("error")
def test_causes_beyond_all_numbers_are_told_without_one() -> None:
    """e^4000 is none; 1.5 times what was declared is."""
    said = SimpleNamespace(model=SimpleNamespace(unknowns=[Unknown("young", 0.02), Unknown("internal", 0.7)]))
    causes = [Explanation(90.0, 4000.0, "hammer", 1), Explanation(40.0, math.log(1.5), "run", 0)]
    text = (
        "chi-square falls by 90 with another internal in test 'hammer', by 40 with young of 1.5 in test 'run'"
    )
    assert explained_text(cast(SystemPosterior, said), causes) == text


def test_probes_of_one_calibrator_err_together(tmp_path: Path) -> None:
    """A rotor of known bearings has the unbalance that its vectors ask for, to their gain: 10 % of one
    calibrator for both probes, beside noise of 1 % of each of 4 vectors and .02 rad of the keyphasor.
    """
    (tmp_path / "rotor.yaml").write_text(
        PLAIN.replace("12 kg +- 3 %", "12 kg").replace("0 g.mm", "50 g.mm", 1)
    )
    own = load_system(tmp_path / "rotor.yaml")
    built = build(own, SURE, {})
    speed, forces = np.array([60.0, 70.0]), predictions.unbalance_forces(built, built.model.means)
    motion, _, _ = built.model.response(
        built.model.means, speed, speed, speed[:, None, None] ** 2 * forces[:, None], [20, 21]
    )
    vectors = motion.reshape(2, 1, 2)
    size, matrix = np.abs(vectors), -np.eye(2, dtype=complex)[None]
    run = RunUp(
        "run", 300.0, speed, ("node 6",), vectors, unbalance={"node 6": 0j},
        amplitude_error=0.01 * size, phase_error=np.full_like(size, 0.01),
        uncertainties=(
            ProbeError(Uncertainty("calibrator", 0.1, "1"), matrix),
            ProbeError(Uncertainty("keyphasor", 0.02, "rad"), 1j * matrix),
        ),
    )  # fmt: skip
    test = SystemTest(name="run", kind="run-up", axes="horizontal", run=RunSettings(file="r.csv"))
    for name, part in (("unbalance 6 re", 0.1), ("unbalance 6 im", 0.02)):
        value, error, _ = error_by(tmp_path, test, run, name)
        assert value == pytest.approx(5e-5 if name.endswith("re") else 0, abs=5e-8)
        assert error == pytest.approx(5e-5 * np.hypot(part, 0.01 / 2), rel=0.03)
    # What it was read less of comes to the probes along the axes as it does itself.
    turned, less = replace(test, axes="load"), replace(run, baseline=run)
    whole = build(own, SURE, {"run": sensors_of(turned, less)})
    read = evidence_of(turned, whole, own, cast("Work", None), less)
    assert read.net is not None and read.net[1][0, 1, 1].tolist() == pytest.approx(0.01 * read.measured[1])
