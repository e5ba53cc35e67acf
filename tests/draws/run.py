"""Combined uncertainties of shipped pipelines, compared with worlds in which every number is off.

python -m tests.draws.run [PIPELINE ...] [--draws N] [--seconds S] [--cases N] [--seed S]

Every sensor of a pipeline's rig that the rig file gives no uncertainty gets one of usual size (gain of a
force 0.5 %, of a response 1 %, delay 2 us, direction 0.5 deg), so does a given mass (0.5 %). A world draws
all of them, records what the fitted model would do with noise of the measured covariance, and fits it with
the numbers as they are written. All fits of a pipeline and its tests share the sensors of a world.
Comparisons of tests get one truth behind all tests, each at a condition that is off by its setting error;
run-ups bearings and probes that are off; responses to unbalance bearings that are off; calibrations new
points; what is said of a control loop noise, channels, mass and support that are off.

Prints for every parameter the scatter over the combined standard uncertainty, how often its 95 % interval
holds the truth, and how often noise alone would. At most N cases (bands, tests) of one fit, evenly chosen; at
most S seconds for a pipeline.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tests.draws.pipelines import draw_pipeline
from tests.draws.tally import HEAD, line

ROOT = Path(__file__).parent.parent.parent


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pipelines", nargs="*", help="names or files; default: all that ship")
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--cases", type=int, default=6)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    files = [
        Path(name) if name.endswith(".yaml") else ROOT / "pipelines" / f"{name}.yaml"
        for name in options.pipelines
    ]
    bad = 0
    for path in files or sorted((ROOT / "pipelines").glob("*.yaml")):
        begun = time.monotonic()
        tally = draw_pipeline(path, options.draws, options.seconds, options.cases, options.seed)
        print(
            f"\n== {path.stem} ({time.monotonic() - begun:.0f} "
            f"s{f', {tally.failed} failed' if tally and tally.failed else ''})",
            flush=True,
        )
        if tally is None:
            print("nothing in it has an uncertainty that can be drawn", flush=True)
            continue
        print(HEAD)
        for row in tally.rows():
            bad += not row.is_good
            print(line(row), flush=True)
    print(f"\n{bad} parameters are not as they should be" if bad else "\nall as they should be")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
