"""Reading the section ``uncertainty:``: how doubts are propagated, and how tests scatter between repeats."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from labpipe.artefacts.digest import DamagedError
from labpipe.artefacts.json_file import read_digested
from labpipe.config.faults import Faults, join
from labpipe.config.reader import read_settings
from labpipe.errors import ConfigError
from labpipe.identify.settings import FitSettings
from labpipe.marked_yaml import Marked
from labpipe.quantities import UnitError
from labpipe.records.repeat_source import RepeatSource
from labpipe.records.settings import Settings, setting
from labpipe.records.uncertain import parse_uncertain
from labpipe.registry import nearest


@dataclass(frozen=True)
class RepeatSettings(Settings):
    """What changes a parameter between repeats of a test: as it is known, or as a repeatability test found it."""

    parameter: str = setting("text", "the coefficient that scatters, of every fit that has it: k", default="")
    size: str = setting("text", "its standard uncertainty, relative: 0.5 %, or 0.5 % (dof=4)", default="")
    file: str = setting("file", "instead of parameter and size: identification.json of a comparison of kind repeatability", default="")
    comparison: str = setting("text", "name of the comparison in that file; its scatter between settings is taken", default="")
    per: str = setting("text", "condition; tests of one value of it have the error in common. Default: each test has its own", default="")

    def __post_init__(self) -> None:
        if self.file and (self.parameter or self.size):
            raise ConfigError("'file' says which parameter scatters and by how much", hint="leave 'parameter' and 'size' out", field="file")
        if not self.file and not (self.parameter and self.size):
            raise ConfigError("'parameter' and 'size' are needed, or the 'file' of a repeatability test", hint="parameter: k, size: 0.5 %")
        if bool(self.file) != bool(self.comparison):
            raise ConfigError("'file' and 'comparison' go together", hint="comparison: the name under `compare`", field="comparison")


METHODS = ("first-order", "monte-carlo")


@dataclass(frozen=True)
class UncertaintySettings(Settings):
    """The ``uncertainty:`` section: how the doubts of given numbers are propagated, for all fits that do not say it themselves."""

    coverage: float = setting("value", "probability of expanded uncertainties", unit="1", default=0.95)
    method: str = setting("choice", "first order, or draws of noise and all doubts beside it", choices=METHODS, default="first-order")
    draws: int = setting("integer", "draws of method monte-carlo", default=2000)
    repeatability: tuple[tuple[str, RepeatSettings], ...] = setting(
        "sections",
        "scatter between repeats, by name: {remounting: {parameter: k, size: 0.5 %, per: mounting}}",
        section=RepeatSettings,
        default=(),
    )

    def __post_init__(self) -> None:
        if not 0 < self.coverage < 1:
            raise ConfigError("'coverage' must lie between 0 and 100 %", field="coverage")
        if self.draws != UncertaintySettings.draws and self.method == METHODS[0]:
            raise ConfigError("'draws' are of method monte-carlo", hint="method: monte-carlo, or leave it out", field="draws")

    def of(self, fit: FitSettings, repeats: tuple[RepeatSource, ...] = ()) -> FitSettings:
        """A fit with these settings where it has none of its own, and with the scatter between *repeats*."""
        by_draws = self.method == "monte-carlo" and "monte_carlo" in fit.kind.keys
        draws = fit.monte_carlo or (self.draws if by_draws else 0)
        coverage = self.coverage if fit.coverage == FitSettings.coverage else fit.coverage
        return replace(fit, coverage=coverage, monte_carlo=draws, repeats=repeats)


def read_uncertainty(node: Marked, faults: Faults) -> Callable[[FitSettings], FitSettings] | None:
    """What the section makes of the settings of a fit; None and faults where it cannot be read."""
    before = len(faults)
    settings = read_settings(UncertaintySettings, node, "uncertainty", faults)
    if settings is None:
        return None
    repeats: list[RepeatSource] = []
    for name, entry in settings.repeatability:
        key = join("uncertainty.repeatability", name)
        written = node.content["repeatability"].content[name]
        try:
            repeats.append(_measured(name, entry, faults.folder) if entry.file else _known(name, entry))
        except UnitError as error:
            at = "file" if entry.file else "size"
            faults.add_unit(written.content[at], join(key, at), error)
    return partial(settings.of, repeats=tuple(repeats)) if len(faults) == before else None


def _known(name: str, settings: RepeatSettings) -> RepeatSource:
    size, _, _ = settings.size.partition("(")
    if not size.strip().endswith("%"):
        raise UnitError(f"'{settings.size}' is not relative to the parameter", "for example 0.5 %, or 0.5 % (dof=4)")
    number = parse_uncertain(f"1 +- {settings.size}", "1")
    return RepeatSource(name, settings.parameter, number.std_error, settings.per, number.dof)


def _measured(name: str, settings: RepeatSettings, folder: Path) -> RepeatSource:
    """The scatter between settings of a repeatability test, relative to its mean, with one degree of freedom less than settings."""
    try:
        comparisons = read_digested(folder / settings.file, "identification.json").get("comparisons") or []
        repeatabilities: Mapping[str, Any] = {entry["name"]: entry for entry in comparisons if entry["kind"] == "repeatability"}
    except DamagedError as error:
        raise UnitError(f"'{settings.file}' is not a readable identification.json: {error.what}", error.hint) from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise UnitError(f"'{settings.file}' is not a readable identification.json") from None
    if settings.comparison not in repeatabilities:
        hint = nearest(settings.comparison, repeatabilities) if repeatabilities else "it needs a comparison of kind: repeatability"
        raise UnitError(f"'{settings.file}' holds no repeatability '{settings.comparison}'", hint)
    comparison = repeatabilities[settings.comparison]
    try:
        amounts = {amount["name"]: float(amount["value"]) for amount in comparison["amounts"]}
        groups = {point["group"] for point in comparison["points"]}
        parameter = str(comparison["subject"]).split(",")[0].strip()
        return RepeatSource(name, parameter, abs(amounts["between"] / amounts["mean"]), settings.per, float(len(groups) - 1))
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        raise UnitError(f"the repeatability '{settings.comparison}' in '{settings.file}' cannot be read") from None
