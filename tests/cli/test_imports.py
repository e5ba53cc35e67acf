"""What a command does not need it does not import: libraries take longer to load than most commands take to
work.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Set
from pathlib import Path

import pyarrow
import pytest

ROOT = Path(__file__).parent.parent.parent
# Loading these takes .2 to .5 s of CPU each.
HEAVY = {"pandas", "scipy", "matplotlib", "h5py", "nptdms"}


# These three of scipy take longer than all the rest of a run of one test.
SLOW = {"scipy.stats", "scipy.signal", "scipy.interpolate"}
# What only a dataset's readers and a cluster need: a tenth of a run that finds nothing to do.
OF_MANY = {"pyarrow.compute", "asyncio"}
LAZY = pytest.mark.skipif(
    int(pyarrow.__version__.split(".")[0]) < 26, reason="pyarrow before 26 imports pandas for any array"
)


def imported(*arguments: object, of: Set[str] = HEAVY | SLOW) -> set[str]:
    """The libraries *of* these that a command has loaded when it ends."""
    script = (
        "import sys; from labpipe.cli.main import run_command; run_command(sys.argv[1:]); "
        "print('|'.join(sys.modules))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        timeout=120,
    )
    return of & set(ended.stdout.splitlines()[-1].split("|"))


@LAZY
def test_a_run_that_changes_nothing_loads_nothing_that_measures_fits_or_draws(tmp_path: Path) -> None:
    run = ("run", "pipelines/pedestal.yaml", "-o", tmp_path / "out")
    assert imported(*run) == {"scipy"}
    # Charts are drawn without matplotlib.
    assert 'type="application/json"' in (tmp_path / "out/report.html").read_text("utf-8")
    assert imported(*run, of=HEAVY | SLOW | OF_MANY) == set()


@LAZY
def test_the_stages_load_what_a_run_loads(tmp_path: Path) -> None:
    """Tables and MATLAB files are another command's: they took half of the time of every stage."""
    output = ("-o", tmp_path / "out")
    assert imported("frf", "-c", "pipelines/pedestal.yaml", *output) == {"scipy"}
    assert imported("identify", "-c", "pipelines/pedestal.yaml", *output) == {"scipy"}
    assert imported("report", tmp_path / "out", "-o", tmp_path / "report.html") <= {"scipy"}


def test_what_measures_loads_no_search_before_one_is_needed() -> None:
    """scipy.optimize takes a tenth of a second of CPU to load."""
    script = "import sys; import labpipe.spectra.measurement; sys.exit('scipy.optimize' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False, cwd=ROOT).returncode == 0


def test_help_loads_nothing_that_takes_long() -> None:
    """The metadata of installed packages take longer than all else beside click."""
    slow = {"importlib.metadata", "labpipe.quantities"}
    assert imported("--help", of=HEAVY | SLOW | slow) == set()


@pytest.mark.long
def test_a_run_loads_no_method_that_its_pipeline_does_not_name(tmp_path: Path) -> None:
    """A fit of a single mass is the core's own work; a ring-down is that of one method."""
    script = (
        "import sys; from labpipe.cli.main import run_command; run_command(sys.argv[1:]); "
        "print('|'.join(sys.modules))"
    )

    def methods(name: str) -> set[str]:
        command = [sys.executable, "-c", script, "run", f"pipelines/{name}.yaml", "-o", str(tmp_path / name)]
        ended = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT, timeout=120)
        loaded = ended.stdout.splitlines()[-1].split("|")
        return {name.split(".")[2] for name in loaded if name.startswith("labpipe.methods.")}

    assert methods("pedestal") == set()
    assert methods("ring-down") == {"ring_down"}
