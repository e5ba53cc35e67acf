"""Plans in two stages on rigs that are not as expected: python -m tests.methods.planning.two_stages
{pedestal,rotor,seal} COUNT

Coefficients are wrong by up to 30 % either way. A fifth of the time is flat, which is the floor, the rest
planned on its estimate without another; all data are fitted together. Held against the plan of one who knows
the rig, with its floor of 20 % of the power, and against flat alone for the whole time.
"""

from __future__ import annotations

import sys

import numpy as np

from labpipe.methods.planning.campaigns import INTERLEAVED, ONE_BY_ONE
from labpipe.methods.planning.search import Wanted, best, flat
from tests.methods.planning.draws import SECONDS, estimates, planned_rig

# The pedestal's lines are those about its resonance; of the others every so many.
STEP = {"pedestal": 1, "rotor": 4, "seal": 2}


def two_stages(name: str, count: int) -> tuple[list[float], list[float]]:
    """Of every rig the share of the gain that is kept, and the gain over flat: ratios of the largest relative
    error.
    """
    rng = np.random.default_rng(2)
    kept, over_flat = [], []
    for number in range(count):
        nominal, lines, wanted = planned_rig(name)
        lines = lines[(lines >= 104) & (lines < 160)] if name == "pedestal" else lines[:: STEP[name]]
        scheme = ONE_BY_ONE if nominal.model.n_dof == 1 else INTERLEAVED
        size = rng.uniform(0.7, 1.3, nominal.model.expected.size)
        true_model = nominal.model.with_values(nominal.model.expected * size)
        truth, _, _ = planned_rig(name, true_model)
        first = flat(truth, lines, scheme)
        (estimate,) = estimates(truth, [(first, 0.2 * SECONDS)], true_model.expected, 1, number)
        estimated = planned_rig(name, true_model.with_values(estimate))[0]
        second = best(estimated, lines, Wanted("minimax", wanted.goals, 0.0), (scheme,)).campaign
        ideal = best(truth, lines, wanted, (scheme,)).campaign
        both = 0.2 * first.information + 0.8 * truth.rate(second.tests[0])
        errors = [
            np.sqrt(np.diagonal(np.linalg.inv(information)).max())
            for information in (both, ideal.information, first.information)
        ]
        kept.append(float(errors[1] / errors[0]))
        over_flat.append(float(errors[2] / errors[0]))
    return kept, over_flat


if __name__ == "__main__":
    shares, gains = two_stages(sys.argv[1], int(sys.argv[2]))
    print(f"gain kept: median {np.median(shares):.2f}, least {min(shares):.2f}")
    print(f"gain over flat: median {np.median(gains):.2f}, least {min(gains):.2f}")
