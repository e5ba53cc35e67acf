"""plan: a plan file -> the plan of its kind, and the files that carry it out and evaluate it."""

from __future__ import annotations

from labpipe.artefacts.writing import OutputFolder
from labpipe.config.plan import PlanFile
from labpipe.errors import ConfigError, LabpipeError


def plan_files(file: PlanFile, output: OutputFolder) -> tuple[list[str], list[str]]:
    """Plan and write; sentences on the plan, and the files' names. LabpipeError names the plan file."""
    try:
        sentences, names = file.kind.load("files")(file, output)
    except LabpipeError as error:
        field = f"plan.{error.field}: " if isinstance(error, ConfigError) and error.field else ""
        error.what = f"{field}{error.what}" if not error.where else error.what
        error.where = error.where or str(file.path)
        raise
    return list(sentences), list(names)
