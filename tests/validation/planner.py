"""Plans: printed optimum designs."""

from __future__ import annotations

from functools import partial

import numpy as np

from labpipe.methods.planning.designs import optimum
from tests.validation.claims import Claim, Method, within, worst
from tests.validation.gaps import gaps

POINTS = np.linspace(-1, 1, 21)
QUADRATIC = np.stack([np.outer(row, row) for row in np.stack([np.ones(21), POINTS, POINTS**2], axis=1)])
LINE = np.stack([np.outer(row, row) for row in np.stack([np.ones(21), POINTS], axis=1)])
PRINTED = "printed calculation"


def designs() -> list[Claim]:
    """Shares of the runs at the points that carry any.

    The search ends 0.1 % below the optimum, 0.002 of a share.
    """
    found = []
    for criterion, shares in (("D", (1 / 3, 1 / 3, 1 / 3)), ("A", (1 / 4, 1 / 2, 1 / 4))):
        ours = optimum(criterion, QUADRATIC).shares[[0, 10, 20]]
        each = [
            within(f"at {place}", value, share, 2e-3, "1", PRINTED, "Fedorov 1972")
            for place, value, share in zip((-1, 0, 1), ours, shares, strict=True)
        ]
        found.append(worst(each, f"{criterion}-optimum shares of a parabola"))
    far = optimum("minimax", LINE, np.array([[1.0, 2.0]]))
    variance = np.array([1, 2]) @ np.linalg.inv(far.information) @ np.array([1, 2])
    found.append(
        within(
            "share at 1, line extrapolated to 2",
            far.shares[20],
            0.75,
            2e-3,
            "1",
            PRINTED,
            "Hoel, Levine 1964",
        )
    )
    found.append(within("its variance", variance, 4.0, 4e-3, "1", PRINTED, "Hoel, Levine 1964"))
    two = np.stack([np.outer(row, row) for row in np.array([[1.0, 0.0], [1.0, 2.0]])])
    # Shares 1 - w and w: v_a = 1 / (1 - w), v_b = 1 / (4 w (1 - w)); the larger is least at w = 1/4.
    found.append(
        within(
            "minimax share of a line at 0 and 2",
            optimum("minimax", two).shares[1],
            0.25,
            1e-3,
            "1",
            "closed form",
            "by hand",
        )
    )
    return found


METHOD = Method("planner", "Plans", {"designs": designs, "not tested": partial(gaps, "planner")})
