"""Makes the validation manual: `python -m tests.validation`; `--check` compares instead with the pages that
are there.

Nothing is fetched. Rows with ROSS, with sdypy-EMA and with the raw files of others are recorded by the
modules `record_ross`, `record_lscf` and `record_measured --data FOLDER`, which need what their names say.
"""

from __future__ import annotations

import argparse
import os
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

from tests.validation.claims import Claim, Method
from tests.validation.methods import METHODS
from tests.validation.page import PAGES, index_page, method_page, same_text


def computed(method: Method) -> dict[str, list[Claim]]:
    """Claims by section; one that fails without words is refused."""
    found = {}
    for name, check in method.checks.items():
        start = time.process_time()
        found[name] = check()
        print(
            f"{method.name}: {name}: {len(found[name])} rows, {time.process_time() - start:.2f} s",
            file=sys.stderr,
        )
        for claim in found[name]:
            if claim.state != "holds" and not claim.why:
                raise SystemExit(
                    f"{method.name}: {claim.quantity}: {claim.value} for {claim.reference}, "
                    "and no words on why"
                )
    return found


def pages() -> dict[str, str]:
    """All pages by file name, the index last."""
    claims = {method: computed(method) for method in METHODS}
    made = {f"{method.name}.md": method_page(method, of_method) for method, of_method in claims.items()}
    flat = {
        method: [claim for section in of_method.values() for claim in section]
        for method, of_method in claims.items()
    }
    return {**made, "index.md": index_page(flat)}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.validation", description=__doc__)
    parser.add_argument(
        "--check", action="store_true", help="compare with docs/pages/validation, write nothing"
    )
    asked = parser.parse_args()
    made = pages()
    if not asked.check:
        PAGES.mkdir(exist_ok=True)
        for name, text in made.items():
            (PAGES / name).write_text(text, encoding="utf-8")
        return 0
    differences = {
        name: same_text(text, (PAGES / name).read_text(encoding="utf-8")) for name, text in made.items()
    }
    for name, difference in differences.items():
        if difference:
            print(f"{name}: {difference}")
    return int(any(differences.values()))


if __name__ == "__main__":
    raise SystemExit(main())
