"""The digest of an artefact's own content: what was changed after labpipe wrote it, or damaged on its way, is
noticed when it is read.

JSON: SHA-256 of the file without the line of its digest, so ``grep -v '^"digest"' FILE | sha256sum`` gives
the same number. Parquet: SHA-256 of the file with zeros in the place of the digest, which stands among the
metadata in its foot. Bytes and not numbers are digested: that costs one pass over the file, and a damaged
file is refused before its pages are decoded.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from labpipe.errors import DataError

DIGEST_KEY = b"labpipe.digest"
# Of the length of a digest: written first, replaced when the rest of the file is there.
BLANK = b"0" * 64
# Bytes digested at once: they stay in the cache.
CHUNK = 1 << 18
# A Parquet file ends with the length of its foot and a mark.
_FOOT_END, _MARK = 8, b"PAR1"
# As the foot's encoding (Thrift, compact) writes it: the key, a text of 64 bytes.
_DIGEST = re.compile(re.escape(DIGEST_KEY) + rb"\x18\x40(.{64})", re.DOTALL)
AGAIN = "restore it from a copy, or have labpipe make it again"


class DamagedError(DataError):
    """An artefact whose content is not what labpipe wrote."""


def file_sha256(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


class DigestAlong:
    """SHA-256 of a file, made piece by piece while something else reads it."""

    def __init__(self, path: Path) -> None:
        self._stream, self._digest = path.open("rb", buffering=0), hashlib.sha256()
        self._size, self._done = path.stat().st_size, 0
        self._buffer = bytearray(CHUNK)

    def __enter__(self) -> DigestAlong:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def advance(self, share: float) -> None:
        """Go on to this *share* [1] of the file."""
        while self._done < share * self._size and self._more():
            pass

    def hexdigest(self) -> str:
        """The digest, when the rest is read too."""
        while self._more():
            pass
        return self._digest.hexdigest()

    def _more(self) -> int:
        count = self._stream.readinto(self._buffer)
        self._digest.update(memoryview(self._buffer)[:count])
        self._done += count
        return count


def mismatch(path: Path) -> DamagedError:
    """The fault of a file whose content does not match its digest."""
    return DamagedError(
        "content does not match its digest: edited or damaged after labpipe wrote it", path, AGAIN
    )


def stamp_parquet(path: Path) -> tuple[str, str]:
    """Put the digest of a finished Parquet file into its place; it, and the SHA-256 of the whole file."""
    place = _digest_place(path)
    if place is None:
        raise AssertionError(f"{path} has no place for a digest")
    before = _digest_before(path, place)
    digest = _digest_after(path, place, before, BLANK)
    with path.open("r+b") as stream:
        stream.seek(place)
        stream.write(digest.encode())
    # Only the end differs between the two.
    return digest, _digest_after(path, place, before, digest.encode())


def parquet_digest(path: Path) -> str:
    """The verified digest of a Parquet file, "" without one; DamagedError where its content is another."""
    place = _digest_place(path)
    if place is None:
        return ""
    with path.open("rb") as stream:
        stream.seek(place)
        stated = stream.read(len(BLANK)).decode("latin-1")
    if _digest_after(path, place, _digest_before(path, place), BLANK) != stated:
        raise mismatch(path)
    return stated


def _digest_place(path: Path) -> int | None:
    """Where the digest stands in a Parquet file; None where there is none, or no foot of a Parquet file."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        if size < _FOOT_END:
            return None
        stream.seek(size - _FOOT_END)
        end = stream.read(_FOOT_END)
        begin = size - _FOOT_END - int.from_bytes(end[:4], "little")
        if end[4:] != _MARK or begin < 0:
            return None
        stream.seek(begin)
        foot = stream.read(size - begin)
    matches = list(_DIGEST.finditer(foot))
    return begin + matches[-1].start(1) if matches else None


def _digest_before(path: Path, place: int) -> hashlib._Hash:
    """SHA-256 of the file up to the place of its digest, to be continued."""
    digest, buffer = hashlib.sha256(), memoryview(bytearray(CHUNK))
    with path.open("rb", buffering=0) as stream:
        remaining = place
        while remaining and (count := stream.readinto(buffer[: min(CHUNK, remaining)])):
            digest.update(buffer[:count])
            remaining -= count
    return digest


def _digest_after(path: Path, place: int, before: hashlib._Hash, middle: bytes) -> str:
    """SHA-256 of what stands *before* the place of the digest, *middle* in it, and of the rest."""
    digest = before.copy()
    digest.update(middle)
    with path.open("rb") as stream:
        stream.seek(place + len(BLANK))
        while chunk := stream.read(CHUNK):
            digest.update(chunk)
    return digest.hexdigest()
