"""Numbers with their standard uncertainty, the systematic sources behind them, and the budget they make."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, freeze
from labpipe.quantities import UnitError, parse_value, written_unit
from labpipe.registry import nearest

# Half width over standard uncertainty of distributions with sharp ends (GUM 4.3.7, 4.3.9).
SHAPES = {"normal": 1.0, "rectangular": math.sqrt(3.0), "triangular": math.sqrt(6.0)}
# Their excess kurtosis, the degrees of freedom up to which Student's distribution has none, and the share of
# the variance up to which a source of so few counts as any other.
EXCESS = {"rectangular": -1.2, "triangular": -0.6}
UNSETTLED, MINOR = 4, 0.01
# A relative uncertainty above it is a slip: of logarithms, 1000 % are nine decades either way.
MOST_RELATIVE = 10


@dataclass(frozen=True)
class Uncertain:
    """A value with its standard uncertainty, both in SI units.

    dof: degrees of freedom behind the uncertainty, None where it is known; shape: its distribution, one of
    SHAPES; source: name of its cause, numbers of one source have one error in common; empty where the number
    stands for itself.
    """

    value: float
    std_error: float = 0.0
    _: KW_ONLY
    dof: float | None = None
    shape: str = "normal"
    source: str = ""


def split_uncertainty(text: str) -> tuple[str, str]:
    """A text and the uncertainty behind it: "8 V/mm +- 1 %" -> ("8 V/mm", "1 %").

    The uncertainty is empty where there is none.
    """
    number, _, uncertainty = text.replace("±", "+-").partition("+-")
    return number.strip(), uncertainty.strip()


def is_uncertain(value: Any) -> bool:
    """Whether a text gives a number with its uncertainty."""
    return isinstance(value, str) and ("+-" in value or "±" in value)


def parse_uncertain(text: str, unit: str) -> Uncertain:
    """Value and standard uncertainty of "45.2 kN/m +- 1 %"; one in per cent is relative to the value.

    Behind it in brackets: what the number is, where it is not a standard uncertainty (k=2, rectangular or
    triangular limits), its degrees of freedom (dof=12), and its cause (source=scale).
    """
    value_text, error_text = split_uncertainty(text)
    value = parse_value(value_text, unit)
    if not error_text:
        return Uncertain(value)
    size_text, qualities = qualities_of(error_text)
    relative = size_text.endswith("%")
    if relative and not value:
        raise UnitError(f"'{size_text}' is relative, of zero", "write the uncertainty with its unit")
    size = abs(value) * parse_value(size_text, "1") if relative else _difference(size_text, unit)
    if size < 0:
        raise UnitError(f"'{text}' has a negative uncertainty")
    if relative and size > MOST_RELATIVE * abs(value):
        what = f"'{size_text}' is more than {MOST_RELATIVE} times the value"
        raise UnitError(what, "write the uncertainty with its unit")
    return _qualify(Uncertain(value, size), qualities)


def _difference(text: str, si_unit: str) -> float:
    """A difference in a unit that may have an offset: 2 degC are 2 K."""
    unit = written_unit(text)
    return parse_value(text, si_unit) - (parse_value(f"0 {unit}", si_unit) if unit else 0.0)


def qualities_of(text: str) -> tuple[str, list[str]]:
    """The size of an uncertainty and what stands in brackets behind it: "1 % (k=2)" -> ("1 %", ["k=2"]).

    Brackets of a unit are part of the size.
    """
    match = re.match(r"^(.*?)\(([^()]*)\)$", text)
    parts = [part.strip() for part in match[2].split(",")] if match else []
    if match is None or not any(
        "=" in part or nearest(part, SHAPES).startswith("did you mean") or part in SHAPES for part in parts
    ):
        return text, []
    return match[1].strip(), parts


def _qualify(plain: Uncertain, qualities: Iterable[str]) -> Uncertain:
    """The uncertainty with its qualities; a factor k divides it alone. UnitError for two of a kind."""
    entries: dict[str, Any] = {}
    for quality in qualities:
        name, _, text = (part.strip() for part in quality.partition("="))
        kind = "shape" if name in SHAPES and not text else name
        value: Any = name if kind == "shape" else text
        if kind in entries:
            raise UnitError(f"'{quality}' stands beside another {kind}", "state one of them")
        if kind in ("k", "dof"):
            value = parse_value(text, "1")
            if not value > 0:
                raise UnitError(f"'{quality}' must be above zero")
        elif not value or (value not in SHAPES if kind == "shape" else kind != "source"):
            words = (*SHAPES, "k=2", "dof=12", "source=NAME")
            raise UnitError(f"'{quality}' says nothing of an uncertainty", nearest(name, words))
        entries[kind] = value
    factor = entries.pop("k", SHAPES[entries.get("shape", "normal")])
    return replace(plain, std_error=plain.std_error / factor, **entries)


# Systematic uncertainties: a number of the rig that is known with a standard uncertainty, the same error in
# all that rests on it. Relative change of a channel's amplitude X by a unit of the error d of its chain, as
# (a, n) for a w^n: X (1 - d), X e^{+jwd}, X e^{+jd}.
COURSES: dict[str, tuple[complex, int]] = {"gain": (-1.0, 0), "delay": (1j, 1), "phase": (1j, 0)}


@dataclass(frozen=True)
class Uncertainty:
    """Standard uncertainty of one number [unit]; numbers of one *source* have one error in common.

    dof: degrees of freedom behind it, None where it is known; shape: its distribution (normal, rectangular,
    triangular).
    """

    source: str
    std_error: float
    unit: str
    dof: float | None = None
    shape: str = "normal"


def uncertainty_of(number: Uncertain, source: str, unit: str) -> Uncertainty:
    """The uncertainty of a number, by its own source where it names one, else *source*."""
    return Uncertainty(number.source or source, number.std_error, unit, number.dof, number.shape)


@dataclass(frozen=True)
class ChannelUncertainty:
    """Uncertainty of a channel's calibration. *effect*: 'gain' (relative), 'delay' [s], 'phase' [rad] or
    'direction' [rad].

    The error d of the number changes the channel's amplitude X [SI] to X (1 - d), X e^{+jwd}, X e^{+jd}; a
    direction turns the channel. *shown*: part of it [1] that the scatter of repeats shows, of which not all
    have it.
    """

    effect: str
    uncertainty: Uncertainty
    shown: float = 0.0


@dataclass(frozen=True)
class MatrixError:
    """What an error that no single channel carries does to a measured matrix: a number in a sum of channels,
    noise of the force within its window.

    *change* (n_frequency, n_output, n_input) complex [unit of the matrix]: by one standard uncertainty of the
    *uncertainty*. *by_repeat*: each repeat has its own, so that their scatter shows it. *parts* of the change
    that go with the powers 0, 1, 2 of each element of the matrix, in noise as well; none: all with the first.
    """

    uncertainty: Uncertainty
    change: ComplexArray
    by_repeat: bool = False
    parts: tuple[ComplexArray, ...] = ()

    def __post_init__(self) -> None:
        what = f"change by {self.uncertainty.source}"
        freeze(self, "change", np.complex128, np.shape(self.change), what)

    def turn(self, of_matrix: Callable[[ComplexArray], ComplexArray]) -> MatrixError:
        """The error of what a linear *of_matrix* makes of the matrix (n_frequency, n_output, n_input) [any
        unit].
        """
        return replace(self, change=of_matrix(self.change), parts=tuple(map(of_matrix, self.parts)))

    def at(self, ratio: ComplexArray) -> ComplexArray:
        """The change [unit of the matrix] where the matrix is *ratio* [1] times the measured one, each
        (n_frequency, n_output, n_input).
        """
        if not self.parts:
            return self.change * ratio
        return np.sum([part * ratio**power for power, part in enumerate(self.parts)], axis=0)


# The uncertainty budget of a fit: what noise and every systematic source leave of its parameters.


@dataclass(frozen=True)
class Budget:
    """Uncertainties of the parameters *names* of a fit, in their units.

    random (n_parameter,) [unit of the parameter]: standard uncertainties by noise, with what the residual
    shows beyond it, NaN where there is none; random_dof behind them. sources: systematic ones; changes
    (n_source, n_parameter) [unit of the parameter]: change of every parameter by one standard uncertainty of
    the source, with its sign: their outer products are the covariance by each source. drawn (n_parameter, 3)
    [unit of the parameter]: scatter and ends of the 95 % interval of Monte Carlo draws of noise and sources,
    None where there are none.
    """

    names: tuple[str, ...]
    random: FloatArray
    random_dof: float | None
    sources: tuple[Uncertainty, ...]
    changes: FloatArray
    drawn: FloatArray | None = None

    @property
    def systematic(self) -> FloatArray:
        """Standard uncertainty (n_parameter,) [unit of the parameter] of all sources together; they are
        independent of each other.

        Equation (unc-systematic).
        """
        return np.sqrt(np.sum(self.changes**2, axis=0))

    @property
    def combined(self) -> FloatArray:
        """Combined standard uncertainty (n_parameter,) [unit of the parameter]. Equation (unc-combined)."""
        return np.hypot(self.random, self.systematic)

    @property
    def dof(self) -> FloatArray:
        """Effective degrees of freedom (n_parameter,) [1]: u_c^4 / sum u_i^4 / nu_i (Welch and Satterthwaite,
        GUM G.4.1); inf: known.

        Equation (unc-dof).
        """
        terms = [self.random**4 / self.random_dof if self.random_dof else np.zeros_like(self.random)]
        terms += [
            change**4 / source.dof
            for change, source in zip(self.changes, self.sources, strict=True)
            if source.dof
        ]
        total = np.sum(terms, axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(total > 0, self.combined**4 / total, np.inf)

    def scatter_of_draws(self) -> tuple[FloatArray, FloatArray]:
        """Scatter (n_parameter,) [unit of the parameter] of draws from the distributions of noise and sources
        by first order, and its excess kurtosis (n_parameter,) [1].

        Student's distribution of nu degrees of freedom has the variance nu / (nu - 2) and the excess 6 / (nu
        - 4): NaN where a source that counts has no more than four. Equation (unc-first-order).
        """
        square, fourth = self.random**2, np.zeros_like(self.random)
        for source, change in zip(self.sources, self.changes**2, strict=True):
            factor, excess = 1.0, EXCESS.get(source.shape, 0.0)
            if source.dof and source.shape == "normal":
                settled = source.dof > UNSETTLED
                factor = source.dof / (source.dof - 2) if settled else np.nan
                excess = 6 / (source.dof - UNSETTLED) if settled else np.nan
            counts = change > MINOR * self.combined**2
            square = square + np.where(counts, factor, 1.0) * change
            fourth = fourth + np.where(counts, excess * (factor * change) ** 2, 0.0)
        # What does not scatter at all has no shape.
        kurtosis = np.divide(fourth, square**2, out=np.zeros_like(square), where=square != 0)
        return np.sqrt(square), kurtosis

    def with_random(self, errors: Mapping[str, float]) -> Budget:
        """The budget with other random *errors* [unit of the parameter] by the names of parameters."""
        pairs = zip(self.names, self.random, strict=True)
        return replace(self, random=np.array([errors.get(name, error) for name, error in pairs]), drawn=None)

    def with_sources(self, sources: tuple[Uncertainty, ...], changes: FloatArray) -> Budget:
        """The budget with further sources and their changes (n_source, n_parameter) [unit of the parameter].

        Draws did not hold these.
        """
        return replace(
            self, sources=(*self.sources, *sources), changes=np.vstack([self.changes, changes]), drawn=None
        )

    def enlarge(self, factors: Mapping[str, float]) -> Budget:
        """The budget with the uncertainty of sources times *factors* [1] by their names.

        As it is for others.
        """
        by = np.array([factors.get(source.source, 1.0) for source in self.sources])
        sources = tuple(
            replace(source, std_error=source.std_error * size)
            for source, size in zip(self.sources, by, strict=True)
        )
        return replace(self, sources=sources, changes=by[:, None] * self.changes)

    def shares(self, name: str) -> dict[str, float]:
        """Share of every source in the variance of a parameter, noise among them, the largest first; they add
        up to 1.

        Equation (unc-share).
        """
        column = self.names.index(name)
        parts = {"noise": float(self.random[column] ** 2)}
        for source, change in zip(self.sources, self.changes, strict=True):
            parts[source.source] = parts.get(source.source, 0.0) + float(change[column] ** 2)
        whole = sum(parts.values()) or 1.0
        return {part: value / whole for part, value in sorted(parts.items(), key=lambda pair: -pair[1])}

    def change_by(self, source: str, name: str) -> float:
        """Change of a parameter by one standard uncertainty of a source.

        Zero for a source that the fit does not have.
        """
        column = self.names.index(name)
        rows = zip(self.sources, self.changes, strict=True)
        return float(sum(change[column] for entry, change in rows if entry.source == source))


# What changes between repeats of a test and is not seen within one: drift between days, remounting.


@dataclass(frozen=True)
class RepeatSource:
    """A standard uncertainty of one *parameter* of every fit, relative to its value.

    per: condition; tests of one value of it have one error in common. Empty: every test has its own. dof:
    degrees of freedom behind the size, None where it is known.
    """

    name: str
    parameter: str
    relative: float
    per: str = ""
    dof: float | None = None
