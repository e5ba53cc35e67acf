"""The figures of fits and of measured responses, single curves and matrices of many elements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.quantities import QUANTITIES, display_unit, to_display
from labpipe.records.finding import Parameter
from labpipe.records.fit_details import Modes
from labpipe.records.identification import Fit, FittedCurve
from labpipe.records.response import FrequencyResponse
from labpipe.records.rig import Geometry
from labpipe.report import chart
from labpipe.report.document import Figure
from labpipe.report.wording import fit_title, meaning, unit_text

FREQUENCY = chart.Axis("frequency", "Hz")
CENTRE = chart.Axis("centre of the band", "Hz")
PHASE = chart.Axis("phase", "deg")
# Least signal-to-noise ratio that a logarithmic axis shows.
LEAST_SNR = 1e-3
LEAST_SIDE = 2.2
# Elements of an FRF matrix that have a curve each.
MOST_CURVES = 24
HIGHEST_COHERENCE = 1.02
PARTIAL = "the partial coherence of each response and force, the other forces removed"


def form_unit(form: str) -> tuple[str, float]:
    """(unit people read, factor from SI) of an FRF form, or of one quantity per another."""
    effect, _, cause = form.partition(" per ")
    quantity = QUANTITIES.get(effect)
    if quantity is None:
        return "SI", 1.0
    per = f"/{QUANTITIES[cause].si_unit}" if cause else ""
    return quantity.display_unit + per, to_display(1.0, quantity.display_unit)


def scale_of(si_unit: str) -> float:
    """What an SI value is multiplied with to be in the unit people read."""
    return to_display(1.0, display_unit(si_unit))


def over_frequency(
    y: chart.Axis, series: Sequence[chart.Series], share: float = 1.0, title: str = ""
) -> chart.Panel:
    return chart.Panel(FREQUENCY, y, tuple(series), title, share=share)


def form_axis(form: str) -> chart.Axis:
    """The amplitude of an FRF form on a logarithmic axis."""
    return chart.Axis(form, form_unit(form)[0], logarithmic=True)


def phase_degrees(values: ComplexArray) -> FloatArray:
    """Phase (n,) [deg] of complex values (n,)."""
    return np.degrees(np.angle(values))


def fitted_curve_figure(fit: Fit, fitted: FittedCurve) -> Figure:
    """Amplitude, phase and residual of measured against fitted FRF, with the 95 % band of noise."""
    pairs = list(np.ndindex(fitted.measured.shape[1:]))
    amplitude: list[chart.Series] = []
    phase: list[chart.Series] = []
    residual: list[chart.Series] = []
    factor, (lines, values) = form_unit(fitted.form)[1], fitted.drawn
    for number, (o, i) in enumerate(pairs):
        colour, label = number % chart.PALETTE_SIZE, f"{fitted.outputs[o]}/{fitted.inputs[i]}"
        # With several elements dots and line of one share an entry of the legend; the caption says which is
        # which.
        entry = label if len(pairs) > 1 else ""
        pair = (
            (f"{label} measured", fitted.frequency, fitted.measured[:, o, i], "", "."),
            (f"{label} fitted", lines, values[:, o, i], "-", ""),
        )
        for name, x, h, line, marker in pair:
            for series, y in ((amplitude, factor * np.abs(h)), (phase, phase_degrees(h))):
                series.append(chart.curve(name, x, y, colour, line, width=1.5, marker=marker, entry=entry))
        if np.all(fitted.fitted[:, o, i]):
            # Nothing is relative to an element that the model takes for zero.
            residual.append(_residual(fitted, o, i, f"{label} measured", colour, entry))
    panels = (
        over_frequency(form_axis(fitted.form), amplitude, 3.0),
        over_frequency(PHASE, phase, 2.0),
        over_frequency(chart.Axis("|residual| / |H|", "%"), residual, 3.0),
    )
    caption = f"{fit_title(fit)}: measured (dots) and fitted (lines) {fitted.form}, and the residual"
    if fitted.variance is not None:
        caption += "; shaded: 95 % of residuals lie below when only the measured noise is left"
    alternative = f"Amplitude, phase and residual of fit {fit_title(fit)} over frequency"
    return Figure(chart.stack(panels, 5.6), f"{caption}.", alternative)


def _residual(fitted: FittedCurve, o: int, i: int, name: str, colour: int, entry: str) -> chart.Series:
    """Residual relative to the fitted FRF [%].

    |e|^2 / var is exponential, so 95 % lie below sqrt(ln 20 var).
    """
    size = np.abs(fitted.fitted[:, o, i])
    values = 100 * np.abs(fitted.measured[:, o, i] - fitted.fitted[:, o, i]) / size
    band = None
    if fitted.variance is not None:
        band = np.zeros_like(size), 100 * np.sqrt(np.log(20.0) * fitted.variance[:, o, i]) / size
    return chart.dots(name, fitted.frequency, values, colour, band=band, entry=entry)


def correlation_figure(fit: Fit) -> Figure:
    """Heat map of the correlation between the estimated parameters."""
    names = [parameter.name for parameter in fit.estimated][: len(fit.correlation)]
    texts = [[f"{value:.2f}" for value in row] for row in fit.correlation.tolist()]
    side = max(LEAST_SIDE, 0.42 * len(names) + 1.2)
    axis = chart.Axis(ticks=chart.named_ticks(names))
    panel = chart.Panel(axis, axis, (chart.cells(fit.correlation, texts),))
    graphic = chart.Chart((panel,), size=(side + 0.9, side))
    caption = (
        f"{fit_title(fit)}: correlation between the estimates. Near +1 or -1 only one combination of "
        "two parameters is determined."
    )
    return Figure(graphic, caption, f"Correlation matrix of fit {fit_title(fit)}")


def sliding_units(fits: Sequence[Fit]) -> dict[str, str]:
    """The units of the coefficients of sliding fits that have a meaning, of which bands may lack some."""
    every = (parameter for fit in fits for parameter in fit.estimated)
    return {parameter.name: parameter.unit for parameter in every if meaning(parameter)}


def per_band(fits: Sequence[Fit], name: str) -> list[Parameter | None]:
    """The coefficient in every band; None where it was eliminated."""
    return [next((p for p in fit.parameters if p.name == name), None) for fit in fits]


def sliding_figures(fits: Sequence[Fit]) -> list[Figure]:
    """Every coefficient over the centre of its band with its 95 % interval, then G.o.F over frequency."""
    every = (p for fit in fits for p in fit.parameters if p.name in sliding_units(fits))
    groups: dict[str, dict[str, str]] = {}
    for parameter in every:
        groups.setdefault(meaning(parameter), {})[parameter.name] = parameter.unit
    return [*(_coefficient_figure(fits, *group) for group in groups.items()), _goodness_figure(fits)]


def sliding_curve(
    fits: Sequence[Fit], parameter: str, label: str, number: int, opacity: float
) -> chart.Series:
    """A coefficient over the centres of its bands [Hz] in the unit people read, shaded: 95 % intervals."""
    factor, nothing = scale_of(sliding_units(fits)[parameter]), (np.nan, np.nan)
    amounts = per_band(fits, parameter)
    values = factor * np.array([np.nan if amount is None else amount.value for amount in amounts])
    ends = factor * np.array([nothing if amount is None else amount.ci95 or nothing for amount in amounts])
    centres, (colour, line) = [fit.centre_hz for fit in fits], chart.look(number)
    return chart.curve(
        label, centres, values, colour, line, marker=".", band=(ends[:, 0], ends[:, 1]), opacity=opacity
    )


def _coefficient_figure(fits: Sequence[Fit], what: str, units: Mapping[str, str]) -> Figure:
    series = [sliding_curve(fits, name, name, number, 0.2) for number, name in enumerate(units)]
    name, unit = next(iter(units.items()))
    y = chart.Axis(name.partition("_")[0], unit_text(unit))
    caption = f"{fit_title(fits[0])}: {what} over frequency, {len(fits)} bands; shaded: 95 % interval."
    alternative = f"{what} of {fit_title(fits[0])} over frequency with 95 % interval"
    return Figure(chart.stack([chart.Panel(CENTRE, y, tuple(series))], 3.2), caption, alternative)


def _goodness_figure(fits: Sequence[Fit]) -> Figure:
    centres = [fit.centre_hz for fit in fits]
    goodness = chart.curve("G.o.F (adj. R²)", centres, [fit.gof.r2_adjusted for fit in fits], marker=".")
    reduced = [np.nan if fit.gof.chi2_reduced is None else fit.gof.chi2_reduced for fit in fits]
    chi2 = chart.curve("chi² per dof", centres, reduced, 1, marker=".")
    panels = (
        chart.Panel(CENTRE, chart.Axis("G.o.F (adj. R²)"), (goodness,)),
        chart.Panel(CENTRE, chart.Axis("chi² per dof"), (chi2, chart.level(1.0))),
    )
    caption = (
        f"{fit_title(fits[0])}: goodness of fit per band. A high G.o.F does not prove the coefficients; "
        "chi² per dof near 1 says that the model leaves nothing but the measured noise."
    )
    alternative = f"Goodness of fit of {fit_title(fits[0])} over frequency"
    return Figure(chart.stack(panels, 3.6, "none"), caption, alternative)


def element_names(response: FrequencyResponse) -> list[tuple[int, int, str]]:
    """(row, column, 'output/input') of every element of an FRF matrix."""
    outputs, inputs = enumerate(response.outputs), list(enumerate(response.inputs))
    return [(o, i, f"{output.label}/{port.label}") for o, output in outputs for i, port in inputs]


def response_figure(response: FrequencyResponse) -> Figure:
    """The measured FRF with its coherence, or signal-to-noise ratio per channel."""
    name, factor = response.name or "the measurement", form_unit(response.form)[1]
    amplitude = _elements(response, factor * np.abs(response.matrix))
    quality, what = _quality(response)
    shown = over_frequency(form_axis(response.form), amplitude, 3.0)
    graphic = chart.stack([shown], 2.4) if quality is None else chart.stack([shown, quality], 3.4)
    subject = f"Measured {response.form} of {name}"
    return Figure(graphic, f"{subject}, and {what}.", f"{subject} and {what}")


def _elements(response: FrequencyResponse, values: FloatArray) -> list[chart.Series]:
    if values[0].size > MOST_CURVES:
        flat, n = values.reshape(values.shape[0], -1), values[0].size
        named = [
            (f"largest of {n}", flat.max(axis=1)),
            (f"median of {n}", np.median(flat, axis=1)),
            (f"least of {n}", flat.min(axis=1)),
        ]
    else:
        named = [(name, values[:, o, i]) for o, i, name in element_names(response)]
    return [
        chart.curve(name, response.frequency, y, *chart.look(number))
        for number, (name, y) in enumerate(named)
    ]


def _quality(response: FrequencyResponse) -> tuple[chart.Panel | None, str]:
    for title, coherence, what in (
        ("partial coherence", response.partial_coherence, PARTIAL),
        ("coherence", response.coherence, "its coherence"),
    ):
        if coherence is not None:
            axis = chart.Axis(title, low=0.0, high=HIGHEST_COHERENCE)
            return over_frequency(axis, _elements(response, coherence), 2.0), what
    if response.snr is not None:
        ratio = np.maximum(response.snr, LEAST_SNR)
        series = [
            chart.curve(channel, response.frequency, ratio[:, n], *chart.look(n))
            for n, channel in enumerate(response.snr_channels)
        ]
        axis = chart.Axis("signal / noise", logarithmic=True)
        return over_frequency(axis, series, 2.0), "the signal-to-noise ratio of its channels"
    if response.variance is not None:
        relative = np.sqrt(response.variance) / np.abs(response.matrix)
        axis = chart.Axis("std / |H|", logarithmic=True)
        return over_frequency(axis, _elements(response, relative), 2.0), "its relative standard deviation"
    return None, "its uncertainty is not known"


def line_figure(fits: Sequence[Fit]) -> Figure:
    """Slopes of a calibration over its groups with their 95 % intervals."""
    slopes = [fit.parameter("slope") for fit in fits]
    values = np.array([slope.value for slope in slopes])
    ends = np.array([slope.ci95 or (slope.value, slope.value) for slope in slopes]).T
    series = chart.dots("slope", np.arange(len(fits)), values, marker="o", size=6.0, bars=(ends[0], ends[1]))
    x = chart.Axis(ticks=chart.named_ticks([fit.test or fit.name for fit in fits]))
    y = chart.Axis("slope", slopes[0].unit, low=0.0 if values.min() > 0 else None)
    graphic = chart.stack([chart.Panel(x, y, (series,))], 3.0, "none")
    caption = f"{fits[0].name}: slope of each line with its 95 % interval."
    return Figure(graphic, caption, f"Slopes of calibration {fits[0].name}")


def tuning_figure(fit: Fit, fitted: FittedCurve) -> Figure:
    """Measured amplitude of every term with the model before and after its tuning."""
    panels = [_before_and_after(fitted, o, i) for o, i in np.ndindex(fitted.measured.shape[1:])]
    caption = (
        f"{fit_title(fit)}: measured {fitted.form}, and the model before and after its tuning, one "
        "panel per term."
    )
    alternative = f"Measured {fitted.form} and the model before and after tuning {fit_title(fit)}"
    return Figure(chart.stack(panels, 0.8 + 1.6 * len(panels)), caption, alternative)


def _before_and_after(fitted: FittedCurve, o: int, i: int) -> chart.Panel:
    assert fitted.before is not None
    unit, factor = form_unit(fitted.form)
    lines, after = fitted.drawn
    measured, before, tuned = (
        factor * np.abs(values[:, o, i]) for values in (fitted.measured, fitted.before, after)
    )
    series = (
        chart.dots("measured", fitted.frequency, measured, chart.GREY),
        chart.curve("before tuning", fitted.frequency, before, 1, "--", width=1.5),
        chart.curve("after tuning", lines, tuned, width=1.5),
    )
    axis = chart.Axis(f"{fitted.outputs[o]}/{fitted.inputs[i]} {fitted.form}", unit, logarithmic=True)
    return chart.Panel(FREQUENCY, axis, series)


# A fitted FRF matrix of many elements: one small panel per element in matrix order, or of very many the sum
# and the worst.

# Largest number of elements in one pair of axes.
MOST_TOGETHER = 4
# Largest number of elements that are all shown; of more the mean over all, and the WORST in this many
# columns.
MOST_SHOWN, WORST, COLUMNS = 24, 12, 3
# Part of the amplitude at which a band ends that would reach below zero, for which a logarithmic axis has no
# place.
LEAST_SHARE = 0.05


def matrix_figures(fit: Fit, fitted: FittedCurve) -> list[Figure]:
    """Every element, or of very many their root mean square and those that are met worst."""
    many = len(fitted.outputs) * len(fitted.inputs) > MOST_SHOWN
    return [mean_figure(fit, fitted), worst_figure(fit, fitted)] if many else [matrix_figure(fit, fitted)]


def mean_figure(fit: Fit, fitted: FittedCurve) -> Figure:
    """Root mean square over all elements: measured, fitted, residual, and the noise where it is known."""
    factor, lines = form_unit(fitted.form)[1], fitted.frequency
    series = [
        chart.dots("measured", lines, factor * _mean_size(fitted.measured), 0, size=1.5),
        chart.curve("fitted", fitted.drawn[0], factor * _mean_size(fitted.drawn[1]), 1),
        chart.dots("residual", lines, factor * _mean_size(fitted.measured - fitted.fitted), 2, size=1.5),
    ]
    if fitted.variance is not None:
        noise = factor * np.sqrt(np.mean(fitted.variance, axis=(1, 2)))
        series.append(chart.curve("noise", lines, noise, 3, "--"))
    number = len(fitted.outputs) * len(fitted.inputs)
    what = f"{fitted.form}, root mean square over all {number} elements"
    caption = f"{fit_title(fit)}: {what}: measured, fitted, and what is left between them."
    graphic = chart.stack([over_frequency(form_axis(fitted.form), series)], 3.6)
    return Figure(graphic, caption, _over_matrix("Root mean square", fit) + ", with the residual")


def _over_matrix(what: str, fit: Fit) -> str:
    return f"{what} of the FRF matrix of fit {fit_title(fit)} over frequency"


def _mean_size(values: ComplexArray) -> FloatArray:
    """Root mean square (n_line,) over the elements of (n_line, n_output, n_input)."""
    return np.sqrt(np.mean(np.abs(values) ** 2, axis=(1, 2)))


def worst_figure(fit: Fit, fitted: FittedCurve) -> Figure:
    """The elements with the largest residual in relation to their size, the worst first."""
    residual = np.sum(np.abs(fitted.measured - fitted.fitted) ** 2, axis=0)
    left = residual / np.sum(np.abs(fitted.measured) ** 2, axis=0)
    worst = np.argsort(-left, axis=None)[:WORST]
    panels = tuple(_element(fitted, *divmod(int(place), left.shape[1])) for place in worst)
    graphic = chart.Chart(
        panels, WORST // COLUMNS, COLUMNS, (chart.WIDTH, 0.6 + 1.7 * (WORST // COLUMNS)), "x", "above"
    )
    caption = (
        f"{fit_title(fit)}: the {WORST} of {left.size} elements that the fit meets worst in relation to "
        f"their size (residual {100 * np.sqrt(left.flat[worst[0]]):.2g} to "
        f"{100 * np.sqrt(left.flat[worst[-1]]):.2g} %), response/force; the rest meets better."
    )
    return Figure(graphic, caption, _over_matrix(f"Amplitude of the {WORST} worst elements", fit))


def matrix_figure(fit: Fit, fitted: FittedCurve) -> Figure:
    """Amplitude of every element, measured with two standard deviations (dots, shaded) and fitted (line)."""
    rows, columns = len(fitted.outputs), len(fitted.inputs)
    panels = tuple(_element(fitted, o, i) for o, i in np.ndindex(rows, columns))
    if min(rows, columns) == 1:
        # One row or column of a matrix, as of a roving test.
        columns = min(COLUMNS, len(panels))
        rows = -(-len(panels) // columns)
    graphic = chart.Chart(panels, rows, columns, (chart.WIDTH, 0.6 + 1.4 * rows), "xy", "above")
    shaded = "" if fitted.variance is None else "; shaded: two standard deviations"
    caption = f"{fit_title(fit)}: measured (dots{shaded}) and fitted (lines) {fitted.form}, response/force."
    return Figure(graphic, caption, _over_matrix("Amplitude of every element", fit))


def _element(fitted: FittedCurve, o: int, i: int) -> chart.Panel:
    factor = form_unit(fitted.form)[1]
    size, band = factor * np.abs(fitted.measured[:, o, i]), None
    if fitted.variance is not None:
        # Half of the variance of the complex value lies along it.
        spread = 2 * factor * np.sqrt(fitted.variance[:, o, i] / 2)
        band = np.maximum(size - spread, LEAST_SHARE * size), size + spread
    lines, values = fitted.drawn
    measured = chart.dots("measured", fitted.frequency, size, 0, size=1.5, band=band)
    model = chart.curve("fitted", lines, factor * np.abs(values[:, o, i]), 1)
    title = f"{fitted.outputs[o]}/{fitted.inputs[i]}"
    return over_frequency(form_axis(fitted.form), (measured, model), title=title)


def repeats_figure(fit: Fit, parameters: Sequence[Parameter]) -> Figure:
    """Every repeat that the values of *parameters* are the means of, with the mean and its interval."""
    panels, used, recorded, groups = [], 0, 0, 0
    for parameter in parameters:
        repeats, factor = parameter.repeats, scale_of(parameter.unit)
        assert repeats is not None
        used, recorded, groups = repeats.used, repeats.n, repeats.groups
        values = factor * np.array(repeats.values)
        series = [
            chart.dots("repeats", np.arange(1, values.size + 1), values, marker="o"),
            chart.level(factor * parameter.value),
        ]
        if parameter.ci95 is not None:
            series.append(chart.span(factor * parameter.ci95[0], factor * parameter.ci95[1], chart.GREY))
        y = chart.Axis(parameter.name, unit_text(parameter.unit))
        panels.append(chart.Panel(chart.Axis("repeat"), y, tuple(series)))
    left_out = f", of {recorded} (the notes name the others)" if used < recorded else ""
    if groups:
        left_out += f", in {groups} groups"
    caption = (
        f"{fit_title(fit)}: {used} repeats whose means the values are{left_out}. Line and shade: mean "
        "and 95 % interval."
    )
    columns = min(len(panels), 2)
    rows = -(-len(panels) // columns)
    graphic = chart.Chart(tuple(panels), rows, columns, (chart.WIDTH, 2.2 * rows), "x", "none")
    return Figure(graphic, caption, f"Repeats of {fit_title(fit)}")


KIND = "mode-shapes"
# Modes of one drawing, one row each.
AT_ONCE = 4
ROW_HEIGHT = 1.75
# The largest motion is drawn as this share of the structure's size.
REACH = 0.15
# Views of the drawing: name, azimuth and elevation [rad] of the eye.
VIEWS = (("oblique", -0.9, 0.5), ("front (x, z)", 0.0, 0.0), ("top (x, y)", 0.0, np.pi / 2))


@dataclass(frozen=True, eq=False)
class ShapeSketch:
    """names and lines (n_line, 2) of the points, positions (n_point, 3) [1] about their middle, the structure
    1 in size.

    titles of the modes; motion (n_mode, n_point, 3) [1], complex, the largest of each REACH.
    """

    names: tuple[str, ...]
    positions: FloatArray
    lines: IntArray
    titles: tuple[str, ...]
    motion: ComplexArray

    def extremes(self, mode: int) -> tuple[FloatArray, FloatArray]:
        """The points (n_point, 3) [1] at the two turns of a mode.

        A complex shape turns where its points together move farthest.
        """
        moved = self.motion[mode]
        turned = (moved * np.exp(-0.5j * np.angle(np.sum(moved**2)))).real
        return self.positions + turned, self.positions - turned


def project(points: FloatArray, azimuth: float, elevation: float) -> FloatArray:
    """*points* (n_point, 3) as an eye sees them that is turned by *azimuth* about z and raised by *elevation*
    [rad], (n_point, 2) [1].
    """
    x, y, z = points.T
    across = np.cos(azimuth) * x + np.sin(azimuth) * y
    away = np.cos(azimuth) * y - np.sin(azimuth) * x
    return np.stack([across, np.cos(elevation) * z + np.sin(elevation) * away], axis=-1)


def shape_figures(title: str, modes: Modes) -> list[Figure]:
    """The shapes on the structure, a few modes in each figure of the fit *title*; none without a geometry."""
    if modes.geometry is None:
        return []
    n_mode = modes.frequency.size
    groups = (range(first, min(first + AT_ONCE, n_mode)) for first in range(0, n_mode, AT_ONCE))
    return [_figure(title, _sketch(modes, modes.geometry, group)) for group in groups]


def _sketch(modes: Modes, geometry: Geometry, chosen: range) -> ShapeSketch:
    middle = (geometry.positions.max(axis=0) + geometry.positions.min(axis=0)) / 2
    size = float(np.max(np.ptp(geometry.positions, axis=0))) or 1.0
    motion = geometry.motion(modes.dofs, modes.shapes)[list(chosen)]
    largest = np.max(np.linalg.norm(motion, axis=-1), axis=-1)
    titles = tuple(
        f"{n + 1}: {modes.frequency[n]:.4g} Hz, {100 * modes.damping_ratio[n]:.3g} %" for n in chosen
    )
    positions, motion = (geometry.positions - middle) / size, REACH * motion / largest[:, None, None]
    return ShapeSketch(geometry.names, positions, geometry.lines, titles, motion)


def _figure(title: str, sketch: ShapeSketch) -> Figure:
    caption = (
        f"{title}: mode shapes on the structure at their two turns, grey at rest; natural frequency and "
        "damping ratio above. Points without a measured dof stand still."
    )
    drawing = chart.Drawing(KIND, sketch, (chart.WIDTH, ROW_HEIGHT * len(sketch.titles)))
    alternative = f"Mode shapes of fit {title} on the structure: {'; '.join(sketch.titles)}"
    return Figure(drawing, caption, alternative)
