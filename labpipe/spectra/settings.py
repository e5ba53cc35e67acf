"""The parameters of the stage recordings -> frequency response."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from math import inf

from labpipe.errors import ConfigError, SettingError
from labpipe.records.frf_layout import WindowedSettings
from labpipe.records.settings import Settings, choice, flag, integer, names, quantity, section, setting, text

EXCITATIONS = ("periodic", "random", "impact", "stepped-sine", "sweep", "decay")
# What each excitation must be given, if anything.
NEEDED = {"periodic": "period", "random": "block", "impact": "block"}
# Excitations whose pieces are found in the recording, and what these are called.
FOUND = {"stepped-sine": "dwells", "sweep": "sweeps"}
# Keys that each excitation takes; all others would change nothing.
OF_LINES = ("band", "exclude", "mask", "directional", "result")
KEYS: dict[str, tuple[str, ...]] = {
    "periodic": (*OF_LINES, "period", "skip", "smooth", "remove", "realisations", "reference"),
    "random": (
        *(*OF_LINES, "block", "window", "overlap", "detrend", "estimator"),
        *("local", "degree", "half_width", "remove", "reference"),
    ),
    "impact": (*OF_LINES, "block", "estimator", "remove", "impact", "windowed"),
    "stepped-sine": (*OF_LINES, "skip", "settle", "smooth"),
    "sweep": (*OF_LINES, "degree", "half_width"),
    "decay": ("decay",),
}
# Keys of averages over blocks with a window, and of local polynomials in their place.
OF_AVERAGES, OF_POLYNOMIALS = ("window", "overlap", "detrend"), ("degree", "half_width")
ESTIMATORS = ("H1", "H2", "Hv")
# What recordings give: frequency responses, free decays, or spectra of all channels.
RESPONSES, DECAYS, SPECTRA = "responses", "decays", "spectra"
# What recordings become: one response matrix, or all channels side by side with the noise of each.
RESULTS = ("response", "spectra")
DETRENDS, LOCALS = ("constant", "linear", "none"), ("none", "polynomial")


def check_excluded(gaps: tuple[tuple[float, float], ...], band: tuple[float, float]) -> None:
    """SettingError for one of the *gaps* [Hz] that lies outside of the *band* [Hz]."""
    for first, last in gaps:
        if last < band[0] or first > band[1]:
            what = f"'exclude' of {first:g}-{last:g} Hz leaves nothing out of the band"
            what = f"{what} of {band[0]:g} to {band[1]:g} Hz"
            raise SettingError("exclude", what, "leave it out, or correct its unit")


@dataclass(frozen=True)
class ShaftLines(Settings):
    """Lines of a rotating shaft: its speed or its tacho channel, and the number of harmonics."""

    speed: float | None = quantity("shaft speed, e.g. 50 Hz or 3000 rpm", "Hz", None)
    tacho: str | None = text("channel with the tacho pulses, instead of a speed", None)
    pulses: int = integer("pulses of the tacho per revolution", 1)
    harmonics: int = integer("multiples of the speed that count, from 1x", 1)

    def __post_init__(self) -> None:
        if (self.speed is None) == (self.tacho is None):
            raise ConfigError("one of 'speed' and 'tacho' is needed", hint="speed: 50 Hz, or tacho: CHANNEL")
        self.require_positive("speed", "pulses", "harmonics")
        if self.speed is not None and self.pulses != 1:
            raise ConfigError("'pulses' belong to a tacho", hint="leave them out beside 'speed'")


@dataclass(frozen=True)
class MaskSettings(ShaftLines):
    """Lines excluded from the response: the shaft speed and its harmonics."""

    width: float | None = quantity(
        "left out to either side; default: 2 lines (random) or half a line", "Hz", None
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_not_negative("width")


@dataclass(frozen=True)
class ImpactSettings(Settings):
    """Detection, windows and acceptance of hammer hits; levels as shares of the hit's peak."""

    trigger: float = quantity("a hit begins where the force exceeds this share of the largest hit", "1", 0.1)
    pretrigger: float = quantity("share of the block that lies before the hit", "1", 0.02)
    force_window: float | None = quantity(
        "length of the force window from the hit on; default: none", "s", None
    )
    decay: float | None = quantity("time constant of the exponential window; default: none", "s", None)
    double_hit: float = quantity("a second push above this share of the peak is a double hit", "1", 0.1)
    reject: tuple[int, ...] = names("numbers of hits that are left out, counted from 1", may_be_empty=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "reject", tuple(_hit_number(number) for number in self.reject))
        self.require_share("trigger", "double_hit")
        self.require_share("pretrigger", or_none=True)
        self.require_positive("force_window", "decay")


@dataclass(frozen=True)
class FreeDecaySettings(Settings):
    """Where the free decays of a recording begin and end; times from its first sample on."""

    start: float | None = quantity("where the decay begins; default: after every hit or release", "s", None)
    end: float | None = quantity("where it ends; default: at the next hit, or in the noise", "s", None)
    settle: float | None = quantity(
        "left out after the largest value of every decay; default: one period", "s", None
    )
    trigger: float = quantity("a hit counts where the response exceeds this share of its largest", "1", 0.1)

    def __post_init__(self) -> None:
        self.require_not_negative("start", "end", "settle")
        if self.end is not None and self.end <= (self.start or 0.0):
            raise SettingError("end", "'end' must come after 'start'")
        for name in ("settle", "trigger") if self.start is not None else ():
            if name in self.written:
                what = f"'{name}' is for decays that are looked for, 'start' says where they begin"
                raise SettingError(name, what, "leave one of them out")
        self.require_share("trigger")


@dataclass(frozen=True)
class FrfSettings(Settings):
    """How recordings become a frequency response; times in s, frequencies in Hz."""

    excitation: str = choice("kind of excitation", EXCITATIONS)
    _: KW_ONLY
    period: float | None = quantity("length of one period of a periodic excitation", "s", None)
    skip: int = integer(
        "transient periods dropped at the start (periodic), or at least, after each step (stepped-sine)", 1
    )
    settle: float | None = quantity(
        "time dropped after each step (stepped-sine); default: until the transient is in the noise", "s", None
    )
    smooth: int = integer(
        "noise is averaged over this many lines to either side (periodic), or as many as it needs of them "
        "(stepped-sine)",
        5,
    )
    block: float | None = quantity("length of one block (random, impact)", "s", None)
    window: str = text("window of random data: any name of scipy.signal.get_window", "hann")
    overlap: float = quantity("overlap of neighbouring blocks (random)", "1", 0.5)
    detrend: str = choice("trend taken out of every block (random)", DETRENDS, "constant")
    estimator: str = choice("estimator of random data and hits", ESTIMATORS, "H1")
    local: str = choice(
        "FRF and leakage as polynomials over neighbouring lines, in place of a window (random)",
        LOCALS,
        "none",
    )
    degree: int = integer("degree of the local polynomials (local, sweep)", 2)
    half_width: int | None = integer(
        "lines to either side that they span; default: as many as the noise needs", None
    )
    band: tuple[float, float] | None = setting("band", "frequencies kept", "Hz", None)
    exclude: tuple[tuple[float, float], ...] = setting("bands", "bands left out", "Hz", (), may_be_empty=True)
    mask: MaskSettings | None = section("lines of the shaft speed left out", MaskSettings, None)
    remove: ShaftLines | None = section(
        "part synchronous with the shaft, taken out of all channels (periodic, random, impact)",
        ShaftLines,
        None,
    )
    realisations: bool = flag("recordings of one force differ in phases, which shows distortion (periodic)")
    impact: ImpactSettings = section("hits of a hammer", ImpactSettings, ImpactSettings())
    windowed: WindowedSettings | None = section(
        "window that hits have already: its damping is taken out", WindowedSettings, None
    )
    decay: FreeDecaySettings = section("free decays: start and end", FreeDecaySettings, FreeDecaySettings())
    result: str = choice(
        "one response matrix, or the spectra of all channels side by side with their noise",
        RESULTS,
        "response",
    )
    reference: tuple[str, ...] = names(
        "what is injected into a closed loop (random, periodic); with result: spectra the drives of the "
        "shakers (random)"
    )
    directional: bool = flag("the response in forward and backward terms (two responses, two forces)")

    def __post_init__(self) -> None:
        self._check_length()
        self._check_keys()
        self.require_share("overlap", or_none=True)
        if self.windowed is not None and self.impact.decay is not None:
            what = "'windowed' and impact.decay are two exponential windows"
            raise SettingError("windowed", what, "leave out impact.decay: the data have their window already")
        window = self.impact.force_window
        if window is not None and self.block is not None and window > self.block:
            what = f"'force_window' of {window:g} s is longer than the block of {self.block:g} s"
            hint = "a little more than the contact, such as 10 ms, or leave it out"
            raise SettingError("impact", what, hint)
        self._check_local()
        self._check_result()
        check_excluded(self.exclude, self.band or (0.0, inf))
        self.require_not_negative("settle")
        if self.excitation in FOUND and self.mask is not None and self.mask.width is None:
            what = f"'mask' needs its 'width' with {self.excitation}"
            raise SettingError("mask", what, "mask: {speed: 50 Hz, width: 0.5 Hz}")

    def _check_keys(self) -> None:
        idle: tuple[str, ...] = ()
        if self.excitation == "random":
            idle = OF_POLYNOMIALS if self.local == "none" else OF_AVERAGES
        for name in self.written:
            if name not in ("excitation", *KEYS[self.excitation]):
                able = ", ".join(excitation for excitation in EXCITATIONS if name in KEYS[excitation])
                what = f"'{name}' is not for {self.excitation} excitation"
                raise SettingError(name, what, f"leave it out; excitations that take it: {able}")
            if name in idle:
                what = f"'{name}' is for local: {'polynomial' if self.local == 'none' else 'none'}"
                raise SettingError(name, what, "leave it out")

    def _check_result(self) -> None:
        if self.result == "response":
            self._check_reference()
            return
        if self.excitation not in ("periodic", "random"):
            what = f"'result: spectra' is for periodic and random excitation, not for {self.excitation}"
            raise SettingError("result", what, "leave it out")
        if self.reference and self.excitation != "random":
            what = "'reference' is for random excitation: periodic data need no drives"
            raise SettingError("reference", what, "leave it out")
        for name in ("directional", "realisations", "local", "estimator"):
            if name in self.written:
                what = f"'{name}' belongs to a response matrix, not to result: spectra"
                raise SettingError(name, what, "leave it out")

    def _check_reference(self) -> None:
        if not self.reference:
            return
        if self.local != "none":
            what = "'local' takes the loop as open, 'reference' as closed"
            raise SettingError("local", what, "leave one of them out")
        if self.estimator != "H1":
            what = "with 'reference' the FRF is estimated by the joint input-output method, not by "
            raise SettingError("estimator", what + self.estimator, "leave `estimator` out")

    @property
    def gives(self) -> str:
        """What recordings become: DECAYS, SPECTRA or RESPONSES."""
        if self.excitation == "decay":
            return DECAYS
        return SPECTRA if self.result == SPECTRA else RESPONSES

    @property
    def single_averages(self) -> bool:
        """Whether H follows from the amplitudes of single periods or hits alone: no window, reference or
        lines of the shaft, and the force is taken as exact.
        """
        others = (self.directional, self.reference, self.mask, self.remove, self.realisations)
        return (
            self.excitation in ("periodic", "impact")
            and self.gives == RESPONSES
            and self.damping_window is None
            and self.estimator == ESTIMATORS[0]
            and not any(others)
        )

    @property
    def damping_window(self) -> float | None:
        """Time constant [s] of the exponential window that the blocks of hits have in the end, whoever
        applied it; None for none.
        """
        return self.impact.decay if self.windowed is None else self.windowed.exponential

    def _check_local(self) -> None:
        if self.local == "none" and self.excitation != "sweep":
            return
        if self.degree < 1:
            hint = "2 follows a resonance, 4 follows it better"
            raise SettingError("degree", f"'degree' is {self.degree}", hint)
        if self.half_width is not None and self.half_width <= self.degree:
            raise SettingError("half_width", "'half_width' must exceed 'degree'", "leave it out")
        if self.local != "none" and self.estimator != "H1":
            what = f"'local' takes the forces as exact, {self.estimator} does not"
            raise SettingError("estimator", what, "estimator: H1")

    def _check_length(self) -> None:
        needed = NEEDED.get(self.excitation)
        if needed is None:
            return
        if getattr(self, needed) is None:
            hint = f"{self.excitation} excitation needs it, e.g. {needed}: 1 s"
            raise ConfigError(f"'{needed}' is missing", hint=hint)
        self.require_positive(needed)


def _hit_number(text: str | int) -> int:
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise ConfigError(f"'{text}' is not the number of a hit", hint="the first hit is 1")
    return number
