"""Addresses of files on this machine and in object storage, what lies there, and recordings brought here
while they are worked on.

``s3://bucket/runs/a.csv`` is ``Path("s3:/bucket/runs/a.csv")`` inside: names, endings and parents are those
of any path, and `shown` gives the URL back. ``file:///data/a.csv`` is a path of this machine.

An object storage by pyarrow's file systems: what is there, objects brought here and put there, each whole or
not at all.

Credentials, region and endpoint are those of the usual environment (AWS_ACCESS_KEY_ID, AWS_PROFILE,
AWS_DEFAULT_REGION, AWS_ENDPOINT_URL, GOOGLE_APPLICATION_CREDENTIALS ...); nothing of them is read or printed
here.
"""

from __future__ import annotations

import datetime
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pyarrow as pa

from labpipe.artefacts.writing import SCHEMES, is_remote, show
from labpipe.errors import DataError, LabpipeError

# A storage that does not answer is given up after ATTEMPTS times so many seconds, and pauses in between.
CONNECT_SECONDS, REQUEST_SECONDS, ATTEMPTS = 5, 10, 3
CHUNK = 8 << 20
_ELSEWHERE = "and AWS_ENDPOINT_URL where the storage is not Amazon's"
# Words of pyarrow's messages, what they mean, and what to do.
_REASONS = (
    (("NO_SUCH_BUCKET",), "there is no such bucket", f"check the name, {_ELSEWHERE}"),
    (("NETWORK_CONNECTION", "curlCode"), "the storage does not answer", f"check the network, {_ELSEWHERE}"),
    (
        ("PermanentRedirect", "HTTP response code: 301"),
        "the bucket is in another region",
        "set AWS_DEFAULT_REGION",
    ),
    (
        ("INVALID_ACCESS_KEY_ID", "SIGNATURE_DOES_NOT_MATCH"),
        "the storage refuses the credentials",
        "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE",
    ),
    (
        ("ACCESS_DENIED", "UNKNOWN (HTTP status 403)"),
        "the storage refuses access",
        "check the credentials in the environment, and the rights on the bucket",
    ),
    (("access token",), "the storage refuses access", "set GOOGLE_APPLICATION_CREDENTIALS"),
    (
        ("credentials",),
        "the storage refuses access",
        "set GOOGLE_APPLICATION_CREDENTIALS, or the variables of your storage",
    ),
)


class StorageError(DataError):
    """The storage itself fails, not an object in it: other objects will fail as well."""


@dataclass(frozen=True)
class Found:
    """An object: its URL as a path, its length in bytes and when it was last changed, in seconds since
    1970.
    """

    path: Path
    size: int
    changed: float


def status(path: Path) -> Found | None:
    """The object of a URL; None where there is none. StorageError for no bucket, no access or no answer."""
    with _with_place(path):
        info = _system(path).get_file_info(_inside(path))
        if info.is_file:
            return _entry(path, info)
        # Whether it is the object or the bucket that is missing, only a list tells.
        _listing(path, recursive=False)
    return None


def list_below(path: Path) -> list[Found]:
    """All objects whose names begin with that of a folder, sorted by name; none where there is nothing."""
    with _with_place(path):
        infos = _listing(path, recursive=True)
    objects = [
        _entry(Path(path.parts[0]) / info.path, info)
        for info in infos
        if info.is_file and _is_plain(info.path)
    ]
    return sorted(objects, key=lambda entry: entry.path)


def get(path: Path, target: Path) -> None:
    """Bring an object here; DataError where there is none, or where it changes meanwhile."""
    from pyarrow.fs import LocalFileSystem, copy_files

    before = status(path)
    if before is None:
        raise DataError("no such object", show(path), "it may have been removed since it was listed")
    target.parent.mkdir(parents=True, exist_ok=True)
    with _with_place(path):
        copy_files(_inside(path), str(target), _system(path), LocalFileSystem(), chunk_size=CHUNK)
    if status(path) != before or target.stat().st_size != before.size:
        raise DataError("changed while it was read", show(path), "run again when it is complete")
    os.utime(target, (before.changed, before.changed))


def put(source: Path, path: Path) -> None:
    """Put a file there: its object appears when all of it has arrived."""
    from pyarrow.fs import LocalFileSystem, copy_files

    # All of it in one call: a stream of Python's own that an interrupt closes would leave half an object.
    with _with_place(path):
        copy_files(str(source), _inside(path), LocalFileSystem(), _system(path), chunk_size=CHUNK)


def remove(path: Path) -> None:
    """Remove an object, which may have gone already."""
    with _with_place(path), suppress(FileNotFoundError):
        _system(path).delete_file(_inside(path))


def _is_plain(name: str) -> bool:
    """Whether an object's name is that of a file: "a/../b" could be written anywhere."""
    return not {"", ".", ".."}.intersection(name.split("/"))


def _entry(path: Path, info: Any) -> Found:
    changed = info.mtime or datetime.datetime.fromtimestamp(0, datetime.UTC)
    return Found(path, info.size, changed.timestamp())


def _listing(path: Path, *, recursive: bool) -> Any:
    from pyarrow.fs import FileSelector

    # Asked to allow for nothing being there, pyarrow would pass over a missing bucket as well.
    try:
        return _system(path).get_file_info(FileSelector(_inside(path), recursive=recursive))
    except FileNotFoundError:
        return []


def _inside(path: Path) -> str:
    return "/".join(path.parts[1:])


def _system(path: Path) -> Any:
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
    return _open(path.parts[0], path.parts[1], endpoint)


@lru_cache(maxsize=8)
def _open(scheme: str, bucket: str, s3_endpoint: str) -> Any:
    from pyarrow import fs

    if scheme == "s3:":
        endpoint = urlsplit(s3_endpoint)
        return fs.S3FileSystem(
            connect_timeout=CONNECT_SECONDS,
            request_timeout=REQUEST_SECONDS,
            retry_strategy=fs.AwsStandardS3RetryStrategy(max_attempts=ATTEMPTS),
            **({"endpoint_override": endpoint.netloc, "scheme": endpoint.scheme} if endpoint.netloc else {}),
        )
    if scheme in ("gs:", "gcs:"):
        return fs.GcsFileSystem(retry_time_limit=datetime.timedelta(seconds=REQUEST_SECONDS))
    return fs.FileSystem.from_uri(f"{scheme}//{bucket}")[0]


@contextmanager
def _with_place(path: Path) -> Iterator[None]:
    try:
        yield
    except (pa.ArrowException, OSError) as error:
        if getattr(error, "errno", None) is not None and not isinstance(error, FileNotFoundError):
            # Of this machine: a full disk, say.
            raise
        text = str(error)
        for words, what, hint in _REASONS:
            if any(word in text for word in words):
                raise StorageError(what, show(path), hint) from None
        reason = (text.splitlines() or [type(error).__name__])[0]
        raise StorageError(f"cannot be reached ({reason[:200]})", show(path)) from None


SPOOL = "labpipe-fetched-"


@contextmanager
def fetch(paths: Sequence[Path], home: Path) -> Iterator[dict[Path, Path]]:
    """Where those of some paths that are URLs lie here, in a folder in *home* that goes at the end. Messages
    of the block name the URLs.

    The parts of such a path end with those of the URL, from which `origin` tells it.
    """
    remote = [path for path in dict.fromkeys(paths) if is_remote(path)]
    if not remote:
        yield {}
        return
    with tempfile.TemporaryDirectory(prefix=SPOOL, dir=home, ignore_cleanup_errors=True) as name:
        here = {path: Path(name) / path for path in remote}
        for path, local in here.items():
            get(path, local)
        with naming({str(local): show(path) for path, local in here.items()}):
            yield here


@contextmanager
def naming(names: dict[str, str]) -> Iterator[None]:
    """Have the messages of the block's errors name places by other names."""
    try:
        yield
    except LabpipeError as error:
        for name, other in names.items():
            error.where, error.what = error.where.replace(name, other), error.what.replace(name, other)
        raise


def origin(path: Path) -> Path | None:
    """The URL that a fetched file comes from, as a path; None for a file of this machine."""
    for number, part in enumerate(path.parts[:-1], 1):
        if part.startswith(SPOOL) and path.parts[number] in SCHEMES:
            return Path(*path.parts[number:])
    return None
