"""Wear found on the rig of Mendes et al. (2017), against truths made by finer oil films than the
identification's.

Frame: y horizontal, z up, spin y to z, wear angle from the bottom, positive with the spin. Rotor, loads and
wear as published, targets from an independent calculation. Truth: films of 960 x 120 cells (identification:
tables of 120 x 30, refined at 480 x 60). Noise: circular, 2 % of the largest |H| on every term.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.rotor_file import load_rotor
from labpipe.methods.wear.model import MISFITS, worn_model, worn_receptance
from labpipe.methods.wear.search import minima, refine, start_mesh
from labpipe.methods.wear.settings import WearSettings, posterior
from labpipe.methods.wear.virtual_rig import receptance
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.records.uncertain import Uncertain
from tests.methods.wear.worn_cases import without_region

RIG = load_rotor(Path(__file__).parents[3] / "configs/rotors/mendes.yaml")
WEAR = [(22.27, 11.0), (22.27, -11.0), (40.19, 8.0), (48.26, 17.0)]
SEVEN = np.array([15.9, 25.1, 34.3, 78.1, 81.3, 84.5, 87.7])
MANY = np.setdiff1d(np.arange(10.0, 100.5, 1.0), [50.0])
DENSE = np.setdiff1d(np.round(np.arange(10.0, 100.2, 0.4), 1), [50.0])
PORTS = (Port("y", "y", "y"), Port("z", "z", "z"))
JOINT = {"viscosity": Uncertain(0.1044, 0.03 * 0.1044), "clearance": Uncertain(90e-6, 0.02 * 90e-6)}
# Fewer starts than an identification has by default: where minima are is tested by itself.
FEW = {"start_depths": (20e-6, 40e-6), "start_angles": (-0.15, 0.15)}
TRUTH, OWN = FilmMesh(960, 120), FilmMesh(480, 60)


def measured(
    lines: np.ndarray,
    wear: tuple[float, float],
    mesh: FilmMesh,
    rng: np.random.Generator | None,
    noise: float = 0.02,
    **bearing: float,
) -> FrequencyResponse:
    rig = RIG.with_bearings((), **bearing) if bearing else RIG
    rig = rig.with_bearings(["bearing 2"], wear_depth=wear[0] * 1e-6, wear_angle=float(np.deg2rad(wear[1])))
    matrix = receptance(rig, lines, mesh)
    std = noise * np.abs(matrix).max()
    if rng is not None:
        matrix = matrix + std * (
            rng.standard_normal(matrix.shape) + 1j * rng.standard_normal(matrix.shape)
        ) / np.sqrt(2)
    return FrequencyResponse(
        lines, matrix, PORTS, PORTS, covariance=diagonal_covariance(np.full(matrix.shape, std**2))
    )


def fitted(found: FrequencyResponse, **wear: object) -> Fit:
    settings = WearSettings(**{"rotor": "mendes.yaml", "rig": RIG, **wear})  # type: ignore[arg-type]
    with without_region():
        (fit,) = identify(found, FitSettings("worn-bearing", model_settings=settings, name="wear"))
    return fit


def errors_of(fit: Fit, wear: tuple[float, float]) -> tuple[float, float]:
    """Errors of depth [um] and angle [deg]."""
    depth, angle = fit.parameter("wear_depth").value * 1e6, np.rad2deg(fit.parameter("wear_angle").value)
    return depth - wear[0], float(angle) - wear[1]


@pytest.mark.long
@pytest.mark.parametrize("wear", WEAR[1::2])
def test_noise_free_recovery(wear: tuple[float, float]) -> None:
    """.01 um and .01 deg, and at least ten of the source's twenty starts lead there; seven lines of the full
    dFRF.

    The truth's films have the cells of the identification's: only then is there nothing but the search and
    the tables to err.
    """
    settings = WearSettings("mendes.yaml", rig=RIG, response="dFRF")
    data = worn_receptance(
        measured(SEVEN, wear, OWN, None), FitSettings("worn-bearing", model_settings=settings), settings
    )
    misfit = MISFITS["complex"](worn_model(settings, SEVEN), data)
    found = minima(misfit, start_mesh(settings, misfit))
    assert found[0].starts >= 10 and sum(one.starts for one in found) == 20
    _, best = refine(misfit, found[0])
    np.testing.assert_allclose(best.parameters, wear, atol=0.01)


@pytest.mark.long
def test_joint_method_under_noise_and_model_error() -> None:
    """Root mean square at most .4 um and .5 deg over the wears, one draw of viscosity and clearance, lines
    every .4 Hz.

    The number of intervals that hold the truth must lie within the central 99.9 % of a binomial with 95 %.
    """
    rng = np.random.default_rng(20260)
    bearing = {
        "viscosity": 0.1044 * (1 + 0.03 * rng.standard_normal()),
        "clearance": 90e-6 * (1 + 0.02 * rng.standard_normal()),
    }
    errors, held = [], []
    for wear in WEAR[::3]:
        fit = fitted(measured(DENSE, wear, TRUTH, rng, **bearing), **JOINT, **FEW)
        errors.append(errors_of(fit, wear))
        for name, truth in (("wear_depth", wear[0] * 1e-6), ("wear_angle", np.deg2rad(wear[1]))):
            low, high = fit.parameter(name).ci95 or (np.inf, -np.inf)
            held.append(low <= truth <= high)
    depth, angle = np.sqrt(np.mean(np.square(errors), axis=0))
    assert depth <= 0.4 and angle <= 0.5
    assert sum(held) >= stats.binom.ppf(5e-4, len(held), 0.95)


@pytest.mark.long
def test_another_cavitation_pressure_is_seen_and_calibrated() -> None:
    """Truth -0.3 bar: chi-square says so; calibrated on the healthy rig, at most 1.5 um and .7 deg.

    Coarser films on both sides.
    """
    coarse = {"cells_around": 60, "cells_across": 12}
    rng = np.random.default_rng(3)
    bearing = {"viscosity": 0.1044 * 1.02, "clearance": 90e-6 * 0.99, "cavitation_pressure": -0.3e5}
    healthy, worn = (
        measured(MANY, wear, FilmMesh(120, 24), rng, **bearing) for wear in ((0.0, 0.0), WEAR[2])
    )
    blind = fitted(worn, **JOINT, **FEW, **coarse)
    assert "model-mismatch" in [finding.code for finding in blind.findings]
    tuning = fitted(healthy, healthy=True, cavitation_pressure=Uncertain(-0.1e5, 0.1e5), **JOINT, **coarse)
    assert tuning.parameter("cavitation_pressure").value == pytest.approx(-0.3e5, abs=0.03e5)
    calibrated = fitted(worn, prior="tuning", posterior=posterior(tuning), **FEW, **coarse)
    depth, angle = errors_of(calibrated, WEAR[2])
    assert abs(depth) <= 1.5 and abs(angle) <= 0.7 and calibrated.gof.chi2_p > 1e-3


@pytest.mark.long
def test_healthy_rig_with_model_error() -> None:
    """Below .6 um, and the angle is called not identifiable."""
    response = measured(
        MANY, (0.0, 0.0), TRUTH, np.random.default_rng(4), viscosity=0.1044 * 1.03, clearance=90e-6 * 0.98
    )
    fit = fitted(response, **JOINT, **FEW)
    assert fit.parameter("wear_depth").value < 0.6e-6 and fit.parameter("wear_angle").ci95 is None
    assert any("angle not identifiable" in finding.message for finding in fit.findings)
    assert fit.parameter("healthy_probability").value > 0.5


@pytest.mark.long
def test_source_objective_beside_it() -> None:
    """Log amplitudes of the full dFRF on seven lines, viscosity and clearance as in the rotor file: several
    times farther off.
    """
    rng = np.random.default_rng(5)
    errors: dict[str, list[tuple[float, float]]] = {"joint": [], "log": []}
    lines = np.union1d(MANY, SEVEN)
    for wear in WEAR[:2]:
        response = measured(lines, wear, TRUTH, rng, viscosity=0.1044 * 1.03, clearance=90e-6 * 0.98)
        errors["joint"].append(errors_of(fitted(response, **JOINT, **FEW), wear))
        errors["log"].append(
            errors_of(fitted(response, response="dFRF", objective="log", lines=tuple(SEVEN), **FEW), wear)
        )
    joint, log = (np.sqrt(np.mean(np.square(errors[name]), axis=0)) for name in ("joint", "log"))
    assert log[0] > 2 * joint[0] and log[1] > 2 * joint[1]
