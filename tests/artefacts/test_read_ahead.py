"""Reading ahead changes neither the blocks nor their order, and hides no error."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from labpipe.artefacts.recording_file import read_ahead


def test_same_blocks_in_the_same_order() -> None:
    assert list(read_ahead(range(20))) == list(range(20))
    assert list(read_ahead([])) == []


def test_the_next_block_is_read_meanwhile() -> None:
    read = threading.Event()

    def blocks() -> Iterator[int]:
        yield 0
        read.set()
        yield 1

    ahead = read_ahead(blocks())
    assert next(ahead) == 0
    assert read.wait(5.0)


def test_what_reading_raises_comes_through_after_the_blocks_before_it() -> None:
    def blocks() -> Iterator[int]:
        yield 7
        raise ValueError("torn")

    ahead = read_ahead(blocks())
    assert next(ahead) == 7
    with pytest.raises(ValueError, match="torn"):
        next(ahead)


def test_stopping_early_is_allowed() -> None:
    before = threading.active_count()
    ahead = read_ahead(range(1000))
    assert next(ahead) == 0
    ahead.close()  # type: ignore[attr-defined]
    assert threading.active_count() == before
