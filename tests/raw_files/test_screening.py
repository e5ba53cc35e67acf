"""Clipping, gaps, levels and time axes, block by block."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labpipe.errors import DataError
from labpipe.raw_files.screening import ChannelScreen, LostSamples, TimeAxisScreen


def screened(
    samples: np.ndarray, block: int, limits: list[tuple[float, float] | None] | None = None
) -> ChannelScreen:
    screen = ChannelScreen([f"ch{n}" for n in range(samples.shape[1])], limits)
    for start in range(0, samples.shape[0], block):
        screen.add(samples[start : start + block])
    return screen


def faulty(seed: int) -> np.ndarray:
    """A clipped channel, one with gaps, one that stands still, one clean on a large offset."""
    rng = np.random.default_rng(seed)
    samples = rng.normal(size=(300, 4))
    samples[:, 0] = np.clip(np.sin(np.arange(300) / 9 + seed), -0.8, 0.8)
    samples[rng.integers(0, 300, 5), 1] = np.nan
    samples[:, 2] = 3.0
    samples[:, 3] = 1e9 + 1e-3 * samples[:, 3]
    return samples


@pytest.mark.long
@settings(derandomize=True, max_examples=40, deadline=None)
@given(block=st.integers(1, 300), seed=st.integers(0, 5))
def test_block_size_changes_nothing(block: int, seed: int) -> None:
    samples = faulty(seed)
    whole, parts = screened(samples, 300), screened(samples, block)
    assert parts.findings() == whole.findings()
    np.testing.assert_array_equal(parts.minimum, whole.minimum)
    np.testing.assert_allclose(parts.rms, whole.rms, rtol=1e-9)
    np.testing.assert_allclose(parts.mean, whole.mean, rtol=1e-12)


def test_levels_equal_numpy() -> None:
    samples = faulty(1)
    screen = screened(samples, 64)
    np.testing.assert_allclose(screen.rms, np.nanstd(samples, axis=0), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(screen.mean, np.nanmean(samples, axis=0), rtol=1e-12)


def test_findings_name_channel_and_first_sample() -> None:
    samples = np.random.default_rng(3).normal(size=(50, 3))
    samples[10:14, 0] = 5.0
    samples[[20, 30], 1] = np.nan
    samples[:, 2] = 0.0
    clipped, gap, constant = screened(samples, 12).findings()
    assert (
        clipped.code == "clipped"
        and "channel ch0: 4 samples" in clipped.message
        and "first is sample 10" in clipped.message
    )
    assert gap.code == "gap" and gap.message == (
        "channel ch1: 2 of 50 samples are not numbers, the first is sample 20"
    )
    assert constant.message == "channel ch2 does not vary at all"


def test_a_known_range_excuses_equal_peaks_inside_it() -> None:
    samples = np.clip(np.sin(np.arange(300) / 9), -0.8, 0.8)[:, None]
    assert [f.code for f in screened(samples, 50).findings()] == ["clipped"]
    assert screened(samples, 50, [(-10.0, 10.0)]).findings() == ()
    assert [f.code for f in screened(samples, 50, [(-0.8, 0.8)]).findings()] == ["clipped"]


def test_a_known_range_finds_peaks_that_do_not_repeat() -> None:
    # Noise behind the saturated amplifier: no two samples are equal, yet all of them stand at or beyond the
    # end of the range.
    samples = np.sin(np.arange(300) / 9)[:, None]
    samples[[40, 41, 200], 0] = [10.0, 10.001, -10.0002]
    (clipped,) = screened(samples, 50, [(-10.0, 10.0)]).findings()
    assert (
        clipped.code == "clipped"
        and "3 samples" in clipped.message
        and "first is sample 40" in clipped.message
    )


@pytest.mark.parametrize("scale", [1e-12, 1 / 3, 1e6])
def test_the_end_of_the_range_is_met_in_any_unit(scale: float) -> None:
    samples = np.array([0.1, 10.0 * (1 - 1e-15), 0.3, 9.99])[:, None] * scale
    (clipped,) = screened(samples, 2, [(-10.0 * scale, 10.0 * scale)]).findings()
    assert "1 samples" in clipped.message and "first is sample 1" in clipped.message


def test_a_gap_at_the_start_of_a_large_offset_keeps_the_level() -> None:
    samples = 1e9 + np.sin(np.arange(300.0))[:, None]
    samples[:3] = np.nan
    assert screened(samples, 2).rms[0] == pytest.approx(np.nanstd(samples), rel=1e-6)


@pytest.mark.parametrize("period", [150.0, 701.3])
def test_the_slow_turn_of_a_sine_in_few_steps_is_no_clipping(period: float) -> None:
    """Whole numbers: some tens of samples at each turn are equal. Then three steps are cut off."""
    sine = 50 * np.sin(2 * np.pi * np.arange(20_000) / period)
    assert screened(np.round(sine)[:, None], 1000).findings() == ()
    (finding,) = screened(np.minimum(np.round(sine), 47)[:, None], 1000).findings()
    assert finding.code == "clipped" and f"{np.sum(np.round(sine) >= 47)} samples" in finding.message


@pytest.mark.parametrize("high", [-0.03, 5.0])
def test_a_step_between_two_values_is_no_clipping(high: float) -> None:
    step = np.where(np.arange(300) < 100, -0.04, high)
    assert screened(step[:, None], 70).findings() == ()


def test_a_channel_without_any_number_is_a_gap_and_nothing_else() -> None:
    screen = screened(np.full((20, 1), np.nan), 7)
    assert [finding.code for finding in screen.findings()] == ["gap"]


def test_an_empty_block_changes_nothing() -> None:
    screen = screened(np.array([[1.0], [2.0]]), 2)
    screen.add(np.empty((0, 1)))
    assert (screen.n_sample, screen.maximum[0]) == (2, 2.0)


def test_two_equal_peaks_are_chance() -> None:
    samples = np.array([0.0, 1.0, 1.0, 0.5, 0.2, -1.0, 0.3])[:, None]
    assert screened(samples, 3).findings() == ()


@pytest.mark.parametrize("block", [500, 20_000])
def test_white_noise_that_is_cut_off_is_seen_though_no_run_is_long(block: int) -> None:
    """At two standard deviations 2.3 % of the samples stand at either end, and hardly ever three in a row."""
    noise = np.round(8192 * np.random.default_rng(5).normal(size=20_000)) / 8192
    assert screened(noise[:, None], block).findings() == ()
    cut = np.clip(noise, -2.0, 2.0)
    (finding,) = screened(cut[:, None], block).findings()
    assert finding.code == "clipped" and f"{np.sum(np.abs(cut) == 2.0)} samples" in finding.message
    assert f"the first is sample {np.argmax(np.abs(cut) == 2.0)}" in finding.message


@pytest.mark.parametrize("amplitude", [20.2, 64.5, 127.0])
def test_the_turn_of_a_coarse_sine_is_no_clipping(amplitude: float) -> None:
    """A quantised sine dwells at its extreme: of 2 q / A samples several times as many as on the next step,
    but not ten times.
    """
    t = np.arange(20_000) / 1000
    for phase in np.linspace(0, 6, 13):
        assert (
            screened(np.round(amplitude * np.sin(2 * np.pi * 137.3 * t + phase))[:, None], 4096).findings()
            == ()
        )


def test_a_sine_in_step_with_the_samples_is_no_clipping() -> None:
    """Eight samples a period: the same values again and again, but for rounding."""
    assert screened(np.sin(2 * np.pi * 125 * np.arange(20_000) / 1000)[:, None], 4096).findings() == ()


def axis(times: np.ndarray, block: int = 7) -> TimeAxisScreen:
    screen = TimeAxisScreen("t [s]")
    for start in range(0, times.size, block):
        screen.add(times[start : start + block])
    return screen


@pytest.mark.parametrize("rate", [1000.0, 20e3, 44100.0, 12800.0, 3.3])
@pytest.mark.parametrize("digits", [5, 6, 9])
def test_rounded_times_give_the_rate(rate: float, digits: int) -> None:
    times = np.round(np.arange(5000) / rate, digits)
    assert axis(times, 999).sample_rate() == pytest.approx(rate, rel=2 * 10.0**-digits * rate / 5000 + 1e-9)


@pytest.mark.parametrize("rate", [8192.0, 1001.0, 19998.0])
def test_times_rounded_to_nearly_the_step_are_no_fault(rate: float) -> None:
    # Printed to 1 us, 8192 Hz steps by 122 us and at times by 123 us.
    times = np.round(np.arange(5000) / rate, 6)
    assert axis(times, 999).sample_rate() == pytest.approx(rate, rel=1e-6 * rate / 5000)


def test_a_last_block_of_one_round_time_does_not_coarsen_the_digits() -> None:
    times = np.round(np.arange(44101) / 44100, 5)
    assert axis(times, 44100).sample_rate() == pytest.approx(44100, rel=1e-4)


def test_a_lost_sample_is_found_whatever_the_digits() -> None:
    for digits in (4, 6, 9):
        times = np.round(np.delete(np.arange(5000) / 2048, 3000), digits)
        with pytest.raises(DataError, match="not equal"):
            axis(times, 999).sample_rate()


@pytest.mark.parametrize("block", [999, 5000])
@pytest.mark.parametrize("step", [1e-3, 1 / 2048, 1e-5])
@pytest.mark.parametrize("digits", [5, 6, 9])
@pytest.mark.parametrize("lost", [0, 1, 7])
def test_lost_samples_are_told_beside_a_stated_rate(block: int, step: float, digits: int, lost: int) -> None:
    clock, there = LostSamples("t"), np.delete(np.arange(5000), slice(3000, 3000 + lost))
    times = np.round(there * step, digits)
    for start in range(0, times.size, block):
        clock.add(times[start : start + block])
    said = [f.message for f in clock.findings()]
    assert len(said) == (lost > 0)
    assert all(f"'t' {lost} sample(s) are lost, the first before sample 3000 (" in text for text in said)


@pytest.mark.parametrize(
    "times",
    [
        np.arange(5000) / 1000 + 3e-4 * np.sin(np.arange(5000) ** 2.0),
        np.floor(np.arange(5000) / 64) * 0.064,
        np.round(np.arange(5000) / 2048, 3),
        np.round(np.arange(5000) * 1.01e-3, 3),
        np.where(np.arange(5000) == 50, np.nan, np.arange(5000.0)),
        1.7e9 + np.arange(5000) / 10_000,
    ],
)
def test_clocks_that_jitter_or_have_few_digits_tell_no_lost_sample(times: np.ndarray) -> None:
    clock = LostSamples("t")
    clock.add(times)
    assert clock.findings() == ()


def test_dates_in_seconds_are_known_to_their_own_digits_only() -> None:
    times = 1.7e9 + np.arange(5000) / 10_000
    assert axis(times, 999).sample_rate() == pytest.approx(10_000, rel=1e-5)
    with pytest.raises(DataError, match="not equal"):
        axis(np.delete(times, 3000), 999).sample_rate()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: np.delete(t, 40), "steps of column 't .s.' are not equal: 0.002 s at sample 40"),
        (lambda t: np.where(np.arange(t.size) == 33, t[32], t), "does not rise at sample 33"),
        (lambda t: np.where(np.arange(t.size) == 33, np.nan, t), "no number at sample 33"),
        (lambda t: t + 2e-4 * (np.arange(t.size) % 2), "not equal"),
        (
            lambda t: np.delete(5 * t, [40, 41]),
            "0.015 s at sample 40, 0.005 s elsewhere; 2 .* lost there; cut the",
        ),
        (
            lambda t: np.repeat(5 * t, np.where(t == 0.02, 2, 1)),
            "0 s at sample 21, .* a row stands twice there",
        ),
        (lambda t: np.floor(100 * t) / 3, "are not equal: 0.3333"),
        (lambda t: t[:1], "fewer than two samples"),
    ],
)
def test_uneven_times_are_refused(change, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(DataError, match=message):
        axis(change(np.arange(100) / 1000.0)).sample_rate()


@pytest.mark.parametrize(
    ("rate", "printed", "n_sample"),
    [
        (51200, "%.6e", 60_000),
        (51200, "%g", 400_000),
        (512, "%.3f", 5000),
        (1024, "%.3f", 5000),
        (2048, "%.4f", 20_000),
        (2048, "%g", 20_000),
        (4096, "%.8g", 5000),
        (1600, "%.5f", 4000),
    ],
)
def test_equal_steps_within_their_printed_digits(rate: int, printed: str, n_sample: int) -> None:
    """Times n / rate as loggers print them give the rate itself.

    One lost sample in the middle is still refused.
    """
    times = np.array([float(printed % (n / rate)) for n in range(n_sample + 1)])
    assert rate_of(times[:-1]) == rate
    with pytest.raises(DataError, match="are not equal"):
        rate_of(np.delete(times, n_sample // 2))


def test_times_of_too_few_digits_to_see_a_lost_sample_are_refused() -> None:
    times = np.round(np.arange(5000) / 2048, 3)
    with pytest.raises(DataError, match="does not rise at sample 1; times of too few digits"):
        rate_of(times)


def rate_of(times: np.ndarray) -> float:
    screen = TimeAxisScreen("t")
    for start in range(0, times.size, 1000):
        screen.add(times[start : start + 1000])
    return screen.sample_rate()


def test_the_zeros_of_a_force_window_are_no_clipping() -> None:
    """A push of a hammer under a force window: half its samples are its lowest value, zero.

    Cut off at the top it is clipped.
    """
    force = np.zeros(400)
    force[20:40] = np.sin(np.pi * (np.arange(20) + 0.5) / 20)
    assert screened(force[:, None], 64).findings() == ()
    (finding,) = screened(np.minimum(force, 0.8)[:, None], 64).findings()
    assert finding.code == "clipped" and "first is sample 26" in finding.message


@pytest.mark.parametrize(
    ("n_clipped", "percent"), [(1000, "100 %"), (996, "100 %"), (990, "99 %"), (123, "12 %"), (3, "0.3 %")]
)
def test_shares_are_written_without_powers_of_ten(n_clipped: int, percent: str) -> None:
    samples = np.where(np.arange(1000) < n_clipped, 5.0, np.linspace(-4, 4, 1000))
    samples[-1] = -4.5
    (finding,) = screened(samples[:, None], 100, [(-10.0, 5.0)]).findings()
    assert f"({percent})" in finding.message
