"""The Dockerfile, read: what can be said of it without building.

It must agree with the project's metadata, the README and the checkout.
"""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
TEXT = (ROOT / "Dockerfile").read_text(encoding="utf-8")
Instruction = tuple[str, str]


def instructions() -> list[Instruction]:
    """Instruction and the rest of its line; comments left out, continued lines joined."""
    text = re.sub(r"^#.*\n", "", TEXT, flags=re.MULTILINE).replace("\\\n", " ")
    return [(line.split(None, 1)[0], line.split(None, 1)[1]) for line in text.splitlines() if line.strip()]


def stages() -> list[list[Instruction]]:
    found: list[list[Instruction]] = []
    for name, rest in instructions():
        if name == "FROM":
            found.append([])
        found[-1].append((name, rest))
    return found


def of(stage: list[Instruction], name: str) -> list[str]:
    return [rest for instruction, rest in stage if instruction == name]


def copied(stage: list[Instruction]) -> list[str]:
    """What is copied from the checkout."""
    return [
        source for rest in of(stage, "COPY") if not rest.startswith("--from") for source in rest.split()[:-1]
    ]


BUILD, FINAL = stages()


def test_every_instruction_is_one() -> None:
    known = {"FROM", "COPY", "RUN", "ENV", "USER", "WORKDIR", "VOLUME", "ENTRYPOINT", "CMD"}
    assert {name for name, _ in instructions()} <= known


def test_the_base_has_a_python_that_labpipe_supports() -> None:
    """Both stages the same one, since the environment is copied from one to the other.

    A public image by its plain name.
    """
    images = {rest.split()[0] for stage in (BUILD, FINAL) for rest in of(stage, "FROM")}
    (image,) = images
    match = re.fullmatch(r"python:(\d+)\.(\d+)-slim", image)
    assert match is not None
    least = re.fullmatch(r">=(\d+)\.(\d+)", PROJECT["project"]["requires-python"])
    assert least is not None
    version = int(match[1]), int(match[2])
    assert version >= (int(least[1]), int(least[2]))
    assert f"Programming Language :: Python :: {version[0]}.{version[1]}" in PROJECT["project"]["classifiers"]
    assert "://" not in TEXT


@pytest.mark.parametrize("source", sorted({*copied(BUILD), *copied(FINAL)}))
def test_what_is_copied_is_there_and_reaches_the_builder(source: str) -> None:
    assert (ROOT / source).exists()
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert "*" in ignored and f"!{source}" in ignored and ignored.index("*") < ignored.index(f"!{source}")


def test_what_the_builder_gets_is_copied() -> None:
    kept = {
        line[1:]
        for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
        if line.startswith("!")
    }
    assert kept == set(copied(BUILD))


def test_the_build_has_all_that_the_package_is_made_of() -> None:
    setuptools = PROJECT["tool"]["setuptools"]
    needed = {pattern.split("/")[0] for patterns in setuptools["data-files"].values() for pattern in patterns}
    assert needed | {"pyproject.toml", "labpipe", PROJECT["project"]["readme"]} == set(copied(BUILD))


def test_the_container_is_the_command_and_its_job_is_the_readme_s() -> None:
    (entry,), (job,) = of(FINAL, "ENTRYPOINT"), of(FINAL, "CMD")
    assert json.loads(entry) == list(PROJECT["project"]["scripts"])
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (main,) = re.findall(r"\.venv/bin/(labpipe run .*)$", readme, re.MULTILINE)
    assert [*json.loads(entry), *json.loads(job)] == shlex.split(main)


def test_the_job_finds_its_files_and_leaves_its_report_in_the_mounted_folder() -> None:
    (home,), (mounted,) = of(FINAL, "WORKDIR"), of(FINAL, "VOLUME")
    job = json.loads(of(FINAL, "CMD")[0])
    for source in ("pipelines", "configs", "sample_data"):
        assert f"{source} {home}/{source}" in of(FINAL, "COPY")
    assert job[1].startswith("pipelines/")
    assert f"{home}/{job[job.index('-o') + 1]}".startswith(f"{mounted}/")
    # The commands in its head mount that folder.
    assert f':{mounted}" labpipe\n' in TEXT


def test_nobody_is_root() -> None:
    names = [name for name, _ in FINAL]
    (user,) = of(FINAL, "USER")
    assert user not in ("root", "0") and re.search(rf"useradd .*\b{user}\b", of(FINAL, "RUN")[0])
    assert names.index("USER") < names.index("ENTRYPOINT")


def test_the_command_of_the_environment_is_on_the_path() -> None:
    (place,) = [rest.split()[1:] for rest in of(FINAL, "COPY") if rest.startswith("--from=build")]
    assert place[0] == place[1], "an environment knows its own path"
    assert any(f'PATH="{place[0]}/bin:$PATH"' in rest for rest in of(FINAL, "ENV"))
    assert f"python -m venv {place[0]} " in of(BUILD, "RUN")[0]
