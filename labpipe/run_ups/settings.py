"""What a pipeline says of its run-ups: which runs, which methods, which metamodels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from labpipe.errors import ConfigError
from labpipe.records.rig import Rig
from labpipe.records.run_up_result import HELD_OUT, TRAINED
from labpipe.records.settings import Uncertain, setting
from labpipe.registry import nearest

METHODS = ("amplitudes", "points", "joint", "process")
METAMODELS = ("response-surface", "network", "gaussian-process", "physical")
SEARCHES = ("pattern", "cobyqa")


@dataclass(frozen=True)
class RunSettings:
    """One entry of ``run_ups.runs:``, a table or a recording; *unbalance* [kg m] by plane, complex: in place of the table's.

    path, subtracted: the files with their folder; own_rig: what `rig` names.
    """

    file: str = setting("text", "table of the run-up (CSV), relative to the pipeline file", default="")
    recording: str = setting("text", "time recording of the run-up with a tacho, instead of a table", default="")
    rig: str = setting("text", "rig file of a raw recording; dofs name planes: disc1.x, disc1.y", default="")
    tacho: str = setting("text", "channel with the tacho's pulses", default="")
    pulses: int = setting("integer", "pulses of the tacho per revolution", default=1)
    harmonics: int = setting("integer", "multiples of the speed fitted along", default=2)
    revolutions: int = setting("integer", "revolutions of one stretch", default=20)
    name: str = setting("text", "name of the run; default: the file's", default="")
    role: str = setting("choice", "fits see trained runs only", choices=(TRAINED, HELD_OUT), default=TRAINED)
    load: float | None = setting("value", "static load; default: the table's", unit="N", default=None)
    threshold: Uncertain | None = setting("uncertain", "measured threshold of instability; default: the table's", unit="Hz", default=None)
    subtract: str = setting("text", "run of the residual unbalance, subtracted phasor by phasor (a file of the same kind)", default="")
    printed_critical_speed: tuple[float, ...] = setting(
        "values", "printed elsewhere, shown for reference: measured, original, enhanced", unit="Hz", default=()
    )
    printed_threshold: tuple[float, ...] = setting("values", "the same of the threshold", unit="Hz", default=())
    unbalance: tuple[tuple[str, complex], ...] = ()
    path: Path = Path()
    subtracted: Path | None = None
    own_rig: Rig | None = None

    def __post_init__(self) -> None:
        if bool(self.file) == bool(self.recording):
            raise ConfigError("one of 'file' and 'recording' is needed", hint="file: load-1.csv, or recording: run.parquet with tacho:")
        if self.recording and not self.tacho:
            raise ConfigError("'tacho' is missing", hint="name the channel with the tacho's pulses")
        if self.recording and self.load is None:
            raise ConfigError("'load' is missing", hint="a recording does not state it; for example load: 3.66 N")
        if self.load is not None and self.load <= 0:
            raise ConfigError("'load' must be positive")
        if self.threshold is not None and not (self.threshold.value > 0 and self.threshold.std_error > 0):
            raise ConfigError("'threshold' needs its uncertainty", hint="for example 2772 rpm +- 6 rpm")
        for name in ("printed_critical_speed", "printed_threshold"):
            if len(getattr(self, name)) not in (0, 3):
                raise ConfigError(f"'{name}' has three values", hint="measured, original and enhanced")
        if self.recording and min(self.pulses, self.harmonics, self.revolutions - 1) < 1:
            raise ConfigError("'pulses' and 'harmonics' are at least 1, 'revolutions' at least 2")


@dataclass(frozen=True)
class RunUpSettings:
    """The ``run_ups:`` section; *rotor_path*: the rotor file with its folder."""

    rotor: str = setting("text", "rotor file with pins, relative to the pipeline file")
    methods: tuple[str, ...] = setting("names", f"what is fitted: {', '.join(METHODS)}", default=("points", "joint"))
    metamodels: tuple[str, ...] = setting("names", f"of coefficients over load and speed: {', '.join(METAMODELS)}", default=())
    metamodels_of: str = setting("choice", "the method whose coefficients they are fitted to", choices=METHODS, default="joint")
    plane: str = setting("text", "plane of the critical speeds; default: the last one", default="")
    bound: float = setting("value", "largest change of a coefficient (amplitudes, points)", unit="1", default=0.3)
    ridge: float = setting("value", "standard deviation of that change before a run is seen (points)", unit="1", default=0.15)
    search: str = setting("choice", "how amplitudes are fitted", choices=SEARCHES, default="pattern")
    starts: int = setting("integer", "starts of that search at one load and speed, to show their spread", default=20)
    seed: int = setting("integer", "of random starts and networks", default=1)
    source: str = setting("text", "where the printed values are from", default="")
    runs: tuple[RunSettings, ...] = ()
    rotor_path: Path = Path()

    def __post_init__(self) -> None:
        for names, known in ((self.methods, METHODS), (self.metamodels, METAMODELS)):
            for name in names:
                if name not in known:
                    raise ConfigError(f"unknown name '{name}'", hint=nearest(name, known))
        if not (0 < self.bound < 1 and self.ridge > 0):
            raise ConfigError("'bound' lies between 0 and 100 %, 'ridge' above 0", hint="for example bound: 30 %")
