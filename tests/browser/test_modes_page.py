"""A page of modes in a browser: the structure turns and sways, and a click on the stabilisation diagram gives
the line of poles.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from labpipe.document.render import html_document
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.modal.report import modal_blocks
from labpipe.methods.modal.settings import ModalSettings
from labpipe.records.fit_details import Modes
from labpipe.records.identification import Fit
from labpipe.report.document import Document, Section
from tests.methods.modal.structures import beam, beam_geometry

STRUCTURE = "document.querySelector('figure.shapes .shape')"
MOVED = f"{STRUCTURE}.querySelector('.moved').getAttribute('d')"
DIAGRAM = "document.querySelectorAll('#figure-1 .panels > svg')[1]"


@pytest.fixture(scope="module")
def fit() -> Fit:
    settings = ModalSettings(structure=beam_geometry())
    (found,) = identify(beam(1), FitSettings("modal", name="beam", model_settings=settings))
    return found


@pytest.fixture
def page(browser: Any, fit: Fit, tmp_path: Path) -> Iterator[Any]:
    path = tmp_path / "modes.html"
    path.write_bytes(
        html_document(
            Document(
                "Modes", "", (Section("Fit", tuple(modal_blocks(fit, fit.detail(Modes)))),), to_sign=False
            )
        )
    )
    opened = browser.open(path)
    yield opened
    assert opened.said("Runtime.exceptionThrown") == []
    opened.close()


def test_the_structure_sways_stops_and_turns(page: Any) -> None:
    page.run(f"{STRUCTURE}.scrollIntoView()")
    first = page.run(MOVED)
    page.until(lambda: page.run(MOVED) != first)
    page.run(f"{STRUCTURE}.focus()")
    page.key(" ")
    still = page.run(MOVED)
    page.settle()
    assert page.run(MOVED) == still
    rest = f"{STRUCTURE}.querySelector('.rest').getAttribute('d')"
    before = page.run(rest)
    page.key("ArrowLeft")
    assert page.run(rest) != before and page.run(MOVED) != still
    page.run(
        "[...document.querySelectorAll('figure.shapes button')].find((one) => one.textContent === "
        "'Top').click()"
    )
    # From above a straight beam along x that moves along z is a straight line, whatever its phase.
    assert page.run(MOVED) == page.run(rest)


def test_another_mode_is_chosen_by_its_button(page: Any, fit: Fit) -> None:
    assert fit.detail(Modes) is not None
    buttons = "[...document.querySelectorAll('figure.shapes .mode')]"
    assert page.run(f"{buttons}.length") == fit.detail(Modes).frequency.size
    page.run(f"{buttons}[1].click()")
    assert page.run(f"{buttons}.map((one) => one.getAttribute('aria-pressed'))")[:2] == ["false", "true"]


def test_a_click_on_a_pole_gives_the_line_for_the_pipeline(page: Any, fit: Fit) -> None:
    assert fit.detail(Modes) is not None
    page.run(f"{DIAGRAM}.scrollIntoView({{block: 'center'}})")
    page.settle()
    low, high = page.run(
        "JSON.parse(document.querySelector('#figure-1 script').textContent).panels[1].x.limits"
    )
    frame = f"{DIAGRAM}.querySelector('clipPath rect')"
    left, width, top, height = page.run(
        f"(([own, box]) => [own.left + Number(box.getAttribute('x')), Number(box.getAttribute('width')),"
        " own.top + Number(box.getAttribute('y')), "
        f"Number(box.getAttribute('height'))])([{DIAGRAM}.getBoundingClientRect(), {frame}])"
    )
    chosen = "document.querySelector('#figure-1 .choice').textContent"
    for frequency in fit.detail(Modes).frequency[:2]:
        at = left + width * (frequency - low) / (high - low), top + 0.1 * height
        for kind in ("mousePressed", "mouseReleased"):
            page.mouse(kind, *at, button="left", clickCount=1)
        page.settle()
    line = page.run(chosen)
    assert line.startswith("poles: [") and line.endswith(" Hz]")
    values = [float(text.removesuffix(" Hz")) for text in line[len("poles: [") : -1].split(", ")]
    assert values == pytest.approx(fit.detail(Modes).frequency[:2], rel=2e-3)
    for kind in ("mousePressed", "mouseReleased"):
        page.mouse(kind, *at, button="left", clickCount=1)
    page.settle()
    assert page.run(chosen).count("Hz") == 1
