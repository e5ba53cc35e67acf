"""Systematic doubts: a number of the rig that is known with a standard uncertainty, the same error in all that rests on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from labpipe.arrays import ComplexArray
from labpipe.records.arrays import frozen_array
from labpipe.records.uncertain import Uncertain

# What the number of a channel does to it: size and sign, delay of its chain, phase, direction.
EFFECTS = {"gain": "1", "delay": "s", "phase": "rad", "direction": "rad"}

# Relative change of a channel's amplitude X by a unit of the error d of its chain, a w^n as (a, n): X (1 - d), X e^{+jwd}, X e^{+jd}.
COURSES: dict[str, tuple[complex, int]] = {"gain": (-1.0, 0), "delay": (1j, 1), "phase": (1j, 0)}


@dataclass(frozen=True)
class Doubt:
    """Standard uncertainty of one number [unit]; numbers of one *source* have one error in common.

    dof: degrees of freedom behind it, None where it is known; shape: its distribution (normal, rectangular, triangular).
    """

    source: str
    std_error: float
    unit: str
    dof: float | None = None
    shape: str = "normal"


def doubt_of(number: Uncertain, source: str, unit: str, scale: float = 1.0) -> Doubt:
    """The doubt of a number times *scale* [-]; its own source, if it names one, takes the place of *source*."""
    return Doubt(number.source or source, scale * number.std_error, unit, number.dof, number.shape)


@dataclass(frozen=True)
class ChannelDoubt:
    """Doubt of a channel's calibration. *effect*: 'gain' (relative), 'delay' [s], 'phase' [rad] or 'direction' [rad].

    The error d of the number changes the channel's amplitude X [SI] to X (1 - d), X e^{+jwd}, X e^{+jd}; a direction turns the channel.
    """

    effect: str
    doubt: Doubt


@dataclass(frozen=True)
class MatrixError:
    """What an error that no single channel carries does to a measured matrix: a number in a sum of channels.

    *change* (n_frequency, n_output, n_input) complex [unit of the matrix]: by one standard uncertainty of the *doubt*.
    """

    doubt: Doubt
    change: ComplexArray

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "change", frozen_array(self.change, np.complex128, f"change by {self.doubt.source}", np.shape(self.change))
        )


def as_doubts(entries: Any) -> tuple[ChannelDoubt, ...]:
    """The doubts of a channel, as they are or from the mappings of a file."""
    return tuple(entry if isinstance(entry, ChannelDoubt) else ChannelDoubt(entry["effect"], Doubt(**entry["doubt"])) for entry in entries)
