"""The drawing of an oil film shows the film that carries the load, and `labpipe bearing -o` writes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.writing import output_folder
from labpipe.bearings.kinds import PressureField
from labpipe.document.charts import canvas_of
from labpipe.methods.journal_bearing.drawing import contour_levels
from labpipe.methods.journal_bearing.kind import JournalFile, film_figure, journal_coefficients
from labpipe.project.bearing import evaluate, write_bearing
from labpipe.project.bearing_file import open_bearing

MENDES = JournalFile(
    kind="journal-bearing",
    diameter=0.031,
    length=0.018,
    clearance=90e-6,
    viscosity=0.1044,
    speed=50.0,
    load=58.82,
    accuracy=0.02,
)


@pytest.fixture(scope="module")
def film() -> PressureField:
    found = journal_coefficients(MENDES).film
    assert found is not None
    return found


def test_the_field_carries_the_load(film: PressureField) -> None:
    """Its pressure on the journal's surface, -p n, sums to the load upwards [N].

    Midpoint rule, so to a percent.
    """
    cell = (film.theta[1] - film.theta[0]) * 0.031 / 2 * (film.axial[1] - film.axial[0])
    across = film.pressure.sum(axis=1) * cell
    force = -across @ np.column_stack([np.cos(film.theta), np.sin(film.theta)])
    np.testing.assert_allclose(force, [0.0, 58.82], atol=0.6)


def test_field_and_middle_are_drawn_in_bar_over_degrees(film: PressureField) -> None:
    field, middle, beside = [
        axes for axes in canvas_of(film_figure("b", film).graphic).axes if axes.get_label() != "<colorbar>"
    ]
    x, y = (np.asarray(values, float) for values in middle.get_lines()[0].get_data())
    assert x[0] >= 0 and x[-1] <= 360 and np.all(np.diff(x) > 0)
    centre = np.abs(film.axial) == np.abs(film.axial).min()
    assert y.max() == pytest.approx(film.pressure[:, centre].max() / 1e5, rel=1e-6)
    thickness = np.asarray(beside.get_lines()[0].get_ydata(), float)
    assert thickness.min() == pytest.approx(film.thickness.min() * 1e6) and beside.get_ylim()[0] == 0
    assert field.get_ylabel() == "from mid width [mm]"


def test_an_odd_number_of_cells_has_its_own_middle() -> None:
    """Pressure 3 bar at mid width, 1 bar beside it."""
    theta = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    pressure = np.outer(np.linspace(1, 1.7, 8), [1e5, 3e5, 1e5])
    figure = film_figure(
        "b", PressureField(theta, np.array([-0.005, 0.0, 0.005]), pressure, np.full(8, 5e-5))
    )
    middle = canvas_of(figure.graphic).axes[1]
    np.testing.assert_allclose(
        np.asarray(middle.get_lines()[0].get_ydata(), float), 3 * np.linspace(1, 1.7, 8)
    )


@pytest.mark.parametrize("torn", [0.0, -0.3, -1e-19])
def test_no_cell_lies_outside_the_contours(torn: float) -> None:
    """Rounding leaves torn cells a hair below their pressure; a field of one value has levels as well."""
    pressure = np.array([[torn, torn - 1e-17, 0.5], [1.0, 2.1, torn]])
    levels = contour_levels(pressure)
    assert (
        levels[0] < pressure.min()
        and levels[-1] > pressure.max()
        and np.all(np.diff(levels) > 0)
        and levels.size >= 8
    )
    assert np.all(np.diff(contour_levels(np.full((2, 3), torn))) > 0)


def test_bearing_with_a_film_writes_its_pressure_and_one_without_none(tmp_path: Path) -> None:
    configs = Path(__file__).parents[3] / "configs" / "bearings"
    written = {}
    for name in ("mendes-journal", "nsk-6208"):
        file = open_bearing(configs / f"{name}.yaml")
        with output_folder(tmp_path / name) as folder:
            written[name] = write_bearing(file, name, evaluate(file), folder)
    assert "pressure.svg" in written["mendes-journal"] and "pressure.svg" not in written["nsk-6208"]
    assert "<svg" in (tmp_path / "mendes-journal" / "pressure.svg").read_text(encoding="utf-8")
