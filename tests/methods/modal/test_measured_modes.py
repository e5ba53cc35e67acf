"""Model modal against the virtual rigs' eigenvalues; measured beams are in the validation manual."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import labpipe
from labpipe.records.identification import Fit

ROOT = Path(__file__).parents[3]


def within(fit: Fit, name: str, truth: float, limit: float) -> bool:
    parameter = fit.parameter(name)
    assert parameter.std_error is not None
    return abs(parameter.value - truth) < limit * parameter.std_error


@pytest.mark.long
def test_two_coupled_modes_half_a_per_cent_apart(tmp_path: Path) -> None:
    """The cross-coupled support of the radial rig: eigenvalues of its K, C and m in state space.

    Damping of 12 and 20 %.
    """
    stiffness, damping = np.array([[180e3, 25e3], [-18e3, 210e3]]), np.array([[120.0, 15.0], [-10.0, 150.0]])
    state = np.block([[np.zeros((2, 2)), np.eye(2)], [-stiffness / 0.92, -damping / 0.92]])
    poles = np.linalg.eigvals(state)
    poles = sorted(poles[poles.imag > 0], key=abs)
    pipeline = tmp_path / "modes.yaml"
    text = (
        (ROOT / "pipelines/radial-two-directions.yaml")
        .read_text()
        .split("identify:")[0]
        .replace("../", f"{ROOT}/")
    )
    pipeline.write_text(text + "identify:\n  modes: {model: modal, mass: estimate, band: 30-130 Hz}\n")
    result = labpipe.run(pipeline, tmp_path / "out")
    (fit,) = result.fits
    assert sum(parameter.name.startswith("f_n_") for parameter in fit.parameters) == 2
    for number, pole in enumerate(poles, start=1):
        assert within(fit, f"f_n_{number}", abs(pole) / (2 * np.pi), 4)
        assert within(fit, f"zeta_{number}", -pole.real / abs(pole), 4)
