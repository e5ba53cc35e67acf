"""Findings of the screening, block by block and by extremes, against their definitions over whole channels,
written plainly.
"""

from __future__ import annotations

from itertools import groupby

import numpy as np
import pytest

from labpipe.raw_files.screening import ChannelScreen
from labpipe.records.finding import Finding

N_SAMPLE = 4000


def clipped_at_limit(x: np.ndarray, limit: float) -> tuple[int, int]:
    """(number, first) of the samples at or beyond the upper *limit*."""
    beyond = [n for n, value in enumerate(x) if np.isfinite(value) and value >= limit]
    return len(beyond), beyond[0] if beyond else -1


def clipped_at_extreme(x: np.ndarray) -> tuple[int, int]:
    """(number, first) of the samples at the maximum: all, where ten times as many have it as each of the 15
    next values, to the digits of single precision; or those in runs of three and more, but for up to three
    times as many as at each of the 3 next values where these are met twice. None of two values.
    """
    finite = x[np.isfinite(x)]
    peak = finite.max()
    if peak == 0:
        return 0, -1
    values, counts = np.unique(finite.astype(np.float32), return_counts=True)
    if values.size < 3:
        return 0, -1
    if values.size > 15 and counts[-1] >= 10 * np.mean(counts[-16:-1]):
        return int(counts[-1]), int(np.flatnonzero(x == peak)[0])
    if values.size > 3 and np.mean(counts[-4:-1]) >= max(2, counts[-1] / 3):
        return 0, -1
    count, first, place = 0, -1, 0
    for at_peak, group in groupby(x == peak):
        length = len(list(group))
        if at_peak and length >= 3:
            count, first = count + length, place if first < 0 else first
        place += length
    return count, first


def findings_by_definition(
    names: list[str], samples: np.ndarray, limits: list[tuple[float, float] | None]
) -> tuple[Finding, ...]:
    found: list[Finding] = []
    for name, x, limit in zip(names, samples.T, limits, strict=True):
        finite = np.isfinite(x)
        missing = np.flatnonzero(~finite)
        if missing.size:
            what = f"{missing.size} of {x.size} samples are not numbers, the first is sample {missing[0]}"
            found.append(Finding("gap", f"channel {name}: {what}"))
        if not finite.any():
            continue
        if x[finite].max() == x[finite].min():
            found.append(Finding("constant", f"channel {name} does not vary at all"))
            continue
        if limit is None:
            runs = [clipped_at_extreme(-x), clipped_at_extreme(x)]
        else:
            margin = 1e-9 * (limit[1] - limit[0])
            runs = [clipped_at_limit(-x, -limit[0] - margin), clipped_at_limit(x, limit[1] - margin)]
        count = sum(number for number, _ in runs)
        if count:
            share = 100 * count / x.size
            percent = f"{share:.0f}" if share >= 99.5 else f"{share:.2g}"
            first = min(first for number, first in runs if number)
            what = f"{count} samples ({percent} %) stand at the end of the range, the first is sample {first}"
            found.append(
                Finding(
                    "clipped",
                    f"channel {name}: {what}; the peaks are cut off and amplitudes come out too small",
                )
            )
    return tuple(found)


# Each makes a channel of a fault from sound samples (n,); many leave the extreme late, so that blocks before
# it are skipped by their ends.
FAULTS = {
    "sound": lambda x, rng: x,
    "clipped noise": lambda x, rng: np.clip(x, *np.quantile(x, [rng.uniform(0, 0.05), rng.uniform(0.95, 1)])),
    "a clipped sine": lambda x, rng: (
        np.clip(np.sin(np.arange(x.size) / 9), -0.8, 0.9) + 1e-3 * (np.abs(x) < 0.01)
    ),
    "a burst late": lambda x, rng: np.where(
        (np.arange(x.size) >= (late := rng.integers(3000, 3900))) & (np.arange(x.size) < late + 5), 9.0, x
    ),
    "bursts of two": lambda x, rng: np.where(np.isin(np.arange(x.size) % 500, [3, 4]), 9.0, x),
    "gaps": lambda x, rng: np.where(rng.random(x.size) < 0.002, np.nan, x),
    "infinities": lambda x, rng: np.where(
        rng.random(x.size) < 0.001, rng.choice([np.inf, -np.inf], x.size), x
    ),
    "nothing": lambda x, rng: np.full(x.size, np.nan),
    "at rest": lambda x, rng: np.full(x.size, float(rng.choice([0.0, 3.0]))),
    "at rest, then not": lambda x, rng: np.where(np.arange(x.size) < 2500, 1.0, x),
    "few levels": lambda x, rng: np.round(x),
    "many levels": lambda x, rng: np.round(x * 200) / 200,
    "a switch": lambda x, rng: np.where(x > 0, 5.0, 0.2),
    "turns in steps": lambda x, rng: np.round(40 * np.sin(np.arange(x.size) / 50)),
    "a window": lambda x, rng: np.where(np.arange(x.size) % 1000 < 50, np.abs(x), 0.0),
    "single precision": lambda x, rng: x.astype(np.float32).astype(float),
    "a gap in a burst": lambda x, rng: np.where(
        np.arange(x.size) == 2001, np.nan, np.where(np.abs(np.arange(x.size) - 2001) < 4, -7.0, x)
    ),
}


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_findings_are_those_of_the_definitions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    names = list(FAULTS)
    sound = rng.normal(size=(N_SAMPLE, len(names))) * 10.0 ** rng.integers(-3, 4)
    samples = np.column_stack([fault(sound[:, n], rng) for n, fault in enumerate(FAULTS.values())])
    limits = [tuple(sorted(rng.normal(size=2) * 3)) if rng.random() < 0.3 else None for _ in names]
    expected = findings_by_definition(names, samples, limits)
    assert {finding.code for finding in expected} == {"gap", "constant", "clipped"}
    for size in (int(rng.integers(1, 60)), int(rng.integers(60, 1500)), N_SAMPLE):
        screen, by_extremes = ChannelScreen(names, limits), ChannelScreen(names, limits)
        for start in range(0, N_SAMPLE, size):
            block = samples[start : start + size]
            screen.add(block)
            if not by_extremes.add_between(
                block.min(axis=0), block.max(axis=0), block.shape[0], block.T.__getitem__
            ):
                by_extremes.add(block)
        assert screen.findings() == expected
        assert by_extremes.findings() == expected


def test_blocks_within_what_was_there_are_not_looked_at() -> None:
    screen, looked = ChannelScreen(["x"]), []
    rng = np.random.default_rng(1)
    for number in range(4):
        block = rng.normal(size=1000) * (1.0 if number != 1 else 5.0)

        def column_of(_: int, block: np.ndarray = block, number: int = number) -> np.ndarray:
            looked.append(number)
            return block

        assert screen.add_between(np.array([block.min()]), np.array([block.max()]), 1000, column_of)
    # Both ends of the first two, the second of five times the range.
    assert looked == [0, 0, 1, 1]


def test_a_run_does_not_go_on_across_a_block_that_is_not_looked_at() -> None:
    """Two samples at the peak end a block, two begin the one after next: no three stand side by side."""
    x = np.random.default_rng(1).normal(size=400)
    x[100:200] *= 0.1
    x[[98, 99, 200, 201]] = 9.0
    screen = ChannelScreen(["x"])
    for start in range(0, 400, 100):
        screen.add(x[start : start + 100, None])
    assert screen.findings() == () == findings_by_definition(["x"], x[:, None], [None])
