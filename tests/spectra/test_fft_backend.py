"""A user's own FFT: what scipy.fft.set_backend names is what the spectra of recordings are made with."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from scipy import fft

from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings


class CountingBackend:
    """numpy's FFT in the place of scipy's, its calls counted."""

    __ua_domain__ = "numpy.scipy.fft"

    def __init__(self) -> None:
        self.calls: Counter[str] = Counter()

    def __ua_function__(
        self, method: Callable[..., Any], args: Sequence[Any], kwargs: Mapping[str, Any]
    ) -> Any:
        """The interface of uarray, by which scipy asks a backend for *method*."""
        self.calls[method.__name__] += 1
        # numpy has no overwrite_x.
        known = {name: value for name, value in kwargs.items() if name in ("n", "axis", "norm")}
        return getattr(np.fft, method.__name__)(*args, **known)


def recording(n_sample: int, n_output: int, rng: np.random.Generator) -> Recording:
    force = Channel("f", "force", "input", "x")
    samples = rng.normal(size=(n_sample, 1 + n_output))
    samples[:, 1:] += samples[:, :1]
    return Recording(
        (force, *(Channel(f"y{n}", "displacement", "output", f"d{n}") for n in range(n_output))),
        samples,
        1024.0,
        "run",
    )


@pytest.mark.parametrize(
    ("block", "n_output", "method"), [(1024, 2, "rfft"), (8192, 2, "fft"), (8192, 6, "fft")]
)
def test_random_data_are_transformed_by_the_backend(
    rng: np.random.Generator, block: int, n_output: int, method: str
) -> None:
    # Short blocks, long ones, and long ones of many channels take three ways; numpy's own FFT is the
    # independent calculation.
    source, settings = recording(12 * block, n_output, rng), FrfSettings("random", block=block / 1024)
    usual, backend = measure([source], settings), CountingBackend()
    with fft.set_backend(backend):
        other = measure([source], settings)
    assert backend.calls[method] > 0
    assert usual.variance is not None
    assert np.max(np.abs(other.matrix - usual.matrix) / np.sqrt(usual.variance)) < 1e-10


def test_periods_are_transformed_by_the_backend(rng: np.random.Generator) -> None:
    period = np.tile(rng.normal(size=(1024, 1)), (6, 2)) + 1e-3 * rng.normal(size=(6 * 1024, 2))
    source = Recording(recording(2, 1, rng).channels, period, 1024.0, "run")
    settings = FrfSettings("periodic", period=1.0)
    usual, backend = measure([source], settings), CountingBackend()
    with fft.set_backend(backend):
        other = measure([source], settings)
    assert backend.calls["rfft"] > 0
    np.testing.assert_allclose(other.matrix, usual.matrix, rtol=1e-10)
