"""From which motion of the shaft on a floating-bearing fit says that it moves."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from labpipe.methods.floating_bearing import findings
from labpipe.methods.floating_bearing.findings import motion_findings


@pytest.mark.parametrize(
    ("moved", "accelerated", "level"),
    [
        (None, False, None),
        # Two and nine tenths of a standard error are noise, one and nine tenths per mille of the motion are
        # too little to matter.
        ((0.1, 2.9), False, None),
        ((0.0019, 100.0), False, None),
        ((0.0021, 3.1), False, "warning"),
        ((0.0021, 3.1), True, "note"),
    ],
)
def test_motion_beyond_three_standard_errors_is_said(
    monkeypatch: pytest.MonkeyPatch, moved: tuple[float, float] | None, accelerated: bool, level: str | None
) -> None:
    monkeypatch.setattr(findings, "shaft_motion", lambda _: moved)
    monkeypatch.setattr(findings, "effective_forces", lambda _: False)
    found = motion_findings(cast("Any", None), cast("Any", SimpleNamespace(accelerated=accelerated)))
    assert [finding.level for finding in found] == ([level] if level else [])
    assert not found or found[0].code == "shaft-moves"
