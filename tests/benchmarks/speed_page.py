"""Writes docs/pages/speed.md: what labpipe costs beside the least that the same work could cost, measured on
this machine.

python -m tests.benchmarks.speed_page [--rows N] [--repeats N]

Raw files of a gigabyte are made one after the other in the folder for temporary files (TMPDIR), which needs 3
GB.

Ratios of CPU times, the least of repetitions in turns, so that they hold on other machines about as well. To
be run on a machine that does nothing else, with OMP_NUM_THREADS=1: threads of BLAS that wait for work take
time of the processor as well. OPENBLAS_CORETYPE and OPENBLAS_L2_SIZE must not be set.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy import fft

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.ports import Layout, find_layout
from labpipe.spectra.random import parts_of_spectra
from labpipe.spectra.settings import FrfSettings
from labpipe.spectra.welch import WelchAverage
from labpipe.spectra.windows import window_values
from tests.benchmarks.raw_files import KINDS, ROOT, TABLE, least_costs, row_of, rows_of
from tests.benchmarks.test_identify_ratios import chain, cpu_time
from tests.benchmarks.test_spectral_ratios import ratios

PAGE = ROOT / "docs/pages/speed.md"
RATE = 1024.0
# Samples of a block, responses, forces, samples of the record.
RECORDS = (
    (1024, 2, 2, 860_000),
    (5120, 2, 2, 860_000),
    (25_000, 2, 2, 1_200_000),
    (100_000, 2, 2, 1_200_000),
    (25_000, 8, 2, 1_200_000),
    (25_000, 16, 3, 1_200_000),
)
# Size of the larger raw files [MB].
LARGE = 1000.0
# Degrees of freedom, lines.
CHAINS = ((3, 1000), (4, 1000), (6, 1000), (3, 10_000), (3, 100_000))
FIVE = "import numpy, scipy.optimize, pandas, pyarrow.parquet, matplotlib.figure"
HEAD = """# What it costs

Made by `python -m tests.benchmarks.speed_page`, not by hand: CPU times as ratios to the least that the same work could cost on the
same machine in the same run, BLAS with one thread. Smaller benchmarks with limits run in CI (`tests/benchmarks`); these figures do not.

"""


def frf_rows() -> Iterator[str]:
    """One row per block length and number of channels: cross-spectra, FRF with covariance and coherence, and
    all that is checked, over scipy's bare real FFTs.
    """
    for block, n_output, n_input, n_sample in RECORDS:
        samples = np.random.default_rng(1).normal(size=(n_sample, n_output + n_input))
        columns = np.ascontiguousarray(samples.T)
        forces = tuple(Channel(f"f{n}", "force", "input", f"d{n}", 0.0) for n in range(n_input))
        responses = tuple(Channel(f"y{n}", "displacement", "output", f"d{n}", 0.0) for n in range(n_output))
        recording, settings = (
            Recording((*forces, *responses), samples, RATE, "run"),
            FrfSettings("random", block=block / RATE),
        )

        def bare(columns: np.ndarray = columns, block: int = block) -> None:
            for start in range(0, columns.shape[1] - block + 1, block // 2):
                fft.rfft(columns[:, start : start + block], axis=1)

        layout = find_layout([recording])

        def averaged(
            recording: Recording = recording,
            settings: FrfSettings = settings,
            layout: Layout = layout,
            block: int = block,
        ) -> None:
            average = WelchAverage(window_values("hann", block), block // 2, recording.samples.shape[1])
            average.add(recording.samples)
            parts_of_spectra([average.spectra(RATE)], settings, layout)

        def checked(recording: Recording = recording, settings: FrfSettings = settings) -> None:
            measure([recording], settings)

        def plain(samples: np.ndarray = samples, block: int = block) -> None:
            cross_products(samples, block)

        cells = [f"{value:.2f}" for value in ratios(bare, plain, averaged, checked, repeats=15)]
        row = f"| {n_output} x {n_input} | {block} | {n_sample} | {1e3 * cpu_time(bare, 7):.0f} ms"
        yield f"{row} | {' | '.join(cells)} |"


def cross_products(samples: np.ndarray, block: int) -> np.ndarray:
    """Sums of X_a X_b* of all channels (n_line, n_channel, n_channel) in plain numpy: each
    segment times the window, its FFT, and one product of matrices for every line and thirty segments.
    """
    n_channel, step = samples.shape[1], block // 2
    taper = np.repeat(window_values("hann", block), n_channel).reshape(block, n_channel)
    sums = np.zeros((block // 2, n_channel, n_channel), np.complex128)
    starts = range(0, samples.shape[0] - block + 1, step)
    amplitude = np.empty((min(30, len(starts)), block // 2, n_channel), np.complex128)
    for first in range(0, len(starts), amplitude.shape[0]):
        some = starts[first : first + amplitude.shape[0]]
        for place, start in zip(amplitude, some, strict=False):
            place[...] = fft.rfft(samples[start : start + block] * taper, axis=0)[1:]
        for line in range(0, block // 2, 64):
            left = amplitude[: len(some), line : line + 64]
            sums[line : line + 64] += left.transpose(1, 2, 0) @ left.conj().swapaxes(0, 1)
    return sums


def likelihood_rows() -> Iterator[str]:
    """One row per number of dofs and lines: maximum likelihood of all stiffness and damping coefficients
    under given masses.
    """
    first = 0.0
    for n_dof, n_line in CHAINS:
        response = chain(n_dof, n_line)
        settings = FitSettings("mdof", symmetric=False, estimator="ml", mass=tuple(1.0 + np.arange(n_dof)))
        spent = cpu_time(
            lambda response=response, settings=settings: identify(response, settings),
            1 if n_line > 10_000 else 2,
        )
        first = first or spent
        shared = chain(n_dof, n_line, is_shared=True)
        beside = cpu_time(
            lambda shared=shared, settings=settings: identify(shared, settings), 1 if n_line > 10_000 else 2
        )
        yield (
            f"| {n_dof} | {n_line} | {2 * n_dof**2} | {spent:.2f} s | {spent / first:.1f} | "
            f"{beside / spent:.1f} |"
        )


def command_rows() -> Iterator[str]:
    """Start-up, help, a first and a repeated run of the pedestal, and a wear test, over what Python itself or
    the libraries take.
    """
    labpipe = [sys.executable, "-m", "labpipe"]
    with tempfile.TemporaryDirectory() as name:
        cold = (
            "from labpipe.cli.main import run_command; import tempfile; "
            f"run_command({_run('pedestal', 'tempfile.mkdtemp()')})"
        )
        wear = cold.replace("pedestal", "wear-1")
        warm = [*labpipe, "run", "pipelines/pedestal.yaml", "-o", f"{name}/out", "-q"]
        least_costs(ROOT, [warm], 1)
        python = [sys.executable, "-c"]
        bare = [[*python, f"import {name}"] for name in ("sys", "click")]
        commands = [*bare, [*python, FIVE], [*labpipe, "--help"], [*python, cold], warm]
        empty, click, libraries, helped, first, again = least_costs(ROOT, commands, 5)
        (worn,) = least_costs(ROOT, [[sys.executable, "-c", wear]], 2)
    yield (
        f"| `labpipe --help` | {helped.cpu:.3f} s | {helped.cpu / empty.cpu:.1f} times an empty Python; "
        f"importing click alone {click.cpu / empty.cpu:.1f} times |"
    )
    five = "times importing numpy, scipy, pandas, pyarrow and matplotlib"
    yield (
        f"| `labpipe run` of the pedestal, nothing there yet | {first.cpu:.2f} s | "
        f"{first.cpu / libraries.cpu:.2f} {five} |"
    )
    yield f"| the same again, nothing changed | {again.cpu:.2f} s | {again.cpu / libraries.cpu:.2f} {five} |"
    yield f"| `labpipe run` of wear-1 | {worn.cpu:.1f} s | |"


def _run(pipeline: str, folder: str) -> str:
    return f"['run', 'pipelines/{pipeline}.yaml', '-o', {folder}, '-q']"


def file_rows(n_row: int, repeats: int) -> Iterator[str]:
    """One row per kind of raw file."""
    for kind in KINDS:
        yield row_of(kind, n_row, 25_600, repeats)
    for kind in KINDS:
        yield row_of(kind, rows_of(kind, LARGE), 25_600, repeats)


def page(n_row: int, repeats: int) -> str:
    """The whole page."""
    parts = [
        HEAD,
        f"Python {platform.python_version()}, numpy {np.__version__}, {platform.machine()}.\n",
        "\n## FRF of records in memory\n\nOver `scipy.fft.rfft` of every block of every channel and nothing "
        "else: first the cross-products of all channels in plain numpy (window, FFT, a product of matrices "
        "per line); then H1 with covariance (in its two factors: it is "
        "made whole when it is first read), ordinary, multiple and partial coherence; then `measure`, which "
        "also checks the record and looks for a loop, drift and aliasing. Blocks of more than 120,000 samples, "
        "of five channels or more together, use two threads where there are two processors: by the clock an "
        "FRF takes about two thirds of these times.\n",
        "| responses x forces | block | samples | bare FFTs | numpy / bare | FRF / bare | measure / bare "
        "|\n|---|---|---|---|---|---|---|",
        *frf_rows(),
        f"\n## A raw file to its FRF by the command\n\nTwo forces, two responses, {n_row} rows, then files "
        f"of {LARGE:g} MB; beside it bare reading and bare FFTs, piece by piece or at once, whichever is "
        "faster. The import of the libraries is subtracted on both sides.\n",
        TABLE,
        *file_rows(n_row, repeats),
        "\n## Maximum likelihood over many dofs and lines\n\nAll stiffness and damping coefficients of "
        "masses in a chain, with the test of "
        "the given masses; last, FRFs that share noise as those of H1 do, over independent ones.\n",
        "| dofs | lines | parameters | CPU | over the first | shared noise |\n|---|---|---|---|---|---|",
        *likelihood_rows(),
        "\n## Commands\n\n| command | CPU | |\n|---|---|---|",
        *command_rows(),
    ]
    return "\n".join(parts).replace(HEAD + "\n", HEAD) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=int, default=4_000_000, help="of the smaller raw files")
    parser.add_argument("--repeats", type=int, default=2, help="of the commands on raw files")
    if os.environ.get("OMP_NUM_THREADS") != "1":
        parser.error("set OMP_NUM_THREADS=1")
    # An editable installation makes an empty Python slower, and every ratio to it smaller.
    if any("editable" in name for name in sys.modules):
        parser.error("install labpipe with its tests, not as an editable package")
    options = parser.parse_args()
    PAGE.write_text(page(options.rows, options.repeats), encoding="utf-8")
    print(f"written: {PAGE.relative_to(Path.cwd()) if PAGE.is_relative_to(Path.cwd()) else PAGE}")


if __name__ == "__main__":
    main()
