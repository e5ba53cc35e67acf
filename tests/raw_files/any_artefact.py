"""Artefacts of random content, the same for the same seed, and the folder's file of each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.artefacts.header import Header
from labpipe.artefacts.identification_file import write_identification
from labpipe.artefacts.measured_files import write_decays, write_response, write_spectra
from labpipe.artefacts.recording_file import RecordingWriter, recording_contents
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit, Goodness, Identification
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.records.spectra import ChannelSpectra, FreeDecay, FreeDecays


def spread(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Numbers of all sizes."""
    return rng.normal(size=shape) * 10.0 ** rng.integers(-9, 9, shape)


def response(seed: int) -> FrequencyResponse:
    rng = np.random.default_rng(seed)
    n, outputs, inputs = (
        int(rng.integers(2, 5)),
        ("x", "y")[: int(rng.integers(1, 3))],
        ("f", "g")[: int(rng.integers(1, 3))],
    )
    shape = (n, len(outputs), len(inputs))
    return FrequencyResponse(
        frequency=np.cumsum(rng.uniform(0.1, 3, n)),
        matrix=spread(rng, *shape) + 1j * spread(rng, *shape),
        outputs=tuple(Port(name, name, name) for name in outputs),
        inputs=tuple(Port(name, name, name) for name in inputs),
        form=("receptance", "mobility", "accelerance")[int(rng.integers(3))],
        covariance=diagonal_covariance(np.abs(spread(rng, *shape))) if rng.random() < 0.7 else None,
        coherence=rng.uniform(0, 1, shape) if rng.random() < 0.7 else None,
        name="h",
    )


def recording(seed: int) -> Recording:
    rng = np.random.default_rng(seed)
    channels = (Channel("f", "force", "input", "y"), Channel("y", "displacement", "output", "y"))
    return Recording(
        channels, spread(rng, int(rng.integers(3, 40)), 2), float(rng.choice([100.0, 1024.0, 3000.0])), "r"
    )


def spectra(seed: int) -> ChannelSpectra:
    rng = np.random.default_rng(seed)
    noise = np.abs(spread(rng, 3, 2, 2))
    channels = (Channel("f", "force", "input", "y"), Channel("y", "displacement", "output", "y"))
    vectors = spread(rng, 3, 2, 2) + 1j * spread(rng, 3, 2, 2)
    return ChannelSpectra(
        np.cumsum(rng.uniform(0.1, 3, 3)),
        vectors,
        noise[..., None] * np.eye(2),
        channels,
        ("a", "b"),
        name="s",
    )


def decays(seed: int) -> FreeDecays:
    rng = np.random.default_rng(seed)
    parts = tuple(
        FreeDecay(name, float(rng.uniform(0, 9)), spread(rng, int(rng.integers(2, 9)), 1))
        for name in ("a", "b")
    )
    return FreeDecays(float(rng.choice([100.0, 3000.0])), (Port("y", "y", "y"),), ("m",), parts, name="d")


def fit(seed: int, *names: str, **parts: Any) -> Fit:
    """A fit with parameters of these names, and uncertainty of all of them but the last."""
    rng = np.random.default_rng(seed)
    errors: list[Any] = [*np.abs(spread(rng, len(names) - 1)), None] if len(names) > 1 else [1.0]
    parameters = tuple(
        Parameter(
            name,
            float(spread(rng)),
            "N/m",
            std_error=error,
            ci95=None if error is None else (-float(error), float(error)),
        )
        for name, error in zip(names, errors, strict=True)
    )
    corner = float(rng.uniform(-0.9, 0.9))
    correlation = np.eye(len(names)) + corner * (1 - np.eye(len(names)))
    band = (1.0, float(rng.uniform(2, 99)))
    fields = {
        "band_hz": band,
        "lines": 3,
        "equations": 6,
        "dof": 4,
        "gof": Goodness(0.9, 0.8),
        "condition_number": 2.0,
    }
    return Fit(
        "a", "sdof", "ml", **fields, parameters=parameters, correlation=correlation, test="=t, 1", **parts
    )


def result(folder: Path, *fits: Fit, **sections: Any) -> Path:
    write_identification(folder / "identification.json", Identification(fits, sections=sections))
    return folder / "identification.json"


def measured(folder: Path, record: Any) -> Path:
    """The artefact of a recording, of a response, of spectra or of decays."""
    if isinstance(record, Recording):
        path = folder / "a.recording.parquet"
        with RecordingWriter(path, record.channels) as writer:
            writer.write(record.samples)
            contents = recording_contents(record.channels, record.sample_rate, record.name)
            writer.finish(Header("recording", {}, inputs=(), contents=contents))
        return path
    path, write = next(
        (folder / f"a.{suffix}.parquet", write) for kind, suffix, write in _KINDS if isinstance(record, kind)
    )
    write(path, record, Header(path.suffixes[0][1:], {}, inputs=()))
    return path


_KINDS: tuple[tuple[type, str, Callable[..., None]], ...] = (
    (FrequencyResponse, "frf", write_response),
    (ChannelSpectra, "spectra", write_spectra),
    (FreeDecays, "decay", write_decays),
)
