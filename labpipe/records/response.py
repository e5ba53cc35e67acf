"""A measured frequency response matrix with its uncertainty."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from labpipe.arrays import BoolArray, ComplexArray, FloatArray, IntArray, freeze
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note
from labpipe.records.text import VIEWS, response_line
from labpipe.records.uncertain import ChannelUncertainty, MatrixError


@dataclass(frozen=True)
class FactoredCovariance:
    """cov(H_oi, H_pj) = R[o, p] G[i, j], one line after the other: a Kronecker product.

    *outputs* R (n_line, n_output, n_output) [output unit^2] and *inputs* G (n_line, n_input, n_input) [1 /
    input unit^2], both Hermitian to the last digit. Of 16 responses and 3 forces these are 265 numbers per
    line, the whole matrix has 2304.
    """

    outputs: ComplexArray
    inputs: ComplexArray

    def __post_init__(self) -> None:
        n_line, n_output, n_input = self.outputs.shape[0], self.outputs.shape[-1], self.inputs.shape[-1]
        for name, n in (("outputs", n_output), ("inputs", n_input)):
            freeze(self, name, np.complex128, (n_line, n, n), f"covariance of the {name}")

    @property
    def shape(self) -> tuple[int, int, int]:
        """(n_line, n, n) of the whole covariance, n = n_output * n_input."""
        n = self.outputs.shape[1] * self.inputs.shape[1]
        return (self.outputs.shape[0], n, n)

    def element(self, p: int, q: int) -> ComplexArray:
        """The covariance of elements *p* and *q* of vec(H), row-major, (n_line,) [unit^2 of H]."""
        (o, i), (r, j) = (divmod(number, self.inputs.shape[1]) for number in (p, q))
        element: ComplexArray = self.outputs[:, o, r] * self.inputs[:, i, j]
        return element

    @property
    def variance(self) -> FloatArray:
        """E|H - E H|^2 of every element, (n_line, n_output, n_input) [unit^2 of H]."""
        left, right = (np.einsum("lii->li", factor).real for factor in (self.outputs, self.inputs))
        return np.maximum(left[:, :, None] * right[:, None, :], 0.0)

    def whole(self) -> ComplexArray:
        """The covariance of vec(H), row-major, (n_line, n, n) [unit^2 of H], Hermitian.

        Lines are last in memory.
        """
        n_line, n_output = self.outputs.shape[:2]
        n = self.shape[1]
        by_axes = np.empty((n_output, n // n_output, n_output, n // n_output, n_line), np.complex128)
        np.multiply(
            self.outputs.transpose(1, 2, 0)[:, None, :, None],
            self.inputs.transpose(1, 2, 0)[None, :, None],
            out=by_axes,
        )
        covariance: ComplexArray = by_axes.reshape(n, n, n_line).transpose(2, 0, 1)
        diagonal = np.einsum("fii->fi", covariance)
        diagonal[...] = np.maximum(diagonal.real, 0.0)
        return covariance


@dataclass(frozen=True)
class BlockCovariance:
    """Covariance of vec(H) in independent blocks: cov(H_elements[b, j], H_elements[b, k]) = blocks[line, b,
    j, k], 0 between blocks.

    *elements* (n_block, m), each of the n_block * m elements of vec(H) once; *blocks* (n_line, n_block, m, m)
    [unit^2 of H], Hermitian. Columns measured one after the other, as by a roving hammer, have independent
    errors: of 79 points and 3 sensors these are 711 numbers per line, the whole matrix has 56169.
    """

    elements: IntArray
    blocks: ComplexArray

    def __post_init__(self) -> None:
        n_block, m = self.elements.shape
        shape = (len(self.blocks), n_block, m, m)
        freeze(self, "blocks", np.complex128, shape, "covariance of the columns")

    @classmethod
    def from_variance(cls, variance: FloatArray) -> BlockCovariance:
        """Every element a block of its own; *variance* (n_line, n_output, n_input) [unit^2 of H]."""
        flat = np.asarray(variance, np.complex128).reshape(len(variance), -1)
        return cls(np.arange(flat.shape[1])[:, None], flat[:, :, None, None])

    @property
    def shape(self) -> tuple[int, int, int]:
        """(n_line, n, n) of the whole covariance."""
        return (self.blocks.shape[0], self.elements.size, self.elements.size)

    @cached_property
    def _places(self) -> IntArray:
        places = np.empty((self.elements.size, 2), np.intp)
        places[self.elements.ravel()] = np.argwhere(self.elements >= 0)
        return places

    def element(self, p: int, q: int) -> ComplexArray:
        """The covariance of elements *p* and *q* of vec(H), row-major, (n_line,) [unit^2 of H]."""
        (b, j), (other, k) = self._places[p], self._places[q]
        element: ComplexArray = (
            self.blocks[:, b, j, k] if b == other else np.zeros(self.blocks.shape[0], np.complex128)
        )
        return element

    @property
    def variance(self) -> FloatArray:
        """E|H - E H|^2 of every element of vec(H), (n_line, n) [unit^2 of H]."""
        diagonal = np.einsum("lbjj->lbj", self.blocks).real
        return diagonal[:, self._places[:, 0], self._places[:, 1]]

    def choose(self, lines: BoolArray, index: Sequence[int]) -> BlockCovariance:
        """That of the elements *index*, which are the new vec(H), on the *lines* (n_frequency,), of rows and
        columns of the matrix.
        """
        place = np.full(self.elements.size, -1, np.intp)
        place[list(index)] = np.arange(len(index))
        new = place[self.elements]
        left = np.any(new >= 0, axis=1)
        inside = np.argsort(new[left], axis=1)[:, np.count_nonzero(new[left] < 0, axis=1).max(initial=0) :]
        numbers = np.flatnonzero(left)[:, None, None]
        blocks = self.blocks[lines][:, numbers, inside[:, :, None], inside[:, None, :]]
        return BlockCovariance(np.take_along_axis(new[left], inside, axis=1), blocks)

    def times(self, factor: ComplexArray) -> BlockCovariance:
        """That of the elements times *factor* (n_line, n) [any unit]."""
        by_block = factor[:, self.elements]
        return BlockCovariance(
            self.elements, self.blocks * by_block[..., None] * by_block[..., None, :].conj()
        )

    def whole(self) -> ComplexArray:
        """The covariance of vec(H), row-major, (n_line, n, n) [unit^2 of H]."""
        covariance = np.zeros(self.shape, np.complex128)
        covariance[:, self.elements[:, :, None], self.elements[:, None, :]] = self.blocks
        return covariance


# What a covariance may be given as, so that it is made whole only where somebody asks for it.
StoredCovariance = ComplexArray | FactoredCovariance | BlockCovariance | None


def variance_of(covariance: StoredCovariance) -> FloatArray | None:
    """E|H - E H|^2 of every element of vec(H), (n_line, n) [unit^2 of H], or None where nothing is known."""
    if isinstance(covariance, np.ndarray):
        return np.einsum("lii->li", covariance).real
    return None if covariance is None else covariance.variance.reshape(covariance.shape[:2])


def element_of(
    covariance: ComplexArray | FactoredCovariance | BlockCovariance, p: int, q: int
) -> ComplexArray:
    """The covariance of elements *p* and *q* of vec(H), row-major, (n_line,) [unit^2 of H]."""
    return covariance[:, p, q] if isinstance(covariance, np.ndarray) else covariance.element(p, q)


class HeldCovariance:
    """An attribute that is given as a whole array (n_line, n, n), in parts, or as None, and read as an array,
    which is made once.
    """

    def __get__(self, instance: object | None, owner: type) -> ComplexArray | None:
        if instance is None:
            # The default of a data class.
            return None
        covariance: StoredCovariance = instance.__dict__["covariance"]
        if isinstance(covariance, FactoredCovariance | BlockCovariance):
            covariance = covariance.whole()
            covariance.flags.writeable = False
            instance.__dict__["covariance"] = covariance
        return covariance

    def __set__(self, instance: object, value: StoredCovariance) -> None:
        instance.__dict__["covariance"] = value


FORMS = {
    "receptance": "m/N",
    "mobility": "m/(N.s)",
    "accelerance": "m/(N.s^2)",
    "transmissibility": "1",
    "other": "1",
}


@dataclass(frozen=True)
class Port:
    """Place and direction of a response or force: channel name, dof label and, if known, direction [rad] from
    x towards y.

    *label* is unique within the outputs or the inputs of a matrix and names rows and columns everywhere.
    *uncertainties* of the channel's calibration.
    """

    label: str
    channel: str
    dof: str
    angle: float | None = None
    uncertainties: tuple[ChannelUncertainty, ...] = ()

    @property
    def place(self) -> str:
        """The point that a dof such as 3.x names before the direction; empty where it is that alone."""
        return "" if " " in self.dof else self.dof.rpartition(".")[0]

    def answers_to(self, name: str) -> bool:
        """Whether a user who writes *name* may mean this port (label, channel or dof)."""
        return name in (self.label, self.channel, self.dof)


@dataclass(frozen=True)
class Blocks:
    """Blocks of random data averaged to an FRF: length [s], window, overlap of neighbours [1], number,
    estimator (H1, H2, Hv, joint).

    degree: of the local polynomials that take the place of the window, half_width: their lines to either
    side; 0 for Welch's averages. derivatives: in time of what was averaged, beyond those of the response's
    form; -2 for a transmissibility from an accelerometer on the base and a probe on the mass. by_force:
    number of the blocks of each force, where one alone acts in a recording; apart: its noise is that of these
    alone. bursts: mean square of a force that rests in each block, in equal parts of it [1]. after_hit: share
    of a block that follows its hit [1], where the response has not died away at its end; else 0.
    """

    length: float
    window: str
    overlap: float
    number: int
    estimator: str
    degree: int = 0
    derivatives: int = 0
    by_force: tuple[int, ...] = ()
    apart: bool = False
    bursts: tuple[float, ...] = ()
    half_width: int = 0
    after_hit: float = 0.0

    def dies_away(self, lines: float) -> bool:
        """Whether a mode of this half-power width [lines] falls to 1 % of its power while a burst rests."""
        power = np.cumsum(self.bursts)
        rest = 1 - (1 + np.searchsorted(power, 0.99 * power[-1])) / power.size if self.bursts else 0.0
        return self.window == "boxcar" and bool(np.exp(-2 * np.pi * lines * rest) < 0.01)

    def select_forces(self, columns: Sequence[int]) -> Blocks:
        """Those of the forces *columns*."""
        return replace(self, by_force=tuple(self.by_force[n] for n in columns)) if self.by_force else self


@dataclass(frozen=True, repr=False)
class FrequencyResponse:
    """H(f), output per input, with its covariance.

    frequency           (n_frequency,) [Hz], increasing
    matrix              (n_frequency, n_output, n_input) complex, unit of the form (receptance: m/N)
    covariance          (n_frequency, n, n) complex with n = n_output * n_input, or None: E[d d^H] of
                        d = vec(H - E H), row-major (index = output * n_input + input); its diagonal is the
                        variance of the complex values E|H - E H|^2, half of it in the real and half in the
                        imaginary part (circular). May be given in factors, FactoredCovariance: it is then
                        made whole when it is first read
    coherence           (n_frequency, n_output, n_input) ordinary, or None
    multiple_coherence  (n_frequency, n_output), or None
    partial_coherence   (n_frequency, n_output, n_input) of each force alone, or None
    distortion          (n_frequency, n_output, n_input) the part of the standard deviation [unit of the form]
                        that is due to nonlinearity, or None; the variance less its square is noise
    change              (n_frequency, n_output, n_input) complex, H of the second half of the record less that
                        of the first, or None
    open_loop           (n_frequency, n_output, n_input) complex, H1 beside an FRF of a closed loop, which it
                        takes as open, or None: biased
    snr                 (n_frequency, n_channel) signal-to-noise amplitude ratio per channel at the line
                        (periodic data; hits and sweeps where noise of the force was taken off), or
                        None; its columns are named by snr_channels
    covariance_dof      effective number of complex degrees of freedom behind the covariance estimate
                        (inf: known)
    line_correlation    E[z_(k+d) z_k*] of the noise z of unit variance with that of the next lines, d = 1, 2,
                        ... line spacings away; empty where lines are independent
    line_gains          (n_frequency, 2 m + 1, n_output, n_input) or None: the error of a line is not z_k
                        alone but sum_j gains(k, j) z_(k+j-m) of its neighbours, scaled to the variance 1 (an
                        exponential window taken out again)
    blocks              of random data, whose ends leave leakage in the FRF, or None
    errors              systematic errors that no single port carries: of the numbers in sums of channels, of
                        the members of these, and of the noise of a force within its window
    repeats             (n_repeat, n_frequency, n_output, n_input) complex, H of every recording alone where
                        each has all of it, or of every hit or sweep, or None; named by repeat_names
    repeat_levels       (n_repeat,) [unit of the force] r.m.s. of each recording or sweep, peak of each hit,
                        or None; *repeats_are*: "recordings", "hits", "sweeps", "realisations"
    repeat_shares       (n_repeat,) [1] of each sweep's block that are no zeros after it, or None: all of it
    """

    frequency: FloatArray
    matrix: ComplexArray
    outputs: tuple[Port, ...]
    inputs: tuple[Port, ...]
    _: KW_ONLY
    form: str = "receptance"
    covariance: HeldCovariance = HeldCovariance()
    coherence: FloatArray | None = None
    multiple_coherence: FloatArray | None = None
    partial_coherence: FloatArray | None = None
    distortion: FloatArray | None = None
    change: ComplexArray | None = None
    open_loop: ComplexArray | None = None
    snr: FloatArray | None = None
    snr_channels: tuple[str, ...] = ()
    averages: float = 1.0
    covariance_dof: float = field(default=math.inf, metadata={"null": math.inf})
    line_correlation: tuple[complex, ...] = ()
    line_gains: ComplexArray | None = None
    blocks: Blocks | None = None
    errors: tuple[MatrixError, ...] = ()
    repeats: ComplexArray | None = None
    repeat_names: tuple[str, ...] = ()
    repeat_levels: FloatArray | None = None
    repeat_shares: FloatArray | None = None
    repeats_are: str = "recordings"
    name: str = ""
    findings: tuple[Finding, ...] = ()
    conditions: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n_f, n_o, n_i = np.size(self.frequency), len(self.outputs), len(self.inputs)
        n = n_o * n_i
        freeze(self, "frequency", np.float64, (n_f,))
        if n_f > 1 and np.any(np.diff(self.frequency) <= 0):
            raise DataError(f"the frequencies of '{self.name}' do not increase")
        if self.form not in FORMS:
            raise DataError(f"unknown form '{self.form}'", hint=f"known: {', '.join(FORMS)}")
        for ports in (self.outputs, self.inputs):
            labels = [port.label for port in ports]
            if len(set(labels)) != len(labels):
                raise DataError(f"two rows or columns of '{self.name}' have one label: {', '.join(labels)}")
        whole, n_gain = (n_f, n_o, n_i), 1 if self.line_gains is None else np.shape(self.line_gains)[1]
        freeze(self, "matrix", np.complex128, whole, "FRF matrix")
        shapes = {
            "covariance": (np.complex128, (n_f, n, n)),
            "coherence": (np.float64, whole),
            "multiple_coherence": (np.float64, (n_f, n_o)),
            "partial_coherence": (np.float64, whole),
            "distortion": (np.float64, whole),
            "change": (np.complex128, whole),
            "open_loop": (np.complex128, whole),
            "snr": (np.float64, (n_f, len(self.snr_channels))),
            "repeats": (np.complex128, (len(self.repeat_names), *whole)),
            **dict.fromkeys(("repeat_levels", "repeat_shares"), (np.float64, (len(self.repeat_names),))),
            "line_gains": (np.complex128, (n_f, n_gain, n_o, n_i)),
        }
        for error in self.errors:
            if error.change.shape != (n_f, n_o, n_i):
                raise DataError(
                    f"the change of '{self.name}' by {error.uncertainty.source} has the shape "
                    f"{error.change.shape}"
                )
        for attribute, (dtype, shape) in shapes.items():
            values = self.__dict__[attribute]
            if not isinstance(values, FactoredCovariance | BlockCovariance):
                freeze(self, attribute, dtype, shape)
            elif values.shape != shape:
                raise DataError(f"covariance has the shape {values.shape}, {shape} is needed")

    def __repr__(self) -> str:
        return response_line(self)

    def with_findings(self, findings: Sequence[Finding]) -> FrequencyResponse:
        """The response with more findings; nothing else is made or checked again."""
        response = copy.copy(self)
        object.__setattr__(response, "findings", (*self.findings, *findings))
        return response

    def rename(self, name: str, conditions: dict[str, Any]) -> FrequencyResponse:
        """The response under another *name* and *conditions*; nothing else is made or checked again."""
        response = copy.copy(self)
        object.__setattr__(response, "name", name)
        object.__setattr__(response, "conditions", conditions)
        return response

    def to_frame(self) -> Any:
        """The elements over frequency [Hz] as a pandas data frame: ``o/i`` complex, ``o/i:std`` where the
        noise is known.
        """
        return VIEWS["frame"](self)

    def to_xarray(self) -> Any:
        """The matrix over frequency, output and input as an xarray data set.

        ConfigError where xarray is not installed.
        """
        return VIEWS["xarray"](self)

    @property
    def n_frequency(self) -> int:
        return int(self.frequency.size)

    @property
    def stored_covariance(self) -> StoredCovariance:
        """The covariance as it is held: whole, in factors or in blocks [unit^2 of H]."""
        covariance: StoredCovariance = self.__dict__["covariance"]
        return covariance

    @property
    def variance(self) -> FloatArray | None:
        """E|H - E H|^2 per element, (n_frequency, n_output, n_input) [unit^2 of H], or None."""
        variance = variance_of(self.stored_covariance)
        return None if variance is None else variance.reshape(self.matrix.shape)

    def covariance_of(self, p: int, q: int) -> ComplexArray:
        """The covariance of elements *p* and *q* of vec(H), row-major, (n_frequency,) [unit^2 of H].

        DataError where none is known.
        """
        covariance = self.stored_covariance
        if covariance is None:
            raise DataError(f"the covariance of '{self.name}' is not known")
        return element_of(covariance, p, q)


# A matrix of more numbers than this stands in its own file only: a result shows as many elements of it as
# have so many numbers.
MOST_STORED, SHOWN = 100_000, 10_000


def shown_ports(n_line: int, n_output: int, n_input: int) -> tuple[list[int], list[int]] | None:
    """Rows and columns, evenly spaced, of a matrix (n_line, n_output, n_input) too large for a result.

    None where it is not.
    """
    if n_line * n_output * n_input <= MOST_STORED:
        return None
    fewer, more = sorted((n_output, n_input))
    left = np.unique(np.linspace(0, more - 1, max(1, SHOWN // (n_line * fewer))).astype(int)).tolist()
    return (list(range(n_output)), left) if n_output <= n_input else (left, list(range(n_input)))


def shown_part(response: FrequencyResponse) -> FrequencyResponse:
    """What a result shows of a response: all of it, or some elements with their variances and a note where
    that would be too much.
    """
    ports = shown_ports(*response.matrix.shape)
    if ports is None:
        return response
    rows, columns = ports

    def part(values: Any) -> Any:
        return None if values is None else values[..., rows, :][..., columns]

    variance, multiple = response.variance, response.multiple_coherence
    n = len(response.outputs) * len(response.inputs)
    message = (
        f"the result shows {len(rows) * len(columns)} of {n} elements of the FRF; all of them stand "
        "in its own file"
    )
    names = ("matrix", "coherence", "partial_coherence", "distortion", "change", "open_loop", "line_gains")
    parts = {name: part(getattr(response, name)) for name in (*names, "repeats")}
    return replace(
        response,
        **parts,
        outputs=tuple(response.outputs[row] for row in rows),
        inputs=tuple(response.inputs[column] for column in columns),
        blocks=response.blocks and response.blocks.select_forces(columns),
        covariance=None if variance is None else BlockCovariance.from_variance(part(variance)),
        multiple_coherence=None if multiple is None else multiple[:, rows],
        errors=tuple(error.turn(part) for error in response.errors),
        findings=(*response.findings, note("part-shown", message)),
    )


def diagonal_covariance(variance: FloatArray) -> ComplexArray:
    """Covariance (n_frequency, n, n) [unit^2] of uncorrelated elements from their variance (n_frequency,
    n_output, n_input).
    """
    flat = variance.reshape(variance.shape[0], -1)
    covariance = np.zeros((*flat.shape, flat.shape[1]), np.complex128)
    np.einsum("fii->fi", covariance)[...] = flat
    return covariance
