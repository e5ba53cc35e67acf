"""A study that cannot be made: the message names the section of the pipeline, unless the fault has a place of
its own.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from labpipe.errors import ConfigError, LabpipeError
from labpipe.project import study
from labpipe.project.study import run_studies


@pytest.mark.parametrize(
    ("where", "message"), [("", "lab/p.yaml: study: no fit"), ("rig.yaml:2:1", "rig.yaml:2:1: no fit")]
)
def test_a_fault_has_its_place(monkeypatch: pytest.MonkeyPatch, where: str, message: str) -> None:
    def refused(*_: Any) -> Any:
        raise ConfigError("no fit", where=where)

    monkeypatch.setattr(study, "run_study", refused)
    pipeline = SimpleNamespace(path=Path("lab/p.yaml"), fits=(), frf=None)
    work = cast("Any", SimpleNamespace(pipeline=pipeline, tell=None, jobs=1))
    with pytest.raises(LabpipeError) as caught:
        run_studies(cast("Any", SimpleNamespace(virtual_rig=pipeline)), work)
    assert str(caught.value) == message
