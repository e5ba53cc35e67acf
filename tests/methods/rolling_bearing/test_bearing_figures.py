"""The drawings of a bearing model show what the numbers say."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.bearings.kinds import BearingCoefficients
from labpipe.methods.rolling_bearing.bearing import rolling_coefficients
from labpipe.methods.rolling_bearing.settings import BallBearingSettings, Loads
from labpipe.project.bearing import stiffness_figure, sweep_figures


def bearing(force: float) -> BearingCoefficients:
    settings = BallBearingSettings(
        kind="ball-bearing",
        elements=9,
        stiffness_constant=1.10e10,
        groove_distance=5.953e-4,
        pitch_radius=0.03,
        loads=Loads(y=-24.0, z=force),
    )
    return rolling_coefficients([settings])[0]


def test_heat_map_says_value_and_unit_of_every_coefficient() -> None:
    found = bearing(427.0)
    (panel,) = stiffness_figure("6208", found).graphic.panels
    (matrix,) = panel.series
    texts = [text for row in matrix.texts for text in row]
    assert len(texts) == 25 and texts[0] == f"{found.stiffness[0, 0] / 1e3:.4g}\nkN/m" and texts[1] == "0"
    assert texts[4] == f"{found.stiffness[0, 4]:.4g}\nN/rad"
    np.testing.assert_allclose(matrix.y, found.relative)
    assert panel.x.ticks[2] == (2.0, "z") and matrix.name == "k_ij / sqrt(k_ii k_jj)"


def test_sweep_curves_are_the_coefficients_in_panels_by_unit() -> None:
    values = np.array([100.0, 400.0, 900.0])
    found = [bearing(force) for force in values]
    figures = sweep_figures("6208", "loads.z [N]", values, found)
    assert list(figures) == ["stiffness"]
    panels = figures["stiffness"].graphic.panels
    assert [panel.y.label for panel in panels] == [
        "stiffness [kN/m]",
        "stiffness [N/rad]",
        "stiffness [N.m/rad]",
    ]
    lines = {series.name: series for panel in panels for series in panel.series}
    assert set(lines) == {
        "k x,x",
        "k y,y",
        "k y,z",
        "k z,z",
        "k x,by",
        "k y,bx",
        "k z,bx",
        "k bx,bx",
        "k by,by",
    }
    assert lines["k z,z"].y == pytest.approx([each.stiffness[2, 2] / 1e3 for each in found])
    assert "range over one passage of a rolling element" in figures["stiffness"].caption


def test_damping_has_its_figure_and_asymmetric_matrices_show_both_sides() -> None:
    """A journal bearing's two dofs: k_yz and k_zy differ and are both drawn."""
    stiffness = np.array([[2.0, 7.0], [-8.0, 1.0]]) * 1e6
    found = [
        BearingCoefficients(dofs=("y", "z"), stiffness=factor * stiffness, damping=np.eye(2) * 1e3)
        for factor in (1.0, 2.0)
    ]
    figures = sweep_figures("journal", "speed [Hz]", np.array([10.0, 20.0]), found)
    labels = [series.name for series in figures["stiffness"].graphic.panels[0].series]
    assert labels == ["k y,y", "k y,z", "k z,y", "k z,z"]
    assert figures["damping"].graphic.panels[0].y.label == "damping [kN.s/m]"
    assert "range" not in figures["stiffness"].caption
