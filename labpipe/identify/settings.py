"""Settings of one fit: from a response to parameters with uncertainties."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any

from labpipe.errors import ConfigError
from labpipe.identify.model_kinds import DECAYS, RESPONSES, SPECTRA, ModelKind
from labpipe.records.identification import Fit
from labpipe.records.repeat_source import RepeatSource
from labpipe.records.response import FrequencyResponse
from labpipe.records.setting_values import COEFFICIENT_UNITS as COEFFICIENT_UNITS
from labpipe.records.setting_values import ESTIMATE as ESTIMATE
from labpipe.records.settings import Doubts, Settings, Uncertain, setting
from labpipe.registry import Registry

# From the setup of a fit (ports, mass) to a model linear in its parameters, or a ModelKind with its own fit function.
MODELS = Registry(
    "model",
    {
        "sdof": "labpipe.identify.models:sdof",
        "rotor-2dof": "labpipe.identify.models:rotor_2dof",
        "rotor-2dof-direct": "labpipe.identify.models:rotor_2dof_direct",
        "mdof": "labpipe.identify.mdof:mdof",
        "base": "labpipe.identify.base_motion:base_excited",
        "modal": "labpipe.modal.model_kind:MODAL",
        "decay": "labpipe.decay.model_kind:DECAY",
        "dynamic-stiffness": "labpipe.dynamic_stiffness.model_kind:DYNAMIC_STIFFNESS",
        "magnet": "labpipe.magnet.model_kind:MAGNET",
        "block": "labpipe.magnet.model_kind:BLOCK",
        "worn-bearing": "labpipe.wear.model_kind:WORN_BEARING",
    },
)
# From a measured FRF, a model and the weight of lines to an Estimate.
ESTIMATORS = Registry(
    "estimator",
    {
        "ls": "labpipe.identify.regression:least_squares",
        "iv": "labpipe.identify.instrumental:instrumental_variables",
        "ml": "labpipe.identify.likelihood:maximum_likelihood",
        "amplitude": "labpipe.identify.amplitude:amplitude_fit",
    },
)
# The model whose input is the motion of a base.
BASE = "base"
WEIGHTS = ("none", "noise")
DAMPINGS = ("viscous", "proportional")

Mass = float | tuple[float, ...] | tuple[tuple[float, ...], ...] | str


@dataclass(frozen=True)
class Sliding(Settings):
    """The fit is repeated in a band of *width* moved by *step*."""

    width: float = setting("value", "width of one band", unit="Hz")
    step: float = setting("value", "distance between the centres of neighbouring bands", unit="Hz")


@dataclass(frozen=True)
class Support(Settings):
    """Stiffness and damping of the support, subtracted from the direct coefficients; their doubts are sources of the budget."""

    stiffness: Uncertain = setting("uncertain", "stiffness of the support", unit="N/m", default=Uncertain(0.0))
    damping: Uncertain = setting("uncertain", "damping of the support", unit="N.s/m", default=Uncertain(0.0))


@dataclass(frozen=True)
class FitSettings(Settings):
    """One fit of the pipeline's ``identify:`` section; *name* is its key there, *model_settings*: of the section that its model has.

    *repeats*: scatter between repeats of a test, from the section ``uncertainty:``.
    """

    model: str = setting("choice", "what is identified", choices=tuple(MODELS))
    _: KW_ONLY
    mass: Mass = setting("mass", "mass that moves with the response, or `estimate`", unit="kg", default=ESTIMATE)
    estimator: str = setting("choice", "how it is estimated", choices=tuple(ESTIMATORS), default="ml")
    input: tuple[str, ...] = setting("names", "force channel(s); default: all", default=())
    output: tuple[str, ...] = setting("names", "response channel(s); default: all the model takes", default=())
    band: tuple[float, float] | None = setting("band", "frequencies used; default: all", unit="Hz", default=None)
    bands: tuple[tuple[float, float], ...] = setting("bands", "several bands, one fit for each", unit="Hz", default=())
    peaks: tuple[tuple[str, tuple[tuple[float, float], ...]], ...] = setting(
        "peaks", "sdof: bands of chosen peaks of the diagonal terms, by dof; one fit for each", unit="Hz", default=()
    )
    sliding: Sliding | None = setting("section", "repeat the fit in sliding bands", section=Sliding, default=None)
    subtract: Support | None = setting("section", "support to subtract", section=Support, default=None)
    share: int = setting("integer", "equal bearings in parallel that share the load", default=1)
    eliminate: bool = setting("flag", "drop insignificant parameters one by one", default=False)
    symmetric: bool = setting("flag", "mdof: K, C and M are symmetric", default=False)
    lumped_mass: bool = setting("flag", "mdof with mass: estimate: the mass matrix is diagonal", default=False)
    scale_mass: bool = setting("flag", "mdof: the given mass is known but for a factor, which is estimated", default=False)
    relative: bool = setting("flag", "base: the response is measured relative to the base", default=False)
    damping: str = setting("choice", "viscous, or proportional: C = alpha M + beta K", choices=DAMPINGS, default="viscous")
    fixed: tuple[tuple[str, float], ...] = setting("coefficients", "coefficients that are given, by name", default=())
    tied: tuple[tuple[str, ...], ...] = setting("groups", "lists of coefficients that have one value", default=())
    weight: str = setting("choice", "ls, iv, amplitude: all lines weigh alike, or by their noise", choices=WEIGHTS, default="none")
    bootstrap: int = setting("integer", "repeats of the fit on resampled noise, for intervals beyond first order", default=0)
    coverage: float = setting("value", "probability of expanded uncertainties", unit="1", default=0.95)
    monte_carlo: int = setting("integer", "draws of noise and of all numbers with a doubt, as a check of the budget", default=0)
    compare: bool = setting("flag", "hold the model against simpler and richer ones", default=False)
    test: tuple[str, ...] = setting("names", "tests that are fitted; default: all", default=())
    name: str = ""
    model_settings: Any = None
    doubts: Doubts = ()
    repeats: tuple[RepeatSource, ...] = ()

    def __post_init__(self) -> None:
        self._check_bands()
        if not 0 < self.coverage < 1:
            raise ConfigError("'coverage' must lie between 0 and 100 %", field="coverage")
        if self.weight != "none" and self.estimator == "ml":
            raise ConfigError("'weight' is not for ml, which always weighs by the noise", hint="leave it out")
        if self.damping == "proportional" and self.estimator != "ml":
            raise ConfigError(f"proportional damping is not linear in its parameters, {self.estimator} cannot fit it", hint="estimator: ml")
        if self.damping == "proportional" and self.eliminate:
            raise ConfigError("'eliminate' cannot be combined with proportional damping", hint="leave one of them out")
        if self.estimator == "amplitude" and self.model != "sdof":
            raise ConfigError("the amplitude fit is for sdof only", hint="estimator: ml")
        self._check_flags()
        kind = self.kind
        if kind.settings is None and self.model_settings is not None:
            raise ConfigError(f"model {self.model} has no settings of its own", hint="leave model_settings out")
        if kind.settings is not None and kind.optional and self.model_settings is None:
            object.__setattr__(self, "model_settings", kind.settings())
        if kind.settings is not None and not isinstance(self.model_settings, kind.settings):
            raise ConfigError(f"model {self.model} needs the section '{kind.section}'", hint=kind.example)
        if self.scale_mass and self.mass == ESTIMATE:
            raise ConfigError("'scale_mass' needs the mass to be scaled", hint="for example mass: [1 kg, 2 kg]")

    def _check_flags(self) -> None:
        """ConfigError for flags of another model."""
        if self.model != "mdof" and (self.symmetric or self.lumped_mass or self.scale_mass):
            raise ConfigError("'symmetric', 'lumped_mass' and 'scale_mass' are for mdof only", hint="leave them out")
        if self.relative and self.model != BASE:
            raise ConfigError(f"'relative' is for {BASE} only, the response to a force is absolute", hint="leave it out", field="relative")

    @property
    def kind(self) -> ModelKind:
        """The ModelKind of the settings' model; ConfigError for an unknown model."""
        return model_kind(self.model)

    def _check_bands(self) -> None:
        """ConfigError for bands or ports that are set twice."""
        if self.bands and (self.band or self.sliding):
            raise ConfigError("'bands' goes with neither 'band' nor 'sliding'", hint="name all bands under bands")
        if self.peaks and (self.band or self.bands or self.sliding or self.input or self.output):
            raise ConfigError("'peaks' names bands and ports by itself", hint="leave out band, bands, sliding, input and output")
        if self.peaks and self.model != "sdof":
            raise ConfigError("'peaks' is for sdof only", hint="for other models name input, output and bands")


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
    needed, remedy = _NEEDED[of]
    if of == RESPONSES:
        hint = f"model: {_MODEL_OF[measured]}"
        raise ConfigError(f"model {settings.model} needs {needed}, {_NEEDED[measured][0]} have none", hint=hint, field="model")
    raise ConfigError(f"model {settings.model} needs {needed}, not {_NEEDED[measured][0]}", hint=remedy, field="model")


def model_kind(name: str) -> ModelKind:
    """The kind of model of that name; a model linear in its parameters is fitted band by band."""
    entry = MODELS.load(name)
    if isinstance(entry, ModelKind):
        return entry
    return LINEAR


def _fit_linear(response: FrequencyResponse, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.identify.fitting import fit_linear

    return fit_linear(response, settings)


# The kind of every model that is linear in its parameters.
LINEAR = ModelKind(_fit_linear)
