"""The worked plug-in: its numbers against closed forms and against what it is compared with on its page."""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from labpipe.errors import ConfigError, DataError
from labpipe.identify.likelihood import maximum_likelihood
from labpipe.identify.measured import measured_part
from labpipe.identify.settings import MODELS, FitSettings
from labpipe.identify.setup import Setup
from labpipe.records.response import FrequencyResponse, Port

SOURCE = Path(__file__).parents[2] / "docs/plugin/src"


@pytest.fixture
def part(monkeypatch: pytest.MonkeyPatch):
    """Import a module of the plug-in."""
    monkeypatch.syspath_prepend(str(SOURCE))

    def load(name: str) -> ModuleType:
        sys.modules.pop(f"labpipe_example.{name}", None)
        return importlib.import_module(f"labpipe_example.{name}")

    return load


def test_the_reader_gives_what_was_stored_in_any_chunks(part, tmp_path: Path, rng: np.random.Generator, monkeypatch) -> None:
    module = part("r16_table")
    samples = rng.integers(-30_000, 30_000, (1000, 2)).astype("<i2")
    channels = [{"name": "f", "unit": "N", "scale": 0.5}, {"name": "y", "unit": "um", "scale": 0.01}]
    path = tmp_path / "a.r16"
    path.write_bytes(json.dumps({"rate_hz": 2000, "channels": channels}).encode() + b"\n" + samples.tobytes())
    monkeypatch.setattr(module, "CHUNK_ROWS", 300)
    table = module.R16Table(path)
    np.testing.assert_allclose(np.concatenate(list(table.chunks(["y", "f"]))), samples[:, ::-1] * [0.01, 0.5])
    assert (table.sample_rate, table.units) == (2000.0, {"f": "N", "y": "um"})


HEAD = b'{"rate_hz": 1, "channels": [{"name": "a", "unit": "V", "scale": 1}]}\n'


@pytest.mark.parametrize(("content", "said"), [(b"no JSON\n12", "does not begin"), (HEAD + b"123", "ends within a sample")])
def test_the_reader_refuses_what_it_cannot_read(part, tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "a.r16"
    path.write_bytes(content)
    with pytest.raises(DataError, match=said):
        part("r16_table").R16Table(path)


def test_disturbed_lines_pull_ml_but_not_the_robust_estimator(part, rng: np.random.Generator) -> None:
    """Closed form: the FRF of k = 80 kN/m, c = 40 N s/m, m = 2 kg with 1 % noise. Two of 60 lines are 30 % too large.

    Both are below the resonance: one on either side would cancel in k.
    """
    frequency = np.linspace(25, 40, 60)
    omega = 2 * np.pi * frequency
    exact = 1 / (80e3 - 2 * omega**2 + 40j * omega)
    sigma = 0.01 * np.abs(exact)
    noisy = exact + sigma * (rng.normal(size=60) + 1j * rng.normal(size=60)) / np.sqrt(2)
    noisy[[10, 14]] *= 1.3
    ports = (Port("y", "y", "y", np.pi / 2),)
    response = FrequencyResponse(frequency, noisy[:, None, None], ports, ports, covariance=(sigma**2 + 0j)[:, None, None])
    measured = measured_part(response, [0], [0], np.full(60, True))
    model = MODELS["sdof"](Setup(ports, ports, FitSettings("sdof", mass=2.0)))
    plain, own = maximum_likelihood(measured, model), part("robust").robust(measured, model)
    errors = [abs(estimate.values[0] - 80e3) / np.sqrt(own.covariance[0, 0]) for estimate in (plain, own)]
    assert errors[1] < 2 and errors[0] > 2 * errors[1]
    assert "lines weigh less" in own.notes[-1]
    with pytest.raises(Exception, match="needs the noise"):
        part("robust").robust(replace(measured, covariance=None), model)


def test_the_damper_is_that_of_the_closed_form(part) -> None:
    """By hand at 30 % eccentricity: c = pi mu R (L/c)^3 / (2 (1 - e^2)^1.5) = 24 428 N s/m, k = 2 mu R (L/c)^3 w e / (1 - e^2)^2."""
    module = part("squeeze_film")
    sizes = {"kind": "squeeze-film-damper", "diameter": 0.1, "length": 0.03, "clearance": 1e-4, "viscosity": 0.01, "frequency": 100.0}
    centred, eccentric = module.coefficients([module.SqueezeFilm(**sizes), module.SqueezeFilm(**sizes, eccentricity=0.3)])
    np.testing.assert_allclose(eccentric.damping, 24428.205 * np.eye(2), rtol=1e-6)
    np.testing.assert_allclose(eccentric.stiffness, 27_000 * 2 * np.pi * 100 * 0.3 / 0.91**2 * np.eye(2), rtol=1e-12)
    assert not centred.stiffness.any()
    with pytest.raises(ConfigError, match="eccentricity"):
        module.SqueezeFilm(**sizes, eccentricity=1.0)
