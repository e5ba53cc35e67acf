"""A text table whose fields any number of blanks keeps apart, as a stream with one blank between two fields."""

from __future__ import annotations

import io
from itertools import islice
from typing import BinaryIO

LINES = 1 << 14


class SqueezedBlanks(io.RawIOBase):
    """UTF-8 bytes of *stream* (text in *encoding*), line by line without blanks at the ends and with one between fields."""

    def __init__(self, stream: BinaryIO, encoding: str) -> None:
        # Line feeds only end a line, as for whoever counts the lines of the header.
        self._lines = io.TextIOWrapper(stream, encoding=encoding, errors="replace", newline="\n")
        self._rest = b""

    def readable(self) -> bool:
        """Always."""
        return True

    def read(self, size: int = -1) -> bytes:
        """At most *size* bytes; none at the end."""
        while size < 0 or len(self._rest) < size:
            lines = list(islice(self._lines, LINES))
            if not lines:
                break
            self._rest += "".join(" ".join(line.split()) + "\n" for line in lines).encode()
        wanted = self._rest if size < 0 else self._rest[:size]
        self._rest = self._rest[len(wanted) :]
        return wanted

    def close(self) -> None:
        """Close the file, too."""
        self._lines.close()
        super().close()
