"""``fits/TEST.json``: the fits of one test among many, so that an interrupted run can be resumed."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from labpipe import __version__
from labpipe.artefacts.code import code_digest
from labpipe.artefacts.digest import AGAIN, DamagedError
from labpipe.artefacts.fit_entry import fit_entry, read_fit
from labpipe.artefacts.header import SourceRef
from labpipe.artefacts.json_file import DIGEST, read_digested, write_digested
from labpipe.artefacts.typed_json import RECORD_FAULTS, entry_of
from labpipe.errors import cut
from labpipe.identify.settings import FitSettings
from labpipe.records.identification import Fit

SCHEMA = "labpipe/fits/1"
FOLDER = "fits"


def _work(settings: Sequence[FitSettings], responses: Sequence[SourceRef]) -> dict[str, Any]:
    """What the fits depend on: equal work gives equal fits."""
    entry = {
        "schema": SCHEMA,
        "labpipe": __version__,
        "code": code_digest(),
        "settings": [entry_of(fit) for fit in settings],
        "responses": [dataclasses.asdict(response) for response in responses],
    }
    return json.loads(json.dumps(entry))


def write_fits(path: Path, fits: Sequence[Fit], settings: Sequence[FitSettings], responses: Sequence[SourceRef]) -> None:
    """Write the fits with the settings and the checksums of the responses they were made from."""
    write_digested(path, {**_work(settings, responses), "fits": [fit_entry(fit) for fit in fits]})


def has_fresh_fits(path: Path, settings: Sequence[FitSettings], responses: Sequence[SourceRef]) -> bool:
    """True if the file contains the fits of these settings and responses by this version; DamagedError for a file that it did not write."""
    if not path.exists():
        return False
    entries = read_digested(path, "file of fits")
    work = _work(settings, responses)
    if {key: entries.get(key) for key in work} != work:
        return False
    if DIGEST not in entries:
        raise DamagedError("carries no digest", where=str(path))
    return True


def read_fits(path: Path) -> list[Fit]:
    """The fits of a file that `write_fits` wrote; DamagedError for another one."""
    return fits_with_digest(path)[0]


def fits_with_digest(path: Path) -> tuple[list[Fit], str]:
    """The fits of a file that `write_fits` wrote, and its digest; DamagedError for another one."""
    try:
        entries = read_digested(path, "file of fits")
        return [read_fit(entry) for entry in entries["fits"]], str(entries.get(DIGEST, ""))
    except RECORD_FAULTS as error:
        raise DamagedError(f"is not readable as fits ({cut(str(error))})", where=str(path), hint=AGAIN) from None
