"""Model decay: the modes of free decays by maximum likelihood, judged by what they leave."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.decay.amplitude_law import FittedLaw, fitted_law
from labpipe.decay.budget import decay_sources
from labpipe.decay.findings import decay_findings, depends_on_amplitude
from labpipe.decay.likelihood import Decayed, energies
from labpipe.decay.missing_mode import MissingMode, missing_mode
from labpipe.decay.over_amplitude import over_amplitude
from labpipe.decay.peaks import peak_decrement
from labpipe.decay.pieces import Piece, pieces_of
from labpipe.decay.residual_test import Judged, judged
from labpipe.decay.settings import MOST_MODES, DecaySettings
from labpipe.decay.start import most_likely
from labpipe.decay.traces import trace
from labpipe.decay.values import law_parameters, mode_parameters, pole_correlation, without_interval
from labpipe.errors import ConfigError, FitError
from labpipe.identify.budget import with_sources
from labpipe.identify.diagnostics import MISMATCH_P
from labpipe.identify.measured import chosen_ports
from labpipe.identify.settings import FitSettings
from labpipe.identify.statistics import student_limit
from labpipe.records.free_decay import FreeDecays
from labpipe.records.identification import Fit, Goodness, Parameter
from labpipe.records.ring_down import OverAmplitude, RingDown

# Rows for each parameter of the poles below which intervals are not those of a large sample.
FEW_DOF = 30
MORE_LINES = 10.0


def decay_fit(decays: FreeDecays, settings: FitSettings) -> Fit:
    """The modes of all decays of a test together as one Fit.

    ConfigError where settings and decays do not fit together, FitError where no decay stands out or it is too short.
    """
    decay_settings: DecaySettings = settings.model_settings
    _check(settings)
    columns = chosen_ports(decays.outputs, settings.output, "response")
    pieces = pieces_of(decays.decays, columns, decays.sample_rate, settings.band)
    fitted = most_likely(decays.decays, columns, pieces, decays.sample_rate, settings.band, decay_settings.modes)
    _check_fitted(pieces, fitted)
    tested = judged(pieces, fitted, decays.sample_rate)
    strongest = {mode: _strongest(fitted, mode) for mode in range(decay_settings.modes)}
    laws = _laws(pieces, fitted, tested, strongest)
    missing = _missing(decays, columns, pieces, fitted, laws, strongest, settings)
    laws = {} if missing and missing.white else laws
    amplitudes = {mode: float(abs(fitted.pieces[piece].amplitudes[mode, output])) for mode, (piece, output) in strongest.items()}
    curves = tuple(
        replace(over_amplitude(pieces, fitted, mode, output), law=laws[mode].law if mode in laws else None)
        for mode, (_, output) in strongest.items()
    )
    parameters = _parameters(fitted, settings, laws, [decays.units[columns[o]] for _, o in strongest.values()])
    findings = decay_findings(fitted, tested, laws, amplitudes, missing)
    if any(finding.code == "model-mismatch" for finding in findings):
        parameters = tuple(map(without_interval, parameters))
    fit = _reported(decays, settings, pieces, fitted, parameters)
    ports = {mode: decays.outputs[columns[output]] for mode, (_, output) in strongest.items()}
    fit = with_sources(fit, decay_sources(parameters, settings, ports))
    return replace(
        fit,
        findings=(*findings, *decays.findings),
        notes=_notes(decays, columns, pieces, fitted, tested),
        ring_down=_ring_down(decays, columns, pieces, fitted, strongest, curves),
    )


def _check(settings: FitSettings) -> None:
    """ConfigError for more than one mass."""
    if not isinstance(settings.mass, (float, str)):
        raise ConfigError("a decay takes one mass", hint="for example mass: 0.92 kg", field="mass")


def _check_fitted(pieces: Sequence[Piece], fitted: Decayed) -> None:
    """FitError for few degrees of freedom, and for a mode that noise explains.

    The largest of n lines of noise has chi-square 2 ln(n / p) with the chance p; a free damping finds more, as if there were MORE_LINES
    times as many.
    """
    if fitted.dof < FEW_DOF:
        raise FitError(f"the decays leave {fitted.dof} degrees of freedom", hint="a longer decay, fewer `modes`, or a wider `band`")
    rows = sum(piece.rows.size for piece in pieces)
    weak = energies(pieces, fitted) < 2 * np.log(MORE_LINES * rows / MISMATCH_P)
    if np.any(weak):
        where = ", ".join(f"{abs(pole) / (2 * np.pi):.4g} Hz" for pole in fitted.poles[weak])
        raise FitError(f"what would be a mode at {where} is noise", hint="fewer `modes`, another `band`, or stronger hits")


def _strongest(fitted: Decayed, mode: int) -> tuple[int, int]:
    """(piece, output) in which a mode is largest against the noise."""
    ratios = [np.abs(solved.amplitudes[mode]) / np.sqrt(fitted.variance[number]) for number, solved in enumerate(fitted.pieces)]
    piece, output = np.unravel_index(int(np.argmax(ratios)), np.shape(ratios))
    return int(piece), int(output)


def _laws(pieces: Sequence[Piece], fitted: Decayed, tested: Judged, strongest: dict[int, tuple[int, int]]) -> dict[int, FittedLaw]:
    """The laws of modes whose damping or frequency depends on the amplitude; none where the residual does not show it."""
    if tested.amplitude >= MISMATCH_P or not fitted.converged:
        return {}
    laws = {mode: fitted_law(pieces, fitted, mode, output) for mode, (_, output) in strongest.items()}
    return {mode: law for mode, law in laws.items() if depends_on_amplitude(law)}


def _missing(
    decays: FreeDecays,
    columns: Sequence[int],
    pieces: Sequence[Piece],
    fitted: Decayed,
    laws: dict[int, FittedLaw],
    strongest: dict[int, tuple[int, int]],
    settings: FitSettings,
) -> MissingMode | None:
    """One mode more, where it explains better than the *laws* what the fit leaves; None without laws."""
    if not laws or fitted.poles.size == MOST_MODES:
        return None
    try:
        richer = most_likely(decays.decays, columns, pieces, decays.sample_rate, settings.band, fitted.poles.size + 1)
    except FitError:
        return None
    white = judged(pieces, richer, decays.sample_rate).white >= MISMATCH_P
    return missing_mode(pieces, fitted, richer, laws, strongest, white=white)


def _parameters(fitted: Decayed, settings: FitSettings, laws: dict[int, FittedLaw], units: Sequence[str]) -> tuple[Parameter, ...]:
    """Parameters of all modes; where a mode depends on its amplitude its means have no interval, and the law's follow."""
    mass = settings.mass if isinstance(settings.mass, float) else None
    parameters = mode_parameters(fitted, mass)
    means = {f"{name}_{mode + 1}" for mode in laws for name in ("f_n", "zeta", "log_decrement", "k", "c")}
    if laws and fitted.poles.size == 1:
        means |= {"k", "c"}
    plain = [without_interval(parameter) if parameter.name in means else parameter for parameter in parameters]
    return (*plain, *(parameter for mode, law in laws.items() for parameter in law_parameters(law, mode, units[mode], fitted.dof)))


def _reported(
    decays: FreeDecays, settings: FitSettings, pieces: Sequence[Piece], fitted: Decayed, parameters: tuple[Parameter, ...]
) -> Fit:
    equations = sum(piece.rows.size for piece in pieces)
    r2 = 1 - _square_sum(solved.residual for solved in fitted.pieces) / _square_sum(_free_of_nuisance(piece) for piece in pieces)
    adjusted = 1 - (1 - r2) * equations / fitted.dof
    matrix = pole_correlation(fitted)
    return Fit(
        name=settings.name,
        model=settings.model,
        estimator="ml",
        band_hz=settings.band or (0.0, decays.sample_rate / 2),
        lines=sum(piece.rows.shape[0] for piece in pieces),
        equations=equations,
        dof=fitted.dof,
        gof=Goodness(r2, adjusted),
        parameters=parameters,
        condition_number=float(np.sqrt(np.linalg.cond(matrix))),
        correlation=matrix,
        converged=fitted.converged,
        iterations=fitted.steps,
    )


def _square_sum(parts: Iterable[FloatArray]) -> float:
    return sum(float(np.sum(part**2)) for part in parts)


def _free_of_nuisance(piece: Piece) -> FloatArray:
    range_ = np.linalg.qr(piece.nuisance)[0]
    return np.asarray(piece.rows - range_ @ (range_.T @ piece.rows))


def _notes(decays: FreeDecays, columns: Sequence[int], pieces: Sequence[Piece], fitted: Decayed, tested: Judged) -> tuple[str, ...]:
    """Size of the noise, the tests of the residual, and the decrement that peaks would give."""
    noise = ", ".join(
        f"{decays.outputs[column].label} {np.sqrt(np.mean(fitted.variance[:, number])):.3g} {decays.units[column]}"
        for number, column in enumerate(columns)
    )
    notes = [
        f"decay: standard deviation of the residual: {noise}. Chance of such a residual in white noise {tested.white:.2g}, of such a "
        f"dependence on the amplitude: {tested.amplitude:.2g}. Intervals (factor {student_limit(fitted.dof):.3g}) hold for white noise."
    ]
    if fitted.poles.size == 1 and pieces[0].lines is None:
        number, output = _strongest(fitted, 0)
        pole, samples = fitted.poles[0], decays.decays[number].samples[:, columns[output]]
        centred = samples - _offset(pieces[number], fitted, number, output)
        read = peak_decrement(centred, decays.sample_rate, pole.imag / (2 * np.pi))
        if read is not None:
            by_fit = -2 * np.pi * pole.real / pole.imag
            notes.append(
                f"decay: the peaks alone would give the logarithmic decrement {read:.4g} (here {by_fit:.4g}); noise makes it too small."
            )
    return tuple(notes)


def _offset(piece: Piece, fitted: Decayed, number: int, output: int) -> float:
    """The fitted offset of an output: the mean of what neither the modes nor the residual are."""
    solved = fitted.pieces[number]
    modes = (np.exp(piece.time[:, None] * fitted.poles) @ solved.amplitudes[:, output]).real
    return float(np.mean(piece.rows[:, output] - solved.residual[:, output] - modes))


def _ring_down(
    decays: FreeDecays,
    columns: Sequence[int],
    pieces: Sequence[Piece],
    fitted: Decayed,
    strongest: dict[int, tuple[int, int]],
    curves: tuple[OverAmplitude, ...],
) -> RingDown:
    """The decay in which the strongest mode is largest, thinned for drawing."""
    number, output = max(strongest.values(), key=lambda place: float(np.max(np.abs(fitted.pieces[place[0]].amplitudes[:, place[1]]))))
    decay, piece = decays.decays[number], pieces[number]
    samples = decay.samples[:, columns[output]]
    modes = (np.exp(piece.time[:, None] * fitted.poles) @ fitted.pieces[number].amplitudes[:, output]).real
    offset = float(np.mean(samples - modes)) if piece.lines is not None else _offset(piece, fitted, number, output)
    time, measured, shown, left = trace(piece.time + decay.start, samples, modes + offset, samples - modes - offset)
    return RingDown(
        decay.recording, decays.outputs[columns[output]].label, decays.units[columns[output]], time, measured, shown, left, curves
    )
