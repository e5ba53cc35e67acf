"""An S3 server on loopback, started as docs/pages/how-to/object-storage.md says, on a free port."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import time
import urllib.request
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[2] / "docs/pages/how-to/object-storage.md"
SECRET = "not-to-be-printed"


@contextmanager
def s3_server() -> Iterator[dict[str, str]]:
    """The variables of the environment by which the server is found; it ends with the block."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    start = re.search(r"^moto_server .*", PAGE.read_text(), re.MULTILINE)
    assert start is not None
    program, *arguments = start[0].replace("5055", str(port)).split()
    command = [str(Path(sys.executable).with_name(program)), *arguments]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server:
        try:
            url = f"http://127.0.0.1:{port}"
            for _ in range(300):
                try:
                    urllib.request.urlopen(f"{url}/moto-api/", timeout=5).close()
                    break
                except OSError:
                    time.sleep(0.1)
            keys = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": SECRET}
            yield {"AWS_ENDPOINT_URL": url, "AWS_DEFAULT_REGION": "us-east-1", **keys}
        finally:
            server.terminate()


def s3_client() -> Any:
    """boto3's client of the server that the environment names."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import boto3

        return boto3.client("s3")
