"""The study of faults on a few of its rows: the first advice, as it is printed, cures them."""

from __future__ import annotations

import pytest

from tests.draws.advice import judged
from tests.draws.faults import FAULTS

FEW = ("response 2 ms late", "column misspelt")


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", FEW)
def test_the_first_advice_cures(name: str) -> None:
    (fault,) = (fault for fault in FAULTS if fault.name == name)
    row = judged(fault)
    assert row["said"] and row["gone"] and row["right"], row


def test_faults_are_many_and_have_names_of_their_own() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 40
