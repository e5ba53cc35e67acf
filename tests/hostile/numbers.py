"""python -m tests.hostile.numbers [FILE ...] [--factors -1 0]: every number of shipped files, one at a time.

A pipeline, plan, rotor, balance, bearing or virtual rig, and each YAML file that it names, with one number
negative, zero, a thousand times or a millionth of it; of lines that differ in their numbers alone the first.
Recordings and rules stay. Prints what ends well with a negative number or zero, of which an engineer has to
say whether it can be, and what must not be: a traceback, a warning of numpy, too much time or memory; exit
code 1 if there is any of that.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import resource
import shutil
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from labpipe.cli.main import run_command
from tests.hostile.scenarios import ROOT

FACTORS = (-1.0, 0.0, 1e3, 1e-6)
SECONDS, MEMORY = 60, 4 << 30
# Neither within a name nor a unit, nor the first digits of a file's name.
_NUMBER = re.compile(
    r"(?<![\w.^])-?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?(?![\w.]*[\w/-]*\.(?:csv|parquet))(?![\w^])"
)
_NAMED = re.compile(r"[\w./-]+\.yaml")
COMMANDS = {
    "virtual": "simulate", "plan": "plan", "rotors": "rotor", "balance": "balance", "bearings": "bearing",
}  # fmt: skip


def arguments_of(path: Path) -> list[str]:
    """The command that reads a shipped file, and all that the file names."""
    words = (path.parent.name, path.name.partition("-")[0])
    command = next((COMMANDS[word] for word in words if word in COMMANDS), "run")
    more = {
        "run": ["-q", "-o", "out", "--set", "report.formats=[]"],
        "simulate": ["-q", "-o", "out"],
        "plan": ["-q", "-o", "out"],
        "bearing": ["-q"],
    }
    return [command, str(path), *more.get(command, [])]


def files_of(path: Path) -> list[Path]:
    """The file and every YAML file that it names."""
    files = [path]
    for file in files:
        named = ((file.parent / name).resolve() for name in _NAMED.findall(file.read_text("utf-8")))
        files += [one for one in named if one.is_file() and one not in files]
    return files


def changed_texts(text: str, factors: list[float]) -> Iterator[tuple[str, bool, str]]:
    """Where and what was changed, whether it is only another size, and the text with this change."""
    start, shapes = 0, set[str]()
    for number, line in enumerate(text.split("\nexpect:")[0].split("\naccept:")[0].splitlines(True), 1):
        shape = _NUMBER.sub("#", line)
        content = (
            ""
            if shape in shapes or line.startswith(("title:", "name:", "description:"))
            else line.partition("#")[0]
        )
        shapes.add(shape)
        for match in _NUMBER.finditer(content):
            begin, after = start + match.start(), text[start + match.end() :]
            whole = float(match[0])
            for value in dict.fromkeys(whole * factor for factor in factors if whole * factor != whole):
                written = f"{value:.6g}" if abs(value) < 1e-3 else f"{value:.12g}"
                shown = f"{line[: match.start()]}<{written}>{line[match.end() :]}".strip()
                yield f"{number}: {shown}", value * whole > 0, text[:begin] + written + after
        start += len(line)


def end_of(arguments: list[str], folder: Path) -> tuple[str, str]:
    """How a command ends in a process of its own, and what it says."""
    said = folder / "said.txt"
    process = os.fork()
    if not process:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        code = 3
        with said.open("w") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
            try:
                code = run_command(arguments)
            except BaseException:
                traceback.print_exc()
        os._exit(code)
    status = os.waitpid(process, 0)[1]
    text = said.read_text("utf-8")
    shutil.rmtree(folder / "out", ignore_errors=True)
    if os.WIFSIGNALED(status):
        return "FAULT: too long", text
    code = os.WEXITSTATUS(status)
    return (
        f"FAULT: {code}" if code == 3 else "FAULT: warning" if "RuntimeWarning" in text else f"{code}",
        text,
    )


def main() -> int:
    """The ends of all changes."""
    parser = argparse.ArgumentParser(description=__doc__)
    shipped = sorted(ROOT.glob("pipelines/*.yaml"))
    parser.add_argument("files", nargs="*", type=lambda name: Path(name).resolve(), default=shipped)
    parser.add_argument("--factors", nargs="*", type=float, default=FACTORS)
    arguments = parser.parse_args()
    ends, seen = Counter[str](), set[Path]()
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        folder = Path(name).resolve()
        for part in ("pipelines", "configs"):
            shutil.copytree(ROOT / part, folder / part)
        (folder / "sample_data").symlink_to(ROOT / "sample_data")
        for path in (folder / file.relative_to(ROOT) for file in arguments.files):
            # As it is, in this process: what it needs is imported once.
            with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
                code = run_command(arguments_of(path))
            assert code in (0, 1), (path, code)
            shutil.rmtree("out", ignore_errors=True)
            for file in (one for one in files_of(path) if one not in seen):
                seen.add(file)
                whole = file.read_text("utf-8")
                for place, sized, text in changed_texts(whole, arguments.factors):
                    file.write_text(text, "utf-8")
                    end, said = end_of(arguments_of(path), folder)
                    ends[end] += 1
                    if end.startswith("FAULT") or not (sized or end == "2"):
                        last = said.strip().splitlines()[-1:] if end != "0" else []
                        print(f"{end:<3} {file.relative_to(folder)}:{place}", *last, flush=True)
                file.write_text(whole, "utf-8")
    print(", ".join(f"{end}: {count}" for end, count in sorted(ends.items())))
    return int(any(end.startswith("FAULT") for end in ends))


if __name__ == "__main__":
    sys.exit(main())
