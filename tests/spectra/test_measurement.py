"""measure: recordings of a known system -> its FRF, with the uncertainty it has."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import signal

from labpipe.errors import ConfigError, DataError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.raw_files.excitation import design_multisine
from labpipe.records.finding import Finding
from labpipe.records.recording import Channel, Recording
from labpipe.records.uncertain import ChannelUncertainty, Uncertainty
from labpipe.spectra.all_channels import channel_spectra
from labpipe.spectra.convert import convert
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

RATE = 256.0
FORCE = Channel("f", "force", "input", "x", 0.0)
X, Y = (
    Channel("x", "displacement", "output", "x", 0.0),
    Channel("y", "displacement", "output", "y", np.pi / 2),
)
PERIODIC = FrfSettings(excitation="periodic", period=1.0, skip=0)


def periodic_recording(
    rng: np.random.Generator, gains: tuple[float, ...], noise: float, periods: int = 6, dof: str = "x"
) -> Recording:
    """Responses are the force times a gain, delayed by one sample: H = g e^{-j w / rate}."""
    force = design_multisine((1.0, 60.0), 1.0, 1.0).samples(RATE, periods)
    samples = [force, *(gain * np.roll(force, 1) for gain in gains)]
    noisy = np.column_stack(samples) + noise * rng.normal(size=(force.size, len(samples)))
    channel = Channel("f", "force", "input", dof, {"x": 0.0, "y": np.pi / 2}[dof])
    return Recording((channel, X, Y)[: len(samples)], noisy, RATE, f"run {dof}")


def test_periodic_data_give_gain_and_the_sign_of_the_phase(rng: np.random.Generator) -> None:
    response = measure([periodic_recording(rng, (2.0,), 1e-9)], PERIODIC)
    expected = 2 * np.exp(-2j * np.pi * response.frequency / RATE)
    assert response.frequency.tolist() == list(range(1, 61))
    np.testing.assert_allclose(response.matrix[:, 0, 0], expected, rtol=1e-7)
    assert (response.form, response.outputs[0].label, response.inputs[0].label) == ("receptance", "x", "f")


def test_periodic_variance_is_what_the_scatter_of_repeats_shows(rng: np.random.Generator) -> None:
    repeats = [measure([periodic_recording(rng, (2.0,), 0.05)], PERIODIC) for _ in range(60)]
    matrices = np.array([response.matrix[:, 0, 0] for response in repeats])
    observed = np.mean(np.abs(matrices - matrices.mean(axis=0)) ** 2, axis=0) * 60 / 59
    predicted = np.mean([response.variance[:, 0, 0] for response in repeats], axis=0)
    assert np.mean(predicted / observed) == pytest.approx(1.0, abs=0.1)


def test_a_recording_too_short_for_an_average_is_left_out_by_name(rng: np.random.Generator) -> None:
    """As what follows an interruption; where no other has its channels it is refused."""
    whole = periodic_recording(rng, (2.0,), 1e-3)
    rest = Recording(whole.channels, whole.samples[: int(0.9 * RATE)], RATE, "rest")
    for settings in (PERIODIC, FrfSettings(excitation="random", block=1.0)):
        response, alone = measure([whole, rest], settings), measure([whole], settings)
        np.testing.assert_array_equal(response.matrix, alone.matrix)
        np.testing.assert_array_equal(response.variance, alone.variance)
        said = [finding.message for finding in response.findings if finding.code == "recording-left-out"]
        assert said == ["recording 'rest' is left out: it is shorter than one average takes (1 s)"]
    other = Recording((whole.channels[0], Y), rest.samples, RATE, "rest")
    for sources in ([whole, other], [rest, rest]):
        with pytest.raises(DataError, match="too short for one period"):
            measure(sources, PERIODIC)


def test_a_single_period_beside_others_has_their_noise(rng: np.random.Generator) -> None:
    """Four periods and one: H is the mean of two recordings, its variance a quarter of 1/4 + 1 times that of
    one period, (1 + |H|^2) 4 s^2 / (N |F|^2).
    """
    drawn = []
    for _ in range(60):
        four, one = (periodic_recording(rng, (2.0,), 0.05, n) for n in (4, 1))
        drawn.append(measure([four, one], PERIODIC))
    matrices = np.array([response.matrix[:, 0, 0] for response in drawn])
    observed = np.mean(np.abs(matrices - matrices.mean(axis=0)) ** 2, axis=0) * 60 / 59
    predicted = np.mean([response.variance[:, 0, 0] for response in drawn], axis=0)
    force = np.abs(np.fft.rfft(four.samples[: int(RATE), 0])[1:61]) * 2 / RATE
    closed = 1.25 / 4 * (1 + 2**2) * 4 * 0.05**2 / (RATE * np.median(force) ** 2)
    assert np.mean(predicted / observed) == pytest.approx(1.0, abs=0.1)
    assert np.median(predicted) == pytest.approx(closed, rel=0.1)
    assert drawn[0].covariance_dof >= 3


def test_calibrations_that_recordings_do_not_share_average_out(rng: np.random.Generator) -> None:
    """The mean of three recordings, of which two have one sensor and all one load cell: by hand its gain has
    errors of 2/3 of the first sensor, 1/3 of the second, and of the load cell in full.
    """
    first, second, cell = (
        ChannelUncertainty("gain", Uncertainty(source, 0.03, "1")) for source in ("first", "second", "cell")
    )
    recordings = []
    for sensor in (first, second, first):
        plain = periodic_recording(rng, (2.0,), 1e-3)
        force, response = plain.channels
        channels = replace(force, uncertainties=(cell,)), replace(response, uncertainties=(sensor,))
        recordings.append(replace(plain, channels=channels))
    of_all = measure(recordings, PERIODIC)
    stated = {c.uncertainty.source: c.uncertainty.std_error for c in of_all.outputs[0].uncertainties}
    assert stated == pytest.approx({"first": 0.02, "second": 0.01})
    assert of_all.inputs[0].uncertainties == (cell,)


@pytest.mark.parametrize("sensors", ["abcd", "aaaa", "aabb", "aaab"])
def test_what_the_scatter_of_repeats_shows_of_their_calibrations_counts_once(
    sensors: str, rng: np.random.Generator
) -> None:
    """Of four recordings with the sensors named, gains 3 % uncertain each: the variance of the mean of their
    gains, less what their scatter says of it, by 40,000 draws, is what a fit over the repeats still counts as
    systematic; where they are fitted together all of it counts.
    """
    recordings = []
    for sensor in sensors:
        plain = periodic_recording(rng, (2.0,), 1e-3)
        force, response = plain.channels
        gain = ChannelUncertainty("gain", Uncertainty(sensor, 0.03, "1"))
        recordings.append(replace(plain, channels=(force, replace(response, uncertainties=(gain,)))))
    of_sensor = 0.03 * np.random.default_rng(2).normal(size=(40_000, 4))
    gains = of_sensor[:, ["abcd".index(sensor) for sensor in sensors]]
    whole = np.var(gains.mean(axis=1))
    left = max(whole - np.mean(gains.var(axis=1, ddof=1)) / 4, 0.0)
    measured = measure(recordings, PERIODIC)
    for repeats, expected in (("each", left), ("pool", whole)):
        (fit,) = identify(measured, FitSettings("sdof", mass=1e-9, repeats=repeats))
        k = fit.parameter("k")
        # Three in a hundred of the draws' own error; a gain of 3 % changes k to first order.
        assert ((k.systematic or 0.0) / k.value) ** 2 == pytest.approx(expected, rel=0.05, abs=0.03 * whole)


def test_a_sensor_s_delay_is_taken_out(rng: np.random.Generator) -> None:
    # The recorded response comes one sample late; a delay of one sample in the rig file makes H real again.
    plain = periodic_recording(rng, (2.0,), 1e-9)
    late = Channel("x", "displacement", "output", "x", 0.0, delay=1 / RATE)
    response = measure([Recording((plain.channels[0], late), plain.samples, RATE, "late")], PERIODIC)
    np.testing.assert_allclose(response.matrix[:, 0, 0], 2.0, atol=1e-7)


def test_two_force_directions_give_one_matrix(rng: np.random.Generator) -> None:
    runs = [
        periodic_recording(rng, (2.0, 0.5), 1e-6, dof="x"),
        periodic_recording(rng, (0.3, 1.0), 1e-6, dof="y"),
    ]
    response = measure(runs, PERIODIC)
    gains = np.abs(response.matrix).mean(axis=0)
    np.testing.assert_allclose(gains, [[2.0, 0.3], [0.5, 1.0]], rtol=1e-4)
    assert [port.label for port in response.inputs] == [port.label for port in response.outputs] == ["x", "y"]
    assert response.covariance.shape == (60, 4, 4)
    # Forces and responses of one label are told apart: files keep a column for each.
    assert response.snr_channels == ("x (input)", "y (input)", "x (output)", "y (output)")


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e6])
def test_no_scale_of_the_numbers_changes_the_result(scale: float) -> None:
    recording = periodic_recording(np.random.default_rng(4), (2.0,), 0.01)
    scaled = Recording(recording.channels, recording.samples * scale, RATE, "run x")
    plain, other = measure([recording], PERIODIC), measure([scaled], PERIODIC)
    np.testing.assert_allclose(other.matrix, plain.matrix, rtol=1e-10)
    np.testing.assert_allclose(other.covariance, plain.covariance, rtol=1e-8)


@pytest.mark.parametrize(
    ("stiffness", "message"),
    [(3.0, "f differs from period to period, and the responses with it"), (np.inf, "no line of the force f")],
)
def test_a_force_that_changes_between_periods_is_not_taken_for_noise(stiffness: float, message: str) -> None:
    """Random periodic: the phases of every block are drawn anew, its amplitudes are one at all lines. A force
    as irregular that moves nothing may well be noise of its channel.
    """
    rng = np.random.default_rng(8)
    n_sample, lines = round(RATE), np.arange(1, 60)
    blocks = np.zeros((12, n_sample // 2 + 1), complex)
    blocks[:, lines] = np.exp(2j * np.pi * rng.random((12, lines.size)))
    force = np.fft.irfft(blocks, n_sample).ravel() * n_sample
    samples = np.column_stack([force, force / stiffness]) + 1e-3 * rng.normal(size=(force.size, 2))
    with pytest.raises(DataError, match=message) as fault:
        measure([Recording((FORCE, X), samples, RATE, "blocks")], PERIODIC)
    assert ("realisations: true" in fault.value.hint) == np.isfinite(stiffness)


def test_hum_in_one_force_channel_makes_no_line(rng: np.random.Generator) -> None:
    # 50 Hz in the force of one run only, where no force is meant to act: the other run knows nothing of that
    # direction there.
    runs = []
    for dof, gains in (("x", (2.0, 0.5)), ("y", (0.3, 1.0))):
        force = design_multisine((1.0, 40.0), 1.0, 1.0).samples(RATE, 6)
        hum = 0.2 * np.cos(2 * np.pi * 50 * np.arange(force.size) / RATE) * (dof == "x")
        samples = np.column_stack([force + hum, gains[0] * force, gains[1] * force]) + 1e-3 * rng.normal(
            size=(force.size, 3)
        )
        runs.append(Recording((Channel("f", "force", "input", dof), X, Y), samples, RATE, dof))
    response = measure(runs, PERIODIC)
    assert response.frequency.tolist() == list(range(1, 41))
    np.testing.assert_allclose(response.matrix.mean(axis=0).real, [[2.0, 0.3], [0.5, 1.0]], atol=0.01)


@pytest.mark.parametrize("estimator", ["H2", "Hv"])
def test_a_silent_response_is_named(rng: np.random.Generator, estimator: str) -> None:
    samples = np.column_stack([rng.normal(size=4000), np.zeros(4000)])
    with pytest.raises(DataError, match="silent: x"):
        measure(
            [Recording((FORCE, X), samples, RATE, "dead")],
            FrfSettings(excitation="random", block=1.0, estimator=estimator),
        )


def random_recording(rng: np.random.Generator, noise: float, n: int = 20_000) -> Recording:
    force = rng.normal(size=n)
    b, a = signal.iirpeak(30.0, 8.0, fs=RATE)
    response = signal.lfilter(b, a, force) + noise * rng.normal(size=n)
    return Recording((FORCE, X), np.column_stack([force, response]), RATE, "noise")


def test_random_variance_is_what_the_scatter_of_repeats_shows() -> None:
    """Of one input; windows and overlaps by two inputs in test_spectra_coverage."""
    rng = np.random.default_rng(6)
    settings = FrfSettings(excitation="random", block=1.0, window="hann", overlap=0.5, band=(10.0, 100.0))
    repeats = [measure([random_recording(rng, 0.5, 8000)], settings) for _ in range(60)]
    matrices = np.array([response.matrix[:, 0, 0] for response in repeats])
    observed = np.mean(np.abs(matrices - matrices.mean(axis=0)) ** 2, axis=0) * 60 / 59
    predicted = np.mean([response.variance[:, 0, 0] for response in repeats], axis=0)
    assert np.mean(predicted / observed) == pytest.approx(1.0, abs=0.1)


SENSED = (X, replace(Y, name="a", quantity="acceleration"), Channel("v", "velocity", "output", "3.z"))


@pytest.mark.parametrize("excitation", ["periodic", "impact", "random"])
def test_motions_of_several_quantities_are_those_of_each_alone(
    rng: np.random.Generator, excitation: str
) -> None:
    """Displacement, acceleration and velocity of three places beside one force: values, covariance and hits
    of each row are those of an FRF of that channel alone, turned to a receptance by the stated factor.
    """
    settings = {
        "periodic": PERIODIC,
        "impact": FrfSettings("impact", block=1.0, band=(2.0, 100.0)),
        "random": FrfSettings("random", block=1.0, band=(2.0, 100.0), local="polynomial"),
    }[excitation]
    if excitation == "impact":
        force = np.zeros(int(10 * RATE))
        force[20 :: int(RATE)], force[21 :: int(RATE)] = 50.0, 30.0
    else:
        force = design_multisine((1.0, 100.0), 1.0, 1.0).samples(RATE, 20)
        force = force + (rng.normal(size=force.size) if excitation == "random" else 0.0)
    motions = signal.lfilter([1.0], [1.0, -1.6, 0.81], force[:, None] * [1.0, -2.0, 0.5], axis=0)
    noisy = motions + 0.01 * np.std(motions, axis=0) * rng.normal(size=motions.shape)
    recording = Recording((FORCE, *SENSED), np.column_stack([force, noisy]), RATE, "mixed")
    together = measure([recording], settings)
    assert together.form == "receptance"
    (said,) = [finding.message for finding in together.findings if finding.code == "turned-response"]
    assert said.startswith("a (acceleration), v (velocity) turned to the receptance")
    for row in range(3):
        channels = [
            replace(c, role="reference") if c not in (FORCE, SENSED[row]) else c for c in recording.channels
        ]
        alone = convert(measure([replace(recording, channels=tuple(channels))], settings), "receptance")
        np.testing.assert_allclose(together.matrix[:, row], alone.matrix[:, 0], rtol=1e-9)
        assert together.covariance is not None and alone.covariance is not None
        np.testing.assert_allclose(together.covariance[:, row, row], alone.covariance[:, 0, 0], rtol=1e-9)
        if excitation == "impact":
            assert together.repeats is not None and alone.repeats is not None
            np.testing.assert_allclose(together.repeats[:, :, row], alone.repeats[:, :, 0], rtol=1e-9)


def test_windowed_random_data_of_several_quantities_are_refused(rng: np.random.Generator) -> None:
    """Each leaks in its own way: of three masses chi-square is 1.11 and 84 % of intervals hold."""
    recording = Recording((FORCE, *SENSED), rng.normal(size=(4096, 4)), RATE, "mixed")
    with pytest.raises(DataError, match=r"each leaks .*local: polynomial"):
        measure([recording], FrfSettings("random", block=1.0))


def test_random_data_near_the_filter_s_own_response(rng: np.random.Generator) -> None:
    response = measure(
        [random_recording(rng, 0.01, 200_000)], FrfSettings(excitation="random", block=4.0, band=(20.0, 60.0))
    )
    _, expected = signal.freqz(*signal.iirpeak(30.0, 8.0, fs=RATE), worN=response.frequency, fs=RATE)
    np.testing.assert_allclose(response.matrix[:, 0, 0], expected, atol=0.03)
    assert response.coherence.max() <= 1 and response.coherence.min() > 0.8


def test_poor_coherence_is_said(rng: np.random.Generator) -> None:
    response = measure([random_recording(rng, 3.0)], FrfSettings(excitation="random", block=1.0))
    assert [finding.code for finding in response.findings] == ["low-coherence"]


def test_one_period_has_no_covariance_and_says_so(rng: np.random.Generator) -> None:
    response = measure([periodic_recording(rng, (2.0,), 0.01, periods=1)], PERIODIC)
    assert response.covariance is None and [f.code for f in response.findings] == ["no-covariance"]


def test_excluded_bands_are_left_out_and_edges_belong(rng: np.random.Generator) -> None:
    settings = FrfSettings(
        excitation="periodic", period=1.0, skip=0, band=(10.0, 20.0), exclude=((12.0, 13.0),)
    )
    response = measure([periodic_recording(rng, (2.0,), 0.01)], settings)
    assert response.frequency.tolist() == [10, 11, 14, 15, 16, 17, 18, 19, 20]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"band": (1.0, 63.0)}, ""),
        ({"band": (1.0, 80.0), "exclude": ((55.0, 80.0),)}, ""),
        ({"band": (1.0, 900.0)}, "lines lie from 1 to 60 Hz, and the band 1-900 Hz reaches beyond"),
        ({"exclude": ((50.0, 51.0), (700.0, 800.0))}, "the band 700-800 Hz reaches beyond"),
    ],
)
def test_bands_beyond_the_lines_are_said(
    rng: np.random.Generator, settings: dict[str, Any], said: str
) -> None:
    """The force has lines from 1 to 60 Hz: of 63 Hz a tenth of the band at most lies beyond."""
    response = measure([periodic_recording(rng, (2.0,), 0.01)], replace(PERIODIC, **settings))
    messages = [finding.message for finding in response.findings if finding.code == "band-beyond"]
    assert len(messages) == bool(said) and all(said in message for message in messages)


def test_findings_of_the_recordings_travel(rng: np.random.Generator) -> None:
    plain = periodic_recording(rng, (2.0,), 0.01)
    clipped = Recording(plain.channels, plain.samples, RATE, "run x", (Finding("clipped", "channel x"),))
    assert measure([clipped], PERIODIC).findings == (Finding("clipped", "channel x"),)


def broken(rng: np.random.Generator, column: int, value: float) -> Recording:
    """A recording with a NaN would be refused at birth.

    A stored one can hold it, so the blocks are made here.
    """
    plain = periodic_recording(rng, (2.0,), 0.01)

    class Stored(Recording):
        def blocks(self, n_sample: int):  # type: ignore[no-untyped-def]
            for block in super().blocks(n_sample):
                changed = block.copy()
                changed[777, column] = value
                yield changed

    return Stored(plain.channels, plain.samples, RATE, "run x")


def test_a_missing_number_is_named_with_channel_and_sample(rng: np.random.Generator) -> None:
    with pytest.raises(DataError, match=r"channel 'x' of 'run x' has no number at sample 777 \(3\.0\d+ s\)"):
        measure([broken(rng, 1, np.nan)], PERIODIC)


def test_what_does_not_fit_together_is_refused(rng: np.random.Generator) -> None:
    one = periodic_recording(rng, (2.0, 1.0), 0.01)
    with pytest.raises(DataError, match="lacks the response y"):
        measure([one, periodic_recording(rng, (2.0,), 0.01, dof="y")], PERIODIC)
    other_rate = Recording(one.channels, one.samples, 2 * RATE, "fast")
    with pytest.raises(DataError, match="different sampling rates"):
        measure([one, other_rate], PERIODIC)
    both = Recording((FORCE, Channel("g", "force", "input", "y"), X), one.samples, RATE, "both")
    with pytest.raises(DataError, match="cannot separate 2 forces"):
        measure([both], FrfSettings(excitation="periodic", period=1.0, skip=0))
    still = Recording(one.channels, one.samples * [0, 1, 1], RATE, "still")
    with pytest.raises(DataError, match="force channel 'f' of 'still' does not vary"):
        measure([still], PERIODIC)
    with pytest.raises(DataError, match=r"no line lies in the band.*every 1 Hz up to 128 Hz"):
        measure([one], FrfSettings(excitation="periodic", period=1.0, band=(500.0, 600.0)))
    with pytest.raises(DataError, match="too short for one block"):
        measure([one], FrfSettings(excitation="random", block=60.0))


def test_settings_must_fit_the_excitation() -> None:
    with pytest.raises(ConfigError, match="'period' is missing"):
        FrfSettings(excitation="periodic")
    with pytest.raises(ConfigError, match="'block' is missing"):
        FrfSettings(excitation="random", period=1.0)
    with pytest.raises(ConfigError, match="below 100 %"):
        FrfSettings(excitation="random", block=1.0, overlap=1.0)
    with pytest.raises(ConfigError, match="skip: '-1' is not a whole number of at least 0"):
        FrfSettings(excitation="periodic", period=1.0, skip=-1)


def test_a_reference_channel_changes_nothing(rng: np.random.Generator) -> None:
    plain = random_recording(rng, 0.1)
    tacho = Channel("tacho", "voltage", "reference", "tacho")
    samples = np.column_stack([plain.samples[:, 0], rng.normal(size=plain.n_sample), plain.samples[:, 1]])
    with_tacho = Recording((FORCE, tacho, X), samples, RATE, "noise")
    settings = FrfSettings(excitation="random", block=1.0)
    one, other = measure([plain], settings), measure([with_tacho], settings)
    np.testing.assert_allclose(other.matrix, one.matrix, rtol=1e-10)
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-8)


def test_a_drift_is_taken_out_with_a_straight_line(rng: np.random.Generator) -> None:
    # A drift of 30 deviations per block leaks into the lowest lines unless the line is taken out.
    plain = random_recording(rng, 0.01)
    drift = np.column_stack([np.zeros(plain.n_sample), np.arange(plain.n_sample) * 30 / RATE])
    drifting = Recording(plain.channels, plain.samples + drift, RATE, "drift")
    plainly = FrfSettings(excitation="random", block=1.0, band=(2.0, 20.0), window="boxcar", overlap=0.0)
    settings = {name: replace(plainly, detrend=name) for name in ("constant", "linear")}
    truth = measure([plain], settings["linear"]).matrix
    error = {name: np.max(np.abs(measure([drifting], own).matrix - truth)) for name, own in settings.items()}
    assert error["linear"] < 1e-9 and error["constant"] > 0.05


@pytest.mark.parametrize(
    "own",
    [
        {"estimator": "H1"},
        {"estimator": "H2", "window": "boxcar"},
        {"local": "polynomial"},
        {"reference": ("r",)},
    ],
    ids=str,
)
def test_a_stated_delay_is_taken_out_however_long_beside_a_block(
    rng: np.random.Generator, own: dict[str, Any]
) -> None:
    """y = 2 u, recorded 1/4 block late, the reference a whole one: |H| was low by the window's
    autocorrelation (H1), the reference refused. Expected is the gain.
    """
    force = rng.normal(size=int(40 * RATE))
    late = {"x": 16, "r": 64}
    channels = (
        FORCE,
        replace(X, delay=late["x"] / RATE),
        Channel("r", "voltage", "reference", "r", delay=late["r"] / RATE),
    )
    samples = np.column_stack([force, np.roll(2 * force, late["x"]), np.roll(force, late["r"])])
    source = Recording(channels, samples + 1e-6 * rng.normal(size=samples.shape), RATE, "late")
    settings = FrfSettings(excitation="random", block=0.25, **own)
    np.testing.assert_allclose(measure([source], settings).matrix, 2.0, rtol=1e-4)
    drives = replace(settings, reference=("r",), local="none", estimator="H1", result="spectra")
    vectors = channel_spectra([source], drives).vectors
    np.testing.assert_allclose(vectors[..., 1] / vectors[..., 0], 2.0, rtol=1e-4)


def test_a_channel_has_one_delay_in_all_recordings(rng: np.random.Generator) -> None:
    sources = [periodic_recording(rng, (2.0,), 1e-3) for _ in range(2)]
    for late in (replace(FORCE, delay=1e-3), replace(X, delay=1e-3)):
        channels = tuple(late if c.name == late.name else c for c in sources[1].channels)
        with pytest.raises(DataError, match=f"'{late.name}' has not the same delay"):
            measure([sources[0], replace(sources[1], channels=channels)], PERIODIC)


@pytest.mark.parametrize(("both", "estimator"), [(False, "H1"), (True, "H1"), (True, "Hv")])
def test_noise_of_another_level_in_the_recordings_of_a_force_is_that_of_its_column(
    both: bool, estimator: str
) -> None:
    """White noise s on a force u of variance p over n averages: E|dH|^2 = s^2 / (p n). A tenth of both in the
    second recording: the noise of both together made it 2 times too small in the first column, 50 times too
    large in the second; whether the force at rest is recorded or not.
    """
    rng = np.random.default_rng(11)
    channels = [Channel(name, "displacement", "output", name) for name in "xy"]
    sources = []
    for number, level in enumerate((1.0, 0.1)):
        forces = level * rng.normal(size=(20_000, 2)) * np.where(np.arange(2) == number, 1.0, 1e-3)
        outputs = forces @ [[2.0, 0.3], [0.5, 1.0]] + 0.01 * level * rng.normal(size=(20_000, 2))
        chosen = [0, 1] if both else [number]
        inputs = [Channel("fg"[n], "force", "input", "fg"[n]) for n in chosen]
        samples = np.hstack([forces[:, chosen], outputs])
        sources.append(Recording((*inputs, *channels), samples, 1e3, str(number)))
    settings = FrfSettings(excitation="random", block=0.25, band=(20.0, 400.0), estimator=estimator)
    response = measure(sources, settings)
    np.testing.assert_allclose(response.variance.mean(axis=0), 1e-4 / (response.averages / 2), rtol=0.1)
