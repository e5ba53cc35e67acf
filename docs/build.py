"""Build the documentation site into docs/site: run the pipelines whose figures the pages show, generate the
reference, call mkdocs.

python docs/build.py            all; what is up to date in out/docs is not computed again
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).parent))

import api
from maths import Equations, labels_of, with_maths

DOCS = Path(__file__).parent
ROOT = DOCS.parent
WORK = ROOT / "out/docs"
PAGES = WORK / "pages"
FIGURE = re.compile(r"^\{\{ figure ([\w.-]+) \| (.+) \}\}$", re.MULTILINE)
SOURCE = re.compile(r"^\{\{ source ([\w./-]+) \}\}$", re.MULTILINE)
PIPELINE = re.compile(r"^\{\{ pipeline ([\w-]+) \| ([\w., -]+) \}\}$", re.MULTILINE)
# What stands in pages between such braces and was none of these, nor an equation, is a slip.
LEFT = re.compile(r"^\{\{ .*", re.MULTILINE)
PAPERS = {"changes.md": "CHANGELOG.md", "contributing.md": "CONTRIBUTING.md"}
LANGUAGES = {".py": "python", ".yaml": "yaml"}
# The pages draw their figures from the result: the reports of the runs would take as long as the runs.
FIGURES_ONLY = ["--set", "report.formats=[]"]
# Where a page shows figures of less work than the pipeline as it is shipped, it says so; rules about the
# statistics go with the work.
OPTIONS = {
    "three-dof": ["--set", "study.repeats=40", "--set", "study.thresholds=false", "--set", "expect={}"]
}


class Results:
    """The figures of the shipped pipelines, each pipeline run once."""

    def __init__(self) -> None:
        self._figures: dict[str, list] = {}

    def figures(self, name: str) -> list:
        """The figures of a pipeline's report, in their order."""
        if name not in self._figures:
            from labpipe.artefacts.identification_file import read_identification
            from labpipe.report.build import build
            from labpipe.report.document import Figure

            document = build(read_identification(ran(name) / "identification.json"))
            self._figures[name] = [
                block
                for section in document.sections
                for block in section.blocks
                if isinstance(block, Figure)
            ]
        return self._figures[name]

    def html(self, name: str, words: str, up: str) -> str:
        """The first figure whose caption holds *words*, as HTML that names its file; the file is written."""
        from labpipe.document.charts import canvas_of, svg_text

        found = [
            n for n, figure in enumerate(self.figures(name), 1) if words.lower() in figure.caption.lower()
        ]
        if not found:
            captions = "\n  ".join(figure.caption for figure in self.figures(name))
            raise SystemExit(f"{name} has no figure whose caption holds '{words}':\n  {captions}")
        figure = self.figures(name)[found[0] - 1]
        target = PAGES / "figures" / f"{name}-{found[0]}.svg"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(svg_text(canvas_of(figure.graphic)), encoding="utf-8")
        image = f'<img src="{up}figures/{target.name}" alt="{escape(figure.alternative)}" loading="lazy">'
        return f"<figure>{image}<figcaption>{escape(figure.caption)}</figcaption></figure>"


def ran(name: str) -> Path:
    """The folder with the result of a shipped pipeline, run unless it is up to date."""
    from labpipe.cli.main import run_command

    folder = WORK / "runs" / name
    print(f"run {name}", flush=True)
    code = run_command(
        [
            "run",
            str(ROOT / "pipelines" / f"{name}.yaml"),
            "-o",
            str(folder),
            "-q",
            *FIGURES_ONLY,
            *OPTIONS.get(name, []),
        ]
    )
    if code:
        raise SystemExit(f"pipelines/{name}.yaml ended with {code}")
    return folder


def source_block(found: re.Match[str]) -> str:
    """A file of docs as a block of code, under its name."""
    path = DOCS / found[1]
    return f"`docs/{found[1]}`:\n\n```{LANGUAGES[path.suffix]}\n{path.read_text(encoding='utf-8')}```"


def pipeline_block(found: re.Match[str]) -> str:
    """Sections of a shipped pipeline as they stand in its file, under its name: `frf`, or `identify.pedestal`
    for one entry.
    """
    place = f"pipelines/{found[1]}.yaml"
    text = (ROOT / place).read_text(encoding="utf-8")
    shown: list[str] = []
    for path in (one.strip() for one in found[2].split(",")):
        lines = cut_out(text, *path.split("."))
        if not lines:
            raise SystemExit(f"{place} has no '{path}'")
        shown += lines[1:] if lines[0] in shown else lines
    return f"`{place}`:\n\n```yaml\n" + "\n".join(shown) + "\n```"


def cut_out(text: str, section: str, entry: str = "") -> list[str]:
    """The lines of a section of a YAML file, or its head and one entry."""
    block = _block(text.splitlines(), f"{section}:")
    if not entry or not block:
        return block
    inner = _block(block[1:], f"  {entry}:")
    return [block[0], *inner] if inner else []


def _block(lines: list[str], head: str) -> list[str]:
    """The line that begins with *head*, and those below it that are indented more."""
    start = next((n for n, line in enumerate(lines) if line.startswith(head)), None)
    if start is None:
        return []
    deeper = " " * (len(head) - len(head.lstrip()) + 1)
    end = next((n for n in range(start + 1, len(lines)) if not lines[n].startswith(deeper)), len(lines))
    return lines[start:end]


def write_pages(target: Path, figure: Callable[[str, str, str], str]) -> None:
    """The pages with their figures (name of a pipeline, words of a caption, way up -> HTML) and the generated
    reference, in *target*.
    """
    from reference import reference_pages

    shutil.copytree(DOCS / "pages", target)
    read = api.modules()
    written = {
        path.relative_to(target).as_posix(): path.read_text(encoding="utf-8")
        for path in sorted(target.rglob("*.md"))
    }
    known = Equations(labels_of(written), api.places(read))
    for page, text in written.items():
        text = FIGURE.sub(
            lambda found, page=page: figure(found[1], found[2], "../" * page.count("/")),
            with_maths(page, text, known),
        )
        text = PIPELINE.sub(pipeline_block, SOURCE.sub(source_block, text))
        if slip := LEFT.search(text):
            raise SystemExit(f"docs/pages/{page}: '{slip[0]}' is not a figure, source, pipeline or equation")
        written[page] = text
    written |= {f"reference/{name}.md": text for name, text in reference_pages().items()} | api.api_pages(
        read, known.labels
    )
    written |= project_papers()
    for page, text in written.items():
        (target / page).parent.mkdir(parents=True, exist_ok=True)
        (target / page).write_text(text, encoding="utf-8")


def project_papers() -> dict[str, str]:
    """The project's own papers as pages, with their links to pages.

    Who reads the site has no checkout at hand.
    """
    return {
        page: (ROOT / name).read_text(encoding="utf-8").replace("](docs/pages/", "](")
        for page, name in PAPERS.items()
    }


def build_site(pages: Path, site: Path) -> int:
    """The pages as a site: mkdocs's exit code.

    Its configuration, with the folders of the navigation as lists of pages, beside *pages*.
    """
    config = yaml.safe_load((DOCS / "mkdocs.yml").read_text(encoding="utf-8"))
    config |= {
        "docs_dir": str(pages),
        "site_dir": str(site),
        "nav": [one for entry in config["nav"] for one in in_full(entry, pages)],
    }
    config["theme"]["custom_dir"] = str(DOCS / "theme")
    written = pages.parent / "mkdocs.yml"
    written.write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--clean", "-f", str(written)]
    return subprocess.run(command, check=False, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}).returncode


def in_full(entry: dict[str, Any], pages: Path) -> list[dict[str, Any]]:
    """An entry of the navigation with its folders as lists of pages; none for a folder without pages."""
    ((title, value),) = entry.items()
    if isinstance(value, list):
        return [{title: [one for inner in value for one in in_full(inner, pages)]}]
    if not value.endswith("/"):
        return [entry]
    return [{title: listed}] if (listed := pages_in(pages / value, pages)) else []


def pages_in(folder: Path, pages: Path) -> list[str]:
    """The pages of a folder: its index first, the others in the order in which the index links to them, those
    it leaves out last.
    """
    index = folder / "index.md"
    linked = re.findall(r"\]\(([\w-]+\.md)\)", index.read_text(encoding="utf-8")) if index.exists() else []
    order = {name: n for n, name in reversed(list(enumerate(["index.md", *linked])))}
    found = sorted(folder.glob("*.md"), key=lambda path: (order.get(path.name, len(order)), path.name))
    return [path.relative_to(pages).as_posix() for path in found]


def main() -> int:
    shutil.rmtree(PAGES, ignore_errors=True)
    write_pages(PAGES, Results().html)
    return build_site(PAGES, DOCS / "site")


if __name__ == "__main__":
    sys.exit(main())
