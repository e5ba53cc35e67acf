"""Two tests band by band: bands with different coefficients, corrected for the number of bands (Holm
1979).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from labpipe.display import chance_text
from labpipe.distributions import student_quantile, two_sided
from labpipe.errors import ConfigError, FitError
from labpipe.records.comparison import ComparedBand, Comparison
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit
from labpipe.registry import few, nearest
from labpipe.uncertainty.amounts import chance, holm, parameter_changes, random_error, source_dofs
from labpipe.uncertainty.settings import CompareSettings
from labpipe.uncertainty.weighted import dof_of_sum

ANY = "k"
MOST_NAMED = 8
COEFFICIENTS = ("N/m", "N.s/m")


# The fits of two tests, in the order of the groups.
TwoTests = tuple[tuple[Fit, ...], tuple[Fit, ...]]


def bandwise(settings: CompareSettings, tests: TwoTests) -> Comparison:
    """Comparison of all coefficients in the bands and terms common to both tests, second group against first,
    by Welch and Satterthwaite. Equation (comp-bands). ConfigError for an unknown parameter, FitError without
    a common band.
    """
    names = _parameters(settings, tests[0][0])
    every = itertools.product(names, *tests)
    pairs = [(a, b, name) for name, a, b in every if (a.band_hz, a.term) == (b.band_hz, b.term)]
    usable = [(a, b, name) for a, b, name in pairs if _has_error(a, name) and _has_error(b, name)]
    if not usable:
        what = "the two tests have no band in common with standard errors"
        raise FitError(what, hint="fit both in the same bands")
    raw = [_test(a, b, name) for a, b, name in usable]
    corrected = holm(np.array([p for p, _ in raw]))
    first, second = settings.groups
    bands = tuple(
        _band(f"{second} against {first}", *pair, ends, float(p))
        for pair, (_, ends), p in zip(usable, raw, corrected, strict=True)
    )
    differing = [band for band in bands if band.p_value is not None and band.p_value < settings.level]
    verdict = "different" if differing else "no difference"
    return Comparison(
        name=settings.name,
        kind="bands",
        subject=f"{', '.join(names)}, fit {settings.fit}",
        unit="N/m",
        points=(),
        amounts=(
            Parameter("different", float(len(differing)), "1", derived=True),
            Parameter("tested", float(len(bands)), "1", derived=True),
            chance("p_value", float(np.min(corrected))),
        ),
        verdict=verdict,
        statement=_statement(settings, bands, differing, verdict, len(pairs) - len(usable)),
        condition=settings.group,
        bands=bands,
    )


def _has_error(fit: Fit, name: str) -> bool:
    return any(p.name == name and p.std_error and p.ci95 is not None for p in fit.parameters)


def _parameters(settings: CompareSettings, fit: Fit) -> list[str]:
    names = [p.name for p in fit.estimated if p.unit in COEFFICIENTS]
    if settings.parameter == ANY and ANY not in names:
        return names
    if settings.parameter == ANY:
        return [name for name in names if name in ("k", "c")]
    if settings.parameter not in names:
        what = f"fit '{settings.fit}' has no '{settings.parameter}'"
        raise ConfigError(what, hint=nearest(settings.parameter, names))
    return [settings.parameter]


def _test(a: Fit, b: Fit, name: str) -> tuple[float, tuple[float, float] | None]:
    """Two-sided p-value of a difference, and the 95 % interval of the ratio. It holds every ratio r for which
    b - r a is no larger than its error (Fieller 1954); None where a may be zero.
    """
    errors = np.array([random_error(fit, fit.parameter(name)) for fit in (a, b)], np.float64)
    first, second = parameter_changes((a, b), name).T
    parts = np.append(errors, second - first)
    dofs = np.array([a.error_dof, b.error_dof, *source_dofs((a, b))])
    total, dof = float(np.linalg.norm(parts)), dof_of_sum(parts, dofs)
    old, new = a.parameter(name).value, b.parameter(name).value
    square = student_quantile(0.975, dof) ** 2
    below = old**2 - square * (errors[0] ** 2 + first @ first)
    middle = old * new - square * (first @ second)
    above = new**2 - square * (errors[1] ** 2 + second @ second)
    root = np.sqrt(max(middle**2 - below * above, 0.0))
    ends = None if below <= 0 else (float((middle - root) / below), float((middle + root) / below))
    return two_sided((new - old) / total, dof), ends


def _band(
    test: str, a: Fit, b: Fit, name: str, ends: tuple[float, float] | None, p_value: float
) -> ComparedBand:
    old, new = a.parameter(name), b.parameter(name)
    assert new.ci95 is not None
    return ComparedBand(
        test,
        f"{name} of {a.term}" if a.term else name,
        new.unit,
        band_hz=a.band_hz,
        value=new.value,
        ci95=new.ci95,
        other=old.value,
        other_ci95=old.ci95,
        ratio=new.value / old.value if old.value else None,
        ratio_ci95=ends,
        p_value=p_value,
    )


def _statement(
    settings: CompareSettings,
    bands: Sequence[ComparedBand],
    differing: Sequence[ComparedBand],
    verdict: str,
    left_out: int,
) -> str:
    first, second = settings.groups
    share = f"{len(differing)} of {len(bands)} coefficients of bands differ"
    result = f"{second} against {first}: {share}: {verdict}"
    corrected = f" (Holm's correction, together at most {100 * settings.level:g} % false alarms)."
    listed = [
        f"{band.parameter} {band.band_hz[0]:g}-{band.band_hz[1]:g} Hz ({chance_text(band.p_value)})"
        for band in differing
    ]
    named = f" They are {few(listed, MOST_NAMED)}." if listed else ""
    missing = f" {left_out} have no standard error and are left out." if left_out else ""
    return result + corrected + named + missing


def two_tests(settings: CompareSettings, fits: Sequence[Fit], groups: Sequence[tuple[str, str]]) -> TwoTests:
    """The fits of the two groups; *groups*: (test, its group). ConfigError for a group without a test or with
    several.
    """
    chosen = []
    for name in settings.groups:
        members = [test for test, group in groups if group == name]
        if len(members) != 1:
            names = ", ".join(sorted({group for _, group in groups}))
            what = f"{len(members)} tests have {settings.group}: {name}; one is compared with one"
            raise ConfigError(what, hint=f"known: {names}")
        chosen.append(tuple(fit for fit in fits if fit.test == members[0]))
    return chosen[0], chosen[1]
