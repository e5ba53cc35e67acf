"""A small wear rig that the tests of the wear identification share: coarse oil films, so that a table takes a
second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.arrays import ComplexArray
from labpipe.estimation.settings import FitSettings
from labpipe.methods.journal_bearing.film import FilmMesh
from labpipe.methods.rotor.response import ReducedRotor
from labpipe.methods.rotor.rig import RotorRig
from labpipe.methods.rotor.rotor_file import load_rotor
from labpipe.methods.wear.model import MISFITS, WornMisfit, WornReceptance, worn_model, worn_receptance
from labpipe.methods.wear.settings import WearSettings
from labpipe.methods.wear.tables import VaryingSupport, forward_backward, response_with_slopes
from labpipe.methods.wear.virtual_rig import receptance
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.records.uncertain import Uncertain

RIG = load_rotor(Path(__file__).parents[3] / "configs/rotors/mendes.yaml")
# The fits refine on films of four times the cells of their tables around, twice those across; the truth has
# those, so that a fit without noise is exact.
COARSE, FINE = (48, 8), FilmMesh(192, 16)
LINES = np.array([15.9, 20.5, 25.1, 29.7, 34.3, 78.1, 79.7, 81.3, 82.9, 84.5, 86.1, 87.7])
Y, Z = Port("y", "y", "y"), Port("z", "z", "z")
PORTS = (Y, Z)
VISCOSITY, CLEARANCE = Uncertain(0.1044, 0.003), Uncertain(90e-6, 1.8e-6)
NUISANCES = {"viscosity": VISCOSITY, "clearance": CLEARANCE}
SCALE = np.array([1e-6, np.deg2rad(1.0)])


@contextmanager
def without_region() -> Iterator[None]:
    """Fits without the outline of the joint region, which takes a third of their time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("labpipe.methods.wear.fit._region", lambda _solved, _parameters: ())
        yield


def wear_settings(**changes: object) -> WearSettings:
    """Settings with the rig in place, coarse films, and four starts, one in every quarter of the range."""
    starts = {"start_depths": (12e-6, 36e-6), "start_angles": (-0.15, 0.15)}
    given = {
        **({} if changes.get("healthy") else starts),
        "rotor": "mendes.yaml",
        "rig": RIG,
        "cells_around": COARSE[0],
        "cells_across": COARSE[1],
        **changes,
    }
    return WearSettings(**given)  # type: ignore[arg-type]


def fit_settings(**changes: object) -> FitSettings:
    return FitSettings("worn-bearing", model_settings=wear_settings(**changes), name="wear")


def worn_rig(depth: float = 0.0, angle: float = 0.0, **bearing: float) -> RotorRig:
    """The rig with *depth* [um] at *angle* [deg] in bearing 2; *bearing*: changes in both bearings."""
    rig = RIG.with_bearings((), **bearing) if bearing else RIG
    return rig.with_bearings(["bearing 2"], wear_depth=depth * 1e-6, wear_angle=float(np.deg2rad(angle)))


def measured(
    rig: RotorRig,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
    lines: np.ndarray = LINES,
    known: bool = True,
) -> FrequencyResponse:
    """Its response with circular noise of *noise* times the largest |H|.

    Of 1e-6 times, but not added, where there is none.
    """
    matrix = receptance(rig, lines, FINE)
    std = (noise or 1e-6) * np.abs(matrix).max()
    if noise and rng is not None:
        matrix = matrix + std * (
            rng.standard_normal(matrix.shape) + 1j * rng.standard_normal(matrix.shape)
        ) / np.sqrt(2)
    covariance = diagonal_covariance(np.full(matrix.shape, std**2)) if known else None
    return FrequencyResponse(lines, matrix, PORTS, PORTS, covariance=covariance)


def misfit_of(found: FrequencyResponse, **changes: object) -> WornMisfit:
    """The misfit of a response under some settings."""
    settings = fit_settings(**changes)
    assert settings.model_settings is not None
    data: WornReceptance = worn_receptance(found, settings, settings.model_settings)
    return MISFITS[settings.model_settings.objective](
        worn_model(settings.model_settings, data.frequency), data
    )


def turned(
    response: FrequencyResponse, ports: tuple[Port, Port], left: np.ndarray, right: np.ndarray
) -> FrequencyResponse:
    """The response L H R under other ports, without covariance."""
    return replace(
        response, matrix=left @ response.matrix @ right, outputs=ports, inputs=ports, covariance=None
    )


@dataclass(frozen=True)
class WornRig:
    """A rotor on all its bearings except the worn one, reduced to the nodes of that one, sensors and exciter;
    bearing: its coefficients with their derivatives by depth [m] and angle [rad].
    """

    rotor: ReducedRotor
    bearing: Callable[[float, float], VaryingSupport]
    output: int
    force: int


def worn_response(
    depth: float, angle: float, rig: WornRig, directional: bool = False
) -> tuple[ComplexArray, ComplexArray]:
    """Receptance (n_line, 2, 2) [m/N] of a wear and its derivatives (2, n_line, 2, 2) by depth and angle."""
    response, slopes = response_with_slopes(rig.rotor, [rig.bearing(depth, angle)], rig.output, rig.force)
    return (forward_backward(response), forward_backward(slopes)) if directional else (response, slopes)
