"""The virtual floating stator against its balance of forces, written out here, and its shipped files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.floating_bearing.virtual_rig import (
    FLOATING_RIG,
    FilmCondition,
    FloatingNoise,
    FloatingRig,
    Pad,
    Relaxation,
    truth,
)
from labpipe.project.simulate import load_virtual_rig
from labpipe.records.spectra import ChannelSpectra
from labpipe.simulate.virtual_rigs import recordings, simulated_response
from labpipe.spectra.all_channels import channel_spectra
from labpipe.spectra.settings import FrfSettings
from labpipe.uncertainty.study import source_of

CONFIGS = Path(__file__).parents[3] / "configs"
SILENT = FloatingNoise(0.0, 0.0, 0.0, 0.0)
K = np.array([[3.30e6, 11.3e6], [-10.3e6, 3.89e6]])
C = np.array([[147e3, 52.9e3], [-57.7e3, 147e3]])
M = np.array([[229.0, 16.0], [32.0, 214.0]])


def seal(**changes: object) -> FloatingRig:
    """The shipped rig without noise, runout and unbalance."""
    rig = load_virtual_rig(CONFIGS / "virtual-floating.yaml")
    assert isinstance(rig, FloatingRig)
    return replace(rig, noise=SILENT, runout=(), unbalance=0.0, **changes)  # type: ignore[arg-type]


def spectra(rig: FloatingRig, run: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Frequencies [Hz] and amplitudes (n_line, 2) of f, d, a, u in the rig's band, by a plain DFT of the
    whole recording.
    """
    (recording,) = recordings(rig, 1, [run])
    frequency = np.fft.rfftfreq(recording.n_sample, 1 / recording.sample_rate)
    band = (frequency > rig.band[0] - 1e-6) & (frequency < rig.band[1] + 1e-6)
    amplitude = np.fft.rfft(recording.samples, axis=0)[band] * 2 / recording.n_sample
    names = [channel.name for channel in recording.channels]
    pairs = {
        letter: [names.index(f"{letter}_{axis}") for axis in "xy"]
        for letter in "fdau"
        if f"{letter}_x" in names
    }
    return frequency[band], {letter: amplitude[:, columns] for letter, columns in pairs.items()}


@pytest.mark.parametrize("run", ["seal-x", "seal-y", "seal-plus", "seal-minus", "seal-zipper", "seal-random"])
def test_the_stator_is_in_balance_whatever_the_shaft_does(run: str) -> None:
    """F - m_s A - (K_b + j w C_b) X_s = (K + j w C - w^2 M) D with the printed matrices.

    A random force disturbs the shaft.
    """
    frequency, of = spectra(seal(shaft_noise=50.0), run)
    jw = 2j * np.pi * frequency[:, None]
    left = of["f"] - 60.0 * of["a"] - (4e6 + jw * 2e3) * of["a"] / jw**2
    h = K + jw[:, :, None] * C + jw[:, :, None] ** 2 * M
    np.testing.assert_allclose(left, np.einsum("fij,fj->fi", h, of["d"]), atol=1e-9 * np.max(np.abs(of["f"])))


def test_the_shaft_moves_on_its_own_supports() -> None:
    """Its balance, H D = (K_r + j w C_r - w^2 m_r) X_r, with X_r = X_s - D."""
    frequency, of = spectra(seal(), "seal-plus")
    lines = np.abs(of["f"][:, 0]) > 1
    jw = 2j * np.pi * frequency[lines, None]
    d, stator = of["d"][lines], of["a"][lines] / jw**2
    h = K + jw[:, :, None] * C + jw[:, :, None] ** 2 * M
    right = (240e6 + jw * 20e3 + jw**2 * 40) * (stator - d)
    np.testing.assert_allclose(np.einsum("fij,fj->fi", h, d), right, atol=1e-8 * np.max(np.abs(right)))


def test_relaxation_and_pad_are_added_in_both_directions() -> None:
    """G jwt/(1 + jwt) and (R_0 + jw R_1)/(1 + 2 z jw/w_0 - w^2/w_0^2), at every line."""
    condition = FilmCondition(
        stiffness=[[2e7, 0], [0, 2e7]],
        relaxation=Relaxation(1e7, 2e-3),
        pad=Pad("10 MN/m", "5 kN.s/m", "60 Hz", "50 %"),
    )
    rig = replace(seal(), conditions=(("pads", condition),))
    frequency, of = spectra(rig, "pads-x")
    lines = np.abs(of["f"][:, 0]) > 1
    jw = 2j * np.pi * frequency[lines]
    ratio = jw / (2 * np.pi * 60)
    h = 2e7 + 1e7 * jw * 2e-3 / (1 + jw * 2e-3) + (1e7 + 5e3 * jw) / (1 + ratio + ratio**2)
    a, d = of["a"][lines, 0], of["d"][lines, 0]
    np.testing.assert_allclose(of["f"][lines, 0] - 60 * a - (4e6 + jw * 2e3) * a / jw**2, h * d, rtol=1e-7)


def test_each_way_of_excitation_drives_its_lines() -> None:
    rig = seal(drives=True)
    forces = {end: spectra(rig, f"seal-{end}")[1] for end in ("x", "plus", "minus", "zipper", "random")}
    silent = 1e-9 * 2000
    assert np.max(np.abs(forces["x"]["f"][:, 1])) < silent
    np.testing.assert_allclose(forces["plus"]["f"][:, 0], forces["plus"]["f"][:, 1], atol=silent)
    np.testing.assert_allclose(forces["minus"]["f"][:, 0], -forces["minus"]["f"][:, 1], atol=silent)
    acting = np.abs(forces["zipper"]["f"]) > silent
    assert not np.any(np.all(acting, axis=1)) and list(acting.sum(axis=0)) == [46, 45]
    assert np.all(np.abs(forces["random"]["f"]) > 0)
    for of in forces.values():
        np.testing.assert_allclose(of["u"] * 1000, of["f"], atol=silent)
        np.testing.assert_allclose(np.sqrt(np.sum(np.abs(of["f"]) ** 2, axis=0) / 2)[0], 2000, rtol=1e-9)


def test_the_amplitude_of_the_lines_follows_the_slope() -> None:
    frequency, of = spectra(seal(slope=-1.0), "seal-x")
    lines = np.abs(of["f"][:, 0]) > 1
    product = np.abs(of["f"][lines, 0]) * frequency[lines]
    np.testing.assert_allclose(product, product[0], rtol=1e-9)


def test_runout_turns_with_the_shaft_and_its_tacho() -> None:
    """Dry and without force, with 32 Hz on a line: 1x of 5 um, 2x of 2 um in both probes, y a quarter turn
    behind; a pulse per turn.
    """
    turning = replace(
        seal(), conditions=(("dry", FilmCondition(speed="32 Hz")),), runout=(5e-6, 2e-6), force=1e-9
    )
    (recording,) = recordings(turning, 1, ["dry-x"])
    amplitude = np.fft.rfft(recording.samples, axis=0) * 2 / recording.n_sample
    at = {order: amplitude[order * 32 * 8] for order in (1, 2, 3)}
    np.testing.assert_allclose(np.abs(at[1][2:4]), 5e-6, rtol=1e-6)
    np.testing.assert_allclose(np.abs(at[2][2:4]), 2e-6, rtol=1e-6)
    np.testing.assert_allclose(at[1][3] / at[1][2], np.exp(-0.5j * np.pi), atol=1e-6)
    assert np.all(np.abs(at[3][2:4]) < 1e-12) and np.all(np.abs(at[1][4:6]) < 1e-9)
    pulses = np.diff(recording.samples[:, -1]) > 2.5
    assert recording.channels[-1].quantity == "tacho" and abs(pulses.sum() - 32 * 8) <= 1


def test_an_unbalance_moves_stator_and_shaft_together() -> None:
    """At a speed that is a line: without force the stator is in balance at 1x too, and the shaft feels m e
    W^2 turning from x to y.
    """
    turning = replace(
        seal(),
        conditions=(("seal", replace(seal().conditions[0][1], speed=32.0)),),
        unbalance=1e-3,
        force=1e-9,
    )
    frequency, of = spectra(turning, "seal-x")
    line = int(np.argmin(np.abs(frequency - 32)))
    w = 2 * np.pi * 32
    a, d = of["a"][line], of["d"][line]
    h = K + 1j * w * C - w**2 * M
    balance = -60 * a - (4e6 + 1j * w * 2e3) * a / -(w**2)
    np.testing.assert_allclose(balance, h @ d, rtol=1e-6)
    force = (240e6 + 1j * w * 20e3 - w**2 * 40) * (a / -(w**2) - d) - h @ d
    np.testing.assert_allclose(np.abs(force), 1e-3 * w**2, rtol=1e-6)
    np.testing.assert_allclose(force[1] / force[0], -1j, atol=1e-6)


def test_a_late_probe_is_late() -> None:
    _, straight = spectra(seal(), "seal-x")
    frequency, late = spectra(seal(probe_delay=1e-4), "seal-x")
    lines = np.abs(straight["f"][:, 0]) > 1
    expected = straight["d"][lines] * np.exp(-2j * np.pi * frequency[lines, None] * 1e-4)
    np.testing.assert_allclose(late["d"][lines], expected, rtol=1e-9)


def test_noise_is_that_of_the_settings_on_every_channel() -> None:
    """Two seeds with silent shakers differ by noise alone.

    8000 samples give a standard deviation within 3 %.
    """
    rig = replace(
        seal(drives=True), conditions=(("dry", FilmCondition()),), noise=FloatingNoise(3.0, 2e-7, 0.04, 1e-3)
    )
    first, second = (recordings(rig, seed, ["dry-x"])[0].samples for seed in (1, 2))
    spread = np.std(first - second, axis=0) / np.sqrt(2)
    np.testing.assert_allclose(spread, [3.0, 3.0, 2e-7, 2e-7, 0.04, 0.04, 1e-3, 1e-3, 0.0], rtol=0.03)


def test_the_journal_bearing_is_the_one_of_a_bearing_file(labpipe, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """Load downwards, turning from x to y: its kyz is k_xy here."""
    rig = load_virtual_rig(CONFIGS / "virtual-floating-bearings.yaml")
    assert isinstance(rig, FloatingRig)
    k = truth(replace(rig, conditions=rig.conditions[:1]))["conditions"]["2kN"]
    (tmp_path / "b.yaml").write_text(
        "kind: journal-bearing\ndiameter: 100 mm\nlength: 50 mm\nclearance: 100 um\nviscosity: 0.03 "
        "Pa.s\nspeed: 3010 rpm\nload: 2 kN\n"
    )
    run = labpipe("bearing", tmp_path / "b.yaml", "--json", tmp_path / "b.json")
    assert run.code == 0
    result = json.loads((tmp_path / "b.json").read_text())
    np.testing.assert_allclose(
        [[k["k_xx"], k["k_xy"]], [k["k_yx"], k["k_yy"]]], result["stiffness"], rtol=1e-9
    )
    np.testing.assert_allclose([[k["c_xx"], k["c_xy"]], [k["c_yx"], k["c_yy"]]], result["damping"], rtol=1e-9)
    assert k["k_xy"] > 0 > k["k_yx"]


def test_the_truth_names_the_printed_coefficients() -> None:
    entries = FLOATING_RIG.parameters(seal(), ("seal-plus", "seal-minus"))
    assert (entries["k_xy"], entries["c_yx"], entries["m_yy"]) == (11.3e6, -57.7e3, 214.0)
    with pytest.raises(ConfigError, match="one condition"):
        FLOATING_RIG.parameters(seal(), ("seal-plus", "dry-plus"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"baseline_stiffness": ((1.0,),)}, "2 x 2"),
        ({"stator_mass": 0.0}, "stator_mass must be positive"),
        ({"conditions": ()}, "are missing"),
        ({"band": (10.0, 600.0)}, "half the sampling rate"),
        ({"spacing": 0.7}, "no whole number"),
        ({"conditions": (("a", {"speed": 600.0}),)}, "at 600 Hz, beyond half"),
        ({"conditions": (("a", {"film": "journal", "speed": 10.0, "load": 10.0}),)}, "no `journal`"),
    ],
)
def test_impossible_rigs_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        seal(**change)


def test_a_random_force_needs_a_line_in_its_band() -> None:
    rig = replace(seal(), band=(10.02, 10.05))
    with pytest.raises(ConfigError, match="no line of a whole recording"):
        recordings(rig, 1, ["seal-random"])


def test_impossible_conditions_are_refused() -> None:
    for settings, message in (
        ({"film": "journal"}, "needs a speed and a load"),
        ({"speed": -1.0}, "must not be negative"),
        ({"mass": ((1.0, 0.0),)}, "2 x 2"),
        ({"relaxation": {"stiffness": 1.0, "time": 0.0}}, "time must be positive"),
        (
            {"pad": {"stiffness": 1.0, "damping": 0.0, "frequency": 0.0, "damping_ratio": 0.5}},
            "frequency must be positive",
        ),
        (
            {"pad": {"stiffness": 1.0, "damping": 0.0, "frequency": 9.0, "damping_ratio": -0.5}},
            "damping_ratio must be positive",
        ),
        (
            {"film": "journal", "speed": 9.0, "load": 9.0, "damping": ((1.0, 0.0), (0.0, 1.0))},
            "'damping' is that of the rig's journal bearing",
        ),
    ):
        with pytest.raises(ConfigError, match=message):
            FilmCondition(**settings)


def test_a_study_may_repeat_spectra_of_all_channels() -> None:
    """The same draws as the recordings of that seed, as the settings measure them."""
    settings = FrfSettings("periodic", period="1 s", skip=0, band="10-100 Hz", result="spectra")
    rig = replace(seal(), noise=FloatingNoise())
    measured = simulated_response(rig, (3,), ["seal-plus", "seal-minus"], settings)
    assert isinstance(measured, ChannelSpectra) and measured.runs == ("seal-plus", "seal-minus")
    direct = channel_spectra(recordings(rig, 3, ["seal-plus", "seal-minus"]), settings)
    np.testing.assert_array_equal(measured.vectors, direct.vectors)
    source = source_of(rig, 1.0, None, ("seal-plus", "seal-minus"), settings)
    assert source.n_line == 91 and source.truth["m_xx"] == 229.0


def test_the_shipped_recordings_are_made_by_their_recipe(root: Path, tmp_path: Path, labpipe) -> None:  # type: ignore[no-untyped-def]
    assert (
        labpipe("simulate", "configs/virtual-floating-matrix.yaml", "-o", tmp_path, "--seed", "1").code == 0
    )
    shipped = root / "sample_data/floating"
    assert sum(path.stat().st_size for path in shipped.iterdir()) < 600_000
    made, kept = (json.loads((folder / "truth.json").read_text())["truth"] for folder in (tmp_path, shipped))
    assert list(made["conditions"]) == list(kept["conditions"])
    for name, values in kept["conditions"].items():
        assert made["conditions"][name] == pytest.approx(values, rel=1e-9, abs=1e-9)
        one, other = (
            pq.read_table(folder / f"{name}-zipper.parquet").to_pandas().to_numpy()
            for folder in (tmp_path, shipped)
        )
        # A rounding of the last bit may move a value by one step of the logger.
        assert np.max(np.abs(one - other)) <= 1
