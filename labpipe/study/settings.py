"""The ``study:`` section of a pipeline."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, setting
from labpipe.simulate.virtual_rigs import VirtualRig

FEWEST_REPEATS = 10


@dataclass(frozen=True, kw_only=True)
class StudySettings(Settings):
    """Virtual rig, noise levels and repeats of a study; *virtual_rig*: contents of `rig`."""

    rig: str = setting("file", "virtual rig file, relative to the pipeline file", file_kind="virtual-rig", into="virtual_rig")
    noise: tuple[float, ...] = setting(
        "values", "noise levels: of a rig given by its FRF the share of the largest |H|, of others relative to the rig's noise", unit="1"
    )
    runs: tuple[str, ...] = setting("names", "runs of the virtual rig that together give one FRF matrix", default=())
    lines: tuple[float, ...] = setting("values", "numbers of lines (rigs given by their FRF); default: the rig's", unit="1", default=())
    repeats: int = setting("integer", "repeats of each case", default=200)
    seed: int = setting("integer", "seed of the noise", default=1)
    success: tuple[float, ...] = setting("values", "relative deviations that count as success", unit="1", default=(0.1,))
    share: float = setting("value", "success rate asked for", unit="1", default=0.95)
    printed: tuple[tuple[str, tuple[float, ...]], ...] = setting(
        "series", "mean errors printed elsewhere, by fit, one for each noise level, to stand beside", unit="1", default=()
    )
    thresholds: bool = setting("flag", "search the noise level where the success rate falls under the share", default=False)
    virtual_rig: VirtualRig | None = None

    def __post_init__(self) -> None:
        if self.repeats < FEWEST_REPEATS:
            raise ConfigError(f"'repeats' must be at least {FEWEST_REPEATS}", hint="500 give the coverage to 1 %")
        if not self.noise or min(self.noise) <= 0:
            raise ConfigError("'noise' needs levels above zero", hint="for example noise: [1 %, 2 %]")
        if any(count != round(count) or count < 2 for count in self.lines):
            raise ConfigError("'lines' needs whole numbers of at least 2")
        if any(len(values) != len(self.noise) for _, values in self.printed):
            raise ConfigError("'printed' needs one value for each noise level")
        if any(limit <= 0 for limit in self.success) or not 0 < self.share < 1:
            raise ConfigError("'success' must be above zero, 'share' between 0 and 100 %")
