"""Formulas of the theory manual, written out as they stand there, against the functions that they name
(labels in the comments).
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy import integrate, special, stats
from scipy.optimize import fsolve

from labpipe.arrays import FloatArray, modal_assurance
from labpipe.distributions import coverage_factor
from labpipe.methods.journal_bearing.bearing import JournalBearing
from labpipe.methods.journal_bearing.film import mean_worn_depth
from labpipe.methods.magnetic_bearing.bearing import MU_0, Magnet, magnet_factors, magnet_force, pole_fluxes
from labpipe.methods.magnetic_bearing.fit import scatter_radius
from labpipe.methods.magnetic_bearing.sampled_loop import tustin
from labpipe.methods.magnetic_bearing.stability import pade
from labpipe.methods.modal.model_error import phase_collinearity
from labpipe.methods.planning.campaigns import schroeder_phases_of
from labpipe.methods.planning.designs import certificate, variances
from labpipe.methods.ring_down.virtual_rig import KIND, DecayRig, motion
from labpipe.methods.rolling_bearing.settings import (
    BallGeometry,
    ContactMaterial as HertzMaterial,
    ellipse_ratio,
    point_contact,
    series_constant,
)
from labpipe.methods.rotor.shaft import ShaftElement, plane_inertia, plane_stiffness, shape_functions
from labpipe.raw_files.excitation import Sweep, schroeder_phases
from labpipe.spectra.covariance import covariance_of_h1, covariance_of_random
from labpipe.spectra.damping import half_power
from labpipe.spectra.quality import multiple_coherence, ordinary_coherence, partial_coherence
from labpipe.spectra.random import h1, h2, hv
from labpipe.spectra.sweeps import largest_rate
from labpipe.spectra.windows import (
    effective_averages,
    hann,
    line_correlation,
    noise_bandwidth,
    overlap_correlation,
)
from labpipe.uncertainty.amounts import from_log, joint_errors
from labpipe.uncertainty.bandwise import holm
from labpipe.uncertainty.weighted import components, control_limits, from_the_rest, weighted_fit
from tests.methods.journal_bearing.short_bearing import (
    short_bearing_coefficients,
    short_bearing_equilibrium,
    short_bearing_load,
)

FILM = JournalBearing(diameter=0.1, length=0.03, clearance=1e-4, viscosity=0.03)


def test_windows() -> None:
    n, step, k = 64, 16, 9
    w = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n) / n)  # spec-hann
    assert hann(n) == pytest.approx(w, abs=1e-15)
    assert (
        noise_bandwidth(w) == pytest.approx(n * np.sum(w**2) / np.sum(w) ** 2) == pytest.approx(1.5)
    )  # spec-enbw
    rho = [(sum(w[i] * w[i + j * step] for i in range(n - j * step)) / np.sum(w**2)) ** 2 for j in (1, 2, 3)]
    assert overlap_correlation(w, step) == pytest.approx(rho)  # spec-overlap
    worth = k / (1 + 2 * sum((1 - j / k) * r for j, r in enumerate(rho, 1)))
    assert effective_averages(w, step, k) == pytest.approx(worth)  # spec-averages
    shared = []
    for d in (0, 1, 2):  # spec-line-correlation
        total = 0.0
        for j in range(-k + 1, k):
            pairs = [(t, t + j * step) for t in range(n) if 0 <= t + j * step < n]
            r = sum(w[t] * w[u] * np.exp(-2j * np.pi * d * t / n) for t, u in pairs)
            total += (k - abs(j)) * abs(r) ** 2
        shared.append(total)
    assert line_correlation(w, step, k)[:2] == pytest.approx(np.array(shared[1:]) / shared[0])


def test_signals() -> None:
    n = np.arange(1, 8)
    power = np.array([0.1, 0.4, 0.2, 0.3])
    phases = [-2 * np.pi * sum((k - l) * power[l - 1] for l in range(1, k)) for k in range(1, 5)]
    assert schroeder_phases(n) == pytest.approx(-np.pi * n * (n - 1) / 7)  # spec-schroeder
    assert schroeder_phases_of(power) == pytest.approx(phases)  # spec-schroeder-power
    t = np.array([0.0, 0.7, 1.9])
    linear = Sweep((5.0, 40.0), 2.0, 1.0, "linear", "up", 0.0)
    logarithmic = Sweep((5.0, 40.0), 2.0, 1.0, "logarithmic", "up", 0.0)
    rho = np.log(40 / 5) / 2
    assert linear.phase(t) == pytest.approx(2 * np.pi * (5 * t + 35 / 4 * t**2))  # spec-sweep
    assert logarithmic.phase(t) == pytest.approx(2 * np.pi * 5 / rho * (np.exp(rho * t) - 1))


def spectra() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """S_uu, S_yu, S_yy and all together, of two forces and two responses."""
    x = np.random.default_rng(11).standard_normal((4, 80)).view(np.complex128)
    s = (x @ x.conj().T / 40)[None]
    return s[:, :2, :2], s[:, 2:, :2], s[:, 2:, 2:], s


def test_estimators_and_coherence() -> None:
    s_uu, s_yu, s_yy, s = spectra()
    s_uy = s_yu.conj().swapaxes(1, 2)
    inverse = np.linalg.inv(s_uu)
    first = s_yu @ inverse
    assert h1(s_uu, s_yu, s_yy) == pytest.approx(first)  # frf-h1
    assert h2(s_uu, s_yu, s_yy) == pytest.approx(s_yy @ np.linalg.inv(s_uy))  # frf-h2
    joint = s[0][np.ix_([0, 1, 3], [0, 1, 3])]  # frf-hv of the second response
    d = np.diag(1 / np.sqrt(np.diag(joint).real))
    plane = d @ np.linalg.eigh(d @ joint @ d)[1][:, 0]
    assert hv(s_uu, s_yu, s_yy)[0, 1] == pytest.approx(-plane[:2].conj() / plane[2].conj())
    gamma = abs(s_yu[0, 1, 0]) ** 2 / (s_yy[0, 1, 1] * s_uu[0, 0, 0]).real
    assert ordinary_coherence(s_uu, s_yu, s_yy)[0, 1, 0] == pytest.approx(gamma)  # frf-coherence
    explained = (s_yu[0, 1] @ inverse[0] @ s_uy[0, :, 1]).real
    assert multiple_coherence(first, s_yu, s_yy)[0, 1] == pytest.approx(
        explained / s_yy[0, 1, 1].real
    )  # frf-multiple-coherence
    left = s_yy[0, 1, 1].real - explained
    own = abs(first[0, 1, 0]) ** 2
    partial = partial_coherence(np.einsum("fii->fi", inverse).real, first, s_yu, s_yy)[0, 1, 0]
    assert partial == pytest.approx(own / (own + inverse[0, 0, 0].real * left))  # frf-partial-coherence
    q = np.linalg.inv(joint)
    assert partial == pytest.approx(abs(q[2, 0]) ** 2 / (q[2, 2] * q[0, 0]).real)


def test_covariance_of_random_data() -> None:
    s_uu, s_yu, s_yy, s = spectra()
    first = h1(s_uu, s_yu, s_yy)
    left = np.hstack([-first[0], np.eye(2)])
    residual, inverse = left @ s[0] @ left.conj().T, np.linalg.inv(s_uu[0])
    expected = np.einsum("op,ji->oipj", residual, inverse).reshape(4, 4) / (40 - 2)  # frf-covariance-h1
    assert covariance_of_h1(s, first, np.linalg.inv(s_uu), 40.0).whole()[0] == pytest.approx(expected)
    instruments = np.eye(2, 4)[None, None].astype(complex)
    assert covariance_of_random(s, first, instruments, 40.0)[0] == pytest.approx(
        expected
    )  # frf-covariance-random
    one = np.array([[[2.0, 0.9 - 0.3j], [0.9 + 0.3j, 1.0]]])
    h = one[:, 1:, :1] / one[:, :1, :1]
    gamma = abs(one[0, 1, 0]) ** 2 / 2.0
    variance = (1 - gamma) / gamma * abs(h[0, 0, 0]) ** 2 / (12 - 1)
    assert covariance_of_h1(one, h, 1 / one[:, :1, :1], 12.0).whole()[0, 0, 0].real == pytest.approx(variance)


def test_resonances() -> None:
    assert largest_rate(80.0, 0.01) == pytest.approx(216 / 60 * 80**2 * 0.01**2)  # frf-sweep-rate
    f = np.linspace(30, 70, 401)
    h = 1 / (1 - (f / 50) ** 2 + 2j * 0.02 * f / 50)
    peak = half_power(f, h, (40.0, 60.0))
    assert peak.damping_ratio == pytest.approx(
        (peak.high**2 - peak.low**2) / (4 * peak.frequency**2)
    )  # frf-half-power
    assert peak.damping_ratio == pytest.approx(0.02, rel=2e-3)
    a, b = np.random.default_rng(12).standard_normal((2, 10)).view(np.complex128)
    mac = abs(a.conj() @ b) ** 2 / (np.sum(abs(a) ** 2) * np.sum(abs(b) ** 2))
    assert modal_assurance(a[None], b[None])[0, 0] == pytest.approx(mac)  # modal-mac
    xx, yy, xy = np.sum(a.real**2), np.sum(a.imag**2), np.sum(a.real * a.imag)
    assert phase_collinearity(a[:, None])[0] == pytest.approx(
        ((xx - yy) ** 2 + 4 * xy**2) / (xx + yy) ** 2
    )  # modal-collinearity


def test_contacts() -> None:
    """The stiffness of a sphere's contact by Hertz's closed form.

    The ellipse by complete elliptic integrals (Johnson 1985, eq. 4.28).
    """
    radius, steel = 0.01, HertzMaterial()
    star = steel.youngs_modulus / (2 * (1 - steel.poissons_ratio**2))
    assert point_contact(1 / radius, 1 / radius) == pytest.approx(
        4 / 3 * star * np.sqrt(radius), rel=1e-9
    )  # roll-point-contact
    k = ellipse_ratio(0.1)
    big_k, big_e = special.ellipk(1 - k**2), special.ellipe(1 - k**2)
    assert (big_k - big_e) / (big_e / k**2 - big_k) == pytest.approx(0.1)  # roll-ellipse
    across, along = 50.0, 500.0
    rho = along + across
    k = ellipse_ratio(across / along)
    big_k, big_e = special.ellipk(1 - k**2), special.ellipe(1 - k**2)
    deflection = 3 * k * big_k / (2 * np.pi * star) * (np.pi * star * rho / (3 * k * big_e)) ** (1 / 3)
    assert point_contact(along, across) == pytest.approx(deflection**-1.5)
    parts = (1.0 / 3e9) ** (2 / 3) + (1.0 / 5e9) ** (2 / 3)
    assert series_constant((3e9, 5e9), 1.5) == pytest.approx(parts**-1.5)  # roll-series
    ball = BallGeometry(0.008, 0.05, 0.52, 0.53, np.radians(25))
    assert ball.groove_distance == pytest.approx((0.52 + 0.53 - 1) * 0.008)  # roll-groove-distance
    assert ball.groove_centre_radius == pytest.approx(
        0.025 + 0.02 * 0.008 * np.cos(np.radians(25))
    )  # roll-groove-radius


def film_force(place: FloatArray, velocity: FloatArray, speed: float) -> FloatArray:
    """Force on the journal (y, z) [N] of a film whose pressure falls to the ends as a parabola, where it is
    above zero.
    """
    a = np.linspace(0, 2 * np.pi, 20001)[:-1]
    gap = FILM.clearance - place[0] * np.cos(a) - place[1] * np.sin(a)
    slope = place[0] * np.sin(a) - place[1] * np.cos(a)
    rising = -velocity[0] * np.cos(a) - velocity[1] * np.sin(a)
    line = np.maximum(-FILM.viscosity * FILM.length**3 / (2 * gap**3) * (speed * slope + 2 * rising), 0.0)
    return -FILM.diameter / 2 * (a[1] - a[0]) * np.array([np.sum(line * np.cos(a)), np.sum(line * np.sin(a))])


def test_short_journal_bearing() -> None:
    """Load, attitude and coefficients from the short film's pressure, integrated and differentiated
    numerically.
    """
    load, speed, still = 400.0, 300.0, np.zeros(2)
    scale = FILM.clearance
    rest = scale * fsolve(
        lambda x: film_force(scale * x, still, speed) / load - [0, 1], [0.3, -0.5], xtol=1e-12
    )
    e, attitude = short_bearing_equilibrium(FILM, load, speed)
    assert e == pytest.approx(np.hypot(*rest) / scale, rel=1e-6)
    assert short_bearing_load(FILM, e, speed) == pytest.approx(load)
    assert attitude == pytest.approx(np.arctan2(rest[0], -rest[1]), rel=1e-6)
    stiffness, damping = short_bearing_coefficients(FILM, load, speed)
    steps = 1e-4 * scale * np.eye(2)
    by_place = [
        (film_force(rest + d, still, speed) - film_force(rest - d, still, speed)) / (2e-4 * scale)
        for d in steps
    ]
    by_speed = [
        (film_force(rest, d * speed, speed) - film_force(rest, -d * speed, speed)) / (2e-4 * scale * speed)
        for d in steps
    ]
    assert stiffness == pytest.approx(-np.array(by_place).T, rel=1e-3)
    assert damping == pytest.approx(-np.array(by_speed).T, rel=1e-3)


def test_wear() -> None:
    depth, angle, width = 0.4, 0.2, 0.1
    theta = np.linspace(0, 2 * np.pi, 37)
    fine = (np.arange(4000) + 0.5) / 4000 - 0.5
    places = theta[:, None] + width * fine
    means = np.mean(np.maximum(0, depth - 1 - np.cos(places - np.pi / 2 - angle)), axis=1)
    assert mean_worn_depth(theta, depth, angle, width) == pytest.approx(means, abs=1e-7)  # jour-wear-mean


def test_magnets() -> None:
    magnet = Magnet(turns=80, gap=4e-4, pole_area=2e-4, bias_current=2.0)
    factors = magnet_factors(magnet)
    flux = pole_fluxes(magnet, 0.0, 0.0)[0]
    assert factors.force_per_current == pytest.approx(4 * flux * 80 / magnet.gap)  # mag-factors
    assert factors.negative_stiffness == pytest.approx(4 * flux**2 / (MU_0 * magnet.pole_area * magnet.gap))
    assert factors.force_per_current == pytest.approx(
        (magnet_force(magnet, 0, 1e-4) - magnet_force(magnet, 0, -1e-4)) / 2e-4
    )
    assert factors.negative_stiffness == pytest.approx(
        (magnet_force(magnet, 1e-9, 0) - magnet_force(magnet, -1e-9, 0)) / 2e-9
    )
    top, bottom = (np.polyval(side, 0.5j) for side in map(ascending, pade(0.8, 4)))
    assert top / bottom == pytest.approx(np.exp(-0.4j), rel=1e-9)  # mag-pade
    b0, b1, a1 = tustin(0.3, 2.0, 0.01, 1e-3)  # mag-tustin: at 100 rad/s of the warped axis
    s = 2e3 * np.tan(0.05) * 1j
    z = np.exp(0.1j)
    assert (b0 + b1 / z) / (1 + a1 / z) == pytest.approx((2 + 0.3 * s) / (1 + 0.01 * s))
    q, dof, count = 1 - 0.95 ** (1 / 7), 12.0, 7
    assert scatter_radius(dof, count, 0.95) == pytest.approx(
        np.sqrt(dof * (q ** (-1 / dof) - 1))
    )  # mag-radius
    assert scatter_radius(dof, count, 0.95) ** 2 == pytest.approx(stats.f.ppf(0.95 ** (1 / 7), 2, 2 * dof))


def ascending(side: Polynomial) -> FloatArray:
    """Coefficients of a polynomial, highest first."""
    return np.asarray(side.coef)[::-1]


def test_shaft_elements() -> None:
    element = ShaftElement(length=0.2, outer_diameter=0.03)
    l, phi = element.length, element.shear_parameter
    material = element.material
    inertia, area = np.pi * 0.03**4 / 64, np.pi * 0.03**2 / 4
    nu, rigidity = material.poisson, material.elastic_modulus * inertia
    kappa = 6 * (1 + nu) / (7 + 6 * nu)  # rotor-cowper, without a bore
    assert phi == pytest.approx(12 * rigidity / (kappa * material.shear_modulus * area * l**2))  # rotor-shear
    near, far = (4 + phi) * l**2, (2 - phi) * l**2
    table = [
        [12, 6 * l, -12, 6 * l],
        [6 * l, near, -6 * l, far],
        [-12, -6 * l, 12, -6 * l],
        [6 * l, far, -6 * l, near],
    ]
    assert plane_stiffness(element) == pytest.approx(
        rigidity / (l**3 * (1 + phi)) * np.array(table)
    )  # rotor-stiffness
    # The same from bending and shear energy of the shape functions: E I D' D'^T + kappa G A (N' - D)(N' -
    # D)^T.
    points, weights = np.polynomial.legendre.leggauss(6)
    xi, step = (points + 1) / 2, 1e-5
    (n_after, d_after), (n_before, d_before), (_, d) = (
        shape_functions(element, xi + k * step) for k in (1, -1, 0)
    )
    bend, shear = (d_after - d_before) / (2 * step * l), (n_after - n_before) / (2 * step * l) - d
    stiff = rigidity * bend * weights @ bend.T
    energy = (stiff + kappa * material.shear_modulus * area * shear * weights @ shear.T) * l / 2
    assert plane_stiffness(element) == pytest.approx(energy, rel=1e-6)  # rotor-shapes
    n, d = shape_functions(element, xi)
    translation, rotary = plane_inertia(element)
    assert translation == pytest.approx(
        material.density * area * l / 2 * (n * weights) @ n.T
    )  # rotor-inertia
    assert rotary == pytest.approx(material.density * inertia * l / 2 * (d * weights) @ d.T)


def test_many_results() -> None:
    values, errors = np.array([2.0, 2.1, 2.0, 2.2]), np.array([0.1, 0.2, 0.1, 0.15])
    common = np.array([[0.05, 0.04, 0.05, 0.06]])
    v = np.diag(errors**2) + common.T @ common
    assert joint_errors(errors, common) == pytest.approx(v)  # comp-covariance, unc-common
    columns = np.column_stack([np.ones(4), [0.0, 1.0, 2.0, 4.0]])
    fit, weight = weighted_fit(columns, values, v), np.linalg.inv(v)
    expected = np.linalg.inv(columns.T @ weight @ columns)
    assert fit.values == pytest.approx(expected @ columns.T @ weight @ values)  # comp-weighted
    assert fit.covariance == pytest.approx(expected)
    assert fit.quantile(0) == pytest.approx(stats.norm.ppf(0.975))  # comp-quantile
    small = weighted_fit(columns, values, errors / 10)
    weight = np.diag(1 / (errors**2 / 100 + small.spread))
    left = values - columns @ small.values
    assert left @ weight @ left == pytest.approx(2) and left @ weight @ columns == pytest.approx(0, abs=1e-9)
    assert small.covariance == pytest.approx(np.linalg.inv(columns.T @ weight @ columns))  # comp-spread
    assert small.quantile(0) == pytest.approx(stats.t.ppf(0.975, 2))
    p = np.array([0.04, 0.01, 0.03])
    assert holm(p) == pytest.approx(
        [0.06, 0.03, 0.06]
    )  # comp-holm: 3 x 0.01, 2 x 0.03, 1 x 0.04 not below those before
    limits = control_limits(values, 8)
    reach = stats.norm.ppf(1 - 0.025 / 8) * np.mean([0.1, 0.1, 0.2]) * np.sqrt(np.pi) / 2
    ends = np.mean(values) - reach, np.mean(values) + reach
    assert (limits.low, limits.high) == pytest.approx(ends)  # comp-control
    rest = np.array([1, 2, 3])
    share = np.linalg.inv(v[np.ix_(rest, rest)]).sum(axis=0)
    share = np.concatenate([[-1.0], share / share.sum()])
    difference, chance = from_the_rest(values, v)
    assert difference[0] == pytest.approx(-share @ values)  # comp-outlier
    assert chance[0] == pytest.approx(2 * stats.norm.sf(abs(difference[0]) / np.sqrt(share @ v @ share)))
    log = from_log("r", "1", 0.2, 0.1, 2.0)
    assert (log.value, *(log.ci95 or ())) == pytest.approx(
        (np.exp(0.2), np.exp(0.0), np.exp(0.4))
    )  # comp-log


def test_components_of_variance() -> None:
    groups = np.array(["a", "a", "a", "b", "b", "c", "c", "c"])
    values = np.array([1.0, 1.2, 0.9, 2.0, 2.3, 1.5, 1.4, 1.7])
    parts = [values[groups == name] for name in "abc"]
    within = sum(np.sum((part - part.mean()) ** 2) for part in parts) / (8 - 3)
    between = sum(part.size * (part.mean() - values.mean()) ** 2 for part in parts) / (3 - 1)
    n_0 = (8 - (9 + 4 + 9) / 8) / (3 - 1)
    found = components(values, groups)
    assert found.within == pytest.approx(np.sqrt(within))  # comp-components
    assert found.between == pytest.approx(np.sqrt((between - within) / n_0))
    assert found.p_value == pytest.approx(stats.f_oneway(*parts).pvalue)
    means = [part.mean() for part in parts]
    assert found.mean == pytest.approx(np.mean(means))
    assert found.mean_error == pytest.approx(np.std(means, ddof=1) / np.sqrt(3))


def test_coverage_and_designs() -> None:
    assert coverage_factor(0.95, 8.0) == pytest.approx(stats.t.ppf(0.975, 8))  # unc-coverage
    rows = np.random.default_rng(13).standard_normal((5, 3))
    candidates = np.einsum("ai,aj->aij", rows, rows)
    weights = np.full(5, 0.2)
    for _ in range(20000):
        inverse = np.linalg.inv(np.einsum("a,aij->ij", weights, candidates))
        weights *= np.einsum("ij,aij->a", inverse, candidates) / 3
    best = np.einsum("a,aij->ij", weights, candidates)
    assert variances(best, rows[:2]) == pytest.approx(
        [r @ np.linalg.inv(best) @ r for r in rows[:2]]
    )  # plan-variances
    # plan-certificate: max tr(I^-1 I_a) of the D-optimal design is the number of coefficients (Kiefer and
    # Wolfowitz).
    assert certificate("D", candidates, best, np.eye(3)).efficiency == pytest.approx(1, abs=1e-3)


def test_joint_that_slips() -> None:
    """sim-decay, by solving A' = -w (z0 + z1 A) A."""
    rig = DecayRig(kind=KIND, frequencies=(10.0,), damping_ratios=(0.01,), joint=0.04)
    omega, time = 20 * np.pi, np.linspace(0, 0.5, 6)
    solved = integrate.solve_ivp(
        lambda _, a: -omega * (0.01 + 0.04 * a) * a, (0, 0.5), [0.7], t_eval=time, rtol=1e-10, atol=1e-12
    )
    assert 0.7 * motion(rig, "joint", time, 0.7) == pytest.approx(
        solved.y[0] * np.sin(omega * time), abs=1e-8
    )
