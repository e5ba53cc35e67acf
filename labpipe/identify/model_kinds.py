"""A kind of model of a response: how it is fitted, and the settings that it has beyond those of every fit.

Every kind is looked at when a pipeline is read, so the modules of the kinds import no code that fits: their functions do, when called.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from labpipe.records.identification import Fit

if TYPE_CHECKING:
    from labpipe.identify.settings import FitSettings


# What a model is fitted to: a FrequencyResponse, FreeDecays, or ChannelSpectra.
RESPONSES, DECAYS, SPECTRA = "responses", "decays", "spectra"


@dataclass(frozen=True)
class ModelKind:
    """How fits of a model are made.

    fit: the fits of what the model is *of*, a response, free decays or spectra; one per band or peak. section: key of the model's own
    settings in a fit, their dataclass *settings*, and an *example* of the section, *optional* where all of them have defaults. earlier:
    name of the fit whose result this one begins with, empty for none; begin: the settings with the result of that fit among *fits*.
    times_mass: stiffness and damping are the given mass times what is fitted.
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
