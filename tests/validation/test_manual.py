"""The validation manual: every row is computed again and is the one on the committed page, numbers to one
unit of their last digit.
"""

from __future__ import annotations

import pytest

from tests.validation.claims import KINDS, MEASURED, OF_OTHERS, Check, Method
from tests.validation.methods import METHODS
from tests.validation.page import (
    GAP,
    HEAD,
    MARK,
    MISS,
    PAGES,
    STATES,
    WORDS,
    same_line,
    same_text,
    section_table,
)

CHECKS = [
    pytest.param(
        method,
        section,
        check,
        id=f"{method.name}: {section}",
        marks=[pytest.mark.long] if section in method.long else [],
    )
    for method in METHODS
    for section, check in method.checks.items()
]

STALE = "the words are not those of words/; make the pages again: python -m tests.validation"


def committed_tables(method: Method) -> dict[str, str]:
    """The tables of a committed page by section; the words around them are those of `words/`."""
    page = (PAGES / f"{method.name}.md").read_text(encoding="utf-8")
    words = MARK.split((WORDS / f"{method.name}.md").read_text(encoding="utf-8"))
    assert words[1::2] == list(method.checks)
    assert page.startswith(words[0]) and page.endswith(words[-1]), f"{method.name}.md: {STALE}"
    tables, rest = {}, page.removeprefix(words[0]).removesuffix(words[-1])
    for section, after in zip(words[1:-2:2], words[2:-1:2], strict=True):
        # Between two marks without words the next table begins after an empty line.
        tables[section], found, rest = rest.partition(after if after.strip() else "\n\n| ")
        assert found, f"{method.name}.md, after '{section}': {STALE}"
        rest = rest if after.strip() else f"| {rest}"
    return {**tables, words[-2]: rest}


@pytest.mark.parametrize(("method", "section", "check"), CHECKS)
def test_rows_are_those_of_the_committed_page(method: Method, section: str, check: Check) -> None:
    claims = check()
    assert all(claim.why for claim in claims if claim.state != "holds")
    difference = same_text(section_table(claims), committed_tables(method)[section])
    assert not difference, (
        f"{method.name}.md, {section}, {difference}\nmake the pages again: python -m tests.validation"
    )


def rows_of(table: str, head: tuple[str, ...]) -> list[dict[str, str]]:
    lines = [line for line in table.splitlines() if line.startswith("|")]
    if not lines or cells(lines[0]) != head:
        return []
    return [dict(zip(head, cells(line), strict=True)) for line in lines[2:]]


def cells(line: str) -> tuple[str, ...]:
    return tuple(cell.strip() for cell in line.replace("\\|", "\0").strip("|").split("|"))


def all_rows() -> tuple[list[dict[str, str]], list[dict[str, str]]]:
    """Rows and gaps of all pages, with the link to their page."""
    rows, gaps = [], []
    for method in METHODS:
        link = {"method": f"[{method.title}]({method.name}.md)"}
        for table in committed_tables(method).values():
            rows += [{**link, **row} for row in rows_of(table, HEAD)]
            gaps += [{**link, **row} for row in rows_of(table, GAP)]
    return rows, gaps


def section(title: str) -> str:
    page = (PAGES / "index.md").read_text(encoding="utf-8")
    return page.partition(f"## {title}\n")[2].partition("\n## ")[0]


def kind_of(row: dict[str, str]) -> str:
    return row["against"].partition(":")[0]


def test_the_first_page_holds_all_rows_of_all_pages_and_the_misses_first() -> None:
    rows, gaps = all_rows()
    assert rows_of(section("All rows"), ("method", *HEAD)) == rows
    assert rows_of(section("Not tested"), ("method", *GAP)) == gaps
    misses = rows_of(section("Misses first"), ("method", *MISS))
    assert all(row["why"] for row in misses)
    shared = ("method", *(name for name in MISS if name in HEAD))
    assert [[row[name] for name in shared] for row in misses] == [
        [row[name] for name in shared] for row in rows if row["state"] != "holds"
    ]


def test_the_counts_are_those_of_the_rows() -> None:
    rows, gaps = all_rows()
    page = (PAGES / "index.md").read_text(encoding="utf-8").partition("\n## ")[0]
    head = ("kind", *STATES, "rows", "what it is")
    groups = [*((kind,) for kind in KINDS), tuple(KINDS), OF_OTHERS, MEASURED]
    counted = rows_of(page, head)
    assert len(counted) == len(groups)
    for line, kinds in zip(counted, groups, strict=True):
        states = ["holds" if row["state"] == "holds" else "fails" for row in rows if kind_of(row) in kinds]
        states += ["not tested" for gap in gaps if kind_of(gap) in kinds]
        assert [line[state] for state in STATES] == [str(states.count(state)) for state in STATES]
        assert line["rows"] == str(len(states))


def test_a_last_digit_may_differ_and_no_more() -> None:
    assert same_line("| 212.10 | holds |", "| 212.11 | holds |")
    assert not same_line("| 212.10 | holds |", "| 212.12 | holds |")
    assert not same_line("| 212.10 | holds |", "| 212.10 | fails |")
    assert same_line("| -0.00 |", "| +0.00 |")
