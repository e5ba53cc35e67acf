"""Hammer hits on a mass on a spring with known dynamics: windows, damping taken out, bad hits left out."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from labpipe.errors import ConfigError, DataError
from labpipe.estimation.leakage import leakage_of
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse, Port
from labpipe.spectra.damping import remove_window_damping, without_added_damping
from labpipe.spectra.impact import find_hits, find_overloaded, is_double
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings, ImpactSettings
from labpipe.spectra.windows import exponential_window, force_window

RATE, BLOCK = 2048.0, 1.0
N = 2048
HAMMER = Channel("hammer", "force", "input", "x", 0.0)
X, Y = (
    Channel("x", "displacement", "output", "x", 0.0),
    Channel("y", "displacement", "output", "y", np.pi / 2),
)
POLE = -2 * np.pi * 0.4 + 2j * np.pi * 60.0


def discrete(pole: complex) -> tuple[list[float], list[float]]:
    """A sampled mode h(n) = Im exp(p n dt): exact in discrete time, so that no aliasing blurs the truth."""
    z = np.exp(pole / RATE)
    return [0.0, float(z.imag)], [1.0, -2 * float(z.real), float(abs(z) ** 2)]


def truth(frequency: np.ndarray, pole: complex = POLE) -> np.ndarray:
    return signal.freqz(*discrete(pole), worN=frequency, fs=RATE)[1]


def half_sine(n_sample: int, starts: list[int], peaks: list[float], width: int = 8) -> np.ndarray:
    force = np.zeros(n_sample)
    for start, peak in zip(starts, peaks, strict=True):
        force[start : start + width] += peak * np.sin(np.pi * (np.arange(width) + 0.5) / width)
    return force


def hammered(
    rng: np.random.Generator,
    force: np.ndarray,
    pole: complex = POLE,
    noise: float = 0.0,
    channels: tuple[Channel, ...] = (HAMMER, X),
) -> Recording:
    response = signal.lfilter(*discrete(pole), force)
    columns = [force, response, 0.5 * response][: len(channels)]
    samples = np.column_stack(columns) + noise * rng.normal(size=(force.size, len(columns))) * np.std(
        response
    )
    return Recording(channels, samples, RATE, "taps")


# The response to one hit has died away before the next.
STARTS = [500 + 6 * N * k for k in range(5)]
LENGTH = 30 * N


def test_without_windows_a_response_that_dies_away_is_exact(rng: np.random.Generator) -> None:
    quick = -2 * np.pi * 4.0 + 2j * np.pi * 60.0
    response = measure(
        [hammered(rng, half_sine(LENGTH, STARTS, [1.0, 0.8, 1.1, 0.9, 1.0]), quick)],
        FrfSettings(excitation="impact", block=2.0, band=(10.0, 150.0)),
    )
    np.testing.assert_allclose(response.matrix[:, 0, 0], truth(response.frequency, quick), rtol=1e-9)
    assert response.averages == 5 and not response.findings


def test_one_hit_has_no_coherence(rng: np.random.Generator) -> None:
    """|S_yu|^2 / (S_uu S_yy) of one average is 1, noise or not; of two it is not."""
    settings = FrfSettings(excitation="impact", block=BLOCK, band=(10.0, 500.0))
    one, two = (
        measure([hammered(rng, half_sine(4 * N, starts, [1.0] * len(starts)), noise=0.01)], settings)
        for starts in ([100], [100, 5000])
    )
    assert one.coherence is None and one.multiple_coherence is None
    assert two.coherence is not None and np.median(two.coherence) < 0.99


def test_hits_left_out_by_number_are_the_same_ones_in_every_recording_alone() -> None:
    """The fourth of all hits, the second of the second recording, is of another rig: without it each
    recording gives the FRF, by closed form.
    """
    quick, other = -2 * np.pi * 4.0 + 2j * np.pi * 60.0, -2 * np.pi * 4.0 + 2j * np.pi * 90.0
    force = half_sine(12 * N, STARTS[:2], [1.0, 0.8])
    runs = [hammered(np.random.default_rng(1), force, quick) for _ in range(2)]
    samples = runs[1].samples.copy()
    samples[6 * N :] = hammered(np.random.default_rng(1), force, other).samples[6 * N :]
    runs = [replace(runs[0], name="a"), replace(runs[1], name="b", samples=samples)]
    settings = FrfSettings("impact", block=2.0, band=(10.0, 150.0), impact=ImpactSettings(reject=("4",)))
    response = measure(runs, settings)
    assert response.repeats is not None and response.averages == 3
    for alone in (response.matrix, *response.repeats):
        np.testing.assert_allclose(alone[:, 0, 0], truth(response.frequency, quick), rtol=1e-9)
    with pytest.raises(DataError, match="`reject` names hit 5, 4 are found"):
        measure(runs, replace(settings, impact=ImpactSettings(reject=("5",))))


def test_the_damping_of_the_exponential_window_is_taken_out_again(rng: np.random.Generator) -> None:
    # Half width 0.4 Hz; the window falls to 1 % within the 1 s block and adds 1 / (2 pi decay) = 0.73 Hz.
    decay = BLOCK / np.log(100)
    impact = ImpactSettings(decay=decay)
    response = measure(
        [hammered(rng, half_sine(LENGTH, STARTS, [1.0] * 5))],
        FrfSettings(excitation="impact", block=BLOCK, band=(20.0, 150.0), impact=impact),
    )
    expected = truth(response.frequency)
    # What the window leaves at the block's end, 1 % x exp(-0.4 x 2 pi) = 0.08 %, is cut off.
    np.testing.assert_allclose(response.matrix[:, 0, 0], expected, atol=0.01 * np.abs(expected).max())
    peak = int(np.argmax(np.abs(expected)))
    assert abs(response.matrix[peak, 0, 0]) == pytest.approx(abs(expected[peak]), rel=0.01)
    windowed = truth(response.frequency, POLE - 1 / decay)
    assert abs(windowed[peak]) < 0.4 * abs(expected[peak])


def test_local_functions_move_two_poles_exactly() -> None:
    frequency = np.arange(20.0, 100.0)
    s, shift = 2j * np.pi * frequency, 3.0
    poles = (-2.0 + 2j * np.pi * 45.3, -4.0 + 2j * np.pi * 71.6)

    def response(at: np.ndarray) -> np.ndarray:
        return sum(
            (1.0 + k) / (at - pole) + (1.0 + k) / (at - pole.conjugate()) for k, pole in enumerate(poles)
        )[:, None, None]

    found = without_added_damping(frequency, response(s + shift), 1 / shift).matrix
    # The other mode, 26 lines off, is met by the second-order numerator but for (4 / 26)^3 = 0.4 % of its
    # size.
    np.testing.assert_allclose(found, response(s), atol=0.004 * np.abs(response(s)).max())
    np.testing.assert_allclose(found[[25, 51]], response(s)[[25, 51]], rtol=0.004)
    # Both ends take the same part of their own line and of their neighbours inside.
    even = response(2j * np.pi * (frequency - frequency.mean()) + shift)
    gains = without_added_damping(frequency, even, 1 / shift).gains[:, :, 0, 0]
    np.testing.assert_allclose(gains[-1, ::-1].conj(), gains[0], rtol=1e-6, atol=1e-9)
    assert np.all(gains[0, 4:] != 0) and not np.any(gains[0, :4])
    constant = np.full((9, 1, 1), 2.0 + 0j)
    np.testing.assert_allclose(
        without_added_damping(frequency[:9], constant, 0.3).matrix, constant, rtol=1e-12
    )
    np.testing.assert_array_equal(
        without_added_damping(frequency[:3], constant[:3], 0.3).matrix, constant[:3]
    )


def test_bad_hits_are_left_out_and_named(rng: np.random.Generator) -> None:
    force = half_sine(LENGTH, STARTS, [1.0, 0.8, 1.1, 0.9, 1.0]) + half_sine(LENGTH, [STARTS[1] + 40], [0.3])
    recording = hammered(rng, force, channels=(HAMMER, X, Y), noise=1e-4)
    samples = recording.samples.copy()
    third = slice(STARTS[2], STARTS[2] + N)
    # The second response is clipped in the third hit.
    samples[third, 2] = np.clip(samples[third, 2], -np.inf, 0.6 * samples[third, 2].max())
    impact = ImpactSettings(decay=0.2, reject=("5",))
    response = measure(
        [Recording(recording.channels, samples, RATE, "taps")],
        FrfSettings(excitation="impact", block=BLOCK, impact=impact),
    )
    messages = [finding.message for finding in response.findings if finding.code == "hit-rejected"]
    assert [message.partition("left out: ")[2] for message in messages] == [
        "double hit",
        "overload of channel 'y'",
        "left out by hand",
    ]
    assert [message[:5] for message in messages] == ["hit 2", "hit 3", "hit 5"]
    assert response.averages == 2
    inside = (response.frequency > 20) & (response.frequency < 150)
    expected = truth(response.frequency)
    assert np.max(np.abs(response.matrix[:, 0, 0] - expected)[inside]) < 0.02 * np.abs(expected).max()


@pytest.mark.long
def test_predicted_variance_is_the_scatter_of_repeats(rng: np.random.Generator) -> None:
    # Recipe: 80 simulated tests of 8 hits each, exponential window with its damping taken out.
    impact = ImpactSettings(decay=0.25)
    settings = FrfSettings(excitation="impact", block=BLOCK, band=(40.0, 90.0), impact=impact)
    starts = [500 + 4 * N * k for k in range(8)]
    force = half_sine(33 * N, starts, [1.0] * 8)
    quick = -2 * np.pi * 2.0 + 2j * np.pi * 60.0
    responses = [measure([hammered(rng, force, quick, noise=0.01)], settings) for _ in range(80)]
    matrices = np.array([response.matrix[:, 0, 0] for response in responses])
    predicted = np.mean([response.variance[:, 0, 0] for response in responses], axis=0)
    ratio = predicted / matrices.var(axis=0)
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.1)


def test_a_response_that_rings_on_is_said(rng: np.random.Generator) -> None:
    recording = hammered(rng, half_sine(LENGTH, STARTS, [1.0] * 5))
    response = measure([recording], FrfSettings(excitation="impact", block=BLOCK, band=(10.0, 500.0)))
    assert [finding.code for finding in response.findings] == ["not-died-away"]


def test_what_blocks_cut_off_of_hits_is_known(rng: np.random.Generator) -> None:
    """A tenth of the amplitude is left at the end: the mean of the exact FRF by the kernel of what follows a
    hit is what was measured, where the FRF itself is a tenth off. Of blocks that hold all nothing is cut.
    """
    recording = hammered(rng, half_sine(LENGTH, STARTS, [1.0] * 5))
    shown = measure([recording], FrfSettings(excitation="impact", block=BLOCK, band=(20.0, 150.0)))
    leakage = leakage_of(shown.blocks, shown.frequency, np.empty(0), 0)
    assert leakage is not None and shown.blocks is not None
    assert shown.blocks.after_hit == pytest.approx(0.98, abs=0.005)
    every = truth(leakage.grid[0] / (2 * np.pi))[:, None, None]
    largest = np.max(np.abs(shown.matrix))
    assert np.max(np.abs(truth(shown.frequency) - shown.matrix[:, 0, 0])) > 0.05 * largest
    assert np.max(np.abs(leakage.average(every) - shown.matrix)) < 2e-3 * largest
    long = FrfSettings(excitation="impact", block=5.5, band=(20.0, 150.0))
    assert measure([recording], long).blocks is None


@pytest.mark.parametrize(("pole", "rings"), [(-2 * np.pi * 4.0 + 2j * np.pi * 60.0, False), (POLE, True)])
def test_noise_at_the_end_of_a_block_is_not_said_to_ring(
    rng: np.random.Generator, pole: complex, rings: bool
) -> None:
    """Noise of 2 % of the peak, more than 5 % of the largest tenth, as before the first hit."""
    clean = hammered(rng, half_sine(LENGTH, STARTS, [1.0] * 5), pole)
    noise = 0.02 * np.max(np.abs(clean.samples[:, 1:])) * rng.normal(size=clean.samples.shape)
    noisy = replace(clean, samples=clean.samples + noise * [0.0, 1.0])
    response = measure([noisy], FrfSettings(excitation="impact", block=BLOCK, band=(10.0, 150.0)))
    assert ("not-died-away" in [finding.code for finding in response.findings]) == rings


def test_two_hammered_directions_give_one_matrix(rng: np.random.Generator) -> None:
    quick = -2 * np.pi * 4.0 + 2j * np.pi * 60.0
    force = half_sine(LENGTH, STARTS, [1.0] * 5)
    runs = []
    for dof, gains in (("x", (1.0, 0.3)), ("y", (0.2, 1.0))):
        response = signal.lfilter(*discrete(quick), force)
        samples = np.column_stack([force, gains[0] * response, gains[1] * response])
        runs.append(Recording((Channel("hammer", "force", "input", dof), X, Y), samples, RATE, dof))
    found = measure(runs, FrfSettings(excitation="impact", block=2.0, band=(20.0, 100.0)))
    expected = truth(found.frequency, quick)[:, None, None] * np.array([[1.0, 0.2], [0.3, 1.0]])
    np.testing.assert_allclose(found.matrix, expected, rtol=1e-8)


def test_windows_closed_forms() -> None:
    window = force_window(100, 10, 40.0)
    assert np.all(window[:51] == 1) and window[52] == pytest.approx(0.5) and np.all(window[54:] == 0)
    np.testing.assert_allclose(exponential_window(11, 5.0)[[0, 5, 10]], np.exp([0.0, -1.0, -2.0]))


def test_judgements() -> None:
    push = half_sine(200, [20], [1.0])
    assert not is_double(push, 0.1) and not is_double(-push, 0.1)
    assert is_double(push + half_sine(200, [40], [0.2]), 0.1) and not is_double(
        push + half_sine(200, [40], [0.05]), 0.1
    )
    flat = np.column_stack([np.clip(push, 0, 0.8), push, np.clip(-push, -0.5, 0.0)])
    assert find_overloaded(flat).tolist() == [True, False, True]


def test_hits_over_block_borders_are_found_once(rng: np.random.Generator) -> None:
    starts = [65_536 - 3, 65_536 + 3 * N, 131_072 - N // 2, 131_072 + 2 * N]
    recording = hammered(rng, half_sine(140_000, starts, [1.0] * 4))
    hits = list(find_hits(recording, 0, N, ImpactSettings(trigger=0.05)))
    assert [hit.start for hit in hits] == [start - round(0.02 * N) for start in starts]
    assert [hit.number for hit in hits] == [1, 2, 3, 4]


def test_a_recording_that_ends_before_its_first_hit_is_whole_is_left_out(rng: np.random.Generator) -> None:
    sound = hammered(rng, half_sine(LENGTH, STARTS, [1.0] * 5))
    rest = hammered(rng, half_sine(3000, [1900], [1.0]))
    settings = FrfSettings(excitation="impact", block=1.0, band=(1.0, 200.0))
    response, alone = measure([sound, rest], settings), measure([sound], settings)
    np.testing.assert_array_equal(response.matrix, alone.matrix)
    (said,) = [finding.message for finding in response.findings if finding.code == "recording-left-out"]
    assert said.endswith("it holds no hit whose block is complete")


def test_what_is_no_impact_test_is_refused(rng: np.random.Generator) -> None:
    force = half_sine(LENGTH, STARTS, [1.0] * 5)
    both = Recording(
        (HAMMER, Channel("g", "force", "input", "y"), X), np.column_stack([force, force, force]), RATE, "both"
    )
    with pytest.raises(DataError, match=r"'both' of hits has 2 forces \(hammer, g\)"):
        measure([both], FrfSettings(excitation="impact", block=1.0))
    with pytest.raises(DataError, match="no hit whose block is complete"):
        measure([hammered(rng, half_sine(3000, [1900], [1.0]))], FrfSettings(excitation="impact", block=1.0))
    with pytest.raises(DataError, match=r"'taps' is 0\.976562 s long, too short for one block of 1 s"):
        measure([hammered(rng, half_sine(2000, [900], [1.0]))], FrfSettings(excitation="impact", block=1.0))
    with pytest.raises(DataError, match=r"1 hit\(s\) found, none of them good"):
        rejecting = ImpactSettings(reject=("1",))
        measure(
            [hammered(rng, half_sine(6000, [900], [1.0]))],
            FrfSettings(excitation="impact", block=1.0, impact=rejecting),
        )
    for wrong, fault in ((("x",), "'x' is not the number"), (("0",), "'0' is not the number")):
        with pytest.raises(ConfigError, match=fault):
            ImpactSettings(reject=wrong)
    with pytest.raises(ConfigError, match="decay must be positive"):
        ImpactSettings(decay=0.0)
    with pytest.raises(ConfigError, match="trigger must lie between"):
        ImpactSettings(trigger=1.0)


def test_an_offset_of_the_hammer_makes_no_hits(rng: np.random.Generator) -> None:
    quick = -2 * np.pi * 4.0 + 2j * np.pi * 60.0
    plain = hammered(rng, half_sine(LENGTH, STARTS, [1.0] * 5), quick)
    offset = Recording(plain.channels, plain.samples + np.array([0.5, -3.0]), RATE, "taps")
    settings = FrfSettings(excitation="impact", block=2.0, band=(10.0, 150.0))
    np.testing.assert_allclose(
        measure([offset], settings).matrix, measure([plain], settings).matrix, rtol=1e-6
    )


def test_the_force_window_takes_the_noise_between_hits_away(rng: np.random.Generator) -> None:
    # Noise of 5 % of the peak on the force: over 8 ms of a 2 s block a 250th of its power is left.
    quick = -2 * np.pi * 4.0 + 2j * np.pi * 60.0
    starts = [20, *STARTS[1:]]
    plain = hammered(rng, half_sine(LENGTH, starts, [1.0] * 5), quick)
    noise = np.column_stack([0.05 * rng.normal(size=LENGTH), np.zeros(LENGTH)])
    noisy = Recording(plain.channels, plain.samples + noise, RATE, "taps")
    errors = []
    for impact in (
        ImpactSettings(trigger=0.4, double_hit=0.4),
        ImpactSettings(trigger=0.4, double_hit=0.4, force_window=8e-3),
    ):
        response = measure(
            [noisy], FrfSettings(excitation="impact", block=2.0, band=(20.0, 100.0), impact=impact)
        )
        expected = truth(response.frequency, quick)
        errors.append(np.sqrt(np.mean(np.abs(response.matrix[:, 0, 0] / expected - 1) ** 2)))
    # sqrt(1 / 250), and as much again for the one draw there is.
    assert errors[1] < 2 * np.sqrt(1 / 250) * errors[0]


@pytest.mark.parametrize(("window", "said"), [(None, "after its hits"), (8e-3, "within its window")])
def test_noise_of_the_hammer_that_moves_all_lines_alike_is_named(
    window: float | None, said: str, rng: np.random.Generator
) -> None:
    """H1 of five hits is low by 4/5 N_uu / S_uu: noise s white over a block of n samples has |X|^2 = n s^2
    (of (1 + a) / (1 + a + a* + s), a the mean noise over the force, E|a|^2 = s / 5). Under a window of 17.6
    ms it is one gain error of all lines, sqrt(n_w s^2 / |U|^2 / 2 / 5) of five hits.
    """
    quick = -2 * np.pi * 4.0 + 2j * np.pi * 60.0
    clean = hammered(rng, half_sine(LENGTH, [20, *STARTS[1:]], [1.0] * 5), quick)
    impact = ImpactSettings(trigger=0.4, double_hit=0.4, force_window=window)
    settings = FrfSettings(excitation="impact", block=2.0, band=(20.0, 100.0), impact=impact)

    def finding(force: float, settings: FrfSettings = settings) -> str:
        scales = np.array([force, 1e-3 * np.max(np.abs(clean.samples[:, 1]))])
        noisy = Recording(clean.channels, clean.samples + scales * rng.normal(size=(LENGTH, 2)), RATE, "taps")
        return next((f.message for f in measure([noisy], settings).findings if f.code == "force-noise"), "")

    size, n = 0.02, round(2 * RATE)
    power = np.median(np.abs(np.fft.rfft(half_sine(n, [20], [1.0])))[40:201] ** 2)
    share = 0.8 * n * size**2 / power if window is None else np.sqrt(0.0176 * RATE * size**2 / power / 10)
    message = finding(size)
    assert said in message
    # Five tails of half a block tell noise to 4 %, two digits are printed.
    printed = float(message.split(" %")[0].split()[-1])
    assert printed == pytest.approx(100 * share, rel=0.15)
    assert not finding(1e-5)
    # H2 holds no power of the force.
    assert bool(finding(size, replace(settings, estimator="H2"))) == (window is not None)


def test_noise_of_two_hammers_is_one_finding_that_names_both(rng: np.random.Generator) -> None:
    """The second force has 1.5 times the noise of the first, and H1 is low by the square of it."""
    quick = -2 * np.pi * 4.0 + 2j * np.pi * 60.0
    runs = []
    for dof, size in (("x", 0.02), ("y", 0.03)):
        clean = hammered(rng, half_sine(LENGTH, [20, *STARTS[1:]], [1.0] * 5), quick)
        noise = np.array([size, 1e-3 * np.max(np.abs(clean.samples[:, 1]))]) * rng.normal(size=(LENGTH, 2))
        channels = (replace(clean.channels[0], dof=dof), clean.channels[1])
        runs.append(Recording(channels, clean.samples + noise, RATE, dof))
    impact = ImpactSettings(trigger=0.4, double_hit=0.4)
    response = measure(runs, FrfSettings(excitation="impact", block=2.0, band=(20.0, 100.0), impact=impact))
    (message,) = [f.message for f in response.findings if f.code == "force-noise"]
    found = re.match(r"noise of the forces (.+), (.+) after its hits makes H low by (.+) %, (.+) %", message)
    assert found and float(found[4]) == pytest.approx(2.25 * float(found[3]), rel=0.15)


def test_noise_of_the_hammer_does_not_make_h_low(rng: np.random.Generator) -> None:
    """Noise of 2 % of each hit's peak in its force, and in every second record hum of as much: the mean of H
    over the truth is 1 by its scatter; H1 by itself is low by 4/5 of the noise over the force, 5 %.
    """
    quick = -2 * np.pi * 4.0 + 2j * np.pi * 60.0
    clean = hammered(rng, half_sine(LENGTH, [20, *STARTS[1:]], [1.0] * 5), quick)
    impact = ImpactSettings(trigger=0.4, double_hit=0.4)
    settings = FrfSettings(excitation="impact", block=2.0, band=(20.0, 100.0), impact=impact)
    power = np.abs(np.fft.rfft(half_sine(round(2 * RATE), [20], [1.0])))[40:201] ** 2
    noise = 2 * RATE * 0.02**2 / power
    hum, ratios, told = 0.02 * np.sin(2 * np.pi * 80.0 * np.arange(LENGTH) / RATE), [], []
    for number in range(20):
        with_hum = number % 2
        moved = np.array([0.02, 1e-6]) * rng.normal(size=(LENGTH, 2))
        moved[:, 0] += with_hum * hum
        response = measure([Recording(clean.channels, clean.samples + moved, RATE, "taps")], settings)
        ratio = (response.matrix[:, 0, 0] / truth(response.frequency, quick)).real
        ratios.append(np.mean(ratio[np.abs(response.frequency - 80.0) > 2.0]))
        if not with_hum:
            told.append(np.mean(response.snr[:, 0] ** -2 * 5 / (noise / (1 + noise))))
    assert np.mean(ratios) == pytest.approx(1, abs=4 * np.std(ratios) / np.sqrt(20))
    assert np.std(ratios) / np.sqrt(20) < 0.003
    # The noise of the mean force, for the weights; a mean of 1 / |U|^2 is larger by 2 / 5 of it.
    assert np.mean(told) == pytest.approx(1 + 0.4 * np.mean(noise), abs=0.03)


@pytest.mark.parametrize("window", [12e-3, 30e-3])
def test_hits_without_noise_of_the_hammer_keep_that_of_the_response(
    window: float, rng: np.random.Generator
) -> None:
    """Noise of the hammer of .05 % of its peak under a force window, and of the response as large as that at
    300 Hz. White noise s of the response has |N|^2 = n s^2 in a block of n samples, so that H of hits F_h has
    the variance n s^2 / sum |F_h|^2, at its resonance and where noise is most of the response alike.
    """
    quick, n_hit, n, sizes = -2 * np.pi * 1.2 + 2j * np.pi * 60.0, 10, round(2 * RATE), []
    settings = FrfSettings(
        excitation="impact", block=2.0, band=(5.0, 400.0), impact=ImpactSettings(force_window=window)
    )
    for _ in range(8):
        starts, peaks = [200 + 2 * n * hit for hit in range(n_hit)], rng.uniform(0.7, 1.3, n_hit).tolist()
        clean = hammered(rng, half_sine(2 * n * n_hit, starts, peaks), quick)
        std = np.array([5e-4, 3e-3 * np.max(np.abs(clean.samples[:, 1]))])
        noisy = clean.samples + std * rng.normal(size=clean.samples.shape)
        response = measure([Recording(clean.channels, noisy, RATE, "taps")], settings)
        lines = np.round(response.frequency * 2.0).astype(int)
        force = np.abs(np.fft.rfft(half_sine(n, [200], [1.0])))[lines] ** 2 * np.sum(np.square(peaks))
        assert len(response.errors) > 10
        sizes.append(response.variance.ravel() / (n * std[1] ** 2 / force))
    # Nine degrees of freedom, or more over neighbouring lines, at 40 lines and more of eight records: 2 %.
    for low, high in ((5, 50), (50, 70), (70, 300), (300, 400)):
        inside = (response.frequency >= low) & (response.frequency < high)
        assert np.mean(np.array(sizes)[:, inside]) == pytest.approx(1, abs=0.08), (low, high)


def one_hit(
    start: int, peak: float, second: float = 0.0, decay: float | None = None, channels=(HAMMER, X)
) -> Recording:
    """A block of 2 s as an analyser stores it, its window on force and response."""
    force = half_sine(2 * N, [start, start + 60], [peak, second])
    window = np.ones(2 * N) if decay is None else exponential_window(2 * N, decay * RATE)
    response = signal.lfilter(*discrete(POLE), force)
    return Recording(channels, np.column_stack([force * window, response * window]), RATE, f"hit at {start}")


@pytest.mark.parametrize("start", [30, 400])
def test_hits_that_an_analyser_has_windowed_lose_its_damping_and_get_no_second_window(start: int) -> None:
    """Closed form.

    One file for every hit, whether the analyser's pretrigger is shorter or longer than labpipe's.
    """
    settings = FrfSettings("impact", block=2.0, band=(30.0, 90.0), windowed={"exponential": "0.3 s"})
    response = measure([one_hit(start, peak, decay=0.3) for peak in (1.0, 0.8, 1.2)], settings)
    np.testing.assert_allclose(response.matrix[:, 0, 0], truth(response.frequency), rtol=1e-3)
    assert response.averages == 3.0
    by_labpipe = measure(
        [one_hit(start, 1.0)], FrfSettings("impact", block=2.0, band=(30.0, 90.0), impact={"decay": "0.3 s"})
    )
    np.testing.assert_allclose(response.matrix, by_labpipe.matrix, rtol=1e-6)


def test_a_bad_hit_of_one_file_costs_that_file_only() -> None:
    sources = [
        one_hit(30, 1.0, decay=0.3),
        one_hit(30, 1.0, second=0.5, decay=0.3),
        one_hit(30, 1.2, decay=0.3),
    ]
    settings = FrfSettings("impact", block=2.0, band=(30.0, 90.0), windowed={"exponential": 0.3})
    response = measure(sources, settings)
    assert response.averages == 2.0
    assert [finding.message for finding in response.findings if finding.code == "hit-rejected"] == [
        "hit 2 ('hit at 30', 0.000 s) is left out: double hit"
    ]
    # The others stay repeats.
    assert response.repeats_are == "recordings" and len(response.repeat_names) == 2
    with pytest.raises(DataError, match=r"1 hit\(s\) found, none of them good"):
        measure(sources[1:2], settings)


def test_a_roving_hammer_gives_one_row_and_a_bad_hit_there_is_no_column_of_zeros() -> None:
    """Points 1 and 2 along a line: three files, the only hit at point 2 a double one."""
    at = [Channel("hammer", "force", "input", place) for place in ("1", "1", "2")]
    sources = [
        one_hit(30, 1.0, second, 0.3, (channel, X))
        for channel, second in zip(at, (0.0, 0.0, 0.5), strict=True)
    ]
    settings = FrfSettings("impact", block=2.0, band=(30.0, 90.0), windowed={"exponential": 0.3})
    with pytest.raises(DataError, match="none of them good"):
        measure(sources, settings)
    response = measure([*sources, one_hit(30, 1.0, 0.0, 0.3, (at[2], X))], settings)
    assert [port.dof for port in response.inputs] == ["1", "2"]
    np.testing.assert_allclose(response.matrix[:, 0, 1], truth(response.frequency), rtol=1e-3)


def test_a_point_with_a_single_hit_has_the_noise_that_the_others_show(rng: np.random.Generator) -> None:
    """Noise of hits that grows with the response, here what rings on: one hit tells of no scatter, and its
    variance is four times that of four hits.
    """
    roving = []
    for point, n_hit in enumerate((4, 4, 4, 1)):
        peaks = (1 + 0.3 * rng.normal(size=n_hit)).tolist()
        starts = [300 + 2500 * k + int(rng.integers(300)) for k in range(n_hit)]
        force = half_sine(2500 * n_hit + N, starts, peaks)
        hammer = replace(HAMMER, dof=f"{point}.x")
        roving.append(replace(hammered(rng, force, noise=1e-4, channels=(hammer, X)), name=f"{point}"))
    response = measure(roving, FrfSettings(excitation="impact", block=1.0, band=(10.0, 150.0)))
    variance = response.variance
    assert variance is not None and np.all(np.isfinite(variance)) and np.all(variance > 0)
    relative = np.median(variance[:, 0] / np.abs(response.matrix[:, 0]) ** 2, axis=0)
    assert 2 < relative[3] / np.mean(relative[:3]) < 8


def test_a_roving_sensor_gives_one_column(rng: np.random.Generator) -> None:
    """The sensor at three places in three files: receptances g H with g = 1, -0.5, 2."""
    sources = []
    for place, gain in (("10", 1.0), ("2", -0.5), ("1", 2.0)):
        hit = one_hit(30, 1.0, decay=0.3)
        sensor = Channel("a", "displacement", "output", place)
        sources.append(Recording((HAMMER, sensor), hit.samples * [1.0, gain], RATE, f"at {place}"))
    settings = FrfSettings("impact", block=2.0, band=(30.0, 90.0), windowed={"exponential": 0.3})
    response = measure(sources, settings)
    assert [port.label for port in response.outputs] == ["1", "2", "10"] and response.line_gains is not None
    for row, gain in enumerate((2.0, -0.5, 1.0)):
        np.testing.assert_allclose(response.matrix[:, row, 0], gain * truth(response.frequency), rtol=1e-3)


@pytest.mark.parametrize(
    ("entries", "fault"),
    [
        (
            {"excitation": "random", "windowed": {"exponential": 1.0}},
            "'windowed' is not for random excitation",
        ),
        (
            {"excitation": "impact", "windowed": {"exponential": 1.0}, "impact": {"decay": 1.0}},
            "two exponential windows",
        ),
        ({"excitation": "impact", "windowed": {"exponential": 0.0}}, "must be positive"),
        (
            {"excitation": "impact", "impact": {"force_window": 1.1}},
            "'force_window' of 1.1 s is longer than the block of 1 s",
        ),
    ],
)
def test_windows_that_cannot_be_meant(entries: dict[str, object], fault: str) -> None:
    with pytest.raises(ConfigError, match=fault):
        FrfSettings(block=1.0, **entries)


def test_a_ready_response_loses_the_damping_of_its_window() -> None:
    """H(j w + 1/tau) becomes H(j w) but for the curvature that the conjugate pole leaves, 120 Hz away.

    Uneven lines are refused.
    """
    frequency = np.arange(40.0, 80.0, 0.5)
    x = Port("x", "x", "x")
    rate = 2j * np.pi * frequency + 1 / 0.4
    matrix = (1 / ((rate - POLE) * (rate - POLE.conjugate())))[:, None, None]
    response = remove_window_damping(
        FrequencyResponse(frequency, matrix, (x,), (x,), covariance=np.ones((80, 1, 1))), 0.4
    )
    rate = 2j * np.pi * frequency
    np.testing.assert_allclose(
        response.matrix[:, 0, 0], 1 / ((rate - POLE) * (rate - POLE.conjugate())), rtol=1e-5
    )
    assert response.covariance is None
    with pytest.raises(DataError, match="not evenly spaced"):
        remove_window_damping(FrequencyResponse(frequency**1.1, matrix, (x,), (x,)), 0.4)


def test_every_hit_of_a_recording_is_a_repeat(rng: np.random.Generator) -> None:
    """Alone it is what is left where all others are rejected by hand."""
    recording = hammered(rng, half_sine(LENGTH, STARTS, [1.0, 0.8, 1.1, 0.9, 1.0]), noise=0.01)
    settings = FrfSettings(excitation="impact", block=BLOCK, band=(20.0, 150.0))
    response = measure([recording], settings)
    assert response.repeat_names == ("hit 1", "hit 2", "hit 3", "hit 4", "hit 5")
    assert response.repeats_are == "hits" and response.repeat_levels[1] == pytest.approx(0.8, abs=0.05)
    rest = replace(settings, impact=replace(settings.impact, reject=("1", "2", "4", "5")))
    alone = measure([recording], rest)
    np.testing.assert_allclose(response.repeats[2], alone.matrix, rtol=1e-9)
    assert alone.repeats is None
    # Lines under an exponential window share their noise, which one hit does not show.
    windowed = replace(settings, impact=replace(settings.impact, decay=BLOCK / np.log(100)))
    assert measure([recording], windowed).repeats is None


def test_a_response_recorded_late_fills_the_same_window(rng: np.random.Generator) -> None:
    """By a tenth of a block, stated: under `decay` H was off by the factor exp(.1 s / 200 ms)."""
    recording = hammered(rng, half_sine(4 * N, [100, 100 + 2 * N], [100.0, 80.0]), noise=1e-6)
    lag = N // 10
    samples = np.column_stack([recording.samples[:, 0], np.roll(recording.samples[:, 1], lag)])
    late = Recording((HAMMER, replace(X, delay=lag / RATE)), samples, RATE, "late")
    settings = FrfSettings(
        excitation="impact", block=BLOCK, band=(30.0, 90.0), impact=ImpactSettings(decay=0.2)
    )
    matrices = [measure([source], settings).matrix for source in (recording, late)]
    np.testing.assert_allclose(matrices[1], matrices[0], rtol=1e-3)


@pytest.mark.parametrize("windows", [{"force_window": 0.02}, {"decay": 0.2}], ids=str)
def test_an_offset_goes_where_little_lies_ahead_of_the_hit(
    rng: np.random.Generator, windows: dict[str, float]
) -> None:
    """A hammer at 5 N and a sensor beside its zero: under a window the offset is a force of its own, and H
    was 5 % off (median); expected is H without it.
    """
    plain = hammered(rng, half_sine(4 * N, [100, 100 + 2 * N], [100.0, 80.0]), noise=1e-5)
    shifted = replace(plain, samples=plain.samples + np.array([5.0, 1.0]))
    impact = ImpactSettings(pretrigger=0.0, **windows)
    settings = FrfSettings(excitation="impact", block=BLOCK, band=(5.0, 200.0), impact=impact)
    matrices = [measure([source], settings).matrix for source in (plain, shifted)]
    np.testing.assert_allclose(matrices[1], matrices[0], rtol=1e-3)


def test_a_block_of_hardly_any_samples_is_refused(rng: np.random.Generator) -> None:
    recording = hammered(rng, half_sine(4 * N, [100], [100.0]))
    for block, n in ((1e-4, 0), (5e-4, 1), (2e-3, 4)):
        with pytest.raises(DataError, match=f"a block of {block:g} s holds {n} samples of 'taps', 20 are"):
            measure([recording], FrfSettings(excitation="impact", block=block))


def test_pulses_of_a_tacho_are_no_overload(rng) -> None:
    """They stand at both ends of their range; all hits were left out for them."""
    taps = hammered(rng, half_sine(4 * N, [200, 200 + 2 * N], [1.0, 1.2]), noise=1e-4)
    pulses = np.arange(taps.n_sample) % 100 < 20
    channels = (*taps.channels, Channel("n", "tacho", "reference", "n"))
    turning = Recording(channels, np.column_stack([taps.samples, pulses]), RATE, "taps")
    settings = FrfSettings("impact", block=BLOCK)
    np.testing.assert_allclose(
        measure([turning], settings).matrix, measure([taps], settings).matrix, rtol=1e-9
    )


@pytest.mark.parametrize("apart", [1.0, 2.0, 4.0])
def test_an_exponential_window_is_taken_out_of_two_modes_that_share_their_lines(apart: float) -> None:
    """The sum of two discrete modes, by closed form. One pole left 30 to 70 % of the peak."""
    poles = (POLE, 1.3 * POLE.real + 1j * (POLE.imag + 2 * np.pi * apart))
    rng, force = np.random.default_rng(1), half_sine(LENGTH, STARTS, [1.0] * 5)
    one, other = (hammered(rng, force, pole) for pole in poles)
    samples = one.samples.copy()
    samples[:, 1] += other.samples[:, 1]
    settings = FrfSettings(
        "impact", block=BLOCK, band=(20.0, 150.0), impact=ImpactSettings(decay=BLOCK / np.log(100))
    )
    response = measure([replace(one, samples=samples)], settings)
    expected = sum(truth(response.frequency, pole) for pole in poles)
    np.testing.assert_allclose(response.matrix[:, 0, 0], expected, atol=0.01 * np.abs(expected).max())
