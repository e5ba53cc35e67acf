"""Cost of one posterior from all tests of a rotor, and of its Campbell diagram with bands, in bare solutions of
what they cannot do without: dynamic stiffness at the lines of the tests, eigenvalues at the speeds.

The figures are printed. Only gross failures (four times the usual ratio) fail the test.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from labpipe.methods.rotor_system.posterior import fit_system
from labpipe.methods.rotor_system.predictions import campbell, values_at_speed
from tests.benchmarks.test_ratios import cpu_seconds
from tests.methods.rotor_system.two_discs import built, drawn, four_tests


def test_posterior_and_campbell_in_bare_solutions(capsys) -> None:  # type: ignore[no-untyped-def]
    """Goals: 5 s for 52 unknowns and four tests, 1 s for the diagram over 41 speeds with bands. Measured where
    all lines are solved in 4 ms: 1.0 s, 250 times that, and 0.6 s, twice the bare eigenvalues.
    """
    of, rng = built(), np.random.default_rng(11)
    tests = four_tests(of, drawn(of, rng), rng)
    found = fit_system(of.model, tests)
    _, shaker, run, _ = tests
    still = np.zeros(shaker.omega.size)
    speeds = np.linspace(5.0, 150.0, 41)
    values = values_at_speed(of.model, found.values)
    (standing,) = of.model.dynamic(values, still, shaker.omega)
    (turning,) = of.model.dynamic(values, run.speed, run.speed)
    matrices = [of.model.matrices(values, 2 * np.pi * speed) for speed in speeds]
    n = of.model.n_dof
    states = []
    for speed, whole in zip(2 * np.pi * speeds, matrices, strict=True):
        lower = -np.linalg.solve(whole.mass, np.hstack([whole.restoring(speed), whole.at_speed(speed)]))
        states.append(np.vstack([np.eye(n, 2 * n, n), lower]))

    def lines() -> None:
        np.linalg.solve(standing, np.eye(n)[:, :8])
        np.linalg.solve(turning, np.eye(n)[:, :5])

    floor = cpu_seconds(lines, 21)
    bare = cpu_seconds(lambda: [linalg.eig(state, left=True) for state in states], 3)
    posterior = cpu_seconds(lambda: fit_system(of.model, tests), 3)
    diagram = cpu_seconds(lambda: campbell(found, speeds), 3)
    with capsys.disabled():
        print(
            f"\n{len(of.model.unknowns)} unknowns, four tests: posterior {posterior:.2f} s = "
            f"{posterior / floor:.0f} times all lines solved once ({1e3 * floor:.2f} ms)"
        )
        print(
            f"Campbell diagram with bands, {speeds.size} speeds: {diagram:.2f} s = {diagram / bare:.2f} times "
            f"the bare eigenvalues and vectors ({bare:.2f} s)"
        )
    assert posterior < 4 * 250 * floor
    assert diagram < 4 * 2 * bare
