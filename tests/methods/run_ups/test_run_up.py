"""A run-up is valid by construction."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.methods.run_ups.records import RunUp, Shaker
from labpipe.records.uncertain import Uncertain

ONES = np.ones((2, 1, 2))
RUN = RunUp(
    "run",
    5.0,
    np.array([60.0, 70.0]),
    ("disc",),
    ONES + 0j,
    amplitude_error=0.01 * ONES,
    phase_error=0.02 * ONES,
    unbalance={"disc": 1e-5 + 0j},
)


def test_it_is_read_only_and_knows_its_speeds_in_rpm() -> None:
    np.testing.assert_allclose(RUN.rpm, [572.958, 668.451], atol=1e-3)
    assert RUN.n_speed == 2
    with pytest.raises(ValueError, match="read-only"):
        RUN.response[0] = 0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"load": 0.0}, "the load"),
        ({"speed": np.array([70.0, 60.0])}, "must rise"),
        ({"speed": np.array([0.0, 60.0])}, "must rise from above zero"),
        ({"response": np.ones((2, 2, 2))}, "shape"),
        ({"response": np.full((2, 1, 2), np.nan)}, "not finite"),
        ({"amplitude_error": 0 * ONES}, "amplitude error"),
        ({"phase_error": -ONES}, "phase error"),
        ({"planes": ()}, "shape"),
        ({"unbalance": {}}, "either an unbalance or a shaker"),
        ({"shaker": Shaker("disc", 1.0, 0.0)}, "either an unbalance or a shaker"),
        ({"unbalance": {"other": 1.0 + 0j}}, "not among its planes"),
        ({"threshold": Uncertain(300.0)}, "threshold"),
    ],
)
def test_what_does_not_fit_together_is_refused(changes: dict[str, object], said: str) -> None:
    with pytest.raises(DataError, match=said):
        dataclasses.replace(RUN, **changes)  # type: ignore[arg-type]


def test_two_planes_of_one_name_are_refused() -> None:
    both = np.ones((2, 2, 2))
    with pytest.raises(DataError, match="different names"):
        RunUp(
            "run",
            5.0,
            RUN.speed,
            ("disc", "disc"),
            both + 0j,
            amplitude_error=both,
            phase_error=both,
            unbalance={"disc": 1e-5 + 0j},
        )
