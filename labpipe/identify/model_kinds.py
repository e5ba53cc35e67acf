"""A kind of model: how it is fitted, which keys of a fit it takes, and its properties, which other code asks for instead of its name.

Every kind is looked at when a pipeline is read, so the modules of the kinds import no code that fits: their functions do, when called.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from labpipe.records.identification import Fit
from labpipe.spectra.settings import RESPONSES

if TYPE_CHECKING:
    from labpipe.identify.model import DynamicModel
    from labpipe.identify.settings import FitSettings
    from labpipe.identify.setup import Setup
    from labpipe.records.response import FrequencyResponse

# Keys of a fit that every model takes.
EVERY = ("model", "estimator", "band", "coverage", "test")
# Keys that every model linear in its parameters takes besides.
LINEAR = (
    *("mass", "input", "output", "bands", "sliding", "subtract", "share", "eliminate", "fixed", "weight"),
    *("bootstrap", "monte_carlo", "compare"),
)


@dataclass(frozen=True)
class ModelKind:
    """How fits of a model are made, and what is true of it.

    fit: the fits of what the model is *of*, a response, free decays or spectra; one per band or peak. section: key of the model's own
    settings in a fit, their dataclass *settings*, and an *example* of the section, *optional* where all of them have defaults. earlier:
    name of the fit whose result this one begins with, empty for none; begin: the settings with the result of that fit among *fits*.
    times_mass: stiffness and damping are the given mass times what is fitted.

    keys: those of a fit, besides EVERY, that change what is computed; all others are refused; by_likelihood: those of them that only an
    estimator by likelihood takes. estimators: names of those that fit it;
    empty: any. equations: of a model linear in its parameters, from ports and settings; None for a model fitted in its own way.

    one_frf: k, c and m of the FRF of one response to one force. one_mode: of a mass on a spring, with f_n and zeta. matrix_modes: the
    modes of its K, C and M are derived. one_direction: a stiffness and a damping for each direction, uncoupled. of_base: its input is
    the motion of a base. frees_mass: a given mass can as well be estimated. richer, simpler: models to compare with.
    """

    fit: Callable[[Any, FitSettings], tuple[Fit, ...]]
    section: str = ""
    settings: type | None = None
    example: str = ""
    optional: bool = False
    earlier: Callable[[FitSettings], str] = lambda _settings: ""
    begin: Callable[[FitSettings, Sequence[Fit]], FitSettings] = lambda settings, _fits: settings
    of: str = RESPONSES
    times_mass: bool = False
    keys: tuple[str, ...] = ("mass", "input", "output", "bands")
    by_likelihood: tuple[str, ...] = ()
    estimators: tuple[str, ...] = ()
    equations: Callable[[Setup], DynamicModel] | None = None
    one_frf: bool = False
    one_mode: bool = False
    matrix_modes: bool = False
    one_direction: bool = False
    of_base: bool = False
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
    from labpipe.identify.fitting import fit_linear

    return fit_linear(response, settings)
