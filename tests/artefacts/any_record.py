"""Any record of a type, made from the types that its fields declare: what files must bring back as it was."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Mapping
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from labpipe.arrays import ComplexArray, IntArray
from labpipe.records.finding import NOTE, WARNING, Finding
from labpipe.records.fit_details import Region
from labpipe.records.identification import Fit, FittedCurve
from labpipe.records.response import FORMS, FrequencyResponse, Port, diagonal_covariance

NUMBERS = st.floats(-1e12, 1e12, allow_nan=False) | st.sampled_from(
    [0.0, -0.0, 1e-300, 5e-324, 1.7e308, 0.1, 1 / 3]
)
TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=6) | st.sampled_from(
    ["y", "45 deg", "µm", 'Prüfstand "A"\n', "k_xx"]
)
UNITS = st.sampled_from(["", "1", "N/m", "m/(N.s^2)", "degC", "%"])
LONGEST = 2


def any_of(hint: Any) -> st.SearchStrategy[Any]:
    """Values of a declared type: numbers, texts, flags, tuples, dataclasses, or none where none is
    allowed.
    """
    if get_origin(hint) is types.UnionType:
        return st.one_of(*(st.none() if one is types.NoneType else any_of(one) for one in get_args(hint)))
    if get_origin(hint) is tuple:
        kinds = get_args(hint)
        if kinds[-1] is Ellipsis:
            return st.lists(any_of(kinds[0]), max_size=LONGEST).map(tuple)
        return st.tuples(*(any_of(kind) for kind in kinds))
    if get_origin(hint) is dict:
        return st.dictionaries(TEXTS, NUMBERS | TEXTS | st.lists(NUMBERS, max_size=2), max_size=2)
    if get_origin(hint) is Mapping:
        return st.dictionaries(TEXTS, NUMBERS, max_size=2)
    if hint is Finding:
        return st.builds(Finding, TEXTS, TEXTS, st.sampled_from([NOTE, WARNING]))
    if dataclasses.is_dataclass(hint):
        hints = get_type_hints(hint)
        return st.builds(
            hint, **{field.name: _named(field.name, hints[field.name]) for field in dataclasses.fields(hint)}
        )
    if get_origin(hint) is np.ndarray:
        return array_of(hint)
    return {float: NUMBERS, int: st.integers(0, 10**9), str: TEXTS, bool: st.booleans()}[hint]


def _named(name: str, hint: Any) -> st.SearchStrategy[Any]:
    """Values of a declared type; units are known ones."""
    return UNITS if name.endswith("unit") and hint is str else any_of(hint)


def array_of(hint: Any) -> st.SearchStrategy[Any]:
    """Two numbers in a row of the kind that an array type declares."""
    if hint == ComplexArray:
        return complex_arrays(2)
    return (
        st.lists(st.integers(0, 99), min_size=2, max_size=2).map(np.array) if hint == IntArray else arrays(2)
    )


@st.composite
def arrays(draw: st.DrawFn, *shape: int) -> NDArray[np.float64]:
    """An array of finite numbers, each of its own."""
    size = int(np.prod(shape))
    return np.array(draw(st.lists(NUMBERS, min_size=size, max_size=size)), np.float64).reshape(shape)


@st.composite
def complex_arrays(draw: st.DrawFn, *shape: int) -> NDArray[np.complex128]:
    return draw(arrays(*shape)) + 1j * draw(arrays(*shape))


@st.composite
def curves(draw: st.DrawFn) -> FittedCurve:
    """Measured and fitted FRFs, with and without variance, with and without what was known before."""
    n, outputs, inputs = draw(st.integers(1, 3)), draw(names()), draw(names())
    shape = (n, len(outputs), len(inputs))
    return FittedCurve(
        draw(arrays(n)),
        draw(complex_arrays(*shape)),
        draw(complex_arrays(*shape)),
        variance=draw(st.none() | arrays(*shape)),
        outputs=outputs,
        inputs=inputs,
        form=draw(st.sampled_from(list(FORMS))),
        before=draw(st.none() | complex_arrays(*shape)),
    )


def names() -> st.SearchStrategy[tuple[str, ...]]:
    """One or two names that differ."""
    return st.lists(TEXTS, min_size=1, max_size=2, unique=True).map(tuple)


@st.composite
def fits(draw: st.DrawFn) -> Fit:
    """A fit with everything that it may carry."""
    hints = get_type_hints(Fit)
    plain = {
        f.name: draw(_named(f.name, hints[f.name]))
        for f in dataclasses.fields(Fit)
        if f.name not in ("curve", "correlation", "details")
    }
    n = draw(st.integers(1, 2))
    outline = draw(arrays(3, 2))
    region = draw(
        st.none() | st.builds(Region, st.tuples(TEXTS, TEXTS), st.just(outline), st.floats(0.5, 0.99))
    )
    return Fit(
        **plain,
        correlation=draw(arrays(n, n)),
        curve=draw(st.none() | curves()),
        details=() if region is None else (region,),
    )


@st.composite
def responses(draw: st.DrawFn) -> FrequencyResponse:
    """A response whose elements are uncorrelated, as identification.json keeps them."""
    n, outputs, inputs = draw(st.integers(1, 3)), draw(names()), draw(names())
    shape = (n, len(outputs), len(inputs))
    variance = draw(st.none() | arrays(*shape).map(np.abs))
    optional = {
        name: draw(st.none() | arrays(*shape)) for name in ("coherence", "partial_coherence", "distortion")
    }
    snr_channels = draw(names())
    return FrequencyResponse(
        frequency=np.arange(1.0, n + 1) * draw(st.floats(1e-3, 1e3)),
        matrix=draw(complex_arrays(*shape)),
        outputs=tuple(Port(label, draw(TEXTS), draw(TEXTS), draw(st.none() | NUMBERS)) for label in outputs),
        inputs=tuple(Port(label, draw(TEXTS), draw(TEXTS), draw(st.none() | NUMBERS)) for label in inputs),
        form=draw(st.sampled_from(list(FORMS))),
        covariance=None if variance is None else diagonal_covariance(variance),
        **optional,
        multiple_coherence=draw(st.none() | arrays(n, len(outputs))),
        snr=draw(arrays(n, len(snr_channels))),
        snr_channels=snr_channels,
        averages=draw(st.floats(1, 100)),
        covariance_dof=draw(st.floats(1, 100) | st.just(float("inf"))),
        name=draw(TEXTS),
        findings=draw(any_of(tuple[Finding, ...])),
        conditions=draw(st.dictionaries(TEXTS, TEXTS, max_size=2)),
    )


def same(one: Any, other: Any) -> bool:
    """Whether two records hold the same, arrays and not-a-number included."""
    if isinstance(one, np.ndarray):
        return (
            isinstance(other, np.ndarray)
            and one.shape == other.shape
            and np.array_equal(one, other, equal_nan=True)
        )
    if dataclasses.is_dataclass(one):
        pairs = ((getattr(one, field.name), getattr(other, field.name)) for field in dataclasses.fields(one))
        return type(one) is type(other) and all(same(mine, theirs) for mine, theirs in pairs)
    if isinstance(one, tuple):
        return isinstance(other, tuple) and len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float) and one != one:
        return isinstance(other, float) and other != other
    return type(one) is type(other) and bool(one == other)
