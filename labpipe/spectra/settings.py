"""The parameters of the stage recordings -> frequency response."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.errors import ConfigError
from labpipe.records.settings import setting

EXCITATIONS = ("periodic", "random")
ESTIMATORS = ("H1", "H2", "Hv")


@dataclass(frozen=True)
class FrfSettings:
    """How recordings become a frequency response; times in s, frequencies in Hz."""

    excitation: str = setting("choice", "kind of excitation", choices=EXCITATIONS)
    period: float | None = setting("value", "length of one period of a periodic excitation", unit="s", default=None)
    skip: int = setting("integer", "transient periods dropped at the start (periodic)", default=1)
    smooth: int = setting("integer", "noise is averaged over this many lines to either side (periodic)", default=5)
    block: float | None = setting("value", "length of one block (random)", unit="s", default=None)
    window: str = setting("text", "window of random data: any name of scipy.signal.get_window", default="hann")
    overlap: float = setting("value", "overlap of neighbouring blocks (random)", unit="1", default=0.5)
    estimator: str = setting("choice", "estimator of random data", choices=ESTIMATORS, default="H1")
    band: tuple[float, float] | None = setting("band", "frequencies kept", unit="Hz", default=None)
    exclude: tuple[tuple[float, float], ...] = setting("bands", "bands left out, for example around 1x", unit="Hz", default=())
    directional: bool = setting("flag", "forward and backward terms; not available yet", default=False)

    def __post_init__(self) -> None:
        needed = {"periodic": "period", "random": "block"}[self.excitation]
        length = getattr(self, needed)
        if length is None:
            raise ConfigError(f"'{needed}' is missing", hint=f"{self.excitation} excitation needs it, e.g. {needed}: 1 s")
        if length <= 0:
            raise ConfigError(f"'{needed}' must be positive")
        for count in ("skip", "smooth"):
            if getattr(self, count) < 0:
                raise ConfigError(f"'{count}' must not be negative")
        if not 0 <= self.overlap < 1:
            raise ConfigError("'overlap' must be at least 0 and below 100 %")
        if self.directional:
            raise ConfigError("'directional' is not available in this version", hint="leave it out")
