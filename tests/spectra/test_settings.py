"""The FRF settings as people write them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from labpipe.errors import ConfigError
from labpipe.project.marked_yaml import load_marked
from labpipe.project.schema import pipeline_schema
from labpipe.project.settings_reader import Faults, read_settings
from labpipe.records.settings import settings_of
from labpipe.spectra.settings import (
    EXCITATIONS,
    KEYS,
    FreeDecaySettings,
    FrfSettings,
    ImpactSettings,
    MaskSettings,
    ShaftLines,
)


def read(tmp_path: Path, text: str) -> tuple[FrfSettings | None, Faults]:
    (tmp_path / "p.yaml").write_text(text)
    faults = Faults()
    return read_settings(FrfSettings, load_marked(tmp_path / "p.yaml"), "frf", faults), faults


def test_a_mask_by_speed(tmp_path: Path) -> None:
    found, _ = read(
        tmp_path, "excitation: random\nblock: 5 s\nmask: {speed: 3000 rpm, harmonics: 3, width: 0.5 Hz}\n"
    )
    assert found is not None and found.mask == MaskSettings(speed=50.0, harmonics=3, width=0.5)
    assert found.remove is None and found.detrend == "constant"


def test_removal_by_tacho(tmp_path: Path) -> None:
    found, _ = read(
        tmp_path,
        "excitation: random\nblock: 5 s\nremove: {tacho: key, pulses: 2}\ndetrend: "
        "linear\ndirectional: true\n",
    )
    assert found is not None and found.remove == ShaftLines(tacho="key", pulses=2)
    assert found.detrend == "linear" and found.directional


def test_hits(tmp_path: Path) -> None:
    text = (
        "excitation: impact\nblock: 2 s\nimpact: {trigger: 20 %, decay: 300 ms, force_window: 5 ms, "
        "double_hit: 5 %, reject: [3, 4]}\n"
    )
    found, _ = read(tmp_path, text)
    assert found is not None
    assert found.impact == ImpactSettings(
        trigger=0.2, decay=0.3, force_window=5e-3, double_hit=0.05, reject=("3", "4")
    )
    assert found.impact.reject == (3, 4)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("excitation: impact\n", "'block' is missing"),
        (
            "excitation: random\nblock: 5 s\nmask: {speed: 9 Hz, harmonic: 3}\n",
            "mask.harmonic: unknown key; did you mean 'harmonics'?",
        ),
        ("excitation: random\nblock: 5 s\nmask: {speed: 50 N}\n", "frf.mask.speed"),
        (
            "excitation: random\nblock: 5 s\nremove: {speed: 50 Hz, tacho: key}\n",
            "one of 'speed' and 'tacho'",
        ),
        ("excitation: sweep\nremove: {speed: 50 Hz}\n", "'remove' is not for sweep excitation"),
        ("excitation: random\nblock: 5 s\ndetrend: square\n", "unknown choice 'square'"),
        (
            "excitation: impact\nblock: 1 s\nimpact: {pretrigger: 100 %}\n",
            "pretrigger must be at least 0 and below 100 %",
        ),
        ("excitation: impact\nblock: 1 s\nimpact: {reject: [two]}\n", "'two' is not the number of a hit"),
        ("excitation: impact\nblock: -1 s\n", "block must be positive"),
        (
            "excitation: impact\nblock: 1 s\nband: 1-100 Hz\nexclude: [49-51 Hz, 49-51 kHz]\n",
            "frf.exclude: 'exclude' of 49000-51000 Hz leaves nothing out of the band of 1 to 100 Hz",
        ),
    ],
)
def test_faults_are_said_at_their_place(tmp_path: Path, text: str, fault: str) -> None:
    found, faults = read(tmp_path, text)
    assert found is None
    with pytest.raises(ConfigError) as caught:
        faults.raise_any()
    assert fault in str(caught.value) and "p.yaml:" in str(caught.value)


WRITTEN = {
    **{
        "period": "1 s",
        "block": "1 s",
        "skip": "2",
        "settle": "1 s",
        "smooth": "3",
        "window": "hamming",
        "overlap": "25 %",
    },
    **{
        "detrend": "linear",
        "estimator": "H2",
        "local": "polynomial",
        "degree": "4",
        "half_width": "9",
        "band": "1-9 Hz",
    },
    **{
        "exclude": "[2-3 Hz]",
        "mask": "{speed: 5 Hz, width: 1 Hz}",
        "remove": "{speed: 5 Hz}",
        "realisations": "true",
    },
    **{
        "impact": "{trigger: 20 %}",
        "windowed": "{exponential: 1 s}",
        "decay": "{start: 1 s}",
        "result": "spectra",
    },
    **{"reference": "r", "directional": "true"},
}
NEEDED = {"periodic": "period: 1 s\n", "random": "block: 1 s\n", "impact": "block: 1 s\n"}


def test_every_key_of_the_section_is_walked() -> None:
    assert {"excitation", *WRITTEN} == set(settings_of(FrfSettings))
    assert set(KEYS) == set(EXCITATIONS) and {key for keys in KEYS.values() for key in keys} == set(WRITTEN)


@pytest.mark.parametrize(
    ("excitation", "key"), [(e, key) for e in EXCITATIONS for key in WRITTEN if key not in KEYS[e]]
)
def test_a_key_of_another_excitation_is_refused_at_its_line(
    tmp_path: Path, excitation: str, key: str
) -> None:
    needed = NEEDED.get(excitation, "")
    found, faults = read(tmp_path, f"excitation: {excitation}\n{needed}{key}: {WRITTEN[key]}\n")
    assert found is None
    able = ", ".join(other for other in EXCITATIONS if key in KEYS[other])
    hint = f"leave it out; excitations that take it: {able}"
    what = f"p.yaml:{3 if needed else 2}:1: frf.{key}: '{key}' is not for {excitation} excitation; {hint}"
    with pytest.raises(ConfigError) as caught:
        faults.raise_any()
    assert str(caught.value).endswith(what)


@pytest.mark.parametrize("key", ["window", "overlap", "detrend", "degree", "half_width"])
def test_blocks_have_a_window_or_polynomials(tmp_path: Path, key: str) -> None:
    local = "local: polynomial\n" if key in ("window", "overlap", "detrend") else ""
    _, faults = read(tmp_path, f"excitation: random\nblock: 1 s\n{local}{key}: {WRITTEN[key]}\n")
    way = "none" if local else "polynomial"
    with pytest.raises(
        ConfigError, match=rf"p.yaml:{4 if local else 3}:1: frf.{key}: '{key}' is for local: {way}"
    ):
        faults.raise_any()


def test_the_schema_knows_the_sections() -> None:
    frf = pipeline_schema()["properties"]["frf"]["properties"]
    assert frf["mask"]["properties"]["harmonics"] == {
        "type": "integer",
        "minimum": 0,
        "description": "multiples of the speed that count, from 1x",
    }
    assert set(frf["excitation"]["enum"]) == {
        "periodic",
        "random",
        "impact",
        "decay",
        "stepped-sine",
        "sweep",
    }
    assert json.dumps(frf)


def test_keys_that_would_change_nothing_are_refused() -> None:
    with pytest.raises(ConfigError, match="'pulses' belong to a tacho"):
        ShaftLines(speed=50.0, pulses=2)
    for name, value in (("settle", 0.1), ("trigger", 0.2)):
        with pytest.raises(ConfigError, match=f"'{name}' is for decays that are looked for"):
            FreeDecaySettings(start=1.0, **{name: value})
