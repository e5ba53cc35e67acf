"""The section rotor_system: the rotor file, the tests of that rotor, and what is asked of them together."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from labpipe.errors import SettingError
from labpipe.methods.rotor_system.build import RotorSystem, SmallErrors
from labpipe.methods.rotor_system.system_file import ESTIMATED
from labpipe.methods.run_ups.settings import RunSettings
from labpipe.quantities import UnitError
from labpipe.records.settings import Settings, choice, flag, integer, names, quantity, section, setting, text
from labpipe.records.uncertain import Uncertain, parse_uncertain

MODES, RESPONSE, RUN_UP, STATIC = "modes", "response", "run-up", "static"
# Keys of a test by its kind, beside name and kind.
KEYS = {
    MODES: ("fit", "frequencies", "damping", "numbers"),
    RESPONSE: ("test", "places", "speed", "free", "gain", "band", "fit", "frequencies"),
    RUN_UP: ("run", "places", "axes", "slow_roll", "gain"),
    STATIC: ("deflections", "mass"),
}
AXES = ("load", "horizontal")
_PLACE = re.compile(r"^\s*(?P<node>\d+)\s*(?P<direction>[yz])?\s*$")


def place_of(text: str, directed: bool = True) -> tuple[int, str]:
    """Node and direction of `3 y`; of `3` alone where it is not *directed*. UnitError for anything else."""
    match = _PLACE.match(text)
    if match is None or bool(match["direction"]) != directed:
        hint = "write 3 y" if directed else "write 3, the node"
        raise UnitError(f"'{text}' is not a place on the rotor", hint)
    return int(match["node"]), match["direction"] or ""


@dataclass(frozen=True, kw_only=True)
class SystemTest(Settings):
    """One entry of ``tests:``."""

    name: str = setting("text", "name of the test")
    kind: str = choice(
        "what was measured: modes of the free rotor, an FRF, a run-up, deflections", tuple(KEYS)
    )
    fit: str = text(
        "modes: a modal fit of this pipeline, of the rotor on soft strings; response: one of this FRF, whose "
        "natural frequencies are compared with those of the free rotor"
    )
    frequencies: tuple[str, ...] = names(
        "in place of a fit, from the lowest: [111.3 Hz +- 0.1 Hz, 239.6 Hz +- .2 Hz]"
    )
    damping: tuple[str, ...] = names("modes: their damping ratios: [1.5 % +- 5 %]")
    numbers: tuple[float, ...] = setting(
        "values", "modes: which bending modes these are; default: 1, 2, 3 ...", "1", ()
    )
    test: str = text("response: the test of this pipeline with the FRF")
    places: tuple[tuple[str, str], ...] = setting(
        "texts",
        "where dofs (response: {d1: 3 y}) or planes (run-up: {disc 1: 5}) are on the rotor",
        default=(),
    )
    speed: float = quantity("response: speed of the rotor meanwhile", "Hz", 0.0)
    free: bool = flag("response: of the rotor on soft strings, without its bearings")
    band: tuple[float, float] | None = setting("band", "response: lines that count; default: all", "Hz", None)
    run: RunSettings | None = section("run-up: its table or recording, as in run_ups", RunSettings, None)
    axes: str = choice(
        "run-up: x of the run is along the load and y a quarter turn further with the spin, or x is y of the "
        "rotor file and y is its z",
        AXES,
        AXES[0],
    )
    slow_roll: float = quantity(
        "run-up: standard deviation of the slow roll left in a component, alike at all speeds", "m", 0.0
    )
    gain: float = quantity("standard uncertainty of each sensor's gain", "1", 0.0)
    deflections: tuple[tuple[str, str], ...] = setting(
        "texts", "static: at a place per force at another: {5 z / 10 z: 0.34 um/N +- 1.5 %}", default=()
    )
    mass: Uncertain | None = setting("uncertain", "static: the rotor weighed", "kg", None)

    def __post_init__(self) -> None:
        for name in self.written:
            if name not in ("name", "kind", *KEYS[self.kind]):
                kinds = " or ".join(kind for kind, keys in KEYS.items() if name in keys)
                raise SettingError(name, f"'{name}' is of kind {kinds}", f"kind: {kinds}")
        needed = {
            MODES: bool(self.fit) != bool(self.frequencies),
            RESPONSE: bool(self.test),
            RUN_UP: self.run is not None,
            STATIC: bool(self.deflections) or self.mass is not None,
        }
        if not needed[self.kind]:
            words = {MODES: "one of fit and frequencies", STATIC: "deflections or mass"}
            raise SettingError(KEYS[self.kind][0], f"{words.get(self.kind, KEYS[self.kind][0])}: is missing")
        if self.fit and self.frequencies:
            what = "natural frequencies are those of 'fit' or 'frequencies'"
            raise SettingError("fit", what, "one of them")
        self.require_not_negative("speed", "gain", "slow_roll")
        if list(self.numbers) != sorted(set(self.numbers)) or any(n < 1 or n % 1 for n in self.numbers):
            raise SettingError("numbers", "'numbers' are whole, from 1 on, and rise", "numbers: [1, 3]")
        if self.mass is not None and not 0 < self.mass.std_error < self.mass.value:
            raise SettingError("mass", "'mass' needs its uncertainty", "mass: 33 kg +- 0.1 kg")
        for field in ("places", "deflections", "frequencies", "damping"):
            try:
                getattr(self, f"read_{field}")
            except UnitError as error:
                raise SettingError(field, error.what, error.hint) from None
        if self.damping and len(self.damping) != len(self.frequencies):
            raise SettingError("damping", "'damping' has as many values as 'frequencies'")

    def counts_as(self, other: SystemTest) -> bool:
        """Whether both have lines of one FRF, one run, or modes of one fit."""
        if self.kind != other.kind:
            return False
        (low, high), (begin, end) = (test.band or (0.0, math.inf) for test in (self, other))
        same_lines = bool(self.test) and self.test == other.test and begin < high and low < end
        same_run = self.run is not None and other.run is not None and self.run.path == other.run.path
        return same_lines or same_run or bool(self.kind == MODES and self.fit and self.fit == other.fit)

    @property
    def has_modes(self) -> bool:
        """Whether natural frequencies stand in it."""
        return bool(self.fit or self.frequencies)

    @property
    def read_places(self) -> dict[str, tuple[int, str]]:
        return {name: place_of(text, self.kind == RESPONSE) for name, text in self.places}

    @property
    def read_deflections(self) -> list[tuple[tuple[int, str], tuple[int, str], Uncertain]]:
        """(place, place of the force, deflection per force [m/N])."""
        read: list[tuple[tuple[int, str], tuple[int, str], Uncertain]] = []
        for path, stated in self.deflections:
            output, mark, force = path.partition("/")
            if not mark:
                raise UnitError(f"'{path}' is not a pair of places", "write 5 z / 10 z")
            number, places = parse_uncertain(stated, "m/N"), (place_of(output), place_of(force))
            if number.std_error <= 0:
                raise UnitError(f"'{stated}' needs its uncertainty", f"write {stated} +- 2 %")
            if places in [other[:2] for other in read]:
                raise UnitError(f"'{path}' appears twice", "write one deflection of each pair")
            read.append((*places, number))
        return read

    @property
    def read_frequencies(self) -> list[Uncertain]:
        read = [self._positive(text, "Hz") for text in self.frequencies]
        if [number.value for number in read] != sorted(number.value for number in read):
            raise UnitError("'frequencies' begin with the lowest")
        return read

    @property
    def read_damping(self) -> list[Uncertain]:
        return [self._positive(text, "1") for text in self.damping]

    @staticmethod
    def _positive(text: str, unit: str) -> Uncertain:
        number = parse_uncertain(text, unit)
        if number.std_error <= 0 or number.value <= 0:
            raise UnitError(f"'{text}' needs an uncertainty, and is above zero", "write 111.3 Hz +- 0.1 Hz")
        return number


# Separation margins and the logarithmic decrement of level I.
API = "API 617"


@dataclass(frozen=True, kw_only=True)
class RotorSystemSettings(Settings):
    """The ``rotor_system:`` section; *system*: contents of `rotor`."""

    rotor: str = setting(
        "file",
        "rotor file whose numbers carry uncertainties, relative to the pipeline file",
        file_kind="rotor-system",
        into="system",
    )
    tests: tuple[SystemTest, ...] = setting(
        "entries", "the tests of this rotor", section=SystemTest, default=(), needed=True
    )
    speeds: tuple[float, float] | None = setting(
        "band", "speeds of the predictions; default: 5 % to 150 % of the file's speed", "Hz", None
    )
    small_errors: SmallErrors = section(
        "errors that are everywhere, with their declared sizes", SmallErrors, SmallErrors()
    )
    balance_speeds: tuple[float, ...] = setting(
        "values", "speeds at which weights in the planes of the unbalances are to calm the rotor", "Hz", ()
    )
    standard: str = choice(
        "whose limits at the rotor file's speed are findings where they are not kept; default: of none",
        (API,),
        "",
    )
    draws: int = integer("draws of the posterior for critical speeds and weights", 200)
    seed: int = integer("of these draws", 1)
    system: RotorSystem | None = None

    def __post_init__(self) -> None:
        self._check_tests()
        if self.draws < 20:
            raise SettingError("draws", "at least 20 draws are needed")
        self.require_positive("speeds", "balance_speeds")
        if self.balance_speeds and all(test.kind != RUN_UP for test in self.tests):
            what = "weights need a run-up among the tests, whose probes they calm"
            raise SettingError("balance_speeds", what, "add one, or leave balance_speeds out")
        if self.system is not None:
            if not self.system.has_unknown:
                hint = f"write numbers with their uncertainty, or estimate: [{', '.join(ESTIMATED)}]"
                raise SettingError("rotor", "nothing of the rotor is unknown", hint)
            self._check_places(self.system)
            if self.standard and self.system.rig.speed <= 0:
                what = f"{self.standard} limits what a rotor does at its speed, and the rotor file has none"
                raise SettingError("standard", what, "write speed: 4200 rpm in the rotor file")

    def _check_tests(self) -> None:
        if not self.tests:
            raise SettingError("tests", "a list of tests is needed", "- {name: hammer, kind: modes, ...}")
        for place, test in enumerate(self.tests):
            for other in self.tests[:place]:
                if other.name == test.name:
                    raise SettingError("tests", f"a second test named '{test.name}'", "names must differ")
                if other.counts_as(test):
                    what = f"'{other.name}' and '{test.name}' are one measurement"
                    raise SettingError("tests", what, "it counts once: leave one out, or divide its band")

    def _check_places(self, system: RotorSystem) -> None:
        n_node = system.rig.rotor.n_node
        for test in self.tests:
            nodes = [node for node, _ in test.read_places.values()]
            nodes += [node for pair in test.read_deflections for node, _ in pair[:2]]
            for node in nodes:
                if not 1 <= node <= n_node:
                    what = f"test '{test.name}': node {node}, the rotor has nodes 1 to {n_node}"
                    raise SettingError("tests", what)
        if self.balance_speeds or any(test.kind == RUN_UP for test in self.tests):
            hint = "write unbalances: [{node: 5, size: 0 g.mm +- 200 g.mm}] in the rotor file"
            if not system.unbalances:
                raise SettingError("rotor", "a run-up needs an unknown unbalance", hint)
            for node, _, error in system.unbalances:
                if not error:
                    raise SettingError("rotor", f"the unbalance at node {node} has no uncertainty", hint)
        film = next((place.name for place in system.rig.bearings if place.is_film), "")
        for test in self.tests:
            resting = test.kind == RESPONSE and not test.free and not test.speed
            if film and (resting or test.deflections):
                what = f"test '{test.name}' is at rest, where bearing '{film}' has no oil film"
                raise SettingError("tests", what, "free: true, or speed: as it turned")

    @property
    def band(self) -> tuple[float, float]:
        """Speeds of the predictions [Hz]."""
        assert self.system is not None
        if self.speeds is not None:
            return self.speeds
        speed = self.system.rig.speed
        if speed <= 0:
            raise SettingError("speeds", "'speeds' is needed, since the file's speed is zero")
        return 0.05 * speed, 1.5 * speed
