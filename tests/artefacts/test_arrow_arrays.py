"""Numbers to and from pyarrow by their buffers: the same as its own conversions, which would import
pandas.
"""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest

from labpipe.artefacts.parquet import arrow_array, numpy_array
from tests.cli.test_imports import LAZY


@pytest.mark.parametrize("kind", ["f8", "f4", "i8", "i4", "u2"])
def test_numbers_come_and_go_as_pyarrow_converts_them(kind: str) -> None:
    values = np.arange(-3 if kind[0] != "u" else 3, 9).astype(kind)
    assert arrow_array(values).equals(pa.array(values))
    np.testing.assert_array_equal(numpy_array(pa.array(values)), values, strict=True)


def test_every_second_number_of_an_array_is_taken_as_it_stands() -> None:
    values = np.arange(10.0)[::2]
    assert arrow_array(values).to_pylist() == [0.0, 2.0, 4.0, 6.0, 8.0]


def test_slices_chunks_and_nothing() -> None:
    column = pa.array([0.0, 1.0, np.nan, 3.0])
    np.testing.assert_array_equal(numpy_array(column.slice(1, 2)), [1.0, np.nan])
    np.testing.assert_array_equal(
        numpy_array(pa.chunked_array([column.slice(3), column[:2]])), [3.0, 0.0, 1.0]
    )
    assert numpy_array(pa.array([], pa.float64())).shape == (0,)


def test_what_is_no_plain_number_is_converted_by_pyarrow() -> None:
    assert arrow_array(np.array([True, False])).to_pylist() == [True, False]
    assert arrow_array(["a", None]).to_pylist() == ["a", None]
    np.testing.assert_array_equal(numpy_array(pa.array([1.0, None])), [1.0, np.nan])


@LAZY
def test_pandas_is_not_imported() -> None:
    script = (
        "import sys, numpy as np, pyarrow as pa; from labpipe.artefacts.parquet import arrow_array, "
        "numpy_array; "
        "numpy_array(pa.chunked_array([arrow_array(np.arange(3.0))])); sys.exit('pandas' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
