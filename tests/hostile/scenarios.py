"""Every kind of YAML file that labpipe reads, each in a small folder with the command that reads it:
SCENARIOS by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.hostile.seeds import CALIBRATION, DATASET, PLAN
from tests.project.laboratory import ALONE, RIG, STIFFNESS, recording
from tests.project.test_every_key import FLOATING, LEVITATED, RESPONSE_TABLE, RING_DOWN, SECTIONS

ROOT = Path(__file__).parents[2]
RUN = ("run", "pipeline.yaml", "-o", "out", "-q", "--set", "report.formats=[]")
BEARING = ("bearing", "bearing.yaml", "-q", "--json", "out.json")
PLANS = ("plan", "plan.yaml", "-o", "out", "-q")
SIMULATE = ("simulate", "virtual.yaml", "-q", "-o", "out")


@dataclass(frozen=True)
class Scenario:
    """The *files* of a folder by name, which of them is *mutated*, and the *command* that is given in the
    folder.

    *moves*: the command puts files of the folder aside, so that they and its results are made anew for every
    trial. *amounts*: of every second trial numbers alone are changed, since other changes are refused before
    anything is computed.
    """

    mutated: str
    command: tuple[str, ...]
    files: Mapping[str, str]
    moves: bool = False
    amounts: bool = False


def shown(name: str) -> str:
    """A file of the examples."""
    return (ROOT / "configs" / name).read_text("utf-8")


LABORATORY = {"rig.yaml": RIG, "soft.csv": recording(STIFFNESS["soft"]), "pipeline.yaml": ALONE}


def heavy(stiffness: float, seed: int) -> str:
    """A recording of 5000 times the force and mass, as stiff as a ball bearing."""
    head, *rows = recording(stiffness, seed).splitlines()
    cells = (row.split(",") for row in rows)
    return (
        "\n".join(
            [head.replace("[N]", "[kN]"), *(f"{t},{5 * float(force):.9g},{y}" for t, force, y in cells)]
        )
        + "\n"
    )


CAMPAIGN = {
    **{f"{number}.csv": heavy(18e3 + 2e3 * number, number) for number in range(3)},
    "bearing.yaml": shown("bearings/nsk-6208.yaml"),
    # Within the noise: fits of wrong models take several times as long.
    "sensor.csv": RESPONSE_TABLE,
    "line.csv": CALIBRATION,
    "rig.yaml": RIG.replace(
        "role: output, dof: y", "role: output, dof: x, response: sensor.csv, uncertainty: {gain: 1 %}"
    )
    .replace("dof: y", "dof: x")
    .replace("unit: N", "unit: kN")
    .replace("[N]", "[kN]")
    .replace("mass: 0.79 kg", "mass: 3950 kg"),
    "pipeline.yaml": """title: Campaign
rig: rig.yaml
tests:
  - {name: a, recordings: 0.csv, conditions: {preload: 427 N, mounting: 1}}
  - {name: b, recordings: 1.csv, conditions: {preload: 701 N, mounting: 1}}
  - {name: c, recordings: 2.csv, conditions: {preload: 1422 N, mounting: 2}}
frf: {excitation: periodic, period: 1 s, skip: 0}
uncertainty: {coverage: 95 %, repeatability: {remounting: {parameter: k, size: 0.5 % (dof=4), per: mounting}}}
calibrate:
  line: {table: line.csv, x: 'x [um]', y: 'y [V]', tolerance: 20 %}
identify:
  peaks: {model: sdof, peaks: {x: 10-40 Hz}}
compare:
  stiffness: {kind: trend, fit: peaks, term: x, over: preload, law: power, setting_error: 0.5 %}
  repeats: {kind: repeatability, fit: peaks, term: x, group: mounting}
  theory: {kind: ratio, fit: peaks, term: x, over: preload, theory: {bearing: bearing.yaml}}
accept: {line.slope: 8000 V/m +- 5 %}
report: {formats: []}
""",
}
RUN_UP_ROTOR = {
    "rotor.yaml": shown("rotors/falah.yaml"),
    "virtual.yaml": "kind: virtual-unbalance-rig\nrotor: rotor.yaml\ntruth: outside\nviscosity_error: -15 "
    "%\nclearance_error: 5 %\n"
    "groove_width: 30 deg\nheating: 10 %\nloads: [1.3 lbf]\nspeeds: 400-3000 rpm\ncount: 3\n"
    "noise: {amplitude: 1 %, phase: 1 deg, threshold: 0.2 %}\n",
}
FRFS = {
    "h.csv": "f [Hz],re [um/N],im [um/N]\n" + "".join(f"{15 + n},{50 + n},{-n}\n" for n in range(20)),
    "pipeline.yaml": "title: t\nfrfs: {file: h.csv, form: receptance, unit: um/N, output: y, input: y, "
    "columns: {frequency: 'f [Hz]', re: 're [um/N]', im: 'im [um/N]'}}\n"
    "identify: {a: {model: sdof, mass: 0.79 kg}}\nreport: {formats: []}\n",
}
PLANNED = {
    "run-ups": """title: Film, planned runs
plan:
  model: run-ups
  rotor: rotor.yaml
  loads: [5.88 N, 10.3 N]
  speeds: 600-3000 rpm
  step: 600 rpm
  stretches: 2
  dwell: 10 s
  duration: 3 min
  trials:
    both: {unbalance: {disc 1: 50 g.mm, disc 2: 30 g.mm at 60 deg}}
    one: {unbalance: {disc 2: 50 g.mm}}
  noise: {amplitude: 1 %, displacement: 0.5 um, phase: 1 deg, threshold: 0.2 %}
  to_threshold: true
  known: [clearance]
  at_load: 8 N
  at_speed: 1800 rpm
  goal: {k_xy: 30 %, threshold: 5 %}
""",
    "wear": """title: Wear, planned tests
plan:
  model: worn-bearing
  rotor: rotor.yaml
  bearing: bearing 2
  expected: {depth: 20 um, angle: 8 deg}
  viscosity: 0.1044 Pa.s +- 3 %
  clearance: 90 um +- 2 %
  speeds: [50 Hz]
  loads: [-40 N, -80 N]
  bands: [15-40 Hz, 60-100 Hz]
  force: 5 N
  sample_rate: 256 Hz
  noise: {displacement: 1 um, force: 50 mN}
  run: 32 s
  duration: 192 s
  goal: {depth: 0.3 um, angle: 0.5 deg}
""",
}
WATCHED = {
    "rig.yaml": RIG,
    "runs/100N-1.csv": recording(STIFFNESS["soft"]),
    "pipeline.yaml": ALONE.replace(
        "recordings: soft.csv\n",
        "tests:\n  - {each: 'runs/*.csv', pattern: '{preload}-{serial}', conditions: {speed: 0 rpm}}\n",
    ),
}
WATCH = ("watch", "runs", "-c", "pipeline.yaml", "-o", "out", "--once", "--settle", "0 s", "-j", "1", "-q")
BEARINGS = (
    "skf-6205",
    "mendes-journal",
    "hmb-magnetic",
    "nu209",
    "rpf-7208",
    "levitated",
    "hmb-geometry",
    "floating-journal",
)
VIRTUAL_RIGS = ("base", "decay", "hmb", "sweep", "white-noise", "floating", "ball-bearing")
# Of a virtual rig with many runs one is enough.
RUNS = {"ball-bearing": ("--run", "6208-701N-up-x")}

SCENARIOS: dict[str, Scenario] = {
    "pipeline.yaml": Scenario("pipeline.yaml", RUN, LABORATORY),
    "rig.yaml": Scenario("rig.yaml", RUN, LABORATORY),
    "campaign": Scenario("pipeline.yaml", RUN, CAMPAIGN),
    "campaign, rig": Scenario("rig.yaml", RUN, CAMPAIGN),
    "campaign, bearing": Scenario("bearing.yaml", RUN, CAMPAIGN),
    "dataset": Scenario(
        "pipeline.yaml",
        RUN,
        {**LABORATORY, "hard.csv": recording(STIFFNESS["hard"]), "pipeline.yaml": DATASET},
    ),
    "ready FRFs": Scenario("pipeline.yaml", RUN, FRFS),
    "calibrate": Scenario(
        "pipeline.yaml", ("calibrate", "-c", "pipeline.yaml", "-o", "out", "-q"), SECTIONS["calibrate"]
    ),
    "unbalance": Scenario("pipeline.yaml", RUN, SECTIONS["unbalance"]),
    "rotor": Scenario("rotor.yaml", RUN, SECTIONS["unbalance"]),
    "study": Scenario("pipeline.yaml", ("study", "pipeline.yaml", "-j", "1", *RUN[2:]), SECTIONS["study"]),
    "study, virtual rig": Scenario(
        "virtual.yaml", ("study", "pipeline.yaml", "-j", "1", *RUN[2:]), SECTIONS["study"]
    ),
    "ring-down": Scenario("pipeline.yaml", RUN, RING_DOWN),
    "floating": Scenario("pipeline.yaml", RUN, FLOATING),
    "levitated": Scenario("pipeline.yaml", RUN, LEVITATED),
    "run-up rotor": Scenario("rotor.yaml", SIMULATE, RUN_UP_ROTOR),
    "run-ups, virtual rig": Scenario("virtual.yaml", SIMULATE, RUN_UP_ROTOR),
    "plan": Scenario("plan.yaml", PLANS, {"plan.yaml": PLAN}),
    "plan, run-ups": Scenario(
        "plan.yaml",
        PLANS,
        {"plan.yaml": PLANNED["run-ups"], "rotor.yaml": shown("rotors/falah.yaml")},
        amounts=True,
    ),
    "plan, wear": Scenario(
        "plan.yaml",
        PLANS,
        {"plan.yaml": PLANNED["wear"], "rotor.yaml": shown("rotors/mendes.yaml")},
        amounts=True,
    ),
    "watch": Scenario("pipeline.yaml", WATCH, WATCHED, moves=True),
    "watched recording": Scenario("runs/100N-1.csv", WATCH, WATCHED, moves=True),
    "virtual journal": Scenario(
        "virtual.yaml",
        SIMULATE,
        {"virtual.yaml": shown("virtual-journal.yaml"), "rotors/mendes.yaml": shown("rotors/mendes.yaml")},
    ),
    **{
        f"bearing {name}": Scenario("bearing.yaml", BEARING, {"bearing.yaml": shown(f"bearings/{name}.yaml")})
        for name in BEARINGS
    },
    **{
        f"virtual {name}": Scenario(
            "virtual.yaml", (*SIMULATE, *RUNS.get(name, ())), {"virtual.yaml": shown(f"virtual-{name}.yaml")}
        )
        for name in VIRTUAL_RIGS
    },
}


def write_scenario(name: str, folder: Path) -> None:
    """The files of a scenario."""
    for file, text in SCENARIOS[name].files.items():
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / file).write_text(text, "utf-8")
