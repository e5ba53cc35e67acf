"""Uncertainties of probes in run-ups: changes against refits, chi-square of runs whose probes are off,
reading a rig file.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from labpipe.errors import ConfigError
from labpipe.methods.run_ups.joint import fit_jointly
from labpipe.methods.run_ups.measured import measured_critical_speed, run_up_of
from labpipe.methods.run_ups.metamodel_kinds import PhysicalFit
from labpipe.methods.run_ups.methods import fit_points, joint_method
from labpipe.methods.run_ups.records import RunUp
from labpipe.methods.run_ups.settings import ProbeSettings, ProbeUncertainties, RunSettings, RunUpSettings
from labpipe.records.response import Port
from labpipe.records.uncertain import ChannelUncertainty, Uncertain, Uncertainty
from labpipe.spectra.orders import OrderTrack, planes_of
from tests.methods.run_ups.run_up_cases import RIG, trained

UNCERTAINTIES = ProbeUncertainties(gain=Uncertain(1.0, 0.02), keyphasor=Uncertain(0.0, 0.03))


@pytest.fixture(scope="module")
def runs() -> tuple[RunUp, ...]:
    return tuple(
        replace(run, uncertainties=UNCERTAINTIES.errors(run.planes)) for run in trained("inside")[:2]
    )


def test_the_change_by_a_keyphasor_is_that_of_refits(runs: tuple[RunUp, ...]) -> None:
    """All phasors turned by a tenth of 0.03 rad either way.

    To 3 % of the combined error of every parameter.
    """
    fit = fit_jointly(RIG, runs)
    names = [source.source for source in fit.sources]
    assert names == ["disc 1 x.gain", "disc 1 y.gain", "disc 2 x.gain", "disc 2 y.gain", "keyphasor"]
    ends = [
        fit_jointly(RIG, [replace(run, response=run.response * np.exp(sign * 0.003j)) for run in runs]).values
        for sign in (1, -1)
    ]
    found = fit.systematic[names.index("keyphasor")]
    np.testing.assert_allclose(found / fit.std_error, (ends[0] - ends[1]) / 0.2 / fit.std_error, atol=0.03)
    viscosity = joint_method(fit).parameters[0]
    assert viscosity.combined == pytest.approx(np.hypot(viscosity.std_error, viscosity.systematic))
    assert sum(part.share for part in viscosity.budget) == pytest.approx(1.0)


def test_probes_that_are_off_do_not_reject_the_family(runs: tuple[RunUp, ...]) -> None:
    """One probe reads 6 % too much, three standard uncertainties: without their uncertainties chi-square
    rejects, with them it does not.
    """
    off = []
    for run in runs:
        response = run.response.copy()
        response[:, 0, 0] *= 1.06
        off.append(replace(run, response=response))
    with_uncertainties, without = (
        fit_jointly(RIG, off),
        fit_jointly(RIG, [replace(run, uncertainties=()) for run in off]),
    )
    assert without.chi2_p < 1e-6 < 0.01 < with_uncertainties.chi2_p
    np.testing.assert_allclose(with_uncertainties.values, without.values, rtol=1e-9)


def test_a_metamodel_takes_the_uncertainties(runs: tuple[RunUp, ...]) -> None:
    """The physical one has the errors of the fit that it is."""
    fit, speed = fit_jointly(RIG, runs), np.array([100.0, 200.0])
    model = PhysicalFit.of(fit, (100.0, 200.0))
    np.testing.assert_allclose(model.std_error(5.0, speed), fit.coefficients(5.0, speed)[1], rtol=1e-12)


def test_coefficients_and_peaks_take_the_uncertainties(runs: tuple[RunUp, ...]) -> None:
    """Point by point: the coefficients of a run whose x probe reads 2 % less, first order.

    A peak's speed does not know the keyphasor.
    """
    one = replace(
        runs[0],
        uncertainties=tuple(
            error for error in runs[0].uncertainties if error.uncertainty.source == "disc 1 x.gain"
        ),
    )
    (with_uncertainty,), (plain,) = fit_points(RIG, [one]), fit_points(RIG, [replace(one, uncertainties=())])
    small = 0.01 * one.changes()["disc 1 x.gain"]
    ends = [
        fit_points(RIG, [replace(one, response=one.response + sign * small, uncertainties=())])[
            0
        ].coefficients
        for sign in (1, -1)
    ]
    change = (ends[0] - ends[1]) / 0.02
    expected = np.hypot(plain.std_error, change)
    free = ~(plain.at_bound | with_uncertainty.at_bound)
    np.testing.assert_allclose(with_uncertainty.std_error[free], expected[free], rtol=0.05)
    only = replace(
        one,
        uncertainties=tuple(
            error for error in runs[0].uncertainties if error.uncertainty.source == "keyphasor"
        ),
    )
    assert measured_critical_speed(only).std_error == pytest.approx(
        measured_critical_speed(replace(one, uncertainties=())).std_error, rel=1e-3
    )
    coarse = replace(one, uncertainties=ProbeUncertainties(gain=Uncertain(1.0, 0.3)).errors(one.planes))
    assert measured_critical_speed(coarse).std_error > 1.1 * measured_critical_speed(one).std_error


def test_a_recording_has_the_uncertainties_of_its_rig_file(runs: tuple[RunUp, ...]) -> None:
    """A probe at 45 deg that points 1 mrad further and reads through 20 us, against phasors of such
    probes.
    """
    size, speed = 1e-3, np.array([20.0, 30.0, 40.0])
    uncertainties = (
        ChannelUncertainty("direction", Uncertainty("a.dof", size, "rad")),
        ChannelUncertainty("delay", Uncertainty("a.delay", 2e-5, "s")),
    )
    angles = np.radians([45.0, 135.0])
    ports = (
        Port("a", "a", "45 deg", float(angles[0]), uncertainties),
        Port("b", "b", "135 deg", float(angles[1])),
    )
    motion = np.array([[1.0 + 0.3j, 0.4 - 1j]]) * speed[:, None] * 1e-6

    def track(turned: float, late: float) -> OrderTrack:
        seen = np.array([angles[0] + turned, angles[1]])
        amplitude = motion @ np.stack([np.cos(seen), np.sin(seen)])
        amplitude[:, 0] *= np.exp(-2j * np.pi * speed * late)
        rest = {"variance": np.full((3, 2), 1e-18), "overall": np.zeros((3, 2)), "orbit": np.zeros((3, 1))}
        rest["mean"] = np.zeros((3, 2))
        return OrderTrack(
            order=1.0,
            time=np.arange(3.0),
            speed=speed,
            amplitude=amplitude,
            ports=ports,
            planes=planes_of(ports),
            **rest,
        )

    runs = [
        run_up_of(track(*errors), (), "a", 1.0, {"": 1e-5 + 0j})
        for errors in ((0, 0), (-size, 0), (0, -2e-5))
    ]
    changes = runs[0].changes()
    for source, run in zip(("a.dof", "a.delay"), runs[1:], strict=True):
        # A number that is written too large is a probe that is turned back, or less late.
        exact = run.response - runs[0].response
        np.testing.assert_allclose(changes[source], exact, atol=5e-3 * np.max(np.abs(exact)))


def test_uncertainties_of_tables_are_read() -> None:
    found = ProbeSettings(gain="2 % (k=2)", phase="0.5 deg (source=filter)", keyphasor="1 deg").uncertainties
    errors = found.errors(("disc 1", "disc 2"))
    assert [error.uncertainty.source for error in errors].count("filter") == 4
    assert {error.uncertainty.std_error for error in errors if error.uncertainty.source.endswith("gain")} == {
        0.01
    }
    assert errors[-1].uncertainty.std_error == pytest.approx(np.radians(1))
    with pytest.raises(ConfigError, match="is not an uncertainty"):
        ProbeSettings(gain="much")


def test_the_report_states_parameters_with_the_uncertainties_of_probes(runs: tuple[RunUp, ...]) -> None:
    """Two significant digits of the combined error, not of that by noise alone."""
    (viscosity, *_) = joint_method(fit_jointly(RIG, runs)).parameters
    assert viscosity.std_error < 0.95 * viscosity.combined and viscosity.full_error == viscosity.combined
    half = (viscosity.ci95[1] - viscosity.ci95[0]) / 2
    assert half == pytest.approx(viscosity.coverage_factor * viscosity.combined)


def test_probes_of_tables_without_a_table_are_refused() -> None:
    run = RunSettings(recording="a.parquet", tacho="n", load=8.0, unbalance=(("disc 1", 2e-5 + 0j),))
    with pytest.raises(ConfigError, match="no run is a table"):
        RunUpSettings(rotor="r.yaml", runs=(run,), probes=ProbeSettings(gain="1 %"))
