"""The page of a running test in a browser: on this machine alone, behind a token, read only."""

from __future__ import annotations

import queue
import secrets
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlsplit

from labpipe.document.html_page import render_html
from labpipe.report.document import Document

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
        """Take the place of what was shown."""
        self._html = render_html(document).encode()
        with self._lock:
            for listener in self._listeners:
                if listener.empty():
                    listener.put(True)

    def close(self) -> None:
        """Serve no more."""
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
            # The page was closed.
            pass
        finally:
            with self._lock:
                self._listeners.remove(news)
