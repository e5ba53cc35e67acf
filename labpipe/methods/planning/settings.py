"""The ``plan:`` section of a plan file, and the table of what can be planned."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import KW_ONLY, dataclass
from typing import Any

from labpipe.errors import ConfigError, SettingError
from labpipe.methods.planning.campaigns import SCHEMES
from labpipe.methods.planning.designs import CRITERIA, MINIMAX
from labpipe.methods.planning.model import FLOATING, axes_of_model, excitable_models, is_floating
from labpipe.methods.rotor.rig import RotorRig
from labpipe.records.rig import Rig
from labpipe.records.settings import Settings, Uncertainties, choice, names, quantity, section, setting, text
from labpipe.registry import Registry

# What else can be planned than the excitation of a model linear in its coefficients.
PLANS = Registry("plan")


@dataclass(frozen=True)
class PlanKind:
    """*settings*: of the section `plan:`; *files*: (PlanFile, OutputFolder) -> sentences, names of files."""

    settings: type[Any]
    files: Callable[[Any, Any], tuple[list[str], list[str]]]


def plan_kinds() -> dict[str, PlanKind]:
    """What can be planned, by the model that will be identified."""
    from labpipe.methods.planning.excitation import EXCITATION

    excited = dict.fromkeys(excitable_models(), EXCITATION)
    return {**excited, FLOATING: EXCITATION, **{name: PLANS.load(name) for name in PLANS}}


BEST = "best"
# Behind the name of a coefficient: of its expanded uncertainty, as in rules.
EXPANDED = ".expanded"


@dataclass(frozen=True)
class NoiseSettings(Settings):
    """Standard deviations of the sensors' noise per sample, at the sampling rate of the plan."""

    force: float = quantity("of the force", "N", 0.0)
    displacement: float = quantity("of the displacement", "m", 0.0)
    acceleration: float = quantity("of the acceleration", "m/s^2", 0.0)


@dataclass(frozen=True)
class DensitySettings(Settings):
    """One-sided densities of the sensors' noise."""

    force: float = quantity("of the force", "N/Hz^0.5", 0.0)
    displacement: float = quantity("of the displacement", "m/Hz^0.5", 0.0)
    acceleration: float = quantity("of the acceleration", "m/(s^2.Hz^0.5)", 0.0)


def criterion_setting() -> Any:
    help = "least largest error, sum of squares, or volume"
    return choice(help, CRITERIA, MINIMAX)


def check_relative(goals: Iterable[tuple[str, tuple[float, ...]]]) -> None:
    """ConfigError for a goal that is not one positive relative error."""
    for name, values in goals:
        if len(values) != 1 or values[0] <= 0:
            what = f"the goal of {name} is one positive relative error"
            raise SettingError("goal", what, f"{name}: 2 %")


def check_distinct(settings: Any, *fields: str) -> None:
    """ConfigError for a list of candidates that holds one twice."""
    for field in fields:
        values = getattr(settings, field)
        if len(set(values)) < len(values):
            raise SettingError(field, f"{field}: one appears twice", "candidates differ")


@dataclass(frozen=True)
class ExpectedTheorySettings(Settings):
    """A bearing whose theory is expected, by its file or on a rotor file's rotor; *rig*: of `rotor`."""

    bearing: str = setting(
        "file", "bearing file; its y and z are the plan's x and y", default="", file_kind="bearing"
    )
    load: float | None = quantity("in place of the bearing file's `load`", "N", None)
    speed: float | None = quantity("in place of the file's `speed`", "Hz", None)
    rotor: str = setting("file", "or a rotor file", default="", file_kind="rotor", into="rig")
    name: str = text("bearing of the rotor file; default: the last one")
    rig: RotorRig | None = None

    def __post_init__(self) -> None:
        if bool(self.bearing) == bool(self.rotor):
            hint = "{bearing: FILE, load: 2 kN, speed: 3000 rpm}"
            raise ConfigError("a bearing file or a rotor file is needed", hint=hint)
        if self.rotor and self.load is not None:
            raise SettingError("load", "the load follows from the rotor", "leave it out")
        self.require_positive("load", "speed")
        if self.rig is not None:
            self.rig.place(self.name)


@dataclass(frozen=True)
class SignalSettings(Settings):
    """What plans of shakers' signals have in common: their period and lines, and the noise of the sensors."""

    _: KW_ONLY
    period: float = quantity("length of one period; lines lie 1 / period apart", "s")
    sample_rate: float = quantity("of signals and recordings", "Hz")
    noise: NoiseSettings | None = section("noise of the sensors per sample", NoiseSettings, None)
    noise_density: DensitySettings | None = section("or its density", DensitySettings, None)
    criterion: str = criterion_setting()
    exclude: tuple[tuple[float, float], ...] = setting(
        "bands", "frequencies that are not excited", "Hz", (), may_be_empty=True
    )
    mains: float | None = quantity("mains frequency, whose multiples are left out", "Hz", None)


@dataclass(frozen=True)
class PlanSettings(SignalSettings):
    """What is to be determined, with which rig, within which limits. *axes*: directions of forces and
    responses, by default those that the typed coefficients need.
    """

    model: str = choice("what will be identified", (*excitable_models(), FLOATING))
    _: KW_ONLY
    band: tuple[float, float] = setting("band", "frequencies that may be excited", "Hz")
    duration: float = quantity("of all measured periods together", "s")
    force_limit: float = quantity("largest force of a shaker, 0-to-peak, also between samples", "N")
    displacement_limit: float | None = quantity(
        "largest in x or y, 0-to-peak, from rest to rest; default: none", "m", None
    )
    crest_factor: float | None = quantity("largest peak over rms of a force; default: any", "1", None)
    expected: tuple[tuple[str, float], ...] = setting("coefficients", "expected values, by name", default=())
    earlier: str = setting(
        "file", "identification.json whose values are expected where `expected` has none", default=""
    )
    fit: str = text("the fit of `earlier`; default: its only one")
    combine_earlier: bool = setting(
        "flag", "the earlier result counts: it and the new test are combined", default=False
    )
    theory: ExpectedTheorySettings | None = section(
        "bearing whose theory is expected where `expected` has no value; also expected: {bearing: FILE, ...}",
        ExpectedTheorySettings,
        None,
    )
    mass: float | None = quantity(
        "known mass that moves, e.g. 0.79 kg +- 5 g; of a floating stator", "kg", None
    )
    rig: str = setting(
        "file",
        "rig file of the recordings, whose uncertainties count; default: none, SI columns",
        default="",
        file_kind="rig",
        into="sensors",
    )
    goal: tuple[tuple[str, tuple[float, ...]], ...] = setting(
        "series",
        "relative standard errors by noise, or expanded: {k: 2 %, c.expanded: 3 %}; default: all alike",
        "1",
        (),
    )
    floor: float = quantity("share of the power on all lines alike, for a test of the model", "1", 0.2)
    shakers: tuple[str, ...] = names("directions of force: x, y, or angles such as 45 deg; default: x and y")
    scheme: str = choice("how two shakers run; default: what tells most", (BEST, *SCHEMES), BEST)
    speed: float | None = quantity(
        "speed of the shaft, whose 1x line and neighbours are left out", "Hz", None
    )
    skip: int | None = setting(
        "integer",
        "transient periods before the measured ones, in every test; default: until motion has died away",
        default=None,
    )
    uncertainties: Uncertainties = ()
    sensors: Rig | None = None
    axes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.axes:
            axes = axes_of_model(self.model, dict(self.expected), len(self.shakers))
            object.__setattr__(self, "axes", axes)
        self.require_positive("period", "sample_rate", "duration", "force_limit", "displacement_limit")
        self.require_positive("mass", "speed", "mains")
        if (self.noise is None) == (self.noise_density is None):
            hint = "noise: {force: 20 mN, displacement: 0.3 um}"
            raise SettingError("noise", "one of 'noise' and 'noise_density' is needed", hint)
        for name, _ in self.uncertainties:
            if name != "mass":
                what = f"an uncertainty of '{name}' is not planned with"
                raise SettingError(name, what, "the mass may carry one")
        self._check_expected()
        check_relative(self.goal)
        if 2 * self.band[1] >= self.sample_rate:
            what = f"{self.band[1]:g} Hz needs more than {2 * self.band[1]:g} Hz of sampling rate"
            raise SettingError("sample_rate", what)
        n_sample = self.sample_rate * self.period
        if abs(n_sample - round(n_sample)) > 1e-6:
            what = "a period holds no whole number of samples"
            raise SettingError("period", what, "change `period` or `sample_rate`")

    @property
    def floating(self) -> bool:
        return is_floating(self.model)

    def _check_expected(self) -> None:
        if not self.expected and not self.earlier and self.theory is None:
            hint = "expected: {k_xx: 180 kN/m, ...}, {bearing: FILE}, or earlier: identification.json"
            raise SettingError("expected", "nothing is expected", hint)
        if self.combine_earlier and not self.earlier:
            raise SettingError("combine_earlier", "there is no earlier result to combine", "earlier: FILE")
        if self.theory is not None and len(self.axes) == 1:
            hint = "state k and c of the pedestal under `expected`"
            raise SettingError("theory", "theory gives matrices", hint)
