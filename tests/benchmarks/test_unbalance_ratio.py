"""Cost of unbalance responses and their identification, in run-up evaluations: figures are printed.

Only gross failures fail.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from labpipe.methods.journal_bearing.curve import journal_curve
from labpipe.methods.rotor.pinned import Stability, unbalance_forces
from labpipe.methods.run_ups.amplitudes import fit_amplitudes
from labpipe.methods.run_ups.joint import fit_jointly
from labpipe.methods.run_ups.metamodel_kinds import Grid
from labpipe.methods.run_ups.metamodels import METAMODELS
from labpipe.methods.run_ups.methods import fit_points
from labpipe.methods.run_ups.process import fit_with_process
from tests.methods.run_ups.run_up_cases import RIG, trained


def wall_seconds(action: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def run_up_seconds() -> float:
    """One vectorised evaluation of a run-up, 27 speeds at two planes."""
    speed = np.arange(400.0, 3001, 100) * np.pi / 30
    condensed = RIG.condense(speed, RIG.known_unbalance)
    stiffness, damping = RIG.start_coefficients(5.0, speed)
    return wall_seconds(lambda: condensed.response(stiffness, damping), 201)


def integration_seconds(speed: float, turns: int) -> float:
    """The same rotor integrated over time by RK45 at one speed, from its matched state, to a relative
    tolerance of 1e-6.
    """
    stiffness, damping = (found[0] for found in RIG.start_coefficients(5.0, np.array([speed])))
    forces = unbalance_forces(RIG.pinned, {2: 5e-5 + 0j}, np.array([speed]))
    system = Stability.of(RIG.pinned, 3).system(np.array([speed]), stiffness, damping)[0]
    push = np.linalg.solve(RIG.pinned.matrices.mass, forces[0])
    state = np.linalg.solve(1j * speed * np.eye(24) - system, np.concatenate([np.zeros(12), push]))

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        rate = system @ y
        rate[12:] += (push * np.exp(1j * speed * t)).real
        return rate

    end = turns * 2 * np.pi / speed
    return wall_seconds(lambda: solve_ivp(slope, (0, end), state.real, "RK45", rtol=1e-6, atol=1e-12), 1)


def test_frequency_domain_against_time_integration(capsys) -> None:  # type: ignore[no-untyped-def]
    """Goal: 1000 times faster.

    A run-up of 27 speeds against 27 integrations of two turns, of which one, at 1500 rpm, is timed.
    """
    run_up = run_up_seconds()
    integrated = 27 * integration_seconds(50 * np.pi, 2)
    with capsys.disabled():
        print(
            f"\nrun-up of 27 speeds: {1e3 * run_up:.3f} ms; integrated over time {integrated:.1f} s, "
            f"{integrated / run_up:.0f} times longer"
        )
    assert integrated > 1000 * run_up
    assert run_up < 0.05


def test_identification_in_run_ups(capsys) -> None:  # type: ignore[no-untyped-def]
    """Goals where a run-up takes 1 ms: (b) 1 s and (c) 3 s, that is 1000 and 3000 run-ups of 1 ms."""
    run_up = run_up_seconds()
    runs = trained("outside")
    points = wall_seconds(lambda: fit_points(RIG, runs), 5)
    joint = wall_seconds(lambda: fit_jointly(RIG, runs), 3)
    condensing = wall_seconds(lambda: RIG.condense(runs[1].speed, RIG.known_unbalance), 21)
    with capsys.disabled():
        print(f"\nrun-up {1e3 * run_up:.3f} ms, condensing it {1e3 * condensing:.2f} ms")
        print(f"per point {1e3 * points:.0f} ms = {points / run_up:.0f} run-ups")
        print(f"joint fit {1e3 * joint:.0f} ms = {joint / run_up:.0f} run-ups")
    # The goals with the run-up counted as 1 ms or what it takes, whichever is longer; four times that is
    # gross failure.
    unit = max(run_up, 1e-3)
    assert points < 4000 * unit
    assert joint < 12000 * unit


def test_amplitudes_smooth_factors_and_metamodels_in_run_ups(capsys) -> None:  # type: ignore[no-untyped-def]
    """Goal where a run-up takes 1 ms: (a) 30 s for four loads and 27 speeds, 30 000 run-ups of 1 ms.

    The others have none.
    """
    run_up = run_up_seconds()
    runs = trained("factors")
    joint = fit_jointly(RIG, runs)
    grid = Grid.sample(joint, joint.loads, runs[1].speed)
    seconds = {
        "amplitudes, one start": wall_seconds(lambda: fit_amplitudes(RIG, runs), 3),
        "amplitudes, twenty starts": wall_seconds(lambda: fit_amplitudes(RIG, runs, starts=20), 1),
        "smooth factors": wall_seconds(lambda: fit_with_process(RIG, runs, joint), 1),
        "response surface": wall_seconds(lambda: METAMODELS["surface"](grid, 0), 5),
        "Gaussian process": wall_seconds(lambda: METAMODELS["process"](grid, 0), 1),
    }
    with capsys.disabled():
        print(f"\nrun-up {1e3 * run_up:.3f} ms")
        for name, taken in seconds.items():
            print(f"{name}: {1e3 * taken:.1f} ms = {taken / run_up:.0f} run-ups")
    unit = max(run_up, 1e-3)
    assert seconds["amplitudes, one start"] < 30_000 * unit
    assert seconds["amplitudes, twenty starts"] < 4 * 30_000 * unit


def test_the_table_of_a_grooved_bearing(capsys) -> None:  # type: ignore[no-untyped-def]
    """Goal: under 10 s where an equilibrium of 120 x 30 cells takes 3 ms."""
    built = wall_seconds(lambda: journal_curve.__wrapped__(0.5, np.deg2rad(20)), 1)
    with capsys.disabled():
        print(f"\n96 equilibria of 288 x 40 and of 144 x 20 cells: {built:.2f} s")
    assert built < 30
