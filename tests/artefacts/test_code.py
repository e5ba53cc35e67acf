"""The digest of the code behind a result: plug-ins are part of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import NamedTuple

import pytest

from labpipe.artefacts import header as code


class Package(NamedTuple):
    name: str
    version: str


def test_another_version_of_a_plug_in_is_another_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its entry points are the same; what stands behind them is not."""
    digests = []
    for version in ("1.0", "1.0", "1.1"):
        entry = SimpleNamespace(value="plug.models:beam", dist=Package("plug", version))
        entries = SimpleNamespace(
            groups={"labpipe.model", "other"},
            select=lambda group, entry=entry: [entry] if group[0] == "l" else [],
        )
        monkeypatch.setattr(code, "entry_points", lambda entries=entries: entries)
        digests.append(code.code_digest.__wrapped__())
    assert digests[0] == digests[1] != digests[2]
