"""The model decay as a fit: parameters, derived values, warnings, notes, refusals, and its way through files
and reports.
"""

from __future__ import annotations

import functools
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from labpipe.artefacts.header import Header
from labpipe.artefacts.identification_file import fit_entry, read_fit
from labpipe.artefacts.measured_files import read_decays, write_decays
from labpipe.errors import ConfigError, DataError, FitError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.ring_down.fit import DecaySettings, check_fitted
from labpipe.methods.ring_down.likelihood import energies, maximum_likelihood, noise_chance, pieces_of
from labpipe.methods.ring_down.report import over_amplitude_figure
from labpipe.records.fit_details import RingDown
from labpipe.records.identification import Fit, Identification
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.spectra import FreeDecay, FreeDecays
from labpipe.report.build import build
from labpipe.report.document import Figure
from tests.methods.ring_down.records_of_decay import motion, record, times
from tests.methods.ring_down.test_amplitude import TURN, noisy, slipping

ONE, TWO = ((40.0, 0.005, 1.0, 0.3),), ((40.0, 0.005, 1.0, 0.3), (41.6, 0.006, 0.7, 1.9))


def fitted(decays: FreeDecays, **settings: object) -> Fit:
    (fit,) = identify(decays, FitSettings("decay", **{"name": "ring", **settings}))
    return fit


@functools.cache
def slipped() -> Fit:
    """Of a decay whose damping depends on its amplitude."""
    return fitted(record(noisy([slipping(1.0, 0.3)], 1)))


def linear(seed: int = 1, modes=ONE) -> FreeDecays:
    return record(noisy([motion(modes, times())], seed))


def test_the_parameters_of_one_mode_and_its_support() -> None:
    """k = m w_n^2, c = 2 zeta w_n m, log decrement = 2 pi zeta / sqrt(1 - zeta^2), from the fitted f_n and
    zeta.
    """
    measured = linear()
    fit = fitted(measured, mass=2.0)
    assert [p.name for p in fit.parameters] == ["f_n_1", "zeta_1", "log_decrement_1", "k", "c"]
    f_n, zeta, decrement, k, c = fit.parameters
    omega = 2 * np.pi * f_n.value
    assert (k.value, c.value) == pytest.approx((2 * omega**2, 4 * zeta.value * omega), rel=1e-12)
    assert decrement.value == pytest.approx(2 * np.pi * zeta.value / np.sqrt(1 - zeta.value**2), rel=1e-12)
    assert k.std_error == pytest.approx(2 * k.value * f_n.std_error / f_n.value, rel=1e-9)
    assert decrement.std_error == pytest.approx(2 * np.pi * zeta.std_error, rel=1e-3)
    assert [p.derived for p in fit.parameters] == [
        False,
        False,
        True,
        True,
        True,
    ] and fit.correlation.shape == (2, 2)
    assert all(
        p.ci95[0] < truth < p.ci95[1]
        for p, truth in zip(fit.parameters, (40, 0.005, 0.0314163, 126330.9, 5.02655), strict=True)
    )
    assert fit.findings == () and fit.lines == fit.equations == 4096 and fit.dof == 4091
    # Five numbers are fitted to the noise of 4096 samples: its square falls by about 5 of 4096.
    samples = measured.decays[0].samples[:, 0]
    noise = np.var(samples - motion(ONE, times())) / np.var(samples)
    assert 1 - fit.gof.r2 == pytest.approx(noise, rel=20 / 4096)
    assert 1 - fit.gof.r2_adjusted == pytest.approx((1 - fit.gof.r2) * 4096 / 4091)


def test_several_modes_ascend_and_number_their_supports() -> None:
    names = [p.name for p in fitted(linear(modes=TWO), mass=2.0, model_settings=DecaySettings(2)).parameters]
    assert names == [f"{name}_{n}" for n in (1, 2) for name in ("f_n", "zeta", "log_decrement", "k", "c")]


def test_the_peaks_are_named_beside_the_fit() -> None:
    (note,) = [note for note in fitted(linear()).notes if "peaks alone" in note]
    read = float(note.split("decrement ")[1].split(" ")[0])
    assert 0.029 < read < 0.0314


def test_damping_over_amplitude_warns_and_makes_the_intervals_longer() -> None:
    """They hold most of the course of the damping ratio, which is known: .003 at rest, and more above."""
    fit = fitted(record(noisy([slipping(1.0, 0.3), slipping(0.6, 2.0)], 1)))
    assert [f.code for f in fit.findings] == ["amplitude-dependent"]
    zeta, curve = fit.parameter("zeta_1"), fit.detail(RingDown).modes[0]
    held = np.mean((curve.damping > zeta.ci95[0]) & (curve.damping < zeta.ci95[1]))
    assert held > 0.7 and zeta.interval.discrepancy > 3 * zeta.std_error
    slope = fit.parameter("zeta_slope_1")
    assert (
        slope.unit == "1/m"
        and slope.ci95[0] < 0.003 < slope.ci95[1]
        and fit.parameter("f_slope_1").unit == "Hz/m"
    )
    assert fit.detail(RingDown).modes[0].law is not None


def test_two_modes_that_beat_are_not_taken_for_a_law_that_gains_energy() -> None:
    """Two linear modes 0.2 Hz apart under one: the law fits the beat with a damping at rest that no structure
    has; two modes fit better.
    """
    decays = record(noisy([motion(((40.0, 0.005, 1.0, 0.3), (40.2, 0.005, 0.5, 2.8)), times(2.0))], 1))
    fit = fitted(decays)
    (finding,) = [finding for finding in fit.findings if finding.code == "missing-mode"]
    assert "`modes: 2`" in finding.message and "amplitude-dependent" not in [
        finding.code for finding in fit.findings
    ]
    named = [float(number) for number in re.findall(r"at (\d+\.?\d*) and (\d+\.?\d*) Hz", finding.message)[0]]
    np.testing.assert_allclose(named, [40.0, 40.2], atol=0.05)
    assert "zeta_rest_1" not in [parameter.name for parameter in fit.parameters]


@pytest.mark.long
@pytest.mark.parametrize(("apart", "ratio", "phase"), [(0.2, 0.2, 0.3), (0.4, 0.5, 2.8)])
def test_a_missing_mode_is_named_where_it_beats(apart: float, ratio: float, phase: float) -> None:
    """Up to the half-power width of 0.4 Hz apart, 4 s: one mode alone would be said to depend on its
    amplitude.
    """
    beating = motion(((40.0, 0.005, 1.0, 0.3), (40.0 + apart, 0.005, ratio, phase)), times())
    assert "missing-mode" in [finding.code for finding in fitted(record(noisy([beating], 7))).findings]


def test_under_a_mismatch_intervals_hold_the_mode() -> None:
    """A second mode at 55 Hz that nothing fits, beside 40 Hz and a damping ratio of .005."""
    fit = fitted(record(noisy([motion((*ONE, (55.0, 0.01, 0.05, 1.0)), times())], 4)))
    assert [finding.code for finding in fit.findings if finding.level == "warning"] == ["model-mismatch"]
    for name, truth in (("f_n_1", 40.0), ("zeta_1", 0.005)):
        low, high = fit.parameter(name).ci95
        assert low < truth < high and high - low < 0.2 * truth


def test_a_mode_too_few_warns() -> None:
    fit = fitted(record(noisy([motion((*ONE, (55.0, 0.01, 0.05, 1.0)), times())], 4)))
    assert "model-mismatch" in [f.code for f in fit.findings] and "55" in fit.findings[-1].message


def test_an_oscillation_that_grows_is_unphysical() -> None:
    fit = fitted(record(noisy([motion(((40.0, -0.001, 0.3, 0.3),), times())], 5)))
    assert [f.code for f in fit.findings] == ["unphysical"] and fit.parameter("zeta_1").value < 0


def test_a_band_is_fitted_alone() -> None:
    fit = fitted(linear(modes=(*ONE, (95.0, 0.01, 3.0, 1.0))), band=(35.0, 45.0))
    assert (
        fit.band_hz == (35.0, 45.0) and abs(fit.parameter("f_n_1").value - 40) < 0.01 and fit.findings == ()
    )


def test_a_band_beyond_half_the_sample_rate_ends_there() -> None:
    """Up to 10 kHz of 1024 samples a second is as up to 512 Hz."""
    wide, whole = (fitted(linear(), band=(1.0, end)) for end in (1e4, 512.0))
    assert wide.parameter("f_n_1").value == pytest.approx(whole.parameter("f_n_1").value, rel=1e-9)


def test_a_decay_too_short_for_the_band_is_left_out() -> None:
    """One of 0.1 s has 2 of 12 lines: the numbers are those of the other alone, and a note says so."""
    (long,) = noisy([motion(ONE, times())], 1)
    alone, both = (fitted(record(each), band=(30.0, 50.0)) for each in ([long], [long, long[:100]]))
    assert [p.value for p in both.parameters] == [p.value for p in alone.parameters]
    said = next(finding for finding in both.findings if finding.code == "repeat-left-out")
    assert "of 2 decays those at 0.000 s are too short" in said.message
    with pytest.raises(FitError, match="widen the band"):
        fitted(record([long[:100], long[:90]]), band=(30.0, 50.0))


def test_an_oscillation_that_does_not_decay_is_no_mode() -> None:
    fit = fitted(record(noisy([motion(((40.0, 1e-7, 0.3, 0.3),), times())], 5)))
    assert {f.code for f in fit.findings} & {"insignificant", "unphysical"} and fit.parameter(
        "zeta_1"
    ).significant is False


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"input": "f"}, ConfigError, "'input' is not for model decay"),
        ({"bands": [(30.0, 50.0)]}, ConfigError, "'bands' is not for model decay"),
        ({"mass": [1.0, 2.0]}, ConfigError, "takes one mass"),
        ({"mass": 0.0}, ConfigError, "takes one mass, above zero"),
        ({"output": "q"}, ConfigError, "no response 'q'"),
        ({"band": (600.0, 700.0)}, FitError, "0 lines of a decay"),
        ({"band": (200.0, 300.0)}, FitError, "is noise"),
    ],
)
def test_what_does_not_fit_is_refused(
    settings: dict[str, object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        fitted(linear(), **settings)


def test_a_decay_of_few_samples_is_refused() -> None:
    with pytest.raises(FitError, match=r"degrees of freedom|samples of its highest frequency"):
        fitted(record([motion(ONE, times())[:30]]))


@pytest.mark.parametrize("modes", [0, 9])
def test_a_number_of_modes_beyond_reason_is_refused(modes: int) -> None:
    with pytest.raises(ConfigError, match="'modes' is"):
        DecaySettings(modes)


def test_models_say_what_they_are_of() -> None:
    port = (Port("y", "y", "y"),)
    response = FrequencyResponse(
        np.arange(1.0, 4.0), np.ones((3, 1, 1), complex), port, (Port("f", "f", "y"),)
    )
    with pytest.raises(ConfigError, match="model decay needs free decays"):
        identify(response, FitSettings("decay"))
    with pytest.raises(ConfigError, match="model sdof needs an FRF"):
        identify(linear(), FitSettings("sdof", mass=1.0))


def test_outputs_of_one_hit_share_their_poles() -> None:
    """The second output sees the mode a hundred times weaker in other units: the intervals are at least as
    narrow as those of the first.
    """
    first, second = noisy([motion(ONE, times()), 0.01 * motion(ONE, times())], 6)
    ports = (Port("a", "a", "x"), Port("b", "b", "y"))
    both = FreeDecays(
        1024.0, ports, ("m", "m/s^2"), (FreeDecay("r", 0.0, np.stack([first, 0.1 * second], axis=1)),)
    )
    together, alone = fitted(both), fitted(both, output="a")
    assert together.parameter("f_n_1").std_error <= alone.parameter("f_n_1").std_error
    assert [mode.unit for mode in together.detail(RingDown).modes] == ["m"]
    assert together.detail(RingDown).output == "a" and together.equations == 2 * alone.equations


def test_decays_that_follow_the_amplitude_are_stated_in_the_unit_it_is_read_in() -> None:
    """Of a displacement and a noisy acceleration, whose numbers are larger: the middle one of 1 ... .6 um is
    .8 um, and no m/s^2.
    """
    time, rng, decays = times(0.5), np.random.default_rng(3), []
    for size in (1.0, 0.9, 0.8, 0.7, 0.6):
        course = motion(((40.0 * (1 - 0.01 * size), 0.01, 1.0, 0.3),), time)
        noise = rng.standard_normal((time.size, 2)) * [1e-10, 1e-2]
        columns = np.column_stack([1e-6 * size * course, -(251.3**2) * 1e-6 * size * course])
        decays.append(FreeDecay(f"hit {size}", 0.0, columns + noise))
    ports = (Port("y", "y", "y"), Port("a", "a", "a"))
    fit = fitted(FreeDecays(1024.0, ports, ("m", "m/s^2"), tuple(decays)))
    repeats = fit.parameter("f_n_1").repeats
    assert repeats is not None and repeats.at == pytest.approx(8e-7, rel=1e-3)
    assert "are stated at 8e-07 m," in fit.notes[0]


@pytest.mark.long
def test_files_hold_decays_and_fits_exactly(tmp_path) -> None:
    decays = FreeDecays(
        1024.0, (Port("y", "y", "y"),), ("m",), linear().decays * 2, name="t", conditions={"preload": "1 N"}
    )
    write_decays(tmp_path / "t.decay.parquet", decays, Header("decay", {}, inputs=()))
    back = read_decays(tmp_path / "t.decay.parquet")
    assert (back.sample_rate, back.outputs, back.units, back.name, back.conditions) == (
        1024.0,
        decays.outputs,
        ("m",),
        "t",
        {"preload": "1 N"},
    )
    assert len(back.decays) == 2
    np.testing.assert_array_equal(back.decays[1].samples, decays.decays[1].samples)
    fit = slipped()
    again = read_fit(json.loads(json.dumps(fit_entry(fit))))
    assert (
        again.parameters == fit.parameters
        and again.detail(RingDown).modes[0].law == fit.detail(RingDown).modes[0].law
    )
    np.testing.assert_array_equal(again.detail(RingDown).residual, fit.detail(RingDown).residual)


def test_the_report_shows_decay_residual_and_course_over_amplitude() -> None:
    fit = slipped()
    # The decay is on the first page; the correlation of the two estimates is a sentence.
    sections = [
        s for s in build(Identification((fit,), "t")).sections if s.heading in ("Verdict", "Result: ring")
    ]
    decay, over = [block for section in sections for block in section.blocks if isinstance(block, Figure)]
    assert decay.graphic.names == ("measured", "fitted", "residual") and over.graphic.names == (
        "stretches",
        "law",
    )
    assert over.graphic.panels[0].series[1].y[-1] > over.graphic.panels[0].series[1].y[0] > 0.3
    # True are .36 % at rest and .3 % more for a metre, 40 Hz at rest and TURN more.
    truth = (("%", 0.36, 0.3, 0.02), ("Hz", 40.0, TURN / (2 * np.pi), 1e-4))
    for panel, (unit, rest, slope, share) in zip(over.graphic.panels, truth, strict=True):
        stretches, law = panel.series
        assert (panel.x.unit, panel.y.unit) == ("um", unit)
        np.testing.assert_allclose(law.y, rest + slope * 1e-6 * law.x, rtol=share)
        there = np.interp(stretches.x, law.x, law.y)
        # The law goes through the bars, which are two standard errors to either side.
        assert np.all(np.abs(there - stretches.y) < 2 * (stretches.high - stretches.low))
    shown = fit.detail(RingDown)
    other = over_amplitude_figure(fit, shown, 1, replace(shown.modes[0], unit="m/s^2"))
    assert (shown.unit, other.graphic.panels[0].x.unit) == ("m", "m/s^2")


def test_no_decay_is_no_record() -> None:
    with pytest.raises(DataError, match="holds no free decay"):
        record([])
    with pytest.raises(DataError, match="has 1 outputs, 2 are needed"):
        FreeDecays(
            1.0,
            (Port("a", "a", "a"), Port("b", "b", "b")),
            ("m", "m"),
            (FreeDecay("r", 0.0, np.ones((3, 1))),),
        )


def test_a_heavily_damped_decrement_is_less_certain_than_its_damping_ratio() -> None:
    """delta = 2 pi zeta / sqrt(1 - zeta^2), so that d ln delta = d ln zeta / (1 - zeta^2)."""
    ratios, time = (0.30, 0.31, 0.29), times(0.4)
    noise = 1e-4 * np.random.default_rng(4).standard_normal((len(ratios), time.size))
    pairs = zip(ratios, noise, strict=True)
    fit = fitted(record([motion(((40.0, zeta, 1.0, 0.3),), time) + part for zeta, part in pairs]))
    decrement, zeta = fit.parameter("log_decrement_1"), fit.parameter("zeta_1")
    widths = [np.log(parameter.ci95[1] / parameter.ci95[0]) for parameter in (decrement, zeta)]
    assert widths[0] / widths[1] == pytest.approx(1 / (1 - zeta.value**2), rel=1e-6)
    assert decrement.value == pytest.approx(2 * np.pi * zeta.value / np.sqrt(1 - zeta.value**2), rel=1e-9)


def test_what_noise_gives_several_decays_together_is_no_mode() -> None:
    """The amplitude of every decay is free: six of them have a chi-square of 12 degrees of freedom. Held
    against one of 2, six of eight such sets of noise had a mode.
    """
    noise = np.random.default_rng(4).standard_normal((6, 200))
    pieces = pieces_of(record(list(noise)).decays, [0], 1024.0, (100.0, 300.0))
    found = maximum_likelihood(pieces, np.array([-10.0 + 2j * np.pi * 105.0]))
    (energy,), rows = energies(pieces, found), sum(piece.rows.size for piece in pieces)
    assert noise_chance(pieces, found) == pytest.approx([rows * stats.chi2.sf(energy, 12)], rel=1e-9)
    with pytest.raises(FitError, match="what would be a mode at"):
        check_fitted(pieces, found)


def test_a_decay_without_noise_is_its_own_truth() -> None:
    """A computed record: what is left is rounding, and no standard error."""
    fit = fitted(record([motion(ONE, times())]))
    assert [p.value for p in fit.parameters[:2]] == pytest.approx([40.0, 0.005], rel=1e-9)


def test_a_band_ends_at_half_the_sampling_rate() -> None:
    assert fitted(linear(), band=(20.0, 9000.0)).band_hz == (20.0, 512.0)
