"""Rigs of the planner's tests: a pedestal, a rotor with eight coefficients, a floating stator with twelve.

And their noise.
"""

from __future__ import annotations

import numpy as np

from labpipe.methods.planning.model import PlannedModel, SensorDensities, planned_model

# The pedestal and the rotor of sample_data/hmb (Lim et al. 2009; truth.json there), the seal of
# configs/virtual-floating.yaml.
PEDESTAL = {"k": 134.5e3, "c": 3.682}
ROTOR = {
    "k_xx": 180e3,
    "k_xy": 25e3,
    "k_yx": -18e3,
    "k_yy": 210e3,
    "c_xx": 120.0,
    "c_xy": 15.0,
    "c_yx": -10.0,
    "c_yy": 150.0,
}
SEAL = {
    **{"k_xx": 3.30e6, "k_xy": 11.3e6, "k_yx": -10.3e6, "k_yy": 3.89e6},
    **{"c_xx": 147e3, "c_xy": 52.9e3, "c_yx": -57.7e3, "c_yy": 147e3},
    **{"m_xx": 229.0, "m_xy": 16.0, "m_yx": 32.0, "m_yy": 214.0},
}


def pedestal() -> tuple[PlannedModel, SensorDensities, np.ndarray]:
    """Model, noise and lines [Hz]."""
    return (
        planned_model("sdof", PEDESTAL, 0.79),
        SensorDensities.of_samples(0.02, 0.3e-6, 0.0, 2000.0),
        np.arange(20, 120, 0.5),
    )


def rig_rotor() -> tuple[PlannedModel, SensorDensities, np.ndarray]:
    """Model, noise and lines [Hz]."""
    return (
        planned_model("rotor-2dof", ROTOR, 0.92),
        SensorDensities.of_samples(0.02, 0.3e-6, 0.0, 2000.0),
        np.arange(5.0, 250.0, 1.0),
    )


def seal() -> tuple[PlannedModel, SensorDensities, np.ndarray]:
    """Model, noise and lines [Hz]."""
    return (
        planned_model("dynamic-stiffness", SEAL, 60.0),
        SensorDensities.of_samples(2.0, 0.2e-6, 0.05, 1000.0),
        np.arange(10.0, 101.0, 1.0),
    )


RIGS = {"pedestal": pedestal, "rotor": rig_rotor, "seal": seal}
