"""Whether a loop is closed, told from records: on an oscillator under a force from outside, and on rotors
under a controller.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import signal, stats

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.magnetic_bearing.levitated_loop import LevitatedRig
from labpipe.project.simulate import load_virtual_rig
from labpipe.raw_files.excitation import design_multisine
from labpipe.records.recording import Channel, Recording
from labpipe.simulate.virtual_rigs import recordings
from labpipe.spectra.feedback import COHERENT, LEVEL, chance_of_order, chance_of_phase, edges_of
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

CONFIGS = Path(__file__).parents[2] / "configs"
RATE = 2000.0
RANDOM = FrfSettings("random", block=1.0, band=(10.0, 300.0))
PERIODIC = FrfSettings("periodic", period=1.0, band=(10.0, 300.0))


def motion(force: np.ndarray, rate: float, zeta: float = 0.05) -> np.ndarray:
    """Of 4 kg on a spring at 40 Hz, by scipy's discrete model for a straight force."""
    k, c = 4 * (80 * np.pi) ** 2, 8 * zeta * 80 * np.pi
    slope = np.array([[0, 1], [-k / 4, -c / 4]])
    a, b, c_out, d, _ = signal.cont2discrete(
        (slope, np.array([[0], [0.25]]), np.array([[1, 0]]), np.zeros((1, 1))), 1 / rate, "foh"
    )
    numerator, denominator = signal.ss2tf(a, b, c_out, d)
    return np.asarray(signal.lfilter(numerator[0], denominator, force))


def open_loop(
    seed: int, band: tuple[float, float], zeta: float, slope: float = 0.0, noise: float = 0.01
) -> Recording:
    """Random force in a band, its motion, both behind an anti-alias filter, with noise of both sensors."""
    rng = np.random.default_rng(seed)
    n = round(16 * 5 * RATE)
    frequency = np.fft.rfftfreq(n, 1 / (5 * RATE))
    spectrum = (rng.standard_normal((frequency.size, 2)) @ [1, 1j]) * (
        (frequency >= band[0]) & (frequency <= band[1])
    )
    force = np.fft.irfft(spectrum * np.maximum(frequency, 1.0) ** slope, n)
    both = np.column_stack([force, motion(force, 5 * RATE, zeta)]) / [np.std(force), 1.0]
    logged = signal.resample_poly(both, 1, 5)[800:-800]
    logged = logged + noise * np.std(logged, axis=0) * rng.standard_normal(logged.shape)
    channels = (Channel("f", "force", "input", "x", 0.0), Channel("x", "displacement", "output", "x", 0.0))
    return Recording(channels, logged, RATE, "open")


def rig(axes: str = "x", disturbance: float = 4.0, **changes: object) -> LevitatedRig:
    shipped = load_virtual_rig(CONFIGS / "virtual-levitated.yaml")
    assert isinstance(shipped, LevitatedRig)
    changes.setdefault("cross_stiffness", shipped.cross_stiffness if axes == "xy" else 0.0)
    noise, injection = (
        replace(shipped.noise, disturbance=disturbance),
        replace(shipped.injection, duration=8.0, periods=10),
    )
    return replace(shipped, axes=axes, force_recorded=True, noise=noise, injection=injection, **changes)  # type: ignore[arg-type]


def feedback(recordings: list[Recording], settings: FrfSettings) -> list[str]:
    return [
        finding.message for finding in measure(recordings, settings).findings if finding.code == "feedback"
    ]


@pytest.mark.parametrize("zeta", [0.5, 0.05, 0.005])
@pytest.mark.parametrize(
    ("band", "slope"),
    [((0.0, 5000.0), 0.0), ((5.0, 500.0), 0.0), ((20.0, 200.0), 0.0), ((1.0, 1000.0), -1.0)],
)
def test_a_force_from_outside_is_no_feedback(band: tuple[float, float], slope: float, zeta: float) -> None:
    """White, band-limited and coloured, damping 50 %, 5 % and 0.5 %.

    What the anti-alias filter does before the force is not a loop.
    """
    for seed, noise in ((1, 0.0), (2, 0.01), (3, 0.3)):
        run = open_loop(seed, band, zeta, slope, noise)
        assert chance_of_order(run.samples[:, :1], run.samples[:, 1:]) > LEVEL


def test_hits_and_shakers_on_a_levitated_rotor_are_no_feedback() -> None:
    """A shaker's force is measured outside of the bearing's loop; hits come when they come."""
    (shaken,) = recordings(rig("xy"), 1, ["shaker"])
    assert feedback([shaken], RANDOM) == []
    force = np.zeros(60000)
    for start in range(1000, 58000, 3900):
        force[start : start + 6] = np.hanning(8)[1:-1] * 100
    samples = np.column_stack([force, motion(force, RATE)]) + np.random.default_rng(1).standard_normal(
        (60000, 2)
    ) * [0.01, 1e-8]
    struck = replace(open_loop(1, (5.0, 500.0), 0.05), samples=samples)
    assert feedback([struck], FrfSettings("impact", block=1.5)) == []


def test_a_loop_is_found_whichever_recording_of_a_force_shows_it() -> None:
    """The same two recordings in either order: one of a levitated rotor, one with a force from outside."""
    (closed,) = recordings(rig(), 1, ["random"])
    outside = open_loop(1, (5.0, 500.0), 0.05)
    force, motion_of = (
        replace(channel, name=name) for channel, name in zip(outside.channels, ("f_x", "x"), strict=True)
    )
    other = replace(outside, channels=(force, motion_of))
    assert len(feedback([other, closed], RANDOM)) == len(feedback([closed, other], RANDOM)) == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"disturbance": 1.0},
        {"disturbance": 16.0},
        {"disturbance": 4.0, "axes": "xy"},
        {"disturbance": 4.0, "negative_stiffness": -2e5},
    ],
)
def test_a_force_in_a_loop_is_found(changes: dict[str, object]) -> None:
    """Levitated rotors, with little and with much disturbance, and a stable one on springs under the same
    controller.
    """
    made = rig(**changes)  # type: ignore[arg-type]
    (found,) = feedback(list(recordings(made, 1, ["random"])), RANDOM)
    assert "follows the responses (p < 1e-07)" in found and "role: reference" in found
    assert (
        feedback(
            list(recordings(made, 1, ["random"])),
            replace(RANDOM, reference=tuple(f"r_{a}" for a in made.labels)),
        )
        == []
    )


@pytest.mark.parametrize("kind", ["stiffness", "accelerance", "mobility"])
@pytest.mark.parametrize(("cut", "order"), [(None, 0), (400.0, 6), (250.0, 8), (120.0, 4)])
def test_a_structure_that_answers_at_once_is_no_feedback(kind: str, cut: float | None, order: int) -> None:
    """An accelerance and a stiffness line do not fall with frequency, whatever filter force and response went
    through together.
    """
    for seed in range(4):
        rng = np.random.default_rng(100 + seed)
        force = rng.normal(size=24_000)
        if cut is not None:
            force = signal.sosfilt(signal.butter(order, cut, fs=1024.0, output="sos"), force)
        w = 2 * np.pi * np.fft.rfftfreq(force.size, 1 / 1024.0)
        w_0, zeta = 2 * np.pi * rng.uniform(20, 150), rng.choice([0.005, 0.05, 0.5])
        mode = 1 / (w_0**2 - w**2 + 2j * zeta * w * w_0)
        transfer = {"stiffness": np.ones(w.size), "accelerance": -(w**2) * mode, "mobility": 1j * w * mode}[
            kind
        ]
        late = np.exp(-1j * w * rng.uniform(0, 3e-4))
        response = np.fft.irfft(np.fft.rfft(force) * transfer * late, force.size)
        noise = rng.choice([1e-4, 1e-2, 0.1]) * response.std() * rng.normal(size=force.size)
        assert chance_of_order(force[:, None], (response + noise)[:, None]) > LEVEL


@pytest.mark.parametrize("hits", [False, True])
def test_an_accelerance_where_a_plate_is_driven_is_no_feedback(hits: bool) -> None:
    """Simply supported, the sum over modes up to 20 kHz in closed form: its mobility is real in the mean, so
    that the accelerance is in quadrature where the band ends.
    """
    rng, n, rate = np.random.default_rng(3), 60_000, 2048.0
    of_x, of_y = (part.ravel() for part in np.meshgrid(np.arange(1, 45), np.arange(1, 45)))
    natural = 2 * np.pi * 14.0 * (of_x**2 + 1.1 * of_y**2)
    shape = (np.sin(0.37 * np.pi * of_x) * np.sin(0.21 * np.pi * of_y))[natural < 4e4 * np.pi]
    natural = natural[natural < 4e4 * np.pi]
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / rate)
    accelerance = sum(
        -(w**2) * a**2 / (w_n**2 - w**2 + 0.02j * w_n * w) for a, w_n in zip(shape, natural, strict=True)
    )
    force = rng.normal(size=n)
    if hits:
        force *= np.arange(n) % 4001 < 3
    force = signal.sosfilt(signal.butter(8, 800.0, fs=rate, output="sos"), force)
    motion_there = np.fft.irfft(np.fft.rfft(force) * accelerance, n)
    motion_there += 1e-3 * motion_there.std() * rng.normal(size=n)
    assert chance_of_order(force[:, None], motion_there[:, None]) > LEVEL


@pytest.mark.parametrize("closed", [False, True])
def test_what_a_force_holds_between_hits_is_feedback_only_with_the_response(closed: bool) -> None:
    """3 kg under hits of 4 ms. On a spring at 60 Hz with 2 % of the peak as noise of the force, by its
    accelerance; and levitated by a controller that works against a negative stiffness and 10 N of random
    disturbance, most of what it does between the hits, by its motion. Both in closed form.
    """
    rate, n, mass, natural = 2048.0, 32_768, 3.0, 2 * np.pi * 60.0
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / rate)
    held, damping = mass * natural**2, 2 * 0.3 * mass * natural
    controller = closed * (1.5 * held + 1j * w * damping) / (1 + 1j * w / (2 * np.pi * 800.0))
    plant = 1 / (held * (-0.5 if closed else 1.0) - mass * w**2 + 1j * w * damping * (not closed))
    for seed in range(3):
        rng, hits = np.random.default_rng(200 + seed), np.zeros(n)
        for start in range(200, n - 3000, 3600):
            hits[start + rng.integers(200) :][:8] += rng.uniform(70, 130) * np.hanning(10)[1:-1]
        struck, disturbance = np.fft.rfft(hits), np.fft.rfft(10.0 * closed * rng.normal(size=n))
        moved = plant * (struck + disturbance) / (1 + plant * controller)
        force = np.fft.irfft(struck - controller * moved, n) + (0.1 if closed else 2.0) * rng.normal(size=n)
        response = np.fft.irfft(moved * (1.0 if closed else -(w**2)), n)
        response += 0.01 * np.max(np.abs(response)) * rng.normal(size=n)
        chance = chance_of_order(force[:, None], response[:, None])
        assert chance < LEVEL if closed else chance > LEVEL


@pytest.mark.long
def test_of_a_rotor_left_alone_the_values_are_no_support() -> None:
    """Without injection H is minus the inverse of the controller, which is causal: no loop shows, but
    negative stiffness and damping do, all of their intervals, and the residual is far from noise.
    """
    response = measure(list(recordings(rig(), 1, ["rest"])), RANDOM)
    assert not [finding for finding in response.findings if finding.code == "feedback"]
    (fit,) = identify(response, FitSettings("sdof", mass=4.0))
    for name in ("k", "c"):
        parameter = fit.parameter(name)
        assert parameter.value < 0 and parameter.ci95 is not None and parameter.ci95[1] < 0
    assert {"mass", "model-mismatch"} <= {finding.code for finding in fit.findings}


def test_a_reference_inside_the_loop_opens_nothing() -> None:
    """The controller's output holds what is injected and what it makes of the motion."""
    made = rig(output_recorded=True)
    (found,) = feedback(list(recordings(made, 1, ["random"])), replace(RANDOM, reference=("u_x",)))
    assert "around the reference u_x too" in found


def periodic(seed: int, periods: int, of_force: float, of_sensors: float) -> Recording:
    """Six to twenty periods of a multisine with a random force besides, and noise of the sensors."""
    rng = np.random.default_rng(seed)
    force = design_multisine((5.0, 300.0), 1.0, 1.0).samples(RATE, periods)
    force = force + of_force * rng.standard_normal(force.size)
    both = np.column_stack([force, motion(force, RATE)])
    both = both + of_sensors * np.std(both, axis=0) * rng.standard_normal(both.shape)
    return replace(open_loop(1, (5.0, 500.0), 0.05), samples=both)


@pytest.mark.long
def test_periods_show_a_loop_by_what_does_not_repeat() -> None:
    """A random force besides the periods, and noise of the force's sensor, correlate force and motion without
    any loop.
    """
    for seed, periods in enumerate((5, 7, 21)):
        for of_force, of_sensors in ((0.0, 0.01), (0.5, 0.001), (0.2, 0.1)):
            assert feedback([periodic(seed, periods, of_force, of_sensors)], PERIODIC) == []
    for disturbance in (0.1, 4.0, 16.0):
        made = rig(disturbance=disturbance)
        (found,) = feedback(list(recordings(made, 1, ["multisine-x"])), PERIODIC)
        assert "chosen and weighted by a force" in found
        assert (
            feedback(list(recordings(made, 1, ["multisine-x"])), replace(PERIODIC, reference=("r_x",))) == []
        )


def test_hum_in_the_sensors_of_force_and_motion_is_no_feedback() -> None:
    """The mains at 50.03 Hz, which do not repeat with the periods, without any loop; a loop beside hum is
    named all the same.
    """
    for seed in range(4):
        run = periodic(seed, 15, 0.0, 0.01)
        hum = np.cos(2 * np.pi * 50.03 / RATE * np.arange(run.samples.shape[0])[:, None] + [0.0, 1.0])
        size = 0.1 * np.std(run.samples, axis=0)
        assert feedback([replace(run, samples=run.samples + size * hum)], PERIODIC) == []
    (run,) = recordings(rig(disturbance=4.0), 1, ["multisine-x"])
    names = [channel.name for channel in run.channels]
    hum = np.cos(2 * np.pi * 50.03 / run.sample_rate * np.arange(run.samples.shape[0]))
    size = 0.1 * np.std(run.samples, axis=0) * [name[0] in "fx" for name in names]
    assert len(feedback([replace(run, samples=run.samples + size * hum[:, None])], PERIODIC)) == 1


def test_the_phase_test_is_exact(rng: np.random.Generator) -> None:
    """p-values of Gaussian noise with real S_wu / G are uniform, of 4 degrees of freedom as of 40: 5 % below
    0.05.
    """
    for dof in (4, 40):
        response = rng.standard_normal(20) + 1j * rng.standard_normal(20)
        chances = []
        for _ in range(400):
            u, w = (rng.standard_normal((20, dof, 2)) @ [1, 1j] for _ in range(2))
            w = w - 0.7 * response[:, None] * u
            both = np.stack([u, w + response[:, None] * u], axis=1)
            chances.append(
                chance_of_phase(both @ both.conj().swapaxes(1, 2) / dof, response, np.zeros(20), dof)
            )
        assert np.mean(np.array(chances) < 0.05) == pytest.approx(0.05, abs=0.03)
        assert np.mean(chances) == pytest.approx(0.5, abs=0.05)


def tail(larger: float, free: float, lines: int, level: float) -> float:
    """The chance of p < *level* of Fisher's sum of so many lines if each t is sqrt(*larger*) times Student's:
    the law of -2 ln p on a grid, convolved with itself.
    """
    grid, step = np.arange(0, 2**16), 0.01
    value = stats.t.isf(np.exp(-grid * step / 2) / 2, free)
    beyond = 2 * stats.t.sf(value / np.sqrt(larger), free)
    chance = -np.diff(beyond, append=0.0)
    total = np.fft.irfft(np.fft.rfft(chance, 2**17) ** lines, 2**17)
    # A cell stands for its middle.
    return float(np.sum(total[round((stats.chi2.isf(level, 2 * lines) - lines * step / 2) / step) :]))


@pytest.mark.long
def test_a_random_force_is_no_feedback_by_the_error_of_the_response(rng: np.random.Generator) -> None:
    """Twenty periods whose force scatters by .7 of its line: the response that follows from the means is
    turned by as much as the test looks for, 19 S_uu / |u|^2 = 0.475 of the variance.

    The tail of the statistic says 8 % of false alarms at 0.1 % if that is left out, and draws say the same;
    with it draws hold their level.
    """
    n, lines, force = 20, 31, np.sqrt(0.5)
    plain, whole = [], []
    for _ in range(1500):
        d, v = ((rng.standard_normal((2, lines, n)).T @ [1, 1j]).T / np.sqrt(2) for _ in range(2))
        both = np.stack([1 + force * d, 1 + force * d + 0.01 * v], axis=1)
        mean = both.mean(axis=2)
        rest = both - mean[..., None]
        noise = rest @ rest.conj().swapaxes(1, 2) / (n - 1) / n
        gain = np.abs(mean[:, 0]) ** -2
        response = mean[:, 1] / mean[:, 0]
        plain.append(chance_of_phase(noise, response, np.zeros(lines), n - 1))
        whole.append(chance_of_phase(noise, response, gain, n - 1))
    assert tail(1.0, 2 * n - 4, lines, 1e-3) == pytest.approx(1e-3, rel=0.02)
    assert np.mean(np.array(plain) < 1e-3) == pytest.approx(tail(1.475, 2 * n - 4, lines, 1e-3), abs=0.025)
    for level, allowed in ((0.05, 0.018), (0.01, 0.009)):
        assert np.mean(np.array(whole) < level) == pytest.approx(level, abs=allowed)


def test_feedback_takes_the_place_of_wrong_causes() -> None:
    """The biased fit says feedback, and neither that the mass is wrong nor that a sign is."""
    (run,) = recordings(rig(disturbance=16.0), 1, ["random"])
    (fit,) = identify(measure([run], RANDOM), FitSettings("sdof", mass=4.0))
    codes = [finding.code for finding in fit.findings]
    assert codes[0] == "feedback" and not {"mass", "unphysical"} & set(codes)
    assert "biased towards minus the inverse of the controller" in fit.findings[0].message


def test_short_and_narrow_records_tell_nothing() -> None:
    run = open_loop(1, (5.0, 500.0), 0.05)
    assert chance_of_order(run.samples[:1500, :1], run.samples[:1500, 1:]) == 1.0
    narrow = open_loop(1, (300.0, 400.0), 0.05)
    assert chance_of_order(narrow.samples[:, :1], narrow.samples[:, 1:]) == 1.0
    still = np.zeros((4000, 1))
    assert chance_of_order(run.samples[:4000, :1], still) == 1.0


@pytest.mark.parametrize(("beyond", "edges"), [(0.2, (10, 30)), (COHERENT, (0, 40))])
def test_a_band_ends_at_a_cliff_unless_the_force_is_coherent_beyond(
    beyond: float, edges: tuple[int, int]
) -> None:
    """Power of one from band 10 to 30, of 0.01 outside: noise where nothing of the response goes with it, a
    weak force where 0.9 does.
    """
    inside = (np.arange(40) >= 10) & (np.arange(40) < 30)
    coarse = np.where(inside, 1.0, 0.01)[:, None]
    assert edges_of(coarse, np.where(inside, 1.0, beyond)) == edges
    # A slope that falls by less than to a tenth within a quarter of the frequency is not a cliff.
    assert edges_of((np.maximum(np.arange(40), 1) / 40.0)[:, None] ** 2, np.full(40, 0.2)) == (0, 40)


def test_rounding_of_a_force_that_repeats_to_the_last_digit_is_no_feedback(rng: np.random.Generator) -> None:
    """Forces of 1 N whose noise is that of the response times 1e-9 and -j beside noise of its own, as a
    controller feeds it back, and times 1e-13, which double precision leaves of a computed force.
    """
    tone = rng.standard_normal((20, 8)) + 1j * rng.standard_normal((20, 8))
    found = []
    for share in (1e-9, 1e-13):
        own = rng.standard_normal((20, 8)) + 1j * rng.standard_normal((20, 8))
        both = np.stack([-1j * share * (tone + 0.3 * own), tone], axis=1)
        noise = both @ both.conj().swapaxes(1, 2) / 8
        found.append(chance_of_phase(noise, np.ones(20, complex), np.ones(20), 8))
    assert found[0] < LEVEL and found[1] == 1.0
