"""What the settings of a certificate refuse."""

from __future__ import annotations

from typing import Any

import pytest

from labpipe.errors import ConfigError
from labpipe.methods.magnetic_bearing.limits import LoopCertificateSettings


@pytest.mark.parametrize(
    "entries",
    [
        {},
        {"before": ("a",), "after": ("b",)},
        {"before": ("a", "b"), "after": ("c", "d")},
        {"after": ("b",)},
        {"confidence": 0.51},
        {"rate": 1.0},
    ],
)
def test_points_one_per_loop_and_limits_that_can_be_kept(entries: dict[str, Any]) -> None:
    assert LoopCertificateSettings(**entries).least_decrement == 0.1


@pytest.mark.parametrize(
    ("entries", "field"),
    [
        ({"before": ("a", "b"), "after": ("c",)}, "before"),
        ({"before": ("a",)}, "before"),
        ({"after": ("a",), "displacement": "a"}, ""),
        ({"confidence": 0.5}, "confidence"),
        ({"confidence": 1.0}, "confidence"),
        ({"log_decrement": 0.0}, "log_decrement"),
        ({"rate": 0.0}, "rate"),
        ({"filtered": True}, "filtered"),
    ],
)
def test_what_is_refused_names_its_entry(entries: dict[str, Any], field: str) -> None:
    with pytest.raises(ConfigError) as caught:
        LoopCertificateSettings(**entries)
    assert caught.value.field == field
