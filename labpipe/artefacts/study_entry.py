"""A study as it stands in identification.json."""

from __future__ import annotations

import math
from typing import Any

from labpipe.records.study import StudiedParameter, Study, StudyCase, StudyThreshold

# Not-a-number has no place in JSON: a study of nothing but failures has null errors.
_NUMBERS = ("mean_error", "median_error", "error_variance")


def read_study(entry: dict[str, Any]) -> Study:
    """The study of its entry."""
    return Study(
        rig=entry["rig"],
        seed=entry["seed"],
        limits=tuple(entry["limits"]),
        share=entry["share"],
        cases=tuple(_case(case) for case in entry["cases"]),
        thresholds=tuple(StudyThreshold(**threshold) for threshold in entry["thresholds"]),
        printed=tuple((name, tuple(values)) for name, values in entry["printed"]),
    )


def _case(entry: dict[str, Any]) -> StudyCase:
    numbers = {name: math.nan if entry[name] is None else entry[name] for name in _NUMBERS}
    parameters = tuple(StudiedParameter(**parameter) for parameter in entry["parameters"])
    return StudyCase(**{**entry, **numbers, "success": tuple(entry["success"]), "parameters": parameters})
