"""Forces that act independently, and such that do not."""

from __future__ import annotations

import numpy as np
import pytest

from labpipe.errors import DataError
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.ports import find_layout
from labpipe.spectra.quality import check_forces, check_responses, condition_number, force_inverse

CHANNELS = tuple(Channel(name, "force", "input", name) for name in "ab") + tuple(
    Channel(n, "displacement", "output", n) for n in "xy"
)
LAYOUT = find_layout([Recording(CHANNELS, np.zeros((2, 4)), 1.0, "run")])


def correlation(c: complex) -> np.ndarray:
    return np.array([[[1.0, c], [np.conj(c), 1.0]]])


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_condition_is_that_of_the_singular_values(rng: np.random.Generator, n: int) -> None:
    root = rng.normal(size=(30, n, 2 * n)) + 1j * rng.normal(size=(30, n, 2 * n))
    matrix = root @ root.conj().swapaxes(1, 2)
    scale = np.sqrt(np.einsum("fii->fi", matrix).real)
    matrix = matrix / (scale[:, :, None] * scale[:, None, :])
    np.testing.assert_allclose(condition_number(matrix), np.linalg.cond(matrix), rtol=1e-9)


def test_equal_forces_have_no_finite_condition() -> None:
    assert condition_number(correlation(1j))[0] == np.inf
    assert condition_number(correlation(1 + 1e-16))[0] == np.inf
    assert condition_number(np.ones((1, 3, 3)) + 0j)[0] > 1e14


def test_forces_in_step_are_refused_in_any_unit() -> None:
    unit = np.array([1e-12, 1e6])
    check_forces(correlation(0.99) * np.outer(unit, unit), LAYOUT)
    with pytest.raises(DataError, match="forces a, b do not act independently"):
        check_forces(correlation(1 - 1e-7) * np.outer(unit, unit), LAYOUT)
    with pytest.raises(DataError, match="no power"):
        check_forces(np.array([[[1.0, 0], [0, 0]]]), LAYOUT)


@pytest.mark.parametrize("n", [3, 4])
@pytest.mark.parametrize("share", [0.9, 1 - 5e-6, 1 - 2.5e-6, 1 - 1e-7])
def test_three_forces_and_more_are_judged_by_their_eigenvalues(n: int, share: float) -> None:
    # Equal coherence of all pairs: the eigenvalues are 1 + (n - 1) share and 1 - share, a condition of 1e6 is
    # refused.
    channels = tuple(Channel(f"f{k}", "force", "input", f"f{k}") for k in range(n)) + CHANNELS[2:]
    layout = find_layout([Recording(channels, np.zeros((2, n + 2)), 1.0, "run")])
    matrix = np.full((2, n, n), share + 0j)
    matrix[:, range(n), range(n)] = 1.0
    matrix[0] = np.eye(n)
    if (1 + (n - 1) * share) / (1 - share) < 1e6:
        check_forces(matrix, layout)
    else:
        with pytest.raises(DataError, match="do not act independently"):
            check_forces(matrix, layout)


def test_only_h2_needs_responses_that_move_independently() -> None:
    check_responses(correlation(1 - 1e-7), LAYOUT, "Hv")
    with pytest.raises(DataError, match="responses do not move independently"):
        check_responses(correlation(1 - 1e-7), LAYOUT, "H2")
    with pytest.raises(DataError, match="Hv needs responses at every line; silent: y"):
        check_responses(np.array([[[1.0, 0], [0, 0]]]), LAYOUT, "Hv")


def test_the_inverse_of_the_forces_undoes_them(rng: np.random.Generator) -> None:
    forces = (rng.normal(size=(5, 2, 3)) + 1j * rng.normal(size=(5, 2, 3))) * np.array([1e-9, 1e3])[:, None]
    scaled = forces / np.array([1e-9, 1e3])[:, None]
    inverse = force_inverse(forces, LAYOUT) * np.array([1e-9, 1e3])
    np.testing.assert_allclose(scaled @ inverse, np.tile(np.eye(2), (5, 1, 1)), atol=1e-12)


def test_too_few_or_equal_runs_are_refused() -> None:
    with pytest.raises(DataError, match=r"1 recording\(s\) cannot separate 2 forces"):
        force_inverse(np.ones((1, 2, 1)) + 0j, LAYOUT)
    with pytest.raises(DataError, match="do not act in independent directions"):
        force_inverse(np.ones((1, 2, 2)) + 0j, LAYOUT)
