"""A plan that cannot be made: the message names the file, and the entry where it is known."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from labpipe.artefacts.writing import OutputFolder
from labpipe.errors import ConfigError, DataError, LabpipeError
from labpipe.methods.planning.plan_file import PlanFile, plan_files


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ConfigError("must be above zero", field="mass"), "lab/plan.yaml: plan.mass: must be above zero"),
        (ConfigError("is not a plan"), "lab/plan.yaml: is not a plan"),
        (DataError("cannot be read"), "lab/plan.yaml: cannot be read"),
        # A file that the plan names says itself where its fault is.
        (
            ConfigError("must be above zero", where="lab/rotor.yaml:3:1", field="mass"),
            "lab/rotor.yaml:3:1: must be above zero",
        ),
    ],
)
def test_a_fault_has_its_place(error: LabpipeError, message: str) -> None:
    def files(*_: Any) -> Any:
        raise error

    kind = cast("Any", SimpleNamespace(files=files))
    with pytest.raises(LabpipeError) as caught:
        plan_files(PlanFile(Path("lab/plan.yaml"), "Plan", kind, None), cast("OutputFolder", None))
    assert str(caught.value) == message
