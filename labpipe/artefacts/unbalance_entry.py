"""A response to unbalance as it stands in identification.json."""

from __future__ import annotations

from typing import Any

from labpipe.records.unbalance import UnbalanceCase, UnbalanceRuns


def read_unbalance(entry: dict[str, Any]) -> UnbalanceRuns:
    """The response of its entry."""
    return UnbalanceRuns(**{**entry, "speed": tuple(entry["speed"]), "cases": tuple(_case(case) for case in entry["cases"])})


def _case(entry: dict[str, Any]) -> UnbalanceCase:
    return UnbalanceCase(**{**entry, "forward": tuple(entry["forward"]), "backward": tuple(entry["backward"])})
