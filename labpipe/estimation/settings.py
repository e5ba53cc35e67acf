"""Settings of one fit, the kinds of models and the tables of models and estimators.

Every kind is looked at when a pipeline is read, so the modules of the kinds import no code that fits: their
functions do, when called.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, Any

from labpipe.errors import ConfigError, SettingError
from labpipe.estimation.estimators import Estimator
from labpipe.records.identification import Fit
from labpipe.records.settings import (
    ESTIMATE,
    Settings,
    Uncertainties,
    choice,
    flag,
    integer,
    names,
    quantity,
    section,
    setting,
)
from labpipe.records.uncertain import RepeatSource, Uncertain
from labpipe.registry import Registry
from labpipe.spectra.settings import DECAYS, RESPONSES, SPECTRA

if TYPE_CHECKING:
    from labpipe.estimation.model import DynamicModel, Setup
    from labpipe.records.response import FrequencyResponse

# Keys of a fit that every model takes.
EVERY = ("model", "estimator", "band", "coverage", "test")
# Keys that every model linear in its parameters takes besides.
LINEAR = (
    *("mass", "input", "output", "bands", "sliding", "subtract", "share", "eliminate", "fixed", "weight"),
    *("bootstrap", "monte_carlo", "compare", "repeats", "repeat_groups"),
)


@dataclass(frozen=True)
class ModelKind:
    """How fits of a model are made, and what is true of it.

    fit: the fits of what the model is *of*, a response, free decays or spectra; one per band or peak.
    section: key of the model's own *settings*, and an *example*, *optional* where all have defaults. earlier:
    name of the fit whose result this one begins with; begin: the settings with that result among *fits*;
    check_after: ConfigError where these contradict the settings of that fit.

    keys: those of a fit, besides EVERY, that change what is computed; all others are refused; by_likelihood:
    those that only an estimator by likelihood takes. estimators that fit it; empty: any. equations of a model
    linear in its parameters, from ports and settings.

    one_frf: k, c and m of one FRF. one_mode: of a mass on a spring, with f_n and zeta. matrix_modes: the
    modes of its K, C and M are derived. one_direction: uncoupled stiffness and damping for each direction.
    of_base: its input is the motion of a base; any_input: no force is needed. own_damping: every mode has one
    damping. frees_mass: a given mass can as well be estimated. richer, simpler: models to compare with.
    """

    fit: Callable[[Any, FitSettings], tuple[Fit, ...]]
    section: str = ""
    settings: type | None = None
    example: str = ""
    optional: bool = False
    earlier: Callable[[FitSettings], str] = lambda _settings: ""
    begin: Callable[[FitSettings, Sequence[Fit]], FitSettings] = lambda settings, _fits: settings
    check_after: Callable[[FitSettings, FitSettings], None] = lambda _settings, _earlier: None
    of_repeat: Callable[[FitSettings, Sequence[Fit]], FitSettings] = lambda settings, _fits: settings
    of: str = RESPONSES
    keys: tuple[str, ...] = ("mass", "input", "output", "bands")
    by_likelihood: tuple[str, ...] = ()
    estimators: tuple[str, ...] = ()
    equations: Callable[[Setup], DynamicModel] | None = None
    one_frf: bool = False
    one_mode: bool = False
    matrix_modes: bool = False
    one_direction: bool = False
    of_base: bool = False
    any_input: bool = False
    own_damping: bool = False
    frees_mass: bool = False
    richer: str = ""
    simpler: str = ""

    def model(self, setup: Setup) -> DynamicModel:
        """The equations of a model linear in its parameters for these ports and settings."""
        assert self.equations is not None
        return self.equations(setup)


def linear_kind(equations: Callable[[Setup], DynamicModel], *more: str, **properties: Any) -> ModelKind:
    """The kind of a model linear in its parameters; *more*: keys beyond LINEAR that it takes."""
    return ModelKind(_fit_linear, keys=(*LINEAR, *more), equations=equations, **properties)


def _fit_linear(response: FrequencyResponse, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.estimation.fitting import fit_linear

    return fit_linear(response, settings)


# Settings of one fit: from a response to parameters with uncertainties.

# ModelKinds, or, of plug-ins, functions from the setup of a fit (ports, mass) to a model linear in its
# parameters.
MODELS = Registry("model")
# Estimators, or, of plug-ins, functions from a measured FRF, a model and the weight of lines to an Estimate.
ESTIMATORS = Registry("estimator")
WEIGHTS = ("none", "noise")
# Draws that give a 95 % interval.
FEWEST = {"bootstrap": 50, "monte_carlo": 200}
# Laws that put factors in place of the damping coefficients, which are `viscous`.
VISCOUS = "viscous"
DAMPINGS = Registry("damping law")

Mass = float | tuple[float, ...] | tuple[tuple[float, ...], ...] | str


@dataclass(frozen=True)
class Sliding(Settings):
    """The fit is repeated in a band of *width* moved by *step*."""

    width: float = quantity("width of one band", "Hz")
    step: float = quantity("distance between the centres of neighbouring bands", "Hz")

    def __post_init__(self) -> None:
        self.require_positive("width", "step")


@dataclass(frozen=True)
class Support(Settings):
    """Stiffness and damping of the support, subtracted from the direct coefficients. Their uncertainties are
    sources of the budget.
    """

    stiffness: Uncertain = setting("uncertain", "stiffness of the support", "N/m", Uncertain(0.0))
    damping: Uncertain = setting("uncertain", "damping of the support", "N.s/m", Uncertain(0.0))


@dataclass(frozen=True)
class FitSettings(Settings):
    """One fit of the pipeline's ``identify:`` section; *name* is its key there, *model_settings*: of the
    section that its model has. *between*: scatter between repeats of a test, from the section
    ``uncertainty:``. *judged*: whether what the residual shows beyond noise is in values and intervals.
    """

    model: str = choice("what is identified", tuple(MODELS))
    _: KW_ONLY
    mass: Mass = setting("mass", "mass that moves with the response, or `estimate`", "kg", ESTIMATE)
    estimator: str = choice("how it is estimated", tuple(ESTIMATORS), "ml")
    input: tuple[str, ...] = names("force channel(s); default: all")
    output: tuple[str, ...] = names("response channel(s); default: all the model takes")
    band: tuple[float, float] | None = setting("band", "frequencies used; default: all", "Hz", None)
    bands: tuple[tuple[float, float], ...] = setting("bands", "several bands, one fit for each", "Hz", ())
    peaks: tuple[tuple[str, tuple[tuple[float, float], ...]], ...] = setting(
        "peaks", "bands of chosen peaks of the diagonal terms, by dof; one fit for each", "Hz", ()
    )
    sliding: Sliding | None = section("repeat the fit in sliding bands", Sliding, None)
    subtract: Support | None = section("support to subtract", Support, None)
    share: int = integer("equal bearings in parallel that share the load", 1)
    eliminate: bool = flag("drop insignificant parameters one by one")
    symmetric: bool = flag("K, C and M are symmetric")
    lumped_mass: bool = flag("with mass: estimate: the mass matrix is diagonal")
    scale_mass: bool = flag("the given mass is known but for a factor, which is estimated")
    residuals: bool = flag(
        "with mass: estimate: a constant beside the mode for those outside the band; modal: one for those "
        "below and one for those above it, no more"
    )
    relative: bool = flag("the response is measured relative to the base")
    damping: str = choice(
        "viscous; proportional: C = alpha M + beta K; hysteretic: K (1 + j eta), eta the loss factor",
        (VISCOUS, *DAMPINGS),
        VISCOUS,
    )
    fixed: tuple[tuple[str, float], ...] = setting(
        "coefficients", "coefficients that are given, by name", default=(), may_be_empty=True
    )
    tied: tuple[tuple[str, ...], ...] = setting(
        "groups", "lists of coefficients that have one value", default=()
    )
    weight: str = choice(
        "all lines weigh alike, or by their noise (as they always do for ml)", WEIGHTS, "none"
    )
    bootstrap: int = integer("repeats of the fit on resampled noise, for intervals beyond first order", 0)
    coverage: float = quantity("probability of expanded uncertainties", "1", 0.95)
    monte_carlo: int = integer(
        "draws of noise and of all numbers with an uncertainty, as a check of the budget", 0
    )
    compare: bool = flag("compare the model with simpler and richer ones")
    test: tuple[str, ...] = names("tests that are fitted; default: all")
    repeats: str = choice(
        "several recordings of one test: each fitted, and their mean; or pool, one fit of all",
        ("each", "pool"),
        "each",
    )
    repeat_groups: tuple[str, ...] = names(
        "days, mountings: the names of the recordings of each, as patterns; a group is one repeat"
    )
    name: str = ""
    model_settings: Any = None
    uncertainties: Uncertainties = ()
    between: tuple[RepeatSource, ...] = ()
    judged: bool = True

    def __post_init__(self) -> None:
        self._check_keys()
        self._check_bands()
        self._check_combinations()
        kind = self.kind
        if kind.settings is None and self.model_settings is not None:
            what = f"model {self.model} has no settings of its own"
            raise ConfigError(what, hint="leave model_settings out")
        section = {} if kind.optional and self.model_settings is None else self.model_settings
        if kind.settings is not None and isinstance(section, dict):
            object.__setattr__(self, "model_settings", kind.settings(**section))
        if kind.settings is not None and not isinstance(self.model_settings, kind.settings):
            raise ConfigError(f"model {self.model} needs the section '{kind.section}'", hint=kind.example)

    @property
    def kind(self) -> ModelKind:
        """The ModelKind of the settings' model; ConfigError for an unknown model."""
        return model_kind(self.model)

    @property
    def estimates(self) -> Estimator:
        """The Estimator of that name; ConfigError for an unknown one."""
        return estimator_of(self.estimator)

    @property
    def frees_mass(self) -> bool:
        """Whether the mass of one oscillator is estimated: neither given nor among the fixed coefficients."""
        return self.mass == ESTIMATE and "m" not in dict(self.fixed)

    def _check_keys(self) -> None:
        kind = self.kind
        every = {name: estimator_of(name) for name in ESTIMATORS}
        able = kind.estimators or [name for name, by in every.items() if kind.one_frf or not by.one_frf]
        if self.estimator not in able:
            what = f"{self.estimator} does not estimate model {self.model}"
            raise SettingError("estimator", what, f"estimator: {_alternatives_text(able)}")
        for key in self.written:
            if key not in (*EVERY, *kind.keys):
                hint = f"leave it out; models that take it: {', '.join(takers(key))}"
                raise SettingError(key, f"'{key}' is not for model {self.model}", hint)
            others = [
                name
                for name in able
                if key not in every[name].refuses
                and (every[name].likelihood or key not in kind.by_likelihood)
            ]
            if self.estimator not in others:
                hint = (
                    f"leave it out, or estimator: {_alternatives_text(others)}" if others else "leave it out"
                )
                raise SettingError(key, f"'{key}' is not for estimator {self.estimator}", hint)

    def _check_combinations(self) -> None:
        law, free_mass = self.damping != VISCOUS, self.mass == ESTIMATE
        either = "leave one of them out"
        what, is_pool = "'repeat_groups' needs every recording fitted alone", self.repeats == "pool"
        _refuse(self.repeat_groups and is_pool, "repeat_groups", what, "leave out repeats: pool")
        what = "one group does not show what groups scatter by"
        hint = "for example [mon-*, tue-*, wed-*]"
        _refuse(len(self.repeat_groups) == 1, "repeat_groups", what, hint)
        self.require_share("coverage")
        for key, fewest in FEWEST.items():
            what = f"'{key}' of {getattr(self, key)} draws gives no 95 % interval"
            _refuse(
                0 < getattr(self, key) < fewest, key, what, f"at least {fewest}; several times that is usual"
            )
        several = law and self.kind.own_damping and DAMPINGS.load(self.damping).fewest > 1
        every = f"every mode of model {self.model} has its own"
        what = f"{self.damping} damping is of several coefficients, {every}"
        _refuse(several, "damping", what, "leave it out")
        what = f"'eliminate' cannot be combined with {self.damping} damping"
        _refuse(law and self.eliminate, "eliminate", what, either)
        of_both = "whose factor is that of bearing and support together"
        what = f"'subtract' cannot be combined with {self.damping} damping, {of_both}"
        not_viscous = self.subtract and law and not DAMPINGS.load(self.damping).viscous
        _refuse(not_viscous, "subtract", what, either)
        _refuse(self.share < 1, "share", "'share' must be at least 1")
        what = "'scale_mass' needs the mass to be scaled"
        _refuse(self.scale_mass and free_mass, "scale_mass", what, "for example mass: [1 kg, 2 kg]")
        for key in ("lumped_mass", "residuals"):
            what = f"'{key}' is for a mass that is estimated"
            _refuse(getattr(self, key) and not free_mass, key, what, "mass: estimate")
        others = {"damping": law, "fixed": self.fixed, "eliminate": self.eliminate}
        of_mass = {"subtract": self.subtract, "share": self.share != 1}
        for key, there in (others | of_mass).items():
            what = f"'residuals' cannot be combined with '{key}'"
            _refuse(self.residuals and there, "residuals", what, either)
        for key, there in of_mass.items():
            what = f"'{key}' needs the mass: without it a transmissibility gives no stiffness"
            _refuse(self.kind.of_base and free_mass and there, key, what, "for example mass: 0.92 kg")

    def _check_bands(self) -> None:
        what = "'bands' goes with neither 'band' nor 'sliding'"
        _refuse(self.bands and (self.band or self.sliding), "bands", what, "name all bands under bands")
        hint = "leave out band, bands, sliding, input and output"
        twice = self.peaks and (self.band or self.bands or self.sliding or self.input or self.output)
        _refuse(twice, "peaks", "'peaks' names bands and ports by itself", hint)


def _refuse(wrong: object, field: str, what: str, hint: str = "") -> None:
    if wrong:
        raise SettingError(field, what, hint)


# What a model needs, in words, and how a pipeline measures that; the model that is of it.
_NEEDED = {
    RESPONSES: ("an FRF", "frf: {excitation: periodic}"),
    DECAYS: ("free decays", "frf: {excitation: decay}"),
    SPECTRA: ("spectra of all channels", "frf: {result: spectra}"),
}
_MODEL_OF = {DECAYS: "decay", SPECTRA: "dynamic-stiffness or magnet"}


def check_kind(settings: FitSettings, measured: str) -> None:
    """ConfigError where a model is not of what was *measured*: responses, decays or spectra."""
    of = settings.kind.of
    if of == measured:
        return
    (needed, hint), there = _NEEDED[of], _NEEDED[measured][0]
    what = f"model {settings.model} needs {needed}, not {there}"
    if of == RESPONSES:
        what = f"model {settings.model} needs {needed}, {there} have none"
        hint = f"model: {_MODEL_OF[measured]}"
    raise SettingError("model", what, hint)


def model_kind(name: str) -> ModelKind:
    """The kind of that name; of a plug-in's function, that of a model linear in its parameters."""
    entry = MODELS.load(name)
    return entry if isinstance(entry, ModelKind) else linear_kind(entry, "tied", "damping")


def estimator_of(name: str) -> Estimator:
    """The estimator of that name; a plug-in's function counts as one with the defaults."""
    entry = ESTIMATORS.load(name)
    return entry if isinstance(entry, Estimator) else Estimator(entry)


def takers(key: str) -> tuple[str, ...]:
    """The models that take a key of a fit."""
    return tuple(name for name in MODELS if key in (*EVERY, *model_kind(name).keys))


def models_text(key: str) -> str:
    """Which models take a key of a fit, as a help says it; empty where all do."""
    able = takers(key)
    return "" if len(able) == len(tuple(MODELS)) else f" (models {', '.join(able)})"


def _alternatives_text(names: Sequence[str]) -> str:
    return " or ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)
