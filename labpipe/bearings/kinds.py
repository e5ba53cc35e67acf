"""Kinds of bearings. BEARINGS by name: what a file of the kind holds, its coefficients, and how it stands on a rotor."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from labpipe.bearings.coefficients import BearingCoefficients
from labpipe.errors import ConfigError
from labpipe.records.response import FrequencyResponse
from labpipe.registry import Registry

BEARINGS = Registry(
    "bearing",
    {
        "ball-bearing": "labpipe.bearings.rolling_kinds:BALL",
        "roller-bearing": "labpipe.bearings.rolling_kinds:ROLLER",
        "journal-bearing": "labpipe.bearings.journal_kind:JOURNAL_KIND",
        "magnetic-bearing": "labpipe.bearings.magnetic_kind:MAGNETIC_KIND",
    },
)


@dataclass(frozen=True)
class OperatingPoint:
    """What a rotor asks of a bearing: static *load* on the journal in y and z [N], *speed* and *frequency* of the motion [rad/s]."""

    load: tuple[float, float]
    speed: float
    frequency: float


class Bearing(Protocol):
    """A bearing on a rotor, whose load and speed follow from the rotor."""

    def at(self, point: OperatingPoint) -> BearingCoefficients:
        """Lateral coefficients (2, 2) in y and z [N/m, N.s/m] with their findings; LabpipeError where there is no equilibrium."""
        ...


@dataclass(frozen=True)
class BearingKind:
    """A kind of bearing: the *settings* of its file, and the *coefficients* of any number of such settings (a sweep).

    bare_units: units of entries that may stand as plain numbers. response: the theoretical frequency response of settings with their
    coefficients, None where the file describes no shaft. On a rotor: *operating* gives the entries of the settings that follow from the
    rotor there, and *lateral* names the dofs that are the rotor's y and z. A kind that needs more on a rotor has its own settings there,
    *on_rotor*, and *mount*, from these to a Bearing.
    """

    settings: type
    coefficients: Callable[[Sequence[Any]], list[BearingCoefficients]]
    _: KW_ONLY
    bare_units: Mapping[str, str] = field(default_factory=dict)
    response: Callable[[Any, BearingCoefficients], FrequencyResponse | None] | None = None
    operating: Mapping[str, Callable[[OperatingPoint], float]] = field(default_factory=dict)
    lateral: tuple[str, str] = ("y", "z")
    on_rotor: type | None = None
    mount: Callable[[Any], Bearing] | None = None

    def mounted(self, settings: Any) -> Bearing:
        """The bearing of a rotor file's entry."""
        return MountedBearing(self, settings) if self.mount is None else self.mount(settings)


@dataclass(frozen=True)
class MountedBearing:
    """A bearing whose settings take load, speed and frequency from the rotor."""

    kind: BearingKind = field(metadata={"entry": False})
    settings: Any

    def at(self, point: OperatingPoint) -> BearingCoefficients:
        """Lateral coefficients (2, 2) in y and z [N/m, N.s/m] at an operating point."""
        entries = {name: follows(point) for name, follows in self.kind.operating.items()}
        (coefficients,) = self.kind.coefficients([replace(self.settings, **entries)])
        return coefficients.lateral(*self.kind.lateral)


def synchronous(point: OperatingPoint) -> float:
    """Speed of an operating point [Hz]."""
    return point.speed / (2 * np.pi)


def frequency_hz(point: OperatingPoint) -> float:
    """Frequency of the motion at an operating point [Hz]."""
    return point.frequency / (2 * np.pi)


def not_on_rotor(entry: str) -> ConfigError:
    """The fault of an entry of a rotor's bearing that follows from the rotor."""
    return ConfigError(f"{entry}: follows from the rotor", hint="leave it out", field=entry.partition(".")[0])
