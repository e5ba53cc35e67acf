"""A running test as people read it: rows, sentences, figures, and a page in the browser."""

from __future__ import annotations

import math
import queue
import secrets
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlsplit

import numpy as np

from labpipe.display import difference_in, shown_unit, unit_label, with_error
from labpipe.document.html_page import render_html
from labpipe.methods.live.bench import Bench, FollowedFit
from labpipe.methods.live.charts import Standing, Update, at_twice_the_level
from labpipe.methods.live.course import coefficients_of, course_figure
from labpipe.methods.live.session import Session
from labpipe.quantities import to_display
from labpipe.records.finding import NORMAL
from labpipe.report.chart import Axis, Panel, Series, curve, stacked
from labpipe.report.document import Block, Document, Figure, Paragraph, Section, Table

# Points of a fitted curve between its first and last line.
DENSE = 400


def value_text(standing: Standing) -> str:
    """A coefficient with its interval: 134.50 ± 0.12 kN/m."""
    parameter = standing.parameter
    unit = shown_unit(parameter.unit, parameter.value, None)
    half = difference_in(standing.half, unit) if math.isfinite(standing.half) else None
    return with_error(to_display(parameter.value, unit), half, unit)


def goal_text(standing: Standing) -> str:
    """The width that is asked for, relative to the value."""
    if standing.goal is None:
        return ""
    return f"± {100 * standing.goal / abs(standing.parameter.value):.2g} %"


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
    text = f"{more} more {what}{'s' if more != 1 else ''}, about {duration(more * update.seconds)}"
    if left.low is not None and left.high is not None:
        text += f" (80 %: {max(left.low - update.averages, 0)}-{left.high - update.averages})"
    return text + (f"; at twice the level {at_twice_the_level(more)}" if left.low is not None else "")


def level_text(session: Session, name: str, size: float) -> str:
    """The largest size of a channel in its unit, and its share of the range where the rig states one."""
    unit = shown_unit(next(one.unit for one in session.rig.all_channels if one.name == name), size, None)
    text = f"{difference_in(size, unit):.3g} {unit_label(unit)}"
    of_rig = {channel.channel.name: channel for channel in session.rig.channels}.get(name)
    if of_rig is None or of_rig.limits is None:
        return text
    reach = abs((of_rig.limits[1] - of_rig.limits[0]) * of_rig.scale)
    return f"{text} ({200 * size / reach:.0f} % of its range)"


def duration(seconds: float) -> str:
    """A time as one says it: 40 s, 4 min, 2.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def what_of(session: Session) -> str:
    """What an average of the test is."""
    frf = session.pipeline.frf
    assert frf is not None
    return {"impact": "hit", "periodic": "period", "decay": "decay"}.get(frf.excitation, "average")


def rows_of(session: Session, update: Update) -> list[tuple[str, str, str, str]]:
    """Coefficient, value with its interval, goal, what is left; those asked for first."""
    what = what_of(session)
    entries = sorted(update.standings.items(), key=lambda entry: entry[1].goal is None)
    return [
        (name, value_text(standing), goal_text(standing), left_text(standing, update, what))
        for name, standing in entries
    ]


def headline(session: Session, update: Update) -> str:
    """One sentence: where the test stands."""
    what = what_of(session)
    count = f"{update.averages} {what}{'s' if update.averages != 1 else ''}"
    if update.stop:
        return f"Enough: {count}, every goal is reached."
    goals = [standing for standing in update.standings.values() if standing.goal is not None]
    missing = sum(not standing.reached for standing in goals)
    return f"{count}. " + (
        f"{missing} of {len(goals)} goals are not reached yet." if goals else "No goal is set."
    )


def course(session: Session, update: Update) -> Document:
    blocks: list[Block] = [Paragraph(headline(session, update), "passed" if update.stop else "note")]
    blocks += [Paragraph(f"{finding.code}: {finding.message}", "warning") for finding in update.findings]
    rows = rows_of(session, update)
    if rows:
        header = ("coefficient", "value and 95 % interval", "goal", "still to come")
        holds = "Intervals hold at this moment: of noise, model error and stated uncertainties"
        blocks.append(Table(header, tuple(rows), holds))
    sections = [Section("Where the test stands", tuple(blocks))]
    updates = session.bench.updates if session.bench else []
    coefficients = coefficients_of(updates)
    figures = [course_figure(coefficients)] if coefficients else []
    figures += _responses(session)
    if figures:
        sections.append(Section("Course of the test", tuple(figures)))
    came: list[Block] = []
    if update.levels:
        levels = tuple((name, level_text(session, name, size)) for name, size in update.levels.items())
        came.append(Table(("channel", "largest size"), levels, "Levels of the last average"))
    events = [event for earlier in updates for event in earlier.events]
    if events:
        came.append(Table(("average",), tuple((event,) for event in events[-40:]), "The last averages"))
    if came:
        sections.append(Section("What came in", tuple(came)))
    return Document(session.pipeline.title, "while it runs", tuple(sections), to_sign=False)


def _responses(session: Session) -> list[Figure]:
    fits = session.bench.fits if isinstance(session.bench, Bench) else []
    return [figure for fit in fits if (figure := _response(fit)) is not None]


def _response(fit: FollowedFit) -> Figure | None:
    """Measured receptances with their 95 % bands, the fitted ones, and the coherences of the averages; None
    before every direction was shaken twice.
    """
    estimate, response = fit.estimate, None if fit.estimate is None else fit.response()
    if estimate is None or response is None or response.variance is None:
        return None
    equation = fit.fit.equation
    forces = np.broadcast_to(
        np.eye(len(response.inputs)), (response.frequency.size, *2 * (equation.n_force,))
    )
    motion, _ = equation.split(np.concatenate([response.matrix.swapaxes(1, 2), forces], axis=2))
    share = response.variance / np.abs(response.matrix) ** 2
    coherence = 1 / (1 + response.averages * share)
    dense = np.linspace(equation.omega[0], equation.omega[-1], DENSE)
    fitted = np.abs(fit.model.receptance(estimate.values, dense))
    panels: list[Panel] = []
    coherences: list[Series] = []
    for row, output in enumerate(response.outputs):
        for column, force in enumerate(response.inputs):
            name, size = f"{output.label}/{force.label}", np.abs(motion[:, column, row])
            # Of an amplitude, whose error is one of both components.
            half = NORMAL * size * np.sqrt(share[:, row, column] / 2)
            ends = (np.maximum(size - half, 1e-3 * size), size + half)
            series = (
                curve("measured", response.frequency, size, line="", marker=".", band=ends),
                curve("fitted", dense / (2 * np.pi), fitted[:, row, column], colour=1),
            )
            amplitude = Axis(f"|{name}|", "m/N", logarithmic=True)
            panels.append(Panel(Axis("frequency", "Hz"), amplitude, series))
            coherences.append(
                curve(name, response.frequency, coherence[:, row, column], colour=len(coherences))
            )
    panels.append(Panel(Axis("frequency", "Hz"), Axis("coherence", low=0.0, high=1.0), tuple(coherences)))
    name, chart = fit.settings.name, stacked(panels, 1.8 * len(panels) + 0.8)
    caption = f"{name}: receptance so far with its 95 % band, the fitted model, and the coherence."
    return Figure(chart, caption, f"Measured and fitted receptance of {name}")


ADDRESS = "127.0.0.1"
# A page that does not listen is told so every so many seconds.
HEARTBEAT = 15.0
# Two frames one upon the other: the new state is shown when it is drawn, at the place that was read.
SHELL = """<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>labpipe live</title><style>
html,body{margin:0;height:100%}iframe{position:fixed;inset:0;width:100%;height:100%;border:0}
.hidden{visibility:hidden}</style></head><body><iframe id="a" title="state of the test"></iframe>
<iframe id="b" class="hidden" title="state of the test, next"></iframe><script>
let [front, back] = [document.getElementById("a"), document.getElementById("b")];
const query = location.search;
let busy = false, waiting = false, number = 0;
function load() {
  if (busy) { waiting = true; return; }
  busy = true;
  back.onload = () => {
    const place = front.contentWindow ? front.contentWindow.scrollY : 0;
    back.contentWindow.scrollTo(0, place);
    back.className = ""; front.className = "hidden";
    [front, back] = [back, front];
    document.title = front.contentDocument.title;
    busy = false;
    if (waiting) { waiting = false; load(); }
  };
  back.src = "/state" + query + "&n=" + ++number;
}
new EventSource("/events" + query).onmessage = load;
load();
</script></body></html>
"""


class Page:
    """Serves the latest document and tells open pages when there is a new one."""

    def __init__(self, port: int = 0) -> None:
        self.token = secrets.token_urlsafe(16)
        self._html = b""
        self._listeners: list[queue.Queue[bool]] = []
        self._lock = threading.Lock()
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
        with self._lock:
            for listener in self._listeners:
                if listener.empty():
                    listener.put(True)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        """One request: the shell, the state, or the stream of news; nothing without the token."""
        parts = urlsplit(request.path)
        token = parse_qs(parts.query).get("token", [""])[0]
        host = (request.headers.get("Host") or "").rpartition(":")[0]
        # Another name for this address is another site's, which may not read the page.
        if host not in (ADDRESS, "localhost") or not secrets.compare_digest(
            token.encode(), self.token.encode()
        ):
            request.send_error(HTTPStatus.FORBIDDEN)
        elif parts.path == "/":
            self._send(request, SHELL.encode())
        elif parts.path == "/state":
            self._send(request, self._html)
        elif parts.path == "/events":
            self._events(request)
        else:
            request.send_error(HTTPStatus.NOT_FOUND)

    @staticmethod
    def _send(request: BaseHTTPRequestHandler, content: bytes) -> None:
        request.send_response(HTTPStatus.OK)
        for name, value in (
            ("Content-Type", "text/html; charset=utf-8"),
            ("Content-Length", str(len(content))),
            ("Cache-Control", "no-store"),
            ("Referrer-Policy", "no-referrer"),
        ):
            request.send_header(name, value)
        request.end_headers()
        request.wfile.write(content)

    def _events(self, request: BaseHTTPRequestHandler) -> None:
        news: queue.Queue[bool] = queue.Queue()
        with self._lock:
            self._listeners.append(news)
        request.send_response(HTTPStatus.OK)
        request.send_header("Content-Type", "text/event-stream")
        request.send_header("Cache-Control", "no-store")
        request.end_headers()
        try:
            while True:
                try:
                    news.get(timeout=HEARTBEAT)
                    request.wfile.write(b"data: new\n\n")
                except queue.Empty:
                    request.wfile.write(b": still here\n\n")
                request.wfile.flush()
        except OSError:
            pass
        finally:
            with self._lock:
                self._listeners.remove(news)
