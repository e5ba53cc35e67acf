"""Model decay: its settings, and the modes of free decays by maximum likelihood."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy

from labpipe.arrays import FloatArray
from labpipe.errors import FitError, SettingError
from labpipe.estimation.budget import Source, mass_source, with_sources
from labpipe.estimation.diagnostics import MISMATCH_P
from labpipe.estimation.measured import chosen_ports
from labpipe.estimation.settings import FitSettings, ModelKind
from labpipe.estimation.statistics import appraise, correlation, derive, restate, student_limit
from labpipe.methods.ring_down import amplitude_law, likelihood, repeats
from labpipe.records.finding import IntervalParts, Parameter
from labpipe.records.fit_details import OverAmplitude, RingDown
from labpipe.records.identification import Fit, Goodness
from labpipe.records.response import Port
from labpipe.records.settings import Settings, choice, integer
from labpipe.records.spectra import FreeDecays
from labpipe.spectra.settings import DECAYS

MOST_MODES = 8


@dataclass(frozen=True)
class DecaySettings(Settings):
    """What a free decay consists of."""

    modes: int = integer("modes that decay together", 1)
    repeats: str = choice(
        "several decays: each fitted, and their mean; or pool, one fit of all", ("each", "pool"), "each"
    )

    def __post_init__(self) -> None:
        if not 1 <= self.modes <= MOST_MODES:
            raise SettingError("modes", f"'modes' is {self.modes}", f"1 to {MOST_MODES}")


DECAY = ModelKind(
    lambda decays, settings: (decay_fit(decays, settings),),
    "decay",
    DecaySettings,
    "decay: {modes: 1}",
    optional=True,
    of=DECAYS,
    keys=("mass", "output", "repeats", "repeat_groups"),
    estimators=("ml",),
)


DOWN_TO = 0.1


def peak_decrement(samples: FloatArray, rate: float, frequency: float) -> float | None:
    """Slope of the logarithm of the peaks of *samples* (n_sample,) [any unit] per period [1]; None with less
    than three peaks. rate, frequency [Hz]. Equation (decay-peaks).
    """
    period = rate / frequency
    ends = np.rint(np.arange(int(samples.size / period) + 1) * period).astype(int)
    peaks = np.array([np.max(samples[low:high]) for low, high in pairwise(ends)])
    small = np.flatnonzero(peaks <= DOWN_TO * peaks[:1])
    peaks = peaks[: small[0]] if small.size else peaks
    if peaks.size < 3:
        return None
    slope = np.polynomial.polynomial.polyfit(np.arange(peaks.size), np.log(peaks), 1)[1]
    return -float(slope)


MOST_STRETCHES = 700


def trace(time: FloatArray, *series: FloatArray) -> tuple[FloatArray, ...]:
    """Time (n,) [s] and series (n,) [any unit] as the least and largest value of MOST_STRETCHES stretches."""
    if time.size <= 2 * MOST_STRETCHES:
        return (time, *series)
    length = -(-time.size // MOST_STRETCHES)
    whole = time.size // length * length
    middle = time[:whole].reshape(-1, length)[:, [length // 4, (3 * length) // 4]].reshape(-1)
    shown = []
    for values in series:
        parts = values[:whole].reshape(-1, length)
        shown.append(np.stack([parts.min(axis=1), parts.max(axis=1)], axis=1).reshape(-1))
    return (middle, *shown)


def mode_parameters(fitted: likelihood.Decayed, mass: float | None) -> tuple[Parameter, ...]:
    """f_n, zeta and logarithmic decrement of every mode in ascending frequency; with a *mass* [kg] k = m
    w_n^2 and c = 2 zeta w_n m. w_n = |lambda|, zeta = -Re lambda / |lambda|, log decrement = -2 pi Re lambda
    / Im lambda; standard errors of first order. Equation (decay-values).
    """
    parameters: list[Parameter] = []
    for mode, pole in enumerate(fitted.poles):
        block = fitted.covariance[2 * mode : 2 * mode + 2, 2 * mode : 2 * mode + 2]
        turn = 2 * np.pi * np.array([-1 / pole.imag, pole.real / pole.imag**2])
        rows = [*_frequency_and_damping(pole)]
        rows.append(("log_decrement", "1", -2 * np.pi * pole.real / pole.imag, turn))
        if mass is not None:
            towards = np.array([pole.real, pole.imag])
            rows.append(("k", "N/m", mass * abs(pole) ** 2, 2 * mass * towards))
            rows.append(("c", "N.s/m", -2 * mass * pole.real, np.array([-2 * mass, 0.0])))
        for number, (quantity, unit, value, gradient) in enumerate(rows):
            name = repeats.quantity_name(quantity, mode, fitted.poles.size)
            error = float(np.sqrt(max(float(gradient @ block @ gradient), 0.0)))
            parameters.append(
                appraise(name, unit, value, error, fitted.dof, None)
                if number < 2
                else derive(name, unit, float(value), error, fitted.dof)
            )
    return tuple(p if fitted.converged else p.without_interval for p in parameters)


def _frequency_and_damping(pole: complex) -> tuple[tuple[str, str, float, FloatArray], ...]:
    """(name, unit, value, gradient (2,) over Re and Im of the pole)."""
    size = abs(pole)
    towards = np.array([pole.real, pole.imag]) / (2 * np.pi * size)
    turned = np.array([-(pole.imag**2), pole.real * pole.imag]) / size**3
    return ("f_n", "Hz", float(size / (2 * np.pi)), towards), ("zeta", "1", float(-pole.real / size), turned)


def with_course(
    parameters: Sequence[Parameter], curves: Sequence[OverAmplitude], fitted: likelihood.Decayed
) -> tuple[Parameter, ...]:
    """The parameters of the modes with intervals that hold what the stretches of the decays scatter by beyond
    noise, by Student's t of their number; none where the stretches are too few.
    """
    widened = []
    for parameter in parameters:
        name, _, number = parameter.name.rpartition("_")
        if parameter.name in ("k", "c"):
            name, number = parameter.name, "1"
        if name not in repeats.POWERS or not number.isdigit():
            widened.append(parameter)
            continue
        mode = int(number) - 1
        spread = amplitude_law.course_spread(curves[mode], complex(fitted.poles[mode]))
        if spread is None or parameter.ci95 is None or parameter.value <= 0:
            widened.append(parameter.without_interval)
            continue
        of_f, of_zeta = repeats.powers_of(name, -fitted.poles[mode].real / abs(fitted.poles[mode]))
        model = float(np.hypot(of_f * spread[0], of_zeta * spread[1]))
        low, high = parameter.ci95
        half_width = float(np.log(high / low)) / 2 if low > 0 else np.inf
        reach = float(np.hypot(half_width, student_limit(spread[2]) * model))
        value, error = parameter.value, parameter.value * reach / student_limit(fitted.dof)
        parts = parameter.interval or IntervalParts(parameter.std_error or 0.0)
        ends = value * float(np.exp(-reach)), value * float(np.exp(reach))
        parts = replace(parts, discrepancy=value * model)
        widened.append(restate(parameter, value, error, ends, interval=parts))
    return tuple(widened)


def law_parameters(
    fitted: amplitude_law.FittedLaw, mode: int, unit: str, dof: int, spread: FloatArray | None
) -> tuple[Parameter, ...]:
    """Damping ratio at rest, its slope and that of the frequency over the amplitude [unit] of the mode of
    this number from 0; intervals hold the model errors *spread* (3,) of a law that leaves more than noise.
    """
    law, errors = fitted.law, np.sqrt(np.diag(fitted.covariance))[:3]
    per, number, hertz = f"/({unit})" if "/" in unit else f"/{unit}", mode + 1, 1 / (2 * np.pi)
    parameters = []
    for place, (name, of, value, scale) in enumerate(
        (
            ("zeta_rest", "1", law.zeta_rest, 1.0),
            ("zeta_slope", f"1{per}", law.zeta_slope, 1.0),
            ("f_slope", f"Hz{per}", law.frequency_slope, hertz),
        )
    ):
        parameter = derive(f"{name}_{number}", of, value * scale, float(errors[place]) * scale, dof)
        if spread is not None:
            model, noise = float(spread[place]) * scale, float(errors[place]) * scale
            reach = student_limit(dof) * float(np.hypot(model, noise))
            ends = parameter.value - reach, parameter.value + reach
            parts = IntervalParts(noise, discrepancy=model)
            parameter = restate(parameter, parameter.value, reach / student_limit(dof), ends, interval=parts)
        elif law.p_value < MISMATCH_P:
            parameter = parameter.without_interval
        parameters.append(parameter)
    return tuple(parameters)


PER_AMPLITUDE = ("zeta_slope", "f_slope")


def decay_sources(
    parameters: Sequence[Parameter], settings: FitSettings, ports: Mapping[int, Port]
) -> list[Source]:
    """The sources that change *parameters* of decays; *ports*: the sensor that the amplitude of every mode,
    from 0, was read by. An error d of a gain makes all amplitudes A (1 - d), and what is per amplitude 1 / (1
    - d) times as large.
    """
    sources: dict[str, Source] = {}
    for mode, port in ports.items():
        names = [f"{name}_{mode + 1}" for name in PER_AMPLITUDE]
        scaled = np.array([p.value if p.name in names else 0.0 for p in parameters])
        for calibration in port.uncertainties:
            if calibration.effect == "gain":
                gain = calibration.uncertainty
                first, change = sources.get(gain.source, (gain, np.zeros(len(parameters))))
                sources[gain.source] = first, change + gain.std_error * scaled
    return [*mass_source(parameters, settings), *sources.values()]


# Rows for each parameter of the poles below which intervals are not those of a large sample.
FEW_DOF = 30
MORE_LINES = 10.0
# Share of the squares of the residual that a law over the amplitude may leave where it does not leave noise:
# of cubic springs and dry friction it leaves up to a quarter, of four measured beams and bearings up to 0.39,
# of gusts seldom less (0.37 in two of 260 decays in wind).
EXPLAINED = 0.42


@dataclass(frozen=True)
class _FittedDecay:
    decays: FreeDecays
    columns: Sequence[int]
    pieces: tuple[likelihood.Piece, ...]
    fit: likelihood.Decayed

    @cached_property
    def tested(self) -> likelihood.Judged:
        return likelihood.judge(self.pieces, self.fit, self.decays.sample_rate)

    @cached_property
    def strongest(self) -> list[tuple[int, int]]:
        """Piece and output in which each mode stands out of its noise most."""
        places = []
        for mode in range(self.fit.poles.size):
            sizes = [np.abs(solved.amplitudes[mode]) for solved in self.fit.pieces]
            ratios = np.array(sizes) / np.sqrt(self.fit.variance)
            piece, output = np.unravel_index(int(np.argmax(ratios)), ratios.shape)
            places.append((int(piece), int(output)))
        return places

    @property
    def units(self) -> list[str]:
        """Unit of the amplitude of each mode."""
        return [self.decays.units[self.columns[output]] for _, output in self.strongest]

    def course(self, number: int, output: int) -> FloatArray:
        """All modes together (n_sample,) [unit of the output]."""
        course = np.exp(self.pieces[number].time[:, None] * self.fit.poles_of(number))
        return (course @ self.fit.pieces[number].amplitudes[:, output]).real

    def offset(self, number: int, output: int) -> float:
        """Of an output: the mean of what neither the modes nor the residual are."""
        left = self.fit.pieces[number].residual[:, output]
        return float(np.mean(self.pieces[number].rows[:, output] - left - self.course(number, output)))


def decay_fit(decays: FreeDecays, settings: FitSettings) -> Fit:
    """The modes of all decays of a test together as one Fit. ConfigError where settings and decays do not fit
    together, FitError where no decay stands out or it is too short.
    """
    decay_settings: DecaySettings = settings.model_settings
    columns = chosen_ports(decays.outputs, settings.output, "response")
    decays, short = likelihood.long_enough(decays, settings.band)
    pieces = likelihood.pieces_of(decays.decays, columns, decays.sample_rate, settings.band)
    repeated = None
    alone = len(pieces) > 1 and "pool" not in (decay_settings.repeats, settings.repeats)
    _check(settings, alone)
    if alone:
        repeated = repeats.repeated_decays(decays, columns, pieces, settings, decay_settings.modes)
    if repeated is None:
        joined = likelihood.most_likely(
            decays.decays, columns, pieces, decays.sample_rate, settings.band, decay_settings.modes
        )
    else:
        joined, places = repeated.joined, repeated.places
        decays = replace(decays, decays=tuple(decays.decays[place] for place in places))
        pieces = tuple(pieces[place] for place in places)
    check_fitted(pieces, joined)
    fitted, jump = _FittedDecay(decays, columns, pieces, joined), None
    if repeated is None and min(fitted.tested.amplitude, fitted.tested.white) < MISMATCH_P:
        jump = amplitude_law.jump_of(decays, columns, joined, settings.band)
    if jump is not None:
        fitted = _FittedDecay(jump.decays, columns, jump.pieces, jump.fitted)
    laws = _laws(fitted)
    missing = _missing(fitted, laws, settings.band)
    most = EXPLAINED * sum(piece.rows.shape[0] for piece in fitted.pieces)
    explaining = (m for m, law in laws.items() if law.law.p_value >= MISMATCH_P or law.squares < most)
    laws = {} if missing and missing.white else {mode: laws[mode] for mode in explaining}
    amplitudes = {
        mode: float(abs(fitted.fit.pieces[piece].amplitudes[mode, output]))
        for mode, (piece, output) in enumerate(fitted.strongest)
    }
    curves = tuple(
        replace(
            amplitude_law.evaluate_over_amplitude(fitted.pieces, fitted.fit, mode, output),
            law=laws[mode].law if mode in laws else None,
            unit=fitted.units[mode],
        )
        for mode, (_, output) in enumerate(fitted.strongest)
    )
    parameters = _parameters(fitted, settings, laws, repeated)
    findings = amplitude_law.decay_findings(fitted.fit, fitted.tested, laws, amplitudes, missing)
    if fitted.fit.converged and (laws or any(finding.code == "model-mismatch" for finding in findings)):
        parameters = with_course(parameters, curves, fitted.fit)
    fit = _report(fitted, settings, parameters)
    ports = {mode: decays.outputs[columns[output]] for mode, (_, output) in enumerate(fitted.strongest)}
    fit = with_sources(fit, decay_sources(parameters, settings, ports))
    findings = (*(() if jump is None else (jump.finding,)), *findings, *short)
    notes = _notes(fitted)
    if repeated is not None:
        findings = (*findings, *repeated.failed, *repeats.drift_findings(repeated))
        read = [decays.units[columns[output]] for output in repeated.outputs]
        notes = (*repeats.repeat_notes(repeated, read), *notes)
    details = (_ring_down(fitted, curves),)
    return replace(fit, findings=(*findings, *decays.findings), notes=notes, details=details)


def _check(settings: FitSettings, each: bool) -> None:
    if not settings.mass or not isinstance(settings.mass, (float, str)):
        raise SettingError("mass", "a decay takes one mass, above zero", "for example mass: 0.92 kg")
    if settings.repeat_groups and not each:
        what = "'repeat_groups' needs several decays, each of which is fitted alone"
        raise SettingError("repeat_groups", what, "leave it out")


def check_fitted(pieces: Sequence[likelihood.Piece], fitted: likelihood.Decayed) -> None:
    """FitError for few degrees of freedom, and for a mode that noise explains. A free damping finds more than
    the largest line, as if there were MORE_LINES times as many.
    """
    if fitted.dof < FEW_DOF:
        hint = "a longer decay, fewer `modes`, or a wider `band`"
        raise FitError(f"the decays leave {fitted.dof} degrees of freedom", hint=hint)
    weak = MORE_LINES * likelihood.noise_chance(pieces, fitted) > MISMATCH_P
    if np.any(weak):
        where = ", ".join(f"{abs(pole) / (2 * np.pi):.4g} Hz" for pole in fitted.poles[weak])
        hint = "fewer `modes`, another `band`, or stronger hits"
        raise FitError(f"what would be a mode at {where} is noise", hint=hint)


def _laws(fitted: _FittedDecay) -> dict[int, amplitude_law.FittedLaw]:
    if fitted.tested.amplitude >= MISMATCH_P or not fitted.fit.converged:
        return {}
    laws = {
        mode: amplitude_law.fitted_law(fitted.pieces, fitted.fit, mode, output)
        for mode, (_, output) in enumerate(fitted.strongest)
    }
    return {mode: law for mode, law in laws.items() if amplitude_law.depends_on_amplitude(law)}


def _missing(
    fitted: _FittedDecay, laws: dict[int, amplitude_law.FittedLaw], band: tuple[float, float] | None
) -> amplitude_law.MissingMode | None:
    n_mode, decays = fitted.fit.poles.size, fitted.decays
    if not laws or n_mode == MOST_MODES:
        return None
    try:
        richer = likelihood.most_likely(
            decays.decays, fitted.columns, fitted.pieces, decays.sample_rate, band, n_mode + 1
        )
    except FitError:
        return None
    white = likelihood.judge(fitted.pieces, richer, decays.sample_rate).white >= MISMATCH_P
    outputs = [output for _, output in fitted.strongest]
    return amplitude_law.missing_mode(fitted.pieces, fitted.fit, richer, laws, outputs, white=white)


def _parameters(
    fitted: _FittedDecay,
    settings: FitSettings,
    laws: dict[int, amplitude_law.FittedLaw],
    repeated: repeats.RepeatedDecays | None,
) -> tuple[Parameter, ...]:
    mass = settings.mass if isinstance(settings.mass, float) else None
    parameters = mode_parameters(fitted.fit, mass)
    if repeated is not None:
        parameters = repeats.with_repeats(parameters, repeated, fitted.fit.dof, mass)
    for mode, law in laws.items():
        place = mode, fitted.strongest[mode][1]
        of = fitted.decays, fitted.columns, fitted.fit, settings.band
        spread = amplitude_law.law_spread(*of, place, law) if law.law.p_value < MISMATCH_P else None
        parameters += law_parameters(law, mode, fitted.units[mode], fitted.fit.dof, spread)
    return parameters


def _report(fitted: _FittedDecay, settings: FitSettings, parameters: tuple[Parameter, ...]) -> Fit:
    of, pieces = fitted.fit, fitted.pieces
    equations = sum(piece.rows.size for piece in pieces)
    left = _square_sum(solved.residual for solved in of.pieces)
    r2 = 1 - left / _square_sum(piece.free(piece.rows) for piece in pieces)
    adjusted = 1 - (1 - r2) * equations / of.dof
    slopes = scipy.linalg.block_diag(
        *([gradient for *_, gradient in _frequency_and_damping(pole)] for pole in of.poles)
    )
    matrix = correlation(slopes @ of.covariance @ slopes.T)
    low, high = settings.band or (0.0, np.inf)
    return Fit(
        name=settings.name,
        model=settings.model,
        estimator="ml",
        band_hz=(low, min(high, fitted.decays.sample_rate / 2)),
        lines=sum(piece.rows.shape[0] for piece in pieces),
        equations=equations,
        dof=of.dof,
        gof=Goodness(r2, adjusted),
        parameters=parameters,
        condition_number=float(np.sqrt(np.linalg.cond(matrix))),
        correlation=matrix,
        converged=of.converged,
        iterations=of.steps,
    )


def _square_sum(parts: Iterable[FloatArray]) -> float:
    return sum(float(np.sum(part**2)) for part in parts)


def _notes(fitted: _FittedDecay) -> tuple[str, ...]:
    decays, columns, tested = fitted.decays, fitted.columns, fitted.tested
    deviations = np.sqrt(np.mean(fitted.fit.variance, axis=0))
    noise = ", ".join(
        f"{decays.outputs[column].label} {deviation:.3g} {decays.units[column]}"
        for column, deviation in zip(columns, deviations, strict=True)
    )
    notes = [
        f"decay: standard deviation of the residual: {noise}. Chance of such a residual in white noise "
        f"{tested.white:.2g}, of such a dependence on the amplitude: {tested.amplitude:.2g}. Intervals "
        f"(factor {student_limit(fitted.fit.dof):.3g}) hold for white noise."
    ]
    if fitted.fit.poles.size == 1 and fitted.pieces[0].lines is None:
        ((number, output),), (pole,) = fitted.strongest, fitted.fit.poles
        centred = decays.decays[number].samples[:, columns[output]] - fitted.offset(number, output)
        read = peak_decrement(centred, decays.sample_rate, pole.imag / (2 * np.pi))
        if read is not None:
            both = f"{read:.4g} (here {-2 * np.pi * pole.real / pole.imag:.4g})"
            what = f"decay: the peaks alone would give the logarithmic decrement {both}"
            notes.append(f"{what}; noise makes it too small.")
    return tuple(notes)


def _ring_down(fitted: _FittedDecay, curves: tuple[OverAmplitude, ...]) -> RingDown:
    number, output = max(
        fitted.strongest,
        key=lambda place: float(np.max(np.abs(fitted.fit.pieces[place[0]].amplitudes[:, place[1]]))),
    )
    decay, piece, column = fitted.decays.decays[number], fitted.pieces[number], fitted.columns[output]
    samples, modes = decay.samples[:, column], fitted.course(number, output)
    offset = fitted.offset(number, output) if piece.lines is None else np.mean(samples - modes)
    shown = modes + offset
    time, measured, shown, left = trace(piece.time + decay.start, samples, shown, samples - shown)
    label, unit = fitted.decays.outputs[column].label, fitted.decays.units[column]
    return RingDown(decay.recording, label, unit, time, measured, shown, left, curves)
