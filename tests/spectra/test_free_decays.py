"""Where free decays begin and end, on recordings whose hits are known."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from labpipe.errors import ConfigError, DataError
from labpipe.records.recording import Channel, Recording
from labpipe.spectra.channels import DerivedRecording
from labpipe.spectra.free_decays import free_decays
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FreeDecaySettings, FrfSettings

RATE, OMEGA = 1024.0, 2 * np.pi * 40
SETTINGS = FrfSettings("decay")
PERIOD = 1 / 40


def recorded(*columns: np.ndarray, noise: float = 0.01, name: str = "run", rate: float = RATE) -> Recording:
    rng = np.random.default_rng(1)
    channels = tuple(Channel(f"y{n}", "displacement", "output", f"y{n}") for n in range(1, len(columns) + 1))
    samples = np.stack(columns, axis=1) + noise * rng.standard_normal((columns[0].size, len(columns)))
    return Recording(channels, samples, rate, name)


def struck(
    hits: tuple[float, ...], duration: float, zeta: float = 0.005, strengths: tuple[float, ...] = ()
) -> np.ndarray:
    """A mode pushed from rest at the times of *hits*, what is left of the one before added."""
    t = np.arange(round(duration * RATE)) / RATE
    y = np.full(t.size, 0.3)
    for hit, strength in zip(hits, strengths or (1.0,) * len(hits), strict=True):
        after = np.maximum(t - hit, 0.0)
        y += strength * np.exp(-zeta * OMEGA * after) * np.sin(OMEGA * after)
    return y


def spans(recording: Recording, settings: FrfSettings = SETTINGS) -> list[tuple[float, float]]:
    return [(d.start, d.start + d.samples.shape[0] / RATE) for d in free_decays([recording], settings).decays]


def test_every_hit_gives_a_decay_from_its_first_period_to_the_next_hit() -> None:
    found = spans(recorded(struck((0.5, 3.5, 6.5), 10.0, strengths=(1.0, 0.4, 0.8))))
    assert len(found) == 3
    for (start, end), hit, following in zip(found, (0.5, 3.5, 6.5), (3.5, 6.5, 10.0), strict=True):
        assert hit + PERIOD < start < hit + 3 * PERIOD and following - 3 * PERIOD < end <= following


@pytest.mark.parametrize("shape", [np.cos, np.sin])
def test_a_weaker_hit_is_seen_in_every_recording(shape: Callable[[np.ndarray], np.ndarray]) -> None:
    # Hits of 100, 80, 64 % and noise of 1 % of the first, as of the sample data: 40 recordings, three decays
    # in each of them.
    t = np.arange(round(12.2 * RATE)) / RATE
    parts = [(t >= hit, np.maximum(t - hit, 0.0), 0.8**number) for number, hit in enumerate((0.2, 4.2, 8.2))]
    y = np.select(
        [acts for acts, *_ in reversed(parts)],
        [size * np.exp(-0.005 * OMEGA * after) * shape(OMEGA * after) for _, after, size in reversed(parts)],
    )
    rng = np.random.default_rng(8)
    channels = (Channel("y", "displacement", "output", "y"),)
    for _ in range(40):
        found = spans(Recording(channels, (y + 0.01 * rng.standard_normal(t.size))[:, None], RATE, "run"))
        assert [round(start) for start, _ in found] == [0, 4, 8]


def test_a_decay_ends_where_it_is_lost_in_the_noise() -> None:
    """exp(-0.02 w t) comes down to the noise of 1 % after ln(100) / 5.03 = 0.92 s.

    Half as much again is kept, and no 20 s of silence.
    """
    ((start, end),) = spans(recorded(struck((0.5,), 20.0, zeta=0.02)))
    assert 1.0 < end - start < 1.8


def test_a_recording_that_begins_in_a_decay_is_used_from_its_second_period_on() -> None:
    t = np.arange(4096) / RATE
    ((start, end),) = spans(recorded(np.exp(-0.005 * OMEGA * t) * np.cos(OMEGA * t)))
    assert start < 4 * PERIOD and end > 3.9


def test_a_release_from_a_steady_state_begins_where_the_exciter_stops() -> None:
    t = np.arange(6144) / RATE
    y = np.exp(-0.005 * OMEGA * np.maximum(t - 2.0, 0)) * np.sin(OMEGA * t)
    ((start, _),) = spans(recorded(y))
    assert 2.0 < start < 2.0 + 6 * PERIOD


@pytest.mark.parametrize("spacing", [1.01, 1.05, 1.2])
def test_beats_of_two_modes_are_one_decay(spacing: float) -> None:
    t = np.arange(4096) / RATE
    y = np.exp(-0.003 * OMEGA * t) * (np.sin(OMEGA * t) + np.sin(spacing * OMEGA * t))
    assert len(spans(recorded(np.concatenate([np.zeros(300), y])))) == 1


def test_start_and_end_can_be_named() -> None:
    recording = recorded(struck((0.5, 3.5), 7.0))
    assert spans(recording, FrfSettings("decay", decay=FreeDecaySettings(start="4 s", end="6 s"))) == [
        (4.0, 6.0)
    ]
    (first, *_) = spans(recording, FrfSettings("decay", decay=FreeDecaySettings(settle="0.2 s")))
    assert 0.7 < first[0] < 0.75
    ((_, end),) = spans(recording, FrfSettings("decay", decay=FreeDecaySettings(end="2 s")))
    assert end == 2.0


def test_weak_hits_below_the_trigger_do_not_count() -> None:
    """A touch of a twentieth, after the first decay has died away."""
    recording = recorded(struck((0.5, 4.5), 7.0, zeta=0.02, strengths=(1.0, 0.05)), noise=1e-4)
    assert len(spans(recording)) == 1
    assert len(spans(recording, FrfSettings("decay", decay=FreeDecaySettings(trigger="2 %")))) == 2


def test_what_is_done_is_said_and_recordings_are_pooled() -> None:
    first, second = recorded(struck((0.5,), 4.0), name="a"), recorded(struck((0.2,), 3.0), name="b")
    decays = free_decays([first, second], SETTINGS, name="t", conditions={"x": "1"})
    assert (
        [d.recording for d in decays.decays] == ["a", "b"] and decays.units == ("m",) and decays.name == "t"
    )
    assert [f.code for f in decays.findings] == ["free-decay"] * 2
    assert "recording 'a' of 4 s: 1 free decay(s), 0.5" in decays.findings[0].message


def test_a_still_output_beside_a_moving_one_does_no_harm() -> None:
    decays = free_decays([recorded(struck((0.5,), 4.0), np.zeros(4096), noise=0.0)], SETTINGS)
    assert decays.decays[0].samples.shape[1] == 2 and len(decays.decays) == 1


@pytest.mark.parametrize(
    ("recording", "message"),
    [
        (recorded(np.zeros(4096)), "no decay stands out of the noise"),
        (recorded(np.zeros(4096), noise=0.0), "does not move"),
        (recorded(struck((1.0,), 4.0)[:1090]), "holds no free decay"),
    ],
    ids=["noise", "constant", "cut off"],
)
def test_recordings_without_a_decay_are_refused(recording: Recording, message: str) -> None:
    with pytest.raises(DataError, match=message):
        free_decays([recording], SETTINGS)


def test_a_recording_without_a_decay_is_left_out_beside_others() -> None:
    sound, quiet = recorded(struck((0.5,), 4.0), name="a"), recorded(np.zeros(4096), name="quiet")
    decays = free_decays([quiet, sound], SETTINGS)
    assert [decay.recording for decay in decays.decays] == ["a"]
    (said,) = [finding.message for finding in decays.findings if finding.code == "recording-left-out"]
    assert said.startswith("recording 'quiet' is left out")
    with pytest.raises(DataError, match="no decay stands out"):
        free_decays([quiet, quiet], SETTINGS)


def test_recordings_that_do_not_fit_together_are_refused() -> None:
    with pytest.raises(DataError, match="no recordings"):
        free_decays([], SETTINGS)
    with pytest.raises(DataError, match="different sampling rates"):
        free_decays([recorded(struck((0.5,), 4.0)), recorded(struck((0.5,), 4.0), rate=2048.0)], SETTINGS)
    with pytest.raises(DataError, match="lacks the response y2"):
        free_decays(
            [recorded(struck((0.5,), 4.0), struck((0.5,), 4.0)), recorded(struck((0.5,), 4.0))], SETTINGS
        )
    with pytest.raises(DataError, match="holds no free decay"):
        free_decays(
            [recorded(struck((0.5,), 4.0))], FrfSettings("decay", decay=FreeDecaySettings(start="9 s"))
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"band": "10-60 Hz"}, "'band' is not for decay excitation"),
        ({"mask": {"speed": "50 Hz"}}, "'mask' is not for decay excitation"),
        ({"directional": True}, "'directional' is not for decay excitation"),
        ({"block": "1 s"}, "'block' is not for decay excitation"),
        ({"decay": {"start": "2 s", "end": "1 s"}}, "'end' must come after 'start'"),
        ({"decay": {"settle": "-1 s"}}, "settle must not be negative"),
        ({"decay": {"trigger": "120 %"}}, "trigger must lie between"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_settings_without_a_meaning_are_refused(change: dict[str, object], message: str) -> None:
    from labpipe.spectra.settings import MaskSettings

    sections = {"mask": MaskSettings, "decay": FreeDecaySettings}
    with pytest.raises(ConfigError, match=message):
        FrfSettings("decay", **{k: sections[k](**v) if k in sections else v for k, v in change.items()})


def test_free_decays_give_no_frf() -> None:
    with pytest.raises(ConfigError, match="excitation decay gives no FRF"):
        measure([recorded(struck((0.5,), 4.0))], SETTINGS)
    with pytest.raises(ConfigError, match="`result: spectra` gives no FRF; channel_spectra makes them"):
        measure([recorded(struck((0.5,), 4.0))], FrfSettings("periodic", period=1.0, result="spectra"))


def test_a_drifting_rest_position_is_no_response() -> None:
    """Hits of 1 and .5 on a rest position that wanders by 5 in 60 s: both are found, and the drift's period
    is not taken for theirs.
    """
    y = struck((10.0, 40.0), 60.0, zeta=0.02, strengths=(1.0, 0.5))
    wander = 5 * np.sin(2 * np.pi * np.arange(y.size) / y.size)
    found = spans(recorded(y + wander))
    assert [round(start, 1) for start, _ in found] == [10.0, 40.0]
    assert all(end - start < 1.8 for start, end in found)


def test_a_decay_does_not_go_on_through_silence_into_a_hit_too_weak_to_count() -> None:
    """The second hit is four times the noise: no decay of its own, and no part of the first, which is lost in
    the noise after 1 s.
    """
    ((start, end),) = spans(recorded(struck((0.5, 15.0), 30.0, zeta=0.02, strengths=(1.0, 0.04))))
    assert start < 0.6 and end < 3.0


def test_a_sample_that_is_no_number_is_named() -> None:

    class Holed(DerivedRecording):
        def blocks(self, n_sample: int) -> Iterator[np.ndarray]:
            for block in self.source.blocks(n_sample):
                samples = block.copy()
                samples[1000] = np.nan
                yield samples

    with pytest.raises(DataError, match="'y1' of 'run' has no number at sample 1000"):
        free_decays([Holed(recorded(struck((0.5,), 4.0)))], SETTINGS)
