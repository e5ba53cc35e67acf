"""A headless browser for each file of this folder, and the pages they open."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from labpipe.document.render import html_report
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings, Sliding
from labpipe.records.identification import Identification, RuleOutcome
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance


def _driver() -> ModuleType:
    spec = importlib.util.spec_from_file_location("labpipe_browser", Path(__file__).with_name("browser.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    """Closed with the last test of its file: one that waits for the end of all tests takes time until then."""
    driver = _driver()
    path = driver.binary()
    if path is None or os.name != "posix":
        pytest.skip(f"no browser found on the path ({', '.join(driver.BINARIES)})")
    running = driver.Browser(path)
    yield running
    running.close()


def sliding_result() -> Identification:
    """79 bands of 15 Hz between 1 and 250 Hz over a resonance, with noise."""
    rng = np.random.default_rng(1)
    frequency = np.arange(1.0, 251.0)
    w = 2 * np.pi * frequency
    clean = (1 / (134.5e3 - 0.79 * w**2 + 30j * w))[:, None, None]
    noise = 1e-7 * (rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape)) / np.sqrt(2)
    covariance = diagonal_covariance(np.full(clean.shape, 1e-14))
    ports = (Port("y", "y", "y"),), (Port("f", "f", "y"),)
    response = FrequencyResponse(frequency, clean + noise, *ports, covariance=covariance, name="run")
    fits = identify(
        response,
        FitSettings("sdof", mass=0.79, name="sliding", band=(1.0, 250.0), sliding=Sliding(15.0, 3.0)),
    )
    whole = identify(response, FitSettings("sdof", mass=0.79, name="whole", band=(40.0, 100.0)))
    outcomes = (RuleOutcome("accept", "whole.gof >= 0.95", 0.99, True),)
    sources = ({"path": "run.csv", "sha256": "ab" * 32},)
    return Identification(
        (*fits, *whole),
        "Sliding bands",
        pipeline="p.yaml",
        sources=sources,
        settings={},
        rig={},
        responses=(response,),
        outcomes=outcomes,
        version="0.1.0",
    )


@pytest.fixture(scope="session")
def report_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_bytes(html_report(sliding_result()))
    return path
