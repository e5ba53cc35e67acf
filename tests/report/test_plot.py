"""labpipe.plot: the figure of a result, as the report has it."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure as Canvas

import labpipe
from labpipe.errors import DataError
from labpipe.records.comparison import ComparedPoint, Comparison
from labpipe.records.identification import Fit, Goodness, Identification
from labpipe.records.response import FrequencyResponse, Port


@pytest.fixture
def response() -> FrequencyResponse:
    frequency = np.arange(40.0, 91.0)
    w = 2 * np.pi * frequency
    h = (1 / (134.5e3 - 0.79 * w**2 + 6.5j * w))[:, None, None]
    return FrequencyResponse(frequency, h, (Port("y", "y", "y"),), (Port("f", "f", "y"),), name="run 1")


def fits(response: FrequencyResponse, sliding: labpipe.Sliding | None = None) -> tuple[Fit, ...]:
    return labpipe.fit(response, labpipe.FitSettings("sdof", mass=0.79, estimator="ls", sliding=sliding))


def labels(canvas: Canvas) -> list[str]:
    return [axes.get_ylabel() for axes in canvas.axes]


def test_a_fit_is_shown_measured_and_fitted(response: FrequencyResponse) -> None:
    (fit,) = fits(response)
    canvas = labpipe.plot(fit)
    assert isinstance(canvas, Canvas) and labels(canvas)[0] == "receptance [um/N]"
    drawn = {line.get_label(): line for line in canvas.axes[0].get_lines()}
    assert np.max(drawn["y/f fitted"].get_ydata()) > np.max(drawn["y/f measured"].get_ydata())
    assert labpipe.plot(fit) is not canvas


def test_bands_of_a_sliding_fit_are_shown_over_frequency(response: FrequencyResponse) -> None:
    assert labels(labpipe.plot(fits(response, labpipe.Sliding(15.0, 5.0)))) == ["k [kN/m]"]
    assert labels(labpipe.plot(list(fits(response))))[0] == "receptance [um/N]"


def test_a_response_an_identification_and_a_comparison(response: FrequencyResponse) -> None:
    assert labels(labpipe.plot(response))[0] == "receptance [um/N]"
    assert len(labels(labpipe.plot(Identification(fits(response), responses=(response,))))) == 3
    points = tuple(ComparedPoint(f"test {n}", 1e6 * n, ci95=None, condition=100.0 * n) for n in (1, 2, 3))
    trend = Comparison(
        name="axial",
        kind="trend",
        subject="k of z",
        unit="N/m",
        points=points,
        amounts=(),
        verdict="rising",
        statement="It rises.",
        condition="preload",
        condition_unit="N",
        line=((100.0, 1e6), (300.0, 3e6)),
    )
    assert labels(labpipe.plot(trend)) == ["k of z [kN/m]"]


def test_what_has_no_figure_is_refused_in_words() -> None:
    bare = Fit(
        "a",
        "sdof",
        "ml",
        band_hz=(1.0, 2.0),
        lines=3,
        equations=6,
        dof=4,
        gof=Goodness(0.9, 0.9),
        parameters=(),
        condition_number=1.0,
        correlation=np.ones((1, 1)),
    )
    with pytest.raises(DataError, match="this Fit has no figure"):
        labpipe.plot(bare)
    with pytest.raises(DataError, match="this Identification has no figure"):
        labpipe.plot(Identification(()))
    with pytest.raises(TypeError, match="no figure of int"):
        labpipe.plot(7)
