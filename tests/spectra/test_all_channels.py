"""Spectra of all channels against the virtual floating stator: the balance of its forces, noise as it was put
in, what is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.errors import ConfigError, DataError
from labpipe.methods.floating_bearing.virtual_rig import FLOATING_RIG, FloatingRig
from labpipe.project.simulate import load_virtual_rig
from labpipe.records.recording import Channel, Number, Recording, SumTerm
from labpipe.records.spectra import ChannelSpectra
from labpipe.records.uncertain import ChannelUncertainty, Uncertainty
from labpipe.simulate.virtual_rigs import recordings
from labpipe.spectra.all_channels import channel_spectra, shared_noise
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

CONFIG = Path(__file__).parents[2] / "configs/virtual-floating.yaml"
PERIODIC = FrfSettings("periodic", period="1 s", skip=0, band="10-100 Hz", result="spectra")
RANDOM = FrfSettings("random", block="4 s", band="10-100 Hz", result="spectra")
K = np.array([[3.30e6, 11.3e6], [-10.3e6, 3.89e6]])
C = np.array([[147e3, 52.9e3], [-57.7e3, 147e3]])
M = np.array([[229.0, 16.0], [32.0, 214.0]])


def seal(**changes: object) -> FloatingRig:
    rig = load_virtual_rig(CONFIG)
    assert isinstance(rig, FloatingRig)
    return replace(rig, runout=(), unbalance=0.0, **changes)  # type: ignore[arg-type]


def quiet(rig: FloatingRig) -> FloatingRig:
    """The same excitation with a millionth of the noise."""
    made: FloatingRig = FLOATING_RIG.noisy(rig, 1e-6)
    return made


def spectra(rig: FloatingRig, *runs: str, seed: int = 1, settings: FrfSettings = PERIODIC) -> ChannelSpectra:
    return channel_spectra(recordings(rig, seed, runs), settings, name="seal")


def balance(frequency: np.ndarray) -> np.ndarray:
    """B (n_line, 2, 6) of F - m_s A - (K_b + j w C_b) A / (jw)^2 - H D = 0 on (f, d, a), the printed
    coefficients written out.
    """
    jw = 2j * np.pi * frequency[:, None, None]
    eye = np.broadcast_to(np.eye(2), (frequency.size, 2, 2))
    stator = 60 + (4e6 + jw * 2e3) / jw**2
    return np.concatenate([eye, -(K + jw * C + jw**2 * M), -stator * eye], axis=2)


def chi2_of_balance(found: ChannelSpectra) -> np.ndarray:
    """e^H S^-1 e over its two equations (n_line, n_run), with e = B z and S = B C_z B^H: one on average."""
    b = balance(found.frequency)
    order = [
        [channel.name for channel in found.channels].index(f"{letter}_{axis}")
        for letter in "fda"
        for axis in "xy"
    ]
    e = np.einsum("lic,lrc->lri", b, found.vectors[:, :, order])
    s = b[:, None] @ found.covariance[:, :, order][..., order] @ b[:, None].conj().swapaxes(2, 3)
    return np.einsum("lri,lrij,lrj->lr", e.conj(), np.linalg.inv(s), e).real / 2


def pooled_dof(dof: float, half_width: int) -> float:
    """1 / mean(1 / nu_k) of 91 lines whose noise is averaged over so many lines to either side."""
    counts = [min(k, half_width) + min(90 - k, half_width) + 1 for k in range(91)]
    return dof / float(np.mean(1 / np.array(counts)))


@pytest.mark.parametrize("runs", [("seal-x", "seal-y"), ("seal-plus", "seal-minus"), ("seal-zipper",)])
def test_noise_of_the_vectors_is_that_of_their_covariance(runs: tuple[str, ...]) -> None:
    """Against the same excitation without noise: e^H C^-1 e over 6 channels, averaged over lines and runs, is
    nu / (nu - 6) (Hotelling).

    Over 6 draws its standard error is 1 / sqrt(6 x 91 x runs x 6), increased by the noise of the covariance,
    which neighbours share.
    """
    rig = seal()
    ratios = []
    for seed in range(6):
        noisy, exact = spectra(rig, *runs, seed=seed), spectra(quiet(rig), *runs, seed=seed)
        e = noisy.vectors - exact.vectors
        ratios.append(
            np.mean(np.einsum("lrc,lrcd,lrd->lr", e.conj(), np.linalg.inv(noisy.covariance), e).real) / 6
        )
    nu = noisy.covariance_dof
    # Sixty degrees of freedom are plenty: of one run 9 lines are averaged, of two that share their noise 5.
    expected = pooled_dof(7.0, 4) if len(runs) == 1 else pooled_dof(14.0, 2)
    assert nu == pytest.approx(expected, rel=0.05) and noisy.vectors.shape == (91, len(runs), 6)
    assert np.mean(ratios) == pytest.approx(nu / (nu - 6), abs=0.07)


@pytest.mark.parametrize("runs", [("seal-x", "seal-y"), ("seal-plus", "seal-minus"), ("seal-zipper",)])
def test_the_balance_holds_line_by_line(runs: tuple[str, ...]) -> None:
    found = spectra(seal(shaft_noise=20.0), *runs)
    assert found.runs == runs and list(found.frequency) == pytest.approx(list(range(10, 101)))
    assert np.mean(chi2_of_balance(found)) == pytest.approx(1.0, abs=0.25)


def test_few_periods_are_pooled_until_weights_by_them_are_worth_it() -> None:
    """Two periods in one run have one degree of freedom a line: 13 lines are needed, not the usual 11."""
    short = seal(periods=2)
    found = (
        spectra(short, "seal-zipper").covariance_dof,
        spectra(short, "seal-plus", "seal-minus").covariance_dof,
    )
    assert found == pytest.approx((pooled_dof(1.0, 6), pooled_dof(2.0, 5)), rel=0.05)
    assert spectra(short, "seal-plus", "seal-minus", settings=replace(PERIODIC, smooth=0)).covariance_dof == 2


def test_runs_share_their_noise_only_where_it_is_the_same() -> None:
    """Chi-square draws of equal and of 1.5 times larger power, 200 lines of 7 degrees of freedom.

    Seeds pinned.
    """
    rng = np.random.default_rng(3)
    draws = [rng.gamma(7, 1 / 7, (200, 2)) * [1.0, 4.0] for _ in range(3)]
    noises = [np.asarray(draw[:, :, None] * np.eye(2), complex) for draw in draws]
    assert shared_noise(noises, [7.0, 7.0, 7.0])
    assert not shared_noise([noises[0], 1.5 * noises[1]], [7.0, 7.0])
    louder = replace(seal(), noise=replace(seal().noise, displacement=4e-7))
    mixed = [recordings(seal(), 1, ["seal-plus"])[0], recordings(louder, 1, ["seal-minus"])[0]]
    found = channel_spectra(mixed, PERIODIC)
    d = [channel.name for channel in found.channels].index("d_x")
    first, second = found.covariance[:, :, d, d].real.mean(axis=0)
    assert second / first == pytest.approx(4.0, rel=0.1)
    # Lines whose noise stands out by chance keep their own.
    assert 0.8 * pooled_dof(7.0, 4) < found.covariance_dof <= pooled_dof(7.0, 4)


def with_sums(recordings: Sequence[Recording], **changes: float) -> list[Recording]:
    """e = f - 60 kg a beside the channels, the probes known to be late by 100 us."""
    uncertainty = Number("m_s", 60.0, 0.5, "kg")
    made = []
    for run in recordings:
        kept = [
            replace(channel, delay=1e-4) if channel.name[0] == "d" else channel for channel in run.channels
        ]
        kept = [replace(channel, role="reference") if channel.name[0] == "f" else channel for channel in kept]
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
        # What lies in the columns of the sums is not used.
        made.append(
            Recording(
                (*kept, *sums), np.column_stack([run.samples, run.samples[:, :2]]), run.sample_rate, run.name
            )
        )
    return made


def test_delays_are_taken_out_and_sums_made_line_by_line() -> None:
    """Late probes give the vectors of punctual ones; e = f - 60 a with the variance of that sum.

    The factor's effect on the vector.
    """
    late = seal(probe_delay=1e-4)
    found = channel_spectra(with_sums(recordings(late, 1, ["seal-plus", "seal-minus"])), PERIODIC)
    plain = spectra(seal(), "seal-plus", "seal-minus")
    names = [channel.name for channel in found.channels]
    assert names == ["f_x", "f_y", "d_x", "d_y", "a_x", "a_y", "e_x", "e_y"] and found.columns(
        "force", "input"
    ) == [6, 7]
    np.testing.assert_allclose(found.vectors[:, :, :6], plain.vectors, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(
        found.vectors[:, :, 6:], plain.vectors[:, :, :2] - 60 * plain.vectors[:, :, 4:], rtol=1e-9
    )
    variance = found.covariance[:, :, 6, 6]
    by_hand = (
        found.covariance[:, :, 0, 0]
        - 120 * found.covariance[:, :, 0, 4].real
        + 3600 * found.covariance[:, :, 4, 4]
    )
    np.testing.assert_allclose(variance, by_hand, rtol=1e-9)
    (factor,) = found.factors
    assert (factor.name, factor.std_error, factor.unit) == ("m_s", 0.5, "kg")
    changed = np.einsum("cd,lrd->lrc", factor.derivative, found.vectors)
    np.testing.assert_allclose(changed[:, :, 6:], -found.vectors[:, :, 4:6])
    assert not np.any(changed[:, :, :6])


@pytest.mark.parametrize("effect", ["gain", "delay", "phase", "direction"])
def test_uncertainties_of_calibrations_change_the_vector_as_they_are_declared(effect: str) -> None:
    """A recording whose d_x has the error gives another vector; the factor's derivative takes it back, to
    second order.

    By a thousandth: a gain of 1.001, 1 us, 1 mrad of phase, and d_x pointing 1 mrad towards y.
    """
    size = {"gain": 1e-3, "delay": 1e-6, "phase": 1e-3, "direction": 1e-3}[effect]
    runs = recordings(quiet(seal()), 1, ["seal-plus", "seal-minus"])
    uncertainty = ChannelUncertainty(effect, Uncertainty("probe", size, "1"))
    marked = []
    for run in runs:
        channels = [
            replace(one, uncertainties=(uncertainty,)) if one.name == "d_x" else one for one in run.channels
        ]
        twice = Channel("s", "displacement", "output", "s", terms=(SumTerm("d_x", -2.0),))
        marked.append(
            replace(
                run, channels=(*channels, twice), samples=np.column_stack([run.samples, run.samples[:, :1]])
            )
        )
    exact = channel_spectra(marked, PERIODIC)
    (factor,) = exact.factors
    assert (factor.source, factor.std_error) == ("probe", size)
    omega = 2 * np.pi * exact.frequency[:, None]
    names = [channel.name for channel in exact.channels]
    d_x, d_y, s = (exact.vectors[:, :, names.index(name)] for name in ("d_x", "d_y", "s"))
    wrong = {
        "gain": d_x * (1 + size),
        "delay": d_x * np.exp(-1j * omega * size),
        "phase": d_x * np.exp(-1j * size),
    }.get(effect, np.cos(size) * d_x + np.sin(size) * d_y)
    change = (
        size
        * omega**factor.power
        * np.einsum("cd,lrd->lrc", factor.derivative, exact.vectors)[:, :, names.index("d_x")]
    )
    # What the error does is taken back, but for its square.
    largest = size * np.max(omega) ** factor.power
    np.testing.assert_allclose(
        change, d_x - wrong, rtol=0, atol=largest**2 * np.max(np.abs(exact.vectors[:, :, :4]))
    )
    assert np.max(np.abs(change)) > 100 * largest**2 * np.max(np.abs(d_x))
    of_sum = (
        size
        * omega**factor.power
        * np.einsum("cd,lrd->lrc", factor.derivative, exact.vectors)[:, :, names.index("s")]
    )
    np.testing.assert_allclose(of_sum, -2 * change, rtol=1e-12)
    np.testing.assert_allclose(s, -2 * d_x, rtol=1e-12)


def test_a_force_that_points_elsewhere_pushes_across_too() -> None:
    """Forces add up: f_x at the angle -d, written as 0, acts as f_x cos d along x and -f_x sin d along y,
    which is left out.
    """
    angle = 1e-3
    runs = recordings(quiet(seal()), 1, ["seal-plus", "seal-minus"])
    uncertainty = ChannelUncertainty("direction", Uncertainty("shaker", angle, "rad"))
    marked = [
        replace(
            run,
            channels=tuple(
                replace(c, uncertainties=(uncertainty,)) if c.name == "f_x" else c for c in run.channels
            ),
        )
        for run in runs
    ]
    found = channel_spectra(marked, PERIODIC)
    (factor,) = found.factors
    f_x, f_y = found.columns("force", "input")
    changed = angle * np.einsum("cd,lrd->lrc", factor.derivative, found.vectors)
    np.testing.assert_allclose(changed[:, :, f_y], np.sin(angle) * found.vectors[:, :, f_x], rtol=1e-6)
    assert np.max(np.abs(np.delete(changed, f_y, axis=2))) < 1e-12 * np.max(np.abs(changed))


def test_drives_are_instruments_for_random_forces() -> None:
    """Two runs, one per drive.

    The balance holds within the covariance of the residual, whatever disturbs the shaft.
    """
    rig = seal(drives=True, periods=120, shaft_noise=20.0)
    found = spectra(rig, "seal-random", settings=RANDOM)
    assert found.runs == ("u_x", "u_y") and not found.findings
    assert np.mean(chi2_of_balance(found)) == pytest.approx(1.0, abs=0.15)
    forces = np.abs(found.vectors[:, :, :2]).mean(axis=0)
    assert forces[0, 0] > 5 * forces[0, 1] and forces[1, 1] > 5 * forces[1, 0]
    assert len(found.line_correlation) > 0


def test_random_data_need_recorded_independent_drives() -> None:
    rig = seal(periods=40)
    with pytest.raises(DataError, match="needs a recorded drive"):
        spectra(rig, "seal-random", settings=RANDOM)
    rig = replace(rig, drives=True)
    (run,) = recordings(rig, 1, ["seal-random"])
    with pytest.raises(ConfigError, match=r"'u_z' is not a channel.*u_"):
        channel_spectra([run], replace(RANDOM, reference=("u_x", "u_z")))
    # Its own noise would be due to it: none of it in the covariance.
    force = next(channel.name for channel in run.channels if channel.role == "input")
    with pytest.raises(ConfigError, match=f"'{force}' is a force of the FRF"):
        channel_spectra([run], replace(RANDOM, reference=(force, "u_x")))
    samples = run.samples.copy()
    samples[:, 7] = samples[:, 6]
    with pytest.raises(DataError, match="u_x, u_y are not independent"):
        channel_spectra([replace(run, samples=samples)], RANDOM)
    with pytest.raises(DataError, match="too few"):
        channel_spectra([run], replace(RANDOM, block=20.0))


def test_noise_beyond_a_tenth_is_said() -> None:
    """A thousand times the noise of the probes, two thousand times that of the forces."""
    rig = seal()
    loud = replace(rig, noise=replace(rig.noise, displacement=2e-4, force=4e3))
    found = spectra(loud, "seal-plus", "seal-minus")
    said = {finding.message.split(":")[0] for finding in found.findings if finding.code == "low-snr"}
    assert said == {"channel f_x", "channel f_y", "channel d_x", "channel d_y"}


def test_what_gives_no_spectra_is_refused() -> None:
    with pytest.raises(DataError, match="one period is left"):
        spectra(seal(), "seal-plus", settings=replace(PERIODIC, skip=7))
    runs = recordings(seal(), 1, ["seal-plus", "seal-minus"])
    without = replace(runs[1], channels=runs[1].channels[:5], samples=runs[1].samples[:, :5])
    with pytest.raises(DataError, match=r"'seal-minus' lacks the channel a_y"):
        channel_spectra([runs[0], without], PERIODIC)
    no_force = replace(runs[0], channels=tuple(replace(one, role="output") for one in runs[0].channels))
    with pytest.raises(DataError, match="has no force"):
        channel_spectra([no_force], PERIODIC)
    with pytest.raises(ConfigError, match="gives no spectra side by side"):
        channel_spectra(runs, FrfSettings("impact", block=1.0))


def test_a_shaker_that_moved_between_recordings_is_two_forces() -> None:
    """One load cell, along x in one run and along y in the other: it is zero where it is not."""
    runs = recordings(seal(), 1, ["seal-x", "seal-y"])
    moved = []
    for run, column, axis in ((runs[0], 0, "x"), (runs[1], 1, "y")):
        channels = (Channel("f", "force", "input", axis), *run.channels[2:])
        moved.append(
            Recording(
                channels,
                np.column_stack([run.samples[:, column], run.samples[:, 2:]]),
                run.sample_rate,
                run.name,
            )
        )
    found = channel_spectra(moved, PERIODIC)
    names = [channel.name for channel in found.channels]
    assert {"f@x", "f@y"} <= set(names)
    other = found.vectors[:, 0, names.index("f@y")]
    assert np.all(other == 0) and np.all(found.covariance[:, 0, names.index("f@y")] == 0)


def test_a_response_matrix_says_what_to_do_with_such_recordings() -> None:
    """Displacement and acceleration together, and lines of two forces that are interleaved."""
    plain = FrfSettings("periodic", period="1 s", skip=0, band="10-100 Hz")
    with pytest.raises(DataError, match=r"several quantities .*acceleration, displacement.*result: spectra"):
        measure(recordings(seal(), 1, ["seal-plus", "seal-minus"]), plain)
    zipper = recordings(seal(), 1, ["seal-zipper"])[0]
    kept = replace(zipper, channels=zipper.channels[:4], samples=zipper.samples[:, :4])
    with pytest.raises(
        DataError, match=r"no line is excited by all forces independently: .*interleaved.*dynamic-stiffness"
    ):
        measure([kept], plain)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"excitation": "impact", "block": 1.0, "result": "spectra"}, "periodic and random"),
        (
            {"excitation": "periodic", "period": 1.0, "result": "spectra", "directional": True},
            "'directional' belongs to a response matrix",
        ),
        (
            {"excitation": "periodic", "period": 1.0, "result": "spectra", "realisations": True},
            "'realisations' belongs",
        ),
        (
            {"excitation": "periodic", "period": 1.0, "result": "spectra", "reference": ("u",)},
            "for random excitation",
        ),
    ],
)
def test_keys_that_do_not_go_with_spectra_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        FrfSettings(**settings)  # type: ignore[arg-type]


def test_a_force_recorded_in_one_of_two_runs_keeps_its_noise(rng) -> None:
    """White noise s of a probe is 4 s^2 / (N n) in the mean of n periods of N samples; half of it was stated
    of a force that the other run does not have.
    """
    n, n_period, s = 100, 8, 0.01
    time = np.arange(n * n_period) / n
    sines = sum(np.cos(2 * np.pi * line * time + line**2) for line in range(5, 40))
    runs = []
    for axis, angle in (("x", 0.0), ("y", np.pi / 2)):
        force = Channel(f"f_{axis}", "force", "input", axis, angle)
        samples = np.column_stack([sines, 2 * sines]) + s * rng.normal(size=(time.size, 2))
        runs.append(
            Recording((force, Channel("d", "displacement", "output", "x", 0.0)), samples, float(n), axis)
        )
    found = channel_spectra(runs, FrfSettings("periodic", period=1.0, skip=0, result="spectra"))
    variance = np.einsum("lrcc->rc", found.covariance).real / found.frequency.size / (4 * s**2 / n / n_period)
    names = [channel.name for channel in found.channels]
    stated = [variance[run, names.index(name)] for run, name in ((0, "f_x"), (1, "f_y"), (0, "d"), (1, "d"))]
    np.testing.assert_allclose(stated, 1.0, rtol=0.25)


def test_a_force_recorded_in_one_of_two_random_runs_keeps_its_noise(rng) -> None:
    """White noise s of a probe, 2 s^2 / f_s in power, is 4 s^2 / (f_s T n) in the amplitude of a line of
    blocks of T over the n averages of both runs; half was stated of a force that the other run lacks.
    """
    n, rate, s = 40_000, 100.0, 0.01
    names = ("u", "v")
    drives = [Channel(name, "voltage", "reference", name) for name in names]
    runs = []
    for number, (axis, angle) in enumerate((("x", 0.0), ("y", np.pi / 2))):
        drive = rng.normal(size=n)
        noisy = [drive + s * rng.normal(size=n), 2 * drive + s * rng.normal(size=n)]
        columns = [*noisy, *(drive * (number == place) for place in range(2))]
        force = Channel(f"f_{axis}", "force", "input", axis, angle)
        response = Channel("d", "displacement", "output", "x", 0.0)
        runs.append(Recording((force, response, *drives), np.column_stack(columns), rate, axis))
    found = channel_spectra(runs, FrfSettings("random", block=1.0, result="spectra", reference=names))
    averages = found.covariance_dof + 2
    variance = np.einsum("lrcc->rc", found.covariance).real / found.frequency.size
    stated = variance * averages * rate / (4 * s**2)
    np.testing.assert_allclose(stated, 1.0, rtol=0.05)


@pytest.mark.parametrize("noise", [((0.1, 0.1), (0.5, 0.5)), ((0.1, 0.1), (0.1, 1.0))])
def test_noise_of_random_recordings_counts_in_what_their_drive_moves(rng, noise) -> None:
    """Two drives of white noise 1, one in each recording, and sensors of noise s, which one or both have more
    of in the second: the covariance of what a drive moves goes with s^2 of its own recording, 2 s^2 block /
    n_e; it had the mean of both recordings, and of all channels. n_e of 2 x 47 blocks, neighbours correlated
    by 1/6 (Hann), is 94 / (1 + 2 (46/47) / 36); of those of one recording, but for its drive, the noise is
    known.
    """
    n, sources = 24 * 256, []
    for run, s in enumerate(np.array(noise)):
        drives = rng.normal(size=(n, 2)) * np.where(np.arange(2) == run, 1.0, 1e-3)
        sensors = [Channel("f", "force", "input", "x"), Channel("x", "displacement", "output", "x")]
        references = [Channel(name, "voltage", "reference", name) for name in "vw"]
        moved = drives.sum(axis=1)[:, None] * [2.0, 3.0] + s * rng.normal(size=(n, 2))
        sources.append(Recording((*sensors, *references), np.hstack([moved, drives]), 256.0, f"run{run}"))
    settings = FrfSettings("random", block=1.0, result="spectra", reference=("v", "w"))
    spectra = channel_spectra(sources, settings)
    power = np.einsum("lrcc->lrc", spectra.covariance).real.mean(axis=0)
    averages = 94 / (1 + 2 * 46 / 47 / 36)
    assert spectra.covariance_dof == pytest.approx(averages / 2 - 1, rel=0.01)
    # One-sided densities 2 s^2 / rate, 2 / block wide, of n_e averages in all.
    np.testing.assert_allclose(power, 2 * np.array(noise) ** 2 / 256.0 * 2 / 1.0 / averages, rtol=0.15)
