"""``identification.json``, schema "labpipe/identification/1": all fits with their doubt, and the responses they came from."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from labpipe import __version__
from labpipe.artefacts.comparison_entry import comparison_entry, read_comparison
from labpipe.artefacts.fit_entry import complex_entry, finding_entries, fit_entry, read_complex, read_findings, read_fit
from labpipe.artefacts.json_file import write_json
from labpipe.artefacts.run_up_entry import read_run_ups, run_up_entry
from labpipe.artefacts.study_entry import read_study
from labpipe.artefacts.unbalance_entry import read_unbalance
from labpipe.errors import DataError
from labpipe.records.identification import Failed, Identification, RuleOutcome
from labpipe.records.response import FrequencyResponse, Port, uncorrelated

SCHEMA = "labpipe/identification/1"
NAME = "identification.json"


def write_identification(path: Path, identification: Identification) -> None:
    """Write the result."""
    entries = {
        "schema": SCHEMA,
        "labpipe": __version__,
        "title": identification.title,
        "pipeline": identification.pipeline,
        "sources": list(identification.sources),
        "rig": identification.rig,
        "settings": identification.settings,
        **({"failed": [dataclasses.asdict(failed) for failed in identification.failed]} if identification.failed else {}),
        "fits": [fit_entry(fit) for fit in identification.fits],
        "accept": [_outcome_entry(outcome) for outcome in identification.outcomes if outcome.section == "accept"],
        "expect": [_outcome_entry(outcome) for outcome in identification.outcomes if outcome.section == "expect"],
        "comparisons": [comparison_entry(comparison) for comparison in identification.comparisons],
        "studies": [dataclasses.asdict(study) for study in identification.studies],
        "responses": [_response_entry(response) for response in identification.responses],
        **({} if identification.unbalance is None else {"unbalance": dataclasses.asdict(identification.unbalance)}),
        **({} if identification.run_ups is None else {"run_ups": run_up_entry(identification.run_ups)}),
    }
    write_json(path, entries)


def read_identification(path: Path) -> Identification:
    """The result of an identification.json; DataError when the file is none."""
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError("no such file", where=str(path), hint="run `labpipe identify` first") from None
    except (ValueError, IsADirectoryError) as error:
        raise DataError(f"is not a readable identification.json ({error})", where=str(path)) from None
    if not isinstance(entries, dict) or entries.get("schema") != SCHEMA:
        raise DataError(f"is not of schema {SCHEMA}", where=str(path))
    try:
        return _identification(entries)
    except (KeyError, TypeError, IndexError, ValueError) as error:
        # Same schema, other entries: written by another version, or edited by hand.
        written = f"was written by labpipe {entries.get('labpipe', '?')}, or edited ({type(error).__name__}: {error})"
        raise DataError(written, where=str(path), hint="run `labpipe identify` again") from None


def _identification(entries: dict[str, Any]) -> Identification:
    outcomes = [RuleOutcome(section, **entry) for section in ("accept", "expect") for entry in entries.get(section, [])]
    return Identification(
        fits=tuple(read_fit(entry) for entry in entries["fits"]),
        title=entries["title"],
        pipeline=entries["pipeline"],
        sources=tuple(entries["sources"]),
        settings=entries.get("settings", {}),
        rig=entries.get("rig", {}),
        responses=tuple(_response(entry) for entry in entries.get("responses", [])),
        outcomes=tuple(outcomes),
        comparisons=tuple(read_comparison(entry) for entry in entries.get("comparisons", [])),
        studies=tuple(read_study(entry) for entry in entries.get("studies", [])),
        unbalance=read_unbalance(entries["unbalance"]) if "unbalance" in entries else None,
        run_ups=read_run_ups(entries["run_ups"]) if "run_ups" in entries else None,
        version=entries["labpipe"],
        failed=tuple(Failed(**entry) for entry in entries.get("failed", [])),
    )


def _outcome_entry(outcome: RuleOutcome) -> dict[str, Any]:
    return {"rule": outcome.rule, "value": outcome.value, "passed": outcome.passed}


_OPTIONAL_ARRAYS = ("coherence", "multiple_coherence", "partial_coherence", "distortion", "snr")


def _response_entry(response: FrequencyResponse) -> dict[str, Any]:
    """The response for reading and plotting: its variance, not the whole covariance (that stays in the FRF file)."""
    variance = response.variance
    optional = {name: getattr(response, name) for name in _OPTIONAL_ARRAYS}
    return {
        "test": response.name,
        "form": response.form,
        "outputs": [dataclasses.asdict(port) for port in response.outputs],
        "inputs": [dataclasses.asdict(port) for port in response.inputs],
        "frequency_hz": response.frequency.tolist(),
        "matrix": complex_entry(response.matrix),
        "variance": None if variance is None else variance.tolist(),
        **{name: None if values is None else values.tolist() for name, values in optional.items()},
        "snr_channels": list(response.snr_channels),
        "averages": response.averages,
        "covariance_dof": response.covariance_dof,
        "conditions": response.conditions,
        **finding_entries(response.findings),
    }


def _response(entry: dict[str, Any]) -> FrequencyResponse:
    matrix = read_complex(entry["matrix"])
    variance = entry["variance"]
    dof = entry["covariance_dof"]
    return FrequencyResponse(
        frequency=np.array(entry["frequency_hz"], np.float64),
        matrix=matrix,
        outputs=tuple(Port(**port) for port in entry["outputs"]),
        inputs=tuple(Port(**port) for port in entry["inputs"]),
        form=entry["form"],
        covariance=None if variance is None else uncorrelated(np.array(variance, np.float64)),
        **{name: None if entry.get(name) is None else np.array(entry[name], np.float64) for name in _OPTIONAL_ARRAYS},
        snr_channels=tuple(entry["snr_channels"]),
        averages=entry["averages"],
        covariance_dof=math.inf if dof is None else dof,
        name=entry["test"],
        findings=read_findings(entry),
        conditions=entry["conditions"],
    )
