"""Read the next block of a file in a thread during the work on the current block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar, cast

Block = TypeVar("Block")
_END = object()


def read_ahead(blocks: Iterable[Block]) -> Iterator[Block]:
    """The same blocks in the same order, one of them read ahead in a thread; errors of reading are raised here."""
    iterator = iter(blocks)
    with ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as reader:
        coming = reader.submit(next, iterator, _END)
        while (block := coming.result()) is not _END:
            coming = reader.submit(next, iterator, _END)
            yield cast(Block, block)
