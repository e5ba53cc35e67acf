"""A running test as people read it: its course in the section live, rows, sentences, figures, and a page in
the browser.
"""

from __future__ import annotations

import math
import secrets
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlsplit

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.cli.many import duration
from labpipe.display import amount_text, count_text, difference_in, per_cent, shown_unit, unit_label
from labpipe.document.html_page import page_part, render_html
from labpipe.estimation.settings import FitSettings
from labpipe.methods.live.bench import Bench, obstacle
from labpipe.methods.live.charts import Goal, Standing, Update
from labpipe.methods.live.session import Session
from labpipe.methods.live.sources import MOST_ROWS
from labpipe.project.ingest import ingest, unique_names
from labpipe.project.tests import Test
from labpipe.project.work import Work
from labpipe.quantities import to_display
from labpipe.records.identification import Identification
from labpipe.records.sections import PipelineSection
from labpipe.records.settings import Settings, names
from labpipe.report.chart import Axis, Panel, curve, level, stack
from labpipe.report.document import Block, Document, Figure, Paragraph, Section, Table
from labpipe.report.figures import fitted_curve_figure, response_figure
from labpipe.spectra.settings import FrfSettings

# Coefficients that are drawn where nothing is asked for.
DRAWN = 4


@dataclass(frozen=True)
class LiveSettings(Settings):
    """What a test is to reach."""

    until: tuple[str, ...] = names(
        "goals, each on the width of an interval: k.expanded<=1%", may_be_empty=True
    )
    test: tuple[str, ...] = names("tests whose course is shown; default: all")

    def __post_init__(self) -> None:
        for text in self.until:
            Goal.of(text)

    @property
    def goals(self) -> list[Goal]:
        return [Goal.of(text) for text in self.until]


@dataclass(frozen=True)
class CoefficientCourse:
    """A coefficient's *value* and *half*-width (n,) [unit] after so many *averages* (n,), and its *goal*."""

    name: str
    unit: str
    averages: FloatArray
    value: FloatArray
    half: FloatArray
    goal: float | None = None


@dataclass(frozen=True)
class LiveCourse:
    """The course of a *test* of so many *averages* (each a *what*: period or hit); *enough*: after how many
    every goal was reached; *left_out*: averages that do not count, with their reason.
    """

    test: str
    what: str
    averages: int
    coefficients: tuple[CoefficientCourse, ...]
    goals: tuple[str, ...] = ()
    enough: int | None = None
    left_out: tuple[str, ...] = ()


Courses = tuple[LiveCourse, ...]


def coefficients_of(updates: Sequence[Update]) -> tuple[CoefficientCourse, ...]:
    """Every coefficient that is asked for, or the first of them, over the averages."""
    there = [update for update in updates if update.standings]
    if len(there) < 2:
        return ()
    last = there[-1].standings
    wanted = [name for name, standing in last.items() if standing.goal is not None] or list(last)[:DRAWN]
    courses = []
    for name in wanted:
        finite = [u for u in there if name in u.standings and math.isfinite(u.standings[name].half)]
        if len(finite) >= 2:
            n = np.array([u.averages for u in finite], float)
            value = np.array([u.standings[name].parameter.value for u in finite])
            half = np.array([u.standings[name].half for u in finite])
            course = CoefficientCourse(name, last[name].parameter.unit, n, value, half, last[name].goal)
            courses.append(course)
    return tuple(courses)


def course_figure(coefficients: Sequence[CoefficientCourse]) -> Figure:
    panels = []
    for course in coefficients:
        unit = shown_unit(course.unit, float(course.value[-1]), None)
        value = np.array([to_display(number, unit) for number in course.value])
        half = np.array([difference_in(number, unit) for number in course.half])
        series = [curve(course.name, course.averages, value, band=(value - half, value + half), marker=".")]
        if course.goal is not None:
            width = difference_in(course.goal, unit)
            series += [level(value[-1] + sign * width, name="goal") for sign in (-1, 1)]
        panels.append(Panel(Axis("averages"), Axis(course.name, unit_label(unit)), tuple(series)))
    caption = (
        "Coefficients with their 95 % intervals after each average; lines: the goal around the last value."
    )
    return Figure(stack(panels, 1.8 * len(panels) + 0.8), caption, "Coefficients over the averages")


def run_live(settings: LiveSettings, work: Work) -> Courses:
    """The course of every test whose fits can be followed average by average."""
    courses = []
    # The names that the run gives to calibrated recordings.
    names = iter(unique_names([s.path for test in work.pipeline.tests for s in test.recordings]))
    for test in work.pipeline.tests:
        of_test = [next(names) for _ in test.recordings]
        frf = test.frf or work.pipeline.frf
        fits = [fit for fit in work.pipeline.fits if not fit.test or test.name in fit.test]
        chosen = not settings.test or test.name in settings.test
        if chosen and fits and test.recordings and frf is not None:
            courses += _course(test, frf, fits, settings, work, of_test)
    return tuple(courses)


def _course(
    test: Test,
    frf: FrfSettings,
    fits: Sequence[FitSettings],
    settings: LiveSettings,
    work: Work,
    names: Sequence[str],
) -> list[LiveCourse]:
    """The course of a test, none where no fit of it can be followed."""
    bench: Bench | None = None
    enough, left_out = None, []
    for source, name in zip(test.recordings, names, strict=True):
        recording = ingest(source, work.output, f"recordings/{name}", work.pipeline.folder)
        if bench is None:
            channels, rate = recording.channels, recording.sample_rate
            plain = [replace(fit, test=()) for fit in fits if not obstacle(fit, frf, channels, rate)]
            if not plain:
                return []
            bench = Bench(recording.channels, recording.sample_rate, frf, plain, settings.goals)
        else:
            bench.restart()
        for block in recording.blocks(MOST_ROWS):
            for update in bench.add(block):
                if update.stop and enough is None:
                    enough = update.averages
                left_out += [event for event in update.events if "left out" in event]
    assert bench is not None
    what, n, coefficients = bench.what, bench.averages, coefficients_of(bench.updates)
    return [LiveCourse(test.name, what, n, coefficients, settings.until, enough, tuple(left_out))]


def course_lines(courses: Courses) -> Iterator[str]:
    for course in courses:
        yield f"live{f' {course.test}' if course.test else ''}: {_sentence(course)}"


def _sentence(course: LiveCourse) -> str:
    count = count_text(course.averages, course.what)
    if not course.goals:
        return f"{count}, no goal was set"
    goals = f"the goals ({', '.join(course.goals)})"
    if course.enough is None:
        return f"{goals} were not reached within {count}"
    return f"{goals} were reached after {course.enough} of {count}"


def course_sections(courses: Courses, _identification: Identification) -> tuple[Section, ...]:
    """The course of each test: a sentence, a figure, the averages that do not count."""
    sections = []
    for course in courses:
        sentence = _sentence(course)
        blocks: list[Block] = [Paragraph(f"{sentence[0].upper()}{sentence[1:]}.", "note")]
        if course.coefficients:
            blocks.append(course_figure(course.coefficients))
        blocks += [Paragraph(event, "warning") for event in course.left_out]
        title = f"Course of the test {course.test}".strip()
        sections.append(Section(title, tuple(blocks)))
    return tuple(sections)


LIVE = PipelineSection(
    words="What a test is to reach, and its course average by average.",
    settings=LiveSettings,
    run=run_live,
    record=Courses,
    entry="courses",
    report=course_sections,
    terminal=course_lines,
)


HEADER = ("coefficient", "value and 95 % interval", "goal", "still to come")


def left_text(standing: Standing, update: Update, what: str) -> str:
    """How long it still takes: 11 more hits, about 4 min (80 %: 8-15)."""
    if standing.goal is None:
        return ""
    if standing.reached:
        return "reached"
    left = standing.remaining
    if left is None or left.expected is None:
        return "not by more averages" if left is not None else ""
    more = max(left.expected - update.averages, 1)
    text = f"{count_text(more, f'more {what}')}, about {duration(more * update.seconds)}"
    if left.low is not None and left.high is not None:
        low, high = (max(n - update.averages, 0) for n in (left.low, left.high))
        text += f" (80 %: {low}-{high}); at twice the level {-(-more // 4)}"
    return text + (f"; {left.others.text(what)}" if left.others and left.others.more < more else "")


def level_text(session: Session, name: str, size: float) -> str:
    """The largest size of a channel in its unit, and its share of the range where the rig states one."""
    units = {channel.name: channel.unit for channel in session.rig.all_channels}
    unit = shown_unit(units[name], size, None)
    text = f"{difference_in(size, unit):.3g} {unit_label(unit)}"
    of_rig = {channel.channel.name: channel for channel in session.rig.channels}.get(name)
    if of_rig is None or of_rig.limits is None:
        return text
    reach = abs((of_rig.limits[1] - of_rig.limits[0]) * of_rig.scale)
    return f"{text} ({200 * size / reach:.0f} % of its range)"


def rows_of(session: Session, update: Update) -> list[tuple[str, str, str, str]]:
    """Coefficient, value with its interval, goal, what is left; those asked for first."""
    rows = []
    for name, standing in sorted(update.standings.items(), key=lambda entry: entry[1].goal is None):
        value, unit = standing.parameter.value, standing.parameter.unit
        goal = "" if standing.goal is None else f"± {per_cent(standing.goal / abs(value))}"
        half = standing.half if math.isfinite(standing.half) else None
        rows.append((name, amount_text(value, half, unit), goal, left_text(standing, update, session.what)))
    return rows


def headline(session: Session, update: Update) -> str:
    """One sentence: where the test stands."""
    count = count_text(update.averages, session.what)
    if update.stop:
        return f"Enough: {count}, every goal is reached."
    goals = [standing for standing in update.standings.values() if standing.goal is not None]
    missing = sum(not standing.reached for standing in goals)
    left = "No goal is set." if not session.goals else "It is too early to judge the goals."
    left = f"{missing} of {len(goals)} goals are not reached yet." if goals else left
    return f"{count}. {left}"


def course(session: Session, update: Update) -> Document:
    blocks: list[Block] = [Paragraph(headline(session, update), "passed" if update.stop else "note")]
    blocks += [Paragraph(f"{finding.code}: {finding.message}", "warning") for finding in update.findings]
    rows = rows_of(session, update)
    if rows:
        holds = "Intervals hold at this moment: of noise, model error and stated uncertainties"
        blocks.append(Table(HEADER, tuple(rows), holds))
    sections = [Section("Where the test stands", tuple(blocks))]
    coefficients = coefficients_of(session.seen)
    figures = [course_figure(coefficients)] if coefficients else []
    figures += _responses(session)
    if figures:
        sections.append(Section("Course of the test", tuple(figures)))
    came: list[Block] = []
    if update.levels:
        levels = tuple((name, level_text(session, name, size)) for name, size in update.levels.items())
        came.append(Table(("channel", "largest size"), levels, "Levels of the last average"))
    events = [event for earlier in session.seen for event in earlier.events]
    if events:
        came.append(Table(("average",), tuple((event,) for event in events[-40:]), "The last averages"))
    if came:
        sections.append(Section("What came in", tuple(came)))
    return Document(session.pipeline.title, "while it runs", tuple(sections), to_sign=False)


def _responses(session: Session) -> Iterator[Figure]:
    for fit in session.bench.fits if isinstance(session.bench, Bench) else ():
        response = None if fit.estimate is None else fit.response()
        if response is not None and response.variance is not None:
            noise = response.averages * response.variance / np.abs(response.matrix) ** 2
            yield response_figure(replace(response, name=fit.settings.name, coherence=1 / (1 + noise)))
        if fit.by_run is not None and fit.by_run.curve is not None:
            yield fitted_curve_figure(fit.by_run, fit.by_run.curve)


ADDRESS = "127.0.0.1"
# A page that does not listen is told so every so many seconds.
HEARTBEAT = 15.0


class Page:
    """Serves the latest document and tells open pages when there is a new one."""

    def __init__(self, port: int = 0) -> None:
        self.token = secrets.token_urlsafe(16)
        self._html = b""
        self._number, self._news = 0, threading.Condition()
        page = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                page.answer(self)

            def log_message(self, format: str, *args: object) -> None:
                """Say nothing."""

        self._server = ThreadingHTTPServer((ADDRESS, port), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def address(self) -> str:
        """Where a browser of this machine finds the page."""
        return f"http://{ADDRESS}:{self._server.server_port}/?token={self.token}"

    def show(self, document: Document) -> None:
        self._html = render_html(document).encode()
        with self._news:
            self._number += 1
            self._news.notify_all()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        """One request: the shell, the state, or the stream of news; nothing without the token."""
        parts = urlsplit(request.path)
        token = parse_qs(parts.query).get("token", [""])[0]
        host = (request.headers.get("Host") or "").rpartition(":")[0]
        # Another name for this address is another site's, which may not read the page.
        is_own = host in (ADDRESS, "localhost")
        if not is_own or not secrets.compare_digest(token.encode(), self.token.encode()):
            request.send_error(HTTPStatus.FORBIDDEN)
        elif parts.path == "/":
            self._send(request, page_part("live.html").encode())
        elif parts.path == "/state":
            self._send(request, self._html)
        elif parts.path == "/events":
            self._events(request)
        else:
            request.send_error(HTTPStatus.NOT_FOUND)

    @staticmethod
    def _send(request: BaseHTTPRequestHandler, content: bytes = b"", kind: str = "text/html") -> None:
        request.send_response(HTTPStatus.OK)
        headers = {"Content-Type": f"{kind}; charset=utf-8", "Cache-Control": "no-store"}
        headers |= {"Content-Length": str(len(content))} if content else {}
        for name, value in {**headers, "Referrer-Policy": "no-referrer"}.items():
            request.send_header(name, value)
        request.end_headers()
        request.wfile.write(content)

    def _events(self, request: BaseHTTPRequestHandler) -> None:
        self._send(request, kind="text/event-stream")
        seen = self._number
        while True:
            with self._news:
                if self._number == seen:
                    self._news.wait(HEARTBEAT)
                is_new, seen = self._number != seen, self._number
            try:
                request.wfile.write(b"data: new\n\n" if is_new else b": still here\n\n")
            except OSError:
                return
