"""Arrays in labpipe's signatures, by kind of number, and how records check and freeze them.

The docstring of each function states shapes, as (n_frequency, n_output, n_input), and units, as [N/m].
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labpipe.errors import DataError

# Files are read by these types, so they are arrays themselves and not NDArray, which is an alias of another
# kind from numpy 2.5 on.
FloatArray: TypeAlias = np.ndarray[tuple[Any, ...], np.dtype[np.floating[Any]]]
ComplexArray: TypeAlias = np.ndarray[tuple[Any, ...], np.dtype[np.complexfloating[Any, Any]]]
IntArray: TypeAlias = np.ndarray[tuple[Any, ...], np.dtype[np.intp]]
BoolArray: TypeAlias = np.ndarray[tuple[Any, ...], np.dtype[np.bool_]]

# Checking and freezing of the arrays that records hold.


def frozen_array(values: ArrayLike, dtype: type, name: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """Read-only array of *values* (n, ...) [any unit] with the given dtype and shape; DataError on another
    shape or NaN.

    A copy, unless nobody can write to *values* any more.
    """
    array = np.asarray(values) if _is_frozen(values, dtype) else np.array(values, dtype=dtype)
    if array.shape != shape:
        raise DataError(f"{name} has the shape {array.shape}, {shape} is needed")
    if not np.all(np.isfinite(array)):
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise DataError(f"{name} is not finite at index {index}")
    array.flags.writeable = False
    return array


def freeze(record: object, name: str, dtype: type, shape: tuple[int, ...], called: str = "") -> None:
    """The array *name* of a frozen record as a frozen_array, *called* so in errors; None stays."""
    if (values := getattr(record, name)) is not None:
        object.__setattr__(record, name, frozen_array(values, dtype, called or name, shape))


def _is_frozen(values: ArrayLike, dtype: type) -> bool:
    """Whether *values* are an array of *dtype* that is read-only, as is all that it is a view of."""
    if not isinstance(values, np.ndarray) or values.dtype != dtype:
        return False
    owner: Any = values
    while isinstance(owner, np.ndarray) and not owner.flags.writeable:
        owner = owner.base
    return owner is None


def freeze_bases(values: NDArray[Any]) -> NDArray[Any]:
    """The array *values* (n, ...) [any unit] made read-only with all that it is a view of, so that a record
    takes it without a copy.

    For arrays that were made for the record and that nobody else holds.
    """
    owner: Any = values
    while isinstance(owner, np.ndarray):
        owner.flags.writeable = False
        owner = owner.base
    return values


def modal_assurance(a: ComplexArray, b: ComplexArray) -> FloatArray:
    """Modal assurance criterion |a^H b|^2 / (|a|^2 |b|^2) of rows of *a* (n, k) and *b* (m, k), (n, m) [1]
    (0 where one vanishes; Allemang and Brown 1982).

    Equation (modal-mac).
    """
    product = np.abs(a.conj() @ b.T) ** 2
    size = np.sum(np.abs(a) ** 2, axis=1)[:, None] * np.sum(np.abs(b) ** 2, axis=1)
    return np.asarray(np.divide(product, size, out=np.zeros_like(product), where=size > 0))
