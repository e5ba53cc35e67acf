"""Worlds of a model's response to unbalance: the bearings as they are, beside those that are written."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labpipe.methods.rotor.rotor_file import load_rotor
from labpipe.methods.rotor.section import UnbalanceRuns, UnbalanceSettings, unbalance_runs
from labpipe.project.pipeline_file import Pipeline
from labpipe.records.finding import Parameter
from labpipe.records.uncertain import Uncertainty
from tests.draws.usual import Errors

# Of every clearance by itself, and of the oil that all bearings have in common.
CLEARANCE, VISCOSITY = 0.02, 0.03
NAMES = ("forward_peak", "forward_speed", "backward_peak", "backward_speed")
# Speeds to either side of the peak, and steps within one of a truth.
ABOUT, FINE = 6, 10
TWO_SIDED = 1.959964


@dataclass(frozen=True)
class UnbalanceWorlds:
    """The *settings* about the peaks, with uncertainties in the rotor's bearings, and what is *stated* of the
    peaks then.
    """

    settings: UnbalanceSettings
    stated: UnbalanceRuns

    def truth(self) -> dict[str, float]:
        """Peaks of the bearings as written, between the speeds as well."""
        fine = unbalance_runs(
            replace(self.settings, rig=_plain(self.settings), step=self.settings.step / FINE)
        )
        return {
            f"{case.name}.{name}": value
            for case in fine.cases
            for name, (value, _) in fine.values(case).items()
        }

    def amounts(self, errors: Errors, rng: np.random.Generator | None) -> dict[str, Parameter]:
        """Peaks of bearings that are off, at speeds that begin anywhere within a step, with the uncertainties
        that are stated.
        """
        rig = self.settings.rig
        assert rig is not None
        for place in rig.bearings:
            film = place.film("a world")
            off = {
                "clearance": film.clearance
                * (1 + errors.of(Uncertainty(f"{place.name}.clearance", CLEARANCE, "1"))),
                "viscosity": film.viscosity * (1 + errors.of(Uncertainty("oil", VISCOSITY, "1"))),
            }
            rig = rig.with_bearings((place.name,), **off)
        begin = 0.0 if rng is None else self.settings.step * rng.uniform(-0.5, 0.5)
        low, high = self.settings.speeds
        runs = unbalance_runs(replace(self.settings, rig=rig, speeds=(low + begin, high + begin)))
        found = {}
        for case, stated in zip(runs.cases, self.stated.cases, strict=True):
            for name, (value, unit) in runs.values(case).items():
                error = stated.error(name) or 0.0
                interval = (value - TWO_SIDED * error, value + TWO_SIDED * error)
                found[f"{case.name}.{name}"] = Parameter(name, value, unit, std_error=error, ci95=interval)
        return found


def _plain(settings: UnbalanceSettings) -> object:
    assert settings.rig is not None
    return replace(
        settings.rig, bearings=tuple(replace(place, uncertainties=()) for place in settings.rig.bearings)
    )


def unbalance_worlds(pipeline: Pipeline) -> UnbalanceWorlds | None:
    """The worlds of the first and the last case of a pipeline; None where it has no section unbalance."""
    settings = pipeline.sections.get("unbalance")
    if settings is None:
        return None
    cases = (settings.cases[0], settings.cases[-1])
    first = unbalance_runs(replace(settings, cases=cases))
    speeds = [
        value
        for case in first.cases
        for name, (value, _) in first.values(case).items()
        if name.endswith("speed")
    ]
    reach = ABOUT * settings.step
    changes = []
    for number, place in enumerate(settings.rig.bearings):
        film = place.film("a world")
        changes.append(f"bearings.{number}.clearance={1e6 * film.clearance:.10g} um +- {100 * CLEARANCE:g} %")
        changes.append(
            f"bearings.{number}.viscosity={film.viscosity:.10g} Pa.s +- {100 * VISCOSITY:g} % (source=oil)"
        )
    rig = load_rotor(pipeline.folder / settings.rotor, changes)
    settings = replace(settings, cases=cases, rig=rig, speeds=(min(speeds) - reach, max(speeds) + reach))
    return UnbalanceWorlds(settings, unbalance_runs(settings))
