"""Addresses of files: paths of this machine, and the URLs of an object storage, which are kept as paths.

``s3://bucket/runs/a.csv`` is ``Path("s3:/bucket/runs/a.csv")`` inside: names, endings and parents are those of any path, and `shown` gives
the URL back. ``file:///data/a.csv`` is a path of this machine.
"""

from __future__ import annotations

from pathlib import Path
from urllib.parse import unquote, urlsplit

from labpipe.errors import ConfigError

# Storages of objects; what else pyarrow reaches is a file system that can be mounted.
SCHEMES = ("s3:", "gs:", "gcs:", "abfs:", "abfss:")
FILE = "file://"


def path_of(text: str) -> Path:
    """The path of an address; ConfigError for a URL without a bucket, or one that names a place twice over."""
    if text.startswith(FILE):
        return Path(unquote(urlsplit(text).path))
    path = Path(text)
    if is_remote(path):
        if len(path.parts) < 2 or "//" in text.split("://", 1)[-1] or ".." in path.parts:
            raise ConfigError("is no URL of an object", where=text, hint="write it as s3://bucket/folder/name")
    elif "://" in text:
        schemes = ", ".join(f"{scheme}//" for scheme in SCHEMES)
        raise ConfigError("is a URL that cannot be read", where=text, hint=f"known: {schemes}, {FILE}")
    return path


def is_remote(path: Path) -> bool:
    """Whether a path stands for a URL of an object storage."""
    return bool(path.parts) and path.parts[0] in SCHEMES


def shown(path: Path) -> str:
    """The path as people write it."""
    return f"{path.parts[0]}//{'/'.join(path.parts[1:])}" if is_remote(path) else str(path)
