"""The page of a running test in a browser: it renews itself, is drawn by the page's own script, and asks
nobody else.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from labpipe.methods.live.view import CoefficientCourse, Page, course_figure
from labpipe.report.document import Document, Paragraph, Section

SHOWN = "document.querySelector('iframe:not(.hidden)').contentDocument"


def state(n: int) -> Document:
    """A test after *n* averages."""
    averages = np.arange(2.0, n + 1)
    course = CoefficientCourse("s.k", "N/m", averages, 8e4 + 10 / averages, 300 / np.sqrt(averages), 100.0)
    blocks = (Paragraph(f"{n} periods. 1 of 1 goals is not reached yet."), course_figure([course]))
    return Document("Bench", "while it runs", (Section("Course of the test", blocks),), to_sign=False)


def test_the_page_shows_the_newest_state_where_the_reader_is(browser: Any) -> None:
    live = Page()
    try:
        live.show(state(6))
        page = browser.open(live.address, height=300)
        page.until(lambda: "6 periods" in (page.run(f"{SHOWN}?.body?.innerText ?? ''")))
        page.until(lambda: page.run(f"{SHOWN}.querySelectorAll('svg path').length") > 0)
        page.run("document.querySelector('iframe:not(.hidden)').contentWindow.scrollTo(0, 40)")
        for n in (7, 8, 9):
            live.show(state(n))
        page.until(lambda: "9 periods" in page.run(f"{SHOWN}.body.innerText"))
        assert page.run("document.querySelector('iframe:not(.hidden)').contentWindow.scrollY") == 40
        requests = page.said("Network.requestWillBeSent")
        assert requests and all(
            one["request"]["url"].startswith(("http://127.0.0.1", "about:", "data:")) for one in requests
        )
        assert page.said("Runtime.exceptionThrown") == []
        page.close()
    finally:
        live.close()
