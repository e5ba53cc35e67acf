"""How often each warning of FRF and fit comes on sound runs and on runs with its fault; the table of the
statistics page is held to it.

A warning on half of all sound runs is noise; one that misses most faults is not a guard.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from labpipe.estimation.settings import FitSettings
from tests.estimation import warning_runs as of
from tests.methods.run_ups.four_dof_rig import MASS

PAGE = Path(__file__).parents[2] / "docs/pages/statistics.md"
# The rotor on oil films and its run-ups take longest.
MANY, FEW = 40, 20


@dataclass(frozen=True)
class Case:
    """A warning's code, its fault in words, and the run by its seed, with what is asked of sound ones and of
    those with the fault.
    """

    code: str
    fault: str
    run: Callable[..., frozenset[str]]
    sound: Mapping[str, object] = field(default_factory=dict)
    faulty: Mapping[str, object] = field(default_factory=dict)
    n_run: int = MANY
    # The suite repeats so many of the sound runs and of the faulty ones, fewer of the costly.
    sound_runs: int = 10
    faulty_runs: int = 10


FOUR, PEDESTAL, EIGHT = of.FOUR, of.PEDESTAL, FitSettings("rotor-2dof", mass=0.92)
HEAVY, FREE = replace(FOUR, mass=(1.03, *MASS[1:])), replace(PEDESTAL, mass="estimate")
CASES = (
    Case("drift", "sensor gain 3 % in the record", of.four_dofs, faulty={"gain": 0.03}, faulty_runs=5),
    Case("mass", "one of four masses 3 % off", of.four_dofs, faulty={"settings": HEAVY}, faulty_runs=2),
    Case(
        "model-mismatch",
        "skew rig fitted as symmetric",
        of.four_dofs,
        faulty={"settings": replace(FOUR, symmetric=True)},
        faulty_runs=2,
    ),
    Case(
        "model-mismatch",
        "mode at 60 Hz, band to 50 Hz",
        of.four_dofs,
        faulty={"hidden": (60.0, 0.01, 0.05)},
        faulty_runs=2,
    ),
    Case(
        "low-coherence",
        "noise as strong as the motion",
        of.four_dofs,
        faulty={"noise": 1.5e-3},
        faulty_runs=5,
    ),
    Case("low-snr", "noise 100 times the usual", of.pedestal, faulty={"level": 100.0}),
    Case(
        "collinear",
        "eight coefficients, one direction",
        of.two_directions,
        {"settings": EIGHT},
        {"settings": EIGHT, "inputs": 1},
    ),
    Case(
        "few-lines",
        "three lines for k and c",
        of.pedestal,
        faulty={"settings": replace(PEDESTAL, band=(64.9, 66.1))},
    ),
    Case(
        "insignificant",
        "damping below its noise",
        of.pedestal,
        faulty={"settings": replace(PEDESTAL, band=(10.0, 20.0))},
    ),
    Case("unphysical", "sign of the response turned", of.pedestal, faulty={"settings": FREE, "sign": -1.0}),
    Case(
        "wrong-quantity",
        "columns of force and response swapped",
        of.pedestal,
        faulty={"settings": FREE, "swap": True},
    ),
    Case(
        "leakage", "blocks of one inverse half-power width", of.short_blocks, {"block": 8.0}, {"block": 1.25}
    ),
    *(
        Case(
            "model-mismatch",
            f"{fault}, noise not known",
            of.residual_of_unknown_noise,
            {"fault": ""},
            {"fault": fault},
            faulty_runs=5,
        )
        for fault in ("second mode", "mode beside the band", "random gain", "step of gain")
    ),
    Case("no-covariance", "imported without variance", of.unknown_noise, {"known": True}, {"known": False}),
    Case(
        "amplitude",
        "stiffness 1 % larger at 10 N than at 5 N",
        of.levels,
        {"stiffer": 0.0},
        {"stiffer": 0.01},
    ),
    Case("other-model", "cross-coupled stiffness left out", of.cross_coupled, {"skew": 0.0}, {"skew": 10e3}),
    Case("reciprocity", "H_12 and H_21 20 % apart either way", of.reciprocal, {"skew": 0.0}, {"skew": 0.2}),
    Case(
        "no-convergence",
        "noise 30 times the motion, `iv`",
        of.without_minimum,
        {"noise": 0.01},
        {"noise": 30.0},
    ),
    Case("clipped", "range of two standard deviations", of.screened, {"fault": ""}, {"fault": "clipped"}),
    Case(
        "clipped",
        "the same of white noise",
        of.screened,
        {"fault": "", "white": True},
        {"fault": "clipped", "white": True},
    ),
    Case("gap", "three samples missing", of.screened, {"fault": ""}, {"fault": "gap"}),
    Case("constant", "dead channel", of.screened, {"fault": ""}, {"fault": "constant"}),
    Case(
        "aliasing",
        "mode just above half the sampling rate, no filter",
        of.sampled,
        {"filtered": True},
        {"filtered": False},
    ),
    Case(
        "not-died-away", "blocks of 1 s for a time constant of .44 s", of.taps, {"block": 4.0}, {"block": 1.0}
    ),
    Case("not-settled", ".3 % of damping, recorded from rest", of.from_rest, {"waited": 20}, {"waited": 0}),
    Case(
        "hit-rejected",
        "the last five of ten hits double",
        of.taps,
        {"block": 4.0},
        {"block": 4.0, "bounce": True},
    ),
    Case(
        "at-bound",
        "wear of 40 um, searched to 30 um",
        of.worn,
        {"depth": 22.27},
        {"depth": 40.19, "depth_limit": 30e-6},
        FEW,
        faulty_runs=5,
    ),
    Case("healthy", "no wear", of.worn, {"depth": 22.27}, {"depth": 0.0}, FEW, faulty_runs=5),
    Case(
        "model-mismatch",
        "run-ups on another family of films",
        of.run_up_family,
        {"truth": "inside"},
        {"truth": "factors"},
        FEW,
        faulty_runs=5,
    ),
)


# Several warnings are looked for in the same sound runs.
_CODES: dict[tuple[object, str, int], frozenset[str]] = {}


def codes(run: Callable[..., frozenset[str]], asked: Mapping[str, object], seed: int) -> frozenset[str]:
    """The warnings of one run."""
    key = run, repr(sorted(asked.items())), seed
    if key not in _CODES:
        _CODES[key] = run(seed, **asked)
    return _CODES[key]


def rate(case: Case, asked: Mapping[str, object], n_run: int) -> int:
    """Runs with the code, of so many."""
    return sum(case.code in codes(case.run, asked, seed) for seed in range(n_run))


def on_page() -> dict[tuple[str, str], tuple[int, int, int]]:
    """(code, fault) -> (sound runs with the warning, faulty ones, number of each) as the statistics page has
    them.
    """
    rows = re.findall(
        r"^\| `([\w-]+)` \| (.+?) \| (\d+) of (\d+) \| (\d+) of \d+ \|$",
        PAGE.read_text("utf-8"),
        re.MULTILINE,
    )
    return {(code, fault): (int(sound), int(faulty), int(runs)) for code, fault, sound, runs, faulty in rows}


@pytest.mark.long
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.code}, {case.fault}")
def test_a_warning_comes_with_its_fault_and_not_without(case: Case) -> None:
    """At most 5 % of sound runs, and one more by chance; at least 90 % of faulty ones: a warning that half of
    all sound runs carry passes with 10 once in 90, one of 20 % three in eight; one that half of the faulty
    ones carry with 10 once in 90, with five and two, all of which must carry it, once in 32 and in four.
    The first of the page's runs are repeated here, the whole of them by running this file.
    """
    n_sound, n_faulty = case.sound_runs, case.faulty_runs
    sound, faulty = rate(case, case.sound, n_sound), rate(case, case.faulty, n_faulty)
    assert sound <= round(0.05 * n_sound) + 1
    assert faulty >= 0.9 * n_faulty
    page_sound, page_faulty, page_run = on_page()[case.code, case.fault]
    assert page_run == case.n_run
    # The others can add what the page has more; other processors round otherwise, which may move one run
    # over a limit.
    assert -1 <= page_sound - sound <= case.n_run - n_sound + 1
    assert -1 <= page_faulty - faulty <= case.n_run - n_faulty + 1


def test_the_page_has_every_case() -> None:
    assert set(on_page()) == {(case.code, case.fault) for case in CASES}


if __name__ == "__main__":
    for row in CASES:
        without, with_fault = (rate(row, asked, row.n_run) for asked in (row.sound, row.faulty))
        print(
            f"| `{row.code}` | {row.fault} | {without} of {row.n_run} | {with_fault} of {row.n_run} |",
            flush=True,
        )
