"""Margins, the peak of S and intervals of a certificate on few lines far apart and on many noisy ones,
against closed forms of a rig of its own.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import labpipe
from labpipe.methods.magnetic_bearing.measured_margins import (
    TELLING,
    ResponseCourse,
    crest_of,
    factor,
    measured_margins,
)
from tests.methods.magnetic_bearing.recorded_axis import Axis, certificate_pipeline, written

# So many lines from 6 to 900 Hz, evenly over the logarithm of the frequency where they are few.
SPARSE = np.unique(np.round(np.geomspace(3, 450, 60))).astype(int)
AXIS = Axis(lines=SPARSE)
ASKED = "{before: before, after: u, displacement: x, current: i, injection: output}"


def drawn(lines: np.ndarray, noise: float, rng: np.random.Generator) -> dict[str, tuple[float, float]]:
    """Measured peak of |S| and phase margin with standard errors, of S with *noise* in either part."""
    frequency = lines / AXIS.period
    true = 1 / (1 + AXIS.loop(2j * np.pi * frequency))
    measured = true + noise * (rng.standard_normal(lines.size) + 1j * rng.standard_normal(lines.size))
    variance, none = np.full(lines.size, 2 * noise**2), np.zeros((0, lines.size), complex)
    crest = crest_of(ResponseCourse(2 * np.pi * frequency, measured, variance, none, np.inf))
    transfer = 1 / measured - 1, variance / np.abs(measured) ** 4
    margins = measured_margins(frequency, transfer, none, (np.inf, 1.96))
    of_phase = next(margin for margin, _ in margins if margin.name == "measured_phase_margin")
    assert crest is not None and of_phase.std_error is not None
    found = {margin.name.removeprefix("measured_"): margin for margin, _ in margins}
    gain = found.get("gain_margin_upper")
    return {
        "peak": crest.value[:2],
        "place": crest.place[:2],
        "phase": (of_phase.value, of_phase.std_error),
        "gain": (np.log(gain.value), gain.std_error / gain.value) if gain else (np.nan, np.nan),
    }


@pytest.mark.long
@pytest.mark.parametrize(
    ("lines", "noise"), [(SPARSE[::2], 0.003), (SPARSE[::2], 0.02), (np.arange(3, 450), 0.02)]
)
def test_margins_and_peak_have_no_bias_that_counts(lines: np.ndarray, noise: float) -> None:
    """40 draws: the mean within half a standard error of the closed form, 95 % intervals hold it in 33 or
    more (the binomial quantile at 0.1 %).

    A parabola over eleven lines is 1.6 to 15 standard errors off for the phase margin. The place of the peak
    is as far off as it says: at 27 lines the polynomial through them is six standard errors by noise away.
    """
    rng = np.random.default_rng(36)
    s = 2j * np.pi * np.geomspace(30, 90, 100_000)
    place = float(np.abs(s[np.argmin(np.abs(1 + AXIS.loop(s)))]))
    truth = {"peak": AXIS.peak(), "phase": AXIS.phase_margin(), "place": place}
    found = [drawn(lines, noise, rng) for _ in range(40)]
    for name, true in truth.items():
        away = np.array([(one[name][0] - true) / one[name][1] for one in found])
        assert abs(np.mean(away)) < (1.2 if name == "place" else 0.5)
        assert np.mean(np.abs(away) < 1.96) >= 33 / 40


@pytest.mark.long
@pytest.mark.parametrize(("lines", "noise", "told"), [(SPARSE, 0.003, 0.8), (SPARSE, 0.02, 0.0)])
def test_no_wrong_gain_margin_is_told_of_noise(lines: np.ndarray, noise: float, told: float) -> None:
    """|L| = 0.048 where Im L = 0; noise of a sixteenth of it, and of two fifths, in either part of a line:
    told in nearly all draws with its interval, or seldom, and wrongly in no more than one of ten of all
    draws (the binomial quantile of 5 % at 99 %). It was told in 80 % of the second once.
    """
    omega = 2 * np.pi * np.geomspace(500, 890, 400_000)
    loop = AXIS.loop(1j * omega)
    (at,) = np.flatnonzero(loop.imag[:-1] * loop.imag[1:] < 0)
    rng = np.random.default_rng(36)
    found = [drawn(lines, noise, rng)["gain"] for _ in range(60)]
    away = np.array([(log + np.log(-loop[at].real)) / error for log, error in found])
    stated = np.isfinite(away)
    assert np.mean(stated) > told if told else np.mean(stated) < 0.4
    assert np.mean(stated & (np.abs(away) >= 1.96)) <= 0.1


def gain_margin() -> float:
    """-1 / L where the closed form's L crosses the real axis, at 742 Hz."""
    loop = AXIS.loop(2j * np.pi * np.geomspace(500, 890, 400_000))
    (at,) = np.flatnonzero(loop.imag[:-1] * loop.imag[1:] < 0)
    return float(-1 / loop[at].real)


@pytest.mark.long
def test_a_gain_margin_that_is_seldom_told_holds_given_that_it_is_told() -> None:
    """27 lines whose noise is four tenths of |L|: told in one test of eleven, where noise makes L
    larger.

    At least 78 % of those hold it (the binomial quantile of 92 % at 0.1 %; by the interval of a factor alone
    it was 60 %). Of a normal size that is told beyond its limit the interval's upper end holds in 97.5 %.
    """
    true_margin = gain_margin()
    rng, noise, lines, held = np.random.default_rng(36), 0.02, SPARSE[::2], []
    frequency = lines / AXIS.period
    true, none = 1 / (1 + AXIS.loop(2j * np.pi * frequency)), np.zeros((0, lines.size), complex)
    for _ in range(500):
        measured = true + noise * (rng.standard_normal(lines.size) + 1j * rng.standard_normal(lines.size))
        transfer = 1 / measured - 1, 2 * noise**2 / np.abs(measured) ** 4
        for one, _ in measured_margins(frequency, transfer, none, (np.inf, 1.96)):
            if one.name == "measured_gain_margin_upper":
                held.append(one.ci95[0] <= true_margin <= one.ci95[1])
    assert 20 < len(held) < 100 and np.mean(held) >= 0.78
    # A size in its standard errors, told from so many on that its factor's interval is 1 / TELLING wide.
    limit = 1.96 / -np.expm1(-1.96 / TELLING)
    for away in (2.5, 1.0, -1.0, -4.0):
        sizes = limit - away + rng.standard_normal(400_000)
        told = sizes[sizes > limit][:1000]
        shares = -np.log1p(-1.96 / told) / 1.96
        ends = [factor("g", 1 / x, share / x, 1.96).ci95[1] for x, share in zip(told, shares, strict=True)]
        # Four standard deviations of 1,000 draws.
        assert np.mean(np.array(ends) >= 1 / (limit - away)) >= 0.975 - 4 * 0.005


@pytest.mark.long
def test_every_line_has_the_degrees_of_freedom_that_are_said(tmp_path: Path) -> None:
    """From a raw file whose reference repeats to the last digit: 20 periods less the one skipped give 18, and
    smoothing over two lines either way five times as many but at the ends of the band.

    The scatter of the estimates of one logger's noise over lines 22 Hz apart agrees.
    """
    columns = AXIS.record(np.random.default_rng(3))
    pipeline = certificate_pipeline(written(tmp_path, AXIS, columns), AXIS, certificate=ASKED)
    (spectra,) = labpipe.run(pipeline).spectra
    assert 75 < spectra.covariance_dof < 18 * 5
    quiet = AXIS.other(disturbance=0.0, probe=0.0, lines=np.arange(12, 445, 11))
    pipeline = certificate_pipeline(
        written(tmp_path, quiet, quiet.record(np.random.default_rng(4))), quiet, certificate=ASKED
    )
    (spectra,) = labpipe.run(pipeline, overrides=["frf.band=6-900 Hz"]).spectra
    row = [channel.name for channel in spectra.channels].index("u")
    power = spectra.covariance[:, 0, row, row].real
    by_scatter = np.mean(power) ** 2 / np.var(power, ddof=1)
    # 40 independent estimates tell their variance to a factor of 1.9 at 0.1 % either way.
    assert spectra.covariance_dof / 2 < by_scatter < 2.2 * spectra.covariance_dof


@pytest.mark.long
def test_the_peak_of_dense_noisy_lines_has_no_bias(tmp_path: Path) -> None:
    """16 raw files of 447 lines, the loop disturbed by five times the usual force: the mean within three of
    its standard errors of the closed form. The highest of the lines was 1.25 errors too high on average.
    """
    noisy = Axis(disturbance=10.0, periods=10)
    away = []
    for seed in range(16):
        columns = noisy.record(np.random.default_rng([36, seed]))
        sides = "{before: before, after: u}"
        file = certificate_pipeline(written(tmp_path, noisy, columns), noisy, certificate=sides)
        text = file.read_text()
        measured = text[: text.index("accept:")].replace("    theory: {bearing: bearing.yaml}\n", "")
        file.write_text("".join(line for line in measured.splitlines(True) if "estimate:" not in line))
        peak = labpipe.run(file).sections["compare"][0].amount("peak")
        away.append((peak.value - noisy.peak()) / peak.std_error)
    assert abs(np.mean(away)) < 3 / np.sqrt(len(away)) and np.std(away) < 1.7


@pytest.mark.long
def test_intervals_of_a_certificate_hold_on_sparse_lines(tmp_path: Path) -> None:
    """40 records of 53 lines and 20 periods: every amount in 33 or more (the binomial quantile of 95 % at
    0.1 %; of 80 % it sees 56 of 100), all together within three deviations of the records' own shares, which
    of 80 % sees 97 of 100 though all amounts are missed alike.
    """
    pole = AXIS.pole()
    truth = {
        "log_decrement_1": AXIS.log_decrement(),
        "pole_real_1": pole.real,
        "negative_stiffness": AXIS.k_n,
        "force_per_current": AXIS.k_i,
        "bandwidth": AXIS.bandwidth,
        "delay": AXIS.delay,
        "sensitivity_peak": AXIS.peak(),
        "peak": AXIS.peak(),
        "gain_margin_lower": float(-1 / AXIS.loop(0j).real),
        "gain_margin_upper": gain_margin(),
        "phase_margin": AXIS.phase_margin(),
        "measured_phase_margin": AXIS.phase_margin(),
    }
    held = np.zeros((40, len(truth)))
    for seed in range(len(held)):
        columns = AXIS.record(np.random.default_rng(seed))
        pipeline = certificate_pipeline(written(tmp_path, AXIS, columns), AXIS, certificate=ASKED)
        amounts = {one.name: one for one in labpipe.run(pipeline).sections["compare"][0].amounts}
        for number, (name, true) in enumerate(truth.items()):
            low, high = amounts[name].ci95
            held[seed, number] = low <= true <= high
    coverage = held.mean(axis=0)
    assert np.all(coverage >= 33 / 40), dict(zip(truth, coverage, strict=True))
    assert np.mean(coverage) >= 0.95 - 3 * held.mean(axis=1).std() / np.sqrt(len(held))


@pytest.mark.long
def test_gains_within_what_is_stated_move_no_unknown(tmp_path: Path) -> None:
    """Gains of reading and current off by two of their uncertainties, one noise: what the controller and the
    other signals tell of a gain leaves k_n, k_i and the decrement within 0.2 of their uncertainties of those
    of true gains. Of fits that leave such gains to the residual k_n was off by up to two of its
    uncertainties.
    """
    columns = AXIS.record(np.random.default_rng(5))
    names = ("negative_stiffness", "force_per_current", "bandwidth", "log_decrement_1")
    found = []
    for gains in ({}, {"x": 0.006}, {"x": -0.006, "i": -0.006}):
        moved = {name: samples * (1 + gains.get(name, 0.0)) for name, samples in columns.items()}
        pipeline = certificate_pipeline(written(tmp_path, AXIS, moved), AXIS, certificate=ASKED)
        stated_gains(tmp_path / "rig.yaml", 0.3)
        (one,) = labpipe.run(pipeline).sections["compare"]
        assert not [finding.code for finding in one.findings if finding.level == "warning"]
        found.append(one)
    sound = found[0]
    for one in found[1:]:
        for name in names:
            plain = sound.amount(name)
            assert abs(one.amount(name).value - plain.value) < 0.2 * plain.combined, name
        k_n = one.amount("negative_stiffness")
        assert k_n.ci95[0] < AXIS.k_n < k_n.ci95[1]


def test_a_gain_that_the_loop_contradicts_is_named(tmp_path: Path) -> None:
    """A current whose gain is 1.2 % too large, stated within 0.3 %: the number that is asked for is
    0.012 / 1.012, and the unknowns are not off by it.
    """
    columns = AXIS.record(np.random.default_rng(5))
    columns["i"] = 1.012 * columns["i"]
    pipeline = certificate_pipeline(written(tmp_path, AXIS, columns), AXIS, certificate=ASKED)
    stated_gains(tmp_path / "rig.yaml", 0.3)
    (found,) = labpipe.run(pipeline).sections["compare"]
    (finding,) = [one for one in found.findings if one.code == "stated-value"]
    asked = float(finding.message.partition("a change by +")[2].split(" ")[0])
    assert "i.gain" in finding.message and "x.gain" not in finding.message
    assert asked == pytest.approx(1.2, abs=0.03)
    k_i = found.amount("force_per_current")
    assert k_i.ci95[0] < AXIS.k_i < k_i.ci95[1] and k_i.combined < 0.002 * AXIS.k_i


def stated_gains(rig: Path, per_cent: float) -> None:
    """The rig file with an uncertainty of the gain of current and reading."""
    lines = rig.read_text().splitlines()
    stated = f", uncertainty: {{gain: {per_cent} %}}}}"
    rig.write_text(
        "\n".join(line[:-1] + stated if line.startswith(("  i:", "  x:")) else line for line in lines)
    )
