"""One levitated axis written down anew: raw files of a multisine in its loop, and pipelines that read them.

m x'' = k_n x + k_i i + d, i = D(s) A(s) u, u = e - C(s) (x + n), of continuous time throughout; every
recorded line and the noise between the lines follow from these equations exactly, d, n and what the loggers
add being random.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import parquet

SIGNALS = ("e", "before", "u", "i", "x")


@dataclass(frozen=True)
class Axis:
    """The rig in SI units; lines as multiples of 1 / period.

    Noise, rms: disturbance [N] and probe [m] in the loop; loggers of currents and commands [A], and of the
    reading [m], behind it.
    """

    mass: float = 6.5
    k_n: float = 420e3
    k_i: float = 120.0
    damping: float = 0.0
    proportional: float = 8000.0
    derivative: float = 14.0
    derivative_time: float = 1e-4
    delay: float = 120e-6
    bandwidth: float = 1500.0
    rate: float = 4000.0
    period: float = 0.5
    periods: int = 20
    rms: float = 0.2
    lines: np.ndarray = field(default_factory=lambda: np.arange(3, 450))
    disturbance: float = 2.0
    probe: float = 1e-7
    current: float = 2e-3
    reading: float = 1e-7
    random: bool = False

    def controller(self, s: np.ndarray) -> np.ndarray:
        return self.proportional + self.derivative * s / (1 + s * self.derivative_time)

    def chain(self, s: np.ndarray) -> np.ndarray:
        return np.exp(-s * self.delay) / (1 + s / (2 * np.pi * self.bandwidth))

    def plant(self, s: np.ndarray) -> np.ndarray:
        return 1 / (self.mass * s**2 + self.damping * s - self.k_n)

    def loop(self, s: np.ndarray) -> np.ndarray:
        return self.controller(s) * self.chain(s) * self.k_i * self.plant(s)

    def pole(self) -> complex:
        """The least damped pole that swings [rad/s]: Newton on 1 + L from several starts."""
        found = []
        for start in [complex(-a, b) for a in (20, 100, 300) for b in (100, 200, 300, 500, 800)]:
            s = start
            for _ in range(30):
                step = (1 + self.loop(s)) * 1e-3 / (self.loop(s + 1e-3) - self.loop(s))
                s -= step * min(1.0, 50 / abs(step))
                if abs(step) < 1e-9 * abs(s):
                    break
            if s.imag > 1 and abs(1 + self.loop(s)) < 1e-6:
                found.append(s)
        return max(found, key=lambda pole: pole.real)

    def log_decrement(self) -> float:
        pole = self.pole()
        return -2 * np.pi * pole.real / pole.imag

    def peak(self) -> float:
        s = 2j * np.pi * np.geomspace(1, 3000, 200_000)
        return float(np.max(np.abs(1 / (1 + self.loop(s)))))

    def phase_margin(self) -> float:
        """The least |arg(-L)| where |L| = 1 [rad], by bisection between samples of a fine grid."""
        omega = 2 * np.pi * np.geomspace(0.5, 3000, 400_000)
        loop = self.loop(1j * omega)
        size = np.log(np.abs(loop))
        at = np.flatnonzero(size[:-1] * size[1:] < 0)
        return float(np.min(np.abs(np.angle(-loop[at]))))

    def record(
        self, rng: np.random.Generator | None, other: np.ndarray | None = None
    ) -> dict[str, np.ndarray]:
        """Columns of a recording; rng None: without noise. other (n_sample,) [N]: a further force on the
        rotor.
        """
        count = round(self.period * self.rate)
        total = count * self.periods
        s = 2j * np.pi * np.fft.rfftfreq(total, 1 / self.rate)
        tones = np.zeros(total // 2 + 1, complex)
        phases = -np.pi * np.arange(len(self.lines)) ** 2 / len(self.lines)
        tones[np.asarray(self.lines) * self.periods] = (
            np.exp(1j * phases) * total * self.rms / np.sqrt(2 * len(self.lines))
        )
        if self.random:
            band = np.abs(s) <= 2 * np.pi * np.max(self.lines) / self.period
            drawn = np.random.default_rng(1).standard_normal((2, len(s)))
            tones = band * (drawn[0] + 1j * drawn[1]) * total * self.rms / np.sqrt(4 * np.sum(band))

        def noise(rms: float) -> np.ndarray:
            return np.zeros(len(s)) if rng is None else np.fft.rfft(rng.standard_normal(total)) * rms

        d, n = noise(self.disturbance), noise(self.probe)
        d = d if other is None else d + np.fft.rfft(other)
        closed = 1 / (1 + self.loop(s))
        plant, control = self.plant(s), self.controller(s)
        x = closed * (self.k_i * plant * self.chain(s) * (tones - control * n) + plant * d)
        before = -control * (x + n)
        u = tones + before
        spectra = {"e": tones, "before": before, "u": u, "i": self.chain(s) * u, "x": x + n}
        loggers = {"before": self.current, "u": self.current, "i": self.current, "x": self.reading}
        spectra |= {name: spectra[name] + noise(rms) for name, rms in loggers.items()}
        return {name: np.fft.irfft(spectrum, total) for name, spectrum in spectra.items()}

    def other(self, **changed: object) -> Axis:
        return replace(self, **changed)  # type: ignore[arg-type]


RIG = """name: Spindle of a test cell, one axis
sample_rate: {rate} Hz
mass: {mass} kg
channels:
  e: {{quantity: current, unit: A, role: reference, dof: e}}
  before: {{quantity: current, unit: A, role: reference, dof: b}}
  u: {{quantity: current, unit: A, role: reference, dof: u}}
  i: {{quantity: current, unit: A, role: input, dof: x}}
  x: {{quantity: displacement, unit: m, role: output, dof: x}}
"""
BEARING = """kind: magnetic-bearing
name: Spindle of a test cell, one axis
mass: {mass} kg
frequency: 50 Hz
negative_stiffness: 400 kN/m
force_per_current: 125 N/A
{more}
loop:
  proportional: {proportional}
  derivative: {derivative} s
  derivative_time: {derivative_time} s
  lag: 0
  sensor: 1 V/m
  amplifier: 1 A/V
  bandwidth: 1.6 kHz
  delay: 110 us
"""
FIT = """title: Fit of a spindle
rig: rig.yaml
recordings: {{file: axis.parquet, channels: {channels}}}
frf: {frf}
identify:
  one: {fit}
"""
CERTIFICATE = """title: Certificate of a spindle
rig: rig.yaml
recordings: {{file: axis.parquet, channels: {channels}}}
frf: {{excitation: periodic, period: {period} s, band: {band}, result: spectra}}
compare:
  certificate:
    kind: certificate
    theory: {{bearing: bearing.yaml}}
    estimate: [negative_stiffness, force_per_current, bandwidth, delay]
    certificate: {certificate}
accept:
  certificate.verdict: accepted
  certificate.probability_log_decrement: ">= 0.95"
  certificate.log_decrement_1: "> 0.1"
"""
# Roles of a certificate, and the reading by the sign of the bearing file.
ROLES = "{e: {role: input}, before: {role: output}, u: {role: output}, i: {role: output}, x: {invert: true}}"
ASKED = "{after: u, displacement: x, current: i, injection: output, log_decrement: 0.1}"


def written(
    folder: Path, axis: Axis, columns: dict[str, np.ndarray], name: str = "axis.parquet", bearing: str = ""
) -> Path:
    """Recording, rig file and bearing file in the folder; bearing: further lines of the bearing file."""
    parquet.write_table(pa.table(columns), folder / name)
    (folder / "rig.yaml").write_text(RIG.format(rate=axis.rate, mass=axis.mass))
    entries = {
        name: getattr(axis, name) for name in ("mass", "proportional", "derivative", "derivative_time")
    }
    (folder / "bearing.yaml").write_text(BEARING.format(**entries, more=bearing))
    return folder


def fit_pipeline(folder: Path, frf: str, fit: str, channels: str = "{}") -> Path:
    """The pipeline of one fit."""
    (folder / "fit.yaml").write_text(FIT.format(frf=frf, fit=fit, channels=channels))
    return folder / "fit.yaml"


def certificate_pipeline(folder: Path, axis: Axis, channels: str = ROLES, certificate: str = ASKED) -> Path:
    """The pipeline of a certificate of all lines of the axis."""
    band = f"{min(axis.lines) / axis.period - 0.1}-{max(axis.lines) / axis.period + 0.1} Hz"
    text = CERTIFICATE.format(channels=channels, period=axis.period, band=band, certificate=certificate)
    (folder / "pipeline.yaml").write_text(text)
    return folder / "pipeline.yaml"
