"""Virtual tests of one mode with a fault in the raw file, and the first advice of labpipe's words as a change
of the files.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.signal import decimate, hilbert

RATE = 500.0
F_N, ZETA, MASS = 30.0, 0.02, 2.0
STIFFNESS = MASS * (2 * np.pi * F_N) ** 2
Signals = dict[str, np.ndarray]
# What is done to the signals of a record before they are written.
Spoiling = Callable[[Signals], Signals]


@dataclass(frozen=True)
class Outcome:
    """What was *said* by code, the parameters by name, and which codes are warnings."""

    said: dict[str, str]
    values: Mapping[str, Any]
    warned: frozenset[str] = frozenset()

    def holds(self, name: str, truth: float, wider: float) -> bool:
        parameter = self.values.get(name)
        if parameter is None or parameter.ci95 is None:
            return False
        low, high = parameter.ci95
        middle, half = (low + high) / 2, wider * (high - low) / 2
        return bool(abs(truth - middle) <= half)


@dataclass(frozen=True)
class Run:
    """A test of the mode, and its files: *frf* and *fit* go into the pipeline, *force*, *motion*, *rig* into
    the rig file. *records*: the frequency of the mode in each record, over `F_N`.
    """

    excitation: str
    frf: Mapping[str, Any] = field(default_factory=dict)
    fit: Mapping[str, Any] = field(default_factory=lambda: {"model": "sdof", "band": "24-36 Hz"})
    length: float = 100.0
    zeta: float = ZETA
    noise: float = 0.003
    level: float = 1.0
    rate: float = RATE
    highest: float = 0.4
    second: tuple[float, float] | None = None
    records: tuple[float, ...] = (1.0,)
    seed: int = 1
    spoil: Spoiling = lambda signals: signals
    force: Mapping[str, Any] = field(default_factory=dict)
    motion: Mapping[str, Any] = field(default_factory=dict)
    rig: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)

    def written(self, folder: Path) -> Path:
        """The pipeline's path, with all files in *folder*."""
        folder.mkdir(parents=True)
        if self.excitation == "frfs":
            return self._written_frf(folder)
        names = []
        for number, moved in enumerate(self.records):
            signals = self.spoil(self.signals(moved, number))
            names.append(f"record{number}.csv")
            columns = list(signals)
            np.savetxt(
                folder / names[-1],
                np.column_stack([signals[name] for name in columns]),
                delimiter=",",
                header=",".join(columns),
                comments="",
                fmt="%.7g",
            )
        channels: dict[str, Any] = {
            "f": {"quantity": "force", "unit": "N", "role": "input", "dof": "x", **self.force},
            "y": {"quantity": "displacement", "unit": "m", "role": "output", "dof": "x", **self.motion},
        }
        if self.excitation == "decay":
            del channels["f"]
        rig = {"name": "Bench", "sample_rate": f"{self.rate:g} Hz", "channels": channels, **self.rig}
        rig = {key: value for key, value in rig.items() if value is not None}
        pipeline = {
            "title": "Bench",
            "rig": "rig.yaml",
            "recordings": names,
            "frf": {"excitation": self.excitation, **self.frf},
            "identify": {"s": dict(self.fit)},
            "report": {"formats": ["md"]},
        }
        (folder / "rig.yaml").write_text(yaml.safe_dump(rig, sort_keys=False), encoding="utf-8")
        path = folder / "p.yaml"
        path.write_text(yaml.safe_dump(pipeline, sort_keys=False), encoding="utf-8")
        return path

    def _written_frf(self, folder: Path) -> Path:
        """A table of the receptance with noise, with its variance as *options* say."""
        f = np.arange(10.0, 50.0, float(self.options.get("step", 0.1)))
        window = float(self.options.get("window", 0.0))
        h = self.receptance(f - 1j * window / (2 * np.pi), 1.0)
        rng, size = np.random.default_rng(self.seed), self.noise * np.sqrt(np.mean(np.abs(h) ** 2))
        h = h + size * (rng.normal(size=f.size) + 1j * rng.normal(size=f.size)) / np.sqrt(2)
        columns = {"frequency_hz": f, "y/f:re": h.real, "y/f:im": h.imag}
        if "variance" in self.options:
            columns["y/f:var"] = np.full(f.size, size**2)
        text = "# form: receptance\n" + ",".join(columns) + "\n"
        text += "\n".join(
            ",".join(f"{value:.9g}" for value in row) for row in zip(*columns.values(), strict=True)
        )
        (folder / "h.csv").write_text(text + "\n", encoding="utf-8")
        pipeline = {
            "title": "Bench",
            "frfs": {"file": "h.csv", **self.frf} if self.frf else "h.csv",
            "identify": {"s": dict(self.fit)},
            "report": {"formats": ["md"]},
        }
        path = folder / "p.yaml"
        path.write_text(yaml.safe_dump(pipeline, sort_keys=False), encoding="utf-8")
        return path

    def receptance(self, f: np.ndarray, moved: float) -> np.ndarray:
        def mode(f_n: float, zeta: float, mass: float) -> np.ndarray:
            return np.asarray(1 / (mass * (2 * np.pi) ** 2) / (f_n**2 - f**2 + 2j * zeta * f_n * f))

        h = mode(F_N * moved, self.zeta, MASS)
        return h if self.second is None else h + mode(self.second[0], self.zeta, MASS / self.second[1])

    def signals(self, moved: float, number: int) -> Signals:
        """Force [N] and motion [m], from rest, with noise of both."""
        rng = np.random.default_rng([self.seed, number])
        n = round(self.length * self.rate)
        force = self.level * self.drive(rng, n)
        size = 2 * n
        h = self.receptance(np.fft.rfftfreq(size, 1 / self.rate), moved)
        motion = np.fft.irfft(np.fft.rfft(force, size) * h, size)[:n]
        if drift := float(self.options.get("drift", 0.0)):
            after = self.receptance(np.fft.rfftfreq(size, 1 / self.rate), moved * (1 + drift))
            later = np.fft.irfft(np.fft.rfft(force, size) * after, size)[:n]
            motion = np.where(np.arange(n) < n // 2, motion, later)
        noise = self.noise / self.level * np.std(motion) * rng.normal(size=n)
        return {"f": force + 1e-4 * np.std(force) * rng.normal(size=n), "y": motion + noise}

    def drive(self, rng: np.random.Generator, n: int) -> np.ndarray:
        t = np.arange(n) / self.rate
        if self.excitation == "random":
            spectrum = np.fft.rfft(rng.normal(size=n))
            spectrum[np.fft.rfftfreq(n, 1 / self.rate) > self.highest * self.rate] = 0
            return np.fft.irfft(spectrum, n)
        if self.excitation == "periodic":
            lines = np.arange(20, 121) / 2.0
            phases = 2 * np.pi * np.random.default_rng(self.seed).uniform(size=lines.size)
            return np.sum(np.cos(2 * np.pi * lines[:, None] * t + phases[:, None]), axis=0) / 10
        if self.excitation == "sweep":
            over, pause = (
                float(self.options.get(name, usual)) for name, usual in (("over", 20.0), ("pause", 5.0))
            )
            into = t % (over + pause)
            phase = 2 * np.pi * (10 * into + 25 * into**2 / over)
            return np.where((into < over) & (t < n / self.rate - pause), np.sin(phase), 0.0)
        # Hits of a hammer, and those that begin a decay.
        between = float(self.options.get("between", 5.0))
        force = np.zeros(n)
        for hit in np.arange(0.5, n / self.rate - 0.6 * between, between):
            width = 0.004
            force += 100 * (1 + 0.2 * rng.normal()) * np.exp(-0.5 * ((t - hit) / width) ** 2)
        return force


@dataclass(frozen=True)
class Shipped:
    """A pipeline of the repository, as it is."""

    name: str

    def written(self, folder: Path) -> Path:
        folder.mkdir(parents=True)
        return Path(__file__).parents[2] / "pipelines" / self.name


@dataclass(frozen=True)
class Fault:
    """A test with a fault, the *code* that should come (`error`: a refusal), the first *advice* in words, and
    the test with it followed, given the message.
    """

    name: str
    code: str
    spoilt: Run | Shipped
    advice: str
    cured: Callable[[Any, str], Run | Shipped]
    truth: Mapping[str, float] = field(default_factory=lambda: {"f_n": F_N, "k": STIFFNESS})


def number(pattern: str, message: str) -> float:
    """The number that a message names."""
    found = re.search(pattern, message)
    assert found, message
    return float(found[1])


def frf(**entries: Any) -> Callable[[Run, str], Run]:
    return lambda run, _: replace(run, frf={**run.frf, **entries})


def fit(**entries: Any) -> Callable[[Run, str], Run]:
    return lambda run, _: replace(run, fit={**run.fit, **entries})


def anew(**changes: Any) -> Callable[[Run, str], Run]:
    """Recorded again, otherwise."""
    return lambda run, _: replace(run, **changes)


RANDOM = Run("random", {"block": "8 s", "band": "10-60 Hz"})
PERIODIC = Run("periodic", {"period": "2 s", "skip": 1, "band": "10-60 Hz"}, length=20.0)
IMPACT = Run("impact", {"block": "4 s", "band": "10-60 Hz"}, length=60.0)
DECAY = Run("decay", {}, {"model": "decay", "modes": 1, "band": "20-40 Hz"}, length=40.0)
SWEEP = Run("sweep", {"band": "12-58 Hz"}, length=75.0)
OF_DECAY = {"f_n_1": F_N, "zeta_1": ZETA}


def as_it_is(signals: Signals) -> Signals:
    return signals


def clipped(signals: Signals) -> Signals:
    y = signals["y"]
    return {**signals, "y": np.clip(y, -1.2 * np.std(y), 1.2 * np.std(y))}


def with_gap(signals: Signals) -> Signals:
    y = signals["y"].copy()
    y[4000:4010] = np.nan
    return {**signals, "y": y}


def late(seconds: float) -> Spoiling:
    def of(signals: Signals) -> Signals:
        y = signals["y"]
        f = np.fft.rfftfreq(y.size, 1 / RATE)
        return {**signals, "y": np.fft.irfft(np.fft.rfft(y) * np.exp(-2j * np.pi * f * seconds), y.size)}

    return of


def times(**gains: float) -> Spoiling:
    return lambda signals: {name: gains.get(name, 1.0) * signal for name, signal in signals.items()}


def constant(name: str) -> Spoiling:
    return lambda signals: {**signals, name: np.zeros_like(signals[name])}


def cut_out(first: int, count: int) -> Spoiling:
    return lambda signals: {name: np.delete(s, slice(first, first + count)) for name, s in signals.items()}


def hum(amount: float, frequency: float) -> Spoiling:
    """[m]"""

    def of(signals: Signals) -> Signals:
        y = signals["y"]
        t = np.arange(y.size) / RATE
        return {**signals, "y": y + amount * np.sin(2 * np.pi * frequency * t + 1.0)}

    return of


def creeping(signals: Signals) -> Signals:
    y = signals["y"]
    return {**signals, "y": y + 30 * np.std(y) * (np.arange(y.size) / y.size) ** 2}


def struck_again(signals: Signals) -> Signals:
    y = signals["y"]
    again = np.concatenate([np.zeros(700), y[:-700]])
    return {**signals, "y": y + 0.6 * again}


def folded(signals: Signals) -> Signals:
    return {name: signal[::2] for name, signal in signals.items()}


def filtered(signals: Signals) -> Signals:
    return {name: decimate(signal, 2, ftype="fir") for name, signal in signals.items()}


def double_hits(signals: Signals) -> Signals:
    """Every second hit bounces after 40 ms."""
    bounced = {}
    for name, signal in signals.items():
        late_part = np.concatenate([np.zeros(20), signal[:-20]])
        t = np.arange(signal.size) / RATE
        bounced[name] = signal + np.where((t % 10.0) < 5.0, 0.5 * late_part, 0.0)
    return bounced


def with_times(jitter: float, missing: int = 0) -> Spoiling:
    def of(signals: Signals) -> Signals:
        n = signals["y"].size
        t = np.arange(n) / RATE + jitter / RATE * np.random.default_rng(5).uniform(-1, 1, n)
        timed = {"t": t, **signals}
        return {name: np.delete(s, slice(3000, 3000 + missing)) for name, s in timed.items()}

    return of


def renamed(**names: str) -> Spoiling:
    return lambda signals: {names.get(name, name): signal for name, signal in signals.items()}


def beside_windowed(signals: Signals) -> Signals:
    """The response and its copy under an exponential window of 1 s from each hit, one every 5 s."""
    t = np.arange(signals["y"].size) / RATE
    return {**signals, "y_window": signals["y"] * np.exp(-((t - 0.4) % 5.0))}


def falling(signals: Signals) -> Signals:
    """The decays with a damping that grows with the amplitude: sqrt of the envelope's law by their own."""
    y = signals["y"]
    size = np.abs(hilbert(y))
    return {**signals, "y": y / (1 + 1.5 * size / size.max())}


def named_block(run: Run, message: str) -> Run:
    """The length that *leakage* names."""
    seconds = number(r"at least (\d+(?:\.\d+)?) s", message)
    return replace(run, frf={**run.frf, "block": f"{seconds:g} s"}, length=max(run.length, 20 * seconds))


def named_skip(run: Run, message: str) -> Run:
    skip = int(number(r"errors: `skip: (\d+)`", message))
    return replace(run, frf={**run.frf, "skip": skip}, length=run.length + 2 * skip)


def named_delay(run: Run, message: str) -> Run:
    return replace(run, motion={"delay": f"{number(r'late by ([0-9.]+)', message):g} ms"})


RANDOM = Run("random", {"block": "8 s", "band": "10-60 Hz"})
PERIODIC = Run("periodic", {"period": "2 s", "skip": 1, "band": "10-60 Hz"}, length=20.0)
IMPACT = Run("impact", {"block": "4 s", "band": "10-60 Hz"}, length=60.0)
DECAY = Run("decay", {}, {"model": "decay", "modes": 1, "band": "20-40 Hz"}, length=40.0)
SWEEP = Run("sweep", {"band": "12-58 Hz"}, length=75.0)
TABLE = Run("frfs", {}, {"model": "sdof", "band": "24-36 Hz", "estimator": "ls"})
OF_DECAY = {"f_n_1": F_N, "zeta_1": ZETA}
SLOW = {"f_n_1": F_N, "zeta_1": 0.004}
READING = "recorded again"

FAULTS = [
    Fault(
        "random, blocks too short",
        "leakage",
        replace(RANDOM, zeta=0.003, frf={**RANDOM.frf, "block": "1 s"}, length=200.0),
        "blocks of the length it names",
        named_block,
    ),
    Fault(
        "response clipped",
        "clipped",
        replace(RANDOM, spoil=clipped),
        "a lower gain, recorded again",
        anew(spoil=as_it_is),
    ),
    Fault(
        "force of a hammer clipped",
        "error",
        replace(IMPACT, spoil=lambda s: {**s, "f": np.minimum(s["f"], 60.0)}),
        "recorded again without overload",
        anew(spoil=as_it_is),
    ),
    Fault(
        "ten samples are not numbers", "error", replace(RANDOM, spoil=with_gap), READING, anew(spoil=as_it_is)
    ),
    Fault(
        "response 2 ms late", "delay", replace(RANDOM, spoil=late(0.002)), "the `delay` it names", named_delay
    ),
    Fault(
        "mass of 3 kg stated for 2 kg",
        "mass",
        replace(RANDOM, fit={**RANDOM.fit, "mass": "3 kg"}),
        "`mass: estimate`",
        fit(mass="estimate"),
    ),
    Fault(
        "sign of the response turned",
        "unphysical",
        replace(RANDOM, spoil=times(y=-1.0)),
        "the sign of the channel (`invert`)",
        anew(motion={"invert": True}),
    ),
    Fault(
        "band of four lines",
        "few-lines",
        replace(RANDOM, fit={**RANDOM.fit, "band": "29.8-30.2 Hz"}),
        "a wider band",
        fit(band="24-36 Hz"),
    ),
    Fault(
        "band beside the mode",
        "unphysical",
        replace(RANDOM, fit={**RANDOM.fit, "band": "45-55 Hz"}),
        "the band",
        fit(band="24-36 Hz"),
    ),
    Fault(
        "weak force, random", "low-coherence", replace(RANDOM, noise=1.0), "a larger force", anew(level=50.0)
    ),
    Fault(
        "weak force, periodic", "low-snr", replace(PERIODIC, noise=2.0), "a larger force", anew(level=50.0)
    ),
    Fault(
        "a second mode near the first",
        "model-mismatch",
        replace(RANDOM, second=(37.0, 0.3)),
        "a richer model (`modal`)",
        fit(model="modal", band="24-45 Hz"),
        {"f_n_1": F_N},
    ),
    Fault(
        "averaged from the first period",
        "not-settled",
        replace(PERIODIC, zeta=0.003, length=40.0, frf={**PERIODIC.frf, "skip": 0}),
        "the `skip` it names",
        named_skip,
    ),
    Fault(
        "hits ring beyond the block",
        "not-died-away",
        replace(
            IMPACT, zeta=0.004, frf={**IMPACT.frf, "block": "1 s"}, options={"between": 10.0}, length=120.0
        ),
        "the `block` it names",
        lambda run, said: replace(run, frf={**run.frf, "block": f"{number(r'about ([0-9.]+) s', said):g} s"}),
    ),
    Fault(
        "rest position creeps",
        "rest-moves",
        replace(PERIODIC, spoil=creeping),
        "fix what creeps",
        anew(spoil=as_it_is),
    ),
    Fault("dead channel", "error", replace(RANDOM, spoil=constant("y")), "the cable", anew(spoil=as_it_is)),
    Fault(
        "samples lost in a decay",
        "lost-samples",
        replace(DECAY, zeta=0.004, length=5.0, spoil=cut_out(700, 7)),
        READING,
        anew(spoil=as_it_is),
        SLOW,
    ),
    Fault(
        "a decay struck again",
        "second-hit",
        replace(DECAY, zeta=0.004, length=5.0, spoil=struck_again),
        "strike once",
        anew(spoil=as_it_is),
        SLOW,
    ),
    Fault(
        "two close modes in a decay",
        "missing-mode",
        replace(DECAY, zeta=0.004, second=(30.9, 0.5), length=5.0),
        "`modes: 2`",
        fit(modes=2),
        {"f_n_1": F_N},
    ),
    Fault(
        "damping that grows with the amplitude",
        "amplitude-dependent",
        replace(DECAY, zeta=0.004, length=8.0, options={"between": 8.0}, spoil=falling),
        "decays of one (small) amplitude",
        frf(decay={"start": "5 s"}),
        {"f_n_1": F_N},
    ),
    Fault(
        "sweep too fast",
        "sweep-rate",
        replace(SWEEP, zeta=0.01, length=3.7, options={"over": 3.0, "pause": 0.7}),
        "a slower sweep",
        anew(options={"over": 60.0, "pause": 15.0}, length=75.0),
    ),
    Fault(
        "sweeps without a pause",
        "sweep-leakage",
        replace(SWEEP, length=60.0, zeta=0.005, options={"pause": 0.0}),
        "pauses between sweeps",
        anew(options={"pause": 8.0}, length=84.0),
    ),
    Fault(
        "no filter before sampling",
        "aliasing",
        replace(
            RANDOM,
            rate=1000.0,
            highest=0.28,
            second=(258.0, 9.0),
            spoil=folded,
            rig={"sample_rate": "500 Hz"},
        ),
        "a filter",
        anew(spoil=filtered),
        {"f_n": F_N},
    ),
    Fault(
        "FRF of a file without variance",
        "no-covariance",
        TABLE,
        "the variance of the FRF",
        anew(options={"variance": True}),
    ),
    Fault(
        "FRF of a file, coarse lines",
        "leakage",
        replace(TABLE, zeta=0.004, fit={"model": "modal", "band": "20-40 Hz"}, options={"step": 0.25}),
        "finer lines",
        anew(options={"step": 0.02}),
        {"f_n_1": F_N},
    ),
    Fault(
        "hits under an exponential window, unstated",
        "windowed",
        replace(TABLE, options={"window": 1.0}),
        "`windowed`",
        frf(windowed={"exponential": "1 s"}),
    ),
    Fault(
        "window stated, raw channel beside its windowed copy",
        "not-windowed",
        replace(IMPACT, frf={**IMPACT.frf, "windowed": {"exponential": "1 s"}}, spoil=beside_windowed),
        "without `windowed`",
        lambda run, _: replace(run, frf=IMPACT.frf),
        {"c": 2 * ZETA * MASS * 2 * np.pi * F_N},
    ),
    Fault(
        "unit in the file's header is another",
        "error",
        replace(RANDOM, spoil=lambda s: {"f": s["f"], "y [um]": 1e6 * s["y"]}, motion={"column": "y [um]"}),
        "the unit of the file",
        anew(motion={"column": "y [um]", "unit": "um"}),
    ),
    Fault(
        "column misspelt",
        "error",
        replace(RANDOM, spoil=renamed(y="disp"), motion={"column": "dips"}),
        "the name that it suggests",
        anew(motion={"column": "disp"}),
    ),
    Fault(
        "block longer than the record",
        "error",
        replace(RANDOM, length=6.0),
        "a shorter block, a longer record",
        anew(length=100.0),
    ),
    Fault(
        "period is another",
        "error",
        replace(PERIODIC, frf={**PERIODIC.frf, "period": "1.9 s"}),
        "check `period`",
        frf(period="2 s"),
    ),
    Fault(
        "hits bounce", "hit-rejected", replace(IMPACT, spoil=double_hits), "hit once", anew(spoil=as_it_is)
    ),
    Fault(
        "force of a controller",
        "feedback",
        Shipped("levitated-open.yaml"),
        "`reference`: what is injected",
        lambda *_: Shipped("levitated.yaml"),
        {"k_xx": -200e3, "c_yy": 100.0},
    ),
    Fault(
        "frequency drifts by 0.6 %",
        "drift",
        replace(RANDOM, options={"drift": 0.006}),
        "let it settle",
        anew(options={}),
    ),
    Fault(
        "one record of six is off",
        "repeat-left-out",
        replace(RANDOM, length=40.0, records=(1, 1, 1.05, 1, 1, 1)),
        "look at it; without it",
        anew(records=(1, 1, 1, 1, 1)),
    ),
    Fault(
        "two states of the structure",
        "two-populations",
        replace(RANDOM, length=40.0, records=(1, 1, 1, 1, 1.04, 1.04, 1.04)),
        "a test for each group",
        anew(records=(1, 1, 1, 1)),
    ),
    Fault(
        "records drift",
        "repeats-in-order",
        replace(RANDOM, length=40.0, records=tuple(1 + 0.004 * n for n in range(10))),
        "record what changes; in groups",
        anew(records=(1.0,) * 10),
    ),
    Fault(
        "damping lost in noise",
        "insignificant",
        replace(RANDOM, zeta=0.01, noise=1.0, fit={**RANDOM.fit, "band": "12-25 Hz"}),
        "`eliminate: true`",
        fit(eliminate=True),
        {"k": STIFFNESS},
    ),
    Fault(
        "uneven time stamps",
        "error",
        replace(RANDOM, spoil=with_times(0.2), rig={"sample_rate": None, "time": "t"}),
        "`sample_rate` instead of `time`",
        anew(rig={"sample_rate": "500 Hz"}),
    ),
    Fault(
        "samples lost, with time stamps",
        "error",
        replace(RANDOM, spoil=with_times(0.0, 40), rig={"sample_rate": None, "time": "t"}),
        READING,
        anew(spoil=with_times(0.0)),
    ),
    Fault(
        "mass in newtons", "error", replace(RANDOM, fit={**RANDOM.fit, "mass": "2 N"}), "kg", fit(mass="2 kg")
    ),
    Fault(
        "a key misspelt",
        "error",
        replace(RANDOM, fit={**RANDOM.fit, "bnad": "24-36 Hz"}),
        "the key that it suggests",
        lambda run, _: replace(run, fit=RANDOM.fit),
    ),
    Fault(
        "band above the lines",
        "error",
        replace(RANDOM, fit={**RANDOM.fit, "band": "70-80 Hz"}),
        "a band among the lines",
        fit(band="24-36 Hz"),
    ),
    Fault(
        "hum in the response, random",
        "low-coherence",
        replace(RANDOM, spoil=hum(1e-4, 33.0)),
        "a larger force",
        anew(level=100.0),
    ),
    Fault(
        "hum louder than a decay",
        "error",
        replace(DECAY, spoil=hum(2e-3, 50.0), length=20.0),
        "excite it more",
        anew(level=3000.0),
        OF_DECAY,
    ),
    Fault(
        "too few samples of a sweep",
        "error",
        replace(SWEEP, length=0.4, options={"over": 0.3, "pause": 0.05}),
        "a longer sweep",
        anew(options={}, length=75.0),
    ),
    Fault(
        "noise where hits should be",
        "error",
        replace(IMPACT, spoil=lambda s: {**s, "f": np.zeros_like(s["f"])}),
        "look at the hits",
        anew(spoil=as_it_is),
    ),
    Fault(
        "response in the wrong unit, mass known",
        "mass",
        replace(RANDOM, spoil=times(y=1.05), fit={**RANDOM.fit, "mass": "2 kg"}),
        "calibration of the response",
        anew(spoil=as_it_is),
    ),
    Fault(
        "random data taken for periods",
        "error",
        replace(RANDOM, excitation="random", frf={"period": "2 s", "band": "10-60 Hz"}),
        "`block`, which it names",
        lambda run, _: replace(run, frf=RANDOM.frf),
    ),
]
