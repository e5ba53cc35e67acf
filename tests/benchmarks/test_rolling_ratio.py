"""Ten thousand load cases of a rolling bearing together, against loops over single cases: CPU time within one
run, printed.

Both loops solve to the same tolerance; labpipe's own single-case call also starts from the same point. Only
gross failure is tested.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest
from scipy import optimize

from labpipe.methods.rolling_bearing.equilibrium import equilibrium
from labpipe.methods.rolling_bearing.loads import RollingBearing
from tests.methods.rolling_bearing.displaced_rings import bearing_loads, bearing_stiffness

BEARING = RollingBearing(9, 1.10e10, 30.1488e-3, groove_distance=5.953e-4)
N_TOGETHER, N_LOOP = 10_000, 200


def cpu_seconds(action: Callable[[], object]) -> float:
    start = time.process_time()
    action()
    return time.process_time() - start


@pytest.fixture(scope="module")
def loads() -> np.ndarray:
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(N_TOGETHER, 5))
    size = 10 ** rng.uniform(0, np.log10(20e3), (N_TOGETHER, 1))
    scaled: np.ndarray = (
        size * directions / np.linalg.norm(directions, axis=1, keepdims=True) * [1, 1, 1, 0.03, 0.03]
    )
    return scaled


def solved_by_scipy(load: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The general-purpose solver with the analytic derivative, tilts counted at the pitch radius."""
    scale = np.array([1, 1, 1, BEARING.pitch_radius, BEARING.pitch_radius])
    found = optimize.root(
        lambda u: (bearing_loads(BEARING, u / scale)[0] - load) / scale,
        start * scale,
        jac=lambda u: bearing_stiffness(BEARING, u / scale)[0] / np.outer(scale, scale),
        tol=1e-12,
    )
    q: np.ndarray = found.x / scale
    return q


def test_many_load_cases_against_loops(loads: np.ndarray, capsys) -> None:  # type: ignore[no-untyped-def]
    equilibrium(BEARING, loads[:10])
    together = cpu_seconds(lambda: equilibrium(BEARING, loads)) / N_TOGETHER
    own_loop = cpu_seconds(lambda: [equilibrium(BEARING, load) for load in loads[:N_LOOP]]) / N_LOOP
    start = np.array([0, 0, 1e-4, 0, 0])
    peer = cpu_seconds(lambda: [solved_by_scipy(load, start) for load in loads[:N_LOOP]]) / N_LOOP
    with capsys.disabled():
        print(
            f"\n10,000 load cases, {1e6 * together:.0f} us each: {own_loop / together:.0f} times faster "
            "than one by one,"
        )
        print(
            f"{peer / together:.0f} times faster than a loop over scipy.optimize.root with the same "
            "derivative (goal 20)"
        )
    assert min(own_loop, peer) > 5 * together
