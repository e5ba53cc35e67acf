"""Responses of a rig whose bearings obey a magnetic-bearing file, with noise of a known or an estimated
size.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings, Sliding, Support
from labpipe.methods.magnetic_bearing.bearing import MagneticFile
from labpipe.methods.magnetic_bearing.loop_problem import View, receptance
from labpipe.project.bearing_file import open_bearing
from labpipe.records.identification import Fit, Goodness
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.records.uncertain import Uncertain

ROOT = Path(__file__).parents[3]
FREQUENCY = np.arange(1.0, 251.0)
SUPPORT = Support(Uncertain(134.5e3, 100.0), Uncertain(3.68, 0.05))
PORTS = {"input": ("f",), "output": ("y",)}
SETTINGS = FitSettings(
    "sdof",
    mass=0.92,
    **PORTS,
    band=(1.0, 250.0),
    sliding=Sliding(15.0, 15.0),
    subtract=SUPPORT,
    share=2,
    name="sliding",
)
# A fit that stands for its band alone, where what it found is of no interest.
WHOLE = Fit(
    "sliding",
    "sdof",
    "ml",
    band_hz=(1.0, 250.0),
    lines=250,
    equations=500,
    dof=498,
    gof=Goodness(1.0, 1.0),
    parameters=(),
    condition_number=1.0,
    correlation=np.eye(2),
)


def bearing(name: str) -> MagneticFile:
    return open_bearing(ROOT / f"configs/bearings/{name}.yaml").settings()


def measured(
    file: MagneticFile,
    rng: np.random.Generator,
    noise: float = 0.004,
    averages: int = 0,
    fits: bool = False,
    support: tuple[float, float] | None = None,
) -> View:
    """y under a force at 45 deg; relative *noise* of the response, its covariance known, or estimated from
    *averages* periods.

    *fits*: in sliding bands, else one that stands for all lines. *support*: stiffness and damping; by default
    as stated, drawn anew within its standard errors.
    """
    ports = ((Port("y", "y", "y", np.pi / 2),), (Port("f", "f", "45 deg", np.pi / 4),))
    empty = FrequencyResponse(FREQUENCY, np.ones((FREQUENCY.size, 1, 1), complex), *ports)
    view = View("", empty, SETTINGS, (), file)
    away = rng.normal(size=2)
    true = support or (134.5e3 + 100.0 * away[0], 3.68 + 0.05 * away[1])
    matrix = receptance(view, file, 2 * np.pi * FREQUENCY, true)
    spread = noise * np.abs(matrix)
    count = averages or 1
    drawn = (
        (rng.normal(size=(count, *matrix.shape)) + 1j * rng.normal(size=(count, *matrix.shape)))
        * spread
        * np.sqrt(count / 2)
    )
    variance = spread**2 if not averages else np.var(drawn, axis=0, ddof=1) / averages
    response = replace(
        empty,
        matrix=matrix + drawn.mean(axis=0),
        covariance=diagonal_covariance(variance),
        averages=float(averages or 1),
        covariance_dof=float(averages - 1) if averages else np.inf,
    )
    return View("", response, SETTINGS, identify(response, SETTINGS) if fits else (WHOLE,), file)
