"""Results that lie in an object storage: brought here to be read, or made here and put there.

A folder of this machine is used as it is. Objects appear whole: what a result is made of first,
identification.json after it, reports last; what is outdated goes at the end. Whoever reads meanwhile, or
after an upload that was cut short, finds the earlier result or the new one.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from labpipe.artefacts.dataset_file import FOLDER, SUFFIX
from labpipe.artefacts.identification_file import NAME
from labpipe.artefacts.places import Found, StorageError, get, list_below, naming, put, remove, status
from labpipe.artefacts.writing import STAGING, is_remote, show
from labpipe.errors import DataError, LabpipeError

Wanted = Callable[[str], bool]
# Objects that are on their way at the same time.
AT_ONCE = 8
REPORT = "report."


def everything(_name: str) -> bool:
    """All objects of a result."""
    return True


def summary(name: str) -> bool:
    """What lists, trends, comparisons and the report read: identification.json and the parts of datasets."""
    return name == NAME or name.endswith((f"/{NAME}", SUFFIX))


@contextmanager
def read_results(place: Path, wanted: Wanted = summary) -> Iterator[Path]:
    """A folder of this machine with the results below a place; messages of the block name the place.

    *place* may be an identification.json itself. DataError where there is nothing, StorageError where the
    storage does not answer.
    """
    if not is_remote(place):
        yield place
        return
    file = place.suffix == ".json" and status(place) is not None
    with _local(place.parent if file else place) as mirror:
        if not mirror.bring(wanted, named_only=True):
            raise DataError(
                "there are no results", show(place), "results appear with `labpipe run PIPELINE -o PLACE`"
            )
        yield mirror.folder / place.name if file else mirror.folder


@contextmanager
def make_results(place: Path, wanted: Wanted = everything) -> Iterator[Path]:
    """A folder of this machine in which the results of a place are made anew: what is *wanted* of the earlier
    ones lies in it.

    Its files are put there at the end; where the block ends by a fault of the input, what tests have finished
    is kept as well.
    """
    if not is_remote(place):
        yield place
        return
    with _local(place) as mirror:
        mirror.bring(wanted)
        try:
            yield mirror.folder
        except StorageError:
            raise
        except LabpipeError:
            mirror.publish()
            raise
        mirror.publish()


@contextmanager
def keep_results(place: Path) -> Iterator[Mirror]:
    """The mirror of results that are added to for as long as the block lasts, with the summary of those that
    are there.

    Of a folder of this machine it is the folder itself, to be published and forgotten without effect.
    """
    if not is_remote(place):
        yield _Itself(place, place)
        return
    with _local(place) as mirror:
        mirror.bring(summary)
        yield mirror


@contextmanager
def _local(place: Path) -> Iterator[Mirror]:
    with tempfile.TemporaryDirectory(prefix="labpipe-results-", ignore_cleanup_errors=True) as name:
        folder = Path(name) / place.name
        folder.mkdir()
        with naming({str(folder): show(place), str(folder.resolve()): show(place)}):
            yield Mirror(place, folder)


class Mirror:
    """A folder of this machine and the place whose results it holds."""

    def __init__(self, place: Path, folder: Path) -> None:
        self.place, self.folder = place, folder
        self._same: dict[str, tuple[int, int]] = {}

    def bring(self, wanted: Wanted, *, named_only: bool = False) -> int:
        """Bring the objects whose names are wanted; their number. *named_only*: of the parts of a run's
        dataset those that the index names, and DataError where one is missing.
        """
        here = {status.path.relative_to(self.place).as_posix(): status for status in list_below(self.place)}
        names = [name for name in here if wanted(name)]
        indices = [name for name in names if Path(name).name == NAME]
        self._get(indices, here)
        read = indices if named_only else []
        unnamed = {part for index in read for part in self._unnamed_parts(index, names)}
        self._get([name for name in names if name not in unnamed and name not in indices], here)
        return len(names)

    def publish(self) -> None:
        """Put there what is new here, and remove there what has gone here."""
        names = {name: stamp for name, stamp in self._files() if self._same.get(name) != stamp}
        gone = [name for name in self._same if not (self.folder / name).exists()]
        reports = [name for name in (*names, *gone) if name.startswith(REPORT)]
        _run_in_threads(self._put, [name for name in names if name != NAME and name not in reports])
        _run_in_threads(self._remove, reports)
        _run_in_threads(self._put, [name for name in names if name == NAME])
        _run_in_threads(self._put, [name for name in reports if name in names])
        _run_in_threads(self._remove, [name for name in gone if name not in reports])
        self._same = {**{name: stamp for name, stamp in self._same.items() if name not in gone}, **names}

    def forget(self) -> None:
        """Free the disk of what lies there as well, but for the index; it stays there."""
        for name, stamp in list(self._files()):
            if name != NAME and self._same.get(name) == stamp:
                (self.folder / name).unlink()
                del self._same[name]

    def _files(self) -> Iterator[tuple[str, tuple[int, int]]]:
        for path in sorted(self.folder.rglob("*")):
            name = path.relative_to(self.folder)
            if path.is_file() and not any(part.startswith(STAGING) for part in name.parts):
                status = path.stat()
                yield name.as_posix(), (status.st_ino, status.st_mtime_ns)

    def _unnamed_parts(self, index: str, names: Sequence[str]) -> Iterator[str]:
        """Parts of a dataset that the result of a run does not name: of an upload that was cut short, or of
        the result before.
        """
        try:
            inputs = json.loads((self.folder / index).read_bytes()).get("inputs", [])
            named = {
                str(Path(index).parent / entry["path"]) for entry in inputs if entry["path"].endswith(SUFFIX)
            }
        except (ValueError, AttributeError, TypeError, KeyError):
            # Whoever reads the file says what is wrong with it.
            return
        if not named:
            return
        home = (Path(index).parent / FOLDER).as_posix() + "/"
        if lacking := named.difference(names):
            raise DataError(
                f"lacks the part '{min(lacking)}'", show(self.place), "it may be changing now; try again"
            )
        there = (name for name in names if name.startswith(home) and name.endswith(SUFFIX))
        yield from (name for name in there if name not in named)

    def _get(self, names: Sequence[str], objects: dict[str, Found]) -> None:
        _run_in_threads(lambda name: get(objects[name].path, self.folder / name), names)
        for name in names:
            there = (self.folder / name).stat()
            self._same[name] = there.st_ino, there.st_mtime_ns

    def _put(self, name: str) -> None:
        put(self.folder / name, self.place / name)

    def _remove(self, name: str) -> None:
        remove(self.place / name)


class _Itself(Mirror):
    """A folder of this machine that is the place."""

    def publish(self) -> None:
        """Nothing is to be done."""

    def forget(self) -> None:
        """Nothing is to be done."""


def _run_in_threads(work: Callable[[str], None], names: Iterable[str]) -> None:
    with ThreadPoolExecutor(AT_ONCE) as pool:
        waiting = [pool.submit(work, name) for name in names]
        try:
            for upload in waiting:
                upload.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
