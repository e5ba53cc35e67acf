"""The model modal: its settings, and its entry in the table of models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from labpipe.errors import ConfigError
from labpipe.estimation.settings import FitSettings, ModelKind
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse
from labpipe.records.rig import Geometry
from labpipe.records.settings import Settings, choice, quantity, setting

# Lowest highest order: below it no mode can be told from noise by its return.
LEAST_ORDER = 6


@dataclass(frozen=True)
class ModalSettings(Settings):
    """How modes are found: from the stabilisation diagram by itself, or at the poles that are named."""

    order: tuple[int, int] = setting(
        "span", "highest order of the stabilisation diagram, or lowest and highest", default=(1, 60)
    )
    poles: tuple[float, ...] = setting(
        "values", "natural frequencies chosen by hand, or auto", unit="Hz", choices=("auto",), default=()
    )
    shapes: str = choice(
        "complex, or real as with damping in proportion to mass and stiffness", ("complex", "real"), "complex"
    )
    moving_mass: float | None = quantity(
        "mass of the sensor or hammer that moves from point to point and loads the structure; frequencies "
        "and damping are then those without it",
        "kg",
        None,
    )
    geometry: str = setting(
        "file",
        "positions of the points: CSV, or UFF 15, 2411, 82, 2412",
        file_kind="geometry",
        into="structure",
        default="",
    )
    structure: Geometry | None = None

    def __post_init__(self) -> None:
        if self.order[1] < max(LEAST_ORDER, self.order[0]):
            what = f"the highest 'order' is {self.order[1]}"
            raise ConfigError(what, hint=f"{LEAST_ORDER} or more, and the lowest first: 2-60", field="order")
        if any(pole <= 0 for pole in self.poles):
            raise ConfigError("'poles' must be positive", field="poles")
        self.require_positive("moving_mass")


def _fit(response: FrequencyResponse, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.methods.modal.fit import modal_fit

    return (modal_fit(response, settings),)


def _repeat_settings(settings: FitSettings, fits: Sequence[Fit]) -> FitSettings:
    # A recording alone is fitted with the modes of all together, so that these keep their numbers.
    poles = tuple(p.value for fit in fits for p in fit.parameters if p.name.startswith("f_n_"))
    return replace(settings, model_settings=replace(settings.model_settings, poles=poles))


MODAL = ModelKind(
    _fit,
    "modal",
    ModalSettings,
    "modal: {order: 60}",
    optional=True,
    of_repeat=_repeat_settings,
    own_damping=True,
    any_input=True,
    keys=("mass", "input", "output", "damping", "residuals", "repeats", "repeat_groups"),
    estimators=("ml",),
)
