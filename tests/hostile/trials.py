"""One mutated input after the other, each judged: refused in one message, read as it was, or read as
something else.
"""

from __future__ import annotations

import contextlib
import io
import random
import re
import shutil
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from labpipe.artefacts.writing import STAGING
from labpipe.cli.main import run_command
from labpipe.cli.output import KEPT, LONGEST, message_line, printable
from labpipe.cli.run import LOCK
from labpipe.errors import LabpipeError
from labpipe.project.catalogue import INDEX
from tests.hostile.mutations import mutated_amounts, mutated_bytes, mutated_yaml
from tests.hostile.scenarios import SCENARIOS, write_scenario
from tests.hostile.seeds import READS

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
    out = io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
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
    if printed := out.getvalue():
        tally.faults.append(f"{kind} seed {seed}: a reader prints {printed[:200]!r}")


def trial_of_yaml(name: str, folder: Path, seed: int, tally: Tally) -> None:
    """Give the command of a scenario in its *folder*, one of whose files is mutated."""
    scenario = SCENARIOS[name]
    path = folder / scenario.mutated
    text, rng = scenario.files[scenario.mutated], random.Random(f"{name} {seed}")
    if path.suffix != ".yaml":
        path.write_bytes(mutated_bytes(text.encode(), rng))
    else:
        path.write_text(
            (mutated_amounts if scenario.amounts and seed % 2 else mutated_yaml)(text, rng), "utf-8"
        )
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = run_command(list(scenario.command))
    except Exception as error:
        tally.add("foreign", f"{name} seed {seed}: {type(error).__name__}: {str(error)[:200]}")
    else:
        fault = _said_amiss(code, err.getvalue()) or _said_amiss(0, out.getvalue()) or _left_behind(folder)
        tally.add("refused" if code == 2 else "run", f"{name} seed {seed}: {fault}" if fault else "")
    finally:
        path.write_text(text, "utf-8")
        if scenario.moves:
            shutil.rmtree(folder / "out", ignore_errors=True)
            write_scenario(name, folder)


def _said_amiss(code: int, said: str) -> str:
    """What must not be about what a command said on standard error; empty where it is as it should be."""
    if printable(said, KEPT) != said:
        return f"control characters: {said[:300]!r}"
    if longest := [line for line in said.splitlines() if len(line) > LONGEST]:
        return f"{len(longest[0])} characters: {longest[0][:300]!r}"
    # A message begins with what it is; every fault of a file is a message.
    messages = re.split(r"^(?=error|warning)", said, flags=re.MULTILINE)
    if lengthy := [message for message in messages if len(message.splitlines()) > MOST_LINES]:
        return f"a message of {len(lengthy[0].splitlines())} lines: {lengthy[0][:300]!r}"
    if code not in (0, 1, 2) or (code == 2 and "error: " not in said):
        return f"exit code {code}: {said[:300]!r}"
    return ""


def _left_behind(folder: Path) -> str:
    # The file of a watch's lock stays; the lock itself goes with the process.
    left = [
        path.name
        for home in (folder, folder / "out")
        for path in home.glob(f"{STAGING}*")
        if path.name != LOCK
    ]
    return f"left behind: {', '.join(left)}" if left else ""
