"""A line of the shaft speed in a record of random excitation: removed or masked, the response beside it is
unharmed.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from labpipe.errors import ConfigError, DataError
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings, MaskSettings, ShaftLines
from labpipe.spectra.synchronous import without_synchronous

RATE = 512.0
FORCE, X = Channel("f", "force", "input", "x", 0.0), Channel("x", "displacement", "output", "x", 0.0)
TACHO = Channel("tacho", "voltage", "reference", "tacho")


def run(
    rng: np.random.Generator, revolutions: np.ndarray, amplitudes: tuple[complex, ...], noise: float = 0.1
) -> Recording:
    """White force through a resonance at 60 Hz, harmonics of the shaft on the response, and one pulse per
    revolution.
    """
    n = revolutions.size
    force = rng.normal(size=n)
    response = signal.lfilter(*signal.iirpeak(60.0, 8.0, fs=RATE), force) + noise * rng.normal(size=n)
    for order, value in enumerate(amplitudes, 1):
        response = response + np.real(value * np.exp(2j * np.pi * order * revolutions))
    pulses = (revolutions % 1.0 < 0.5) * 5.0
    return Recording((FORCE, X, TACHO), np.column_stack([force, response, pulses]), RATE, "run")


def even(speed: float, n: int = 60_000) -> np.ndarray:
    return speed * np.arange(n) / RATE


def truth(frequency: np.ndarray) -> np.ndarray:
    return signal.freqz(*signal.iirpeak(60.0, 8.0, fs=RATE), worN=frequency, fs=RATE)[1]


def test_the_amplitudes_taken_out_are_those_put_in(rng: np.random.Generator) -> None:
    recording = run(rng, even(50.0), (3.0 + 4.0j, -1.0j), noise=0.0)
    amplitude = without_synchronous(recording, ShaftLines(speed=50.0, harmonics=2)).amplitude
    # 60,000 samples of a resonance's noise of about 0.3 leave about 0.3 sqrt(2 / 60,000) x 4 at a line inside
    # its peak.
    np.testing.assert_allclose(amplitude[:, 1], [3.0 + 4.0j, -1.0j], atol=0.05)
    assert np.max(np.abs(amplitude[:, 0])) < 0.05
    np.testing.assert_array_equal(amplitude[:, 2], 0.0)


def test_a_pure_line_is_taken_out_to_rounding() -> None:
    revolutions = even(47.3)
    samples = np.column_stack([np.cos(2 * np.pi * revolutions), 7.0 + np.sin(4 * np.pi * revolutions)])
    recording = Recording((FORCE, X), samples, RATE, "pure")
    left = np.concatenate(
        list(without_synchronous(recording, ShaftLines(speed=47.3, harmonics=2)).blocks(7000))
    )
    np.testing.assert_allclose(left, np.tile([0.0, 7.0], (revolutions.size, 1)), atol=1e-9)


def test_a_speed_slightly_off_is_refined(rng: np.random.Generator) -> None:
    recording = run(rng, even(50.03), (5.0,))
    found = without_synchronous(recording, ShaftLines(speed=50.0))
    assert found.motion.speeds[0] == pytest.approx(50.03, abs=1e-3)
    assert abs(found.amplitude[0, 1]) == pytest.approx(5.0, abs=0.1)


def test_the_tacho_follows_a_speed_that_changes(rng: np.random.Generator) -> None:
    time = np.arange(60_000) / RATE
    recording = run(rng, 50 * time + 0.3 * np.sin(2 * np.pi * 0.05 * time) / 0.05, (5.0,))
    found = without_synchronous(recording, ShaftLines(tacho="tacho"))
    # A pulse is known to a sample, a tenth of a revolution here: exp(j phi), |phi| < 0.31, loses 0.31^2 / 6
    # of its mean at most.
    assert 5 * (1 - 0.31**2 / 6) - 0.05 < abs(found.amplitude[0, 1]) < 5.05
    assert found.findings[-1].message.startswith("channel x: the part synchronous with 4")


@pytest.mark.parametrize("way", ["remove", "mask"])
def test_beside_a_removed_or_masked_line_the_response_is_right_within_its_uncertainty(
    rng: np.random.Generator, way: str
) -> None:
    recording = run(rng, even(50.0), (5.0, 0.5, 0.2))
    lines = MaskSettings(speed=50.0, harmonics=3) if way == "mask" else ShaftLines(speed=50.0, harmonics=3)
    settings = FrfSettings(excitation="random", block=1.0, band=(40.0, 160.0), **{way: lines})
    response = measure([recording], settings)
    error = np.abs(response.matrix[:, 0, 0] - truth(response.frequency)) ** 2
    # Blocks of 1 s bias the resonance a little; lines of 50 Hz would be off by 100 deviations.
    assert np.mean(error / response.variance[:, 0, 0]) < 1.5
    assert np.max(error / response.variance[:, 0, 0]) < 12
    kept = response.frequency.tolist()
    assert (
        ([f for f in (47.0, 48.0, 49.0, 50.0, 51.0, 52.0, 53.0) if f in kept] == [47.0, 53.0])
        if way == "mask"
        else 50.0 in kept
    )
    assert [finding.code for finding in response.findings][:1] == [
        {"mask": "masked", "remove": "synchronous-removed"}[way]
    ]
    untreated = measure([recording], FrfSettings(excitation="random", block=1.0, band=(40.0, 160.0)))
    plain = np.abs(untreated.matrix[:, 0, 0] - truth(untreated.frequency))
    assert plain[10] > 5 * np.sqrt(np.max(error))


def test_the_mask_follows_the_tacho(rng: np.random.Generator) -> None:
    time = np.arange(60_000) / RATE
    recording = run(rng, 50 * time + np.sin(2 * np.pi * 0.05 * time) / (2 * np.pi * 0.05), (5.0,))
    mask = MaskSettings(tacho="tacho", width=1.0)
    response = measure([recording], FrfSettings(excitation="random", block=1.0, band=(40.0, 70.0), mask=mask))
    # 49 to 51 Hz, the pulses' rounding to samples (10 %), and 1 Hz to either side.
    left_out = sorted(set(range(40, 71)) - {round(f) for f in response.frequency})
    assert {48, 49, 50, 51, 52} <= set(left_out) and left_out[0] >= 44 and left_out[-1] <= 58


def test_what_cannot_be_removed_is_refused(rng: np.random.Generator) -> None:
    with pytest.raises(DataError, match="shorter than two revolutions"):
        without_synchronous(run(rng, even(0.001), ()), ShaftLines(speed=0.001))
    with pytest.raises(ConfigError, match="'remove' is not for sweep excitation"):
        FrfSettings(excitation="sweep", remove=ShaftLines(speed=50.0))


@pytest.mark.parametrize("harmonics", [4, 6])
def test_harmonics_that_are_others_at_this_rate_are_refused(rng: np.random.Generator, harmonics: int) -> None:
    """4x of 64 Hz is half of 512 Hz, of whose sine the samples see nothing; 6x is 2x."""
    top = harmonics * 64
    with pytest.raises(DataError, match=rf"{harmonics}x of the shaft of 'run' is {top} Hz, not below half"):
        without_synchronous(run(rng, even(64.0), ()), ShaftLines(speed=64.0, harmonics=harmonics))


def test_a_speed_is_refined_to_what_the_whole_record_tells() -> None:
    """One in 500 off over 20 s: .3 s at a time left 7 mHz, a seventh of a turn. The bound of Cramer and Rao,
    sqrt(6 s^2 / A^2 / n) / (pi T), is 0.7 mHz for the rms s of the rest, 1.8 A.
    """
    source = run(np.random.default_rng(1), even(33.37, 10_240), (0.2,), noise=0.3)
    cleaned = without_synchronous(source, ShaftLines(speed=33.3))
    assert cleaned.motion.speed_range[0] == pytest.approx(33.37, abs=1e-3)


def struck(rng: np.random.Generator, added: np.ndarray) -> Recording:
    """Hits every 640 samples or a little later at the same resonance, and what is *added* to its response."""
    force = np.zeros(added.size)
    starts = np.arange(100, added.size - 600, 640)
    for start in starts + rng.integers(0, 60, starts.size):
        force[start : start + 3] = rng.uniform(0.6, 1.2) * np.array([0.5, 1.0, 0.5])
    response = signal.lfilter(*signal.iirpeak(60.0, 8.0, fs=RATE), force) + added
    pulses = (37.3 * np.arange(added.size) / RATE % 1.0 < 0.5) * 5.0
    samples = np.column_stack([force, response + 1e-5 * rng.normal(size=added.size), pulses])
    return Recording((FORCE, X, replace(TACHO, quantity="tacho")), samples, RATE, "struck")


N_STRUCK = 9000
TURNING = 0.02 * np.cos(2 * np.pi * 37.3 * np.arange(N_STRUCK) / RATE + 1)
HITS = FrfSettings("impact", block=1.0, band=(10.0, 200.0))


@pytest.mark.parametrize("lines", [ShaftLines(speed=37.0), ShaftLines(tacho="tacho")])
def test_hits_at_a_rotor_that_turns_lose_1x_and_say_so_where_they_keep_it(
    rng: np.random.Generator, lines: ShaftLines
) -> None:
    recording = struck(rng, TURNING)
    # The filter's own response is the truth; blocks of one second hold all of its decay, exp(-24).
    kept, removed = (measure([recording], settings) for settings in (HITS, replace(HITS, remove=lines)))
    expected = truth(kept.frequency)
    off = [np.max(np.abs(response.matrix[:, 0, 0] - expected)) for response in (kept, removed)]
    assert off[0] > 0.1
    assert off[1] < 2e-3
    (finding,) = [finding for finding in kept.findings if finding.code == "steady-tone"]
    size = re.search(r"37\.3 Hz of ([\d.]+) mm that", finding.message)
    # 20 mm; the five lines of a tone between two hold all but some per cent of it.
    assert size is not None and float(size[1]) == pytest.approx(20.0, rel=0.05)
    codes = {finding.code for finding in removed.findings}
    assert not {"steady-tone", "not-died-away"} & codes and "synchronous-removed" in codes


def test_a_mode_that_noise_shakes_between_hits_is_no_tone() -> None:
    # Twenty records of a mode at 90 Hz, narrower than a line of a quarter of a block, under white noise.
    codes = set()
    for seed in range(20):
        rng = np.random.default_rng(seed)
        shaken = signal.lfilter(*signal.iirpeak(90.0, 90.0, fs=RATE), rng.normal(size=N_STRUCK))
        codes |= {finding.code for finding in measure([struck(rng, 0.02 * shaken)], HITS).findings}
    assert "steady-tone" not in codes


def test_hits_that_leave_no_revolution_between_them_are_refused(rng: np.random.Generator) -> None:
    # 0.2 Hz turn 3.5 times in 18 s, of which thirteen hits leave 8 s.
    settings = replace(HITS, remove=ShaftLines(speed=0.2))
    with pytest.raises(DataError, match="leave less than two revolutions of the shaft between them"):
        measure([struck(rng, TURNING)], settings)
