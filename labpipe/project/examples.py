"""The shipped examples: for every rig its recordings, what describes it, and the pipelines that use it."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import ConfigError
from labpipe.registry import nearest

_SAMPLE = re.compile(r"\.\./sample_data/([\w.-]+)/")
_VIRTUAL = re.compile(r"\.\./configs/([\w.-]+)\.yaml")


def shipped() -> Path:
    """Where pipelines, configs and sample data are: in the checkout, or beside the installed package.

    ConfigError when nowhere.
    """
    for root in (Path(__file__).parents[2], Path(sys.prefix) / "share/labpipe"):
        if (root / "pipelines").is_dir() and (root / "sample_data").is_dir():
            return root
    raise ConfigError(
        "the examples are not installed",
        hint="they come with the repository: pipelines, configs and sample_data",
    )


def examples() -> dict[str, list[Path]]:
    """The pipelines of every rig by the rig's name: that of its recordings, or of what describes it where it
    has none.
    """
    by_rig: dict[str, list[Path]] = {}
    for path in sorted((shipped() / "pipelines").glob("*.yaml")):
        by_rig.setdefault(_rig_of(path), []).append(path)
    return dict(sorted(by_rig.items()))


def _rig_of(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    sample = _SAMPLE.search(text)
    if sample is not None:
        return sample[1]
    described = _VIRTUAL.search(text)
    return described[1] if described is not None else path.stem


def copy_example(name: str, output: OutputFolder) -> list[str]:
    """Copy an example's pipelines with all they name, in the folders that they are in; the names of the
    pipelines.

    ConfigError when there is none of that name.
    """
    pipelines = examples()
    if name not in pipelines:
        raise ConfigError(f"no example '{name}'", hint=nearest(name, pipelines))
    root = shipped()
    files = [*pipelines[name], *(path for path in (root / "configs").rglob("*") if path.is_file())]
    samples = {
        sample
        for pipeline in pipelines[name]
        for sample in _SAMPLE.findall(pipeline.read_text(encoding="utf-8"))
    }
    for sample in sorted(samples):
        files.extend(path for path in (root / "sample_data" / sample).rglob("*") if path.is_file())
    for path in files:
        output.write_path(path.relative_to(root).as_posix()).write_bytes(path.read_bytes())
    return [pipeline.name for pipeline in pipelines[name]]
