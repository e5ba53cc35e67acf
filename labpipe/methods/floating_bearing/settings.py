"""The model dynamic-stiffness: its settings, and its entry in the table of models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass

from labpipe.errors import ConfigError
from labpipe.estimation.settings import FitSettings, ModelKind
from labpipe.methods.floating_bearing.forms import BANDS, FORMS, NAMES
from labpipe.methods.floating_bearing.given import Baseline
from labpipe.records.identification import Fit
from labpipe.records.settings import Settings, quantity, require_positive, setting
from labpipe.records.spectra import ChannelSpectra
from labpipe.records.uncertain import Uncertain
from labpipe.registry import nearest
from labpipe.spectra.settings import SPECTRA

MOTIONS = ("relative", "absolute")
SYMMETRIES = ("none", "seal", "direct")
COMPARED = ("kc", "kcm", "relaxation", "pad")


@dataclass(frozen=True)
class DynamicStiffnessSettings(Settings):
    """What is identified and what is given; *known*: the baseline of `baseline`, once its fit is made."""

    form: str | None = setting(
        "choice",
        "course over frequency; default: kcm, or with `compare` the best",
        choices=NAMES,
        default=None,
    )
    _: KW_ONLY
    symmetry: str = setting(
        "choice",
        "none; seal: k_xx = k_yy, k_xy = -k_yx; direct: no cross terms",
        choices=SYMMETRIES,
        default="none",
    )
    motion: str = setting(
        "choice",
        "that it acts on: against the shaft, or absolute (baseline)",
        choices=MOTIONS,
        default="relative",
    )
    stator_mass: Uncertain | None = setting(
        "uncertain", "mass of the stator with its uncertainty; default: `mass`", unit="kg", default=None
    )
    baseline: str = setting("text", "an earlier fit of what holds the stator, or its test", default="")
    baseline_stiffness: Uncertain | None = setting(
        "uncertain", "of what holds the stator, in x and y", unit="N/m", default=None
    )
    baseline_damping: Uncertain | None = setting(
        "uncertain", "of what holds the stator, in x and y", unit="N.s/m", default=None
    )
    band_width: float | None = quantity("form bands: width of one; default: a tenth of the band", "Hz", None)
    forms: tuple[str, ...] = setting(
        "names", "forms that `compare` holds against each other", default=COMPARED
    )
    speed: float | None = quantity(
        "speed of the shaft, from x to y; default: the test's condition `speed`", "Hz", None
    )
    rotor_mass: Uncertain | None = setting(
        "uncertain",
        "mass on the bearing, for the onset speed of whirl of a rotor on it",
        unit="kg",
        default=None,
    )
    rotor_stiffness: float | None = quantity("stiffness of that rotor; default: rigid", "N/m", None)
    load: float | None = quantity(
        "for coefficients without dimension; default: the condition `load`", "N", None
    )
    clearance: float | None = quantity("radial clearance, for coefficients without dimension", "m", None)
    viscosity: float | None = quantity("for the Sommerfeld number", "Pa.s", None)
    diameter: float | None = quantity("for the Sommerfeld number", "m", None)
    length: float | None = quantity("for the Sommerfeld number", "m", None)
    known: Baseline | None = None

    def __post_init__(self) -> None:
        if self.baseline and (self.baseline_stiffness or self.baseline_damping):
            raise ConfigError("'baseline' is given twice", hint="a fit, or numbers", field="baseline")
        for name in ("stator_mass", "rotor_mass"):
            mass: Uncertain | None = getattr(self, name)
            if mass is not None and mass.value < 0:
                raise ConfigError(f"'{name}' is negative", field=name)
        require_positive(self, "band_width", "rotor_stiffness", "load", "clearance", "viscosity", "diameter")
        require_positive(self, "length")
        for form in self.forms:
            if form not in FORMS:
                raise ConfigError(
                    f"'forms': '{form}' cannot be compared", hint=nearest(form, tuple(FORMS)), field="forms"
                )
        if self.band_width is not None and self.form != BANDS:
            raise ConfigError("'band_width' goes with form: bands", hint="leave it out", field="band_width")


def _fit(spectra: ChannelSpectra, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.methods.floating_bearing.fit import dynamic_stiffness_fits

    return dynamic_stiffness_fits(spectra, settings)


def _begin(settings: FitSettings, fits: Sequence[Fit]) -> FitSettings:
    from labpipe.methods.floating_bearing.fit import with_baseline

    return with_baseline(settings, fits)


DYNAMIC_STIFFNESS = ModelKind(
    _fit,
    "dynamic_stiffness",
    DynamicStiffnessSettings,
    "dynamic_stiffness: {form: kcm}",
    optional=True,
    earlier=lambda settings: settings.model_settings.baseline,
    begin=_begin,
    of=SPECTRA,
    keys=("mass", "input", "output", "bands", "compare"),
    by_likelihood=("compare",),
    estimators=("ml", "ls"),
)
