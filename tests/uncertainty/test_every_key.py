"""Every key of a comparison with every kind: it changes what is found, or it is refused at its line with the
kinds that take it.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labpipe.artefacts.json_file import entry_of
from labpipe.errors import ConfigError, ConfigErrors, LabpipeError
from labpipe.estimation.fitting import identify
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.schema import pipeline_schema
from labpipe.records.response import FrequencyResponse, Port
from labpipe.uncertainty import settings as comparison_settings
from labpipe.uncertainty.compare import Evidence, compare
from labpipe.uncertainty.settings import (
    COMPARISONS,
    CompareSettings,
    ComparisonKind,
    TheorySettings,
    comparison_kind,
    takers,
)
from tests.methods.magnetic_bearing import certified, loop_cases
from tests.uncertainty.conftest import a_fit
from tests.uncertainty.test_theory import BENDING, PEAKS, measured as of_shaft

# A walk over everything: it runs with the long tests.
pytestmark = pytest.mark.long

BEARINGS = Path(__file__).parents[2] / "configs/bearings"
OF_SHAFT = TheorySettings(bearing="nsk-6208.yaml", entry=("loads.z",))
OF_LOOP = TheorySettings(bearing="hmb-magnetic.yaml")


def preloads() -> Evidence:
    """Peaks of a shaft on the 6208 at three preloads, up and down, whose values scatter between the tests."""
    rng, responses, fits = np.random.default_rng(1), [], []
    for way, preload in itertools.product(("up", "down"), (427.0, 500.0, 600.0)):
        name = f"{preload:g} {way}"
        made = of_shaft(1.12 * (preload / 427) ** 0.7 * rng.uniform(0.98, 1.02), BENDING, rng)
        conditions = {"preload": f"{preload:g} N", "way": way, "speed": f"{rng.uniform(1, 9)!r} Hz"}
        responses.append(replace(made, name=name, conditions=conditions))
        fits += [replace(fit, test=name) for fit in identify(made, PEAKS)]
    return Evidence(tuple(fits), tuple(responses), (PEAKS,), folder=BEARINGS)


def two_directions() -> Evidence:
    """A reciprocal matrix of x and y, with noise."""
    rng = np.random.default_rng(2)
    matrix = np.broadcast_to(np.array([[2.0, 1.0], [1.0, 3.0]], complex), (40, 2, 2))
    noise = 0.05 * (rng.standard_normal(matrix.shape) + 1j * rng.standard_normal(matrix.shape)) / np.sqrt(2)
    covariance = np.broadcast_to(0.05**2 * np.eye(4), (40, 4, 4)).astype(complex)
    outputs, inputs = (tuple(Port(f"{kind}{dof}", dof, dof) for dof in "xy") for kind in ("", "f"))
    return Evidence(
        (),
        (
            FrequencyResponse(
                np.arange(1.0, 41.0), matrix + noise, outputs, inputs, covariance=covariance, name="t"
            ),
        ),
        (),
    )


def two_speeds() -> Evidence:
    """Two tests of k, c and m in two bands; the second k differs by 2.4 standard errors."""
    fits, responses = [], []
    for speed, shift in (("0 rpm", 0.0), ("8000 rpm", 3.4)):
        for number in (0, 1):
            values = {"k": (1e5 + 100 * shift * number, 100.0), "c": (100.0, 1.0), "m": (1.0, 0.01)}
            fits.append(replace(a_fit(speed, values, name="a"), band_hz=(10.0 * number, 10.0 * number + 10)))
        conditions = {"speed": speed, "gear": "high" if shift else "low"}
        responses.append(replace(certified.response(None), name=speed, conditions=conditions))
    return Evidence(tuple(fits), tuple(responses), ())


def bands_of_a_loop() -> Evidence:
    view = loop_cases.measured(loop_cases.bearing("hmb-magnetic"), np.random.default_rng(3), fits=True)
    response = replace(view.response, name="t", conditions={"gain": "3000", "way": "up"})
    fits = tuple(replace(fit, test="t", term="y") for fit in view.fits)
    return Evidence(fits, (response,), (view.settings,), folder=BEARINGS)


def signals() -> Evidence:
    """Both sides of a sum under an injection, also under other names, and a fit with a damping ratio."""
    made = certified.response(np.random.default_rng(4))
    again = (*made.outputs, *(Port(f"other_{port.label}", port.label, port.dof) for port in made.outputs))
    assert made.covariance is not None
    doubled = np.tile(made.covariance, (1, 2, 2))
    response = replace(
        made,
        matrix=np.concatenate([made.matrix, 1.01 * made.matrix], axis=1),
        outputs=again,
        covariance=doubled,
        name="t",
    )
    zeta = dataclasses.replace(
        a_fit("t", {"k": (0.03, 0.001)}, name="a").parameters[0], name="zeta", unit="1"
    )
    fit = replace(a_fit("t", {"k": (1.0, 0.1)}, name="a"), parameters=(zeta,))
    return Evidence((fit,), (response,), (), folder=BEARINGS)


PEAK = {"fit": "peaks", "term": "z", "over": "preload"}
# Evidence of each kind, and settings with which it answers.
CASES: dict[str, tuple[Callable[[], Evidence], dict[str, Any]]] = {
    "trend": (preloads, PEAK),
    "difference": (preloads, {**PEAK, "group": "way", "groups": ("up", "down")}),
    "quotient": (preloads, {**PEAK, "group": "way", "groups": ("up", "down")}),
    "repeatability": (preloads, {"fit": "peaks", "term": "z", "group": "way"}),
    "ratio": (preloads, {**PEAK, "theory": OF_SHAFT}),
    "rayleigh": (preloads, {**PEAK, "theory": OF_SHAFT}),
    "reciprocity": (two_directions, {}),
    "bands": (two_speeds, {"fit": "a", "group": "speed", "groups": ("0 rpm", "8000 rpm")}),
    "prediction": (bands_of_a_loop, {"fit": "sliding", "theory": OF_LOOP}),
    "sensitivity": (signals, {"theory": OF_LOOP}),
    "certificate": (signals, {"theory": OF_LOOP}),
}
# A value of each key as it is written, and as settings hold it; by the kind where they differ.
WRITTEN = {
    "fit": "b",
    "term": "x",
    "parameter": "c",
    "over": "speed",
    "tolerance": "20 %",
    "group": "preload",
    "groups": "[down, up]",
    "law": "power",
    "setting_error": "5 %",
    "theory": "{bearing: FILE, entry: loads.z}",
    "estimate": "[delay]",
    "before": "other_before",
    "after": "other_after",
    "level": "60 %",
}
VALUES: dict[str, Any] = {"groups": ("down", "up"), "estimate": ("delay",), "theory": None}
OF_KIND: dict[tuple[str, str], Any] = {
    ("ratio", "theory"): replace(OF_SHAFT, shaft="1e8 N/m"),
    ("prediction", "over"): "gain",
    ("prediction", "theory"): TheorySettings(bearing="hmb-geometry.yaml"),
    ("bands", "groups"): ("8000 rpm", "0 rpm"),
    ("bands", "group"): "gear",
    ("certificate", "fit"): "a",
}
# What else a key needs to have a meaning.
BESIDE: dict[tuple[str, str], dict[str, Any]] = {
    ("prediction", "over"): {
        "theory": TheorySettings(bearing="hmb-magnetic.yaml", entry=("loop.proportional",))
    },
    ("certificate", "fit"): {"theory": None},
}
PAIRS = list(itertools.product(COMPARISONS, WRITTEN))


@functools.cache
def made_by(maker: Callable[[], Evidence]) -> Evidence:
    """Once for all kinds that share it."""
    return maker()


def evidence_of(kind: str) -> Evidence:
    return made_by(CASES[kind][0])


@functools.cache
def plain(kind: str) -> str:
    return found(kind)


def found(kind: str, **more: Any) -> str:
    """All that a comparison says, in numbers and words; where it is not possible, why."""
    try:
        return repr(
            entry_of(
                compare(CompareSettings(kind=kind, name="a", **{**CASES[kind][1], **more}), evidence_of(kind))
            )
        )
    except LabpipeError as error:
        return error.what


def test_every_key_and_kind_is_walked() -> None:
    assert {*WRITTEN, "kind"} == {
        field.name for field in fields(CompareSettings) if "setting" in field.metadata
    }
    assert set(CASES) == set(COMPARISONS)


@pytest.mark.parametrize(
    ("kind", "key"), [pair for pair in PAIRS if pair[0] in takers(pair[1]) and pair[1] != "level"]
)
def test_a_key_that_is_taken_changes_what_is_found(kind: str, key: str) -> None:
    beside = BESIDE.get((kind, key), {})
    changed = OF_KIND.get((kind, key), VALUES.get(key, WRITTEN[key]))
    without = found(kind, **beside) if beside else plain(kind)
    assert found(kind, **{**beside, key: changed}) != without


@pytest.mark.parametrize("kind", takers("level"))
def test_a_level_on_either_side_of_the_p_value_changes_the_verdict(kind: str) -> None:
    settings = CompareSettings(kind=kind, name="a", **CASES[kind][1])
    p_value = compare(settings, evidence_of(kind)).amount("p_value").value
    below, above = (
        compare(replace(settings, level=level), evidence_of(kind)).verdict
        for level in (0.9 * p_value, p_value**0.9)
    )
    assert below != above


@pytest.mark.parametrize(("kind", "key"), [pair for pair in PAIRS if pair[0] not in takers(pair[1])])
def test_a_key_that_is_not_taken_is_refused_at_its_line(kind: str, key: str, tmp_path: Path) -> None:
    value = WRITTEN[key].replace("FILE", str(BEARINGS / "nsk-6208.yaml"))
    with pytest.raises(ConfigErrors) as refused:
        load_pipeline(written(tmp_path, f"{{kind: {kind},\n    {key}: {value}}}"))
    (fault,) = refused.value.faults
    assert str(fault).startswith(f"{tmp_path / 'p.yaml'}:9:5: compare.q.{key}: ")
    assert fault.what.endswith(f"is not for the kind {kind}") and fault.hint.endswith(
        f"kinds that take it: {', '.join(takers(key))}"
    )
    with pytest.raises(ConfigError, match=f"'{key}' is not for the kind {kind}"):
        CompareSettings(
            kind=kind,
            **{**CASES[kind][1], key: OF_SHAFT if key == "theory" else VALUES.get(key, WRITTEN[key])},
        )


def written(folder: Path, comparison: str) -> Path:
    """A pipeline whose last lines, from the eighth on, are a comparison q."""
    (folder / "rig.yaml").write_text(
        "name: R\nsample_rate: 1 kHz\nchannels:\n  f: {quantity: force}\n  x: {quantity: displacement}\n"
    )
    (folder / "a.csv").write_text("f,x\n1,2\n")
    head = (
        "rig: rig.yaml\nrecordings: a.csv\nfrf: {excitation: periodic, period: 1 s}\nidentify:\n  b: "
        "{model: sdof,\n    mass: 1 kg}\n"
    )
    (folder / "p.yaml").write_text(f"{head}compare:\n  q: {comparison}\n")
    return folder / "p.yaml"


@pytest.mark.parametrize("kind", [kind for kind in COMPARISONS if not comparison_kind(kind).section])
def test_the_section_of_another_kind_is_refused_at_its_line(kind: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigErrors) as refused:
        load_pipeline(written(tmp_path, f"{{kind: {kind},\n    certificate: {{zone: A}}}}"))
    (fault,) = refused.value.faults
    assert str(fault) == (
        f"{tmp_path / 'p.yaml'}:9:5: compare.q.certificate: is not for the kind {kind}; kind: certificate"
    )


def test_a_section_of_a_kind_is_read_with_its_faults(tmp_path: Path) -> None:
    (settings,) = load_pipeline(
        written(tmp_path, "{kind: certificate,\n    certificate: {zone: A}}")
    ).sections["compare"]
    assert settings.kind_settings.zone == "A"
    with pytest.raises(ConfigErrors, match=r"9:19: compare\.q\.certificate\.zone: unknown choice 'Z'"):
        load_pipeline(written(tmp_path, "{kind: certificate,\n    certificate: {zone: Z}}"))


@pytest.mark.parametrize("entry", ["shaft: 1 kN/m", "arm: 1 m"])
def test_a_loop_has_no_shaft_that_bends(entry: str, tmp_path: Path) -> None:
    file = BEARINGS / "hmb-magnetic.yaml"
    with pytest.raises(ConfigErrors, match=f"'theory.{entry.split(':')[0]}' is not for the kind sensitivity"):
        load_pipeline(written(tmp_path, f"{{kind: sensitivity,\n    theory: {{bearing: {file}, {entry}}}}}"))


def test_a_function_of_a_plug_in_takes_every_key_over_one_condition(monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(settings: CompareSettings, _evidence: Evidence) -> str:
        return settings.law

    plain = comparison_settings.comparison_kind
    monkeypatch.setattr(COMPARISONS, "load", lambda _name: answer)
    assert not isinstance(COMPARISONS.load("trend"), ComparisonKind) and "law" in plain("trend").keys
    assert compare(CompareSettings(kind="trend", law="power"), Evidence((), (), ())) == "power"
    with pytest.raises(ConfigError, match="goes over 1 condition"):
        CompareSettings(kind="trend", over=("a", "b"))


def test_the_schema_knows_the_sections_of_kinds_and_which_kinds_take_a_key() -> None:
    entry = pipeline_schema()["properties"]["compare"]["additionalProperties"]["properties"]
    assert set(entry["certificate"]["properties"]) >= {"zone", "after", "log_decrement"}
    assert entry["law"]["description"].endswith("(kinds trend)")
