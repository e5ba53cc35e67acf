"""Every kind of virtual rig through the same door: runs, files, truth, noise levels, studies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labpipe.artefacts.writing import output_folder
from labpipe.errors import ConfigError
from labpipe.estimation.settings import FitSettings
from labpipe.project.simulate import load_virtual_rig, simulate_files
from labpipe.records.recording import Recording
from labpipe.simulate.virtual_rigs import (
    VIRTUAL_RIGS,
    VirtualRig,
    chosen_runs,
    kind_of,
    recordings,
    simulate,
    simulated_response,
)
from labpipe.spectra.settings import FrfSettings
from labpipe.uncertainty.study import source_of

CONFIGS = Path(__file__).parents[2] / "configs"
# A rig file of every kind that is shipped with labpipe, the runs of one FRF matrix, how they are measured,
# and a fit of that matrix.
STUDIED: dict[str, tuple[str, tuple[str, ...], FrfSettings | None, FitSettings]] = {
    "virtual-magnetic-rig": (
        "virtual-hmb.yaml",
        ("pedestal",),
        FrfSettings("periodic", period="2 s"),
        FitSettings("sdof", mass="0.79 kg", band="60-70 Hz"),
    ),
    "virtual-mdof-rig": (
        "three-dof.yaml",
        (),
        None,
        FitSettings("mdof", mass=["1 kg", "2 kg", "3 kg"], symmetric=True),
    ),
    "virtual-ball-bearing-rig": (
        "virtual-ball-bearing.yaml",
        ("6208-427N-up-z",),
        FrfSettings("periodic", period="0.5 s", skip=0),
        FitSettings("sdof", mass="2 kg", output="z", band="100-400 Hz"),
    ),
    "virtual-journal-rig": (
        "virtual-journal.yaml",
        ("healthy-y", "healthy-z"),
        FrfSettings("random", block="4 s"),
        FitSettings("rotor-2dof", mass="30 kg", band="10-30 Hz"),
    ),
    "virtual-base-rig": (
        "virtual-base.yaml",
        ("absolute",),
        FrfSettings("random", block="4 s", band="12-95 Hz"),
        FitSettings("base", mass="2 kg"),
    ),
    "virtual-sweep-rig": (
        "virtual-sweep.yaml",
        ("linear",),
        FrfSettings("sweep", band="30-60 Hz"),
        FitSettings("sdof", mass="2 kg"),
    ),
    "virtual-white-noise-rig": (
        "virtual-white-noise.yaml",
        ("along-x", "along-y"),
        FrfSettings("random", block="5 s"),
        FitSettings("rotor-2dof", mass="30 kg", band="10-60 Hz"),
    ),
}
RUN_UPS_ONLY = "virtual-unbalance-rig"
OTHERS = {
    RUN_UPS_ONLY: "virtual-unbalance.yaml",
    "virtual-decay-rig": "virtual-decay.yaml",
    "virtual-floating-rig": "virtual-floating.yaml",
    "virtual-levitated-rig": "virtual-levitated.yaml",
    "virtual-rotor-rig": "virtual-rotor.yaml",
}
FILES = {kind: file for kind, (file, *_) in STUDIED.items()} | OTHERS


def small(kind: str) -> Any:
    """The shipped rig, coarser or shorter where a run takes long."""
    rig = load_virtual_rig(CONFIGS / FILES[kind])
    return (
        replace(rig, cells_around=48, cells_across=8, duration=20.0) if kind == "virtual-journal-rig" else rig
    )


def test_every_built_in_kind_is_tested_here() -> None:
    assert set(FILES) == set(VIRTUAL_RIGS.names())


@pytest.mark.parametrize("kind", sorted(FILES))
def test_the_first_run_is_written_with_its_truth(kind: str, tmp_path: Path) -> None:
    rig = small(kind)
    assert kind_of(rig).settings is type(rig)
    runs = kind_of(rig).runs(rig)[:1]
    with output_folder(tmp_path / "out") as output:
        names = simulate_files(rig, 3, runs or None, output)
    assert (
        names[-1] == "truth.json"
        and len(names) == 2
        and all((tmp_path / "out" / name).stat().st_size > 0 for name in names)
    )


@pytest.mark.parametrize("kind", sorted(FILES))
def test_an_unknown_run_is_answered_with_the_nearest(kind: str) -> None:
    rig = small(kind)
    known = kind_of(rig).runs(rig)
    with pytest.raises(ConfigError, match=r"no run|has no runs"):
        chosen_runs(rig, ["no-such-run"])
    assert set(chosen_runs(rig, None)) <= set(known) or not known


@pytest.mark.parametrize("kind", sorted(STUDIED))
def test_a_study_can_be_made_of_every_rig_that_has_responses(kind: str) -> None:
    """Its response depends on the seed, half the noise level halves what differs, and its truth names
    parameters of its fit.
    """
    _, runs, frf, fit = STUDIED[kind]
    rig = small(kind)
    level = rig.noise if kind == "virtual-mdof-rig" else 1.0
    source, quieter = source_of(rig, level, None, runs, frf), source_of(rig, 1e-6 * level, None, runs, frf)
    first, again, other = (source.response(seed) for seed in ((1, 0), (1, 0), (1, 1)))
    np.testing.assert_array_equal(first.matrix, again.matrix)
    assert not np.array_equal(first.matrix, other.matrix)
    exact = quieter.response((1, 0)).matrix
    assert np.all(np.isfinite(exact)) and np.mean(np.abs(first.matrix - exact)) > 0
    assert source.truth and all(np.isfinite(value) for value in source.truth.values())
    assert all(value > 0 for value in source.bounds(fit).values())


def test_a_rig_of_run_ups_says_that_it_has_no_response() -> None:
    rig = small(RUN_UPS_ONLY)
    with pytest.raises(ConfigError, match="gives no frequency response"):
        source_of(rig, 1.0, None, ("load-1",), FrfSettings("random", block=1.0))
    with pytest.raises(ConfigError, match="gives no frequency response"):
        simulated_response(rig, (1,), ["load-1"], None)
    with pytest.raises(ConfigError, match="gives no recordings"):
        recordings(rig, 1, ["load-1"])


@pytest.mark.parametrize("kind", sorted(set(STUDIED) - {"virtual-mdof-rig"}))
def test_recordings_are_those_of_the_files(kind: str) -> None:
    _, runs, _, _ = STUDIED[kind]
    rig = small(kind)
    made = recordings(rig, 2, runs)
    assert [recording.name for recording in made] == list(runs) and all(
        isinstance(recording, Recording) for recording in made
    )
    assert list(simulate(rig, 2, runs).files) == list(runs)


def test_runs_of_several_states_or_preloads_are_no_frf_matrix() -> None:
    journal: VirtualRig = small("virtual-journal-rig")
    with pytest.raises(ConfigError, match="one state of wear"):
        _ = source_of(journal, 1.0, None, ("healthy-y", "wear-1-z"), FrfSettings("random", block=4.0)).truth
    balls: VirtualRig = small("virtual-ball-bearing-rig")
    with pytest.raises(ConfigError, match="one bearing, preload and way"):
        _ = source_of(
            balls, 1.0, None, ("6208-427N-up-z", "string"), FrfSettings("periodic", period=0.5)
        ).truth


def test_a_free_body_has_no_response_at_0_hz() -> None:
    """K = [[1, -1], [-1, 1]] N/m is singular: nothing holds the two masses."""
    spring = ((1.0, -1.0), (-1.0, 1.0))
    body = replace(small("virtual-mdof-rig"), stiffness=spring, damping=spring, mass=(1.0, 2.0))  # type: ignore[type-var]
    still = replace(body, lines=replace(body.lines, first=0.0))
    with pytest.raises(ConfigError, match="infinite at a frequency line"):
        simulate(still, 1)
