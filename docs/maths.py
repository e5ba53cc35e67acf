r"""Formulas of the pages: `$...$` within a line and `$$...$$` by itself, in LaTeX, become MathML, which
browsers draw without a script.

MathML and not a script as MathJax or KaTeX: nothing is fetched or run when a page is read, no font is
shipped, and a formula that is wrong ends the build, not the reader's page. math-core makes it: it knows the
part of MathML that browsers draw, and stops at a command or an environment that it does not know
(latex2mathml lets them through). Code is left alone; a dollar sign is written `\$`.

A line ahead of a `$$` block gives the equation a label and says which public names of labpipe compute it:

    {{ equation frf-h1 | labpipe.spectra.random.h1, labpipe.spectra.random.hv }}
    $$ H_1 = S_{yu} S_{uu}^{-1} $$
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import NoReturn

FENCE = re.compile(r"\s*(?:[-*+] |\d+\. )?\s*(`{3,}|~{3,})")
# Below these an indented line is a paragraph of theirs and not code: lists, admonitions, footnotes.
OWNERS = re.compile(r"\s*(?:[-*+]|\d+\.)\s|[!?]{3}|\[\^")
# A label has words between hyphens, so that `Equation (12)` of a book is none.
LABEL = r"[a-z]\w*(?:-\w+)+"
CITATION = rf"\b[Ee]quations?\s+\({LABEL}\)(?:(?:,|\s+and|,\s+and)\s+\({LABEL}\))*"
FORMULA = r"(?:\\.|[^$\\])+?"
TOKEN = re.compile(
    r"(?P<code>(?<!`)(?P<ticks>`+)(?!`).+?(?<!`)(?P=ticks)(?!`)|<(?P<tag>pre|code|script)\b.*?</(?P=tag)>|<!--.*?-->|\\\\)"
    r"|(?P<dollar>\\\$)"
    rf"|(?P<display>(?:^\{{\{{ equation (?P<label>{LABEL}) \| (?P<by>[\w., ]+?) \}}\}}[ \t]*\n)?"
    rf"\$\$(?P<block>{FORMULA})\$\$)"
    rf"|(?P<cited>{CITATION})"
    rf"|(?P<inline>\$(?=\S)(?P<within>{FORMULA})(?<=\S)\$(?!\d)(?P<behind>[.,;:)]*))"
    r"|(?P<wrong>\$|^\{\{ equation\b[^\n]*)",
    re.DOTALL | re.MULTILINE,
)
# Letters between the tags of a formula that Markdown would read.
ACTIVE = re.compile(r"[*_`|\\\[\]~^#!](?=[^<>]*<)")


@dataclass(frozen=True)
class Equations:
    """Where the labels of equations stand, and where the public names of labpipe are documented: page and
    name of the anchor.
    """

    labels: Mapping[str, str]
    names: Mapping[str, str]


class FormulaError(ValueError):
    """A formula that cannot be rendered."""


def mathml(formula: str, display: bool = False) -> str:
    """A formula in LaTeX as one line of MathML; FormulaError says what is wrong with it."""
    from math_core import LatexError, LatexToMathML

    try:
        made = LatexToMathML(fancy_error=False).convert_with_local_state(
            " ".join(formula.split()), displaystyle=display
        )
    except LatexError as error:
        raise FormulaError(str(error).partition(": ")[2].rstrip(".")) from error
    return ACTIVE.sub(lambda letter: f"&#{ord(letter[0])};", made)


def labels_of(pages: Mapping[str, str]) -> dict[str, str]:
    """Label -> page of every equation of the pages, path -> text; SystemExit at a label given twice."""
    found: dict[str, str] = {}
    for page, text in pages.items():
        for start, block in paragraphs(text):
            for token in TOKEN.finditer(block):
                if token["label"] in found:
                    stop(
                        page,
                        start,
                        block,
                        token,
                        f"the label '{token['label']}' is given twice, first in {found[token['label']]}",
                    )
                if token["label"]:
                    found[token["label"]] = page
    return found


def with_maths(page: str, text: str, known: Equations) -> str:
    """The page with its formulas in MathML; SystemExit with page, line and formula where one cannot be
    rendered.

    *page* is its path below the folder of pages; names and labels link to their pages from there.
    """
    lines = text.splitlines(keepends=True)
    for start, block in paragraphs(text):
        replaced = TOKEN.sub(
            lambda token, at=start, whole=block: _rendered(page, at, whole, token, known), block
        )
        if replaced != block:
            count = len(block.splitlines())
            lines[start : start + count] = [replaced, *[""] * (count - 1)]
    return "".join(lines)


def paragraphs(text: str) -> Iterator[tuple[int, str]]:
    """(number of the first line from 0, text) of every stretch between blank lines that is no code."""
    lines = text.splitlines(keepends=True)
    start, fence, owner, blank = 0, "", "", True
    for number, line in enumerate([*lines, "\n"]):
        marks = FENCE.match(line)
        code = (
            bool(fence)
            or marks is not None
            or (blank and line.startswith("    ") and not OWNERS.match(owner))
        )
        if marks is not None and (
            not fence or (marks[1].startswith(fence) and not line.strip(" \t\n" + fence[0]))
        ):
            fence = "" if fence else marks[1]
        if code or not line.strip():
            if start < number:
                yield start, "".join(lines[start:number])
            start = number + 1
        blank = not line.strip() or (code and blank)
        owner = line if line.strip() and not line.startswith("    ") else owner


def _rendered(page: str, start: int, block: str, token: re.Match[str], known: Equations) -> str:
    """What stands in a page in place of a token."""
    if token["code"]:
        return token[0]
    if token["dollar"]:
        return "&#36;"
    if token["cited"]:
        return linked(token[0], lambda label: _link(page, start, block, token, label, known))
    if token["wrong"]:
        stop(page, start, block, token, _fault(token[0]))
    formula = token["block"] or token["within"]
    try:
        made = mathml(formula, display=token["display"] is not None)
    except FormulaError as error:
        stop(page, start, block, token, f"{error} in the formula {' '.join(formula.split())}")
    if token["inline"]:
        # Within a span, as Markdown takes <math> at the beginning of a line for a block; with what must not
        # begin the next line.
        return f'<span class="math">{made}{token["behind"]}</span>'
    if token["label"]:
        return _equation(token["label"], made, _computed(page, start, block, token, known))
    alone = token.start() == 0 or block[token.start() - 1] == "\n"
    return f'\n\n<div class="equation">{made}</div>\n\n' if alone else f'<span class="equation">{made}</span>'


def _fault(found: str) -> str:
    if found == "$":
        return "a $ without its partner; a dollar sign is written \\$"
    return (
        f"'{found}' is not '{{{{ equation LABEL | labpipe.MODULE.NAME, ... }}}}' on the line above a $$ "
        "block, with a hyphen in LABEL"
    )


def _equation(label: str, made: str, computed: str) -> str:
    number = f'<a class="number" href="#{label}">({label})</a>'
    return (
        f'\n\n<div class="equation" id="{label}">{made}{number}</div>\n\ncomputed by {computed}\n{{: '
        ".computed }\n\n"
    )


def _computed(page: str, start: int, block: str, token: re.Match[str], known: Equations) -> str:
    """Links to the reference of the names that compute an equation."""
    links = []
    for name in (one.strip() for one in token["by"].split(",")):
        if name not in known.names:
            stop(page, start, block, token, f"labpipe has no public name '{name}'")
        links.append(f"[`{name}`]({way(page, known.names[name])}#{name})")
    return ", ".join(links)


def _link(page: str, start: int, block: str, token: re.Match[str], label: str, known: Equations) -> str:
    if label not in known.labels:
        stop(page, start, block, token, f"no page has an equation '{label}'")
    return f"[({label})]({way(page, known.labels[label])}#{label})"


def linked(citation: str, link: Callable[[str], str]) -> str:
    """`Equation (label)`, and several of them, with each label as the link that *link* makes of it."""
    return re.sub(rf"\(({LABEL})\)", lambda found: link(found[1]), citation)


def way(page: str, other: str) -> str:
    """The relative path from a page to another one."""
    here, there = PurePosixPath(page).parent.parts, PurePosixPath(other).parts
    same = next(
        (n for n, pair in enumerate(zip(here, there[:-1], strict=False)) if pair[0] != pair[1]),
        min(len(here), len(there) - 1),
    )
    return "/".join([*[".."] * (len(here) - same), *there[same:]])


def stop(page: str, start: int, block: str, token: re.Match[str], said: str) -> NoReturn:
    """End the build with page, line and what is wrong."""
    raise SystemExit(f"docs/pages/{page}:{start + 1 + block.count(chr(10), 0, token.start())}: {said}")
