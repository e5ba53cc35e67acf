"""Weights in the planes of the unbalances by the posterior of a rotor: what to set without a trial run, what
that leaves, and which run first would pay.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.methods.balancing.influence import best_weights, rms_left, square_of
from labpipe.methods.rotor.posterior import root_of
from labpipe.methods.rotor_system.build import Built
from labpipe.methods.rotor_system.evidence import RunUpVectors, as_real
from labpipe.methods.rotor_system.posterior import SystemPosterior, normal_draws
from labpipe.methods.rotor_system.records import BalanceResult, InfluenceResult, VibrationResult, WeightResult
from labpipe.methods.rotor_system.settings import RotorSystemSettings

# Draws behind what one more run would leave, and behind the vibration over so many speeds.
LOOKED, SPEEDS = 60, 61


def balance(settings: RotorSystemSettings, built: Built, posterior: SystemPosterior) -> BalanceResult | None:
    """Weights in the planes of the unbalances, what they leave, and what one more run would change."""
    runs = [test for test in posterior.tests if isinstance(test, RunUpVectors)]
    if not settings.balance_speeds or not runs:
        return None
    speed = 2 * np.pi * np.array(settings.balance_speeds)
    test = replace(
        runs[0], speed=speed, added=(), measured=np.zeros((speed.size, len(runs[0].outputs)), complex)
    )
    drawn = drawn_influence(built, test, posterior.draws(settings.draws, settings.seed))
    weights = best_weights(square_of(drawn))
    before, left = (rms_left(drawn, acting) for acting in (np.zeros_like(weights), weights))
    return BalanceResult(
        settings.balance_speeds,
        tuple(
            WeightResult(node, float(abs(w)), float(np.angle(w) % (2 * np.pi)))
            for node, w in zip(built.planes, weights, strict=True)
        ),
        float(np.sqrt(np.mean(before**2))),
        float(np.sqrt(np.mean(left**2))),
        interval_of(left, posterior.widened),
        _next_weights(built, posterior, test, weights),
        stated_influence(built, posterior, test),
        _over_speed(settings, built, posterior, test, weights),
    )


def _over_speed(
    settings: RotorSystemSettings,
    built: Built,
    posterior: SystemPosterior,
    test: RunUpVectors,
    weights: ComplexArray,
) -> VibrationResult:
    """What the weights do from half the lowest of the speeds they are made for to beyond the highest, and to
    the operating speed.
    """
    asked, operating = settings.balance_speeds, 0.0 if settings.system is None else settings.system.rig.speed
    speed = np.linspace(0.5 * min(asked), max(1.1 * max(asked), operating), SPEEDS)
    wide = replace(test, speed=2 * np.pi * speed)
    drawn = drawn_influence(built, wide, posterior.draws(LOOKED, settings.seed))
    drawn = drawn.reshape(LOOKED, SPEEDS, -1, drawn.shape[-1])
    before, after = (rms_left(drawn, acting) for acting in (np.zeros_like(weights), weights))
    low, high = np.percentile(after, (2.5, 97.5), axis=0)
    before, middle = (np.sqrt(np.mean(part**2, axis=0)) for part in (before, after))
    return VibrationResult(speed, before, middle, low, posterior.widened * high)


def stated_influence(built: Built, posterior: SystemPosterior, test: RunUpVectors) -> InfluenceResult:
    """z_0 = H u and alpha = H at the speeds and probes of a *test*, with the root of their covariance: the
    half differences over one standard deviation to either side along each axis of the posterior, which is
    widened where intervals are.
    """

    def parts(values: FloatArray) -> FloatArray:
        return as_real(drawn_influence(built, test, values[None]).ravel())

    middle = posterior.values
    root = [
        posterior.widened * (parts(middle + step) - parts(middle - step)) / 2
        for step in root_of(posterior.spread).T
    ]
    readings = tuple(
        f"{dof // 4 + 1} {'yz'[dof % 4]} {speed * 30 / np.pi:.0f} rpm"
        for speed in test.speed
        for dof in test.outputs
    )
    planes = tuple(f"node {node}" for node in built.planes)
    return InfluenceResult(planes, readings, parts(middle), np.array(root).T, posterior.widened)


def interval_of(left: FloatArray, widened: float) -> tuple[float, float]:
    """95 % interval of what is left [m], by draws (n_draw,) [m]. What the posterior is *widened* by enlarges
    its upper end; the lower one stays, since what is left grows with the spread.
    """
    low, high = np.percentile(left, (2.5, 97.5))
    return float(low), float(widened * high)


def drawn_influence(built: Built, test: RunUpVectors, draws: FloatArray) -> ComplexArray:
    """z_0 = H u [m] and alpha = H [m/(kg m)], (n_draw, n_reading, n_plane + 1), at the speeds and probes of a
    *test*, of *draws* (n_draw, n_unknown) of the unknowns.
    """
    influences = []
    for values in draws:
        _, _, influence = test.readings(built.model, values)
        h = influence.reshape(-1, len(built.planes))
        u = np.array([values[real] + 1j * values[imaginary] for _, real, imaginary in built.planes.values()])
        influences.append(np.column_stack([h @ u, h]))
    return np.array(influences)


def _next_weights(
    built: Built, posterior: SystemPosterior, test: RunUpVectors, weights: ComplexArray
) -> dict[str, float]:
    """What one more run first, with a weight in one plane or the weights themselves, is expected to leave:
    the posterior narrows, its middle stays.
    """
    trial = float(np.max(np.abs(weights)))
    sets = {f"a weight at node {node}": {node: trial + 0j} for node in built.planes}
    sets["the weights themselves"] = dict(zip(built.planes, weights, strict=True))
    noise = float(np.median(test.noise))
    by_run = {}
    for name, weights_of_run in sets.items():
        added = tuple((built.planes[node][0], amount) for node, amount in weights_of_run.items())
        run = test.planned(test.speed, noise, added)
        covariance = posterior.covariance_with(run)
        drawn = drawn_influence(built, test, normal_draws(posterior.values, covariance, LOOKED))
        left = rms_left(drawn, best_weights(square_of(drawn)))
        by_run[name] = float(np.sqrt(np.mean(left**2)))
    return by_run
