"""What is measured beside responses: spectra of all channels with their covariance, and free decays."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, freeze
from labpipe.errors import DataError
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel
from labpipe.records.response import Blocks, Port


@dataclass(frozen=True)
class UncertainFactor:
    """A number of the rig file with its uncertainty: one that stands in sums of channels, or a gain, delay,
    phase or direction of a channel.

    value, std_error [unit], an SI unit; *derivative* (n_channel, n_channel) complex [SI units of the channels
    per unit of the value]: an error of the number by d changes the vector z of all channels by d w^power
    (derivative @ z), w the angular frequency [rad/s]. Factors of one *source* have one error; by default that
    is the number itself.
    """

    name: str
    value: float
    std_error: float
    unit: str
    derivative: ComplexArray
    power: int = 0
    source: str = ""

    def __post_init__(self) -> None:
        n = len(self.derivative)
        freeze(self, "derivative", np.complex128, (n, n), f"derivative of '{self.name}'")
        object.__setattr__(self, "source", self.source or f"{self.name}, {self.value:g} {self.unit}")


@dataclass(frozen=True)
class ChannelSpectra:
    """Spectra of the channels of one test: a vector z of all channels for every line and run, none of them
    taken as free of noise.

    frequency         (n_line,) [Hz], increasing
    vectors           (n_line, n_run, n_channel) complex amplitudes at e^{+jwt}, 0 to peak [SI units of the
                      channels], corrected for the channels' delays and frequency responses; a run is one
                      independent excitation: a recording of periodic data, or the part of random data that is
                      due to one drive
    covariance        (n_line, n_run, n_channel, n_channel) complex, E[e e^H] of the noise e of a vector; runs
                      do not share noise
    covariance_dof    complex degrees of freedom behind each covariance (inf: known)
    line_correlation  E[e_(k+d) e_k*] of noise of unit variance with that of the next lines, d = 1, 2, ...;
                      empty where independent
    factors           numbers with an uncertainty that stand in derived channels, and uncertainties of the
                      channels' calibrations
    blocks            of random data, whose ends leave leakage in the vectors, or None

    The channels are forces (role input) and responses (output), then sums of these and their members; a
    member that is no force or response of its own has the role reference, and the covariance is singular
    between a sum and its members.
    """

    frequency: FloatArray
    vectors: ComplexArray
    covariance: ComplexArray
    channels: tuple[Channel, ...]
    runs: tuple[str, ...]
    _: KW_ONLY
    covariance_dof: float = field(default=math.inf, metadata={"null": math.inf})
    line_correlation: tuple[complex, ...] = ()
    factors: tuple[UncertainFactor, ...] = ()
    blocks: Blocks | None = None
    name: str = ""
    findings: tuple[Finding, ...] = ()
    conditions: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n_line, n_run, n = np.size(self.frequency), len(self.runs), len(self.channels)
        freeze(self, "frequency", np.float64, (n_line,))
        if n_line > 1 and np.any(np.diff(self.frequency) <= 0):
            raise DataError(f"the frequencies of '{self.name}' do not increase")
        freeze(self, "vectors", np.complex128, (n_line, n_run, n))
        freeze(self, "covariance", np.complex128, (n_line, n_run, n, n))

    def columns(self, quantity: str, role: str = "") -> list[int]:
        """Numbers of the channels of a quantity, of one role if it is given."""
        return [
            number
            for number, channel in enumerate(self.channels)
            if channel.quantity == quantity and (not role or channel.role == role)
        ]


# Free decays: what a structure does that is left to itself, cut out of recordings.


@dataclass(frozen=True)
class FreeDecay:
    """One decay: *samples* (n_sample, n_output) [SI units of the outputs] of *recording* from *start* [s]
    on.
    """

    recording: str
    start: float
    samples: FloatArray

    def __post_init__(self) -> None:
        freeze(self, "samples", np.float64, np.shape(self.samples), f"decay of '{self.recording}'")


@dataclass(frozen=True)
class FreeDecays:
    """The free decays of one test at one *sample_rate* [Hz]; *units* of the outputs [SI].

    All hits and recordings share the modes.
    """

    sample_rate: float
    outputs: tuple[Port, ...]
    units: tuple[str, ...]
    decays: tuple[FreeDecay, ...]
    _: KW_ONLY
    name: str = ""
    findings: tuple[Finding, ...] = ()
    conditions: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.decays:
            raise DataError(f"'{self.name}' holds no free decay")
        for decay in self.decays:
            if decay.samples.shape[1] != len(self.outputs):
                raise DataError(
                    f"a decay of '{decay.recording}' has {decay.samples.shape[1]} outputs, "
                    f"{len(self.outputs)} are needed"
                )
