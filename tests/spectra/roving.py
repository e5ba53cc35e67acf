"""A plate hit by a roving hammer: nine modes in closed form, one recording per point."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from labpipe.records.recording import Channel, Recording

FREQUENCIES = np.array([120.0, 205.0, 290.0, 400.0, 515.0, 640.0, 780.0, 930.0, 1110.0])
DAMPING = np.array([0.006, 0.005, 0.007, 0.004, 0.006, 0.005, 0.004, 0.005, 0.004])
RATE = 4096.0


def shapes(places: np.ndarray) -> np.ndarray:
    """Mode shapes (n_point, 9) at *places* (n_point, 2) within the unit square."""
    x, y = places.T
    return np.stack(
        [np.cos(0.9 * np.pi * a * x) * np.cos(0.8 * np.pi * b * y) for a in (1, 2, 3) for b in (1, 2, 3)],
        axis=-1,
    )


def hits(
    n_hit: int, n_sensor: int = 3, n_sample: int = 4096, seed: int = 1, noise: float = 1.0
) -> list[Recording]:
    """Accelerances H = sum of -w^2 phi_o phi_i / (w_r^2 - w^2 + 2 j zeta w_r w) / m under half sines, with
    *noise* times usual noise.
    """
    rng = np.random.default_rng(seed)
    struck, felt = shapes(rng.uniform(0, 1, (n_hit, 2))), shapes(rng.uniform(0, 1, (n_sensor, 2)))
    omega, natural = 2 * np.pi * np.fft.rfftfreq(2 * n_sample, 1 / RATE), 2 * np.pi * FREQUENCIES
    modes = (
        -(omega[:, None] ** 2)
        / (natural**2 - omega[:, None] ** 2 + 2j * DAMPING * natural * omega[:, None])
        / 2.0
    )
    recordings = []
    for hit in range(n_hit):
        force = np.zeros(n_sample)
        force[41:45] = np.sin(np.pi * np.arange(1, 5) / 5) * rng.uniform(60, 140)
        motion = (modes * struck[hit]) @ felt.T * np.fft.rfft(force, 2 * n_sample)[:, None]
        motion = np.fft.irfft(motion, axis=0)[:n_sample]
        errors = (
            noise
            * rng.normal(size=(n_sample, n_sensor + 1))
            * np.r_[0.05, np.full(n_sensor, 2e-3 * np.abs(motion).max())]
        )
        samples = np.column_stack([force, motion]) + errors
        channels = (
            Channel("f", "force", "input", f"p{hit + 1}"),
            *(Channel(f"a{n + 1}", "acceleration", "output", f"s{n + 1}") for n in range(n_sensor)),
        )
        recordings.append(Recording(channels, samples, RATE, f"h{hit:03d}"))
    return recordings


def write_pipeline(folder: Path, recordings: list[Recording], order: int = 40) -> Path:
    """The recordings as CSV, with rig file and pipeline: what a user of a roving hammer has."""
    names = [channel.name for channel in recordings[0].channels]
    rows = []
    for number, recording in enumerate(recordings):
        np.savetxt(
            folder / f"h{number}.csv",
            recording.samples,
            delimiter=",",
            fmt="%.6g",
            header=",".join(names),
            comments="",
        )
        rows.append(f"  - {{file: h{number}.csv, channels: {{f: {{dof: {recording.channels[0].dof}}}}}}}")
    sensors = [
        f"  {c.name}: {{quantity: acceleration, unit: m/s^2, role: output, dof: {c.dof}}}"
        for c in recordings[0].channels[1:]
    ]
    force = "  f: {quantity: force, unit: N, role: input, dof: p1}"
    (folder / "rig.yaml").write_text(
        "\n".join(["name: plate", f"sample_rate: {RATE:g} Hz", "channels:", force, *sensors])
    )
    block = recordings[0].samples.shape[0] / RATE
    path = folder / "roving.yaml"
    path.write_text(
        "\n".join(
            [
                "title: A plate under a roving hammer",
                "rig: rig.yaml",
                "recordings:",
                *rows,
                f"frf: {{excitation: impact, block: {block:g} s, band: 80-1250 Hz}}",
                f"identify: {{m: {{model: modal, modal: {{order: {order}}}}}}}",
                "report: {formats: [html]}",
            ]
        )
    )
    return path
