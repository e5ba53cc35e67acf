"""What can be planned. PLANS by the model that will be identified: its settings, and what makes and writes it."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from labpipe.registry import Registry


@dataclass(frozen=True)
class PlanKind:
    """*settings*: the dataclass of the section `plan:`; *files*: (PlanFile, OutputFolder) -> sentences, names of files."""

    settings: str
    files: str

    def load(self, step: str) -> Any:
        """The object of a step, imported when it is used."""
        module, _, attribute = getattr(self, step).partition(":")
        return getattr(import_module(module), attribute)


EXCITATION = PlanKind("labpipe.planner.settings:PlanSettings", "labpipe.stages.plan_excitation:excitation_files")
RUN_UPS = PlanKind("labpipe.planner.run_up_settings:RunUpPlanSettings", "labpipe.stages.plan_run_ups:run_up_files")
WEAR = PlanKind("labpipe.planner.wear_settings:WearPlanSettings", "labpipe.stages.plan_wear:wear_files")
STATES = PlanKind("labpipe.planner.state_settings:StatePlanSettings", "labpipe.stages.plan_states:state_files")

PLANS = Registry(
    "model",
    {
        "sdof": "labpipe.planner.kinds:EXCITATION",
        "rotor-2dof": "labpipe.planner.kinds:EXCITATION",
        "dynamic-stiffness": "labpipe.planner.kinds:EXCITATION",
        "bearing-states": "labpipe.planner.kinds:STATES",
        "run-ups": "labpipe.planner.kinds:RUN_UPS",
        "worn-bearing": "labpipe.planner.kinds:WEAR",
    },
)
