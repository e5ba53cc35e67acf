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
        "span",
        "highest order of the stabilisation diagram, or lowest and highest; at most a quarter of the lines",
        default=(1, 60),
    )
    poles: tuple[float, ...] = setting(
        "values", "natural frequencies chosen by hand, or auto", "Hz", (), choices=("auto",)
    )
    shapes: str = choice(
        "complex, or real as with damping in proportion to mass and stiffness", ("complex", "real"), "complex"
    )
    moving_mass: float | None = quantity(
        "mass of the sensor or hammer that moves from point to point (that it moves is used, not its size); "
        "frequencies and damping are then those without it",
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
    # Damping ratios [1] at which named poles begin, where the fit of all repeats tells them.
    ratios: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        lowest, highest = self.order
        if highest < max(LEAST_ORDER, lowest):
            what = f"the highest 'order' is {highest}, the lowest {lowest}"
            raise ConfigError(what, hint=f"{LEAST_ORDER} or more, and the lowest first: 2-60", field="order")
        self.require_positive("poles", "moving_mass")


def _fit(response: FrequencyResponse, settings: FitSettings) -> tuple[Fit, ...]:
    from labpipe.methods.modal.fit import modal_fit

    return (modal_fit(response, settings),)


def _repeat_settings(settings: FitSettings, fits: Sequence[Fit]) -> FitSettings:
    # A recording alone is fitted from the modes of all together, so that these keep their numbers: the poles
    # of its own diagram that are nearest may be noise.
    values = {p.name: p.value for fit in fits for p in fit.parameters}
    numbers = [name.removeprefix("f_n_") for name in values if name.startswith("f_n_")]
    poles = tuple(values[f"f_n_{number}"] for number in numbers)
    ratios = tuple(values.get(f"zeta_{n}", values.get(f"eta_{n}", 0.0) / 2) for n in numbers)
    return replace(settings, model_settings=replace(settings.model_settings, poles=poles, ratios=ratios))


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
