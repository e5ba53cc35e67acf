"""Uncertainties in rig files: short and long form, what each is of, calibration fits that bring theirs,
faults at their place.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from labpipe.errors import ConfigErrors
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.rig_file import load_rig
from labpipe.records.uncertain import ChannelUncertainty, Uncertainty

PROBE = "quantity: displacement, unit: V, sensitivity: 8 V/mm"


def uncertainties_of(tmp_path: Path, entry: str) -> tuple[ChannelUncertainty, ...]:
    path = tmp_path / "rig.yaml"
    path.write_text(f"sample_rate: 1 kHz\nchannels:\n  x: {{{entry}}}\n")
    return load_rig(path).channels[0].channel.uncertainties


@pytest.mark.parametrize(
    ("entry", "effect", "uncertainty"),
    [
        (f"{PROBE} +- 1 %", "gain", Uncertainty("x.sensitivity 8 V/mm", 0.01, "1")),
        (f"{PROBE} +- 0.08 V/mm", "gain", Uncertainty("x.sensitivity 8 V/mm", 0.01, "1")),
        (
            f'{PROBE}, uncertainty: {{gain: "2 % (k=2, dof=30)"}}',
            "gain",
            Uncertainty("x.gain", 0.01, "1", 30.0),
        ),
        (f"{PROBE}, uncertainty: {{phase: 1 deg}}", "phase", Uncertainty("x.phase", math.pi / 180, "rad")),
        (f"{PROBE}, delay: 10 us +- 2 us", "delay", Uncertainty("x.delay 10 us", 2e-6, "s")),
        (
            f"{PROBE}, dof: 45 deg +- 0.5 deg",
            "direction",
            Uncertainty("x.dof 45 deg", math.radians(0.5), "rad"),
        ),
        (f"{PROBE}, dof: x +- 0.5 deg", "direction", Uncertainty("x.dof x", math.radians(0.5), "rad")),
        (
            "quantity: displacement, unit: V, sensitivity: {value: 8 V/mm, limits: 1 %, shape: rectangular, "
            "source: calibrator 7}",
            "gain",
            Uncertainty("calibrator 7", 0.01 / math.sqrt(3), "1", None, "rectangular"),
        ),
        (
            "quantity: displacement, unit: V, sensitivity: {value: 8 V/mm, expanded: 1 %, dof: 12}",
            "gain",
            Uncertainty("x.sensitivity 8 V/mm", 0.005, "1", 12.0),
        ),
    ],
)
def test_a_number_carries_its_uncertainty(
    tmp_path: Path, entry: str, effect: str, uncertainty: Uncertainty
) -> None:
    (found,) = uncertainties_of(tmp_path, entry)
    assert found.effect == effect
    assert (
        found.uncertainty.source,
        found.uncertainty.unit,
        found.uncertainty.dof,
        found.uncertainty.shape,
    ) == (uncertainty.source, uncertainty.unit, uncertainty.dof, uncertainty.shape)
    assert found.uncertainty.std_error == pytest.approx(uncertainty.std_error)


def test_the_number_itself_is_as_without_an_uncertainty(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(
        f"sample_rate: 1 kHz\nmass: 2 kg +- 1 %\nchannels:\n  x: {{{PROBE} +- 1 %, dof: 45 deg +- 1 deg, "
        f"delay: 3 us +- 1 us}}\n"
    )
    rig = load_rig(path)
    (channel,) = rig.channels
    assert (rig.mass, rig.mass_uncertainty.std_error) == (2.0, pytest.approx(0.02))
    assert channel.scale == pytest.approx(1 / 8000)
    assert channel.channel.angle == pytest.approx(math.pi / 4)
    assert channel.channel.delay == 3e-6


def test_a_calibration_fit_brings_the_error_of_its_slope(tmp_path: Path) -> None:
    slope = {"name": "slope", "value": 8.0, "unit": "V/mm", "std_error": 0.04}
    (tmp_path / "cal.json").write_text(
        json.dumps({"fits": [{"name": "probe", "dof": 9, "parameters": [slope]}]})
    )
    (found,) = uncertainties_of(tmp_path, "quantity: displacement, unit: V, sensitivity: cal.json#probe")
    assert (found.effect, found.uncertainty.dof, found.uncertainty.source) == (
        "gain",
        9,
        "sensitivity cal.json#probe",
    )
    assert found.uncertainty.std_error == pytest.approx(0.005)
    # Another channel with this slope has its error.
    path = tmp_path / "two.yaml"
    entry = "{quantity: displacement, unit: V, sensitivity: cal.json#probe}"
    path.write_text(f"sample_rate: 1 kHz\nchannels:\n  x: {entry}\n  y: {entry}\n")
    first, second = (channel.channel.uncertainties for channel in load_rig(path).channels)
    assert first == second == (found,)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (f"{PROBE} +- 1 kg", "channels.x.sensitivity"),
        (f"{PROBE} +- 1 % (rectanglar)", "did you mean 'rectangular'?"),
        (f'{PROBE}, uncertainty: {{gain: "1 % (shape=round)"}}', "'shape=round' says nothing of"),
        (f"{PROBE}, dof: 45 deg +- 1 %", "'1 %' is relative, of zero"),
        (f"{PROBE}, uncertainty: {{phase: 1 %}}", "'1 %' is relative, of zero"),
        (f"{PROBE} +- 40000 %", "'40000 %' is more than 10 times the value"),
        (f'{PROBE}, uncertainty: {{gain: "1 % (k=2, k=2)"}}', "'k=2' stands beside another k"),
        (f"{PROBE[:-6]}{{value: 8 V/mm, std: 1 %, limits: 2 %}}", "'limits=2 %' says nothing"),
        (f"{PROBE[:-6]}{{value: 8 V/mm, std: 1 %, k: 2}}", "'k=2' stands beside another k"),
        (f"{PROBE}, dof: 45 deg +- 1 kg", "channels.x.dof"),
        (f"{PROBE}, uncertainty: {{gian: 1 %}}", "did you mean 'gain'?"),
        (
            "quantity: displacement, unit: V, sensitivity: {value: 8 V/mm, limit: 1 %}",
            "channels.x.sensitivity",
        ),
    ],
)
def test_faults_stand_at_their_place(tmp_path: Path, entry: str, message: str) -> None:
    with pytest.raises(ConfigErrors, match=r"rig.yaml:3:\d+: ") as caught:
        uncertainties_of(tmp_path, entry)
    assert any(message in str(fault) for fault in caught.value.faults)


def test_a_number_that_cannot_be_read_is_one_fault(tmp_path: Path) -> None:
    with pytest.raises(ConfigErrors) as caught:
        uncertainties_of(tmp_path, "quantity: displacement, unit: V, sensitivity: 8 V/mmm +- 1 %")
    (fault,) = caught.value.faults
    assert "unknown unit 'mmm'; did you mean 'mm'?" in str(fault)


PIPELINE = """frfs: h.frf.csv
uncertainty: {{{uncertainty}}}
identify:
  a: {{model: sdof, mass: {{value: 2 kg, std: 1 %}}}}
  b: {{model: sdof, monte_carlo: 300, coverage: 90 %}}
"""


def pipeline_of(tmp_path: Path, uncertainty: str):
    (tmp_path / "h.frf.csv").write_text("frequency_hz,x/f:re,x/f:im\n1,2,3\n2,3,4\n")
    (tmp_path / "p.yaml").write_text(PIPELINE.format(uncertainty=uncertainty))
    return load_pipeline(tmp_path / "p.yaml")


def test_the_pipeline_says_how_uncertainties_are_propagated(tmp_path: Path) -> None:
    a, b = pipeline_of(tmp_path, "coverage: 99 %, method: monte-carlo, draws: 500").fits
    assert (a.coverage, a.monte_carlo) == (0.99, 500)
    assert (b.coverage, b.monte_carlo) == (0.9, 300)
    assert dict(a.uncertainties)["mass"].std_error == pytest.approx(0.02)
    first, _ = pipeline_of(tmp_path, "method: first-order").fits
    assert (first.coverage, first.monte_carlo) == (0.95, 0)


def test_what_a_fit_states_stands_also_where_it_is_the_default(tmp_path: Path) -> None:
    (tmp_path / "h.frf.csv").write_text("frequency_hz,x/f:re,x/f:im\n1,2,3\n2,3,4\n")
    text = PIPELINE.format(uncertainty="coverage: 99 %, method: monte-carlo")
    (tmp_path / "p.yaml").write_text(text.replace("300, coverage: 90 %", "0, coverage: 95 %"))
    a, b = load_pipeline(tmp_path / "p.yaml").fits
    assert (a.coverage, a.monte_carlo) == (0.99, 2000)
    assert (b.coverage, b.monte_carlo) == (pytest.approx(0.95, rel=1e-12), 0)


def test_too_few_draws_are_no_draws(tmp_path: Path) -> None:
    for draws in (0, 199):
        with pytest.raises(ConfigErrors, match=f"{draws} draws give no 95 % interval; at least 200"):
            pipeline_of(tmp_path, f"method: monte-carlo, draws: {draws}")


def test_an_unknown_method_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigErrors, match="did you mean 'monte-carlo'"):
        pipeline_of(tmp_path, "method: monte-calro")


def test_the_key_of_the_version_before_is_read_with_a_note(tmp_path: Path) -> None:
    with pytest.warns(
        FutureWarning, match=r"rig\.yaml:3:\d+: channels\.x\.doubt is called 'uncertainty' now"
    ):
        (found,) = uncertainties_of(tmp_path, f"{PROBE}, doubt: {{gain: 1 %}}")
    assert found == ChannelUncertainty("gain", Uncertainty("x.gain", 0.01, "1"))
    with pytest.raises(ConfigErrors, match="doubt: unknown key"):
        uncertainties_of(tmp_path, f"{PROBE}, doubt: {{gain: 1 %}}, uncertainty: {{gain: 2 %}}")


@pytest.mark.parametrize(
    ("size", "divisor"), [("expanded: 1 %, k: 1.65", 1.65), ("std: 1 %", 1.0), ("limits: 1 %", math.sqrt(3))]
)
def test_a_shape_divides_limits_alone(tmp_path: Path, size: str, divisor: float) -> None:
    """GUM 4.3.3: a stated multiple of a standard uncertainty is divided by that multiple, whatever the
    distribution; 4.3.7: limits of a rectangular one by the root of 3.
    """
    (found,) = uncertainties_of(tmp_path, f"{PROBE[:-6]}{{value: 8 V/mm, {size}, shape: rectangular}}")
    assert found.uncertainty.std_error == pytest.approx(0.01 / divisor)
    assert found.uncertainty.shape == "rectangular"


def test_a_calibration_by_groups_has_no_one_slope(tmp_path: Path) -> None:
    """Two positions of a magnet, two slopes of one name: neither is that of the sensor."""
    fits = [
        {"name": "probe", "dof": 9, "parameters": [{"name": "slope", "value": value, "unit": "V/mm"}]}
        for value in (8.0, 9.0)
    ]
    (tmp_path / "cal.json").write_text(json.dumps({"fits": fits}))
    with pytest.raises(
        ConfigErrors, match=r"'cal\.json' holds 2 calibration fits 'probe'; one for each group"
    ):
        uncertainties_of(tmp_path, "quantity: displacement, unit: V, sensitivity: cal.json#probe")
