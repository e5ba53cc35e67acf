"""Parameters of results as lists, trends and campaigns read them: those of all fits and of every other section."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from labpipe.records.finding import WARNING, of_level
from labpipe.records.identification import Fit, Identification
from labpipe.records.parameter import Parameter
from labpipe.sections import section


@dataclass(frozen=True, kw_only=True)
class ListedParameter:
    """A parameter as lists of results show it: *fit* is whose it is (a fit, "run_ups.joint"), of which *test*, *term* and band [Hz].

    changes: of the parameter by one standard uncertainty of every systematic source, by its name; *random*: standard error without them.
    """

    fit: str
    parameter: Parameter
    test: str = ""
    term: str = ""
    model: str = ""
    estimator: str = ""
    band_hz: tuple[float, float] = (0.0, 0.0)
    warnings: tuple[str, ...] = ()
    random: float | None = None
    changes: Mapping[str, float] = field(default_factory=dict)

    @property
    def random_error(self) -> float | None:
        """Standard error without what given numbers add, which is common to all tests that share them."""
        return self.parameter.full_error if self.random is None else self.random


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
            random=random_part(fit, parameter),
            changes=changes_of(fit, parameter),
        )


def random_part(fit: Fit, parameter: Parameter) -> float | None:
    """Standard error of a parameter [its unit] without what given numbers add; None where it has no systematic part by itself."""
    if fit.budget is None or parameter.name not in fit.budget.names or parameter.systematic is None:
        return None
    return float(fit.budget.random[fit.budget.names.index(parameter.name)])


def changes_of(fit: Fit, parameter: Parameter) -> dict[str, float]:
    """Change of a parameter [its unit] by one standard uncertainty of every source of the fit's budget."""
    if fit.budget is None or parameter.name not in fit.budget.names:
        return {}
    return {source.source: fit.budget.change_by(source.source, parameter.name) for source in fit.budget.sources}


def warning_codes(fit: Fit) -> list[str]:
    """The codes of a fit's warnings, each once."""
    return list(dict.fromkeys(finding.code for finding in of_level(WARNING, fit.findings)))
