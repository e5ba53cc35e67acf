"""labpipe balance FILE: balancing by influence coefficients, vibration z = z_0 + sum_q alpha_q w_q of every
reading.

Noise leaves z_0 and alpha uncertain; the weights are those of the least expected square of the vibration that
is left, which do not trust an influence that is hardly known; without noise they are -pinv(alpha) z_0
(Goodman 1964; Darlow 1989).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import optimize

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, DataError
from labpipe.project.marked_yaml import Marked, load_marked, set_entry
from labpipe.project.settings_reader import Faults, join, read_settings
from labpipe.quantities import UnitError, parse_value, written_unit
from labpipe.records.settings import Settings, quantity, setting

# Draws of z_0 and alpha by which intervals are stated, and their seed.
DRAWS, SEED = 4000, 20261125
# Truths over which one more run is looked at.
TRIED = 200
COVERED = (2.5, 97.5)


@dataclass(frozen=True)
class Run:
    """One run: added *weights* (n_plane,) [kg m], complex, as all angles in the direction of spin, and
    *readings* (n_line,), complex, NaN where there is none.
    """

    name: str
    weights: ComplexArray
    readings: ComplexArray


@dataclass(frozen=True)
class Noise:
    """Standard uncertainty of one component of a reading: *floor* [unit of the reading], and a *share* [1] of
    its amplitude, of what repeats when nothing is changed.
    """

    floor: float
    share: float

    def variance(self, readings: ComplexArray) -> FloatArray:
        """Of the complex readings, both components together, (n_run,) [unit of the reading squared]."""
        return np.asarray(2 * self.floor**2 + (self.share * np.abs(readings)) ** 2)


@dataclass(frozen=True)
class Influence:
    """z_0 and alpha of every line: *mean* (n_line, n_plane + 1) [unit of the readings, per kg m] and their
    complex *covariance* (n_line, n_plane + 1, n_plane + 1); *misfit* chi-square of the readings, its *dof*.
    """

    mean: ComplexArray
    covariance: ComplexArray
    misfit: float
    dof: int

    def expected_square(self, weights: ComplexArray) -> float:
        """Sum over the lines of E |z_0 + alpha w|^2 at *weights* (n_plane,) [kg m]."""
        whole = np.concatenate([[1.0], weights])
        middle = np.sum(np.abs(self.mean @ whole) ** 2)
        return float(
            middle + np.einsum("i,lij,j->", whole.conj(), self.covariance.swapaxes(1, 2), whole).real
        )

    def quadratic(self) -> tuple[ComplexArray, ComplexArray]:
        """A (n_plane, n_plane) [unit^2/(kg m)^2] and b (n_plane,) [unit^2/(kg m)] of the expected square
        w^H A w + 2 Re b^H w + constant, in the unit of the readings.
        """
        second = np.einsum("li,lj->ij", self.mean.conj(), self.mean) + self.covariance.sum(axis=0).T
        return second[1:, 1:], second[1:, 0]

    def draws(self, n: int = DRAWS) -> ComplexArray:
        """Drawn z_0 and alpha, (n, n_line, n_plane + 1) [unit of the readings, per kg m]."""
        rng = np.random.default_rng(SEED)
        shape = (n, *self.mean.shape)
        normal = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0))[:, None, :]
        return np.asarray(self.mean + np.einsum("lij,nlj->nli", root, normal))


def influence(runs: Sequence[Run], noise: Noise) -> Influence:
    """z_0 and alpha by weighted least squares of all runs, line by line.

    DataError where the runs do not determine them: a plane without a trial weight, too few runs.
    """
    design = np.array([np.concatenate([[1.0], run.weights]) for run in runs])
    readings = np.array([run.readings for run in runs])
    n_line, n_unknown = readings.shape[1], design.shape[1]
    means = np.empty((n_line, n_unknown), np.complex128)
    covariances = np.empty((n_line, n_unknown, n_unknown), np.complex128)
    misfit, dof = 0.0, 0
    scale = np.max(np.abs(design), axis=0)
    for line in range(n_line):
        there = np.isfinite(readings[:, line])
        rows, z = design[there] / np.where(scale > 0, scale, 1.0), readings[there, line]
        if np.linalg.matrix_rank(rows, tol=1e-6) < n_unknown:
            raise DataError(
                f"{len(z)} runs with readings do not determine the influence of {n_unknown - 1} plane(s)",
                hint="a run as found, and one for each plane with a trial weight there",
            )
        weight = 1 / noise.variance(z)
        information = (rows.conj().T * weight) @ rows
        inverse = np.linalg.inv(information)
        mean = inverse @ (rows.conj().T @ (weight * z))
        residual = z - rows @ mean
        misfit += float(2 * np.sum(weight * np.abs(residual) ** 2))
        dof += 2 * (len(z) - n_unknown)
        means[line] = mean / scale
        covariances[line] = inverse / np.outer(scale, scale)
    return Influence(means, covariances, misfit, dof)


def best_weights(known: Influence) -> ComplexArray:
    """The weights (n_plane,) [kg m] of the least expected square of the vibration that is left."""
    square, linear = known.quadratic()
    return np.asarray(-np.linalg.solve(square, linear))


@dataclass(frozen=True)
class Places:
    """Where weights can be set in a plane: *angles* (n_place,) [rad] at *radius* [m], at most *largest* [kg]
    in each.
    """

    angles: FloatArray
    radius: float
    largest: float = np.inf


def placed_weights(known: Influence, places: Sequence[Places]) -> list[FloatArray]:
    """Masses [kg] in every place of every plane, (n_place,) each: the least expected square that masses from
    zero to the largest can reach, by as little mass as that takes.
    """
    square, linear = known.quadratic()
    directions = [place.radius * np.exp(1j * place.angles) for place in places]
    onto = np.zeros((len(places), sum(d.size for d in directions)), np.complex128)
    ends = np.cumsum([0, *(direction.size for direction in directions)])
    for plane, direction in enumerate(directions):
        onto[plane, ends[plane] : ends[plane + 1]] = direction
    root = np.linalg.cholesky(square).conj().T
    rows, side = root @ onto, -np.linalg.solve(root.conj().T, linear)
    largest = np.concatenate([np.full(place.angles.size, place.largest) for place in places])
    scale = float(np.max(np.abs(rows)))
    reached = optimize.lsq_linear(
        np.concatenate([rows.real, rows.imag]) / scale,
        np.concatenate([side.real, side.imag]) / scale,
        (0.0, largest),
        method="bvls",
        tol=1e-14,
        max_iter=1000,
    ).x
    # Many masses make one vector: the least of them stand in two places, and in those that are full.
    masses = []
    for plane, (direction, place) in enumerate(zip(directions, places, strict=True)):
        target = direction @ reached[ends[plane] : ends[plane + 1]]
        ends_of_mass = (0.0, place.largest if np.isfinite(place.largest) else None)
        least = optimize.linprog(
            np.ones(direction.size),
            A_eq=np.array([direction.real, direction.imag]) / place.radius,
            b_eq=np.array([target.real, target.imag]) / place.radius,
            bounds=ends_of_mass,
        )
        masses.append(least.x if least.success else reached[ends[plane] : ends[plane + 1]])
    return masses


@dataclass(frozen=True)
class Residual:
    """What the weights are expected to leave: root mean square over the lines *rms* with its 95 % interval,
    of what it was *before*; amplitudes of each line (n_line,) with theirs [unit of the readings]; *unbalance*
    (n_plane,) [kg m] that is left, upper ends of 95 %.
    """

    rms: float
    interval: tuple[float, float]
    before: float
    amplitudes: FloatArray
    low: FloatArray
    high: FloatArray
    unbalance: FloatArray


def residual_of(known: Influence, weights: ComplexArray, noise: Noise) -> Residual:
    """The vibration with *weights* (n_plane,) [kg m] set, as a reading shows it, by draws."""
    drawn = known.draws()
    whole = np.concatenate([[1.0], weights])
    left = _drawn_residual(known, drawn, whole)
    rng = np.random.default_rng(SEED + 1)
    spread = np.sqrt(noise.variance(left) / 2)
    left = left + spread * (rng.standard_normal(left.shape) + 1j * rng.standard_normal(left.shape))
    rms = np.sqrt(np.mean(np.abs(left) ** 2, axis=1))
    low, high = np.percentile(np.abs(left), COVERED, axis=0)
    ends = np.percentile(rms, COVERED)
    before = float(np.sqrt(np.mean(np.abs(known.mean[:, 0]) ** 2)))
    unbalance = np.array([np.linalg.pinv(draw[:, 1:]) @ draw[:, 0] + weights for draw in drawn[:400]])
    upper = np.percentile(np.abs(unbalance), 95, axis=0)
    amplitudes = np.sqrt(np.mean(np.abs(left) ** 2, axis=0))
    interval = (float(ends[0]), float(ends[1]))
    return Residual(float(np.sqrt(np.mean(rms**2))), interval, before, amplitudes, low, high, upper)


def _drawn_residual(known: Influence, drawn: ComplexArray, whole: ComplexArray) -> ComplexArray:
    """z_0 + alpha w of the *drawn* z_0 and alpha, (n, n_line) [unit of the readings].

    What weights in these planes cannot change of the estimated vibration is noise as far as its size is that
    of noise (empirical Bayes): unbalance in the planes themselves leaves nothing of that kind.
    """
    middle = known.mean @ whole
    errors = drawn @ whole - middle
    n_line, n_plane = middle.size, whole.size - 1
    if n_line <= n_plane:
        return np.asarray(middle + errors)
    basis = np.linalg.svd(known.mean[:, 1:], full_matrices=False)[0]
    within = errors @ basis.conj() @ basis.T
    beyond, fixed = errors - within, middle - basis @ (basis.conj().T @ middle)
    # Their common variance, by its posterior under a prior flat in the logarithm.
    n_free = n_line - n_plane
    noise = float(np.mean(np.sum(np.abs(beyond) ** 2, axis=1))) / n_free
    size = np.sum(np.abs(fixed) ** 2) / np.random.default_rng(SEED + 3).gamma(n_free, size=drawn.shape[0])
    share = np.maximum(1 - noise / np.maximum(size, 1e-300), 0.0)[:, None]
    return np.asarray(middle - fixed + within + share * fixed + np.sqrt(share) * beyond)


def next_runs(known: Influence, noise: Noise, candidates: Mapping[str, ComplexArray]) -> dict[str, float]:
    """Expected root mean square of what is left [unit of the readings] if one more run were made first, with
    the weights (n_plane,) [kg m] of each candidate, and the weights chosen anew by it.

    Over draws of the truth: its readings move the mean and narrow z_0 and alpha (preposterior analysis).
    """
    n_line = known.mean.shape[0]
    rng = np.random.default_rng(SEED + 2)
    truths = known.draws(TRIED)
    for truth in truths:
        # Unbalance in the planes: what they cannot make is no part of the truth.
        truth[:, 0] = truth[:, 1:] @ (np.linalg.pinv(truth[:, 1:]) @ truth[:, 0])
    scatter = (rng.standard_normal((TRIED, n_line)) + 1j * rng.standard_normal((TRIED, n_line))) / np.sqrt(2)
    expected = {}
    for name, weights in candidates.items():
        whole = np.concatenate([[1.0], weights])
        variance = noise.variance(known.mean @ whole)
        spread = known.covariance @ whole.conj()
        total = (spread @ whole).real + variance
        narrowed = known.covariance - spread[:, :, None] * spread[:, None, :].conj() / total[:, None, None]
        squares = []
        for truth, normal in zip(truths, scatter, strict=True):
            surprise = (truth - known.mean) @ whole + np.sqrt(variance) * normal
            moved = known.mean + spread * (surprise / total)[:, None]
            chosen = best_weights(Influence(moved, narrowed, known.misfit, known.dof))
            squares.append(np.sum(np.abs(truth @ np.concatenate([[1.0], chosen])) ** 2))
        expected[name] = float(np.sqrt(np.mean(squares) / n_line))
    return expected


LISTS = ("planes", "runs")


@dataclass(frozen=True)
class BalanceSettings(Settings):
    """The plain entries of a balance file; planes and runs are read by themselves."""

    title: str = setting("text", "title of the report", default="")
    _: KW_ONLY
    repeatability: float = quantity(
        "scatter of a reading when nothing is changed, as a share of it (standard)", "1", 0.02
    )
    noise: str = setting(
        "text", "scatter that does not depend on the reading, e.g. 0.2 um (standard)", default=""
    )
    mass: float | None = quantity("mass of the rotor, for a grade", "kg", None)
    speed: float | None = quantity("service speed, for a grade", "Hz", None)
    grade: float | None = quantity("balance quality grade asked for, e.g. 2.5 mm/s for G 2.5", "m/s", None)


@dataclass(frozen=True)
class PlaneSettings(Settings):
    """One entry of ``planes:``: where weights can be set in it."""

    radius: float | None = quantity("at which weights are set; needed for masses", "m", None)
    places: int = setting("integer", "evenly spread places for weights; 0: any angle", default=0)
    first: float = quantity("angle of the first place", "rad", 0.0)
    largest: float | None = quantity("most mass in one place", "kg", None)

    def __post_init__(self) -> None:
        if self.places and (self.places < 3 or self.radius is None):
            what = "'places' needs a radius, and three places at least"
            raise ConfigError(what, hint="radius: 120 mm", field="places")
        if self.largest is not None and not self.places:
            raise ConfigError("'largest' is of places", hint="places: 12", field="largest")


@dataclass(frozen=True)
class BalanceFile:
    """A balance file; *planes* and *lines* (sensor, or sensor at a speed) by name; *unit* of all readings."""

    path: Path
    settings: BalanceSettings
    planes: dict[str, PlaneSettings]
    lines: tuple[str, ...]
    unit: str
    runs: tuple[Run, ...]
    noise: Noise


def polar(text: str, unit: str) -> complex:
    """A vector `8.5 um at 60 deg` in the SI *unit*; UnitError where it is none."""
    size, mark, angle = text.partition(" at ")
    if not mark:
        raise UnitError(f"'{text}' is no vector", f"write it as 12 {unit} at 30 deg")
    return parse_value(size, unit) * complex(np.exp(1j * parse_value(angle, "rad")))


def load_balance(path: Path, overrides: Iterable[str] = ()) -> BalanceFile:
    """The content of a balance file; ConfigErrors with every fault at its place."""
    tree = load_marked(path)
    for assignment in overrides:
        set_entry(tree, assignment)
    faults = Faults(path.parent)
    entries = faults.mapping(tree, "")
    plain = {name: entry for name, entry in entries.items() if name not in LISTS}
    settings = read_settings(BalanceSettings, Marked(plain, tree.where, tree.key_where), "", faults)
    planes = _planes(entries.get("planes", tree), faults)
    named: dict[str, tuple[dict[str, complex], dict[str, complex]]] = {}
    units: dict[str, str] = {}
    nodes = entries["runs"].content if "runs" in entries else None
    if not isinstance(nodes, list) or not nodes:
        faults.add(entries.get("runs", tree), "runs", "a list of runs is needed", "the first is as found")
        nodes = []
    for number, node in enumerate(nodes, 1):
        _read_run(node, join("runs", str(number)), planes, units, named, faults)
    faults.raise_any()
    assert settings is not None
    unit = next(iter(units.values()), "1")
    noise = Noise(parse_value(settings.noise, unit) if settings.noise else 0.0, settings.repeatability)
    lines = tuple(dict.fromkeys(line for _, readings in named.values() for line in readings))
    missing = complex(np.nan, np.nan)
    runs = tuple(
        Run(
            name,
            np.array([weights.get(plane, 0j) for plane in planes]),
            np.array([readings.get(line, missing) for line in lines]),
        )
        for name, (weights, readings) in named.items()
    )
    return BalanceFile(path, settings, planes, lines, unit, runs, noise)


def _planes(node: Marked, faults: Faults) -> dict[str, PlaneSettings]:
    if isinstance(node.content, list):
        return {entry.text: PlaneSettings() for entry in node.content}
    planes = {}
    for name, entry in faults.mapping(node, "planes").items() if node.content else ():
        empty = Marked({}, entry.where, entry.key_where) if entry.content is None else entry
        settings = read_settings(PlaneSettings, empty, join("planes", name), faults)
        if settings is not None:
            planes[name] = settings
    return planes


def _read_run(
    node: Marked,
    key: str,
    planes: dict[str, PlaneSettings],
    units: dict[str, str],
    named: dict[str, tuple[dict[str, complex], dict[str, complex]]],
    faults: Faults,
) -> None:
    """Add a run to *named*; readings of all runs have the dimension of the first."""
    entries = faults.mapping(node, key)
    faults.unknown_keys(node, key, ("name", "weights", "readings"))
    vectors: dict[str, dict[str, complex]] = {"weights": {}, "readings": {}}
    for part, into in vectors.items():
        for name, entry in (
            faults.mapping(entries[part], join(key, part)) if part in entries else {}
        ).items():
            place = join(key, part, name)
            if part == "weights" and name not in planes:
                faults.add(entry, place, "there is no such plane", f"planes: {', '.join(planes) or 'none'}")
                continue
            try:
                if part == "readings":
                    units.setdefault("", _si_of(entry.text))
                into[name] = polar(entry.text, "kg.m" if part == "weights" else units[""])
            except UnitError as error:
                faults.add_unit(entry, place, error)
    if not vectors["readings"]:
        faults.add(node, join(key, "readings"), "are missing", "readings: {A: 8.5 um at 60 deg}")
    name = entries["name"].text if "name" in entries else f"run {len(named) + 1}"
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
    raise UnitError(f"'{text}' is no reading of a motion", "write it as 8.5 um at 60 deg, or in mm/s")


@dataclass(frozen=True)
class Balanced:
    """What follows: *known* influence, *weights* (n_plane,) [kg m] and, where there are places, the *masses*
    [kg] of each plane by angle [rad]; the *residual*; what is expected after each of *next_runs* [unit of the
    readings].
    """

    file: BalanceFile
    known: Influence
    weights: ComplexArray
    masses: dict[str, tuple[tuple[float, float], ...]]
    residual: Residual
    next_runs: dict[str, float]

    @property
    def permissible(self) -> float | None:
        """Permissible residual unbalance of the rotor, U = G m / Omega, [kg m] (ISO 21940-11).

        None where no grade is asked for.
        """
        settings = self.file.settings
        if settings.grade is None or settings.mass is None or settings.speed is None:
            return None
        return settings.grade * settings.mass / (2 * np.pi * settings.speed)


def balanced(file: BalanceFile) -> Balanced:
    """Weights, what they leave, and what one more run would change; DataError for runs that do not do."""
    try:
        known = influence(file.runs, file.noise)
    except DataError as error:
        error.where = error.where or str(file.path)
        raise
    weights, masses = best_weights(known), {}
    if any(plane.places for plane in file.planes.values()):
        places = [_places(name, plane) for name, plane in file.planes.items()]
        chosen = placed_weights(known, places)
        weights = np.array(
            [
                place.radius * (mass @ np.exp(1j * place.angles))
                for mass, place in zip(chosen, places, strict=True)
            ]
        )
        for name, mass, place in zip(file.planes, chosen, places, strict=True):
            masses[name] = tuple(
                (float(a), float(m)) for a, m in zip(place.angles, mass, strict=True) if m > 0
            )
    trial = max(float(np.max(np.abs(run.weights))) for run in file.runs)
    candidates = {
        f"a trial weight in plane {name}": trial * np.eye(len(file.planes))[number].astype(complex)
        for number, name in enumerate(file.planes)
    }
    candidates["the weights themselves"] = weights
    expected = next_runs(known, file.noise, candidates)
    return Balanced(file, known, weights, masses, residual_of(known, weights, file.noise), expected)


def _places(name: str, plane: PlaneSettings) -> Places:
    if not plane.places or plane.radius is None:
        raise ConfigError(
            f"planes.{name}: 'places' are needed where another plane has them", hint="places: 12"
        )
    angles = plane.first + 2 * np.pi * np.arange(plane.places) / plane.places
    return Places(angles, plane.radius, np.inf if plane.largest is None else plane.largest)


def balance_entry(result: Balanced) -> dict[str, Any]:
    """The result as `labpipe balance --json` writes it, SI units, angles in rad."""
    residual, file = result.residual, result.file
    return {
        "schema": "labpipe/balance/1",
        "weights": [
            {
                "plane": name,
                "size": float(np.abs(weight)),
                "unit": "kg.m",
                "angle": float(np.angle(weight) % (2 * np.pi)),
                "masses": [{"angle": angle, "mass": mass} for angle, mass in result.masses.get(name, ())],
            }
            for name, weight in zip(file.planes, result.weights, strict=True)
        ],
        "residual": {
            "rms": residual.rms,
            "ci95": list(residual.interval),
            "before": residual.before,
            "unit": file.unit,
        },
        "readings": [
            {"name": name, "expected": float(middle), "ci95": [float(low), float(high)]}
            for name, middle, low, high in zip(
                file.lines, residual.amplitudes, residual.low, residual.high, strict=True
            )
        ],
        "unbalance_left": [
            {"plane": name, "upper95": float(upper), "unit": "kg.m"}
            for name, upper in zip(file.planes, residual.unbalance, strict=True)
        ],
        "permissible": result.permissible,
        "chi2": {"value": result.known.misfit, "dof": result.known.dof},
        "next_runs": dict(result.next_runs),
    }
