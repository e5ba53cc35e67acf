"""The parameters of one fit: response -> parameters with their doubt."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.records.settings import Uncertain, setting

MODELS = ("sdof", "rotor-2dof", "rotor-2dof-direct")
ESTIMATORS = ("ls", "ml")

Mass = float | tuple[float, ...] | tuple[tuple[float, ...], ...] | str
ESTIMATE = "estimate"


@dataclass(frozen=True)
class Sliding:
    """The fit is repeated in a band of *width* moved by *step*."""

    width: float = setting("value", "width of one band", unit="Hz")
    step: float = setting("value", "distance between the centres of neighbouring bands", unit="Hz")


@dataclass(frozen=True)
class Support:
    """Stiffness and damping of the support, subtracted from the direct coefficients with their uncertainty."""

    stiffness: Uncertain = setting("uncertain", "stiffness of the support", unit="N/m", default=Uncertain(0.0))
    damping: Uncertain = setting("uncertain", "damping of the support", unit="N.s/m", default=Uncertain(0.0))


@dataclass(frozen=True)
class FitSettings:
    """One fit of the pipeline's ``identify:`` section; *name* is its key there."""

    model: str = setting("choice", "what is identified", choices=MODELS)
    mass: Mass = setting("mass", "mass that moves with the response, or `estimate`", unit="kg", default=ESTIMATE)
    estimator: str = setting("choice", "how it is estimated", choices=ESTIMATORS, default="ml")
    input: tuple[str, ...] = setting("names", "force channel(s); default: all", default=())
    output: tuple[str, ...] = setting("names", "response channel(s); default: all the model takes", default=())
    band: tuple[float, float] | None = setting("band", "frequencies used; default: all", unit="Hz", default=None)
    sliding: Sliding | None = setting("section", "repeat the fit in sliding bands", section=Sliding, default=None)
    subtract: Support | None = setting("section", "support to subtract", section=Support, default=None)
    share: int = setting("integer", "equal bearings in parallel that share the load", default=1)
    eliminate: bool = setting("flag", "drop insignificant parameters one by one", default=False)
    name: str = ""
