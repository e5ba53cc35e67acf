"""The header of an artefact: what it was made from, whether that is still so, and no clock."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

import labpipe
from labpipe.artefacts.header import SCHEMA, Header, SourceRef, header_from_json, source_ref
from labpipe.artefacts.parquet import HEADER_KEY, batches, has_header, open_parquet, read_header
from labpipe.errors import DataError
from labpipe.records.finding import Finding, note

HEADER = Header(
    "frf", {"period": 1.0, "band": [1.0, 250.0]}, inputs=(SourceRef("a.csv", "00"), SourceRef("b.csv", "11"))
)
PATH = Path("x.frf.parquet")


# what makes the same work


def test_the_same_inputs_parameters_and_version_are_the_same_work() -> None:
    assert HEADER.same_work(replace(HEADER))


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "recording"},
        {"parameters": {"period": 2.0, "band": [1.0, 250.0]}},
        {"parameters": {"period": 1.0}},
        {"parameters": {"period": 1.0, "band": [1.0, 250.0], "skip": 0}},
        {"inputs": (SourceRef("a.csv", "01"), SourceRef("b.csv", "11"))},
        {"inputs": (SourceRef("c.csv", "00"), SourceRef("b.csv", "11"))},
        {"inputs": (SourceRef("b.csv", "11"), SourceRef("a.csv", "00"))},
        {"inputs": ()},
        {"schema": SCHEMA + 1},
        {"labpipe": "0.0.1"},
    ],
    ids=str,
)
def test_any_difference_in_them_is_other_work(change: dict) -> None:
    other = replace(HEADER, **change)
    assert not HEADER.same_work(other) and not other.same_work(HEADER)


@pytest.mark.parametrize("change", [{"findings": (Finding("gap", "3 s"),)}, {"contents": {"name": "x"}}])
def test_what_came_out_is_no_part_of_the_work(change: dict) -> None:
    assert HEADER.same_work(replace(HEADER, **change))


def test_tuples_and_lists_are_the_same_parameters() -> None:
    """A header that is asked for has tuples, one from a file has lists."""
    assert Header("frf", {"band": (1.0, 250.0)}, inputs=()).same_work(
        Header("frf", {"band": [1.0, 250.0]}, inputs=())
    )


PARAMETERS = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**9), 10**9)
    | st.floats(-1e300, 1e300)
    | st.text(st.characters(exclude_categories=["Cs"]), max_size=5),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=6,
)
REFS = st.lists(st.builds(SourceRef, st.text(max_size=5), st.text(max_size=5)), max_size=3).map(tuple)


@settings(max_examples=60)
@given(st.dictionaries(st.text(max_size=4), PARAMETERS, max_size=3), REFS)
def test_a_header_read_back_is_the_same_work(parameters: dict, inputs: tuple[SourceRef, ...]) -> None:
    header = Header(
        "frf",
        parameters,
        inputs=inputs,
        findings=(Finding("gap", "3 s"), note("masked", "50 Hz")),
        contents={"name": "a"},
    )
    again = header_from_json(header.to_json(), PATH, "frf")
    assert again == header and again.same_work(header)


def test_a_header_names_the_version_that_made_it_and_no_time() -> None:
    entries = json.loads(HEADER.to_json())
    assert entries["labpipe"] == labpipe.__version__
    assert set(entries) == {
        "kind",
        "parameters",
        "inputs",
        "findings",
        "contents",
        "schema",
        "labpipe",
        "code",
    }


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_a_parameter_that_is_no_number_is_refused(number: float) -> None:
    """Not-a-number is no JSON, and never equals itself: the artefact would never be fresh."""
    with pytest.raises(ValueError, match="JSON"):
        Header("frf", {"period": number}, inputs=()).to_json()


# what is not ours


def test_another_kind_is_named() -> None:
    with pytest.raises(DataError) as caught:
        header_from_json(HEADER.to_json(), PATH, "recording")
    assert str(caught.value) == "x.frf.parquet: is a frf file, a recording file is needed"


def test_the_header_of_an_earlier_version_is_read() -> None:
    """As files out there have it, schema 1; without the code's digest, which came later."""
    text = (
        '{"kind": "frf", "schema": 1, "labpipe": "0.1", "parameters": {"block": 4.0}, '
        '"inputs": [{"path": "a.csv", "sha256": "0f"}], "findings": [], "contents": {}}'
    )
    header = header_from_json(text, PATH, "frf")
    assert header.parameters == {"block": 4.0} and header.inputs == (SourceRef("a.csv", "0f"),)
    assert (header.labpipe, header.code) == ("0.1", "")


def test_another_schema_is_refused_with_a_cure() -> None:
    with pytest.raises(DataError) as caught:
        header_from_json(replace(HEADER, schema=99).to_json(), PATH, "frf")
    assert str(caught.value) == (
        f"x.frf.parquet: has schema 99, this version reads {SCHEMA}; make it again with this version"
    )


# checksums


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200))
def test_a_checksum_is_that_of_the_content(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.bin").write_bytes(content)
    assert source_ref(tmp_path / "a.bin", tmp_path) == SourceRef("a.bin", hashlib.sha256(content).hexdigest())


def test_a_known_checksum(tmp_path: Path) -> None:
    """FIPS 180-4, one-block message: SHA-256 of "abc"."""
    (tmp_path / "abc").write_bytes(b"abc")
    assert (
        source_ref(tmp_path / "abc", tmp_path).sha256
        == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    )


def test_a_file_longer_than_one_piece(tmp_path: Path) -> None:
    content = bytes(range(256)) * 10_000
    (tmp_path / "long").write_bytes(content)
    assert source_ref(tmp_path / "long", tmp_path).sha256 == hashlib.sha256(content).hexdigest()


def test_paths_are_relative_so_that_the_same_work_is_the_same_anywhere(tmp_path: Path) -> None:
    refs = []
    for lab in ("here", "there"):
        folder = tmp_path / lab / "pipelines"
        folder.mkdir(parents=True)
        (tmp_path / lab / "run.csv").write_text("1,2\n")
        refs.append(source_ref(tmp_path / lab / "run.csv", folder))
    assert refs[0] == refs[1] and refs[0].path == "../run.csv"


# parquet files


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    """Twelve rows in three groups, with our header."""
    path = tmp_path / "a.frf.parquet"
    table = pa.table({"f": np.arange(12.0), "x": np.arange(12.0) ** 2})
    pq.write_table(
        table.replace_schema_metadata({HEADER_KEY: HEADER.to_json().encode()}), path, row_group_size=5
    )
    return path


def test_the_header_is_read_from_the_file(stored: Path) -> None:
    assert has_header(stored) and read_header(stored, "frf") == replace(
        HEADER, parameters={"period": 1.0, "band": [1.0, 250.0]}
    )


def test_a_file_without_header_is_none_of_ours(tmp_path: Path) -> None:
    pq.write_table(pa.table({"f": [1.0]}), tmp_path / "a.parquet")
    assert not has_header(tmp_path / "a.parquet")
    with pytest.raises(DataError, match="has no labpipe header; another program may have saved it again"):
        read_header(tmp_path / "a.parquet", "frf")


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(1, 15))
def test_batches_are_all_rows_in_their_order(stored: Path, n_row: int) -> None:
    parts = list(batches(stored, ["x"], n_row))
    assert all(1 <= part.num_rows <= n_row and part.schema.names == ["x"] for part in parts)
    np.testing.assert_array_equal(
        np.concatenate([part.column("x").to_numpy() for part in parts]), np.arange(12.0) ** 2
    )


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: None, "no such file"),
        (lambda path: path.mkdir(), "is a folder"),
        (lambda path: path.write_bytes(b""), "is not a readable Parquet file"),
        (lambda path: path.write_text("f,x\n1,2\n"), "is not a readable Parquet file"),
        (lambda path: path.write_bytes(b"PAR1" + bytes(40) + b"PAR1"), "is not a readable Parquet file"),
    ],
)
def test_what_is_no_parquet_file_is_said_in_one_line(tmp_path: Path, make, said: str) -> None:
    make(tmp_path / "a.parquet")
    with pytest.raises(DataError) as caught:
        open_parquet(tmp_path / "a.parquet")
    assert (
        said in str(caught.value)
        and str(caught.value).startswith(str(tmp_path))
        and "\n" not in str(caught.value)
    )


def test_a_file_that_was_cut_off_is_said(stored: Path) -> None:
    stored.write_bytes(stored.read_bytes()[:-20])
    with pytest.raises(DataError, match="is not a readable Parquet file"):
        open_parquet(stored)
