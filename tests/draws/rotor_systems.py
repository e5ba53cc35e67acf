"""Rotors drawn from what is declared, all their tests together: are unknowns and predictions held?

python -m tests.draws.rotor_systems [KIND ...] [--draws N] [--seconds S] [--seed S]; `raw` records every test
and runs the pipeline from the raw files, the others take four tests (free modes, responses at rest, a run-up
to .85 of the first critical speed, deflections and weight) as numbers. Kinds: none (truth as declared), exact
(no small errors), disc (inertias 30 % off), shaft (elements 5 % off), probe (phases 3 deg), bearings (30 %
stiffer and 35 % more damped at speed), declared (the same, small_errors: {together: 30 %}), pedestal (missing
in the model), raw; and on other bearings: oil (two films by clearance and viscosity, shaken while it turns),
seal (cross-coupled, of any sign), magnets (controlled, their pull a negative stiffness, shaken while they
turn), warm (oil, of 60 % of the viscosity in the run-up). Of these only rotors that are stable to the end of
their run-up.

Prints how many 95 % intervals hold the truth, by prediction: frequency and decrement of the first two modes
at speed, first critical speed with amplification and peak, onset; of the unknowns; of the vibration that
weights leave, set without a trial run, by trial runs, and by both.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from labpipe.artefacts.json_file import entry_of
from labpipe.errors import LabpipeError
from labpipe.methods.balancing.balance_file import model
from labpipe.methods.balancing.influence import (
    BalanceRun,
    ReadingNoise,
    best_weights,
    influence,
    remaining_rms,
    residual_of,
    square_of,
)
from labpipe.methods.rotor.response import WhirlModes
from labpipe.methods.rotor.theory import Critical, follow, peaks
from labpipe.methods.rotor_system.build import PEDESTALS, TOGETHER, Built
from labpipe.methods.rotor_system.evaluate import FAINT, findings_of, most_probable
from labpipe.methods.rotor_system.posterior import SystemPosterior, common_changes, explanations, fit_system
from labpipe.methods.rotor_system.predictions import (
    MOST_MODES,
    at_speed,
    campbell,
    critical_speeds,
    drawn_influence,
    interval_of,
    onset,
    stated_influence,
    unbalance_forces,
)
from labpipe.methods.rotor_system.records import InfluenceResult
from tests.methods.rotor_system.two_discs import built, dof, drawn, four_tests, run_up

ROOT = Path(__file__).parent.parent.parent
OPERATING = 100.0
BEARINGS = ("oil", "seal", "magnets")
KINDS = (
    "none",
    "exact",
    "disc",
    "shaft",
    "probe",
    "bearings",
    "declared",
    "pedestal",
    *BEARINGS,
    "warm",
    "raw",
)
# Viscosity of the oil in the run-up over that in all other tests, of the kind warm.
WARM = 0.6
# Speed [Hz] at which a turning rotor is shaken, and the log decrement from which a mode is not an
# oscillation to speak of.
TURNING, DAMPED = 25.0, 10.0
# What a kind does to the small errors of a truth: group, standard deviation; a common shift.
OFF = {"shaft": ("elements", 0.05), "probe": ("phase", 0.05)}
Held = dict[str, list[bool] | list[float]]


def truth_of(kind: str, of: Built, rng: np.random.Generator) -> np.ndarray:
    values = drawn(of, rng)
    for number, unknown in enumerate(of.model.unknowns):
        if kind == "exact" and unknown.group:
            values[number] = 0.0
        if kind in OFF and unknown.group == OFF[kind][0]:
            values[number] = OFF[kind][1] * rng.standard_normal()
        if kind == "disc" and unknown.group == "inertia":
            values[number] = 0.3 * rng.choice([-1, 1])
        if kind in ("bearings", "declared") and unknown.name.endswith("running"):
            values[number] = np.log(1.35 if " c " in unknown.name else 1.3)
    return values


def bearings_of(kind: str) -> str:
    return "oil" if kind == "warm" else kind if kind in BEARINGS else ""


def fitted(kind: str, tests: list) -> tuple[Built, SystemPosterior]:
    """As the section does it: alternatives where a test misfits or small errors are large."""

    def on(this: Built, test: object) -> object:
        if getattr(test, "planes", None) is None:
            return test
        return replace(
            test, planes=tuple(this.planes.values()), gains=this.gains["run"], phases=this.phases["run"]
        )

    def fit(alternative: str) -> tuple[Built, SystemPosterior]:
        pedestals = kind != "pedestal"
        together, bearings = 0.3 if kind == "declared" else 0.0, bearings_of(kind)
        this = built(pedestals, alternative, together=together, bearings=bearings)
        found = fit_system(this.model, [on(this, test) for test in tests])
        return this, replace(found, alternative=alternative)

    names = [PEDESTALS] if kind in ("pedestal", "oil", "warm", "magnets") else []
    return most_probable(fit, [*names, *([TOGETHER] if kind != "declared" else [])])


def true_peak(of: Built, values: np.ndarray, output: int) -> Critical | None:
    speed = np.linspace(15.0, 95.0, 2000)
    omega = 2 * np.pi * speed
    forces = unbalance_forces(of, values)[:, None] * omega[:, None, None] ** 2
    (stiffness,) = of.model.dynamic(at_speed(of.model, values), omega, omega)
    motion = np.linalg.solve(stiffness, forces)[:, output]
    found = peaks(speed, np.abs(motion[:, 0]))
    return max(found, key=lambda peak: peak.amplitude) if found else None


def turning_modes(of: Built, values: np.ndarray) -> WhirlModes:
    """Modes at the operating speed, in the order of the Campbell diagram."""
    spin = 2 * np.pi * OPERATING
    roots = of.model.roots(at_speed(of.model, values), spin, 2 * MOST_MODES)
    shaft = roots.shapes[: of.model.n_shaft].reshape(-1, 4, roots.values.size)
    return WhirlModes(spin, roots.values, shaft[:, :2].transpose(2, 0, 1))


def judge(
    held: Held,
    of: Built,
    truth: np.ndarray,
    this: Built,
    found: SystemPosterior,
    peak: Critical | None,
    read: int,
) -> None:
    true = turning_modes(of, truth)
    diagram = campbell(found, np.array([OPERATING]))
    f, u = diagram.frequency[0], diagram.frequency_error[0]
    delta, v = diagram.log_decrement[0], diagram.log_decrement_error[0]
    roots = true.eigenvalues
    true_f, true_delta = roots.imag / (2 * np.pi), -2 * np.pi * roots.real / roots.imag
    # By their shapes: the second pair is so close that frequencies alone mistake one for the other.
    pairs = follow([turning_modes(this, found.values), true])
    oscillating = np.flatnonzero(delta < DAMPED)
    for mode, name in zip(oscillating[[0, 2]], "12", strict=True):
        near = pairs[1, mode]
        held[f"f{name}"].append(abs(true_f[near] - f[mode]) < 1.96 * u[mode])
        held[f"delta{name}"].append(abs(true_delta[near] - delta[mode]) < 1.96 * v[mode])
        held[f"% half-width f{name}"].append(196 * u[mode] / f[mode])
        held[f"% half-width delta{name}"].append(196 * v[mode] / delta[mode])
    output = dof("4 z")
    criticals = critical_speeds(found, this, (20.0, 90.0), OPERATING, [output], n_draw=200)
    if peak is not None and criticals:
        best = min(criticals, key=lambda each: abs(np.log(each.speed / peak.speed)))
        held["% half-width N_c"].append(50 * float(np.log(best.speed_interval[1] / best.speed_interval[0])))
        held["N_c"].append(best.speed_interval[0] < peak.speed < best.speed_interval[1])
        held["peak"].append(best.amplitude_interval[0] < peak.amplitude < best.amplitude_interval[1])
        if best.amplification_interval is not None and peak.amplification is not None:
            low, high = best.amplification_interval
            held["AF"].append(low < peak.amplification < high)
    end = onset(found, 20.0)
    growth = (
        [
            of.model.roots(at_speed(of.model, truth), 2 * np.pi * speed, slopes=False).values.real.max()
            for speed in (end[0] * np.exp(-1.96 * end[1]), end[0] * np.exp(1.96 * end[1]))
        ]
        if end
        else [-1.0, 1.0]
    )
    held["onset"].append(growth[0] < 0 < growth[1])
    names = {unknown.name: number for number, unknown in enumerate(of.model.unknowns)}
    for number, unknown in enumerate(this.model.unknowns):
        if unknown.name in names:
            off = found.values[number] - truth[names[unknown.name]]
            what = "small errors" if unknown.group else "unknowns"
            held[what].append(abs(off) < 1.96 * found.standard_errors[number])
    speeds = 60 * peak.speed * np.array([0.6, 0.72, 0.84]) if peak is not None else np.array([1600.0, 2000.0])
    predicted = drawn_influence(this, run_up(this, speeds), found.draws(200, 5))
    weights = best_weights(square_of(predicted))
    (true_influence,) = drawn_influence(of, run_up(of, speeds), truth[None])
    before, left = (remaining_rms(true_influence, acting) for acting in (0 * weights, weights))
    low, high = interval_of(remaining_rms(predicted, weights), found.widened)
    held["left"].append(low < left < high)
    held["left, upper"].append(left < high)
    held["% left"].append(100 * left / before)
    for _ in range(read):
        ways_to_balance(held, true_influence, stated_influence(this, found, run_up(this, speeds)), before)


# What readings repeat to, a trial weight in either plane [kg m], and how often the readings of a rotor are
# drawn: a single time each, eighty rotors tell a coverage to 2.4 % only.
READING, TRIAL, READ = ReadingNoise(1.5e-7, 0.01), 1.5e-4, 3


def ways_to_balance(held: Held, truth: np.ndarray, stated: InfluenceResult, before: float) -> None:
    """Weights by the model, by trial runs, and by both, set and measured again: the rms of the readings
    within its interval, and what is left without noise.
    """
    rng = np.random.default_rng([len(held["left"]), len(held["by model"])])
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "identification.json"
        entry = {"influence": entry_of(stated)}
        path.write_text(json.dumps({"rotor_system": {"balance": entry}}))
        prior, _ = model(path, stated.planes, ())

    def run(weights: np.ndarray) -> BalanceRun:
        z = truth @ np.concatenate([[1.0], weights])
        noise = rng.standard_normal(z.size) + 1j * rng.standard_normal(z.size)
        return BalanceRun("", weights, z + np.sqrt(READING.variance(z) / 2) * noise)

    trials = [run(weights) for weights in np.array([[0, 0], [TRIAL, 0], [0, TRIAL]], complex)]
    first = run(best_weights(prior.square))
    ways = {
        "model": influence([], READING, prior),
        "model, found, 1 trial": influence(trials[:2], READING, prior),
        "model, found, 2 trials": influence(trials, READING, prior),
        "model, trimmed": influence([first], READING, prior),
        "found, 2 trials": influence(trials, READING),
    }
    for name, known in ways.items():
        weights = best_weights(known.square)
        low, high = residual_of(known, weights, READING).interval
        reading = np.sqrt(np.mean(np.abs(run(weights).readings) ** 2))
        held[f"by {name}"].append(low < reading < high)
        held[f"by {name}, below"].append(reading > low)
        held[f"% left by {name}"].append(100 * remaining_rms(truth, weights) / before)


def by_numbers(kind: str, n_draw: int, seconds: float, seed: int) -> tuple[Held, Counter[str]]:
    held: Held = defaultdict(list)
    counts: Counter[str] = Counter()
    of = built(True, bearings=bearings_of(kind))
    turning = TURNING if kind in ("oil", "warm", "magnets") else 0.0
    for draw in range(n_draw):
        if time.process_time() > seconds:
            break
        counts["draws"] += 1
        rng = np.random.default_rng([seed, draw])
        while True:
            truth = truth_of(kind, of, rng)
            peak = true_peak(of, truth, dof("4 z"))
            top = 60 * 0.85 * peak.speed if peak is not None else 2300.0
            speeds = [np.pi * top / 30, 2 * np.pi * TURNING]
            at = [of.model.roots(at_speed(of.model, truth), w, 16, slopes=False).values for w in speeds]
            if not bearings_of(kind) or max(each.real.max() for each in at) < 0:
                break
            counts["unstable, drawn again"] += 1
        tests = four_tests(of, truth, rng, top, turning)
        if kind == "warm":
            warm = truth.copy()
            warm[of.model.number("oil")] *= WARM
            run = four_tests(of, warm, rng, top, turning)[2]
            tests = [run if test.name == "run" else test for test in tests]
        try:
            this, found = fitted(kind, tests)
        except LabpipeError as error:
            held["fit"].append(False)
            print("failed:", draw, error)
            continue
        held["fit"].append(True)
        counts["flagged"] += bool(found.misfits or found.enlarged or found.alternative)
        disagree = [each for each in findings_of(found) if each.code == "tests-disagree"]
        if disagree:
            first = explanations(found)[0]
            counts[f"disagree by {first.group or found.model.unknowns[first.number].name}"] += 1
        for name, was in (
            ("named", found.alternative or next(iter(found.enlarged), "nothing")),
            ("refitted", found.refits is not None),
            ("change not told", any(spread > FAINT for spread in common_changes(found).values())),
        ):
            counts[f"{name}: {was}" if name == "named" else name] += was is not False
        judge(held, of, truth, this, found, peak, 0 if bearings_of(kind) else READ)
    return held, counts


def from_raw(n_draw: int, seconds: float, seed: int) -> tuple[Held, Counter[str]]:
    """Every test recorded, the pipeline run as it stands."""
    import labpipe
    from labpipe.artefacts.writing import output_folder
    from labpipe.methods.rotor_system.virtual_rig import world_of
    from labpipe.project.simulate import load_virtual_rig, simulate_files

    held: Held = defaultdict(list)
    counts: Counter[str] = Counter()
    text = (ROOT / "pipelines/rotor-system.yaml").read_text().replace("../configs", str(ROOT / "configs"))
    for draw in range(n_draw):
        if time.process_time() > seconds:
            break
        counts["draws"] += 1
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            rig = load_virtual_rig(ROOT / "configs/virtual-rotor.yaml", [f"truth={1000 * seed + draw + 1}"])
            with output_folder(folder / "sample_data/rotor-system") as output:
                simulate_files(rig, draw, None, output)
            world = world_of(rig)
            values, model = world.values, world.built.model
            shaft = model.matrices(values, 0.0, supported=False).mass[
                0 : model.n_shaft : 4, 0 : model.n_shaft : 4
            ]
            mass = float(shaft.sum()) * (1 + 0.002 * np.random.default_rng([seed, draw]).standard_normal())
            pipeline = yaml.safe_load(text.replace("../sample_data", str(folder / "sample_data")))
            pipeline["rotor_system"]["tests"][-1]["mass"] = f"{mass} kg +- 0.2 %"
            pipeline["report"] = {"formats": []}
            (folder / "pipeline.yaml").write_text(yaml.safe_dump(pipeline, sort_keys=False))
            result = labpipe.run(folder / "pipeline.yaml", folder / "out").sections["rotor_system"]
        true = model.roots(at_speed(model, values), 2 * np.pi * result.operating)
        least = float(np.min(-2 * np.pi * true.values.real / true.values.imag))
        held["least decrement"].append(abs(result.decrement[0] - least) < 1.96 * result.decrement[1])
        names = {unknown.name: unknown for unknown in model.unknowns}
        truths = dict(zip(names, values, strict=True))
        for unknown in result.unknowns:
            if unknown.name not in truths:
                continue
            known = names[unknown.name]
            value = truths[unknown.name] if known.unit else known.nominal * np.exp(truths[unknown.name])
            what = "small errors" if unknown.group else "unknowns"
            held[what].append(abs(unknown.value - value) < 1.96 * unknown.error)
        counts["flagged"] += any(finding.level == "warning" for finding in result.findings)
        for test in result.tests:
            held["tests fit (p > 5 %)"].append(test.probability > 0.05)
    return held, counts


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kinds", nargs="*", choices=KINDS, default=[])
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=600.0, help="of the processor, for each kind")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    for kind in options.kinds or KINDS:
        held, counts = (
            from_raw(options.draws, time.process_time() + options.seconds, options.seed)
            if kind == "raw"
            else by_numbers(kind, options.draws, time.process_time() + options.seconds, options.seed)
        )
        sizes = {name: held.pop(name) for name in list(held) if name.startswith("%")}
        cells = [f"{name} {100 * np.mean(rows):.1f} ({len(rows)})" for name, rows in held.items()]
        predictions = [row for name, rows in held.items() if name in PREDICTIONS for row in rows]
        whole = f"all predictions {100 * np.mean(predictions):.1f}; " if predictions else ""
        print(f"{kind}: {whole}{'; '.join(cells)}", flush=True)
        spread = [
            f"{name[2:]} {np.median(rows):.2g} (90 %: {np.percentile(rows, 90):.2g})"
            for name, rows in sizes.items()
        ]
        print(f"    medians, %: {'; '.join(spread)}", flush=True)
        print(f"    {', '.join(f'{n} {name}' for name, n in counts.items())}", flush=True)


PREDICTIONS = ("f1", "delta1", "f2", "delta2", "N_c", "AF", "peak", "onset")

if __name__ == "__main__":
    main()
