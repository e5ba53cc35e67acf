"""An estimator of another package: a wrapper of ml, installed as documented, is ml in all its numbers and all
that is said of them.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import MODELS, FitSettings
from tests.estimation.conftest import FX, X, with_noise

ROOT = Path(__file__).parents[2]
ENTRIES = (
    "[labpipe.estimator]\nplain = wrapped:plain\nstated = wrapped:STATED\nequations = wrapped:EQUATIONS\n"
)
WRAPPED = """
from dataclasses import replace
from labpipe.estimation.estimators import LS, ML
from labpipe.estimation.likelihood import maximum_likelihood
from labpipe.estimation.regression import least_squares

def plain(measured, model, weight="none"):
    return maximum_likelihood(measured, model, weight)

STATED = replace(ML, fit=plain)
EQUATIONS = replace(LS, fit=least_squares)
"""
# Short blocks of random data; a model that lacks a mode; a mode seen from another point, with a mass that is
# not known; a given mass and a sensor in uncertainty.
FITTED = """
import json, sys
from dataclasses import replace
import numpy as np
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.response import Port
from tests.estimation.conftest import FX, X, with_noise
from tests.estimation.test_leakage import response

w = 2 * np.pi * np.arange(50.0, 70.0, 0.25)
one, other = (1 / (k - w**2 + 20j * w) for k in (380.0**2, 420.0**2))
rng = np.random.default_rng(3)
def measured(values, output=X):
    matrix = values[:, None, None]
    return with_noise(w / (2 * np.pi), matrix, (output,), (FX,), 1e-7, np.random.default_rng(3))
short = response(2.0)
real, imaginary = rng.normal(size=(2, *short.matrix.shape))
noise = 1e-3 * np.abs(short.matrix).max() * (real + 1j * imaginary)
cases = {
    "leakage": (replace(short, matrix=short.matrix + noise), {"mass": 1.0}),
    "blocks far too short": (response(1.0), {"mass": 1.0}),
    "missing mode": (measured(one + 0.5 * other), {"mass": "1 kg +- 1 %"}),
    "wrong mass": (measured(one), {"mass": "1.2 kg +- 1 %"}),
    "transfer": (replace(measured(0.4j * one, Port("q", "q", "7")), inputs=(Port("f", "f", "3"),)), {}),
    "compared": (measured(one), {"mass": "1 kg +- 1 %", "compare": True}),
}
def said(estimator, data, keys):
    (fit,) = identify(data, FitSettings("sdof", estimator=estimator, name="one", **keys))
    return {
        "numbers": [(p.name, p.value, p.std_error, p.full_error, p.expanded) for p in fit.parameters],
        "chi2": fit.gof.chi2_reduced, "notes": fit.notes,
        "candidates": [(c.name, c.chi2) for c in fit.candidates],
        "findings": [(f.code, f.message) for f in fit.findings],
        "curve": np.abs(fit.curve.fitted).ravel().tolist(),
    }
def each(case):
    return {estimator: said(estimator, *case) for estimator in sys.argv[1:]}
print(json.dumps({name: each(case) for name, case in cases.items()}))
"""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, dict[str, list]]]:
    """What fits by each estimator say, in a process that begins with the plug-in installed: choices are
    looked up once.
    """
    folder = tmp_path_factory.mktemp("plugin")
    (folder / "plugin-1.dist-info").mkdir()
    (folder / "plugin-1.dist-info/entry_points.txt").write_text(ENTRIES)
    (folder / "plugin-1.dist-info/METADATA").write_text("Metadata-Version: 2.1\nName: plugin\nVersion: 1\n")
    (folder / "wrapped.py").write_text(WRAPPED)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}
    ended = subprocess.run(
        [sys.executable, "-c", FITTED, "ml", "plain", "stated", "ls", "equations"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)  # type: ignore[no-any-return]


@pytest.mark.long
def test_a_wrapper_of_ml_is_ml(found) -> None:
    codes = {name: {code for code, _ in case["ml"]["findings"]} for name, case in found.items()}
    assert "leakage" not in codes["leakage"] and "leakage" in codes["blocks far too short"]
    assert (
        "model-mismatch" in codes["missing mode"]
        and "mass" in codes["wrong mass"]
        and found["compared"]["ml"]["candidates"]
    )
    assert [name for name, *_ in found["transfer"]["ml"]["numbers"]][2] == "modal_constant"
    for name, case in found.items():
        assert case["stated"] == case["plain"] == case["ml"], name


@pytest.mark.long
def test_one_that_states_the_properties_of_ls_is_ls(found) -> None:
    assert "leakage" in {code for code, _ in found["leakage"]["ls"]["findings"]}
    for case in found.values():
        text = (
            json.dumps(case["equations"])
            .replace("equations is biased", "ls is biased")
            .replace("equations:", "ls:")
        )
        assert json.loads(text) == case["ls"]


@pytest.mark.parametrize("estimator", ["ml", "ls", "iv"])
def test_the_model_of_the_page_is_fitted_by_every_estimator(
    monkeypatch: pytest.MonkeyPatch, estimator: str
) -> None:
    """k (1 + j eta) of 1.2 MN/m and 3 % with 5 kg, from the closed form; a given mass that is left as its
    word is the plug-in's fault, and said.
    """
    page = (ROOT / "docs/pages/extend/estimator.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n([^`]*def structural.*?)```", page, re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)
    # In the place of one that the table has.
    monkeypatch.setitem(MODELS._loaded, "sdof", names["structural"])
    frequency = np.arange(60.0, 98.0)
    w = 2 * np.pi * frequency
    exact = 1 / (1.2e6 * (1 + 0.03j) - 5.0 * w**2)
    response = with_noise(frequency, exact[:, None, None], (X,), (FX,), 1e-8, np.random.default_rng(1))
    for mass in (5.0, "estimate"):
        (fit,) = identify(response, FitSettings("sdof", mass=mass, estimator=estimator))
        for name, truth in (("k", 1.2e6), ("h", 36e3), *([("m", 5.0)] if mass != 5.0 else [])):
            parameter = fit.parameter(name)
            assert parameter.value == pytest.approx(truth, abs=4 * parameter.std_error, rel=0)
    exec(code.replace('mass == "estimate" else mass', "mass is None else mass"), names)
    setup = SimpleNamespace(outputs=(X,), inputs=(FX,), settings=FitSettings("sdof"))
    careless = names["structural"](setup)
    with pytest.raises(ConfigError, match="has matrices that do not hold numbers"):
        careless.receptance(np.ones(3), w)
