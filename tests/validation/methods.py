"""The pages of the manual in their order."""

from __future__ import annotations

from tests.validation import (
    budget,
    files,
    frf,
    identification,
    journal,
    magnetic,
    measured,
    modal,
    planner,
    rolling,
    rotors,
)
from tests.validation.claims import Method

METHODS: tuple[Method, ...] = tuple(
    page.METHOD
    for page in (
        rolling,
        journal,
        magnetic,
        rotors,
        frf,
        identification,
        modal,
        measured,
        budget,
        planner,
        files,
    )
)
