"""A document as Markdown; figures are named by their captions, and none of them is drawn."""

from __future__ import annotations

from labpipe.report.document import Block, Code, Document, Figure, Paragraph


def render_markdown(document: Document) -> str:
    """The document as Markdown."""
    parts = [f"# {_plain(document.title)}", _plain(document.subtitle)]
    for section in document.signed:
        parts.append(f"## {_plain(section.heading)}")
        parts.extend(_markdown(block) for block in section.blocks)
    return "\n\n".join(parts) + "\n"


def _markdown(block: Block) -> str:
    if isinstance(block, Paragraph):
        return f"> **{block.kind}**: {_plain(block.text)}" if block.kind else _plain(block.text)
    if isinstance(block, Code):
        return "```json\n" + block.text + "\n```"
    if isinstance(block, Figure):
        return f"*Figure (drawn in the HTML report):* {_plain(block.caption)}"
    rows = [block.header, tuple("---:" if n in block.numeric else "---" for n in range(len(block.header))), *block.rows]
    lines = ["| " + " | ".join(cell if set(cell) <= set("-:") else _plain(cell) for cell in row) + " |" for row in rows]
    return (f"*{_plain(block.caption)}*\n\n" if block.caption else "") + "\n".join(lines)


def _plain(text: str) -> str:
    """Text in which nothing is markup."""
    for sign in "\\`*_[]<>|#":
        text = text.replace(sign, f"\\{sign}")
    return text.replace("\n", " ")
