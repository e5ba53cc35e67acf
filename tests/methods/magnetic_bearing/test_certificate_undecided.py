"""What a certificate cannot judge it does not accept: from raw files of a rig of its own, whose truth is a
closed form.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.display import probability_text
from labpipe.methods.magnetic_bearing.limits import (
    Limit,
    LoopCertificateSettings,
    decrement_certificate,
    probability_below,
    verdict_of,
)
from labpipe.project.judging import judged_part, whole_outcome
from labpipe.project.rules import Rule
from labpipe.records.finding import Finding, Parameter
from labpipe.records.identification import Fit, Goodness
from labpipe.uncertainty.settings import CompareSettings
from tests.methods.magnetic_bearing import recorded_axis
from tests.methods.magnetic_bearing.recorded_axis import (
    ASKED,
    BEARING,
    ROLES,
    Axis,
    certificate_pipeline,
    written,
)

AXIS = Axis(lines=np.unique(np.round(np.geomspace(4, 450, 90))).astype(int))


@pytest.fixture(scope="module")
def columns() -> dict[str, np.ndarray]:
    return AXIS.record(np.random.default_rng(5))


@pytest.fixture
def certified(labpipe_without_report, tmp_path: Path):
    """Exit code, comparison and rules of a certificate of these columns."""

    def run(columns: dict[str, np.ndarray], axis: Axis = AXIS, **pipeline: str):
        file = certificate_pipeline(written(tmp_path, axis, columns), axis, **pipeline)
        code = labpipe_without_report("run", file, "-o", tmp_path / "out").code
        result = json.loads((tmp_path / "out/identification.json").read_text())
        return code, result["comparisons"][0], result["accept"]

    return run


@pytest.mark.long
def test_a_sound_loop_is_accepted(certified, columns) -> None:
    """The decrement by Newton's method on 1 + L of the rig's own equations."""
    code, found, _ = certified(columns)
    assert code == 0 and found["verdict"] == "accepted"
    amounts = {amount["name"]: amount for amount in found["amounts"]}
    assert (
        abs(amounts["log_decrement_1"]["value"] - AXIS.log_decrement())
        < 4 * amounts["log_decrement_1"]["std_error"]
    )
    assert 0.7 < amounts["chi2_reduced"]["value"] < 1.4


@pytest.mark.parametrize(
    ("channel", "factor", "words"),
    [("x", -1.0, "sign of 'x'"), ("i", 1000.0, "'i' times 0.001"), ("x", -1e-6, "'x' times 1e+06")],
)
def test_a_wrong_sign_or_unit_is_named_and_nothing_is_accepted(
    certified, columns, channel: str, factor: float, words: str
) -> None:
    code, found, rules = certified({**columns, channel: factor * columns[channel]})
    assert code == 1 and found["verdict"] == "undecided"
    assert not any(rule["passed"] for rule in rules)
    assert words in found["statement"] and "the fit is good" in found["statement"]
    assert "model-mismatch" in [finding["code"] for finding in found["findings"]]


@pytest.mark.long
def test_a_loop_of_another_controller_decides_nothing(certified, columns) -> None:
    """The bearing file has 0.6 of the derivative gain: no sign and no unit explains that, and the unknowns
    follow it anywhere.
    """
    code, found, rules = certified(columns, AXIS.other(derivative=0.6 * AXIS.derivative))
    assert code == 1 and found["verdict"] == "undecided" and "check signs, units" in found["statement"]
    assert not any(rule["passed"] for rule in rules)
    assert "probability_log_decrement" not in [amount["name"] for amount in found["amounts"]]


@pytest.mark.long
def test_damping_of_the_rotor_itself_is_none_of_the_file(certified) -> None:
    """400 N s/m between rotor and housing, as of eddy currents or a fluid: no unknown stands for it."""
    damped = AXIS.other(damping=400.0)
    code, found, rules = certified(damped.record(np.random.default_rng(5)))
    assert code == 1 and found["verdict"] == "undecided" and not any(rule["passed"] for rule in rules)
    assert "model-mismatch" in [finding["code"] for finding in found["findings"]]


@pytest.mark.long
def test_a_late_probe_outside_of_the_loop_is_the_channel_s_delay(certified, columns) -> None:
    """Two samples of 4 kHz between the loop's reading and its record. As a delay of the channel it leaves the
    loop as it is; the file's own delay is that between command and current, and does not explain it.
    """
    late = {**columns, "x": np.roll(columns["x"], 2)}
    _, unstated, _ = certified(late)
    assert unstated["verdict"] == "undecided"
    code, found, _ = certified(
        late, channels=ROLES.replace("{invert: true}", "{invert: true, delay: 0.5 ms}")
    )
    amounts = {amount["name"]: amount for amount in found["amounts"]}
    assert code == 0 and amounts["delay"]["ci95"][0] < AXIS.delay < amounts["delay"]["ci95"][1]


class Computed(Axis):
    """The axis whose controller computes for 50 us, ahead of the sum at which the loop is excited."""

    def controller(self, s: np.ndarray) -> np.ndarray:
        return super().controller(s) * np.exp(-50e-6 * s)


def test_a_power_of_z_in_the_controller_is_a_delay_of_the_loop(certified, monkeypatch) -> None:
    """The 50 us as z^-1 at 20 kHz in the file: poles are those of Newton's method on 1 + L of the rig.

    Where the sampled path dropped it the damping was overstated by 7 %. The file's loop is sampled and held,
    the rig's is continuous: without noise their poles differ by 0.03 %, the delays by 0.5 us.
    """
    axis = Computed(lines=AXIS.lines, delay=70e-6)
    law = BEARING[BEARING.index("  proportional") : BEARING.index("  sensor")]
    pid = ", ".join(line.strip() for line in law.splitlines() if "lag" not in line)
    step = "{{form: polynomial, numerator: [0, 1], denominator: [1, 0], rate: 20 kHz}}"
    blocks = f"  controller: [{{{{form: pid, {pid}}}}}, {step}]\n"
    monkeypatch.setattr(recorded_axis, "BEARING", BEARING.replace(law, blocks))
    code, found, _ = certified(axis.record(np.random.default_rng(5)), axis)
    assert code == 0, found["statement"]
    amounts = {amount["name"]: amount for amount in found["amounts"]}
    pole = axis.pole()
    truth = {"pole_real_1": pole.real, "pole_imag_1": pole.imag, "log_decrement_1": axis.log_decrement()}
    for name, true in truth.items():
        off = abs(amounts[name]["value"] - true)
        assert off < 4 * amounts[name]["std_error"] + 5e-4 * abs(true) < 0.01 * abs(true), name
    assert amounts["delay"]["value"] == pytest.approx(70e-6, abs=1e-6)


def unmodelled(folder: Path, columns: dict[str, np.ndarray], axis: Axis, certificate: str) -> Path:
    """The pipeline without a bearing file."""
    file = certificate_pipeline(written(folder, axis, columns), axis, certificate=certificate)
    left_out = ("theory:", "estimate:", "log_decrement_1", "probability_log")
    file.write_text(
        "\n".join(
            line for line in file.read_text().splitlines() if not any(word in line for word in left_out)
        )
    )
    return file


def test_a_decrement_that_is_asked_for_needs_a_model(columns, tmp_path: Path, labpipe_without_report) -> None:
    plain = unmodelled(tmp_path, columns, AXIS, "{after: u, log_decrement: 0.1}")
    ended = labpipe_without_report("run", plain, "-o", tmp_path / "out")
    assert ended.code == 1 and "undecided: a decrement needs a model" in ended.out
    ended = labpipe_without_report("run", unmodelled(tmp_path, columns, AXIS, ASKED), "-o", tmp_path / "out")
    assert ended.code == 2 and "'displacement' changes nothing: there is no theory" in ended.err
    ended = labpipe_without_report(
        "run", unmodelled(tmp_path, columns, AXIS, "{after: u}"), "-o", tmp_path / "out"
    )
    assert ended.code == 0 and "Accepted" in ended.out


def test_a_peak_at_the_edge_of_the_band_is_not_judged(
    columns, tmp_path: Path, labpipe_without_report
) -> None:
    """Lines up to 38 Hz: |S| peaks at 49 Hz."""
    below = AXIS.other(lines=AXIS.lines[AXIS.lines < 20])
    ended = labpipe_without_report(
        "run", unmodelled(tmp_path, columns, below, "{after: u}"), "-o", tmp_path / "out"
    )
    assert ended.code == 1 and "undecided: the largest |S| lies at the edge of the band" in ended.out


def test_a_pipeline_holds_a_certificate_per_test(columns, tmp_path: Path, labpipe_without_report) -> None:
    """Two recordings of one loop, both by one bearing file; a test must be named, and be there."""
    file = certificate_pipeline(written(tmp_path, AXIS, columns), AXIS)
    written(tmp_path, AXIS, AXIS.record(np.random.default_rng(6)), name="again.parquet")
    text = file.read_text()
    recording = next(line for line in text.splitlines() if line.startswith("recordings:"))
    tests = [
        f"  - {{name: {name}, recordings: {recording.partition(': ')[2].replace('axis', source)}}}"
        for name, source in (("first", "axis"), ("second", "again"))
    ]
    text = text.replace(recording, "\n".join(["tests:", *tests]))
    body = text[text.index("  certificate:\n") : text.index("accept:")]
    other = body.replace("  certificate:\n", "  second:\n").replace("{after", "{test: second, after")
    named = body.replace("{after", "{test: first, after")
    file.write_text(text.replace(body, named + other))
    ended = labpipe_without_report("run", file, "-o", tmp_path / "out")
    assert ended.code == 0, ended.err
    found = json.loads((tmp_path / "out/identification.json").read_text())["comparisons"]
    assert [one["verdict"] for one in found] == ["accepted", "accepted"]
    values = [
        next(amount["value"] for amount in one["amounts"] if amount["name"] == "delay") for one in found
    ]
    assert values[0] != values[1]
    file.write_text(text)
    ended = labpipe_without_report("run", file, "-o", tmp_path / "again")
    assert ended.code == 2 and "one loop" in ended.err and "first, second" in ended.err


# What a fit cannot tell, its rules and its certificate cannot accept.


def fitted(
    test: str, *parameters: Parameter, converged: bool = True, findings: tuple[Finding, ...] = ()
) -> Fit:
    sizes = {
        "band_hz": (1.0, 2.0),
        "lines": 1,
        "equations": 2,
        "dof": 1,
        "condition_number": 1.0,
        "correlation": np.eye(1),
    }
    goodness = {"gof": Goodness(1, 1), "parameters": parameters, "converged": converged, "findings": findings}
    return Fit("modes", "modal", "ml", test=test, **sizes, **goodness)


ZETA = Parameter("zeta_1", 0.2, "1", std_error=0.01, ci95=(0.18, 0.22))
RULE = Rule(
    section="accept",
    address="modes.zeta_1",
    fit="modes",
    which="",
    item="zeta_1",
    kind=">=",
    bound="0.1",
    place="p.yaml:1",
)


def test_a_rule_fails_where_a_test_lacks_its_parameter_or_the_fit_did_not_converge() -> None:
    assert whole_outcome(RULE, judged_part(RULE, [fitted("a", ZETA)])).passed
    lacking = whole_outcome(
        RULE, judged_part(RULE, [fitted("a", ZETA), fitted("b", replace(ZETA, name="zeta_2"))])
    )
    assert not lacking.passed and "in a test the fit has no 'zeta_1'" in lacking.found
    lost = whole_outcome(RULE, judged_part(RULE, [fitted("a", ZETA, converged=False)]))
    assert not lost.passed and "did not converge" in lost.found


@pytest.mark.parametrize(
    ("fit", "why"),
    [
        (fitted("a", ZETA, converged=False), "no-convergence"),
        (fitted("a", ZETA, findings=(Finding("feedback", "."),)), "feedback"),
        (fitted("a", ZETA, Parameter("zeta_2", 0.001, "1")), "log_decrement_2 has no standard error"),
    ],
)
def test_decrements_of_a_rejected_fit_are_undecided(fit: Fit, why: str) -> None:
    settings = CompareSettings(
        kind="certificate", name="c", fit="modes", kind_settings=LoopCertificateSettings()
    )
    assert decrement_certificate(settings, [fitted("a", ZETA)]).verdict == "accepted"
    found = decrement_certificate(settings, [fit])
    assert (
        found.verdict == "undecided"
        and why in found.statement
        and why in found.why_undecided("probability_log_decrement")
    )


@pytest.mark.parametrize(
    ("chances", "verdict"),
    [
        ((0.96, 0.99), "accepted"),
        ((0.95,), "accepted"),
        ((0.96, 0.94), "undecided"),
        ((0.96, None), "undecided"),
        ((), "undecided"),
        ((0.06, 0.99), "undecided"),
        ((0.04, 0.99, None), "not accepted"),
    ],
)
def test_a_verdict_needs_its_confidence_either_way(chances: tuple[float | None, ...], verdict: str) -> None:
    """Of 95 %: every limit kept with it, or one broken with it; what could not be judged accepts nothing."""
    limits = [Limit("a", chance, "") for chance in chances]
    assert verdict_of(limits, 0.95) == verdict


@pytest.mark.parametrize(
    ("value", "error", "probability"),
    [(1.0, 0.5, 0.9772499), (3.0, 0.5, 0.0227501), (2.0, 0.5, 0.5), (1.9, 0.0, 1.0), (2.0, 0.0, 0.0)],
)
def test_the_chance_to_lie_below_two(value: float, error: float, probability: float) -> None:
    """The normal distribution at two standard errors to either side; without an error it is certain."""
    assert probability_below(value, error, 2.0) == pytest.approx(probability, abs=1e-7)


def test_chances_in_words() -> None:
    assert [probability_text(p) for p in (0.9995, 0.977, 0.0005)] == ["over 99.9 %", "97.7 %", "under 0.1 %"]
