"""Kinds of bearings. BEARINGS by name: what a file holds, its coefficients with their uncertainty, how it
stands on a rotor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray, freeze
from labpipe.errors import ConfigError, SettingError
from labpipe.records.finding import Finding
from labpipe.records.response import FrequencyResponse
from labpipe.records.settings import Settings, choice, quantity, text
from labpipe.records.uncertain import Uncertainty
from labpipe.registry import Registry

TILTS = ("bx", "by", "bz")


@dataclass(frozen=True)
class Amount:
    """A number of the equilibrium: its name, its value in the SI unit, and that unit."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class PressureField:
    """Pressure of an oil film against ambient (n_theta, n_axial) [Pa], over the angle from +y to +z [rad] and
    from mid width [m].

    thickness (n_theta,) [m]: of the film.
    """

    theta: FloatArray
    axial: FloatArray
    pressure: FloatArray
    thickness: FloatArray


@dataclass(frozen=True)
class BearingCoefficients:
    """Stiffness and damping (n_dof, n_dof): force in the row's dof per displacement or velocity in the
    column's [SI units].

    rest: equilibrium position; element_state: arrays per rolling element by name; lowest, highest: stiffness
    over one ball passage (rolling bearings); notes: further numbers of the model; shaft: results of the rigid
    shaft on the bearing, if the file describes one; shares: contribution of each element of a control loop to
    the direct coefficients; poles: of the closed loop [rad/s]; words: verdicts by name; film: pressure of an
    oil film (journal bearings).
    """

    dofs: tuple[str, ...]
    stiffness: FloatArray
    damping: FloatArray
    rest: tuple[Amount, ...] = ()
    _: KW_ONLY
    element_state: Mapping[str, FloatArray] = field(default_factory=dict)
    lowest: FloatArray | None = None
    highest: FloatArray | None = None
    notes: tuple[Amount, ...] = ()
    shaft: tuple[Amount, ...] = ()
    findings: tuple[Finding, ...] = ()
    shares: tuple[Amount, ...] = ()
    poles: ComplexArray | None = None
    words: Mapping[str, str] = field(default_factory=dict)
    film: PressureField | None = None

    def __post_init__(self) -> None:
        n = len(self.dofs)
        for name in ("stiffness", "damping", "lowest", "highest"):
            freeze(self, name, np.float64, (n, n))

    def unit(self, row: int, column: int, of: str = "stiffness") -> str:
        """Unit of a stiffness coefficient: N/m, N/rad (force per tilt, the same as moment per displacement
        N.m/m) or N.m/rad; *of* damping N.s/m, N.s/rad or N.m.s/rad.
        """
        tilts = (self.dofs[row] in TILTS) + (self.dofs[column] in TILTS)
        unit = ("N/m", "N/rad", "N.m/rad")[tilts]
        return unit.replace("/", ".s/") if of == "damping" else unit

    @property
    def relative(self) -> FloatArray:
        """Relative coupling K_ij / sqrt(|K_ii K_jj|), (n_dof, n_dof) [1]; zero beside a diagonal of zero."""
        diagonal = np.sqrt(np.abs(np.diag(self.stiffness)))
        scale = np.outer(diagonal, diagonal)
        relative: FloatArray = np.divide(self.stiffness, scale, out=np.zeros_like(scale), where=scale > 0)
        return relative

    def lateral(self, y: str, z: str) -> BearingCoefficients:
        """The coefficients of the dofs *y* and *z* alone, (2, 2), the other dofs held."""
        places = np.ix_(*[[self.dofs.index(y), self.dofs.index(z)]] * 2)
        return BearingCoefficients(
            ("y", "z"), self.stiffness[places], self.damping[places], findings=self.findings
        )


BEARINGS = Registry("bearing")


@dataclass(frozen=True)
class OperatingPoint:
    """What a rotor asks of a bearing: static *load* on the journal in y and z [N], *speed* and *frequency* of
    the motion [rad/s].
    """

    load: tuple[float, float]
    speed: float
    frequency: float


class Bearing(Protocol):
    """A bearing on a rotor, whose load and speed follow from the rotor."""

    def at(self, point: OperatingPoint) -> BearingCoefficients:
        """Lateral coefficients (2, 2) in y and z [N/m, N.s/m] with their findings. LabpipeError where there
        is not an equilibrium.
        """
        ...


@dataclass(frozen=True)
class BearingKind:
    """A kind of bearing: the *settings* of its file, and the *coefficients* of any number of such settings (a
    sweep).

    bare_units: units of entries that may stand as plain numbers. response: the theoretical frequency response
    of settings with their coefficients, None where the file describes no shaft. figures: (name, coefficients)
    -> figures of its own by the names of their SVG files. On a rotor: *operating* gives the entries of the
    settings that follow from the rotor there, and *lateral* names the dofs that are the rotor's y and z. A
    kind that needs more on a rotor has its own settings there, *on_rotor*, and *mount*, from these to a
    Bearing. dynamic: of a kind whose coefficients follow the frequency of the motion, K + j w C (n, 2, 2)
    [N/m] of settings at frequencies w (n,) [rad/s].
    """

    settings: type
    coefficients: Callable[[Sequence[Any]], list[BearingCoefficients]]
    _: KW_ONLY
    bare_units: Mapping[str, str] = field(default_factory=dict)
    response: Callable[[Any, BearingCoefficients], FrequencyResponse | None] | None = None
    operating: Mapping[str, Callable[[OperatingPoint], float]] = field(default_factory=dict)
    lateral: tuple[str, str] = ("y", "z")
    on_rotor: type | None = None
    figures: Callable[[str, BearingCoefficients], Mapping[str, Any]] | None = None
    mount: Callable[[Any], Bearing] | None = None
    dynamic: Callable[[Any, FloatArray], ComplexArray] | None = None

    def make(self, settings: Any) -> Bearing:
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


def entry_of_rotor_error(entry: str) -> ConfigError:
    """The fault of an entry of a rotor's bearing that follows from the rotor."""
    return SettingError(entry.partition(".")[0], f"{entry}: follows from the rotor", "leave it out")


@dataclass(frozen=True)
class BearingUncertainties:
    """Changes of the coefficients by one standard uncertainty of each of the *sources*, with their signs.

    stiffness, damping (n_source, n_dof, n_dof) [SI units of the coefficients]; rest (n_source, n_amount): of
    the amounts at rest.
    """

    sources: tuple[Uncertainty, ...]
    stiffness: FloatArray
    damping: FloatArray
    rest: FloatArray

    def error(self, of: str) -> FloatArray:
        """Standard uncertainty of the stiffness, the damping or the amounts at rest by all independent
        sources, (n_dof, n_dof) or (n_amount,) [unit of each].
        """
        return np.sqrt(np.sum(getattr(self, of) ** 2, axis=0))

    def shares(self, changes: FloatArray) -> list[tuple[str, float]]:
        """Shares in the variance of one amount, the largest first; *changes* (n_source,) [its unit]."""
        whole = float(np.sum(changes**2))
        if not whole:
            return []
        names = [source.source for source in self.sources]
        return sorted(zip(names, (changes**2 / whole).tolist(), strict=True), key=lambda pair: -pair[1])


def bearing_uncertainties(
    sources: Sequence[Uncertainty], ends: Sequence[tuple[BearingCoefficients, BearingCoefficients]]
) -> BearingUncertainties:
    """Half the difference of the coefficients with every number one standard uncertainty above and below its
    value (GUM 5.1.3, note 2). *ends*: those two for each of *sources*; numbers of one source change together,
    so that their changes add up with their signs. Equation (unc-bearing).
    """
    names = list(dict.fromkeys(source.source for source in sources))
    first = {source.source: source for source in reversed(sources)}

    def changes(values: Sequence[FloatArray]) -> FloatArray:
        return np.array(
            [
                sum(change for source, change in zip(sources, values, strict=True) if source.source == name)
                for name in names
            ]
        )

    return BearingUncertainties(
        tuple(first[name] for name in names),
        changes([(high.stiffness - low.stiffness) / 2 for high, low in ends]),
        changes([(high.damping - low.damping) / 2 for high, low in ends]),
        changes([(_rest(high) - _rest(low)) / 2 for high, low in ends]),
    )


def _rest(coefficients: BearingCoefficients) -> FloatArray:
    return np.array([amount.value for amount in coefficients.rest])


@dataclass(frozen=True, kw_only=True)
class LinearBearingSettings(Settings):
    """A bearing of constant coefficients, as a test or a supplier states them; y horizontal,
    z up, `k_yz` = force in y per displacement in z.
    """

    kind: str = choice("which bearing", ("linear-bearing",))
    name: str = text("name of the bearing")
    k_yy: float = quantity("stiffness in y", "N/m")
    k_zz: float | None = quantity("stiffness in z; default: k_yy", "N/m", None)
    k_yz: float = quantity("cross-coupled stiffness", "N/m", 0.0)
    k_zy: float = quantity("cross-coupled stiffness", "N/m", 0.0)
    k_cross: float | None = quantity(
        "cross-coupled stiffness of a seal, k_yz = -k_zy; above zero it drives forward whirl", "N/m", None
    )
    c: float | None = quantity("damping in y and z alike", "N.s/m", None)
    c_yy: float = quantity("damping in y", "N.s/m", 0.0)
    c_zz: float = quantity("damping in z", "N.s/m", 0.0)
    c_yz: float = quantity("cross-coupled damping", "N.s/m", 0.0)
    c_zy: float = quantity("cross-coupled damping", "N.s/m", 0.0)

    def __post_init__(self) -> None:
        if self.c is not None and (self.c_yy or self.c_zz):
            raise SettingError("c", "'c' is damping in both directions", "c, or c_yy and c_zz")
        if self.k_cross is not None and (self.k_yz or self.k_zy):
            raise SettingError("k_cross", "'k_cross' is k_yz and -k_zy", "k_cross, or k_yz and k_zy")

    @property
    def stiffness(self) -> FloatArray:
        """(2, 2) [N/m]."""
        k_yz, k_zy = (self.k_yz, self.k_zy) if self.k_cross is None else (self.k_cross, -self.k_cross)
        return np.array([[self.k_yy, k_yz], [k_zy, self.k_yy if self.k_zz is None else self.k_zz]])

    @property
    def damping(self) -> FloatArray:
        """(2, 2) [N s/m]."""
        diagonal = (self.c_yy, self.c_zz) if self.c is None else (self.c, self.c)
        return np.array([[diagonal[0], self.c_yz], [self.c_zy, diagonal[1]]])


LINEAR = BearingKind(
    LinearBearingSettings,
    lambda each: [BearingCoefficients(("y", "z"), stated.stiffness, stated.damping) for stated in each],
)
