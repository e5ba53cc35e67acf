"""Faults of a Parquet file in plain words, whoever finds them."""

from __future__ import annotations

from pathlib import Path

import pytest

from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.parquet import check_layout, open_parquet
from labpipe.errors import DataError

PATH = Path("a.frf.parquet")


@pytest.mark.parametrize("fault", [KeyError("frequency"), ValueError("negative"), TypeError("None")])
def test_what_the_artefact_lacks_is_damage(fault: Exception) -> None:
    with (
        pytest.raises(
            DamagedError, match=f"^{PATH}: is not as labpipe writes it \\({type(fault).__name__}: "
        ),
        check_layout(PATH),
    ):
        raise fault


def test_a_fault_in_plain_words_stays_as_it_is() -> None:
    fault = DataError("holds no lines", where="b.parquet")
    with pytest.raises(DataError) as caught, check_layout(PATH):
        raise fault
    assert caught.value is fault


def test_what_is_no_parquet_file_is_said(tmp_path: Path) -> None:
    (tmp_path / "a.parquet").write_text("frequency")
    with pytest.raises(DamagedError, match="is not a readable Parquet file"):
        open_parquet(tmp_path / "a.parquet")
    with pytest.raises(DataError, match="is a folder"):
        open_parquet(tmp_path)
