"""Sound runs and runs with a fault, by seed: what test_warning_rates counts the findings of.

Each run gives its codes as a set.
"""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
from scipy import signal

from labpipe.estimation.fitting import identify
from labpipe.estimation.levels import with_level_findings
from labpipe.estimation.settings import FitSettings
from labpipe.methods.magnetic_bearing.virtual_mechanics import VirtualMagneticRig
from labpipe.methods.magnetic_bearing.virtual_rig import MAGNETIC_RIG
from labpipe.methods.run_ups.joint import fit_jointly
from labpipe.raw_files.screening import ChannelScreen
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse, Port, diagonal_covariance
from labpipe.spectra.measurement import measure
from labpipe.spectra.quality import reciprocity_findings
from labpipe.spectra.settings import FrfSettings, ImpactSettings
from tests.estimation.test_residual_structure import response as response_of_one_mode
from tests.methods.run_ups.four_dof_rig import MASS, FourDofRig, recordings
from tests.methods.run_ups.run_up_cases import RIG, trained
from tests.methods.wear.test_wear_identification import MANY, OWN, fitted, measured
from tests.spectra.test_impact_coverage import hammered

RANDOM = FrfSettings(excitation="random", block=4.0, band=(5.0, 50.0))
PERIODIC = FrfSettings(excitation="periodic", period=2.0, skip=3, band=(1.0, 100.0))
FOUR = FitSettings("mdof", mass=tuple(MASS))
PEDESTAL = FitSettings("sdof", mass=0.79, band=(60.0, 70.0))


def codes(response: FrequencyResponse, settings: FitSettings) -> frozenset[str]:
    """All codes of a response and of its fits."""
    return frozenset(
        finding.code for carrier in (response, *identify(response, settings)) for finding in carrier.findings
    )


@functools.cache
def four_dofs(seed: int, settings: FitSettings = FOUR, **rig: object) -> frozenset[str]:
    """Welch data of the rig with four dofs, 100 s."""
    (record,) = recordings(FourDofRig(**{"length": 100.0, "noise": 1e-4, **rig}), range(seed, seed + 1))
    return codes(measure([record], RANDOM), settings)


def pedestal(
    seed: int, settings: FitSettings = PEDESTAL, level: float = 1.0, sign: float = 1.0, swap: bool = False
) -> frozenset[str]:
    """Five periods of a multisine on one mass, the noise of its sensor *level* times the usual, its response
    times *sign*; *swap*: each channel has the samples of the other.
    """
    rig = VirtualMagneticRig("virtual-magnetic-rig")
    rig = replace(rig, noise=replace(rig.noise, displacement=level * rig.noise.displacement))
    (record,) = MAGNETIC_RIG.recordings(rig, seed, ("pedestal",))
    used = [number for number, channel in enumerate(record.channels) if channel.role in ("input", "output")]
    samples = record.samples.copy()
    samples[:, used] = samples[:, used[::-1] if swap else used]
    response = measure([replace(record, samples=samples)], PERIODIC)
    return codes(replace(response, matrix=sign * response.matrix), settings)


def from_rest(seed: int, waited: int) -> frozenset[str]:
    """Twenty periods of 2 s on 2 kg and 40 kN/m, damping ratio .3 %, *waited* periods after the force began.

    Exact free motion.
    """
    rng = np.random.default_rng(seed)
    t, lines = np.arange(20 * 500) / 250, np.arange(30, 61)
    w, forces = np.pi * lines, 0.2 * np.exp(2j * np.pi * rng.uniform(size=lines.size))
    decay, damped = 0.003 * np.sqrt(2e4), np.sqrt(2e4 * (1 - 0.003**2))
    moved = forces / (2 * (2e4 + 2j * decay * w - w**2))
    applied, steady = (
        np.sum((a[:, None] * np.exp(1j * w[:, None] * t)).real, axis=0) for a in (forces, moved)
    )
    begin, speed = moved.sum().real, (1j * w * moved).sum().real
    free = np.exp(-decay * (t + 2 * waited)) * (
        begin * np.cos(damped * t) + (speed + decay * begin) / damped * np.sin(damped * t)
    )
    channels = (Channel("f", "force", "input", "x"), Channel("x", "displacement", "output", "x"))
    noise = rng.normal(size=(t.size, 2)) * (5e-3, 2e-7)
    record = Recording(channels, np.stack([applied, steady - free], axis=1) + noise, 250.0)
    settings = FrfSettings(excitation="periodic", period=2.0, skip=1, band=(14.9, 30.1))
    return codes(measure([record], settings), FitSettings("sdof", mass=2.0))


def two_directions(seed: int, settings: FitSettings, inputs: int = 2) -> frozenset[str]:
    """A symmetric rotor (0.92 kg, 180 kN/m, 190 N s/m) under forces along x and y, or one at 45 degrees,
    65-80 Hz, noise 0.4 %.
    """
    f = np.arange(65.0, 81.0)
    w = 2 * np.pi * f
    h = (1 / (180e3 + 190j * w - 0.92 * w**2))[:, None, None] * (
        np.eye(2) if inputs == 2 else np.full((2, 1), np.cos(np.pi / 4))
    )
    noise = np.random.default_rng(seed).normal(size=(2, *h.shape)) * 3e-8 / np.sqrt(2)
    outputs = (Port("x", "x", "x", 0.0), Port("y", "y", "y", np.pi / 2))
    forces = (
        (Port("fx", "fx", "x", 0.0), Port("fy", "fy", "y", np.pi / 2))
        if inputs == 2
        else (Port("f", "f", "45 deg", np.pi / 4),)
    )
    return codes(
        FrequencyResponse(
            f,
            h + noise[0] + 1j * noise[1],
            outputs,
            forces,
            covariance=diagonal_covariance(np.full(h.shape, 9e-16)),
        ),
        settings,
    )


def unknown_noise(seed: int, known: bool) -> frozenset[str]:
    """A resonance of 1 kg at 40 Hz, with its variance or without it."""
    f = np.arange(380, 421) / 10
    w = 2 * np.pi * f
    h = (1 / (63.17e3 - w**2 + 5.03j * w))[:, None, None]
    noise = np.random.default_rng(seed).normal(size=(2, *h.shape)) * 1e-6
    response = FrequencyResponse(
        f, h + noise[0] + 1j * noise[1], (Port("x", "x", "x"),), (Port("f", "f", "x"),)
    )
    return codes(
        replace(response, covariance=diagonal_covariance(np.full(h.shape, 2e-12))) if known else response,
        FitSettings("sdof", mass=1.0),
    )


def short_blocks(seed: int, block: float) -> frozenset[str]:
    """The pedestal's mode (65.7 Hz, damping ratio .6 %: .75 Hz wide) under 200 s of white force, H1 of Hann
    blocks.
    """
    rng = np.random.default_rng(seed)
    rate, n = 512.0, 102_400
    k, c, m = 134.5e3, 3.7, 0.79
    f = np.fft.rfftfreq(n, 1 / rate)
    force = rng.normal(size=n)
    # The record is periodic in itself, so that its response is exact; blocks of it see no period.
    motion = np.fft.irfft(np.fft.rfft(force) / (k - m * (2 * np.pi * f) ** 2 + 2j * np.pi * f * c), n)
    samples = np.stack([force, motion + 0.01 * np.std(motion) * rng.normal(size=n)], axis=-1)
    channels = (Channel("f", "force", "input", "y"), Channel("y", "displacement", "output", "y"))
    settings = FrfSettings(excitation="random", block=block, band=(50.0, 80.0))
    return codes(
        measure([Recording(channels, samples, rate, "blocks")], settings),
        replace(PEDESTAL, band=(55.0, 75.0)),
    )


def residual_of_unknown_noise(seed: int, fault: str) -> frozenset[str]:
    return codes(response_of_one_mode(fault, seed), FitSettings("sdof"))


def screened(seed: int, fault: str, *, white: bool = False) -> frozenset[str]:
    """A random signal of a 16-bit logger, white or in a band of a tenth of half the sampling rate, with one
    fault of its samples.
    """
    values = np.random.default_rng(seed).normal(size=20_000)
    if not white:
        values = np.convolve(values, np.hanning(20) / np.sqrt(7.1), mode="same")
    if fault == "clipped":
        values = np.clip(values, -2.0, 2.0)
    values = np.round(values * 8192) / 8192
    if fault == "gap":
        values[700:703] = np.nan
    if fault == "constant":
        values[:] = values[0]
    screen = ChannelScreen(["y"])
    screen.add(values[:, None])
    return frozenset(finding.code for finding in screen.findings())


def levels(seed: int, stiffer: float) -> frozenset[str]:
    """The pedestal at 5 and 10 N, its stiffness at the higher level by the share *stiffer* larger."""
    fits = []
    for number, (test, share) in enumerate((("quiet", 0.0), ("loud", stiffer))):
        rig = VirtualMagneticRig("virtual-magnetic-rig")
        rig = replace(rig, pedestal_stiffness=(1 + share) * rig.pedestal_stiffness)
        response = measure(MAGNETIC_RIG.recordings(rig, 1000 * number + seed, ("pedestal",)), PERIODIC)
        fits += [replace(fit, test=test) for fit in identify(response, PEDESTAL)]
    found = with_level_findings(fits, {"quiet": {"level": "5 N"}, "loud": {"level": "10 N"}})
    return frozenset(finding.code for fit in found for finding in fit.findings)


def sampled(seed: int, filtered: bool) -> frozenset[str]:
    """Modes at 66 and 262 Hz of equal velocity under a force up to 280 Hz, sampled at 512 Hz, with an
    anti-alias filter or not.
    """
    rng = np.random.default_rng(seed)
    rate, fine, n = 512.0, 4, 40_960
    f = np.fft.rfftfreq(n * fine, 1 / (rate * fine))
    force = np.where(f < 280.0, np.fft.rfft(rng.normal(size=n * fine)), 0.0)
    h = sum(1 / (1 - (f / f_n) ** 2 + 0.02j * f / f_n) / f_n for f_n in (66.0, 262.0))
    motion = np.fft.irfft(h * force, n * fine)
    pair = np.column_stack(
        [np.fft.irfft(force, n * fine), motion + 1e-3 * np.std(motion) * rng.normal(size=motion.size)]
    )
    samples = signal.decimate(pair, fine, axis=0) if filtered else pair[::fine]
    channels = (Channel("f", "force", "input", "y"), Channel("y", "displacement", "output", "y"))
    return frozenset(
        finding.code
        for finding in measure(
            [Recording(channels, samples, rate, "s")], replace(RANDOM, band=(40.0, 90.0))
        ).findings
    )


def taps(seed: int, block: float, bounce: bool = False) -> frozenset[str]:
    """Ten hits on an oscillator of 60 Hz and .6 %, which falls to 5 % in 1.3 s; *bounce*: in the last five a
    second hit after 20 ms.
    """
    rng = np.random.default_rng(seed)
    record = hammered(rng, 0.006, block, 10)
    if bounce:
        second = np.zeros_like(record.samples)
        half = second.shape[0] // 2
        second[half + 20 :, 0] = 0.4 * record.samples[half:-20, 0]
        record = replace(record, samples=record.samples + second)
    response = measure(
        [record], FrfSettings(excitation="impact", block=block, band=(30.0, 100.0), impact=ImpactSettings())
    )
    return frozenset(finding.code for finding in response.findings)


def reciprocal(seed: int, skew: float) -> frozenset[str]:
    """Two dofs, H_12 and H_21 apart by the share *skew*, noise .4 %: the note's code where it says more than
    noise.
    """
    f = np.arange(65.0, 81.0)
    w = 2 * np.pi * f
    cross = 20e3 * np.array([[0.0, 1 + skew], [1 - skew, 0.0]])
    k = 180e3 * np.eye(2) + cross
    h = np.linalg.inv(k + (190j * w - 0.92 * w**2)[:, None, None] * np.eye(2))
    noise = np.random.default_rng(seed).normal(size=(2, *h.shape)) * 3e-8 / np.sqrt(2)
    ports = [tuple(Port(f"{kind}{dof}", f"{kind}{dof}", dof) for dof in "xy") for kind in "xf"]
    response = FrequencyResponse(
        f, h + noise[0] + 1j * noise[1], *ports, covariance=diagonal_covariance(np.full(h.shape, 9e-16))
    )
    return frozenset(
        "reciprocity" for finding in reciprocity_findings(response) if "beyond the noise" in finding.message
    )


def cross_coupled(seed: int, skew: float) -> frozenset[str]:
    """A rotor with cross-coupled stiffness of +-skew [N/m], fitted without cross terms and compared with
    other models.
    """
    f = np.arange(65.0, 81.0)
    w = 2 * np.pi * f
    k = np.array([[180e3, skew], [-skew, 180e3]])
    h = np.linalg.inv(k + (190j * w - 0.92 * w**2)[:, None, None] * np.eye(2))
    noise = np.random.default_rng(seed).normal(size=(2, *h.shape)) * 3e-8 / np.sqrt(2)
    outputs = (Port("x", "x", "x", 0.0), Port("y", "y", "y", np.pi / 2))
    forces = (Port("fx", "fx", "x", 0.0), Port("fy", "fy", "y", np.pi / 2))
    response = FrequencyResponse(
        f,
        h + noise[0] + 1j * noise[1],
        outputs,
        forces,
        covariance=diagonal_covariance(np.full(h.shape, 9e-16)),
    )
    return codes(response, FitSettings("rotor-2dof-direct", mass=0.92, compare=True))


@functools.cache
def worn(seed: int, depth: float, depth_limit: float = 50e-6) -> frozenset[str]:
    """The Mendes rotor with a wear of *depth* [um] at 11 deg, 2 % noise on 90 lines, viscosity and clearance
    known.
    """
    response = measured(MANY, (depth, 11.0), OWN, np.random.default_rng(seed))
    starts = {
        "start_depths": (10e-6, 25e-6),
        "start_angles": (-0.15, 0.15),
        "cells_around": 60,
        "cells_across": 12,
    }
    return frozenset(finding.code for finding in fitted(response, depth_limit=depth_limit, **starts).findings)


def run_up_family(seed: int, truth: str) -> frozenset[str]:
    """Four run-ups on films inside the fitted family or with arbitrary factors."""
    return frozenset({"model-mismatch"} if fit_jointly(RIG, trained(truth, seed)).rejected else ())


def without_minimum(seed: int, noise: float) -> frozenset[str]:
    """One mode with its mass free by instrumental variables; *noise* as a share of the largest response."""
    f = np.arange(40.0, 61.0)
    w = 2 * np.pi * f
    h = (1 / (180e3 + 190j * w - 0.92 * w**2))[:, None, None]
    std = noise * np.abs(h).max()
    drawn = np.random.default_rng(seed).normal(size=(2, *h.shape)) * std / np.sqrt(2)
    covariance = diagonal_covariance(np.full(h.shape, std**2))
    response = FrequencyResponse(
        f, h + drawn[0] + 1j * drawn[1], (Port("x", "x", "x"),), (Port("f", "f", "x"),), covariance=covariance
    )
    return codes(response, FitSettings("sdof", mass="estimate", estimator="iv"))
