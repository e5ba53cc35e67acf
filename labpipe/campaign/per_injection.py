"""Spectra of all channels as responses to the injections: signals of several quantities, none of them taken as free of noise."""

from __future__ import annotations

import numpy as np

from labpipe.arrays import ComplexArray
from labpipe.campaign.loop_sources import merged
from labpipe.errors import ConfigError
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.doubt import Doubt, MatrixError
from labpipe.records.response import FrequencyResponse, Port

# Condition number of the injections of all runs beyond which they are one.
ONE_INJECTION = 1e6


def per_injection(spectra: ChannelSpectra) -> FrequencyResponse:
    """H = Y R^-1 of the runs, Y the channels of role output and R those of role input, dH = (dY - H dR) R^-1.

    Doubts of channels and of sums go the same way, but for directions that no other channel tells, which stay at their ports.
    ConfigError where there is not one run per injection, or where the runs do not tell them apart. Equation (comp-injection).
    """
    inputs, outputs = ([n for n, channel in enumerate(spectra.channels) if channel.role == role] for role in ("input", "output"))
    if len(spectra.runs) != len(inputs):
        hint = "one recording per injection, the injections alone with role: input"
        raise ConfigError(f"{len(spectra.runs)} run(s) for {len(inputs)} injection(s)", hint=hint)
    injected = spectra.vectors[:, :, inputs].swapaxes(1, 2)
    if np.any(np.linalg.cond(injected) > ONE_INJECTION):
        raise ConfigError("the runs do not tell the injections apart", hint="inject into one loop after the other")
    inverse = np.linalg.inv(injected)
    matrix = spectra.vectors[:, :, outputs].swapaxes(1, 2) @ inverse
    return FrequencyResponse(
        spectra.frequency,
        matrix,
        tuple(_port(spectra, n) for n in outputs),
        tuple(_port(spectra, n) for n in inputs),
        form="other",
        covariance=_covariance(spectra, (outputs, inputs), matrix, inverse),
        covariance_dof=spectra.covariance_dof,
        line_correlation=spectra.line_correlation,
        errors=_errors(spectra, (outputs, inputs), matrix, inverse),
        name=spectra.name,
        findings=spectra.findings,
        conditions=dict(spectra.conditions),
    )


def _covariance(spectra: ChannelSpectra, places: tuple[list[int], list[int]], matrix: ComplexArray, inverse: ComplexArray) -> ComplexArray:
    """E[dH dH^H] (n_line, n, n) row by row: sum over runs of E[(dY - H dR)(dY - H dR)^H] times what the run is in R^-1."""
    outputs, inputs = places
    rows = np.zeros((*matrix.shape[:2], len(spectra.channels)), np.complex128)
    rows[:, np.arange(len(outputs)), outputs] = 1.0
    rows[:, :, inputs] -= matrix
    noise = np.einsum("loc,lrcd,lpd->lrop", rows, spectra.covariance, rows.conj())
    joint: ComplexArray = np.einsum("lrop,lri,lrj->loipj", noise, inverse, inverse.conj())
    n = matrix.shape[1] * matrix.shape[2]
    return joint.reshape(-1, n, n)


def _errors(
    spectra: ChannelSpectra, places: tuple[list[int], list[int]], matrix: ComplexArray, inverse: ComplexArray
) -> tuple[MatrixError, ...]:
    """dH (n_line, n_output, n_input) by one standard uncertainty of every source in the channels and their sums."""
    outputs, inputs = places
    doubts = {doubted.doubt.source: doubted.doubt for channel in spectra.channels for doubted in channel.doubts}
    omega = 2 * np.pi * spectra.frequency
    errors = []
    for factor in spectra.factors:
        moved = spectra.vectors @ factor.derivative.T * (factor.std_error * omega**factor.power)[:, None, None]
        change = (moved[:, :, outputs].swapaxes(1, 2) - matrix @ moved[:, :, inputs].swapaxes(1, 2)) @ inverse
        doubt = doubts.get(factor.source, Doubt(factor.source, factor.std_error, factor.unit))
        errors.append(MatrixError(doubt, change))
    return merged(errors)


def _port(spectra: ChannelSpectra, number: int) -> Port:
    channel = spectra.channels[number]
    factor_sources = {factor.source for factor in spectra.factors}
    left = tuple(doubted for doubted in channel.doubts if doubted.doubt.source not in factor_sources)
    return Port(channel.name, channel.name, channel.dof, channel.angle, left)
