"""What the page and the terminal say while a test runs, from made-up standings."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from labpipe.methods.live.charts import Forecast, Goal, GoalWatch, OtherForces, Standing, Update
from labpipe.methods.live.view import headline, left_text, level_text, rows_of
from labpipe.records.finding import Parameter
from labpipe.records.recording import Channel
from labpipe.spectra.settings import FrfSettings

# 18 +- .4 kN/m, of which .1 kN/m is asked for, after 5 hits of 20 s.
K = Parameter("k", 18e3, "N/m", std_error=200.0, ci95=(17.6e3, 18.4e3))
OPEN = Standing(K, 100.0, Forecast(16, 13, 21))
C = Parameter("c", 30.0, "N.s/m")


def update(*standings: Standing, stop: bool = False) -> Update:
    named = {standing.parameter.name: standing for standing in standings}
    return Update(5, seconds=20.0, standings=named, stop=stop)


@pytest.mark.parametrize(
    ("standing", "text"),
    [
        (OPEN, "11 more hits, about 3 min 40 s (80 %: 8-16); at twice the level 3"),
        (replace(OPEN, remaining=Forecast(6)), "1 more hit, about 20 s"),
        (
            replace(OPEN, remaining=Forecast(2, 1, 3)),
            "1 more hit, about 20 s (80 %: 0-0); at twice the level 1",
        ),
        (
            replace(OPEN, remaining=Forecast(16, others=OtherForces(("y",), 4))),
            "11 more hits, about 3 min 40 s; with y by turns 4 more hits",
        ),
        (
            replace(OPEN, remaining=Forecast(16, others=OtherForces(("y",), 11))),
            "11 more hits, about 3 min 40 s",
        ),
        (replace(OPEN, remaining=Forecast(None)), "not by more averages"),
        (replace(OPEN, remaining=None), ""),
        (replace(OPEN, goal=500.0), "reached"),
        (replace(OPEN, goal=None), ""),
    ],
)
def test_what_is_still_to_come(standing: Standing, text: str) -> None:
    """At twice the level of force noise is a quarter in power: a quarter of the averages, rounded up."""
    assert left_text(standing, update(), "hit") == text


def test_rows_begin_with_what_was_asked_for() -> None:
    session: Any = SimpleNamespace(what="hit")
    rows = rows_of(session, update(replace(OPEN, parameter=C, goal=None), OPEN))
    assert [row[0] for row in rows] == ["k", "c"]
    assert rows[0][1:3] == ("18.00 ± 0.40 kN/m", "± 0.56 %") and rows[0][3].startswith("11 more hits")
    assert rows[1][1:] == ("30 N.s/m", "", "")
    assert math.isinf(replace(OPEN, parameter=C).half) and OPEN.half == pytest.approx(400)


@pytest.mark.parametrize(
    ("standings", "stop", "text"),
    [
        (
            (OPEN, replace(OPEN, parameter=replace(K, name="m"), goal=500.0)),
            False,
            "1 of 2 goals are not reached yet.",
        ),
        ((replace(OPEN, goal=None),), False, "No goal is set."),
        ((replace(OPEN, goal=500.0),), True, ""),
        ((), False, "It is too early to judge the goals."),
    ],
)
def test_where_the_test_stands(standings: tuple[Standing, ...], stop: bool, text: str) -> None:
    session: Any = SimpleNamespace(what="hit", goals="No goal" not in text)
    said = headline(session, update(*standings, stop=stop))
    assert said == ("Enough: 5 hits, every goal is reached." if stop else f"5 hits. {text}")


def test_a_standard_error_asks_for_noise_alone_and_an_interval_for_all() -> None:
    """1 % of 100 N/m is twice 1 N/m of half-width by noise; beside a floor of 3 N/m root (4 + 9)."""
    k, frf = Parameter("k", 100.0, "N/m"), FrfSettings("periodic", period=1.0)
    of_noise, of_all = (
        GoalWatch((), 1.0, frf, (), [Goal.of(f"k.{kind}<=1%")]) for kind in ("std_error", "expanded")
    )
    assert (of_noise.goal_of("a", k, 0.0), of_noise.goal_of("a", k, 3.0)) == pytest.approx((2.0, 13**0.5))
    assert (
        of_all.goal_of("a", k, 3.0) == pytest.approx(1.0)
        and of_all.goal_of("a", replace(k, name="c"), 3.0) is None
    )


def test_a_level_is_a_share_of_the_range_that_the_rig_states() -> None:
    """3 V/N makes 250 N of a range of -1 to 1 kN a quarter."""
    force = Channel("f", "force", "input", "y")
    stated = SimpleNamespace(channel=force, limits=(-3e3, 3e3), scale=1 / 3)
    rig = SimpleNamespace(all_channels=[force], channels=[stated])
    session: Any = SimpleNamespace(rig=rig)
    assert level_text(session, "f", 250.0) == "250 N (25 % of its range)"
    rig.channels = [SimpleNamespace(channel=force, limits=None, scale=1.0)]
    assert level_text(session, "f", np.float64(250.0)) == "250 N"
