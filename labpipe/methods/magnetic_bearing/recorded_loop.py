"""All recorded signals of a loop beside their prediction, and the sign, unit or place that would make them
fit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import ComplexArray
from labpipe.errors import ConfigError, FitError
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.estimation.measured import chosen_ports, matrix_errors, measured_part
from labpipe.methods.magnetic_bearing.bearing import MagneticFile
from labpipe.methods.magnetic_bearing.limits import CertificateSettings
from labpipe.methods.magnetic_bearing.loop_fit import LoopFit, loop_fit
from labpipe.methods.magnetic_bearing.loop_problem import LoopObservation, LoopProblem
from labpipe.methods.magnetic_bearing.stability import INPUT, OUTPUT, open_loop
from labpipe.records.response import FrequencyResponse
from labpipe.records.uncertain import MatrixError

# Powers of ten by which a signal of a wrong unit or sensitivity is off.
POWERS = (-9, -6, -3, -2, -1, 1, 2, 3, 6, 9)
# So many causes that come nearest before a fit are fitted.
FITTED_CAUSES = 4


def recorded_loop(
    own: CertificateSettings, response: FrequencyResponse, file: MagneticFile
) -> LoopObservation:
    """All recorded signals and their prediction.

    With both sides of the sum what is truly added is a complex unknown of every line, the most likely one, so
    that neither gain nor delay of the recorded excitation counts.
    """
    rate = own.rate or file.loop.rate
    named = {
        "after": own.after[0],
        "output": own.output,
        "displacement": own.displacement,
        "current": own.current,
    }
    named |= {"before": own.before[0]} if own.before else {}
    signals = {
        signal: chosen_ports(response.outputs, (name,), "response")[0]
        for signal, name in named.items()
        if name
    }
    if len(response.inputs) != 1:
        raise ConfigError(
            f"one loop has one excitation, not {len(response.inputs)}",
            hint="role: input for the excitation alone",
        )
    lines = np.ones(response.frequency.size, bool)
    measured = measured_part(replace(response, form="receptance"), list(signals.values()), [0], lines)
    if measured.covariance is None:
        raise FitError(
            "the noise of the response is not known, so nothing has an interval",
            hint="average several periods or blocks",
        )
    weights = np.linalg.inv(measured.covariance)

    def per_added(changed: MagneticFile) -> ComplexArray:
        signal = open_loop(changed.levitated(), measured.omega, rate, own.filtered).signals(own.injection)
        return np.stack([signal[name] for name in signals], axis=1)

    def along(per: ComplexArray, vectors: ComplexArray) -> ComplexArray:
        """The part of vectors (n_line, n_signal) that some true addition explains, the most likely one."""
        weighted = np.einsum("la,lab->lb", per.conj(), weights)
        added = np.sum(weighted * vectors, axis=1) / np.sum(weighted * per, axis=1)
        return np.asarray(per * added[:, None])

    def predict(changed: MagneticFile, _: tuple[float, float]) -> ComplexArray:
        per = per_added(changed)
        return np.asarray((along(per, measured.matrix[:, :, 0]) if own.before else per)[:, :, None])

    def errors(changed: MagneticFile, support: tuple[float, float]) -> Sequence[MatrixError]:
        # Changes of the predicted signals: in proportion to measured ones a gain would shrink their noise
        # with them. What is common to all of them is added then, and cancels to the last digit.
        uncertainties = matrix_errors(replace(measured, matrix=predict(changed, support)))
        if not own.before:
            return uncertainties
        per = per_added(changed)
        return [
            replace(error, change=error.change - along(per, error.change[:, :, 0])[:, :, None])
            for error in uncertainties
        ]

    return LoopObservation(
        measured, predict, file, nuisance=2 * measured.omega.size if own.before else 0, errors=errors
    )


def cause_of(
    own: CertificateSettings, response: FrequencyResponse, file: MagneticFile, estimate: Sequence[str]
) -> str:
    """The one change of sign, of a power of ten or of the place of the excitation with which the fit is good;
    empty without one.
    """
    changes = []
    for what, changed_own, changed in _changes(own, response):
        observation = recorded_loop(changed_own, changed, file)
        problem = LoopProblem((observation,), (), ())
        changes.append((problem.chi2(problem.start), what, observation))
    for _, what, observation in sorted(changes, key=lambda change: change[0])[:FITTED_CAUSES]:
        fit = loop_fit([observation], estimate)
        if sound(fit):
            return f"{what} the fit is good (chi-square per degree of freedom {fit.chi2_reduced:.3g})"
    return ""


def sound(fit: LoopFit) -> bool:
    """True where the fit has determined values, if it has unknowns, and leaves no more than noise."""
    return fit.chi2_p >= MISMATCH_P and (fit.usable or not fit.parameters)


def _changes(
    own: CertificateSettings, response: FrequencyResponse
) -> Iterator[tuple[str, CertificateSettings, FrequencyResponse]]:
    """Words, settings and response of every change."""
    place = INPUT if own.injection == OUTPUT else OUTPUT
    yield f"with injection: {place}", replace(own, injection=place), response
    signals = list(dict.fromkeys(own.recorded))
    excitation = [] if own.before else [response.inputs[0].label]
    for name in (*signals, *excitation):
        rows = (
            [chosen_ports(response.outputs, (name,), "response")[0]]
            if name in signals
            else list(range(len(response.outputs)))
        )
        for factor in (-1.0, *(sign * 10.0**power for power in POWERS for sign in (1, -1))):
            # More of the excitation is less of all responses to it.
            yield (
                _words(name, factor),
                own,
                _scaled(response, rows, factor if name in signals else 1 / factor),
            )


def _words(name: str, factor: float) -> str:
    if factor == -1:
        return f"with the sign of '{name}' changed (invert: in the rig file)"
    sign = " and its sign changed" if factor < 0 else ""
    return f"with '{name}' times {abs(factor):g}{sign} (its unit or sensitivity in the rig file)"


def _scaled(response: FrequencyResponse, rows: Sequence[int], factor: float) -> FrequencyResponse:
    """The response with some of its outputs times a real factor; one input."""
    assert response.covariance is not None
    scale = np.ones(len(response.outputs))
    scale[list(rows)] = factor
    errors = tuple(replace(error, change=error.change * scale[:, None]) for error in response.errors)
    covariance = response.covariance * np.outer(scale, scale)
    return replace(response, matrix=response.matrix * scale[:, None], covariance=covariance, errors=errors)
