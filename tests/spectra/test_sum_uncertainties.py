"""Uncertainties of sums of channels in an FRF, compared with FRFs of recordings whose sums were made with the
number off by a little.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labpipe.artefacts.header import Header
from labpipe.artefacts.measured_files import read_response, write_response
from labpipe.records.recording import Channel, Number, Recording, SumTerm
from labpipe.records.response import FrequencyResponse
from labpipe.records.uncertain import ChannelUncertainty, Uncertainty
from labpipe.spectra.convert import convert, directional
from labpipe.spectra.measurement import measure
from labpipe.spectra.ports import join
from labpipe.spectra.settings import FrfSettings

MASS = Number("m_s", 3.0, 0.02, "kg")
GAIN = ChannelUncertainty("gain", Uncertainty("calibrator 7", 0.01, "1"))
DELAY = ChannelUncertainty("delay", Uncertainty("a.delay", 2e-5, "s"))
SETTINGS = {
    "random": FrfSettings("random", block="1 s", band="10-150 Hz"),
    "periodic": FrfSettings("periodic", period="0.5 s", skip=0, band="10-150 Hz"),
}
RATE, N = 1000.0, 8000


def recordings(excitation: str, mass: float = 3.0, gain: float = 1.0) -> list[Recording]:
    """One run with both forces; of periodic ones two, the second force reversed in one of them."""
    runs = [recording(excitation, mass, gain)]
    return [*runs, recording(excitation, mass, gain, reverse=True)] if excitation == "periodic" else runs


def recording(excitation: str, mass: float = 3.0, gain: float = 1.0, *, reverse: bool = False) -> Recording:
    """Two forces less a mass times acceleration, and the difference of two motions; *gain*: of the
    accelerometers and of x1.
    """
    rng = np.random.default_rng(11)
    if excitation == "periodic":
        forces = np.tile(rng.normal(size=(500, 2)), (16, 1))
        forces[:, 1] *= -1 if reverse else 1
    else:
        forces = rng.normal(size=(N, 2))
    lines = np.fft.rfftfreq(N, 1 / RATE)
    omega = 2 * np.pi * lines
    spectra = np.fft.rfft(forces, axis=0)

    def answer(of_first: complex, of_second: complex, f_n: float) -> np.ndarray:
        transfer = 1 / ((2 * np.pi * f_n) ** 2 - omega**2 + 2j * 0.2 * 2 * np.pi * f_n * omega)
        return np.asarray(np.fft.irfft(transfer * (of_first * spectra[:, 0] + of_second * spectra[:, 1]), N))

    x1, x2, y = answer(1, 0.3, 40), answer(0.2, -0.1, 90), answer(0.4, 1.2, 60)
    ax, ay = answer(0.5, 0.1, 55) * 1e4, answer(0.2, 0.8, 70) * 1e4
    ax, ay, x1 = gain * ax, gain * ay, gain * x1
    columns = [
        forces[:, 0],
        forces[:, 1],
        ax,
        ay,
        x1,
        x2,
        x1 - x2,
        y,
        forces[:, 0] - mass * ax,
        forces[:, 1] - mass * ay,
    ]
    uncertainties = (GAIN, DELAY)
    channels = (
        Channel("fx", "force", "reference", "x"),
        Channel("fy", "force", "reference", "y"),
        Channel("ax", "acceleration", "reference", "x", uncertainties=uncertainties),
        Channel("ay", "acceleration", "reference", "y", uncertainties=uncertainties),
        Channel("x1", "displacement", "reference", "x", uncertainties=(GAIN,)),
        Channel("x2", "displacement", "reference", "x"),
        Channel("d", "displacement", "output", "x", 0.0, terms=(SumTerm("x1", 1.0), SumTerm("x2", -1.0))),
        Channel("y", "displacement", "output", "y", np.pi / 2),
        Channel(
            "ex",
            "force",
            "input",
            "x",
            0.0,
            terms=(SumTerm("fx", 1.0), SumTerm("ax", -mass, (MASS,), (-1.0,))),
        ),
        Channel(
            "ey",
            "force",
            "input",
            "y",
            np.pi / 2,
            terms=(SumTerm("fy", 1.0), SumTerm("ay", -mass, (MASS,), (-1.0,))),
        ),
    )
    return Recording(channels, np.column_stack(columns), RATE, f"run{int(reverse)}")


def change_of(response: FrequencyResponse, source: str) -> np.ndarray:
    return next(error.change for error in response.errors if error.uncertainty.source == source)


@pytest.mark.parametrize("excitation", ["random", "periodic"])
def test_the_change_by_a_mass_and_by_a_common_calibrator_is_that_of_changed_recordings(
    excitation: str,
) -> None:
    """Central differences of FRFs measured anew.

    Without noise the FRF is exact up to leakage, which the differences share.
    """
    settings = SETTINGS[excitation]
    response = measure(recordings(excitation), settings)
    assert [finding.code for finding in response.findings if finding.code == "number-uncertainty"] == []
    by_mass, by_gain = (
        (
            measure(recordings(excitation, **plus), settings).matrix
            - measure(recordings(excitation, **minus), settings).matrix
        )
        / 2
        for plus, minus in (({"mass": 3.02}, {"mass": 2.98}), ({"gain": 0.99}, {"gain": 1.01}))
    )
    # Random blocks leak, each channel in its own way: the row of a member is known to that only.
    accuracy = 1e-4 if excitation == "periodic" else 0.01
    for change, expected in (
        (change_of(response, "m_s, 3 kg"), by_mass),
        (change_of(response, "calibrator 7"), by_gain),
    ):
        assert np.linalg.norm(change - expected) < accuracy * np.linalg.norm(expected)


def test_a_delay_of_a_member_turns_its_phase_in_proportion_to_frequency() -> None:
    """dH = -H D G with D = -m j w dt for both accelerations, G their own FRF.

    Held against acceleration as a response of its own.
    """
    made = recordings("periodic")
    response = measure(made, SETTINGS["periodic"])
    roles = {"acceleration": "output", "displacement": "reference"}
    kept = tuple(replace(c, role=roles.get(c.quantity, c.role)) for c in made[0].channels)
    acceleration = measure([replace(run, channels=kept) for run in made], SETTINGS["periodic"]).matrix
    jw = 2j * np.pi * response.frequency[:, None, None]
    expected = -response.matrix @ (-3.0 * jw * 2e-5 * acceleration)
    np.testing.assert_allclose(change_of(response, "a.delay"), expected, rtol=1e-9)


class Counted:
    """A recording that counts how often it is read."""

    def __init__(self, recording: Recording) -> None:
        self.channels, self.sample_rate, self.n_sample = (
            recording.channels,
            recording.sample_rate,
            recording.n_sample,
        )
        self.name, self.findings, self._recording = recording.name, recording.findings, recording
        self.reads = 0

    def blocks(self, n_sample: int) -> Iterator[np.ndarray]:
        self.reads += 1
        return self._recording.blocks(n_sample)


def test_recordings_are_read_a_second_time_only_where_sums_have_uncertainties() -> None:
    uncertain = recordings("random")[0]
    plain = tuple(
        replace(c, uncertainties=(), terms=tuple(SumTerm(t.channel, t.factor) for t in c.terms))
        for c in uncertain.channels
    )
    reads = []
    for channels in (plain, uncertain.channels):
        counted = Counted(replace(uncertain, channels=channels))
        assert bool(measure([counted], SETTINGS["random"]).errors) == (channels is not plain)
        reads.append(counted.reads)
    # Each time the first blocks are looked at for bursts before.
    assert reads[1] == reads[0] + 2


def test_errors_follow_the_matrix_into_files_and_other_forms(tmp_path: Path) -> None:
    response = measure(recordings("periodic"), SETTINGS["periodic"])
    write_response(tmp_path / "a.frf.parquet", response, Header("frf", {}, inputs=()))
    read = read_response(tmp_path / "a.frf.parquet")
    assert [error.uncertainty for error in read.errors] == [error.uncertainty for error in response.errors]
    for before, after in zip(response.errors, read.errors, strict=True):
        np.testing.assert_array_equal(before.change, after.change)
        np.testing.assert_array_equal(before.parts, after.parts)
        np.testing.assert_allclose(np.sum(after.parts, axis=0), after.change, rtol=1e-12)
    # Any linear map of the matrix acts on its changes alike: one standard uncertainty added before or after
    # gives the same.
    moved = replace(response, matrix=response.matrix + change_of(response, "m_s, 3 kg"))
    for through in (lambda r: convert(r, "accelerance"), directional):
        expected = through(moved).matrix - through(response).matrix
        np.testing.assert_allclose(
            change_of(through(response), "m_s, 3 kg"), expected, atol=1e-12 * np.abs(expected).max()
        )
    alone = [replace(response, outputs=(response.outputs[n],), **parts_of(response, n)) for n in (0, 1)]
    np.testing.assert_array_equal(change_of(join(alone), "m_s, 3 kg"), change_of(response, "m_s, 3 kg"))


def parts_of(response: FrequencyResponse, row: int) -> dict[str, object]:
    """One row of a response, without its qualities."""
    none = dict.fromkeys(
        ("covariance", "coherence", "multiple_coherence", "partial_coherence", "distortion", "change", "snr")
    )
    errors = tuple(replace(error, change=error.change[:, row : row + 1]) for error in response.errors)
    return {
        **none,
        "snr_channels": (),
        "matrix": response.matrix[:, row : row + 1],
        "errors": errors,
        "name": str(row),
    }


def test_a_member_that_points_elsewhere_changes_the_sum_as_recordings_of_it_do() -> None:
    """ax at the angle d from x reads cos d ax + sin d ay: central differences of FRFs of such recordings, 10
    mrad either way.
    """
    made, angle = recordings("periodic"), 0.01
    turned = ChannelUncertainty("direction", Uncertainty("ax.dof", angle, "rad"))

    def measured(by: float, uncertainties: tuple[ChannelUncertainty, ...] = ()) -> FrequencyResponse:
        runs = []
        for run in made:
            samples = run.samples.copy()
            samples[:, 2] = np.cos(by) * run.samples[:, 2] + np.sin(by) * run.samples[:, 3]
            samples[:, 8] = samples[:, 0] - 3.0 * samples[:, 2]
            channels = tuple(
                replace(c, uncertainties=uncertainties) if c.name == "ax" else c for c in run.channels
            )
            runs.append(replace(run, samples=samples, channels=channels))
        return measure(runs, SETTINGS["periodic"])

    response = measured(0.0, (turned,))
    assert [finding.code for finding in response.findings if finding.code == "number-uncertainty"] == []
    # An angle that is written too large is a sensor that is turned back.
    expected = (measured(-angle).matrix - measured(angle).matrix) / 2
    assert np.linalg.norm(change_of(response, "ax.dof") - expected) < 1e-3 * np.linalg.norm(expected)


def test_of_a_members_direction_an_frf_says_that_it_is_not_held() -> None:
    made = recordings("periodic")
    angle = ChannelUncertainty("direction", Uncertainty("x1.dof", 0.01, "rad"))
    channels = tuple(replace(c, uncertainties=(angle,)) if c.name == "x1" else c for c in made[0].channels)
    findings = measure([replace(run, channels=channels) for run in made], SETTINGS["periodic"]).findings
    (finding,) = [finding for finding in findings if finding.code == "number-uncertainty"]
    assert "direction of x1 in d" in finding.message
