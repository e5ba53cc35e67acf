"""Windows of random data: values, noise bandwidth, correlation of overlapping blocks, and their leakage;
windows of hits.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import ConfigError
from labpipe.records.response import Blocks

# Correlation below which lines count as independent; no main lobe is wider than FURTHEST_LINE lines.
SHARED = 1e-3
FURTHEST_LINE = 20
# The same for the exponential window, whose noise falls off slowly: as one over the distance.
FAINT = 0.02
# Errors of a force under its window beside the largest from which on they count, and twice the band times the
# length of the window up to which they are told.
LEAST_COURSE, MOST_COURSES = 0.03, 96
# Looks at the noise of the responses beside that of the force.
PASSES = 2
# Windows whose parameters are numbers of samples.
IN_SAMPLES = (
    "exponential",
    "poisson",
    "gaussian",
    "gauss",
    "gss",
    "general_gaussian",
    "general_gauss",
    "ggs",
)
# Samples that stand for a window whose length is not known: its correlation depends on the shape alone.
WINDOW_SAMPLES = 1024


def hann(n_sample: int) -> FloatArray:
    """The periodic (DFT-even) Hann window, 1/2 - 1/2 cos(2 pi n / N), (n_sample,) [1]. Equation
    (spec-hann).
    """
    values: FloatArray = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n_sample) / n_sample)
    return values


def window_values(name: str, n_sample: int) -> FloatArray:
    """The periodic (DFT-even) window of that name, (n_sample,) [1]; "tukey 0.25" gives a parameter.
    ConfigError for an unknown name, and for a window whose shape is not the same over any number of samples.
    """
    if name == "hann":
        return hann(n_sample)
    kind, *parameters = name.split()
    if kind in IN_SAMPLES:
        what = f"the parameter of the window '{name}' counts samples, so that its shape depends on the block"
        raise ConfigError(what, hint="for example 'kaiser 8'")
    try:
        chosen: Any = (kind, *(float(parameter) for parameter in parameters)) if parameters else kind
        with np.errstate(all="ignore"):
            values: FloatArray = scipy.signal.get_window(chosen, n_sample, fftbins=True)
        if not np.sum(values) > 0:
            raise ValueError
    except (ValueError, TypeError):
        hint = "for example hann, hamming, blackman, flattop, boxcar, 'tukey 0.25'"
        raise ConfigError(f"unknown window '{name}'", hint=hint) from None
    return values


def noise_bandwidth(window: FloatArray) -> float:
    """Equivalent noise bandwidth n sum w^2 / (sum w)^2 in lines [1] of a window (n_sample,) (Harris 1978, eq.
    11). Boxcar 1, Hann 1.5. Equation (spec-enbw).
    """
    return float(window.size * np.dot(window, window) / np.sum(window) ** 2)


def overlap_correlation(window: FloatArray, step: int) -> FloatArray:
    """rho_k = (sum w(n) w(n + k step) / sum w^2)^2 [1], correlation of the powers of blocks k steps apart, k
    = 1 ... (Welch 1967). window (n_sample,), *step* in samples; the result has one value for every
    overlapping step. Equation (spec-overlap).
    """
    n = window.size
    products = [np.dot(window[:-shift], window[shift:]) for shift in range(step, n, step)]
    return (np.array(products) / np.dot(window, window)) ** 2


def line_correlation(window: FloatArray, step: int, n_block: int) -> tuple[float, ...]:
    """c_d of the noise of an FRF at lines d = 1, 2, ... apart, down to SHARED: Hann 0.45, 0.03; boxcar
    without overlap none. window (n_sample,) [1], *step* [samples]. With r_j(d) = sum_t w(t) w(t + j step)
    exp(-2 pi j d t / N) of noise and force of blocks j apart: c_d = sum_j (K - |j|) |r_j(d)|^2 / sum_j (K -
    |j|) |r_j(0)|^2. Equation (spec-line-correlation).
    """
    n = window.size
    products = [
        window * np.concatenate([window[shift:], np.zeros(shift)])
        for shift in range(0, min(n, n_block * step), step)
    ]
    power = np.abs(np.fft.rfft(products, axis=1)[:, : FURTHEST_LINE + 1]) ** 2
    # Blocks before and after contribute equally.
    weight = (n_block - np.arange(len(products))) * np.where(np.arange(len(products)) == 0, 1, 2)
    shared = weight @ power
    return _while_shared(shared[1:] / shared[0])


def amplitude_correlation(name: str) -> tuple[float, ...]:
    """r_d = sum w^2 cos(2 pi d n / N) / sum w^2 of lines d = 1, 2, ... apart, down to SHARED: Hann -2/3, 1/6;
    boxcar none. That of the noise of an FRF whose force is the same in every block (a sweep, a period, a
    hit), with the phase of its beginning. ConfigError for an unknown *name*. Equation
    (spec-amplitude-correlation).
    """
    window = window_values(name, WINDOW_SAMPLES)
    power = np.fft.fft(window**2).real[: FURTHEST_LINE + 1] / np.dot(window, window)
    return _while_shared(power[1:])


def _while_shared(correlation: FloatArray) -> tuple[float, ...]:
    above = np.flatnonzero(np.abs(correlation) > SHARED)
    return tuple(correlation[: above[-1] + 1].tolist()) if above.size else ()


def exponential_correlation(window: FloatArray, origin: float) -> ComplexArray:
    """r_d = sum_t w^2 exp(-2 pi j d (t - origin) / N) / sum w^2 of lines d = 1, 2, ... apart, (n_distance,)
    [1], down to FAINT. window (n_sample,) [1] of the block; *origin* [samples]: the hit. The force has the
    phase exp(-j w origin). exp(-t / tau) in a block T gives nearly 1 / (1 + j pi d tau / T). Equation
    (spec-exponential-correlation).
    """
    power = np.fft.fft(window**2)[: window.size // 2] / np.dot(window, window)
    above = np.flatnonzero(np.abs(power) > FAINT)
    d = np.arange(1, above[-1] + 1)
    correlation: ComplexArray = power[d] * np.exp(2j * np.pi * d * origin / window.size)
    return correlation


def effective_averages(window: FloatArray, step: int, n_block: int) -> float:
    """n_e = K / (1 + 2 sum_k (1 - k/K) rho_k), effective number of averages of K overlapping blocks (Welch
    1967). window (n_sample,) [1], *step* [samples]. Equation (spec-averages).
    """
    rho = overlap_correlation(window, step)
    k = np.arange(1, rho.size + 1)
    return float(n_block / (1 + 2 * np.sum(np.maximum(1 - k / n_block, 0) * rho)))


# Samples of a window that show its shape, and of one with bursts; points per line.
SHAPE_SAMPLES, BURST_SAMPLES, POINTS = 512, 2048, 4
# Share of the window's power outside of the lines that count, and their largest number to either side.
OUTSIDE, MOST_LINES = 1e-6, 64


@dataclass(frozen=True)
class LeakageKernel:
    """Spectrum of the window of *blocks*, phase taken out: *amplitude* W (n_point,) [1] at *offsets*
    (n_point,) [1 / POINTS line]. sum W^2 = 1. The mean of H by *weights* (n_point,) [1] is its expected H1.
    """

    blocks: Blocks
    offsets: FloatArray
    amplitude: FloatArray
    weights: FloatArray | ComplexArray

    def shifts(self) -> list[tuple[FloatArray, ComplexArray]]:
        """(weights (n_input or 1, 1) [1], phases (n_point,) [1]) of pairs of blocks that overlap: exp(j v t
        step), and (1 - |t| / K) / K of the K blocks of each force.
        """
        step = 1 - self.blocks.overlap
        number = np.array(self.blocks.by_force or (self.blocks.number,))[:, None]
        most = min(int(np.ceil(1 / step)), number.max()) - 1
        return [
            (
                np.maximum(1 - abs(t) / number, 0.0) / number,
                np.exp(2j * np.pi * self.offsets * (t * step / POINTS)),
            )
            for t in range(-most, most + 1)
        ]


@functools.cache
def kernel_of(blocks: Blocks) -> LeakageKernel | None:
    """The spectrum of the window of blocks, what they hold of bursts and hits, or of local polynomials;
    None beyond H1, ConfigError for an unknown window. Equations (frf-leakage-kernel), (frf-leakage-bursts),
    (frf-local-kernel).
    """
    if blocks.estimator != "H1" or (blocks.degree and not blocks.half_width):
        return None
    if blocks.degree:
        # Least squares by a rough force, of which the polynomials of the leakage take a share of every line.
        lines = np.arange(-blocks.half_width, blocks.half_width + 1)
        powers = (lines / blocks.half_width)[:, None] ** np.arange(blocks.degree + 1)
        smooth = np.linalg.qr(powers)[0]
        left = 1 - np.sum(smooth**2, axis=1)
        weights = np.linalg.solve(powers.T @ (left[:, None] * powers), powers.T * left)[0]
        return LeakageKernel(blocks, POINTS * lines.astype(float), np.sqrt(np.abs(weights)), weights)
    offsets = np.arange(-MOST_LINES * POINTS, MOST_LINES * POINTS + 1)
    if blocks.bursts or blocks.after_hit:
        weights = _weights_of_lags(blocks, offsets)
        return LeakageKernel(blocks, offsets.astype(float), np.sqrt(np.abs(weights)), weights)
    window = window_values(blocks.window, SHAPE_SAMPLES)
    # About the middle of the block the transform of a symmetric window is real.
    place = np.arange(SHAPE_SAMPLES) - SHAPE_SAMPLES / 2
    amplitude = (np.exp(-2j * np.pi * np.outer(offsets, place) / (SHAPE_SAMPLES * POINTS)) @ window).real
    nearest = np.argsort(np.abs(offsets), kind="stable")
    share = np.cumsum(amplitude[nearest] ** 2) / np.sum(amplitude**2)
    inside = np.abs(offsets) <= abs(offsets[nearest[np.argmax(share > 1 - OUTSIDE)]])
    amplitude = amplitude[inside] / np.linalg.norm(amplitude[inside])
    return LeakageKernel(blocks, offsets[inside].astype(float), amplitude, amplitude**2)


def _weights_of_lags(blocks: Blocks, offsets: IntArray) -> ComplexArray:
    """Weights (n_point,) [1] of H at *offsets* (n_point,) [1 / POINTS line] by what blocks of bursts or hits
    hold of a response at each lag behind its force.
    """
    window = window_values(blocks.window, BURST_SAMPLES)
    if blocks.after_hit:
        seen = np.clip(window.size * blocks.after_hit - np.arange(window.size) + 0.5, 0.0, 1.0)
    else:
        force = np.array(blocks.bursts)[np.arange(window.size) * len(blocks.bursts) // window.size]
        seen = np.correlate(window, window * force, "full")[window.size - 1 :]
        seen /= seen[0]
    # Nothing responds before the force, so that the course at lags below 0 is free. Without a kink at 0 what
    # lies beyond these lines alternates, and fading out towards it takes it off.
    before = (2 - seen) * (0.5 + 0.5 * np.cos(np.pi * np.arange(seen.size) / seen.size))
    rest = np.zeros((POINTS - 2) * seen.size + 1)
    weights = np.fft.ifft(np.concatenate([seen, rest, before[:0:-1]]))[offsets]
    weights *= 0.5 + 0.5 * np.cos(np.pi * np.clip(4 * np.abs(offsets) / offsets[-1] - 3, 0.0, 1.0))
    return weights / np.sum(weights)


# The force window falls from one to zero within this share of its length.
FLANK = 0.1


def force_window(n_sample: int, trigger: int, length: float) -> FloatArray:
    """Force window: one up to *length* [samples] before and after the hit, then half a cosine to zero within
    a tenth of it, (n_sample,).
    """
    past = np.abs(np.arange(n_sample) - trigger) - length
    return 0.5 + 0.5 * np.cos(np.pi * np.clip(past / (FLANK * length), 0.0, 1.0))


def exponential_window(n_sample: int, constant: float) -> FloatArray:
    """exp(-t / constant) from the start of the block, (n_sample,) [1]; *constant* in samples. Applied to
    force and outputs alike, so that their FRF is exactly H(j w + 1/constant). Equation (frf-exponential).
    """
    return np.exp(-np.arange(n_sample) / constant)


def phase_factors(lines: IntArray, samples: IntArray, n_sample: int) -> ComplexArray:
    """exp(-jwt) (n_line, n) [1] of *lines* of a block of *n_sample* samples at *samples* (n,)."""
    return np.exp(-2j * np.pi / n_sample * np.outer(lines, samples))


def window_shapes(window: FloatArray, trigger: int, lines: IntArray) -> ComplexArray | None:
    """Amplitudes (n_line, n) [1] at *lines* of white noise under the *window* (n_sample,) of a hit, counted
    from its *trigger* and relative to the root of its power, by n independent real numbers of variance 1 that
    hold nearly all of it; None where these are more than MOST_COURSES.
    """
    at = np.flatnonzero(window)
    # Twice the band times the length of the window.
    if 2 * lines.size * at.size > MOST_COURSES * window.size:
        return None
    shapes = phase_factors(lines, at - trigger, window.size) * (window[at] / np.linalg.norm(window))
    _, sizes, rows = np.linalg.svd(np.concatenate([shapes.real, shapes.imag]), full_matrices=False)
    shapes = shapes @ rows[sizes > LEAST_COURSE * sizes[0]].T
    # Of hits with more no noise would be left beside them.
    return shapes if shapes.shape[1] <= lines.size else None


def without_window_noise(
    motion: ComplexArray, force: ComplexArray, gain: ComplexArray, noise: FloatArray, shapes: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """The *motion* (n_hit, n_line, n_output) and *force* (n_hit, n_line) [N s per spacing] of hits without
    the noise of the force: *shapes* (n_line, n) by independent numbers of variance 1, whose most likely
    values z explain what the motion is beside *gain* (n_line, n_output) times the force.

    *noise* (n_line, n_output) [squared unit of the motion]: what a hit scatters by, that of the force with
    it; the second of PASSES has it without. Of a residual r = D z + e with e of variance 1, D z takes the
    share h = diag(D (1 + D^T D)^-1 D^T), most at a resonance: between hits what is left grows by
    (1 - h)^-1/2, so that it scatters as e does. Equation (frf-force-alignment).
    """
    left = motion - gain * force[..., None]
    columns = -gain[:, :, None] * shapes[:, None, :]
    # Hits that repeat to the last digit scatter by nothing.
    least = np.finfo(float).eps ** 2 * np.mean(np.abs(motion) ** 2, axis=0) + np.finfo(float).tiny
    for _ in range(PASSES):
        weights = np.sqrt(2 / np.maximum(noise, least))[..., None]
        rows = (
            (columns * weights).reshape(-1, shapes.shape[1]),
            (left * weights[..., 0]).reshape(len(left), -1).T,
        )
        design, right = (np.concatenate([of.real, of.imag]) for of in rows)
        inverse = np.linalg.inv(np.eye(shapes.shape[1]) + design.T @ design)
        amounts = inverse @ (design.T @ right)
        taken = np.mean(np.sum(design @ inverse * design, axis=1).reshape(2, *gain.shape), axis=0)
        kept = np.maximum(1 - taken, np.finfo(float).eps)
        rest = left - np.moveaxis(columns @ amounts, -1, 0)
        noise = np.mean(np.abs(rest) ** 2, axis=0) / kept
    force = force - (shapes @ amounts).T
    # A pulse of a few samples has no power at all at some line.
    power = np.maximum(np.sum(np.abs(force) ** 2, axis=0), np.finfo(float).tiny)[:, None]
    mean = np.sum(motion * force[..., None].conj(), axis=0) / power * force[..., None]
    return mean + (motion - mean) / np.sqrt(kept), force
