"""Measured data that another project ships (vibrationtesting, MIT licence): an analyser's MATLAB files, and a
mode known from elsewhere.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

import labpipe
from labpipe.project.scaffold import scaffold
from labpipe.project.settings_reader import DECIDE
from labpipe.raw_files.table import open_table
from tests.validation.shipped import analysed, shipped


@pytest.mark.parametrize("band", [(204.0, 220.0), (209.0, 215.0)])
@pytest.mark.parametrize("estimator", ["ls", "iv"])
def test_the_mode_that_the_package_prints(band: tuple[float, float], estimator: str) -> None:
    """212.0925 Hz stands in the package's documentation, from a fit of its own.

    Half the mode's width and a line are 0.18 and 0.31 Hz.
    """
    (fit,) = labpipe.fit(analysed(), labpipe.FitSettings("sdof", estimator=estimator, band=band, name="mode"))
    assert fit.parameter("f_n").value == pytest.approx(212.0925, abs=0.03)


def test_the_time_records_of_the_analyser_are_read_with_their_rate() -> None:
    table = open_table(shipped("case1.mat"))
    assert table.sample_rate == 1280.0
    assert table.columns == ("Time_domain", "Time_chan_1", "Time_chan_2")
    rows = np.concatenate(list(table.chunks(table.columns)))
    np.testing.assert_array_equal(rows[:, 2], loadmat(shipped("case1.mat"))["Time_chan_2"].ravel())


def test_a_time_step_gives_the_rate() -> None:
    table = open_table(shipped("frf_data1.mat"))
    assert set(table.columns) == {"x", "f"} and table.sample_rate == pytest.approx(10.0)


def test_a_project_of_such_a_file_asks_for_what_it_does_not_say(tmp_path: Path) -> None:
    """The averaged FRF with its frequencies and coherence, beside a last block of time data: its unit alone
    is for a person, and the band lies around the published mode of 212.0925 Hz.
    """
    made = scaffold([shipped("case1.mat")], tmp_path)
    assert (
        'variables: {frequency: "Freq_domain", complex: "Hf_chan_2", coherence: "Hf_coh_chan_2"}'
        in made.pipeline
    )
    assert made.rig == "" and made.pipeline.count(DECIDE) == len(made.decisions) == 1
    low, high = map(float, re.search(r"band: ([\d.]+)-([\d.]+) Hz", made.pipeline).groups())
    assert low < 212.0925 < high and high - low < 0.1 * 212
