"""Settings of a certificate: the section `certificate:` of a comparison of that kind."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.bearings.open_loop import INPUT, OUTPUT
from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, setting

# Zones that a peak of the sensitivity may have to lie in; D has no upper end.
ZONE_NAMES = ("A", "B", "C")


@dataclass(frozen=True, kw_only=True)
class CertificateSettings(Settings):
    """What was recorded of the loop, how it is sampled, and the limits of acceptance."""

    before: tuple[str, ...] = setting("names", "responses ahead of the sums at which excitations are added, one per loop", default=())
    after: tuple[str, ...] = setting("names", "responses behind those sums, one per loop", default=())
    output: str = setting("text", "response that is the command behind the controller, [V]", default="")
    displacement: str = setting("text", "response that is the reading of the probe", default="")
    current: str = setting("text", "response that is the current", default="")
    injection: str = setting("choice", "where the excitation is added: the controller's side", choices=(INPUT, OUTPUT), default=INPUT)
    rate: float | None = setting("value", "sampling rate of the controller; default: that of discrete blocks", unit="Hz", default=None)
    filtered: bool = setting("flag", "current and displacement were recorded through a filter against aliasing", default=False)
    log_decrement: float = setting("value", "least logarithmic decrement of every mode", unit="1", default=0.1)
    zone: str = setting("choice", "worst zone of ISO 14839-3", choices=ZONE_NAMES, default="B")
    confidence: float = setting("value", "probability from which a limit counts as kept, or as broken", unit="1", default=0.95)

    def __post_init__(self) -> None:
        if not 0.5 < self.confidence < 1:
            raise ConfigError("'confidence' must lie between 50 and 100 %", field="confidence")
        if not self.log_decrement > 0:
            raise ConfigError("'log_decrement' must be above zero", field="log_decrement")
        if self.rate is not None and not self.rate > 0:
            raise ConfigError("'rate' must be above zero", field="rate")
        if self.before and len(self.before) != len(self.after):
            raise ConfigError(f"{len(self.before)} points ahead of a sum and {len(self.after)} behind", hint="one per loop", field="before")

    @property
    def recorded(self) -> tuple[str, ...]:
        """The responses that it names."""
        return tuple(name for name in (*self.before, *self.after, self.output, self.displacement, self.current) if name)
