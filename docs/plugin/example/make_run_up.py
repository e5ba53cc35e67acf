"""Writes damper.csv: a run-up of the pinned rotor with oil 20 % thicker than its file says, so that all
coefficients are 1.2 times it.
"""

import sys
from pathlib import Path

import numpy as np

import labpipe
from labpipe.methods.run_ups.records import RunUp
from labpipe.methods.run_ups.run_up_csv import write_run_up_csv

TRUE_FACTOR, LOAD = 1.2, 40.0
rig = labpipe.rotor(Path(__file__).parent / "pinned-rotor.yaml")
speed = np.linspace(600, 2200, 41) * np.pi / 30
stiffness, damping = rig.start_coefficients(LOAD, speed)
exact = rig.condense(speed, rig.known_unbalance).response(TRUE_FACTOR * stiffness, TRUE_FACTOR * damping)
exact = exact.reshape(speed.size, len(rig.planes), 2)
rng = np.random.default_rng(1)
relative, phase = 0.01, np.radians(1)
measured = (
    exact
    * (1 + relative * rng.standard_normal(exact.shape))
    * np.exp(1j * phase * rng.standard_normal(exact.shape))
)
errors = {"amplitude_error": relative * np.abs(measured), "phase_error": np.full(exact.shape, phase)}
run = RunUp("damper", LOAD, speed, rig.plane_names, measured, **errors, unbalance=rig.known_unbalance)
write_run_up_csv(Path(sys.argv[1]), run)
