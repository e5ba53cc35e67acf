"""Shapes on a structure: which way a dof moves its point, and the shapes of a beam on two hinges against
their closed form.
"""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.modal.settings import ModalSettings
from labpipe.records.fit_details import Modes
from labpipe.records.rig import Geometry
from labpipe.report.figures import REACH, project, shape_figures
from tests.methods.modal.structures import beam, beam_geometry, beam_shapes

PAIR = Geometry(("1", "gyz"), np.zeros((2, 3)), np.array([[0, 1]]))


@pytest.mark.parametrize(
    ("dof", "point", "direction"),
    [
        ("1.x", 0, (1, 0, 0)),
        ("1:-y", 0, (0, -1, 0)),
        ("1+Z", 0, (0, 0, 1)),
        ("1y", 0, (0, 1, 0)),
        ("1", 0, (0, 0, 1)),
        ("gyz", 1, (0, 0, 1)),
        ("gyz.x", 1, (1, 0, 0)),
    ],
)
def test_a_dof_names_its_point_and_direction(dof: str, point: int, direction: tuple[int, int, int]) -> None:
    found, vector = PAIR.place(dof)
    assert found == point and tuple(vector) == direction


def test_a_direction_alone_belongs_to_the_only_point() -> None:
    assert Geometry(("rotor",), np.zeros((1, 3)), np.empty((0, 2), int)).place("y")[0] == 0
    with pytest.raises(DataError, match=r"no point 'y', of the dof 'y'; its points: 1, gyz"):
        PAIR.place("y")


def test_several_dofs_of_a_point_add_up() -> None:
    motion = PAIR.motion(["1.x", "1.-z", "gyz.y"], np.array([[1.0 + 2j], [3.0], [4.0]]))
    np.testing.assert_array_equal(motion, [[[1 + 2j, 0, -3], [0, 4, 0]]])


def test_the_shapes_of_a_beam_on_two_hinges_stand_on_its_points() -> None:
    settings = ModalSettings(structure=beam_geometry())
    (fit,) = identify(beam(2), FitSettings("modal", model_settings=settings))
    assert fit.detail(Modes) is not None and fit.detail(Modes).geometry is settings.structure
    motion = beam_geometry().motion(fit.detail(Modes).dofs, fit.detail(Modes).shapes)
    assert not motion[:, [0, -1]].any() and not motion[:, :, :2].any()
    error = np.abs(
        motion[:, 1:-1, 2].T
        - beam_shapes()
        * np.sign(beam_shapes()[np.argmax(np.abs(fit.detail(Modes).shapes), axis=0), range(3)])
    )
    assert np.all(error < 4 * fit.detail(Modes).shape_std_errors + 1e-9)
    (figure,) = shape_figures("beam", fit.detail(Modes))
    sketch = figure.graphic.subject  # type: ignore[union-attr]
    there, back = sketch.extremes(0)
    assert np.max(np.abs(there - sketch.positions)) == pytest.approx(REACH, rel=1e-3)
    np.testing.assert_allclose((there + back) / 2, sketch.positions, atol=1e-12)


def test_a_point_that_the_geometry_lacks_is_named() -> None:
    lacking = Geometry(("1", "2"), np.zeros((2, 3)), np.empty((0, 2), int))
    with pytest.raises(DataError, match=r"no point '3', of the dof '3\.z'"):
        identify(beam(1), FitSettings("modal", model_settings=ModalSettings(structure=lacking)))


def test_views_are_turned_as_an_eye_sees() -> None:
    """From the front x goes right and z up, from above y goes up, after a quarter turn y goes right."""
    points = np.eye(3)
    np.testing.assert_allclose(project(points, 0.0, 0.0), [[1, 0], [0, 0], [0, 1]], atol=1e-15)
    np.testing.assert_allclose(project(points, 0.0, np.pi / 2), [[1, 0], [0, 1], [0, 0]], atol=1e-15)
    np.testing.assert_allclose(project(points, np.pi / 2, 0.0), [[0, 0], [1, 0], [0, 1]], atol=1e-15)
