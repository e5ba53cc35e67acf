"""Parameters of results as lists, trends and campaigns read them: those of all fits and of every other section."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from labpipe.records.finding import WARNING, of_level
from labpipe.records.identification import Fit, Identification
from labpipe.records.parameter import Parameter
from labpipe.sections import section


@dataclass(frozen=True, kw_only=True)
class ListedParameter:
    """A parameter as lists of results show it: *fit* is whose it is (a fit, "run_ups.joint"), of which *test*, *term* and band [Hz]."""

    fit: str
    parameter: Parameter
    test: str = ""
    term: str = ""
    model: str = ""
    estimator: str = ""
    band_hz: tuple[float, float] = (0.0, 0.0)
    warnings: tuple[str, ...] = ()


def listed_parameters(identification: Identification) -> Iterator[ListedParameter]:
    """The parameters of all fits, then those of every other section."""
    for fit in identification.fits:
        yield from of_fit(fit)
    for name, record in identification.sections.items():
        yield from section(name).call("parameters", record)


def of_fit(fit: Fit) -> Iterator[ListedParameter]:
    """The parameters of one fit."""
    codes = tuple(warning_codes(fit))
    for parameter in fit.parameters:
        yield ListedParameter(
            fit=fit.name,
            parameter=parameter,
            test=fit.test,
            term=fit.term,
            model=fit.model,
            estimator=fit.estimator,
            band_hz=fit.band_hz,
            warnings=codes,
        )


def warning_codes(fit: Fit) -> list[str]:
    """The codes of a fit's warnings, each once."""
    return list(dict.fromkeys(finding.code for finding in of_level(WARNING, fit.findings)))
