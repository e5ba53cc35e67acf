"""Worlds of a frequency response: what its sensors would record of a fitted model, every number off, with new
noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from labpipe.estimation.fitting import identify
from labpipe.estimation.leakage import SharedNoise
from labpipe.estimation.measured import select_ports
from labpipe.estimation.model import Setup
from labpipe.estimation.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port
from tests.draws.usual import Errors, angle_error, factor_of

# With more averages than this the weights are as good as known.
MOST_AVERAGES = 20.0
# The matrix of a world (n_line, n_output, n_input), forces turned by angles (n_input,) [rad]; where the
# response's columns do not tell.
Turned = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Scatter:
    """Covariances as the scatter of few periods tells them: *dof* of one line, means over *width* lines,
    *there*: (n, n) what is told.

    Weights that are themselves estimated cost efficiency, which the stated standard errors hold; with weights
    that are known the scatter of the estimates would be smaller than stated.
    """

    dof: int
    width: int
    there: np.ndarray

    def estimated(self, root: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(n_line, n, n): complex Wishart of unit mean, averaged over neighbouring lines, about the
        covariance *root* root^H.
        """
        n_line, n = root.shape[:2]
        parts = rng.standard_normal((2, n_line, n, self.dof)) / np.sqrt(2)
        white = parts[0] + 1j * parts[1]
        told = white @ white.conj().swapaxes(1, 2) / self.dof
        sums = np.cumsum(np.concatenate([np.zeros((1, n, n)), told]), axis=0)
        first = np.maximum(np.arange(n_line) - self.width // 2, 0)
        last = np.minimum(first + self.width, n_line)
        first = last - self.width if n_line >= self.width else first
        means = (sums[last] - sums[first]) / (last - first)[:, None, None]
        return np.asarray(root @ means @ root.conj().swapaxes(1, 2) * self.there)


def scatter_of(response: FrequencyResponse) -> Scatter | None:
    """Of responses of which every force was measured by itself over few periods.

    Others have averages enough.
    """
    covariance, averages = response.covariance, response.averages
    assert covariance is not None
    n_output, n_input = response.matrix.shape[1:]
    there = np.abs(covariance).max(axis=0) > 0
    alone = np.kron(np.ones((n_output, n_output)), np.eye(n_input)) > 0
    dof = response.covariance_dof
    if not np.isfinite(dof) or averages > MOST_AVERAGES or np.any(there & ~alone):
        return None
    width = max(round(dof / (averages - 1)), 1)
    return Scatter(max(round(averages - 1), 1), width, there) if width * (averages - 1) > n_output else None


@dataclass(frozen=True)
class ResponseWorlds:
    """Worlds about a *response* whose matrix is that of the model: recorded with errors and noise of the
    response's own covariance.

    scatter: how the covariance itself is estimated anew in every world; None where it is known, or has too
    many averages to matter.
    """

    response: FrequencyResponse
    root: np.ndarray
    lines: SharedNoise | None
    turned: Turned | None = None
    scatter: Scatter | None = None

    def recorded(self, errors: Errors, rng: np.random.Generator | None) -> FrequencyResponse:
        response = self.response
        matrix = self._aimed(errors)
        omega = 2 * np.pi * response.frequency
        matrix = (
            matrix
            * np.stack([factor_of(port.uncertainties, omega, errors) for port in response.outputs], axis=1)[
                :, :, None
            ]
        )
        matrix = (
            matrix
            / np.stack([factor_of(port.uncertainties, omega, errors) for port in response.inputs], axis=1)[
                :, None, :
            ]
        )
        # What sums of channels do to the matrix, to first order.
        matrix = matrix + sum(
            errors.of(one.uncertainty) / one.uncertainty.std_error * one.change for one in response.errors
        )
        if rng is None:
            return replace(response, matrix=matrix)
        covariance = response.covariance if self.scatter is None else self.scatter.estimated(self.root, rng)
        return replace(response, matrix=matrix + self._noise(rng), covariance=covariance)

    def _aimed(self, errors: Errors) -> np.ndarray:
        """Sensors and forces in the directions that they have, not in those that are written: written = true
        + error.
        """
        response = self.response
        matrix = response.matrix
        of_forces = np.array([angle_error(port.uncertainties, errors) for port in response.inputs])
        if self.turned is not None:
            matrix = self.turned(-of_forces)
        else:
            matrix = turned_rows(response.inputs, matrix.swapaxes(1, 2), -of_forces).swapaxes(1, 2)
        return turned_rows(
            response.outputs,
            matrix,
            -np.array([angle_error(port.uncertainties, errors) for port in response.outputs]),
        )

    def _noise(self, rng: np.random.Generator) -> np.ndarray:
        n_line, n = self.root.shape[:2]
        if self.lines is not None:
            white = self.lines.draw(rng, n)[..., 0]
        else:
            parts = rng.standard_normal((2, n_line, n)) / np.sqrt(2)
            white = parts[0] + 1j * parts[1]
        return np.einsum("lab,lb->la", self.root, white).reshape(self.response.matrix.shape)


def turned_rows(ports: tuple[Port, ...], matrix: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Rows (n_line, n_port, n) of ports of known direction turned *by* angles (n_port,) [rad].

    As they are where the plane is not told.
    """
    known = [number for number, port in enumerate(ports) if port.angle is not None]
    angles = np.array([ports[number].angle for number in known], float)
    plane = np.column_stack([np.cos(angles), np.sin(angles)])
    if len(known) < 2 or np.linalg.svd(plane, compute_uv=False)[-1] < 0.1:
        return matrix
    turned = matrix.copy()
    now = angles + by[known]
    turned[:, known] = np.column_stack([np.cos(now), np.sin(now)]) @ np.linalg.pinv(plane) @ matrix[:, known]
    return turned


def response_worlds(
    response: FrequencyResponse, settings: FitSettings
) -> tuple[ResponseWorlds, FrequencyResponse]:
    """Worlds about the fit of one band to the *response*, and the part of the response on the lines of the
    fit.
    """
    (fit,) = identify(response, replace(settings, compare=False, bootstrap=0, monte_carlo=0), judging=False)
    curve = fit.curve
    assert curve is not None and curve.form == response.form
    lines = np.min(np.abs(response.frequency[:, None] - curve.frequency), axis=1) < 1e-6 * response.frequency
    part = _on_lines(response, lines)
    rows = [[port.label for port in part.outputs].index(name) for name in curve.outputs]
    columns = [[port.label for port in part.inputs].index(name) for name in curve.inputs]
    matrix = part.matrix.copy()
    matrix[np.ix_(range(matrix.shape[0]), rows, columns)] = curve.fitted
    truth = replace(part, matrix=matrix)
    return replace(worlds_about(truth), turned=_by_model(truth, settings, fit)), part


def worlds_about(truth: FrequencyResponse) -> ResponseWorlds:
    """Worlds whose response is the *truth* but for errors and noise of the covariance that stands in it."""
    assert truth.covariance is not None
    values, vectors = np.linalg.eigh(truth.covariance)
    # The Hermitian root goes smoothly from line to line; eigenvectors alone change sign and order, and noise
    # that lines share would not be.
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ vectors.conj().swapaxes(1, 2)
    noise = None
    if truth.line_correlation:
        spacing = np.min(np.diff(truth.frequency))
        gains = (
            None if truth.line_gains is None else truth.line_gains.reshape(*truth.line_gains.shape[:2], -1)
        )
        noise = SharedNoise(
            np.round(truth.frequency / spacing).astype(int), np.array(truth.line_correlation, complex), gains
        )
    return ResponseWorlds(truth, root, noise, scatter=scatter_of(truth))


def _on_lines(response: FrequencyResponse, lines: np.ndarray) -> FrequencyResponse:
    names = (
        "matrix",
        "covariance",
        "coherence",
        "multiple_coherence",
        "partial_coherence",
        "distortion",
        "line_gains",
    )
    cut = {
        name: None if getattr(response, name) is None else getattr(response, name)[lines] for name in names
    }
    errors = tuple(replace(one, change=one.change[lines]) for one in response.errors)
    rest = {"change": None, "open_loop": None, "snr": None, "snr_channels": (), "errors": errors}
    return replace(response, frequency=response.frequency[lines], **cut, **rest)


def _by_model(truth: FrequencyResponse, settings: FitSettings, fit: Fit) -> Turned | None:
    """The response with forces in other directions, by the fitted model.

    None where columns tell it, or direction does not count.
    """
    if settings.model != "rotor-2dof-direct" or len(truth.inputs) > 1 or truth.inputs[0].angle is None:
        return None
    rows, columns = select_ports(truth, settings.input, settings.output)
    plain = replace(settings, subtract=None, share=1)
    whole = {p.name: p.value * settings.share for p in fit.parameters}
    support = settings.subtract
    if support is not None:
        whole = {
            k: v + {"k": support.stiffness.value, "c": support.damping.value}.get(k[0], 0.0)
            for k, v in whole.items()
        }
    omega = 2 * np.pi * truth.frequency

    def receptance(by: np.ndarray) -> np.ndarray:
        inputs = tuple(replace(truth.inputs[c], angle=truth.inputs[c].angle + by[c]) for c in columns)
        model = settings.kind.model(Setup(tuple(truth.outputs[r] for r in rows), inputs, plain))
        return model.receptance(np.array([whole[name] for name in model.names]), omega)

    start = receptance(np.zeros(len(truth.inputs)))
    np.testing.assert_allclose(start, truth.matrix[:, rows], rtol=1e-6)

    def turned(by: np.ndarray) -> np.ndarray:
        matrix = truth.matrix.copy()
        matrix[:, rows] = receptance(by)
        return matrix

    return turned
