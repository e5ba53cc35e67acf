"""labpipe balance FILE: runs with known weights, a model, or both, to weights and what they leave."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import brute

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.distributions import chi2_tail
from labpipe.errors import ConfigError, SettingError, locate_errors
from labpipe.methods.balancing.influence import (
    BalanceRun,
    Influence,
    Places,
    ReadingNoise,
    RemainingVibration,
    WeightInterval,
    best_weights,
    influence,
    next_runs,
    placed_weights,
    residual_of,
    weight_intervals,
)
from labpipe.project.marked_yaml import Marked, load_marked
from labpipe.project.settings_reader import Faults, join, read_settings
from labpipe.quantities import UnitError, parse_value, written_unit
from labpipe.records.settings import Settings, integer, parse_phasor, quantity, setting, text
from labpipe.registry import nearest

LISTS = ("planes", "runs")
# Share of itself that no reading and no weight is uncertain by: a per cent sign is missing.
MOST_SHARE = 0.5
# Chance below which the readings contradict the stated noise.
UNLIKELY = 0.01
# Weights by plane and readings by line of a run.
Vectors = tuple[dict[str, complex], dict[str, complex]]


@dataclass(frozen=True)
class BalanceSettings(Settings):
    """The plain entries of a balance file; planes and runs are read by themselves."""

    title: str = text("title of the result")
    _: KW_ONLY
    repeatability: float = quantity(
        "scatter of a reading as a vector when nothing is changed, as a share of it (standard)", "1", 0.02
    )
    weight_uncertainty: float = quantity(
        "standard uncertainty of a weight that is set, as a vector (mass, radius, angle), as a share of it",
        "1",
        0.0,
    )
    noise: str = text("scatter of each of its parts that does not depend on it, e.g. 0.2 um (standard)")
    mass: float | None = quantity("mass of the rotor, for a grade", "kg", None)
    speed: float | None = quantity("service speed, for a grade", "Hz", None)
    grade: float | None = quantity("balance quality grade asked for, e.g. 2.5 mm/s for G 2.5", "m/s", None)
    model: str = setting(
        "file",
        "identification.json of a pipeline whose rotor_system has balance_speeds: what it says is a prior",
        file_kind="path",
        default="",
    )

    def __post_init__(self) -> None:
        self.require_positive("mass", "speed", "grade")
        self.require_not_negative("repeatability", "weight_uncertainty")
        for name in ("repeatability", "weight_uncertainty"):
            if getattr(self, name) >= MOST_SHARE:
                raise SettingError(name, f"'{name}' is {100 * getattr(self, name):g} % of the size", "1 %")
        of_grade = {"mass": self.mass, "speed": self.speed, "grade": self.grade}
        missing = [name for name, value in of_grade.items() if value is None]
        if missing and len(missing) < len(of_grade):
            given = next(name for name in of_grade if name not in missing)
            what = f"'{given}' alone says nothing of a permissible unbalance"
            raise SettingError(given, what, f"give {' and '.join(missing)} as well")


@dataclass(frozen=True)
class PlaneSettings(Settings):
    """One entry of ``planes:``: where weights can be set in it."""

    radius: float | None = quantity("at which weights are set, for masses", "m", None)
    places: int = integer("evenly spread places for weights; 0: any angle", 0)
    first: float = quantity("angle of the first place", "rad", 0.0)
    angles: tuple[float, ...] = setting("values", "or places at these angles", "rad", ())
    largest: float | None = quantity("most mass in one place", "kg", None)

    def __post_init__(self) -> None:
        self.require_positive("radius", "largest")
        if self.first and not self.places:
            raise SettingError("first", "'first' belongs to places", "places: 12")
        if len({round(angle % (2 * np.pi), 9) for angle in self.angles}) < len(self.angles):
            raise SettingError("angles", "an angle is named twice", "name each place once")
        if self.places and self.angles:
            raise SettingError("angles", "'places' and 'angles' exclude each other", "keep one")
        if self.at.size and (self.at.size < 3 or self.radius is None):
            what = "'places' needs a radius, and three places at least"
            raise SettingError("angles" if self.angles else "places", what, "radius: 120 mm")
        if self.largest is not None and not self.at.size:
            raise SettingError("largest", "'largest' belongs to places", "places: 12")

    @property
    def at(self) -> FloatArray:
        """Angles of the places, (n_place,) [rad], none for any angle."""
        evenly = self.first + 2 * np.pi * np.arange(self.places) / max(self.places, 1)
        return np.array(self.angles) if self.angles else evenly


@dataclass(frozen=True)
class BalanceFile:
    """*planes* and *lines* (sensors at a speed) by name; *unit* of readings; *prior* of a model."""

    path: Path
    settings: BalanceSettings
    planes: dict[str, PlaneSettings]
    lines: tuple[str, ...]
    unit: str
    runs: tuple[BalanceRun, ...]
    noise: ReadingNoise
    prior: Influence | None = None


def model(path: Path, planes: Sequence[str], lines: Sequence[str]) -> tuple[Influence, tuple[str, ...]]:
    """What a rotor's tests say of these *planes* and *lines*, or all lines, and the lines; ConfigError for a
    result without it, and for names that it does not have.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))["rotor_system"]["balance"]["influence"]
        names = {"plane": list(stored["planes"]), "reading": list(stored["readings"])}
        n_plane, n_line = len(names["plane"]), len(names["reading"])
        shape = (2, n_line, n_plane + 1)
        mean, root = np.array(stored["mean"]).reshape(shape), np.array(stored["root"]).reshape(*shape, -1)
        widened = float(stored.get("widened", 1.0))
    except (ValueError, KeyError, TypeError, UnicodeDecodeError) as error:
        hint = "a result of a pipeline whose rotor_system has balance_speeds"
        raise ConfigError("holds no influence of a rotor's planes", path, hint) from error
    lines = tuple(lines) or tuple(names["reading"])
    for what, asked in (("plane", planes), ("reading", lines)):
        for name in asked:
            if name not in names[what]:
                there = nearest(name, names[what])
                raise ConfigError(f"the model has no {what} '{name}'", path, there)
    # Planes that are not named carry no weights.
    columns = [0, *(1 + names["plane"].index(name) for name in planes)]
    rows = [names["reading"].index(name) for name in lines]
    mean, root = (part[:, rows][:, :, columns] for part in (mean, root))
    flat = root.reshape(mean.size, -1)
    modelled = Influence(mean[0] + 1j * mean[1], flat @ flat.T, modelled=True)
    narrow = replace(modelled, joint=modelled.joint / widened**2) if widened > 1 else None
    return replace(modelled, narrow=narrow), lines


def load_balance(path: Path, overrides: Iterable[str] = ()) -> BalanceFile:
    """The content of a balance file; ConfigErrors with every fault at its place."""
    tree = load_marked(path, overrides)
    faults = Faults(path.parent)
    entries = faults.mapping(tree, "")
    plain = {name: entry for name, entry in entries.items() if name not in LISTS}
    settings = read_settings(BalanceSettings, Marked(plain, tree.where, tree.key_where), "", faults)
    planes, read = _planes(entries["planes"], faults) if "planes" in entries else {}, len(faults)
    if not (planes or read):
        faults.add(entries.get("planes", tree), "planes", "a plane is needed", "planes: [left, right]")
    named: dict[str, Vectors] = {}
    units: dict[str, str] = {}
    nodes = entries["runs"].content if "runs" in entries else []
    alone = settings is not None and bool(settings.model)
    if not isinstance(nodes, list) or not (nodes or alone):
        faults.add(entries.get("runs", tree), "runs", "a list of runs is needed", "the first is as found")
        nodes = []
    for number, node in enumerate(nodes, 1):
        _read_run(node, join("runs", str(number)), planes, units, named, faults)
    unit = units.get("", "m")
    floor = _floor(entries["noise"], unit, faults) if settings is not None and settings.noise else 0.0
    faults.raise_any()
    assert settings is not None
    noise = ReadingNoise(floor, settings.repeatability, settings.weight_uncertainty)
    lines = tuple(dict.fromkeys(line for _, readings in named.values() for line in readings))
    prior = None
    if settings.model:
        if unit != "m":
            raise ConfigError("a model needs readings of displacement", path, "in um")
        prior, lines = model(path.parent / settings.model, list(planes), lines)
    if settings.grade is not None and len(lines) < len(planes):
        what = f"grade: {len(lines)} reading(s) do not determine the unbalance in {len(planes)} planes"
        raise ConfigError(what, entries["grade"].place, "more sensors or speeds, or no grade")
    missing = complex(np.nan, np.nan)
    runs = tuple(
        BalanceRun(
            name, np.array([w.get(n, 0j) for n in planes]), np.array([z.get(n, missing) for n in lines])
        )
        for name, (w, z) in named.items()
    )
    _check_noise(path, runs, lines, noise)
    return BalanceFile(path, settings, planes, lines, unit, runs, noise, prior)


def _floor(node: Marked, unit: str, faults: Faults) -> float:
    with faults.of_unit(node, "noise"):
        floor = parse_value(node.text, unit)
        if floor < 0:
            faults.add(node, "noise", "a scatter cannot be negative")
        return floor
    return 0.0


def _check_noise(path: Path, runs: Sequence[BalanceRun], lines: Sequence[str], noise: ReadingNoise) -> None:
    for run in runs:
        for line, variance in zip(lines, noise.variance(run.readings), strict=True):
            if variance == 0:
                what = f"reading {line} of run '{run.name}' has no scatter, as if it were exact"
                raise ConfigError(what, path, "noise: 0.2 um, for example")


def _planes(node: Marked, faults: Faults) -> dict[str, PlaneSettings]:
    if isinstance(node.content, list):
        names = [entry.text for entry in node.content]
        for entry in node.content:
            if names.count(entry.text) > 1:
                faults.add(entry, "planes", f"'{entry.text}' is named twice")
        return {name: PlaneSettings() for name in names}
    planes = {}
    for name, entry in faults.mapping(node, "planes").items() if node.content else ():
        empty = Marked({}, entry.where, entry.key_where) if entry.content is None else entry
        planes[name] = read_settings(PlaneSettings, empty, join("planes", name), faults) or PlaneSettings()
    return planes


def _read_run(
    node: Marked,
    key: str,
    planes: dict[str, PlaneSettings],
    units: dict[str, str],
    named: dict[str, Vectors],
    faults: Faults,
) -> None:
    """Add a run to *named*; readings of all runs have the dimension of the first."""
    entries = faults.mapping(node, key)
    if not isinstance(node.content, dict):
        return
    faults.unknown_keys(node, key, ("name", "weights", "readings"))
    vectors: dict[str, dict[str, complex]] = {"weights": {}, "readings": {}}
    for part, into in vectors.items():
        given = faults.mapping(entries[part], join(key, part)) if part in entries else {}
        for name, entry in given.items():
            place = join(key, part, name)
            if part == "weights" and name not in planes:
                faults.add(entry, place, "there is no such plane", f"planes: {', '.join(planes) or 'none'}")
                continue
            with faults.of_unit(entry, place):
                if part == "readings":
                    units.setdefault("", _si_of(entry.text))
                unit = "kg.m" if part == "weights" else units[""]
                if " at " not in entry.text:
                    raise UnitError(f"'{entry.text}' is not a vector", f"write it as 12 {unit} at 30 deg")
                into[name] = parse_phasor(entry.text, unit)
    if "readings" not in entries or entries["readings"].content == {}:
        faults.add(node, join(key, "readings"), "are missing", "readings: {A: 8.5 um at 60 deg}")
    name = faults.text(entries, key, "name") or f"run {len(named) + 1}"
    if name in named:
        faults.add(node, join(key, "name"), f"'{name}' is the name of an earlier run")
    named[name] = (vectors["weights"], vectors["readings"])


def _si_of(text: str) -> str:
    written = written_unit(text.partition(" at ")[0])
    for unit in ("m", "m/s", "m/s^2"):
        try:
            parse_value(f"1 {written}", unit)
        except UnitError:
            continue
        return unit
    raise UnitError(f"'{text}' is not a reading of a motion", "write it as 8.5 um at 60 deg, or in mm/s")


@dataclass(frozen=True)
class OtherMark:
    """How angles count against a model's: *mirrored*, *turned* [rad], those of the *weights* as well."""

    mirrored: bool = False
    turned: float = 0.0
    weights: bool = False

    def apply(self, run: BalanceRun) -> BalanceRun:
        turn = np.exp(1j * self.turned)
        readings = turn * (run.readings.conj() if self.mirrored else run.readings)
        return replace(run, readings=readings, weights=run.weights * (turn if self.weights else 1.0))


@dataclass(frozen=True)
class Balanced:
    """*knowledge* of the influence, *weights* (n_plane,) [kg m], of planes with a radius *masses* by angle
    [rad, kg], the *residual*, and what is expected after each of *next_runs* [unit of the readings].
    *widened*: factor on all errors, since the readings scatter more than was stated. intervals: of the
    weights that would leave nothing, none where readings are fewer than planes. *mark*: how
    their angles count where they agree otherwise than as given.
    """

    file: BalanceFile
    knowledge: Influence
    weights: ComplexArray
    masses: dict[str, tuple[tuple[float, float], ...]]
    residual: RemainingVibration
    next_runs: dict[str, float]
    widened: float = 1.0
    intervals: tuple[WeightInterval, ...] = ()
    mark: OtherMark = OtherMark()

    @property
    def permissible(self) -> float | None:
        """Unbalance [kg m] that the grade permits to remain; None without a grade."""
        settings = self.file.settings
        if settings.grade is None or settings.mass is None or settings.speed is None:
            return None
        return permissible_unbalance(settings.grade, settings.mass, settings.speed)


def permissible_unbalance(grade: float, mass: float, speed: float) -> float:
    """U = G m / Omega [kg m] of a *grade* [m/s], a *mass* [kg] and a service *speed* [Hz] (ISO 21940-11)."""
    return grade * mass / (2 * np.pi * speed)


def balance(file: BalanceFile) -> Balanced:
    """Weights, what they leave, what one more run would change; DataError for runs that do not do."""
    with locate_errors(file.path):
        knowledge = influence(file.runs, file.noise, file.prior)
    # Readings that contradict what was stated have errors as large as they show (Birge 1932).
    unlikely = knowledge.dof > 0 and chi2_tail(knowledge.misfit, knowledge.dof) < UNLIKELY
    widened = float(np.sqrt(knowledge.misfit / knowledge.dof)) if unlikely else 1.0
    knowledge, noise = knowledge.widen(widened), file.noise
    if not knowledge.modelled:
        noise = ReadingNoise(*(widened * size for size in (noise.floor, noise.share, noise.weight)))
    weights, masses = _choose_weights(file, knowledge)
    trial = max([float(np.max(np.abs(run.weights))) for run in file.runs], default=0.0)
    trial = trial or float(np.max(np.abs(weights)))
    names = [*(f"a trial weight in plane {name}" for name in file.planes), "the weights themselves"]
    candidates = dict(zip(names, [*(trial * np.eye(len(file.planes), dtype=complex)), weights], strict=True))
    expected = next_runs(knowledge, noise, candidates)
    residual = residual_of(knowledge, weights, noise)
    intervals = weight_intervals(knowledge, weights)
    mark = _other_mark(file) if unlikely else OtherMark()
    return Balanced(file, knowledge, weights, masses, residual, expected, widened, intervals, mark)


def _other_mark(file: BalanceFile) -> OtherMark:
    """How angles count where the readings agree with weights, and a model, which has a mark of its own."""

    def misfit(turned: FloatArray, mark: OtherMark) -> float:
        runs = [replace(mark, turned=turned.item()).apply(run) for run in file.runs]
        return influence(runs, file.noise, file.prior).misfit

    dof = influence(file.runs, file.noise, file.prior).dof
    if chi2_tail(misfit(np.zeros(1), OtherMark(True)), dof) >= UNLIKELY:
        return OtherMark(True)
    for mirrored, weights in itertools.product((False, True), repeat=2) if file.prior else ():
        mark = OtherMark(mirrored, weights=weights)
        # Every 10 degrees, then down from the best.
        angle, least, *_ = brute(misfit, ((0, 2 * np.pi),), (mark,), Ns=37, full_output=True)
        if chi2_tail(float(least), dof - 1) >= UNLIKELY:
            return replace(mark, turned=float(np.mod(angle[0], 2 * np.pi)))
    return OtherMark()


def _choose_weights(
    file: BalanceFile, knowledge: Influence
) -> tuple[ComplexArray, dict[str, tuple[tuple[float, float], ...]]]:
    planes = file.planes.items()
    if not any(plane.at.size for _, plane in planes):
        weights = best_weights(knowledge.square)
        angles, sizes = (np.angle(weights) % (2 * np.pi)).tolist(), np.abs(weights).tolist()
        rows = zip(planes, angles, sizes, strict=True)
        return weights, {n: ((angle, size / p.radius),) for (n, p), angle, size in rows if p.radius}
    places = [_places(*entry) for entry in planes]
    sets = list(zip(file.planes, places, placed_weights(knowledge, places), strict=True))
    masses = {name: np.stack([at.angles, mass], axis=1)[mass > 0] for name, at, mass in sets}
    weights = np.array([at.radius * (mass @ np.exp(1j * at.angles)) for _, at, mass in sets])
    return weights, {name: tuple(map(tuple, rows.tolist())) for name, rows in masses.items()}


def _places(name: str, plane: PlaneSettings) -> Places:
    if not plane.at.size or plane.radius is None:
        what = f"planes.{name}: 'places' are needed where another plane has them"
        raise ConfigError(what, hint="places: 12")
    return Places(plane.at, plane.radius, np.inf if plane.largest is None else plane.largest)


def balance_entry(result: Balanced) -> dict[str, Any]:
    """The result as `labpipe balance --json` writes it, SI units, angles in rad."""
    residual, file = result.residual, result.file
    intervals = [
        {"size_ci95": list(of.size), "angle_ci95": None if of.angle is None else list(of.angle)}
        for of in result.intervals
    ]
    by_line = zip(file.lines, residual.amplitudes, residual.low, residual.high, strict=True)
    return {
        "schema": "labpipe/balance/1",
        "title": file.settings.title,
        "weights": [
            {
                "plane": name,
                "size": float(np.abs(weight)),
                "unit": "kg.m",
                "angle": float(np.angle(weight) % (2 * np.pi)),
                "masses": [{"angle": angle, "mass": mass} for angle, mass in result.masses.get(name, ())],
                **interval,
            }
            for name, weight, interval in zip(
                file.planes, result.weights, intervals or [{}] * len(file.planes), strict=True
            )
        ],
        "residual": {
            "rms": residual.rms,
            "ci95": list(residual.interval),
            "before": residual.before,
            "unit": file.unit,
        },
        "readings": [
            {"name": name, "expected": float(middle), "ci95": [float(low), float(high)]}
            for name, middle, low, high in by_line
        ],
        "unbalance_left": [
            {"plane": name, "upper95": float(upper), "unit": "kg.m"}
            for name, upper in zip(file.planes, residual.unbalance, strict=True)
            # Fewer readings than planes tell the least of all unbalances that explain them.
            if len(file.lines) >= len(file.planes)
        ],
        "permissible": result.permissible,
        "chi2": {"value": result.knowledge.misfit, "dof": result.knowledge.dof},
        "widened": result.widened,
        "mirrored": result.mark.mirrored,
        "turned": result.mark.turned,
        "next_runs": dict(result.next_runs),
    }
