"""One mutated input after the other, each judged: refused in one message, read as it was, or read as something else."""

from __future__ import annotations

import contextlib
import io
import random
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from labpipe.catalogue.index import INDEX
from labpipe.cli.main import run_command
from labpipe.cli.output import LONGEST, message_line, printable
from labpipe.errors import LabpipeError
from tests.fuzz.mutations import mutated_bytes, mutated_yaml
from tests.fuzz.seeds import READS

# The lines of a message, one for each fault of a YAML file; a file with more faults is summed up.
MOST_LINES = 3


@dataclass
class Tally:
    """How the trials of one kind of file ended; *faults*: what must not be, with the seed of the trial."""

    kind: str
    counts: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)

    def add(self, outcome: str, fault: str = "") -> None:
        self.counts[outcome] += 1
        if fault:
            self.faults.append(fault)


def trial_of_file(kind: str, folder: Path, scratch: Path, seed: int, tally: Tally, whole: object) -> None:
    """Read one mutated file of a kind."""
    content = (folder / kind).read_bytes()
    changed = mutated_bytes(content, random.Random(f"{kind} {seed}"))
    path = scratch / (kind if kind == INDEX else f"{seed % 7}-{kind}")
    path.write_bytes(changed)
    try:
        read = READS[kind](path)
    except LabpipeError as error:
        text = message_line(f"error: {error}")
        sound = len(text) <= LONGEST and printable(text) == text
        tally.add("refused", "" if sound else f"{kind} seed {seed}: message {text[:200]!r}")
    except Exception as error:
        tally.add("foreign", f"{kind} seed {seed}: {type(error).__name__}: {str(error)[:200]}")
    else:
        same = changed == content or read[0] == whole
        tally.add("as it was" if same else "with a finding" if read[1] else "other numbers")
    finally:
        path.unlink(missing_ok=True)


def trial_of_yaml(name: str, lab: Path, seed: int, tally: Tally) -> None:
    """Run a whole pipeline, one of whose YAML files is mutated, from the laboratory's folder."""
    path = lab / name
    text = path.read_text("utf-8")
    path.write_text(mutated_yaml(text, random.Random(f"{name} {seed}")), "utf-8")
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = run_command(["run", str(lab / "pipeline.yaml"), "-o", str(lab / "out"), "-q", "--set", "report.formats=[]"])
    except Exception as error:
        tally.add("foreign", f"{name} seed {seed}: {type(error).__name__}: {str(error)[:200]}")
    else:
        said = err.getvalue() + out.getvalue()
        long = max(map(len, said.splitlines()), default=0) > LONGEST + 20
        sound = not long and printable(said, "\n") == said and (code != 2 or said.startswith(("error", "warning")))
        tally.add("refused" if code == 2 else "run", "" if sound else f"{name} seed {seed}: said {said[:300]!r}")
    finally:
        path.write_text(text, "utf-8")
