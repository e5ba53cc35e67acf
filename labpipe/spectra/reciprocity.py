"""Test of reciprocity, H_ij = H_ji within the standard errors, as on a structure without rotation and control."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.distributions import gamma_tail
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note
from labpipe.records.response import FrequencyResponse

# Neighbouring lines of a windowed spectrum share noise over this many lines.
SHARED_LINES = 3
# Pairs reported, the p-value below which a difference is significant, and the least p-value printed.
MOST_PAIRS = 6
NOT_BY_CHANCE = 0.01
LEAST_CHANCE = 1e-12


@dataclass(frozen=True)
class Reciprocity:
    """H from dof *second* (force) to *first* (response) against the reverse.

    ratio (n_frequency,) [1]: |H_ij - H_ji|^2 over its variance, 1 on average where reciprocity holds; difference [1]: rms of
    |H_ij - H_ji| over the rms of both; p_value: probability of a mean ratio at least as large where reciprocity holds.
    """

    first: str
    second: str
    ratio: FloatArray
    difference: float
    p_value: float


def reciprocity(response: FrequencyResponse) -> tuple[Reciprocity, ...]:
    """All pairs of dofs with both a response and a force; DataError without covariance or without such a pair.

    var(H_ij - H_ji) = C_pp + C_qq - 2 Re C_pq, from the covariance of the response. Equation (frf-reciprocity).
    """
    if response.variance is None:
        raise DataError("reciprocity cannot be tested without the covariance of the FRF", hint="record more periods or blocks")
    rows = {port.dof: number for number, port in enumerate(response.outputs)}
    columns = {port.dof: number for number, port in enumerate(response.inputs)}
    shared = [dof for dof in rows if dof in columns]
    if len(shared) < 2:
        raise DataError("reciprocity needs two dofs that are both excited and measured")
    pairs = [(i, j) for number, i in enumerate(shared) for j in shared[number + 1 :]]
    return tuple(_pair(response, i, j, (rows[i], columns[j]), (rows[j], columns[i])) for i, j in pairs)


def reciprocity_findings(response: FrequencyResponse) -> tuple[Finding, ...]:
    """Notes on the pairs of dofs both excited and measured, the least reciprocal first; none where reciprocity cannot be tested."""
    try:
        pairs = sorted(reciprocity(response), key=lambda pair: (pair.p_value, -pair.difference))
    except DataError:
        return ()
    return tuple(note("reciprocity", _statement(pair)) for pair in pairs[:MOST_PAIRS])


def _statement(pair: Reciprocity) -> str:
    verdict = "as noise explains" if pair.p_value > NOT_BY_CHANCE else "more than noise explains"
    chance = f"= {pair.p_value:.2g}" if pair.p_value >= LEAST_CHANCE else f"< {LEAST_CHANCE:g}"
    what = f"H of {pair.first} to {pair.second} and of {pair.second} to {pair.first}"
    return f"{what} differ by {100 * pair.difference:.3g} % (rms), {verdict} (p {chance})"


def _pair(response: FrequencyResponse, first: str, second: str, forward: tuple[int, int], reverse: tuple[int, int]) -> Reciprocity:
    n_input = len(response.inputs)
    p, q = (row * n_input + column for row, column in (forward, reverse))
    c = response.covariance_of
    variance = (c(p, p) + c(q, q) - 2 * c(p, q).real).real
    here, there = response.matrix[:, *forward], response.matrix[:, *reverse]
    if np.any(variance <= 0):
        raise DataError(f"H of {first} to {second} and its reverse have no variance at a line, so they cannot be compared")
    normal = (here - there) / np.sqrt(variance)
    ratio = np.abs(normal) ** 2
    size = np.sqrt(np.mean(np.abs(here) ** 2 + np.abs(there) ** 2) / 2)
    difference = float(np.sqrt(np.mean(np.abs(here - there) ** 2)) / size)
    return Reciprocity(first, second, ratio, difference, _p_value(normal, response.covariance_dof))


def _p_value(normal: ComplexArray, dof: float) -> float:
    """P(mean ratio at least as large): a gamma distribution with the mean and variance of averaged F(2, 2 dof) ratios.

    Mean dof/(dof-1), variance dof^3 / ((dof-1)^2 (dof-2)) / n_e, with n_e = n / (1 + 2 sum |r_k|^2) effective lines, r_k the
    sample correlation of the differences k lines apart.
    """
    if dof <= 2:
        raise DataError(f"reciprocity cannot be tested with {dof:g} degrees of freedom of the covariance", hint="record longer")
    power = np.sum(np.abs(normal) ** 2)
    shared = [abs(np.sum(normal[k:] * normal[:-k].conj())) / power for k in range(1, min(SHARED_LINES, normal.size - 1) + 1)]
    # The mean of |r|^2 over n lines is 1/n without correlation.
    excess = sum(max(r**2 - 1 / normal.size, 0.0) for r in shared)
    n_effective = max(normal.size / (1 + 2 * excess), 1.0)
    exact = np.isinf(dof)
    shape = n_effective * (1.0 if exact else (dof - 2) / dof)
    mean = power / normal.size * (1.0 if exact else (dof - 1) / dof)
    return gamma_tail(mean * shape, shape)
