"""Scatter between repeats of a test as sources of its uncertainty: drift between days, remounting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from labpipe.errors import ConfigError
from labpipe.identify.budget import Source, with_contributions, with_sources
from labpipe.records.doubt import Doubt
from labpipe.records.identification import Fit
from labpipe.records.repeat_source import RepeatSource


def with_repeat_sources(fit: Fit, sources: Sequence[RepeatSource], test: str, conditions: Mapping[str, Any], coverage: float) -> Fit:
    """The fit with the scatter between repeats in its budget; *coverage* [1] of expanded uncertainties.

    One source changes one parameter, since repeats of one coefficient do not tell how others go with it. ConfigError for a test without
    the condition that its errors go by.
    """
    names = [parameter.name for parameter in fit.parameters]
    counted = [_source(source, fit, test, conditions) for source in sources if source.parameter in names]
    return with_contributions(with_sources(fit, counted), coverage) if counted else fit


def _source(source: RepeatSource, fit: Fit, test: str, conditions: Mapping[str, Any]) -> Source:
    if source.per and source.per not in conditions:
        what = f"{source.name} goes by the condition '{source.per}', which {f'test {test}' if test else 'the test'} does not have"
        raise ConfigError(what, hint=f"conditions: {{{source.per}: ...}}, or leave `per` out")
    same = f"{source.per} {conditions[source.per]}" if source.per else test or "this test"
    changes = np.array([source.relative * parameter.value if parameter.name == source.parameter else 0.0 for parameter in fit.parameters])
    size = abs(float(np.sum(changes)))
    return Doubt(f"{source.name} ({same})", size, fit.parameter(source.parameter).unit, source.dof), changes
