"""Constraints on single coefficients: fixed values, equal values, proportional damping."""

from __future__ import annotations

from labpipe.errors import ConfigError
from labpipe.identify.model import DynamicModel
from labpipe.identify.proportional import ProportionalModel, proportional
from labpipe.identify.settings import FitSettings
from labpipe.registry import nearest


def constrained(model: DynamicModel, settings: FitSettings) -> DynamicModel | ProportionalModel:
    """*model* with its `fixed`, `tied` and `damping` settings applied; ConfigError for names the model does not have."""
    for name, value in settings.fixed:
        _check_names(model, name, "fixed")
        model = model.fixed(name, value)
    for group in settings.tied:
        model = _tied(model, group)
    if not model.terms:
        raise ConfigError("every coefficient is fixed, so nothing is left to estimate", hint="shorten `fixed`")
    return proportional(model) if settings.damping == "proportional" else model


def _tied(model: DynamicModel, group: tuple[str, ...]) -> DynamicModel:
    for name in group:
        _check_names(model, name, "tied")
    units = {term.unit for term in model.terms if term.name in group}
    if len(set(group)) < 2 or len(units) > 1:
        raise ConfigError(f"tied: {', '.join(group)} cannot have one value", hint="name two or more coefficients of one unit")
    return model.tied(group)


def _check_names(model: DynamicModel, name: str, key: str) -> None:
    if name not in model.names:
        hint = nearest(name, model.names)
        raise ConfigError(f"{key}: {model.name} has no coefficient '{name}' (left to estimate)", hint=hint)
