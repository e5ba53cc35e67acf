"""Rotors drawn from what is declared, all their tests together: are unknowns and predictions held?

python -m tests.draws.rotor_systems [KIND ...] [--draws N] [--seed S]; `raw` records every test and runs the
pipeline from the raw files, the others take four tests (free modes, responses at rest, a run-up to .85 of the
first critical speed, deflections and weight) as numbers. Kinds: none (truth as declared), exact (no small
errors), disc (inertias 30 % off), shaft (elements 5 % off), probe (phases 3 deg), bearings (30 % stiffer and
35 % more damped at speed), pedestal (missing in the model), raw.

Prints how many 95 % intervals hold the truth, by prediction: frequency and decrement of the first two modes
at speed, first critical speed with amplification and peak, onset; of the unknowns; of the vibration that
weights leave, set without a trial run.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from labpipe.errors import LabpipeError
from labpipe.methods.rotor.theory import peaks
from labpipe.methods.rotor_system.build import PEDESTALS, TOGETHER, Built
from labpipe.methods.rotor_system.evaluate import best_weights, influence
from labpipe.methods.rotor_system.posterior import WIDENED, Posterior, fit_system
from labpipe.methods.rotor_system.predictions import (
    at_speed,
    campbell,
    critical_speeds,
    onset,
    unbalance_forces,
)
from tests.methods.rotor_system.two_discs import built, dof, drawn, four_tests, run_up

ROOT = Path(__file__).parent.parent.parent
OPERATING = 100.0
KINDS = ("none", "exact", "disc", "shaft", "probe", "bearings", "pedestal", "raw")
# What a kind does to the small errors of a truth: group, standard deviation; a common shift.
OFF = {"shaft": ("elements", 0.05), "probe": ("phase", 0.05)}
Held = dict[str, list[bool]]


def truth_of(kind: str, of: Built, rng: np.random.Generator) -> np.ndarray:
    values = drawn(of, rng)
    for number, unknown in enumerate(of.model.unknowns):
        if kind == "exact" and unknown.group:
            values[number] = 0.0
        if kind in OFF and unknown.group == OFF[kind][0]:
            values[number] = OFF[kind][1] * rng.standard_normal()
        if kind == "disc" and unknown.group == "inertia":
            values[number] = 0.3 * rng.choice([-1, 1])
        if kind == "bearings" and unknown.name.endswith("running"):
            values[number] = np.log(1.35 if " c " in unknown.name else 1.3)
    return values


def fitted(of: dict[str, Built], tests: list, names: list[str]) -> tuple[Built, Posterior]:
    """As the section does it: alternatives where a test misfits or small errors are large."""

    def on(this: Built, test: object) -> object:
        if getattr(test, "planes", None) is None:
            return test
        return replace(
            test, planes=tuple(this.planes.values()), gains=this.gains["run"], phases=this.phases["run"]
        )

    best = of[""], fit_system(of[""].model, [on(of[""], test) for test in tests])
    if not (best[1].misfits or best[1].enlarged):
        return best
    for name in names:
        try:
            other = (
                of[name],
                replace(fit_system(of[name].model, [on(of[name], test) for test in tests]), alternative=name),
            )
        except LabpipeError:
            continue
        if other[1].ln_evidence > best[1].ln_evidence:
            best = other
    return best[0], replace(best[1], widened=WIDENED)


def true_peak(of: Built, values: np.ndarray, output: int) -> object:
    speed = np.linspace(15.0, 95.0, 6000)
    omega = 2 * np.pi * speed
    forces = unbalance_forces(of, values)[:, None] * omega[:, None, None] ** 2
    motion, _, _ = of.model.response(at_speed(of.model, values), omega, omega, forces, [output])
    found = peaks(speed, np.abs(motion[:, 0, 0]))
    return max(found, key=lambda peak: peak.amplitude) if found else None


def judge(
    held: Held, of: Built, truth: np.ndarray, this: Built, found: Posterior, rng: np.random.Generator
) -> None:
    true = of.model.roots(at_speed(of.model, truth), 2 * np.pi * OPERATING)
    diagram = campbell(found, np.array([OPERATING]))
    f, u = diagram.frequency[0], diagram.frequency_error[0]
    delta, v = diagram.log_decrement[0], diagram.log_decrement_error[0]
    true_f = true.values.imag / (2 * np.pi)
    true_delta = -2 * np.pi * true.values.real / true.values.imag
    for mode, name in ((0, "1"), (2, "2")):
        near = int(np.argmin(np.abs(true_f - f[mode])))
        held[f"f{name}"].append(abs(true_f[near] - f[mode]) < 1.96 * u[mode])
        held[f"delta{name}"].append(abs(true_delta[near] - delta[mode]) < 1.96 * v[mode])
    output = dof("4 z")
    peak = true_peak(of, truth, output)
    criticals = critical_speeds(found, this, (20.0, 90.0), OPERATING, [output], n_draw=200)
    if peak is not None and criticals:
        best = min(criticals, key=lambda each: abs(np.log(each.speed / peak.speed)))
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
    draws = found.values + found.widened * (found.draws(200, 5) - found.values)
    each = [influence(this, run_up(this, speeds), values) for values in draws]
    weights = best_weights(each)
    h, unbalance = influence(of, run_up(of, speeds), truth)
    left = np.sqrt(np.mean(np.abs(h @ (unbalance + weights)) ** 2))
    before = np.sqrt(np.mean(np.abs(h @ unbalance) ** 2))
    predicted = [np.sqrt(np.mean(np.abs(g @ (u_ + weights)) ** 2)) for g, u_ in each]
    low, high = np.percentile(predicted, (2.5, 97.5))
    held["left"].append(low < left < high)
    held["left, upper"].append(left < high)
    held.setdefault("% left", []).append(100 * left / before)  # type: ignore[arg-type]


def by_numbers(kind: str, n_draw: int, seed: int) -> tuple[Held, int]:
    held: Held = defaultdict(list)
    flagged = 0
    of = built(True)
    models = {"": built(kind != "pedestal"), TOGETHER: built(kind != "pedestal", TOGETHER)}
    models |= {PEDESTALS: built(False, PEDESTALS)} if kind == "pedestal" else {}
    for draw in range(n_draw):
        rng = np.random.default_rng([seed, draw])
        truth = truth_of(kind, of, rng)
        peak = true_peak(of, truth, dof("4 z"))
        top = 60 * 0.85 * peak.speed if peak is not None else 2300.0
        try:
            this, found = fitted(models, four_tests(of, truth, rng, top), [name for name in models if name])
        except LabpipeError as error:
            held["fit"].append(False)
            print("failed:", draw, error)
            continue
        held["fit"].append(True)
        flagged += bool(found.misfits or found.enlarged or found.alternative)
        judge(held, of, truth, this, found, rng)
    return held, flagged


def from_raw(n_draw: int, seed: int) -> tuple[Held, int]:
    """Every test recorded, the pipeline run as it stands."""
    import labpipe
    from labpipe.artefacts.writing import output_folder
    from labpipe.methods.rotor_system.virtual_rig import world_of
    from labpipe.project.simulate import load_virtual_rig, simulate_files

    held: Held = defaultdict(list)
    flagged = 0
    text = (ROOT / "pipelines/rotor-system.yaml").read_text().replace("../configs", str(ROOT / "configs"))
    for draw in range(n_draw):
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
        flagged += any(finding.level == "warning" for finding in result.findings)
        for test in result.tests:
            held["tests fit (p > 5 %)"].append(test.probability > 0.05)
    return held, flagged


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kinds", nargs="*", choices=KINDS, default=[])
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    for kind in options.kinds or KINDS:
        held, flagged = (
            from_raw(options.draws, options.seed)
            if kind == "raw"
            else by_numbers(kind, options.draws, options.seed)
        )
        left = held.pop("% left", [])
        cells = [f"{name} {100 * np.mean(rows):.1f} ({len(rows)})" for name, rows in held.items()]
        predictions = [row for name, rows in held.items() if name in PREDICTIONS for row in rows]
        whole = f"all predictions {100 * np.mean(predictions):.1f}; " if predictions else ""
        spread = f"; left % median {np.median(left):.1f}, 90 %: {np.percentile(left, 90):.1f}" if left else ""
        print(f"{kind}: {whole}{'; '.join(cells)}{spread}; flagged {flagged} of {options.draws}", flush=True)


PREDICTIONS = ("f1", "delta1", "f2", "delta2", "N_c", "AF", "peak", "onset")

if __name__ == "__main__":
    main()
