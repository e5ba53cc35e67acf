"""A test as it runs: samples of a source through the bench, update by update, and the run at its end."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, DataError, LabpipeError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.live.bench import Bench, names_of_fit, obstacle
from labpipe.methods.live.charts import Forecast, Goal, Standing, Update, Watch, check_names, half_width
from labpipe.methods.live.sources import MOST_ROWS, Folder, SampleStream, is_old
from labpipe.project.ingest import Calibration, channel_screen
from labpipe.project.measured import OTHERS
from labpipe.project.pipeline_file import Pipeline
from labpipe.raw_files.screening import TimeAxisScreen
from labpipe.records.finding import WARNING, Finding, note
from labpipe.records.identification import Fit
from labpipe.records.recording import Channel, Recording
from labpipe.records.rig import Rig
from labpipe.records.spectra import FreeDecays
from labpipe.spectra.measurement import measure
from labpipe.spectra.ports import find_layout
from labpipe.spectra.settings import FrfSettings

# Rows of a time column by which the rate is known.
ROWS_OF_RATE = 64
# A step of time beyond so many usual ones is a gap.
GAP = 1.5
# Averages from which a fit of all samples so far is judged, and how much longer they are at its next look:
# before, when nothing can be enough yet, and from then on.
LEAST_WHOLE, EARLY_LOOK, NEXT_LOOK = 10, 1.4, 1.15
# Pause between two looks at a source that had nothing new [s].
PAUSE = 0.1
# Time by which the picture may lag behind the samples before that is said [s].
BEHIND = 1.0


class Kept:
    """Rows of samples on disk, in the order in which they come, as long as there is room."""

    def __init__(self, path: Path, n_column: int) -> None:
        self.path, self.n_row, self._n_column = path, 0, n_column
        # Without a buffer nothing waits to be written when the disk is full.
        self._file = path.open("wb", buffering=0)
        self.full = ""

    def add(self, rows: FloatArray) -> bool:
        """Keep *rows* (n, n_column) [any unit]; False from the moment on when there is no room."""
        if self.full:
            return False
        text = memoryview(np.ascontiguousarray(rows, np.float64).tobytes())
        try:
            while text:
                text = text[self._file.write(text) :]
        except OSError as error:
            self.full = (error.strerror or str(error)).lower()
            return False
        self.n_row += rows.shape[0]
        return True

    def blocks(self, n_row: int, first: int = 0, end: int | None = None) -> Iterator[FloatArray]:
        """Consecutive blocks (n, n_column) [unit in which they came] of at most *n_row* rows, of those from
        *first* to *end*.
        """
        end = self.n_row if end is None else end
        if self.n_row:
            whole = np.memmap(self.path, np.float64, "r", shape=(self.n_row, self._n_column))
            for start in range(first, end, n_row):
                yield np.array(whole[start : min(start + n_row, end)])

    def close(self) -> None:
        self._file.close()


@dataclass(frozen=True)
class Part:
    """One recording of those that came so far: samples *first* to *end* of what is on disk."""

    channels: tuple[Channel, ...]
    sample_rate: float
    kept: Kept
    first: int
    end: int
    name: str
    findings: tuple[Finding, ...] = ()

    @property
    def n_sample(self) -> int:
        return self.end - self.first

    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """Consecutive blocks (n, n_channel) [SI] of at most *n_sample* samples."""
        return self.kept.blocks(n_sample, self.first, self.end)


class WholeFits(Watch):
    """Fits that cannot follow single averages: made anew of all samples so far, at looks ever further
    apart. What begins anew (a file that falls into a folder, a gap) is another recording, as in a run.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        sample_rate: float,
        frf: FrfSettings,
        fits: Sequence[FitSettings],
        goals: Sequence[Goal],
    ) -> None:
        super().__init__(channels, sample_rate, frf, goals)
        self._fits = tuple(fits)
        self._folder = tempfile.TemporaryDirectory(prefix="labpipe-live-")
        self._kept = Kept(Path(self._folder.name) / "samples", len(self.channels))
        self._next, self._looked_at = 0.0, 0
        self._firsts = [0]

    def restart(self) -> None:
        """The samples that follow belong to another recording."""
        if self.n_sample > self._firsts[-1]:
            self._firsts.append(self.n_sample)

    def add(self, block: FloatArray) -> list[Update]:
        """Keep the next samples (n, n_channel) [SI]; an update where it is time for a look."""
        if not self._kept.full and not self._kept.add(block):
            return self.look()
        length = self.frf.period or self.frf.block or 1.0
        self._next = self._next or 3 * length * self.sample_rate
        if self.n_sample < self._next:
            return []
        looked = self.look()
        self._next = (NEXT_LOOK if self.averages >= LEAST_WHOLE else EARLY_LOOK) * self.n_sample
        return looked

    def close(self) -> None:
        """Leave no samples on disk."""
        self._kept.close()
        self._folder.cleanup()

    @property
    def n_sample(self) -> int:
        return self._kept.n_row

    def _parts(self) -> list[Part]:
        ends = [*self._firsts[1:], self.n_sample]
        return [
            Part(self.channels, self.sample_rate, self._kept, first, end, f"recording {number}")
            for number, (first, end) in enumerate(zip(self._firsts, ends, strict=True), 1)
            if end > first
        ]

    def _fitted(self, parts: Sequence[Part]) -> tuple[Any, list[Fit]]:
        """What the recordings give, and the fits of it; what has just begun may not do yet."""
        kind = OTHERS.get(self.frf.gives)
        try:
            measured = measure(parts, self.frf) if kind is None else kind.make(parts, self.frf)
            return measured, [fit for settings in self._fits for fit in identify(measured, settings)]
        except LabpipeError:
            if len(parts) < 2 or parts[-1].end < self.n_sample:
                raise
        return self._fitted(parts[:-1])

    def look(self) -> list[Update]:
        """An update by all samples so far, none where these were looked at already."""
        seconds = self.n_sample / self.sample_rate
        if self._looked_at == self.n_sample:
            return []
        self._looked_at = self.n_sample
        try:
            measured, fits = self._fitted(self._parts())
        except LabpipeError as error:
            full = _no_room(self._kept, self.sample_rate)
            update = Update(self.averages, findings=(*full, Finding("not-yet", error.what)))
            self.keep(update)
            return [update]
        check_names(self.goals, {fit.name: [p.name for p in fit.parameters] for fit in fits})
        decays = measured.decays if isinstance(measured, FreeDecays) else ()
        counted = len(decays) or getattr(measured, "averages", 0)
        self.averages = int(counted or round(seconds / (self.frf.period or 1.0)))
        standings = {
            f"{fit.name}.{parameter.name}": self._standing(fit.name, parameter)
            for fit in fits
            for parameter in fit.parameters
        }
        wanted = [standing for standing in standings.values() if standing.goal is not None]
        enough = bool(wanted) and self.averages >= LEAST_WHOLE and all(s.reached for s in wanted)
        findings = (*measured.findings, *(finding for fit in fits for finding in fit.findings))
        update = Update(
            self.averages,
            standings=standings,
            findings=(*_no_room(self._kept, self.sample_rate), *(f for f in findings if f.level == WARNING)),
            stop=enough,
            seconds=seconds / max(self.averages, 1),
        )
        self.keep(update)
        return [update]

    def _standing(self, fit: str, parameter: Any) -> Standing:
        half, wanted = half_width(parameter), self.goal_of(fit, parameter)
        if wanted is None:
            return Standing(parameter, half)
        expected = None
        if np.isfinite(half) and self.averages:
            expected = max(self.averages, int(np.ceil(self.averages * (half / wanted) ** 2)))
        return Standing(parameter, half, wanted, Forecast(expected))

    def by_hand(self) -> dict[str, tuple[float, float]]:
        return {}


@dataclass
class Session:
    """One test of a pipeline over the samples of a source.

    idle: seconds without new samples after which the test is over; keep: where the samples of a source that
    leaves no file are kept, None for nowhere.
    """

    pipeline: Pipeline
    rig: Rig
    stream: SampleStream
    goals: Sequence[Goal] = ()
    idle: float = 90.0
    keep: Path | None = None
    path: Path | None = None
    bench: Bench | WholeFits | None = None
    n_row: int = 0
    findings: list[Finding] = field(default_factory=list)
    stopped: Callable[[], bool] = lambda: False

    def __post_init__(self) -> None:
        if self.pipeline.frf is None:
            raise ConfigError(
                "frf: is missing", where=str(self.pipeline.path), hint="say what the excitation is"
            )
        if not self.pipeline.fits:
            raise ConfigError(
                "identify: is missing", where=str(self.pipeline.path), hint="name what is wanted"
            )
        self._calibration, self._screen = Calibration(self.rig), channel_screen(self.rig)
        self._head: list[FloatArray] = []
        self._rate: float | None = None
        self._last_time: float | None = None
        self.kept = None if self.keep is None else Kept(self.keep, len(self.columns))

    @property
    def columns(self) -> list[str]:
        """What the source is asked for: the time, if the rig names it, and the rig's columns."""
        return columns_of(self.rig)

    def updates(self) -> Iterator[Update]:
        """What each new average changes, until the source ends, rests too long, or *stopped* says so."""
        rested, waited = 0.0, (time.monotonic(), 0)
        try:
            while not self.stopped():
                rows = self.stream.read()
                if rows is None:
                    break
                if not rows.shape[0]:
                    if rested >= self.idle or (rested > 1.0 and self.path and is_old(self.path, self.idle)):
                        break
                    time.sleep(PAUSE)
                    rested += PAUSE
                    waited = (time.monotonic(), self.n_row)
                    continue
                rested = 0.0
                for update in self._taken(rows):
                    yield replace(update, findings=(*update.findings, *self._behind(*waited)))
            yield from self._ended()
        finally:
            for open_one in (self.kept, self.bench):
                if isinstance(open_one, Kept | WholeFits):
                    open_one.close()

    def _behind(self, since: float, done: int) -> list[Finding]:
        """What is said where samples come faster than they are followed, *since* a time [s] when *done* were
        followed and no more were there.
        """
        if self._rate is None:
            return []
        lag = time.monotonic() - since - (self.n_row - done) / self._rate
        message = f"the picture is {lag:.0f} s behind the samples; none is lost"
        return [note("behind", message)] if lag > BEHIND else []

    def _taken(self, rows: FloatArray) -> Iterator[Update]:
        if self.kept is not None and not self.kept.full and not self.kept.add(rows):
            self.findings += _no_room(self.kept, self._rate or self.stream.sample_rate)
        if self.bench is None:
            self._head.append(rows)
            if not self._begun():
                return
            rows, self._head = np.concatenate(self._head), []
            if self.findings:
                yield Update(0, findings=tuple(self.findings))
        assert self.bench is not None
        if self.stream.restarted:
            self.bench.restart()
        for piece in self._without_gaps(rows):
            block = self._calibration.with_sums(self._calibration.measured(piece))
            measured = block[:, : len(self.rig.channels)]
            if np.isfinite(measured).all():
                self._screen.add(measured)
            self.n_row += piece.shape[0]
            for update in self.bench.add(block):
                screened = self._screen.findings() if self.n_row else ()
                yield replace(update, findings=(*update.findings, *self.findings, *screened))

    def _begun(self) -> bool:
        head = np.concatenate(self._head)
        rate = self.rig.sample_rate or self.stream.sample_rate
        if self.rig.time:
            if head.shape[0] < ROWS_OF_RATE:
                return False
            screen = TimeAxisScreen(self.rig.time)
            screen.add(head[:ROWS_OF_RATE, 0] * self.rig.time_scale)
            rate = screen.sample_rate()
        if rate is None:
            raise DataError("neither the source nor the rig file says the rate", hint="sample_rate: 20 kHz")
        frf, fits = self.pipeline.frf, self.pipeline.fits
        assert frf is not None
        channels = self.rig.all_channels
        reasons = {fit.name: obstacle(fit, frf, channels, rate) for fit in fits}
        followed = [fit for fit in fits if not reasons[fit.name]]
        wanted = self._waited_for(fits, followed, rate)
        # A fit that nobody waits for is left to the run at the end.
        whole = [fit for fit in fits if fit not in followed and (not followed or fit.name in wanted)]
        self.findings += [
            _not_followed(fit.name, reasons[fit.name], fit in whole) for fit in fits if fit not in followed
        ]
        self._rate = rate
        if whole:
            looked_at = [fit for fit in fits if fit in whole or fit.name in wanted]
            self.bench = WholeFits(channels, rate, frf, looked_at, self.goals)
        else:
            self.bench = Bench(channels, rate, frf, followed, self.goals)
        return True

    def _waited_for(
        self, fits: Sequence[FitSettings], followed: Sequence[FitSettings], rate: float
    ) -> set[str]:
        """The fits that a goal is set for; one that names no fit is for all that have its coefficient, and,
        if no fit that is followed has it, for all whose coefficients are only known by their values.
        """
        linear = [fit for fit in fits if fit.kind.equations is not None]
        names: dict[str, tuple[str, ...]] = {}
        if linear and any(not goal.fit for goal in self.goals):
            channels = self.rig.all_channels
            layout = find_layout([Recording(tuple(channels), np.zeros((2, len(channels))), rate)])
            names = {fit.name: names_of_fit(fit, layout) for fit in linear}
        known = {name for fit in followed for name in names.get(fit.name, ())}
        return {goal.fit for goal in self.goals} | {
            fit.name
            for fit in fits
            for goal in self.goals
            if not goal.fit and (goal.name in names.get(fit.name, ()) or goal.name not in known)
        }

    def _without_gaps(self, rows: FloatArray) -> Iterator[FloatArray]:
        if not self.rig.time:
            yield rows
            return
        assert self._rate is not None
        times = rows[:, 0] * self.rig.time_scale
        before = times[:1] if self._last_time is None else np.array([self._last_time])
        steps = np.diff(np.concatenate([before, times])) * self._rate
        steps[0] = 1.0 if self._last_time is None else steps[0]
        gaps = np.flatnonzero((steps > GAP) | (steps <= 0))
        for place in gaps:
            what = (
                f"{steps[place] - 1:.0f} samples are missing" if steps[place] > 0 else "the clock began anew"
            )
            self.findings.append(Finding("gap", f"{what} at {times[place]:.3f} s; averages begin anew there"))
        self._last_time = float(times[-1])
        begin = 0
        for end in (*gaps.tolist(), rows.shape[0]):
            if end > begin:
                yield rows[begin:end, 1:]
            if end < rows.shape[0] and self.bench is not None:
                self.bench.restart()
            begin = end

    def write_recording(self, path: Path) -> None:
        """What was kept of a source that leaves no file, as a Parquet file."""
        assert self.kept is not None
        schema = pa.schema([(name, pa.float64()) for name in self.columns])
        with pq.ParquetWriter(path, schema) as writer:
            for rows in self.kept.blocks(MOST_ROWS):
                writer.write_table(pa.table(list(rows.T), schema=schema))

    def _ended(self) -> Iterator[Update]:
        if self.bench is None:
            raise DataError("the source ended before it held enough samples", hint="is it the right one?")
        if isinstance(self.bench, WholeFits):
            for update in self.bench.look():
                yield replace(update, findings=(*update.findings, *self.findings))

    @property
    def recorded(self) -> list[Path]:
        """The files that the whole test stands in, for the run at its end."""
        if isinstance(self.stream, Folder):
            return list(self.stream.files)
        return [] if self.path is None else [self.path]


def _no_room(kept: Kept, rate: float | None) -> list[Finding]:
    """What is said of a disk that is full."""
    if not kept.full:
        return []
    where = f"{kept.n_row / rate:.1f} s" if rate else f"sample {kept.n_row}"
    return [Finding("disk-full", f"{kept.full}: samples from {where} on are not kept, {kept.n_row} are")]


def _not_followed(fit: str, reason: str, whole: bool) -> Finding:
    """What is said at the beginning of a test of a fit that cannot be followed."""
    instead = (
        f"it is made anew of all samples, each time after {100 * (NEXT_LOOK - 1):.0f} % more of them "
        f"({100 * (EARLY_LOOK - 1):.0f} % before average {LEAST_WHOLE})"
        if whole
        else "it is made once the test has ended"
    )
    return note("not-followed", f"{fit} cannot be followed average by average: {reason}; {instead}")


def columns_of(rig: Rig) -> list[str]:
    """The columns that a rig reads: its time, then its channels."""
    return [*([rig.time] if rig.time else []), *(channel.column for channel in rig.channels)]
