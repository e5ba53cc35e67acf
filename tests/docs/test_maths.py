"""Formulas of the pages become MathML.

What cannot be rendered, and names and labels that are not there, end the build with the place.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytest.importorskip("math_core")
sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))

import api
import maths

H1 = "labpipe.spectra.random.h1"
KNOWN = maths.Equations(
    {"frf-h1": "theory/frf.md"},
    {H1: "reference/python/spectra.md", "labpipe.spectra.random.h2": "reference/a.md"},
)


def page(text: str, name: str = "theory/frf.md") -> str:
    return maths.with_maths(name, text, KNOWN)


def test_a_formula_within_a_line_and_one_by_itself() -> None:
    """MathML 3, 3.4.1 and 3.3.2: a subscript and a fraction."""
    made = page("The mass $m_1$ is\n\n$$\n\\frac{k}{w}\n$$\n\nheavy.\n")
    assert made.startswith(
        'The mass <span class="math"><math><msub><mi>m</mi><mn>1</mn></msub></math></span> is\n'
    )
    assert (
        '<div class="equation"><math display="block"><mfrac><mi>k</mi><mi>w</mi></mfrac></math></div>' in made
    )
    assert made.endswith("heavy.\n")


@pytest.mark.parametrize(
    "code",
    [
        "`$a$` and ``$x ` $``",
        "```console\n$ labpipe run $HOME\n\n$ labpipe\n```",
        "~~~sh\n$a_{\n~~~",
        "1. First\n\n    ```console\n    $ labpipe run\n    ```\n",
        "text\n\n    $ indented\n",
        "<pre>\n$a$\n</pre>",
        "<!-- $a$ -->",
    ],
)
def test_dollar_signs_of_code_are_left_alone(code: str) -> None:
    assert page(code) == code


def test_an_indented_paragraph_of_a_list_or_an_admonition_is_text() -> None:
    assert "<math>" in page("- one\n\n    where $m$ is\n")
    assert "<math>" in page("!!! note\n\n    where $m$ is\n")


def test_a_dollar_sign_is_written_with_a_backslash() -> None:
    assert page("costs \\$5") == "costs &#36;5"


def test_markdown_reads_nothing_in_a_formula() -> None:
    """Two products in a line would be emphasis, two bars cells of a table."""
    made = page("| $a*b$ | $c*d$ | $|x|$ |")
    assert made.count("|") == 4 and "*" not in made


def test_a_formula_at_the_beginning_of_a_line_stays_in_its_paragraph() -> None:
    """Python-Markdown takes <math> there for a block.

    What is behind a formula does not begin the next line.
    """
    from markdown import markdown

    made = markdown(
        page("with the factors\n$b_x$, $b_y$, and\n$m$.\n"), extensions=["md_in_html", "attr_list", "tables"]
    )
    assert made.count("<p>") == 1 and made.count("<math>") == 3
    assert "</math>,</span>" in made and made.endswith("</math>.</span></p>")


def test_an_equation_has_an_anchor_a_number_and_the_names_that_compute_it() -> None:
    made = page(f"{{{{ equation frf-h1 | {H1}, labpipe.spectra.random.h2 }}}}\n$$ H_1 $$\n")
    assert (
        '<div class="equation" id="frf-h1"><math' in made
        and ('<a class="number" href="#frf-h1">(frf-h1)</a></div>') in made
    )
    assert (
        f"computed by [`{H1}`](../reference/python/spectra.md#{H1}), "
        "[`labpipe.spectra.random.h2`](../reference/a.md#"
    ) in made


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "one\n\ntwo\n$m_1 \\unknown$\n",
            r"docs/pages/theory/frf.md:4: Unknown command .* in the formula m_1 \\unknown",
        ),
        ("one\n\n$$\n\\frac{a}{\n$$\n", r"frf.md:3: Expected closing .* in the formula \\frac\{a\}\{"),
        ("\none $ two\n", r"frf.md:2: a \$ without its partner"),
        ("$$\na\n\nb\n$$\n", r"frf.md:1: a \$ without its partner"),
        (
            "{{ equation frf-h1 | labpipe.spectra.nothing }}\n$$ a $$\n",
            r"frf.md:1: labpipe has no public name 'labpipe.spectra.nothing'",
        ),
        (
            f"a\n\n{{{{ equation frf-h1 | {H1} }}}}\n\n$$ a $$\n",
            r"frf.md:3: .* is not .* on the line above a \$\$ block",
        ),
        (f"{{{{ equation h1 | {H1} }}}}\n$$ a $$\n", r"frf.md:1: .* is not"),
        ("as Equation (frf-h2) says", r"frf.md:1: no page has an equation 'frf-h2'"),
    ],
)
def test_what_is_wrong_ends_the_build_with_page_and_line(text: str, said: str) -> None:
    with pytest.raises(SystemExit, match=said):
        page(text)


def test_a_label_stands_once() -> None:
    block = f"{{{{ equation frf-h1 | {H1} }}}}\n$$ a $$\n"
    assert maths.labels_of({"a.md": block}) == {"frf-h1": "a.md"}
    with pytest.raises(SystemExit, match=r"b.md:2: the label 'frf-h1' is given twice, first in a.md"):
        maths.labels_of({"a.md": block, "b.md": "\n" + block})


def test_a_page_and_a_docstring_link_to_the_equation_they_name() -> None:
    assert (
        page("see Equation (frf-h1).", "tutorials/a.md")
        == "see Equation [(frf-h1)](../theory/frf.md#frf-h1)."
    )
    assert page("Equation (12) of the book") == "Equation (12) of the book"
    made = api.Entries(KNOWN.labels).html(
        "H1 by Equation\n(frf-h1), `S_uu` > 0.", "reference/python/spectra.md", "estimators.py: h1"
    )
    assert made == (
        '<div class="docstring"><p>H1 by Equation <a href="../../theory/frf.html#frf-h1">(frf-h1)</a>, '
        "<code>S_uu</code> &gt; 0.</p></div>"
    )
    with pytest.raises(SystemExit, match=r"estimators.py: h1: no page has an equation 'frf-h9'"):
        api.Entries(KNOWN.labels).html(
            "Equation (frf-h9)", "reference/python/spectra.md", "estimators.py: h1"
        )
