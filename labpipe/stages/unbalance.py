"""The section unbalance: the model's response to unbalance over speed."""

from __future__ import annotations

from labpipe.records.unbalance import UnbalanceRuns
from labpipe.rigs.unbalance_runs import UnbalanceSettings, unbalance_runs
from labpipe.stages.work import Work


def run_unbalance(settings: UnbalanceSettings, work: Work) -> UnbalanceRuns:  # noqa: ARG001 (one signature for all sections)
    """The response of every state of wear at every speed."""
    return unbalance_runs(settings)
