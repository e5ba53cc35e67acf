"""Modal identification against a public LSCF package on the same data: error in the worst mode, and time."""

from __future__ import annotations

import contextlib
import io

import numpy as np

from labpipe.methods.modal.likelihood import FrfLines, Refined
from labpipe.methods.modal.poles import normal_equations, refine_with_terms, stabilisation
from tests.benchmarks.test_identify_ratios import cpu_time
from tests.methods.modal.structures import DAMPING, FREQUENCIES, nine_modes


def own(omega: np.ndarray, matrix: np.ndarray) -> Refined:
    modes = stabilisation(normal_equations(omega, matrix, 60), (omega[0], omega[-1]), 60).modes
    return refine_with_terms(
        FrfLines(omega, matrix, 2, np.ones(omega.size)), modes.values, modes.participation
    )[0]


def peer_poles(frequency: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Poles of all orders up to 60; the package takes one row of FRFs. It is loaded here: every run of the
    tests collects this file.
    """
    import sdypy.EMA as peer

    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        model = peer.Model(
            matrix.reshape(frequency.size, -1).T,
            frequency,
            lower=frequency[0],
            upper=frequency[-1],
            pol_order_high=60,
            frf_form="accelerance",
        )
        model.get_poles(method="lscf", show_progress=False)
    return np.concatenate([np.asarray(poles) for poles in model.all_poles])


def relative_errors(poles: np.ndarray) -> np.ndarray:
    """Of frequency and damping ratio of the nine modes, (2, 9).

    Of many poles the one nearest to the truth.
    """
    truth = 2 * np.pi * FREQUENCIES * (-DAMPING + 1j * np.sqrt(1 - DAMPING**2))
    nearest = np.array([poles[np.argmin(np.abs(poles - pole))] for pole in truth])
    zeta = -nearest.real / np.abs(nearest)
    return np.abs(np.stack([np.abs(nearest) / (2 * np.pi * FREQUENCIES) - 1, zeta / DAMPING - 1]))


def test_modes_against_a_public_package(record_property) -> None:  # type: ignore[no-untyped-def]
    structure = nine_modes()
    omega = 2 * np.pi * structure.frequency
    draws = [structure.noisy(0.01, seed) for seed in range(3)]
    ours, theirs = [], []
    times = [
        (
            cpu_time(lambda m=matrix: ours.append(own(omega, m).poles), 1),
            cpu_time(lambda m=matrix: theirs.append(peer_poles(structure.frequency, m)), 1),
        )
        for matrix in draws
    ]
    errors = [np.mean([relative_errors(poles) for poles in found], axis=0) for found in (ours, theirs)]
    worst = float(np.max(errors[0] / errors[1]))
    # The quickest draw of each: the first of the package loads it.
    mine, others = np.min(times, axis=0)
    ratio = mine / others
    record_property("modal_error_over_peer_worst_mode", round(worst, 3))
    record_property("modal_time_over_peer", round(ratio, 2))
    assert worst < 0.5
    assert ratio < 1.5
