"""Nonlinear distortion beside noise, from periodic excitation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.periodic import LineSpectrum


@dataclass(frozen=True)
class Distortion:
    """Levels of one FRF element over frequency (n_frequency,) [Hz], all as standard deviations of one realisation's FRF [its unit].

    gain (n_frequency,): best linear approximation, the mean of the realisations; total: standard deviation between realisations of
    the phases; noise: standard deviation from the scatter between periods; nonlinear: the excess of total over noise.
    """

    frequency: FloatArray
    gain: ComplexArray
    total: FloatArray
    noise: FloatArray
    n_realisation: int

    @property
    def nonlinear(self) -> FloatArray:
        """sqrt(total^2 - noise^2), (n_frequency,) [unit of the FRF]; 0 where the noise exceeds the total. Equation (frf-distortion)."""
        return np.asarray(np.sqrt(np.maximum(self.total**2 - self.noise**2, 0.0)))


def robust_distortion(realisations: Sequence[FrequencyResponse], output: int = 0, force: int = 0) -> Distortion:
    """Distortion from FRFs of one rig under several random-phase realisations of one excitation.

    Noise scatters from period to period, stochastic nonlinear contributions only from realisation to realisation (Pintelon and
    Schoukens, System Identification, 2nd ed., sec. 4.3.1: the robust method). DataError for fewer than two realisations, different
    lines, or FRFs of single periods.
    """
    if len(realisations) < 2:
        raise DataError("distortion needs at least two realisations of the phases", hint="record with other phases")
    first = realisations[0]
    for other in realisations:
        if other.frequency.shape != first.frequency.shape or np.any(other.frequency != first.frequency):
            raise DataError(f"'{other.name}' has other lines than '{first.name}'")
        if other.variance is None:
            raise DataError(f"'{other.name}' has no covariance, so its noise level is unknown", hint="record several periods")
    matrices = np.array([response.matrix[:, output, force] for response in realisations])
    noise = np.mean([response.variance[:, output, force] for response in realisations if response.variance is not None], axis=0)
    total = np.var(matrices, axis=0, ddof=1)
    return Distortion(first.frequency, matrices.mean(axis=0), np.sqrt(total), np.sqrt(noise), len(realisations))


@dataclass(frozen=True)
class DetectionLines:
    """Response at lines without force: *frequency* (n,) [Hz], *level* |Y| and *noise* std of Y (n,) [unit of the channel]."""

    frequency: FloatArray
    level: FloatArray
    noise: FloatArray

    @property
    def distortion(self) -> float:
        """Root mean square of the level after subtraction of the noise power; 0 where the noise is stronger. Equation (frf-detection)."""
        return max(float(np.mean(self.level**2 - self.noise**2)), 0.0) ** 0.5 if self.level.size else 0.0


def detection_lines(spectrum: LineSpectrum, excited: BoolArray, column: int, spacing: float) -> dict[str, DetectionLines]:
    """Odd and even lines without force, within the band of the excited ones: "odd" and "even" distortion of one output.

    An odd multisine in a nonlinear system of even order responds at even lines only, of odd order at odd ones only, so lines left
    out on purpose show both (Pintelon and Schoukens, sec. 4.3.2: the fast method). *spacing* [Hz]: fundamental of the excitation;
    *excited* (n_line,): mask of the spectrum's lines. DataError without noise, or when the force leaves no line out.
    """
    if spectrum.noise is None:
        raise DataError("detection lines need the noise of at least two periods")
    if not np.any(excited):
        raise DataError("no line is excited")
    numbers = np.round(spectrum.frequency / spacing).astype(np.int64)
    on_grid = np.abs(spectrum.frequency / spacing - numbers) < 1e-6
    first, last = np.flatnonzero(excited)[[0, -1]]
    silent = on_grid & ~excited
    silent[:first] = silent[last + 1 :] = False
    if not np.any(silent):
        raise DataError("the force acts at every line, none is left to detect distortion", hint="leave lines out of the excitation")
    std = np.sqrt(np.einsum("fii->fi", spectrum.noise).real[:, column])
    level = np.abs(spectrum.mean[:, column])
    chosen = {"odd": silent & (numbers % 2 == 1), "even": silent & (numbers % 2 == 0)}
    return {kind: DetectionLines(spectrum.frequency[lines], level[lines], std[lines]) for kind, lines in chosen.items()}
