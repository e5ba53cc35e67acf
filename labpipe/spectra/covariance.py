"""The covariance of a frequency response matrix: E[d d^H] of d = vec(H - E H), row-major (index = output *
n_input + input).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from labpipe.arrays import ComplexArray, FloatArray, freeze_bases
from labpipe.records.response import BlockCovariance, FactoredCovariance, StoredCovariance
from labpipe.spectra.matrices import (
    hermitian,
    inverse,
    lines_last,
    product,
    schur_complement,
    without_rounding,
)
from labpipe.spectra.period_average import neighbourhood_mean

# Degrees of freedom of the noise up to which it is averaged over neighbouring lines.
ENOUGH_DOF = 16.0
# Rounds of the fit of a residual's two parts, and standard errors by which a part must exceed zero.
REWEIGHTED = 5
SIGNIFICANT = 3.0
# Gain in the logarithm of the likelihood from which noise follows a response, and the least noise [unit^2].
BETTER, TINY = 4.5, float(np.finfo(float).tiny)
# Recordings share their noise unless it differs by more than this share and more standard errors than this.
# Their levels are compared on lines with the mean of so many to either side.
SAME_SHARE, SAME_ERRORS, SMOOTH = 0.1, 4.0, 12
# Noise in the power of the forces up to which it is taken out of it.
MOST_NOISE = 0.5
# Lines from which on a response is interpolated between its neighbours, and how far |H|^2 may be from there.
FEWEST_LINES, MOST_APART = 5, 4.0
# Numbers of matrices that are made together: a part of the cache.
CACHED_NUMBERS = 1 << 16


def covariance_of_random(
    spectra: ComplexArray,
    response: ComplexArray,
    instruments: ComplexArray,
    averages: float,
    half_width: int = 0,
    parts: Sequence[tuple[ComplexArray, FloatArray]] = (),
) -> ComplexArray:
    """cov(H_oi, H_pj) = S_rr[o, p] (B_p^H S_zz[p, o] B_o)[j, i] / (n_e - n_input), B_o = (E[u z_o^H])^-1,
    S_rr = [-H, I] S [-H, I]^H. The error of an estimator with instruments z is d_o = sum_k r_o z_o^H B_o /
    n_e, r = y - H u. Exact for H1, first order in 1 / n_e for the others. spectra (n_frequency, n, n)
    [unit^2/Hz] of all channels, the n_input forces first; response (n_frequency, n_output, n_input) [unit/N];
    instruments W (n_frequency, n_output or 1, n_input, n) with z_o = W_o [u; y], see random.INSTRUMENTS;
    *parts* that add up to the spectra, with the level (n_output,) of the noise in each. The residual's
    spectrum is averaged over *half_width* lines to either side, where few averages alone would tell little of
    it (pooled_residual). Equation (frf-covariance-random).
    """
    n_frequency, _, n_input = response.shape
    residual = pooled_residual(residual_spectrum(spectra, response), response, half_width)
    force_products = spectra[:, None, :n_input] @ hermitian(instruments)
    # B_o^H W_o of every response in rows, so that one product gives the spread of all pairs of responses.
    gain = hermitian(inverse(force_products)) @ instruments
    rows = gain.reshape(n_frequency, -1, gain.shape[3])
    shape = n_frequency, gain.shape[1], n_input, gain.shape[1], n_input
    whole = np.zeros((n_frequency, response[0].size, response[0].size), np.complex128)
    for part, level in parts or [(spectra, np.ones(response.shape[1]))]:
        spread = (rows @ part @ hermitian(rows)).reshape(shape) / max(averages - n_input, 1.0)
        # B_p^H S_zz[p, o] B_o stands at [p, j, o, i]; the covariance needs it at [o, i, p, j].
        whole += _join(residual * np.sqrt(np.outer(level, level)), spread.transpose(0, 3, 4, 1, 2))
    return without_rounding(whole)


def covariance_of_h1(
    spectra: ComplexArray,
    response: ComplexArray,
    inverse_force: ComplexArray,
    averages: float,
    half_width: int = 0,
) -> FactoredCovariance:
    """cov(H_oi, H_pj) = S_rr[o, p] (S_uu^-1)[j, i] / (n_e - n_input): covariance_of_random with the forces as
    instruments. S_rr = S_yy - S_yu S_uu^-1 S_uy here. inverse_force: S_uu^-1 (n_frequency, n_input, n_input)
    [Hz/N^2]; the result, of (n_frequency, n, n), stays in its two factors, since it is large where there are
    many responses; the other arguments as there. Equation (frf-covariance-h1).
    """
    residual = pooled_residual(schur_complement(spectra, response.shape[2]), response, half_width)
    spread = without_rounding(inverse_force).swapaxes(1, 2) / max(averages - response.shape[2], 1.0)
    return FactoredCovariance(freeze_bases(residual), freeze_bases(spread))


def residual_spectrum(spectra: ComplexArray, response: ComplexArray) -> ComplexArray:
    """S_rr of r = y - H u, [-H, I] S [-H, I]^H, (n_frequency, n_output, n_output) [unit^2/Hz]; arguments as
    in covariance_of_random.
    """
    n_line, n_output, n_input = response.shape
    residual = lines_last(n_line, n_output, n_output)
    n_chunk = max(1, CACHED_NUMBERS // n_output**2)
    for start in range(0, n_line, n_chunk):
        chunk = slice(start, start + n_chunk)
        h = response[chunk]
        left = spectra[chunk, n_input:] - product(h, spectra[chunk, :n_input])
        residual[chunk] = without_rounding(left[:, :, n_input:] - product(left[:, :, :n_input], hermitian(h)))
    return residual


def _join(residual: ComplexArray, spread: ComplexArray) -> ComplexArray:
    n_frequency, n_output = residual.shape[:2]
    n = n_output * spread.shape[2]
    covariance = lines_last(n_frequency, n, n)
    by_axes = (
        covariance.transpose(1, 2, 0)
        .reshape(n_output, -1, n_output, n // n_output, n_frequency)
        .transpose(4, 0, 1, 2, 3)
    )
    np.multiply(residual[:, :, None, :, None], spread, out=by_axes)
    diagonal = np.einsum("fii->fi", covariance)
    diagonal[...] = np.maximum(diagonal.real, 0.0)
    return covariance


def pooled_residual(residual: ComplexArray, response: ComplexArray, half_width: int) -> ComplexArray:
    """The residual's spectrum (n_frequency, n_output, n_output) [unit^2/Hz] averaged over *half_width* lines
    to either side. Where what grows with the *response* (n_frequency, n_output, n_input) [unit/N] is
    significant, as noise of the force and hits that are not alike do, lines are averaged relative to a + b
    |H|^2. Equation (frf-pooled-residual).
    """
    if half_width == 0:
        return residual
    # As many lines as are averaged have ENOUGH_DOF degrees of freedom together.
    of_line = (2 * half_width + 1) / ENOUGH_DOF
    shape = noise_shape(np.einsum("foo->fo", residual).real, response, of_line)
    scale = np.sqrt(shape[:, :, None] * shape[:, None, :])
    mean: ComplexArray = (
        neighbourhood_mean(residual / scale, np.ones(residual.shape[0], bool), half_width) * scale
    )
    return mean


def pooled_by_force(
    noise: ComplexArray, response: ComplexArray, freedoms: FloatArray, half_width: int, shares: bool
) -> ComplexArray:
    """The residual's spectrum where each force acts alone (n_line, n_input, n_output, n_output) [unit^2/Hz],
    from *noise* of that shape, sums of *freedoms* (n_input,) complex degrees of freedom each: averaged over
    the forces and over *half_width* lines to either side, relative to the level of noise in a force's
    recordings and to a + b |H_oi|^2 of that force alone: a point at a node has little of what grows with the
    response. Not where it *shares* noise among responses, which the levels of each would turn. Equation
    (frf-pooled-force).
    """
    shape: FloatArray = np.ones(noise.shape[:3])
    if half_width or (noise.shape[1] > 1 and not shares):
        residual = np.einsum("lioo->lo", noise).real
        of_line = (2 * half_width + 1) / ENOUGH_DOF if half_width else 1 / freedoms.sum()
        shape = _force_shapes(residual, response, freedoms, of_line)
    power = np.einsum("lioo->lio", noise).real / shape
    if not shares:
        shape = shape * noise_levels(power.swapaxes(1, 2), freedoms).T
    elif noise.shape[1] > 1:
        shape = shape * _shared_levels(power, freedoms)[:, :, None]
    # As loud as each other before they are added: the sum would know no more than its loudest part does.
    size = np.sqrt(shape[..., :, None] * shape[..., None, :])
    alike = np.divide(noise, size, out=np.zeros_like(noise), where=size > 0).sum(axis=1)
    if half_width:
        alike = neighbourhood_mean(alike, np.ones(len(alike), bool), half_width)
    return np.asarray(alike[:, None] * (size / freedoms.sum()))


def _shared_levels(power: FloatArray, freedoms: FloatArray) -> FloatArray:
    """Noise of all responses together where each force acts over that of all forces (n_line, n_input) [1], of
    which leakage has more around the modes that the force drives: the mean over SMOOTH lines to either side;
    1 where levels are alike within the errors of such means. *power* (n_line, n_input, n_output) [any unit]
    of *freedoms* (n_input,) complex degrees of freedom per line.
    """
    every, whole = np.ones(len(power), bool), power.sum(axis=1, keepdims=True)
    whole = neighbourhood_mean(whole, every, SMOOTH)
    ratio = np.divide(power, whole, out=np.ones_like(power), where=whole > 0).mean(axis=2, keepdims=True)
    level = neighbourhood_mean(ratio, every, SMOOTH)[..., 0] * freedoms.sum() / np.maximum(freedoms, 1.0)
    levels = noise_levels(ratio.swapaxes(1, 2), freedoms)
    return np.where(levels == 1, 1.0, level)


def _force_shapes(
    residual: FloatArray, response: ComplexArray, freedoms: FloatArray, of_line: float
) -> FloatArray:
    """a + b |H_oi|^2 (n_line, n_input, n_output) [1] where each force acts alone, a and b of every output's
    *residual* (n_line, n_output) over all of them; 1 where b is not SIGNIFICANT. Arguments as in noise_shape
    and pooled_by_force.
    """
    powers, shapes = _power(response), []
    for variance, power in zip(residual.T, powers.swapaxes(0, 1), strict=True):
        mean = power @ (freedoms / freedoms.sum())
        constant, slope = _shape(variance, mean, of_line)
        shapes.append(np.maximum(constant + slope * power, np.finfo(float).eps))
    return np.stack(shapes, axis=2)


def lines_around(dof: float, shared: float, n_line: int) -> tuple[int, float]:
    """Lines to either side over which noise of *dof* complex degrees of freedom is averaged where it has less
    than ENOUGH_DOF, and the degrees of freedom of the mean. *shared*: lines that share one value of it; 0:
    averages of no lines.
    """
    if shared == 0:
        return 0, dof
    half_width = int(np.ceil((ENOUGH_DOF * shared / dof - 1) / 2)) if 0 < dof < ENOUGH_DOF else 0
    return half_width, dof * max(1.0, min(2 * half_width + 1, n_line) / shared)


def noise_levels(residual: FloatArray, dof: FloatArray) -> FloatArray:
    """Noise of the responses where each force acts over that of all (n_output, n_input) [1], the mean over
    the lines; 1 where they are alike within the errors of such means. *residual* (n_line, n_output, n_input)
    [any unit] of *dof* (n_input,) complex degrees of freedom per line.
    """
    every = np.ones(len(residual), bool)
    # Of single lines a quotient of two estimates would be too large on average.
    pooled = neighbourhood_mean(residual.sum(axis=2, keepdims=True) / dof.sum(), every, SMOOTH)
    ratio = np.divide(residual, pooled, out=np.ones_like(residual), where=pooled > 0)
    is_driven = dof > 0
    level = ratio.mean(axis=0) / np.where(is_driven, dof, 1.0)
    error = np.sqrt((1 / np.where(is_driven, dof, 1.0) + 1 / dof.sum()) / residual.shape[0])
    alike = np.abs(level - 1) < np.maximum(SAME_SHARE, SAME_ERRORS * error)
    return np.where(alike | ~is_driven, 1.0, np.maximum(level, 0.0))


def covariance_of_parts(noise: ComplexArray, spread: ComplexArray, levels: FloatArray) -> ComplexArray:
    """cov(H_oi, H_pj) = R[o, p] sum_e sqrt(g_oe g_pe) G_e[i, j] (n_line, n, n) [unit^2 of H]. noise R
    (n_line, n_output, n_output) [unit^2]; spread G (n_line, n_part, n_input, n_input) [1/N^2] and levels g
    (n_output, n_part) [1] of parts of the record, see noise_levels.
    """
    size = np.sqrt(levels)
    whole = np.einsum("lop,oe,pe,leij->loipj", noise, size, size, spread, optimize=True)
    n = noise.shape[1] * spread.shape[2]
    return without_rounding(whole.reshape(-1, n, n))


def _power(response: ComplexArray) -> FloatArray:
    """|H_oi|^2 (n_line, n_output, n_input) [unit^2/N^2] of H of that shape [unit/N], each 1 / H by the
    parabola through its two neighbours on either side: smooth at a resonance, however narrow, and without
    the noise of the line itself, which would tilt the weights that follow. Not far from the line's own, as
    it is where H is noise and 1 / H may vanish between the lines.
    """
    size = np.abs(response) ** 2
    if len(response) >= FEWEST_LINES:
        stiffness = np.divide(1.0, response, out=np.zeros_like(response), where=response != 0)
        padded = np.pad(stiffness, ((2, 2), (0, 0), (0, 0)), mode="reflect", reflect_type="odd")
        between = np.abs(4 * (padded[1:-3] + padded[3:-1]) - padded[:-4] - padded[4:]) ** 2 / 36
        between = np.divide(1.0, between, out=np.full_like(size, np.inf), where=between > 0)
        size = np.clip(between, size / MOST_APART, size * MOST_APART)
    return np.asarray(size)


def noise_shape(
    variance: FloatArray, response: ComplexArray, of_line: float, half_width: int = 0
) -> FloatArray:
    """a + b |H|^2 [1] of each output's *variance* (n_line, n_output) [any unit] where b is SIGNIFICANT, else
    1; *response* H (n_line, n_output, n_input) [unit/N]. *of_line*: relative variance [1] of a line's
    variance. With a *half_width* also only where so many lines to either side tell a line better by it:
    wander at low frequencies follows no resonance.
    """
    shapes = []
    for one, power in zip(variance.T, _power(response).sum(axis=2).T, strict=True):
        constant, slope = _shape(one, power, of_line)
        shape = np.maximum(constant + slope * power, np.finfo(float).eps)
        better = half_width == 0 or _gain(one, shape, half_width) > BETTER * of_line
        shapes.append(shape if better else np.ones_like(shape))
    return np.column_stack(shapes)


def _gain(variance: FloatArray, shape: FloatArray, half_width: int) -> float:
    """What the logarithm of the likelihood of chi-square gains by a *shape* (n_line,) [1], by neighbours."""
    every = np.ones(variance.size, bool)
    plain, sharp = (
        np.maximum(neighbourhood_mean(variance / of, every, half_width, centre=False) * of, TINY)
        for of in (np.ones_like(shape), shape)
    )
    return float(np.sum(np.log(plain / sharp) + variance * (1 / plain - 1 / sharp)))


def _shape(variance: FloatArray, power: FloatArray, of_line: float) -> tuple[float, float]:
    """a [1] and b [over the unit of the power] of a *variance* (n_line,) [any unit] that goes as a + b
    *power* (n_line,), least squares relative to itself; 1 and 0 where b is not SIGNIFICANT.
    """
    shape = np.ones_like(variance)
    # A silent response has no power.
    largest = float(np.max(power)) or 1.0
    columns = np.column_stack([shape, power / largest])
    variance = np.maximum(variance, np.finfo(float).eps * np.max(variance))
    variance = variance / np.max(variance) if np.max(variance) > 0 else shape
    for _ in range(REWEIGHTED):
        weighted = columns / shape[:, None]
        values = scipy.optimize.nnls(weighted, variance / shape)[0]
        shape = np.maximum(columns @ values, np.finfo(float).eps)
    covariance = np.linalg.pinv(weighted.T @ weighted) * of_line
    if values[1] <= SIGNIFICANT * np.sqrt(covariance[1, 1]):
        return 1.0, 0.0
    return float(values[0]), float(values[1]) / largest


def joined_response(mean: ComplexArray, inverse: ComplexArray, noise: ComplexArray | None) -> ComplexArray:
    """H = (Y U^H - N_yu) (U U^H - N_uu)^-1 (n_line, n_output, n_input) [unit/N] of all recordings, N = sum_e
    (1 - h_e) N_e with h_e = (U^+ U)_ee. mean (n_line, n_input + n_output, n_recording) [unit], forces first;
    inverse (n_line, n_recording, n_input) [1/N] = U^+; noise (n_recording, n_line, n_channel, n_channel)
    [unit^2]. Y U^+ as it is where the noise is not known, or more than half of the forces. Equation
    (frf-joined).
    """
    n_input = inverse.shape[2]
    response = mean[:, n_input:] @ inverse
    if noise is None or mean.shape[2] == n_input:
        return response
    spare = 1 - np.einsum("lei,lie->el", inverse, mean[:, :n_input]).real
    share = np.einsum("el,elab->lab", spare, noise)[:, :, :n_input] @ (hermitian(inverse) @ inverse)
    of_forces = share[:, :n_input]
    # The trace of a product of two non-negative matrices bounds its eigenvalues.
    clear = (np.einsum("lii->l", of_forces).real < MOST_NOISE)[:, None, None]
    whole = np.eye(n_input) - np.where(clear, of_forces, 0)
    return (response - np.where(clear, share[:, n_input:], 0)) @ np.linalg.inv(whole)


def covariance_of_periodic(
    response: ComplexArray, force_inverse: ComplexArray, noise: ComplexArray
) -> ComplexArray:
    """cov(H_oi, H_pj) = sum_e R_e[o, p] G[e, i] G[e, j]*, R_e = [-H, I] N_e [-H, I]^H, G = pinv(U). From H =
    Y G over the experiments e (one per force direction): dH = sum_e (dy_e - H du_e) G[e, :]. response
    (n_line, n_output, n_input) [unit/N]; force_inverse (n_line, n_experiment, n_input) [1/N]; noise
    (n_experiment, n_line, n_input + n_output, n_input + n_output) [unit^2], forces first. Equation
    (frf-covariance-periodic).
    """
    n_line, n_output, n_input = response.shape
    identity = np.broadcast_to(np.eye(n_output), (n_line, n_output, n_output))
    weights = np.concatenate([-response, identity], axis=2)
    residual = np.einsum("foa,efab,fpb->efop", weights, noise, weights.conj())
    covariance = np.einsum("efop,fei,fej->foipj", residual, force_inverse, force_inverse.conj())
    n = n_output * n_input
    return without_rounding(covariance.reshape(n_line, n, n))


def correct_covariance(covariance: StoredCovariance, factor: ComplexArray) -> StoredCovariance:
    """The *covariance* of elements times a *factor* (n_frequency, n_output, n_input) [1]."""
    if covariance is None or np.all(factor == 1):
        return freeze_bases(covariance) if isinstance(covariance, np.ndarray) else covariance
    flat = factor.reshape(factor.shape[0], -1)
    if isinstance(covariance, BlockCovariance):
        return covariance.times(flat)
    whole = covariance.whole() if isinstance(covariance, FactoredCovariance) else covariance
    scaled: ComplexArray = whole * flat[:, :, None]
    scaled *= flat[:, None, :].conj()
    return freeze_bases(scaled)
