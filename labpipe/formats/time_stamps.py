"""Times of day, with or without a date, as seconds."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import DataError

DAY = 86400.0
_STAMP = re.compile(
    r"""\s*"?(?:(?P<date>\d{1,4}[-./]\d{1,2}[-./]\d{1,4})[T ]\s*)?(?P<hour>\d{1,2}):(?P<minute>\d{2}):(?P<second>\d{2}(?:[.,]\d+)?)"""
    r"""\s*(?P<half>[AP]M)?\s*(?:Z|[+-]\d\d:?\d\d)?"?\s*""",
    re.IGNORECASE,
)


def is_stamp(field: str) -> bool:
    """True for 10:00:00.5, 2024-03-01 10:00:00,5, 3/1/2024 10:00:00 AM, 2024-03-01T10:00:00Z."""
    return _STAMP.fullmatch(field) is not None


class StampClock:
    """Seconds since the midnight before the first stamp. Days follow one another, so that no order of day and month is guessed."""

    def __init__(self, column: str) -> None:
        self._column = column
        self._date: str | None = None
        self._last = -np.inf
        self._midnight = 0.0

    def seconds(self, stamps: Iterable[str | None]) -> FloatArray:
        """The next stamps in seconds (n,) [s], NaN for a missing one; DataError for a date that is not the next day."""
        return np.array([self._second(stamp) for stamp in stamps], np.float64)

    def _second(self, stamp: str | None) -> float:
        match = _STAMP.fullmatch(stamp or "")
        if match is None:
            return float("nan")
        hour = int(match["hour"])
        if match["half"]:
            hour = hour % 12 + (12 if match["half"].upper() == "PM" else 0)
        second = hour * 3600 + int(match["minute"]) * 60 + float(match["second"].replace(",", "."))
        new_day = second < self._last - DAY / 2 if match["date"] is None else self._date not in (None, match["date"])
        if new_day:
            if second > self._last:
                raise DataError(
                    f"the column '{self._column}' leaves out time between {self._date} and {stamp}", hint="split the file there"
                )
            self._midnight += DAY
        self._date, self._last = match["date"], second
        return self._midnight + second
