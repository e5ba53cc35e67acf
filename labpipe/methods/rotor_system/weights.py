"""Weights in the planes of the unbalances by the posterior of a rotor: what to set without a trial run, what
that leaves, and which run first would pay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.methods.rotor_system.build import Built
from labpipe.methods.rotor_system.evidence import RunUpVectors, run_up_whitener
from labpipe.methods.rotor_system.posterior import Posterior
from labpipe.methods.rotor_system.records import BalanceResult, InfluenceResult, VibrationResult, WeightResult
from labpipe.methods.rotor_system.settings import RotorSystemSettings

# Draws behind what one more run would leave, and behind the vibration over so many speeds.
LOOKED, SPEEDS = 60, 61


def balance(settings: RotorSystemSettings, built: Built, posterior: Posterior) -> BalanceResult | None:
    """Weights in the planes of the unbalances, what they leave, and what one more run would change."""
    runs = [test for test in posterior.tests if isinstance(test, RunUpVectors)]
    if not settings.balance_speeds or not runs:
        return None
    speed = 2 * np.pi * np.array(settings.balance_speeds)
    test = replace(
        runs[0], speed=speed, added=(), measured=np.zeros((speed.size, len(runs[0].outputs)), complex)
    )
    weights, left, before = expected(built, test, posterior, settings.draws, settings.seed)
    low, high = interval_of(left, posterior.widened)
    return BalanceResult(
        settings.balance_speeds,
        tuple(
            WeightResult(node, float(abs(w)), float(np.angle(w) % (2 * np.pi)))
            for node, w in zip(built.planes, weights, strict=True)
        ),
        before,
        float(np.sqrt(np.mean(left**2))),
        (low, high),
        _next_weights(built, posterior, test, weights),
        known_influence(built, posterior, test),
        _over_speed(settings, built, posterior, test, weights),
    )


def _over_speed(
    settings: RotorSystemSettings,
    built: Built,
    posterior: Posterior,
    test: RunUpVectors,
    weights: ComplexArray,
) -> VibrationResult:
    """What the weights do from half the lowest of the speeds they are made for to beyond the highest, and to
    the operating speed.
    """
    asked, operating = settings.balance_speeds, 0.0 if settings.system is None else settings.system.rig.speed
    speed = np.linspace(0.5 * min(asked), max(1.1 * max(asked), operating), SPEEDS)
    wide = replace(test, speed=2 * np.pi * speed)
    before: list[FloatArray] = []
    after: list[FloatArray] = []
    for values in posterior.draws(LOOKED, settings.seed):
        h, u = vectors_of_unbalance(built, wide, values)
        for into, acting in ((before, u), (after, u + weights)):
            into.append(np.sqrt(np.mean(np.abs((h @ acting).reshape(SPEEDS, -1)) ** 2, axis=1)))
    low, high = np.percentile(after, (2.5, 97.5), axis=0)
    middles = (np.sqrt(np.mean(np.square(part), axis=0)) for part in (before, after))
    columns = (speed, *middles, low, posterior.widened * high)
    return VibrationResult(*(tuple(float(value) for value in column) for column in columns))


def known_influence(built: Built, posterior: Posterior, test: RunUpVectors) -> InfluenceResult:
    """z_0 = H u and alpha = H at the speeds and probes of a *test*, with the root of their covariance: the
    half differences over one standard deviation to either side along each axis of the posterior, which is
    widened where intervals are.
    """

    def parts(values: FloatArray) -> FloatArray:
        h, u = vectors_of_unbalance(built, test, values)
        both = np.concatenate([(h @ u)[:, None], h], axis=1).ravel()
        return np.concatenate([both.real, both.imag])

    scale = posterior.standard_errors
    sizes, axes = np.linalg.eigh(posterior.spread / np.outer(scale, scale))
    steps = (scale[:, None] * axes * np.sqrt(np.maximum(sizes, 0.0))).T
    middle = posterior.values
    root = [posterior.widened * (parts(middle + step) - parts(middle - step)) / 2 for step in steps]
    readings = tuple(
        f"{dof // 4 + 1} {'yz'[dof % 4]} {speed * 30 / np.pi:.0f} rpm"
        for speed in test.speed
        for dof in test.outputs
    )
    columns = tuple(tuple(float(value) for value in row) for row in np.array(root).T)
    planes = tuple(f"node {node}" for node in built.planes)
    values = tuple(float(value) for value in parts(middle))
    return InfluenceResult(planes, readings, values, columns, posterior.widened)


def expected(
    built: Built, test: RunUpVectors, posterior: Posterior, n_draw: int, seed: int
) -> tuple[ComplexArray, FloatArray, float]:
    """Weights (n_plane,) [kg m], the rms of the readings that they leave in every draw (n_draw,) [m], and the
    rms of the readings before [m].
    """
    each = [vectors_of_unbalance(built, test, values) for values in posterior.draws(n_draw, seed)]
    weights = best_weights(each)
    left = np.array([np.sqrt(np.mean(np.abs(h @ (u + weights)) ** 2)) for h, u in each])
    return weights, left, float(np.sqrt(np.mean([np.mean(np.abs(h @ u) ** 2) for h, u in each])))


def interval_of(left: FloatArray, widened: float) -> tuple[float, float]:
    """95 % interval of what is left [m], by draws (n_draw,) [m]. What the posterior is *widened* by enlarges
    its upper end; the lower one stays, since what is left grows with the spread.
    """
    low, high = np.percentile(left, (2.5, 97.5))
    return float(low), float(widened * high)


def vectors_of_unbalance(
    built: Built, test: RunUpVectors, values: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """H (n_reading, n_plane) [m/(kg m)] and u (n_plane,) [kg m] at *values* (n_unknown,), for the speeds and
    probes of a test.
    """
    _, _, influence = test.readings(built.model, values)
    u = np.array([values[real] + 1j * values[imaginary] for _, real, imaginary in built.planes.values()])
    return influence.reshape(-1, u.size), u


def best_weights(each: Sequence[tuple[ComplexArray, ComplexArray]]) -> ComplexArray:
    """Weights (n_plane,) [kg m] that make the mean of |H (u + w)|^2 over draws (H (n_reading, n_plane)
    [m/(kg m)], u (n_plane,) [kg m]) least: w = -(sum H^H H)^-1 sum H^H H u. Equation (system-balance).
    """
    square = sum(h.conj().T @ h for h, _ in each)
    return np.asarray(-np.linalg.solve(square, sum(h.conj().T @ h @ u for h, u in each)))


def _next_weights(
    built: Built, posterior: Posterior, test: RunUpVectors, weights: ComplexArray
) -> dict[str, float]:
    """What one more run first, with a weight in one plane or the weights themselves, is expected to leave:
    the posterior narrows, its middle stays.
    """
    information = np.linalg.inv(posterior.covariance)
    trial = float(np.max(np.abs(weights)))
    sets = {f"a weight at node {node}": {node: trial + 0j} for node in built.planes}
    sets["the weights themselves"] = dict(zip(built.planes, weights, strict=True))
    noise = np.median(1 / np.linalg.norm(test.whitener, axis=2))
    by_run = {}
    for name, added in sets.items():
        run = replace(
            test,
            added=tuple((built.planes[node][0], amount) for node, amount in added.items()),
            whitener=run_up_whitener(np.full((len(test.outputs), test.speed.size), noise), 0.0),
        )
        _, jacobian = run.residual(built.model, posterior.values)
        covariance = np.linalg.inv(information + jacobian.T @ jacobian)
        narrowed = replace(posterior, covariance=covariance, refits=None)
        each = [vectors_of_unbalance(built, test, values) for values in narrowed.draws(LOOKED)]
        chosen = best_weights(each)
        by_run[name] = float(np.sqrt(np.mean([np.mean(np.abs(h @ (u + chosen)) ** 2) for h, u in each])))
    return by_run
