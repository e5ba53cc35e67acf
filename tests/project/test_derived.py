"""Sums of channels in the rig file: what is read, what is refused and where, and that they reach recordings
and FRFs.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.writing import output_folder
from labpipe.errors import ConfigErrors, DataError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.floating_bearing.virtual_rig import FloatingNoise, FloatingRig
from labpipe.project.ingest import SourceFile, ingest
from labpipe.project.rig_file import load_rig
from labpipe.project.simulate import load_virtual_rig
from labpipe.records.identification import Fit
from labpipe.records.recording import Channel, Number, Recording, SumTerm
from labpipe.records.rig import Rig
from labpipe.simulate.virtual_rigs import recordings
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

CONFIGS = Path(__file__).parents[2] / "configs"
HEAD = """sample_rate: 1 kHz
constants: {m_s: 30 kg +- 0.1 kg, half: 50 %}
channels:
  f: {quantity: force, dof: x}
  a: {quantity: acceleration, dof: x}
  x1: {quantity: displacement, unit: um, dof: 45 deg}
  x2: {quantity: displacement, unit: um, dof: 135 deg}
"""


def rig(folder: Path, *entries: str) -> Rig:
    (folder / "rig.yaml").write_text(HEAD + "".join(f"  {entry}\n" for entry in entries))
    return load_rig(folder / "rig.yaml")


def terms(folder: Path, quantity: str, text: str) -> dict[str, SumTerm]:
    (derived,) = rig(folder, f"s: {{quantity: {quantity}, derived: '{text}', dof: x}}").derived
    return {term.channel: term for term in derived.terms}


@pytest.mark.parametrize(
    ("quantity", "text", "factors"),
    [
        ("force", "f - m_s * a", {"f": 1, "a": -30}),
        ("force", "f - 30 kg +- 0.1 kg * a", {"f": 1, "a": -30}),
        ("force", "-a * 30000 g + f", {"f": 1, "a": -30}),
        ("displacement", "x1 - x2", {"x1": 1, "x2": -1}),
        ("displacement", "half * x1 + 0.5 * x2", {"x1": 0.5, "x2": 0.5}),
        ("displacement", "0.7071 * x1 - 0.7071 * x2", {"x1": 0.7071, "x2": -0.7071}),
        (
            "displacement",
            "cos(45 deg) * x1 - sin(45 deg) * x2",
            {"x1": math.sqrt(0.5), "x2": -math.sqrt(0.5)},
        ),
        ("displacement", "x1 - 0.2 * x1 + 2 mm/N * f", {"x1": 0.8, "f": 2e-3}),
        ("acceleration", "-1 * a", {"a": -1}),
    ],
)
def test_a_sum_is_read_as_an_engineer_writes_it(
    tmp_path: Path, quantity: str, text: str, factors: dict[str, float]
) -> None:
    found = terms(tmp_path, quantity, text)
    assert {name: term.factor for name, term in found.items()} == pytest.approx(factors)


@pytest.mark.parametrize(
    ("text", "name", "error", "derivative"),
    [
        ("f - m_s * a", "m_s", 0.1, -1.0),
        ("f - half * m_s * a", "m_s", 0.1, -0.5),
        ("f - 30 kg ± 1 % * a", "30 kg in s", 0.3, -1.0),
        (
            "f - cos(60 deg +- 2 deg) * 30 kg * a",
            "cos(60 deg in s",
            math.radians(2),
            30 * math.sin(math.radians(60)),
        ),
    ],
)
def test_the_uncertainty_of_a_number_is_kept_with_its_derivative(
    tmp_path: Path, text: str, name: str, error: float, derivative: float
) -> None:
    """d(sum)/d(number), by hand."""
    term = terms(tmp_path, "force", text)["a"]
    assert [number.std_error for number in term.numbers] == pytest.approx([error])
    assert list(term.derivatives) == pytest.approx([derivative])
    assert term.numbers[0].name == name or "(" in name


def test_sums_of_sums_are_written_out(tmp_path: Path) -> None:
    """d = x1 - x2, e = 3 m_s a + 2 kN/mm d: the uncertainty of m_s is in a, once."""
    derived = rig(
        tmp_path,
        "d: {quantity: displacement, derived: x1 - x2}",
        "e: {quantity: force, derived: '3 * m_s * a + 2 kN/mm * d', dof: x}",
    ).derived
    found = {term.channel: term for term in derived[1].terms}
    assert {name: term.factor for name, term in found.items()} == pytest.approx(
        {"a": 90, "x1": 2e6, "x2": -2e6}
    )
    assert found["a"].derivatives == pytest.approx((3.0,)) and found["x1"].numbers == ()
    assert [channel.role for channel in derived] == ["reference", "input"]


def test_members_are_references_unless_the_file_says_otherwise(tmp_path: Path) -> None:
    text = HEAD.replace("a: {quantity: acceleration,", "a: {quantity: acceleration, role: output,")
    (tmp_path / "rig.yaml").write_text(text + "  e: {quantity: force, derived: f - m_s * a, dof: x}\n")
    roles = {channel.name: channel.role for channel in load_rig(tmp_path / "rig.yaml").all_channels}
    assert roles == {"f": "reference", "a": "output", "x1": "output", "x2": "output", "e": "input"}


@pytest.mark.parametrize(
    ("entry", "place", "message"),
    [
        (
            "e: {quantity: force, derived: 'f - m_z * a'}",
            "8:24",
            "'m_z' is neither a channel nor one of the constants; did you mean 'm_s'?",
        ),
        ("e: {quantity: force, derived: 'f-m_s*a'}", "8:24", "blanks around"),
        (
            "e: {quantity: force, derived: 'f - a'}",
            "8:24",
            "'a' is in m/s^2, N is needed for a force; the factor of a is in kg",
        ),
        ("e: {quantity: displacement, derived: 'm_s * x1'}", "8:31", "the factor of x1 is a pure number"),
        ("e: {quantity: force, derived: 'm_s * f * a'}", "8:24", "holds 2 channels"),
        ("e: {quantity: force, derived: 'f - 3 N'}", "8:24", "holds no channel"),
        ("e: {quantity: force, derived: 'f - '}", "8:24", "lacks a term"),
        ("e: {quantity: force, derived: ''}", "8:24", "a text is missing"),
        ("e: {quantity: force, derived: 'f - 3 kgg * a'}", "8:24", "unknown unit 'kgg'"),
        ("e: {quantity: force, derived: 'f', unit: kN}", "8:38", "belongs to a recorded channel"),
        ("e: {quantity: force, derived: 'f + 2 * e'}", "8:24", "the sum contains itself: e of e"),
    ],
)
def test_faults_have_their_place(tmp_path: Path, entry: str, place: str, message: str) -> None:
    with pytest.raises(ConfigErrors) as caught:
        rig(tmp_path, entry)
    (fault,) = caught.value.faults
    assert str(fault).startswith(f"{tmp_path}/rig.yaml:{place}: channels.e.") and message in str(fault)


def test_sums_may_be_listed_by_themselves(tmp_path: Path) -> None:
    """`derived: {e: {sum: {f: 1, a: -30 kg +- 0.1 kg}}}` is the same as the text, and its faults have their
    place.
    """
    text = HEAD + "derived:\n  e: {sum: {f: 1, a: -30 kg +- 0.1 kg}, quantity: force, role: input, dof: x}\n"
    (tmp_path / "rig.yaml").write_text(text)
    (listed,) = load_rig(tmp_path / "rig.yaml").derived
    written = rig(tmp_path, "e: {quantity: force, derived: 1 * f - 30 kg +- 0.1 kg * a, dof: x}").derived[0]
    assert [(term.channel, term.factor) for term in listed.terms] == [
        (term.channel, term.factor) for term in written.terms
    ]
    assert listed.terms[1].numbers[0].std_error == 0.1 and (listed.role, listed.dof) == ("input", "x")
    for broken, message in (
        (text.replace("sum: {f: 1,", "sum: {g: 1,"), r"rig.yaml:9:7: channels.e.derived: 'g' is neither"),
        (
            text.replace("sum: {f: 1, a: -30 kg +- 0.1 kg}", "sum: f"),
            r"rig.yaml:9:7: derived.e.sum: a mapping of channels",
        ),
        (text.replace("\n  e: {sum", "\n  f: {sum"), r"rig.yaml:9:3: derived.f: is a channel already"),
        (text.replace("role: input", "rolle: input"), r"channels.e.rolle: unknown key; did you mean 'role'"),
    ):
        (tmp_path / "rig.yaml").write_text(broken)
        with pytest.raises(ConfigErrors, match=message):
            load_rig(tmp_path / "rig.yaml")


def test_a_ring_of_sums_and_a_constant_without_unit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigErrors, match="contains itself: d of e of d"):
        rig(tmp_path, "d: {quantity: force, derived: 2 * e}", "e: {quantity: force, derived: f + d}")
    (tmp_path / "rig.yaml").write_text(HEAD.replace("30 kg +- 0.1 kg", "heavy"))
    with pytest.raises(ConfigErrors, match=r"rig.yaml:2:\d+: constants.m_s: 'heavy' is not a value"):
        load_rig(tmp_path / "rig.yaml")


def test_a_constant_that_no_sum_could_name_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(HEAD.replace("half: 50 %", "f: 2"))
    with pytest.raises(ConfigErrors, match=r"rig.yaml:2:\d+: constants.f: is a channel already"):
        load_rig(tmp_path / "rig.yaml")


def test_sums_stand_in_the_recording_and_follow_the_rig_file(tmp_path: Path) -> None:
    """Made from the calibrated members, and made again when a constant changes."""
    (tmp_path / "r.csv").write_text("f,a,x1,x2\n1,2,3,4\n5,6,7,9\n2,0,1,1\n")
    found = rig(
        tmp_path,
        "e: {quantity: force, derived: f - m_s * a, dof: x}",
        "d: {quantity: displacement, derived: x1 - x2}",
    )
    for loaded, mass in ((found, 30.0), (load_rig(tmp_path / "rig.yaml", ["constants.m_s=31 kg"]), 31.0)):
        with output_folder(tmp_path / "out") as output:
            recording = ingest(SourceFile(tmp_path / "r.csv", loaded), output, "r", tmp_path).in_memory()
            assert [channel.name for channel in recording.channels] == ["f", "a", "x1", "x2", "e", "d"]
            f, a, x1, x2, e, d = recording.samples.T
        np.testing.assert_allclose(e, f - mass * a)
        np.testing.assert_allclose(d, x1 - x2)
        assert recording.channels[4].terms[1] == SumTerm(
            "a", -mass, *(((loaded.derived[0].terms[1].numbers), (-1.0,)) if mass == 30 else ())
        )


def seal_recordings(**changes: object) -> list[Recording]:
    """The virtual seal without baseline and noise.

    In the recordings f_eff = f - 60 kg a, and accelerations as references.
    """
    virtual = load_virtual_rig(CONFIGS / "virtual-floating.yaml")
    assert isinstance(virtual, FloatingRig)
    none = ((0.0, 0.0), (0.0, 0.0))
    virtual = replace(
        virtual,
        baseline_stiffness=none,
        baseline_damping=none,
        noise=FloatingNoise(0, 0, 0, 0),
        runout=(),
        unbalance=0.0,
    )
    uncertainty = Number("m_s", 60.0, 0.5, "kg")
    made = []
    for run in recordings(virtual, 1, ["seal-plus", "seal-minus"]):
        kept = [
            replace(channel, role="reference", **changes) if channel.name[0] in "fa" else channel
            for channel in run.channels
        ]
        sums = [
            Channel(
                f"e_{axis}",
                "force",
                "input",
                axis,
                terms=(SumTerm(f"f_{axis}", 1.0), SumTerm(f"a_{axis}", -60.0, (uncertainty,), (-1.0,))),
            )
            for axis in "xy"
        ]
        forces = run.samples[:, :2] - 60 * run.samples[:, 4:6]
        made.append(
            Recording((*kept, *sums), np.column_stack([run.samples, forces]), run.sample_rate, run.name)
        )
    return made


def test_an_acceleration_of_a_moving_mass_serves_as_a_force() -> None:
    """Of a stator without hoses H^-1 is the film's K + j w C - w^2 M, with the printed coefficients of Kanki
    and Kawakami.
    """
    response = measure(seal_recordings(), FrfSettings("periodic", period="1 s", skip=0, band="10-100 Hz"))
    jw = 2j * np.pi * response.frequency[:, None, None]
    k, c = np.array([[3.30e6, 11.3e6], [-10.3e6, 3.89e6]]), np.array([[147e3, 52.9e3], [-57.7e3, 147e3]])
    film = k + jw * c + jw**2 * np.array([[229.0, 16.0], [32.0, 214.0]])
    np.testing.assert_allclose(np.linalg.inv(response.matrix), film, rtol=1e-6)
    # A mass of the stator that is off by d leaves -d (j w)^2 of its own motion, which is that of the film
    # less the shaft's.
    (error,) = response.errors
    assert (error.uncertainty.source, error.uncertainty.std_error) == ("m_s, 60 kg", 0.5)


def test_a_sum_in_time_of_channels_with_different_delays_is_refused() -> None:
    recordings = seal_recordings()
    late = [
        replace(channel, delay=1e-4) if channel.name == "a_x" else channel
        for channel in recordings[0].channels
    ]
    with pytest.raises(
        DataError, match=r"'e_x' is a sum of channels with different delays .*f_x: 0 us, a_x: 100 us"
    ):
        measure([replace(recordings[0], channels=tuple(late))], FrfSettings("periodic", period="1 s"))


def test_a_delay_that_all_members_have_is_the_delay_of_the_sum(tmp_path: Path) -> None:
    text = HEAD.replace("unit: um,", "unit: um, delay: 20 us,")
    (tmp_path / "rig.yaml").write_text(text + "  d: {quantity: displacement, derived: x1 - x2}\n")
    assert load_rig(tmp_path / "rig.yaml").derived[0].delay == pytest.approx(2e-5)


def test_numbers_in_their_long_form(tmp_path: Path) -> None:
    """The same terms as of `30 kg +- 0.1 kg (source=scale)`: 0.3 kg of half width are 0.1732 kg."""
    long = "{value: 30 kg, limits: 0.3 kg, source: scale}"
    text = HEAD.replace("30 kg +- 0.1 kg", long)
    text += "derived:\n  e: {sum: {f: 1, a: m_s}, quantity: force, dof: x, position: 5 mm}\n"
    text += f"  d: {{sum: {{f: 1, a: {long}}}, quantity: force, dof: z}}\n"
    (tmp_path / "rig.yaml").write_text(text)
    e, d = load_rig(tmp_path / "rig.yaml").derived
    numbers = [channel.terms[1].numbers[0] for channel in (e, d)]
    assert [(number.source, number.std_error) for number in numbers] == [
        ("scale", pytest.approx(0.3 / math.sqrt(3)))
    ] * 2
    assert e.position == 0.005


def test_a_minus_of_a_number_is_that_of_its_term(tmp_path: Path) -> None:
    """One scale weighs all of them too heavy together: of -30 kg and of - 30 kg the derivative is -1."""
    listed = "s: {quantity: force, derived: 'f + -30 kg +- 0.1 kg (source=scale) * a', dof: x}"
    signed = "t: {quantity: force, derived: 'f - 30 kg +- 0.1 kg (source=scale) * a', dof: y}"
    first, second = (channel.terms[1] for channel in rig(tmp_path, listed, signed).derived)
    assert (first.factor, second.factor) == (-30.0, -30.0)
    assert first.derivatives == second.derivatives == (-1.0,)
    assert first.numbers[0].value == second.numbers[0].value == 30.0


def test_a_direction_of_a_sum_carries_no_uncertainty(tmp_path: Path) -> None:
    with pytest.raises(ConfigErrors, match=r"rig.yaml:\d+:\d+: channels.s.dof: a sum has no uncertainty"):
        rig(tmp_path, "s: {quantity: force, derived: f - m_s * a, dof: x +- 1 deg}")


TORSION = """sample_rate: 500 Hz
channels:
  M: {quantity: moment, unit: N.m, role: reference}
  twist: {quantity: angle, unit: deg, role: reference}
derived:
  f: {sum: {M: 1 1/m +- 0.001 1/m}, quantity: force, role: input, dof: x}
  x: {sum: {twist: 1 m/rad}, quantity: displacement, role: output, dof: x}
"""
# A load cell below the moving mass m_s, whose inertia its accelerometer takes off.
BELOW = """sample_rate: 500 Hz
channels:
  f: {quantity: force, role: reference}
  a: {quantity: acceleration, role: output, dof: x}
derived:
  e: {sum: {f: 1, a: -0.1 kg +- 0.001 kg}, quantity: force, role: input, dof: x}
"""
LINES = np.arange(20, 181)


def fit_of_periods(folder: Path, rig_text: str, lines: dict[str, np.ndarray], seed: int) -> Fit:
    """One dof, all estimated, from ten periods of 2 s with 1 % of noise in channels of those *lines*."""
    rng, periods = np.random.default_rng(seed), []
    phase = np.exp(2j * np.pi * rng.random(LINES.size))
    for values in lines.values():
        spectrum = np.zeros(501, complex)
        spectrum[LINES] = phase * values
        period = np.tile(np.fft.irfft(spectrum, 1000), 10)
        periods.append(period + 0.01 * np.std(period) * rng.normal(size=period.size))
    np.savetxt(folder / "run.csv", np.transpose(periods), delimiter=",", header=",".join(lines), comments="")
    (folder / "rig.yaml").write_text(rig_text)
    with output_folder(folder / "out") as output:
        source = SourceFile(folder / "run.csv", load_rig(folder / "rig.yaml"))
        recording = ingest(source, output, "run", folder).in_memory()
    response = measure([recording], FrfSettings("periodic", period=2.0, band=(10.0, 90.0)))
    (fit,) = identify(response, FitSettings("sdof"))
    return fit


def test_a_moment_over_an_angle_is_a_force_over_a_displacement_at_an_arm_of_a_metre(tmp_path: Path) -> None:
    # J a'' + c a' + k a = M in closed form: N.m/rad, N.m.s/rad and kg.m^2 in the place of N/m, N.s/m and kg.
    # A factor of the whole force is one of k, c and J as well, so that the data say nothing of it.
    truth, w = {"k": 900.0, "c": 0.35, "m": 0.012}, np.pi * LINES
    angle = 1 / (truth["k"] + 1j * truth["c"] * w - truth["m"] * w**2)
    fit = fit_of_periods(tmp_path, TORSION, {"M": np.ones(w.size), "twist": angle * 180 / np.pi}, 1)
    assert not fit.findings
    for name, value in truth.items():
        parameter = fit.parameter(name)
        assert abs(parameter.value - value) < 4 * parameter.std_error < 4e-3 * value
        assert parameter.systematic == pytest.approx(1e-3 * value, rel=0.01)


# The same with uncertain gains: of the cell through the sum alone, of the accelerometer through both.
CALIBRATED = BELOW.replace("force, role", "force, unit: V, sensitivity: 1 V/N +- 1 %, role", 1).replace(
    "acceleration, role", "acceleration, unit: V, sensitivity: 1 V/(m/s^2) +- 1 %, role"
)


@pytest.mark.parametrize(("rig_text", "seed"), [(BELOW, 0), (BELOW, 1), (CALIBRATED, 0), (CALIBRATED, 1)])
def test_noise_of_a_sensor_in_force_and_response_is_no_loop_and_no_wrong_number(
    tmp_path: Path, rig_text: str, seed: int
) -> None:
    w = np.pi * LINES
    moved = 1 / (40e3 + 20j * w - 1.1 * w**2)
    fit = fit_of_periods(tmp_path, rig_text, {"f": np.ones(w.size), "a": -(w**2) * moved}, seed)
    assert not {"feedback", "mass", "stated-value"} & {finding.code for finding in fit.findings}
    stiffness = fit.parameter("k")
    assert abs(stiffness.value - 40e3) < 4 * stiffness.full_error


# Forces on a stator of 30 kg less its inertia, on two axes, every gain known to 1 %.
STATOR = """sample_rate: 500 Hz
constants: {m_s: 30 kg +- 0.1 kg}
channels:
  fx: {quantity: force, unit: V, sensitivity: 1 V/N +- 1 %, role: reference}
  fy: {quantity: force, unit: V, sensitivity: 1 V/N +- 1 %, role: reference}
  ax: {quantity: acceleration, unit: V, sensitivity: 1 V/(m/s^2) +- 1 %, role: reference}
  ay: {quantity: acceleration, unit: V, sensitivity: 1 V/(m/s^2) +- 1 %, role: reference}
  x: {quantity: displacement, unit: V, sensitivity: 1 V/m +- 1 %, role: output, dof: x}
  y: {quantity: displacement, unit: V, sensitivity: 1 V/m +- 1 %, role: output, dof: y}
  ex: {quantity: force, derived: fx - m_s * ax, role: input, dof: x}
  ey: {quantity: force, derived: fy - m_s * ay, role: input, dof: y}
"""


def test_sound_sums_on_two_axes_are_contradicted_by_nothing(tmp_path: Path, rng: np.random.Generator) -> None:
    # F = (K + jw C - w^2 m_s) X in closed form, one shaker after the other; every statement is exact.
    k, c = np.array([[4e6, 5e5], [-3e5, 6e6]]), np.array([[3e3, 5e2], [2e2, 4e3]])
    w = np.pi * LINES
    receptance = np.linalg.inv(k + 1j * w[:, None, None] * c - 30 * w[:, None, None] ** 2 * np.eye(2))
    (tmp_path / "rig.yaml").write_text(STATOR)
    recordings = []
    with output_folder(tmp_path / "out") as output:
        for run in (0, 1):
            force = np.exp(2j * np.pi * rng.random(w.size))[:, None] * np.where(np.arange(2) == run, 1, 0.05)
            moved = np.einsum("lij,lj->li", receptance, force)
            spectra = np.zeros((501, 6), complex)
            spectra[LINES] = np.hstack([force, -(w[:, None] ** 2) * moved, moved])
            samples = np.tile(np.fft.irfft(spectra, 1000, axis=0), (10, 1))
            samples += (
                0.01 * np.std(samples, axis=0).reshape(3, 2).max(1).repeat(2) * rng.normal(size=samples.shape)
            )
            path = tmp_path / f"run-{run}.csv"
            np.savetxt(path, samples, delimiter=",", header="fx,fy,ax,ay,x,y", comments="")
            source = SourceFile(path, load_rig(tmp_path / "rig.yaml"))
            recordings.append(ingest(source, output, path.stem, tmp_path).in_memory())
    response = measure(recordings, FrfSettings("periodic", period=2.0, band=(10.0, 90.0)))
    (fit,) = identify(response, FitSettings("rotor-2dof", mass=0.0))
    assert not fit.findings
    for name, value in zip(("k_xx", "k_xy", "k_yx", "k_yy"), k.ravel(), strict=True):
        parameter = fit.parameter(name)
        # Gains of a force, a response and an accelerometer that takes as much as K off: 2 to 3 %.
        assert abs(parameter.value - value) < 4 * parameter.std_error
        assert 0.01 < parameter.full_error / abs(value) < 0.05
