"""Calibration, uncertainty and scatter: the guide's printed readings, NIST's certified values, descents to a
known minimum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from labpipe.distributions import student_quantile
from labpipe.estimation.derived import Estimated, propagate
from labpipe.estimation.descent import minimise, sum_of_squares
from labpipe.estimation.draws import drawn_error
from labpipe.methods.calibration.section import fit_line
from labpipe.records.uncertain import Budget, Uncertainty
from labpipe.uncertainty.decisions import Limits, conformance, global_risk
from labpipe.uncertainty.weighted import components
from tests.validation import printed_readings as readings
from tests.validation.claims import Claim, Method, within, worst
from tests.validation.gaps import gaps

MEASUREMENT = "printed measurement"
LENGTH, DIFFERENCE, EXPANSION, TEMPERATURE = 50.000623e-3, 215e-9, 11.5e-6, -0.1
# As printed in table H.1; from their unrounded half widths (1e-6 / K, 0.05 K) the expanded uncertainty would
# be 92.5 nm.
UNCERTAINTIES = {
    "standard": Uncertainty("standard", 25e-9, "m", dof=18.0),
    "comparison": Uncertainty("comparison", 9.7e-9, "m", dof=25.6),
    "expansion difference": Uncertainty(
        "expansion difference", 0.58e-6, "1/K", dof=50.0, shape="rectangular"
    ),
    "temperature difference": Uncertainty("temperature difference", 0.029, "K", dof=2.0, shape="rectangular"),
}


def end_gauge() -> list[Claim]:
    """l = l_s + d - l_s (da theta + a_s dtheta); half a printed digit each."""
    slopes = (1.0, 1.0, -LENGTH * TEMPERATURE, -LENGTH * EXPANSION)
    changes = np.array(
        [
            [slope * uncertainty.std_error]
            for slope, uncertainty in zip(slopes, UNCERTAINTIES.values(), strict=True)
        ]
    )
    budget = Budget(("l",), np.zeros(1), None, tuple(UNCERTAINTIES.values()), changes)
    u, source = 1e9 * budget.combined[0], "GUM H.1"
    return [
        within("u_c of an end gauge", u, 32.0, 0.5, "nm", MEASUREMENT, source),
        within("its degrees of freedom, cut off", int(budget.dof[0]), 16.0, 0.5, "1", MEASUREMENT, source),
        within(
            "its expanded uncertainty at 99 %",
            student_quantile(0.995, 16) * u,
            93.0,
            0.5,
            "nm",
            MEASUREMENT,
            source,
        ),
        within(
            "u_c with terms of second order, 200 000 draws",
            1e9 * second_order(),
            34.0,
            0.5,
            "nm",
            MEASUREMENT,
            source,
        ),
    ]


def second_order() -> float:
    """GUM H.1.7: the mean temperature's 0.5 K cycle (arc-sine) and 0.2 K (normal) enter by the expansion
    difference only.
    """
    rng, draws = np.random.default_rng(11), 200_000
    theta = TEMPERATURE + 0.2 * rng.standard_normal(draws) + 0.5 * np.sin(2 * np.pi * rng.uniform(size=draws))
    expansion = EXPANSION + 2e-6 * rng.uniform(-1, 1, draws)
    length, difference = (scale * rng.standard_normal(draws) for scale in (25e-9, 9.7e-9))
    da, dtheta = (
        np.array([drawn_error(UNCERTAINTIES[name], np.random.default_rng(seed)) for seed in range(2000)])[
            rng.integers(0, 2000, draws)
        ]
        for name in ("expansion difference", "temperature difference")
    )
    return float(np.std(length + difference - LENGTH * (da * theta + expansion * dtheta)))


def impedance() -> list[Claim]:
    """Resistance, reactance and impedance of five simultaneous readings, with their correlations.

    Half a printed digit.
    """
    of = np.array([readings.VOLT, readings.AMPERE, readings.PHASE])
    volt, ampere, phase = of.mean(axis=1)
    means = Estimated(("V", "I", "phi"), ("V", "A", "rad"), of.mean(axis=1), np.cov(of) / 5)
    size = volt / ampere
    r, x = size * np.cos(phase), size * np.sin(phase)
    slopes = {
        "R": {"V": r / volt, "I": -r / ampere, "phi": -x},
        "X": {"V": x / volt, "I": -x / ampere, "phi": r},
        "Z": {"V": size / volt, "I": -size / ampere},
    }
    source = "GUM H.2"
    values = (("R", r, 127.732), ("X", x, 219.847), ("Z", size, 254.260))
    found = [
        worst(
            [
                within(name, value, printed, 5e-4, "ohm", MEASUREMENT, source)
                for name, value, printed in values
            ],
            "mean of R, X, Z",
        )
    ]
    why = (
        "the five printed readings give 0.2956, which is cut off in print; its second approach prints 0.2955"
    )
    for name, printed in (("R", 0.071), ("X", 0.295), ("Z", 0.236)):
        off = why if name == "X" else ""
        found.append(
            within(
                f"u({name}) of correlated readings",
                propagate(means, slopes[name]),
                printed,
                5e-4,
                "ohm",
                MEASUREMENT,
                source,
                off,
            )
        )
    rows = np.array([[of_name.get(name, 0.0) for name in means.names] for of_name in slopes.values()])
    covariance = rows @ means.covariance @ rows.T
    correlation = covariance / np.outer(*[np.sqrt(np.diag(covariance))] * 2)
    each = [
        within(pair, value, printed, 5e-4, "1", MEASUREMENT, source)
        for pair, value, printed in zip(
            ("R, X", "R, Z", "X, Z"), correlation[np.triu_indices(3, 1)], (-0.588, -0.485, 0.993), strict=True
        )
    ]
    return [*found, worst(each, "correlation of R, X, Z")]


def calibration_lines() -> list[Claim]:
    """A thermometer's correction over its reading less 20 deg C, and NIST's ozone monitors."""
    line = fit_line(readings.THERMOMETER[:, 0] - 20, readings.THERMOMETER[:, 1])
    errors = np.sqrt(np.diag(line.covariance))
    at_30 = line.values @ [10.0, 1.0]
    error_30 = float(np.sqrt([10.0, 1.0] @ line.covariance @ [10.0, 1.0]))
    source = "GUM H.3"
    monitors = fit_line(readings.NORRIS_X, readings.NORRIS_Y)
    of_slope, of_intercept = np.sqrt(np.diag(monitors.covariance))
    nist = "NIST StRD Norris"
    return [
        within("correction at 20 deg C", line.values[1], -0.1712, 5e-5, "K", MEASUREMENT, source),
        within("its standard error", errors[1], 0.0029, 5e-5, "K", MEASUREMENT, source),
        within("slope of the correction", line.values[0], 0.00218, 5e-6, "1", MEASUREMENT, source),
        within("its standard error", errors[0], 0.00067, 5e-6, "1", MEASUREMENT, source),
        within(
            "correlation of both",
            line.covariance[0, 1] / errors[0] / errors[1],
            -0.930,
            5e-4,
            "1",
            MEASUREMENT,
            source,
        ),
        within("correction at 30 deg C", at_30, -0.1494, 5e-5, "K", MEASUREMENT, source),
        within("its standard error", error_30, 0.0041, 5e-5, "K", MEASUREMENT, source),
        within("slope of ozone monitors", monitors.slope, 1.00211681802045, 1e-10, "1", MEASUREMENT, nist),
        within("its standard error", 1e3 * of_slope, 0.429796848199937, 1e-8, "10^-3", MEASUREMENT, nist),
        within(
            "intercept of ozone monitors",
            monitors.values[1],
            -0.262323073774029,
            1e-8,
            "1",
            MEASUREMENT,
            nist,
        ),
        within("its standard error", of_intercept, 0.232818234301152, 1e-8, "1", MEASUREMENT, nist),
    ]


def scatter() -> list[Claim]:
    """Scatter within and between settings: the Zener standard's ten days, five instruments on silicon."""
    # The analysis of variance needs of every day its mean and standard deviation only, and these are what is
    # printed.
    shape = np.array([-2.0, -1, 0, 1, 2]) / np.sqrt(2.5)
    volts = readings.ZENER_MEAN[:, None] + readings.ZENER_SPREAD[:, None] * shape
    zener = components(volts.ravel(), np.repeat(np.arange(10).astype(str), 5))
    silicon = components(readings.SILICON.ravel(), np.repeat(np.arange(5).astype(str), 5))
    f_zener = (zener.within**2 + 5 * zener.between**2) / zener.within**2
    source, nist = "GUM H.5", "NIST StRD SiRstv"
    between = np.sqrt((1.18046237440255 - 1) / 5) * 0.104076068334656
    return [
        within("mean of a Zener standard above 10 V", zener.mean, 97.0, 0.5, "uV", MEASUREMENT, source),
        within("its scatter within a day", zener.within, 85.0, 0.5, "uV", MEASUREMENT, source),
        within("its scatter between days", zener.between, 43.0, 0.5, "uV", MEASUREMENT, source),
        within("its standard error", zener.mean_error, 18.0, 0.5, "uV", MEASUREMENT, source),
        within("F ratio", f_zener, 2.25, 0.05, "1", MEASUREMENT, source),
        within(
            "scatter within an instrument, silicon",
            silicon.within,
            0.104076068334656,
            1e-9,
            "ohm.cm",
            MEASUREMENT,
            nist,
        ),
        within("scatter between instruments", silicon.between, between, 1e-9, "ohm.cm", MEASUREMENT, nist),
    ]


@dataclass(frozen=True)
class Observed:
    """y = f(x; b), its derivatives by complex steps, for labpipe's descent."""

    x: np.ndarray
    y: np.ndarray
    model: Callable[[np.ndarray, np.ndarray], np.ndarray]

    @property
    def size(self) -> float:
        return float(np.linalg.norm(self.y))

    def residual(self, parameters: np.ndarray) -> np.ndarray:
        return self.model(self.x, parameters) - self.y

    def jacobian(self, parameters: np.ndarray) -> np.ndarray:
        steps = 1e-20 * np.diag(np.abs(parameters))
        return np.stack(
            [self.model(self.x, parameters + 1j * step).imag / step.max() for step in steps], axis=1
        )

    def chi2(self, parameters: np.ndarray) -> float:
        return sum_of_squares(self.residual, parameters)


def adsorption(x: np.ndarray, b: np.ndarray) -> np.ndarray:
    return b[0] * (1 - np.exp(-b[1] * x))


def mobility(x: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (b[0] + x * (b[1] + x * (b[2] + x * b[3]))) / (1 + x * (b[4] + x * (b[5] + x * b[6])))


CERTIFIED = {
    "Misra1a": (
        Observed(readings.MISRA_X, readings.MISRA_Y, adsorption),
        (500, 1e-4),
        (2.3894212918e2, 5.5015643181e-4),
    ),
    "Thurber": (
        Observed(readings.THURBER_X, readings.THURBER_Y, mobility),
        (1000, 1000, 400, 40, 0.7, 0.3, 0.03),
        (
            1.2881396800e3,
            1.4910792535e3,
            5.8323836877e2,
            7.5416644291e1,
            9.6629502864e-1,
            3.9797285797e-1,
            4.9727297349e-2,
        ),
    ),
}


def descents() -> list[Claim]:
    """From NIST's distant start to the certified parameters.

    Labpipe stops where a step is a millionth of a standard error or so.
    """
    found = []
    for name, (problem, start, certified) in CERTIFIED.items():
        end = minimise(problem, np.array(start, float))
        each = [
            within(
                f"b{number}",
                100 * value / known,
                100.0,
                0.001,
                "% of certified",
                MEASUREMENT,
                f"NIST StRD {name}",
            )
            for number, (value, known) in enumerate(zip(end.values, certified, strict=True), start=1)
        ]
        found.append(worst(each, f"parameters of {name} from its distant start"))
    return found


def decisions() -> list[Claim]:
    """Probabilities within limits, and the global risks of a process; half a printed digit each."""
    printed, jcgm, deaver = "printed calculation", "JCGM 106:2012, clause 7", "Deaver, NCSL 1993"
    examples = {
        "Zener diode, -5.47 V with 0.05 V, at most -5.40 V": (-5.47, 0.05, Limits(high=-5.40), 0.92),
        "container, 509.7 kPa with 8.6 kPa, at least 490 kPa": (509.7, 8.6, Limits(low=490.0), 0.99),
        "oil, 13.6 mm^2/s with 1.8 mm^2/s, from 12.5 to 16.3 mm^2/s": (13.6, 1.8, Limits(12.5, 16.3), 0.66),
    }
    rows = [
        within(f"probability: {name}", conformance(*example[:3]), example[3], 0.005, "1", printed, jcgm)
        for name, example in examples.items()
    ]
    limits = Limits(-2.0, 2.0)
    for ratio, factor, accepted, rejected in ((4, 1.0, 0.8, 1.5), (2, 0.91, 0.8, 6.6)):
        risks = global_risk((0.0, 1.0), 1 / ratio, limits, limits.narrow(2 - 2 * factor))
        name = f"{ratio} to 1" + (f", guard band {factor:g}" if factor < 1 else "")
        pairs = (
            ("accepted", risks.false_acceptance, accepted),
            ("rejected", risks.false_rejection, rejected),
        )
        rows += [
            within(f"falsely {what}, {name}", 100 * share, wanted, 0.05, "%", printed, deaver)
            for what, share, wanted in pairs
        ]
    return rows


METHOD = Method(
    "budget",
    "Calibration and uncertainty",
    {
        "end gauge": end_gauge,
        "impedance": impedance,
        "calibration lines": calibration_lines,
        "scatter": scatter,
        "descents": descents,
        "decisions": decisions,
        "not tested": partial(gaps, "budget"),
    },
)
