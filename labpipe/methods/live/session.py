"""A test as it runs: samples of a source through the bench, update by update, and the run at its end."""

from __future__ import annotations

import math
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.errors import ConfigError, DataError, LabpipeError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.live.bench import Bench, layout_of, names_of_fit, obstacle
from labpipe.methods.live.charts import Forecast, Goal, GoalWatch, Standing, Update, lasting
from labpipe.methods.live.sources import Folder, Frames, FrameStore, SampleStream, is_old
from labpipe.project.ingest import SAME_RATE, Calibration, channel_screen
from labpipe.project.measured import measurement
from labpipe.project.pipeline_file import Pipeline
from labpipe.raw_files.screening import TimeAxisScreen
from labpipe.records.finding import WARNING, Finding, Parameter, note, of_level
from labpipe.records.identification import Fit
from labpipe.records.recording import Channel
from labpipe.records.rig import Rig
from labpipe.records.spectra import FreeDecays

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


@dataclass(frozen=True)
class Part:
    """One recording of those that came so far: samples *first* to *end* of those in a file of float64."""

    channels: tuple[Channel, ...]
    sample_rate: float
    path: Path
    first: int
    end: int
    name: str
    findings: tuple[Finding, ...] = ()

    @property
    def n_sample(self) -> int:
        return self.end - self.first

    def blocks(self, n_sample: int) -> Iterator[FloatArray]:
        """Consecutive blocks (n, n_channel) [SI] of at most *n_sample* samples."""
        whole = np.memmap(self.path, np.float64, "r", shape=(self.end, len(self.channels)))
        for start in range(self.first, self.end, n_sample):
            yield np.array(whole[start : start + n_sample])


@dataclass(eq=False, repr=False)
class WholeFits(GoalWatch):
    """Fits that cannot follow single averages: made anew of all samples so far, at looks ever further
    apart. What begins anew (a file that falls into a folder, a gap) is another recording, as in a run.
    """

    def __post_init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="labpipe-live-")
        self._kept = FrameStore(Path(self._folder.name) / "samples", 8 * len(self.channels))
        self._next, self._looked_at, self._firsts = 0.0, 0, [0]

    def restart(self) -> None:
        if self.n_sample > self._firsts[-1]:
            self._firsts.append(self.n_sample)

    def add(self, block: FloatArray) -> list[Update]:
        """Keep the next samples (n, n_channel) [SI]; an update where it is time for a look."""
        self._kept.add(np.ascontiguousarray(block, np.float64).tobytes())
        if self._kept.full:
            return self.look()
        length = self.frf.period or self.frf.block or 1.0
        self._next = self._next or 3 * length * self.sample_rate
        if self.n_sample < self._next:
            return []
        looked = self.look()
        ratio = NEXT_LOOK if self.averages >= LEAST_WHOLE else EARLY_LOOK
        left = [standing.remaining for standing in looked[0].standings.values() if standing.remaining]
        if left:
            # Not later than where all goals are expected to be reached.
            due = max(LEAST_WHOLE, self.averages + 1, *(progress.expected or math.inf for progress in left))
            ratio = min(ratio, due / self.averages)
        self._next = ratio * self.n_sample
        return looked

    def close(self) -> None:
        """Leave no samples on disk."""
        self._kept.close()
        self._folder.cleanup()

    @property
    def n_sample(self) -> int:
        return self._kept.n_frame

    def _parts(self) -> list[Part]:
        pieces = zip(self._firsts, [*self._firsts[1:], self.n_sample], strict=True)
        return [
            Part(self.channels, self.sample_rate, self._kept.path, first, end, f"recording {number}")
            for number, (first, end) in enumerate(pieces, 1)
            if end > first
        ]

    def _fit(self, parts: Sequence[Part]) -> tuple[Any, list[Fit]]:
        """What the recordings give, and the fits of it; what has just begun may not do yet."""
        try:
            result = measurement(parts, self.frf)
            return result, [fit for settings in self.settings for fit in identify(result, settings)]
        except LabpipeError:
            if len(parts) < 2 or sum(part.n_sample for part in parts) < self.n_sample:
                raise
        return self._fit(parts[:-1])

    def look(self) -> list[Update]:
        """An update by all samples so far, none where these were looked at already."""
        if self._looked_at == self.n_sample:
            return []
        self._looked_at, seconds = self.n_sample, self.n_sample / self.sample_rate
        standings: dict[str, Standing] = {}
        try:
            result, fits = self._fit(self._parts())
        except LabpipeError as error:
            findings = [Finding("not-yet", error.what)]
        else:
            self.check_goals({fit.name: [p.name for p in fit.parameters] for fit in fits})
            decays = result.decays if isinstance(result, FreeDecays) else ()
            counted = len(decays) or getattr(result, "averages", 0)
            self.averages = int(counted or round(seconds / (self.frf.period or 1.0)))
            several = Counter(fit.name for fit in fits)
            for fit in fits:
                # Of several bands or directions each one, as rules address them.
                which = " ".join(filter(None, (fit.term, f"{fit.centre_hz:g} Hz")))
                name = fit.name if several[fit.name] == 1 else f"{fit.name}[{which}]"
                lasts = lasting(fit, getattr(result, "errors", ()))
                standings |= {
                    f"{name}.{p.name}": self._standing(fit.name, p, lasts.get(p.name, 0.0))
                    for p in fit.parameters
                }
            findings = [*result.findings, *(finding for fit in fits for finding in fit.findings)]
            findings += [s.no_help(label) for label, s in standings.items() if s.held_up]
        wanted = [standing for standing in standings.values() if standing.goal is not None]
        warnings = dict.fromkeys(of_level(WARNING, findings))
        update = Update(
            self.averages,
            standings=standings,
            findings=(*self._kept.findings(self.sample_rate), *warnings),
            stop=bool(wanted) and self.averages >= LEAST_WHOLE and all(s.reached for s in wanted),
            seconds=seconds / max(self.averages, 1),
        )
        self.keep(update)
        return [update]

    def _standing(self, fit: str, parameter: Parameter, floor: float) -> Standing:
        expected = None
        standing = Standing(parameter, wanted := self.goal_of(fit, parameter, floor))
        if wanted is None or not (np.isfinite(standing.half) and self.averages):
            return standing
        if floor < wanted:
            times = (standing.half**2 - floor**2) / (wanted**2 - floor**2)
            expected = max(self.averages, math.ceil(self.averages * times))
        return replace(standing, remaining=Forecast(expected), floor=floor)


@dataclass
class Session:
    """One test of a pipeline over the samples of a source; *idle* [s] without new ones ends it."""

    pipeline: Pipeline
    rig: Rig
    stream: SampleStream
    goals: Sequence[Goal] = ()
    idle: float = 90.0
    path: Path | None = None
    bench: Bench | WholeFits | None = None
    n_row: int = 0
    findings: list[Finding] = field(default_factory=list)
    stopped: Callable[[], bool] = lambda: False

    def __post_init__(self) -> None:
        hints = {"frf": "say what the excitation is", "identify": "name what is wanted"}
        for key, section in (("frf", self.pipeline.frf), ("identify", self.pipeline.fits)):
            if not section:
                raise ConfigError(f"{key}: is missing", self.pipeline.path, hints[key])
        self._calibration, self._screen = Calibration(self.rig), channel_screen(self.rig)
        self._head: list[FloatArray] = []
        self._rate: float | None = None
        self._last_time: float | None = None

    def updates(self) -> Iterator[Update]:
        """What each new average changes, until the source ends, rests too long, or *stopped* says so."""
        rested, waited = 0.0, (time.monotonic(), 0)
        try:
            while not self.stopped():
                if (rows := self.stream.read()) is None:
                    break
                if not rows.shape[0]:
                    if rested >= self.idle or (rested > 1.0 and self.path and is_old(self.path, self.idle)):
                        break
                    time.sleep(PAUSE)
                    rested += PAUSE
                    waited = (time.monotonic(), self.n_row)
                    continue
                rested = 0.0
                for update in self._take(rows):
                    yield replace(update, findings=(*update.findings, *self._behind(*waited)))
            yield from self._end()
        finally:
            for open_one in (self.stream, self.bench):
                if isinstance(open_one, Frames | WholeFits):
                    open_one.close()

    def _behind(self, since: float, done: int) -> list[Finding]:
        """What is said of a late picture; *done* samples were all there were at the time *since* [s]."""
        if self._rate is None:
            return []
        lag = time.monotonic() - since - (self.n_row - done) / self._rate
        message = f"the picture is {lag:.0f} s behind the samples; none is lost"
        return [note("behind", message)] if lag > BEHIND else []

    def _take(self, rows: FloatArray) -> Iterator[Update]:
        if self.bench is None:
            self._head.append(rows)
            if not self._begin():
                return
            rows, self._head = np.concatenate(self._head), []
            if self.findings:
                yield Update(0, findings=tuple(self.findings))
        assert self.bench is not None and self._rate is not None
        stated = self.stream.sample_rate
        if stated and not self.rig.time and abs(stated / self._rate - 1) > SAME_RATE:
            what = f"samples come at {stated:g} Hz, {self._rate:g} Hz by the rig file or what came before"
            raise DataError(what, self.path or "", "leave sample_rate out of the rig file, or correct it")
        if self.stream.restarted:
            self.bench.restart()
        for piece in self._skip_gaps(rows):
            block = self._calibration.with_sums(self._calibration.to_si(piece))
            measured = block[:, : len(self.rig.channels)]
            if np.isfinite(measured).all():
                self._screen.add(measured)
            self.n_row += piece.shape[0]
            for update in self.bench.add(block):
                kept = self.stream.kept if isinstance(self.stream, Frames) else None
                more = (*self._screen.findings(), *(kept.findings(self._rate) if kept else ()))
                yield replace(update, findings=(*update.findings, *self.findings, *more))

    def _begin(self) -> bool:
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
        wanted = self._fits_with_goals(fits, followed, rate)
        # A fit that nobody waits for is left to the run at the end.
        whole = [fit for fit in fits if fit not in followed and (not followed or fit.name in wanted)]
        self.findings += [
            _unfollowed_finding(fit.name, reasons[fit.name], fit in whole)
            for fit in fits
            if fit not in followed
        ]
        self._rate = rate
        observed = [fit for fit in fits if fit in whole or fit.name in wanted] if whole else followed
        self.bench = (WholeFits if whole else Bench)(channels, rate, frf, observed, self.goals)
        return True

    def _fits_with_goals(
        self, fits: Sequence[FitSettings], followed: Sequence[FitSettings], rate: float
    ) -> set[str]:
        """The fits that a goal is set for; one that names no fit is for all that have its coefficient, and,
        if no fit that is followed has it, for all whose coefficients are only known by their values.
        """
        linear = [fit for fit in fits if fit.kind.equations is not None]
        layout = layout_of(self.rig.all_channels, rate) if linear else None
        names = {fit.name: names_of_fit(fit, layout) for fit in linear if layout is not None}
        coefficients = {name for fit in followed for name in names.get(fit.name, ())}
        return {goal.fit for goal in self.goals} | {
            fit.name
            for fit in fits
            for goal in self.goals
            if not goal.fit and (goal.name in names.get(fit.name, ()) or goal.name not in coefficients)
        }

    def _skip_gaps(self, rows: FloatArray) -> Iterator[FloatArray]:
        if not self.rig.time:
            yield rows
            return
        assert self._rate is not None
        times = rows[:, 0] * self.rig.time_scale
        before = times[0] - 1 / self._rate if self._last_time is None else self._last_time
        steps = np.diff(times, prepend=before) * self._rate
        gaps = np.flatnonzero((steps > GAP) | (steps <= 0))
        for place in gaps:
            missing = f"{steps[place] - 1:.0f} samples are missing"
            what = missing if steps[place] > 0 else "the clock restarted"
            self.findings.append(Finding("gap", f"{what} at {times[place]:.3f} s; averages restart there"))
        self._last_time = float(times[-1])
        begin = 0
        for end in (*gaps.tolist(), rows.shape[0]):
            if end > begin:
                yield rows[begin:end, 1:]
            if end < rows.shape[0] and self.bench is not None:
                self.bench.restart()
            begin = end

    def _end(self) -> Iterator[Update]:
        if isinstance(self.bench, WholeFits):
            for update in self.bench.look():
                yield replace(update, findings=(*update.findings, *self.findings))
        if self.bench is None or not self.bench.updates:
            raise DataError("the source ended before it held enough samples", hint="is it the right one?")

    @property
    def what(self) -> str:
        """What an average is, once the test has begun."""
        return self.bench.what if self.bench else ""

    @property
    def seen(self) -> list[Update]:
        """All updates so far."""
        return self.bench.updates if self.bench else []

    @property
    def recorded(self) -> list[Path]:
        """The files that the whole test stands in, for the run at its end."""
        if isinstance(self.stream, Folder):
            return list(self.stream.files)
        return [] if self.path is None else [self.path]


def _unfollowed_finding(fit: str, reason: str, whole: bool) -> Finding:
    instead = "it is made once the test has ended"
    if whole:
        more, early = (f"{100 * (look - 1):.0f} %" for look in (NEXT_LOOK, EARLY_LOOK))
        instead = "it is computed again from all samples where a goal is due, at the latest after "
        instead += f"{more} more ({early} before average {LEAST_WHOLE})"
    return note("not-followed", f"{fit} cannot be followed average by average: {reason}; {instead}")
