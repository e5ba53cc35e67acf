"""Coverage and warnings from raw files of rigs that do not ship, in worlds drawn from what is stated.

python -m tests.draws.raw_files [STUDY ...] [--draws N] [--faults N] [--seed S]

Studies: plan, certificate, floating, loop, budget. A world draws every stated number within its uncertainty,
and the noise; the recording follows from the rig's equations, the pipeline reads it with the numbers as they
are stated. Counted are how often 95 % intervals hold the truth and which warnings come; then the same with
the study's fault, for its warning alone. docs/pages/statistics.md has what was counted.
"""

from __future__ import annotations

import argparse
import functools
import json
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import parquet
from scipy import stats

import labpipe
from labpipe.methods.planning.plan_file import read_plan
from labpipe.methods.planning.records import Plan
from labpipe.records.finding import WARNING, Finding, Parameter
from tests.methods.floating_bearing.test_stated_numbers import BENCH, FILM, fitted
from tests.methods.magnetic_bearing.recorded_axis import Axis, certificate_pipeline, fit_pipeline, written
from tests.methods.planning.test_settling import DAMPING, MASS as SEISMIC, PLAN, STIFFNESS, from_rest

# One world: the parameters that were found, the findings, and the truth by name.
World = tuple[Iterable[Parameter], Iterable[Finding], dict[str, float]]
Draw = Callable[[Path, np.random.Generator, bool], World]

# Standard uncertainties of a gain, as a share; of a mass [kg]; of the stator's mass [kg].
GAIN, MASS, STATOR = 0.003, 0.02, 0.12
SPARSE = Axis(lines=np.unique(np.round(np.geomspace(3, 450, 60))).astype(int))
LEVITATED = Axis(lines=np.unique(np.round(np.geomspace(4, 400, 120))).astype(int))
WIDTH = " width over planned"
STATED = ", uncertainty: {gain: 0.3 %}"
# Expected damping of the planned test [N s/m], 3 % of critical.
EXPECTED_DAMPING = float(2 * 0.03 * np.sqrt(STIFFNESS * SEISMIC))


def certificate(folder: Path, rng: np.random.Generator, fault: bool) -> World:
    """A sampled reading and a current whose gains are off by 0.3 %; fault: the derivative gain of the file is
    0.6 of the true one.
    """
    columns = SPARSE.record(rng)
    columns = {name: gained(rng, samples) if name in "ix" else samples for name, samples in columns.items()}
    asked = "{before: before, after: u, displacement: x, current: i, injection: output}"
    file = SPARSE.other(derivative=0.6 * SPARSE.derivative) if fault else SPARSE
    pipeline = certificate_pipeline(written(folder, file, columns), file, certificate=asked)
    with_uncertainty(folder / "rig.yaml", "i", "x")
    result = labpipe.run(pipeline)
    (found,) = result.sections["compare"]
    pole = SPARSE.pole()
    truth = {
        "log_decrement_1": SPARSE.log_decrement(),
        "pole_real_1": pole.real,
        "pole_imag_1": pole.imag,
        "negative_stiffness": SPARSE.k_n,
        "force_per_current": SPARSE.k_i,
        "bandwidth": SPARSE.bandwidth,
        "delay": SPARSE.delay,
        "sensitivity_peak": SPARSE.peak(),
        "phase_margin": SPARSE.phase_margin(),
        "peak": SPARSE.peak(),
        "measured_phase_margin": SPARSE.phase_margin(),
    }
    return found.amounts, (*found.findings, *measured_findings(result)), truth


def floating(folder: Path, rng: np.random.Generator, fault: bool) -> World:
    """A stator whose mass is off by 0.12 kg; fault: by 3 %."""
    mass = 25.0 + (0.75 if fault else STATOR * rng.standard_normal())
    seed = int(rng.integers(1 << 31))
    fit = fitted(folder, "25 kg +- 0.12 kg", seed, replace(BENCH, stator_mass=mass))
    matrices = {"k": FILM.stiffness, "c": FILM.damping, "m": FILM.mass}
    truth = {
        f"{letter}_{row}{column}": matrix["xy".index(row)]["xy".index(column)]
        for letter, matrix in matrices.items()
        for row in "xy"
        for column in "xy"
    }
    return fit.parameters, fit.findings, truth


def loop(folder: Path, rng: np.random.Generator, fault: bool) -> World:
    """A levitated mass by the force of its magnet, whose gain is off by 0.3 %, its mass by 20 g; fault: the
    command of the controller named as the reference, under random excitation.
    """
    axis = LEVITATED.other(mass=LEVITATED.mass + MASS * rng.standard_normal())
    axis = axis.other(random=True, periods=40, disturbance=10.0) if fault else axis
    columns = axis.record(rng)
    columns["i"] = gained(rng, columns["i"])
    written(folder, LEVITATED, columns)
    frf = (
        "{excitation: random, block: 500 ms, band: 6-800 Hz, reference: u}"
        if fault
        else "{excitation: periodic, period: 500 ms, band: 6-800 Hz, reference: e}"
    )
    force = f"{{i: {{quantity: force, sensitivity: 0.0083333333333333 A/N{STATED}}}}}"
    pipeline = fit_pipeline(folder, frf, "{model: sdof, mass: 6.5 kg +- 20 g}", force)
    result = labpipe.run(pipeline)
    (fit,) = result.fits
    findings = (*fit.findings, *measured_findings(result))
    return fit.parameters, findings, {"k": -LEVITATED.k_n, "c": 0.0}


SUPPORT = """name: Support of a gearbox
sample_rate: 2000 Hz
channels:
  f: {quantity: force, unit: N, role: input, dof: z, uncertainty: {gain: 0.3 %}}
  z: {quantity: displacement, unit: m, role: output, dof: z, uncertainty: {gain: 0.3 %}}
"""


def budget(folder: Path, rng: np.random.Generator, fault: bool) -> World:
    """A mass of 38 kg +- 20 g on 2.6 MN/m and 900 N s/m, gains of force and response off by 0.3 %; fault:
    the mass off by 5 %.
    """
    stiffness, damping, mass = 2.6e6, 900.0, 38.0 + (1.9 if fault else MASS * rng.standard_normal())
    periods, count, rate = 12, 2000, 2000.0
    lines = np.arange(5, 200)
    omega = 2 * np.pi * lines * rate / count
    spectrum = np.zeros(count // 2 + 1, complex)
    spectrum[lines] = 4.0 * count / 2 * np.exp(-1j * np.pi * np.arange(lines.size) ** 2 / lines.size)
    answer = spectrum.copy()
    answer[lines] /= stiffness + 1j * omega * damping - mass * omega**2
    force, motion = (np.tile(np.fft.irfft(each, count), periods) for each in (spectrum, answer))
    columns = {
        "f": gained(rng, force + 0.5 * rng.standard_normal(force.size)),
        "z": gained(rng, motion + 2e-7 * rng.standard_normal(force.size)),
    }
    parquet.write_table(pa.table(columns), folder / "axis.parquet")
    (folder / "rig.yaml").write_text(SUPPORT)
    frf = "{excitation: periodic, period: 1 s, skip: 0, band: 5-199 Hz}"
    result = labpipe.run(fit_pipeline(folder, frf, "{model: sdof, mass: 38 kg +- 20 g}"))
    (fit,) = result.fits
    return fit.parameters, (*fit.findings, *measured_findings(result)), {"k": stiffness, "c": damping}


def measured_findings(result: labpipe.Identification) -> list[Finding]:
    """What was said of the recordings and their spectra."""
    return [finding for one in (*result.responses, *result.spectra) for finding in one.findings]


def gained(rng: np.random.Generator, samples: np.ndarray) -> np.ndarray:
    """A channel whose gain is off within what is stated."""
    return samples * (1 + GAIN * rng.standard_normal())


def with_uncertainty(rig: Path, *channels: str) -> None:
    """The rig file with a gain of 0.3 % at these channels."""
    lines = rig.read_text().splitlines()
    changed = [
        line[:-1] + STATED + "}" if line.strip().partition(":")[0] in channels else line for line in lines
    ]
    rig.write_text("\n".join(changed))


@functools.cache
def planned(folder: Path, fault: bool) -> Plan:
    """The plan of the seismic mass, its files in the folder; fault: skip 1, .3 % of damping."""
    damping = {"k": f"{STIFFNESS} N/m", "c": f"{EXPECTED_DAMPING} N.s/m"}
    entries = {**PLAN, "skip": 1} if fault else {**PLAN, "expected": damping}
    folder.mkdir()
    (folder / "plan.yaml").write_text(json.dumps({"title": "Seismic mass", "plan": entries}))
    command = [
        sys.executable,
        "-m",
        "labpipe",
        "plan",
        str(folder / "plan.yaml"),
        "-o",
        str(folder / "planned"),
    ]
    subprocess.run(command, check=True, capture_output=True)
    return read_plan(folder / "planned" / "plan.json")


def plan(folder: Path, rng: np.random.Generator, fault: bool) -> World:
    """A planned test of a seismic mass, from rest, whose stiffness is 1 % and whose damping 5 % from what was
    expected, one standard deviation each; fault: too few periods are skipped. The intervals that the plan
    promised count beside those of the fit, about its values: `k planned`.
    """
    made = planned(folder / ("fault" if fault else "sound"), fault)
    truth = {
        "k": STIFFNESS * (1 + 0.01 * rng.standard_normal()),
        "c": (DAMPING if fault else EXPECTED_DAMPING) * (1 + 0.05 * rng.standard_normal()),
    }
    place = folder / ("fault" if fault else "sound") / "planned"
    from_rest(made, place, int(rng.integers(1 << 31)), truth["k"], truth["c"])
    result = labpipe.run(place / "pipeline.yaml")
    (fit,) = result.fits
    errors = {one.name: one.error_weighted * one.scale for one in made.coefficients}
    promised = []
    for name, error in errors.items():
        found = fit.parameter(name)
        ends = (found.value - 1.96 * error, found.value + 1.96 * error)
        promised.append(replace(found, name=f"{name} planned", ci95=ends))
        promised.append(replace(found, name=f"{name}{WIDTH}", value=found.std_error / error))
    truth |= {f"{name} planned": truth[name] for name in errors}
    return (*fit.parameters, *promised), (*fit.findings, *measured_findings(result)), truth


STUDIES: dict[str, Draw] = {
    "plan": plan,
    "certificate": certificate,
    "floating": floating,
    "loop": loop,
    "budget": budget,
}


def study(
    draw: Draw, draws: int, seed: int, fault: bool
) -> tuple[dict[str, list[bool]], Counter[str], dict[str, list[float]]]:
    """By parameter whether its interval held in each world, in how many worlds each warning came, and widths
    over those of the plan; a refused fit counts as the warning *refused*.
    """
    held: dict[str, list[bool]] = {}
    widths: dict[str, list[float]] = {}
    warned: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(draws):
            try:
                parameters, findings, truth = draw(Path(folder), np.random.default_rng([seed, number]), fault)
            except labpipe.LabpipeError:
                warned["refused"] += 1
                continue
            # A code counts once in a world, whether the recording or the fit says it.
            warned.update({finding.code for finding in findings if finding.level == WARNING})
            for one in parameters:
                if one.name.endswith(WIDTH):
                    widths.setdefault(one.name, []).append(one.value)
                if one.name in truth and one.ci95 is not None:
                    low, high = one.ci95
                    held.setdefault(one.name, []).append(low <= truth[one.name] <= high)
    return held, warned, widths


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("studies", nargs="*", choices=[*STUDIES, []], default=[])
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--faults", type=int, default=100)
    parser.add_argument("--seed", type=int, default=36)
    options = parser.parse_args()
    for name in options.studies or STUDIES:
        held, warned, widths = study(STUDIES[name], options.draws, options.seed, fault=False)
        print(f"== {name}, {options.draws} worlds: {dict(warned)}")
        low, high = stats.binom.ppf([0.005, 0.995], options.draws, 0.95) / options.draws
        for parameter, each in held.items():
            coverage = np.mean(each)
            outside = "" if low <= coverage <= high else f" outside {low:.3f} to {high:.3f}"
            print(f"  {parameter:24s} {coverage:.3f} of {len(each)}{outside}")
        print(f"  all {np.mean([one for each in held.values() for one in each]):.4f}")
        for parameter, sizes in widths.items():
            low, middle, high = np.quantile(sizes, [0.025, 0.5, 0.975])
            print(f"  {parameter:24s} {middle:.3f}, 95 % of them {low:.3f} to {high:.3f}")
        _, warned, _ = study(STUDIES[name], options.faults, options.seed, fault=True)
        print(f"  with the fault, {options.faults} worlds: {dict(warned)}", flush=True)


if __name__ == "__main__":
    main()
