"""A cluster whose workers are gone is waited for as long as there is hope, and not for ever."""

from __future__ import annotations

import pytest

from labpipe.errors import DataError
from labpipe.project import executors as cluster


class Client:
    """Of a scheduler that has workers at the looks that say so."""

    def __init__(self, *looks: int) -> None:
        self.looks = list(looks)

    def nthreads(self) -> dict[str, int]:
        return {f"worker{number}": 1 for number in range(self.looks.pop(0))}


def test_it_is_asked_again_while_there_are_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "START_SECONDS", -1)
    asked: list[float] = []

    def ask(seconds: float) -> str:
        asked.append(seconds)
        if len(asked) < 3:
            raise TimeoutError
        return "done"

    client = Client(2, 1)
    assert (
        cluster.patiently(client, ask) == "done" and asked == [cluster.LOOK_SECONDS] * 3 and not client.looks
    )


def test_it_is_given_up_without_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "START_SECONDS", -1)

    def ask(_: float) -> None:
        raise TimeoutError

    with pytest.raises(DataError, match="has no workers any more"):
        cluster.patiently(Client(1, 0), ask)
