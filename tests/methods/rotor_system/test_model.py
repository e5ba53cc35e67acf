"""The model of a rotor with all its unknowns: an independent calculation, and derivatives by differences."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy import linalg

from labpipe.bearings.kinds import OperatingPoint
from labpipe.estimation.leakage import Leakage
from labpipe.methods.journal_bearing.bearing import journal_equilibrium
from labpipe.methods.journal_bearing.curve import CURVE_MESH as FINE
from labpipe.methods.rotor.response import modes
from labpipe.methods.rotor.rig import BearingPlace, RotorRig
from labpipe.methods.rotor.shaft import Disc, NodeSupport, Rotor, ShaftElement, Sleeve, free_rotor
from labpipe.methods.rotor_system.build import (
    RUNNING,
    LinearBearing,
    RotorSystem,
    Sensors,
    SmallErrors,
    Theory,
    build,
)
from labpipe.methods.rotor_system.evidence import FreeModes
from labpipe.methods.rotor_system.system_file import load_system
from labpipe.records.response import Blocks
from labpipe.spectra.windows import kernel_of
from tests.methods.rotor_system.two_discs import (
    STEEL,
    built,
    dof,
    drawn,
    four_tests,
    mass_of,
    run_up,
    system,
    true_values,
    variant,
)

ROOT = Path(__file__).parents[3]

# Independent calculation (Timoshenko elements of another program, all at the truth), printed to 7 digits.
FREE_HZ = (111.3659, 239.5671, 445.4013, 645.0392)
FREE_ZETA = (0.01565818, 0.03368341, 0.06262394, 0.09069327)
EIGENVALUES = {
    0: ((-7.836873, -5.536004, -121.1589, -71.50029), (277.5327, 282.0518, 890.6385, 902.6877)),
    6000: ((-9.296338, -4.353079, -797.574, -121.8464), (266.5646, 292.6687, 5.366863, 886.4691)),
}
RUN_UP = {
    700.0: (2.934404e-07 - 6.02694e-08j, -6.182264e-08 - 2.816768e-07j, 3.085783e-07 + 6.584629e-08j,
            4.471647e-08 - 2.662856e-07j),
    2300.0: (1.024331e-05 - 2.809612e-06j, -2.050874e-06 - 9.001045e-06j, 1.099395e-05 - 1.609389e-06j,
             -4.470888e-07 - 8.798035e-06j),
}  # fmt: skip
STATIC = ((0.5250798, 0.3276954), (0.3276954, 0.3519011))
LN_MASS = 3.492187


def test_free_modes_of_an_independent_calculation() -> None:
    of = built()
    test = FreeModes("hammer", np.arange(1, 5), *[np.ones(4)] * 4)
    ln, _ = test.predict(of.model, true_values(of))
    assert np.exp(ln[:4]) == pytest.approx(FREE_HZ, rel=1e-6)
    assert np.exp(ln[4:]) == pytest.approx(FREE_ZETA, rel=1e-6)


@pytest.mark.parametrize("rpm", EIGENVALUES)
def test_eigenvalues_of_an_independent_calculation(rpm: int) -> None:
    """With its internal damping, without which the modes at speed are others."""
    of = built()
    values = np.where(of.model.acting(RUNNING), true_values(of), 0.0)
    roots = of.model.roots(values, rpm * np.pi / 30, 4).values
    real, imaginary = EIGENVALUES[rpm]
    assert roots.real == pytest.approx(real, rel=2e-6) and roots.imag == pytest.approx(imaginary, rel=2e-6)


def test_run_up_and_deflections_of_an_independent_calculation() -> None:
    of = built()
    vectors, _, _ = run_up(of, np.array(list(RUN_UP))).readings(of.model, true_values(of))
    for row, reference in zip(vectors, RUN_UP.values(), strict=True):
        assert np.abs(row - np.array(reference)).max() < 1e-6 * np.abs(row).max()
    static = four_tests(of, true_values(of), None)[3]
    assert 1e6 * static.measured == pytest.approx(np.array(STATIC), rel=1e-6)
    standing = np.where(of.model.acting("static"), true_values(of), 0.0)
    assert np.log(mass_of(of, standing)) == pytest.approx(LN_MASS, rel=1e-6)


def assert_derivatives(of, test, values: np.ndarray, unknowns) -> None:
    """The derivatives of a test's residual by these *unknowns* are central differences."""
    jacobian = test.residual(of.model, values)[1]()
    for unknown in unknowns:
        error = of.model.errors[unknown]
        step = np.zeros(values.size)
        step[unknown] = 1e-3 * error
        ends = [test.residual(of.model, values + sign * step)[0] for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * step[unknown])
        # What an unknown hardly touches is known to the rounding of the whole.
        scale = np.abs(jacobian[:, unknown]).max() + 1e-5 * np.abs(jacobian * of.model.errors).max() / error
        assert np.abs(slope - jacobian[:, unknown]).max() < 2e-4 * scale, of.model.unknowns[unknown].name


@pytest.mark.parametrize(
    "number", [0, *(pytest.param(number, marks=pytest.mark.long) for number in (1, 2, 3))]
)
def test_derivatives_of_every_test(number: int) -> None:
    """By central differences, for every unknown."""
    of = built()
    values = drawn(of, np.random.default_rng(3))
    test = four_tests(of, values, np.random.default_rng(4))[number]
    assert_derivatives(of, test, values, range(values.size))


def test_a_response_of_random_data_is_the_expected_h1() -> None:
    """|W|^2 of numpy's Hann window on 16 points to a line, summed, of blocks of 2 s: at the peaks a few per
    cent less than H, and the derivatives likewise.
    """
    of = built()
    values = true_values(of)
    plain = replace(four_tests(of, values, None)[1], omega=2 * np.pi * np.arange(20.0, 60.0, 0.5))
    numbers = np.arange(40, 120)
    blocks = Blocks(2.0, "hann", 0.5, 60, "H1")
    leaking = replace(plain, leakage=Leakage(kernel_of(blocks), numbers, np.zeros(0), 0))
    window = np.zeros(16 * 512)
    window[:512] = np.hanning(513)[:-1]
    offsets = np.arange(-64, 65)
    power = np.abs(np.fft.fft(window)[offsets]) ** 2
    shifted = [replace(plain, omega=plain.omega + 2 * np.pi * offset / 32) for offset in offsets]
    every = [one.predict(of.model, values) for one in shifted]
    expected = np.average([motion for motion, _ in every], axis=0, weights=power)
    slopes = np.average([slope() for _, slope in every], axis=0, weights=power)
    found, found_slopes = leaking.predict(of.model, values)
    size = np.abs(expected).max()
    assert np.max(np.abs(plain.predict(of.model, values)[0] - expected) / size) > 0.02
    np.testing.assert_allclose(found / size, expected / size, atol=1e-4)
    scale = np.abs(slopes).max(axis=(1, 2, 3), keepdims=True) + 1e-300
    np.testing.assert_allclose(found_slopes() / scale, slopes / scale, atol=1e-3)


@pytest.mark.long
def test_derivatives_of_eigenvalues() -> None:
    of = built()
    values, spin = drawn(of, np.random.default_rng(5)), 600.0
    roots = of.model.roots(values, spin, 6)
    for unknown, error in enumerate(of.model.errors):
        step = np.zeros(values.size)
        step[unknown] = 1e-4 * error
        ends = [of.model.roots(values + sign * step, spin, 6, slopes=False).values for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * step[unknown])
        scale = np.abs(roots.slopes[:, unknown]).max() + 1e-6 * np.abs(roots.values).max() / error
        assert np.abs(slope - roots.slopes[:, unknown]).max() < 1e-3 * scale, of.model.unknowns[unknown].name


def test_the_same_rotor_as_the_plain_model() -> None:
    """Without internal damping and pedestals, sleeves and cross-coupled bearings included."""
    shaft = Rotor(
        tuple(ShaftElement(0.1, 0.04, STEEL) for _ in range(6)), (Disc(4, 12.0, 0.06, 0.11),),
        (Sleeve(2, 0.06, STEEL, 1.4),),
    )  # fmt: skip
    stiffness = np.array([[8e6, 1e6], [-2e6, 1.2e7]])
    damping = np.array([[9e3, 1e3], [5e2, 7e3]])
    bearing = LinearBearing(stiffness, damping, np.zeros((2, 2)), np.zeros((2, 2)))
    places = tuple(BearingPlace(str(node), node, None, "linear-bearing") for node in (1, 7))  # type: ignore[arg-type]
    rig = RotorRig("small", shaft, speed=50.0, bearings=places)
    system = RotorSystem(
        rig, {}, (), {"1": ((2,), float(np.log(1.4)), 0.0)}, linear={"1": bearing, "7": bearing}
    )
    model = build(system, SmallErrors(0, 0, 0, 0, 0), {}).model
    assert not model.unknowns
    reference = modes(shaft, [NodeSupport(node, stiffness, damping) for node in (1, 7)], 300.0)
    found = model.roots(np.zeros(0), 300.0, slopes=False).values
    for value in reference.eigenvalues[:6]:
        assert np.abs(found - value).min() < 1e-8 * abs(value)


def test_two_sleeves_on_one_element_and_one_damping_in_both_directions() -> None:
    """The factors of both act; c_yz has a number of its own where c_yy and c_zz share one."""
    shaft = Rotor(tuple(ShaftElement(0.1, 0.04, STEEL) for _ in range(2)))
    places = tuple(BearingPlace(str(node), node, None, "linear-bearing") for node in (1, 3))  # type: ignore[arg-type]
    damping, errors = np.array([[9e3, 1e3], [0.0, 9e3]]), np.array([[0.2, 200.0], [0.0, 0.2]])
    bearing = LinearBearing(1e6 * np.eye(2), damping, np.zeros((2, 2)), errors, "c")
    sleeves = {"A": ((1,), 0.2, 0.1), "B": ((1,), 0.3, 0.1)}
    rig = RotorRig("small", shaft, speed=50.0, bearings=places)
    system = RotorSystem(rig, sleeves=sleeves, linear={"1": bearing, "3": bearing})
    model = build(system, SmallErrors(0, 0, 0, 0, 0), {}).model
    names = [unknown.name for unknown in model.unknowns]
    assert names == ["sleeve A", "sleeve B", "1 c", "1 c_yz", "3 c", "3 c_yz"]
    plain, stiff = (model.matrices(values, 0.0, False).stiffness for values in (np.zeros(6), model.means))
    assert stiff[0, 0] == pytest.approx(np.exp(0.5) * plain[0, 0])


@pytest.mark.long
def test_an_oil_film_s_clearance_is_an_unknown(tmp_path: Path) -> None:
    """Its coefficients follow the speed, and at one standard uncertainty above are those of that clearance;
    the derivatives hold by differences.
    """
    text = """speed: 50 Hz
elements: [{length: 200 mm, diameter: 25 mm, count: 2}]
discs: [{node: 2, mass: 5 kg, polar_inertia: 0.01 kg.m^2, transverse_inertia: 0.006 kg.m^2}]
bearings:
  - {kind: journal-bearing, name: left, node: 1, diameter: 30 mm, length: 15 mm, clearance: 90 um +- 5 um,
     viscosity: 0.05 Pa.s}
  - {kind: linear-bearing, name: right, node: 3, k_yy: 8 MN/m, c: 5 kN.s/m}
unbalances: [{node: 2, size: 0 g.mm +- 20 g.mm}]
"""
    (tmp_path / "rotor.yaml").write_text(text)
    system = load_system(tmp_path / "rotor.yaml")
    model = build(system, SmallErrors(0, 0, 0, 0, 0), {}).model
    (number,) = [n for n, unknown in enumerate(model.unknowns) if "clearance" in unknown.name]
    values, spin = model.means.copy(), 2 * np.pi * 40.0
    values[number] += model.errors[number]
    load = system.rig.static_loads()["left"]
    film = replace(system.rig.place("left").film("a test"), clearance=95e-6)
    fine, coarse = (journal_equilibrium(film, load, spin, mesh).stiffness for mesh in (FINE, FINE.halve()))
    # Extrapolated to cells of no size, as the curve is; it is a spline, .04 % off between its nodes.
    reference = (4 * fine - coarse) / 3
    free = model.matrices(values, spin, supported=False).stiffness[:2, :2]
    assert model.matrices(values, spin).stiffness[:2, :2] - free == pytest.approx(reference, rel=1e-3)
    speeds, forces = np.array([200.0, 300.0]), np.eye(model.n_dof)[:, [4]]
    motion, slopes, _ = model.response(values, speeds, speeds, forces, [4, 5])
    step = np.zeros(values.size)
    step[number] = 1e-4 * model.errors[number]
    ends = [model.response(values + sign * step, speeds, speeds, forces, [4, 5])[0] for sign in (1, -1)]
    assert (ends[0] - ends[1]) / (2 * step[number]) == pytest.approx(
        slopes()[number], rel=1e-5, abs=1e-6 * np.abs(motion).max()
    )


@pytest.mark.parametrize(
    "bearings", ["oil", *(pytest.param(other, marks=pytest.mark.long) for other in ("seal", "magnets"))]
)
def test_derivatives_on_other_bearings(bearings: str) -> None:
    """By central differences, for every unknown that is no small error elsewhere, of the run-up and of
    eigenvalues at speed; those of magnets with the controller at the frequency of each mode.
    """
    of = built(bearings=bearings)
    values, spin = drawn(of, np.random.default_rng(6)), 200.0
    test = run_up(of, np.linspace(900.0, 2100.0, 4))
    chosen = [n for n, unknown in enumerate(of.model.unknowns) if unknown.group in ("", "bearings")]
    assert_derivatives(of, test, values, chosen)
    roots = of.model.roots(values, spin, 6)
    for unknown in chosen:
        error = of.model.errors[unknown]
        step = np.zeros(values.size)
        step[unknown] = 1e-3 * error
        ends = [of.model.roots(values + sign * step, spin, 6, slopes=False).values for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * step[unknown])
        scale = np.abs(roots.slopes[:, unknown]).max() + 1e-5 * np.abs(roots.values).max() / error
        assert np.abs(slope - roots.slopes[:, unknown]).max() < 1e-3 * scale, of.model.unknowns[unknown].name


def test_eigenvalues_of_a_controlled_bearing_are_zeros_of_its_dynamic_stiffness() -> None:
    """The determinant of lambda^2 M + lambda (C + Omega G) + K with K and C of the magnets at Im lambda, from
    `labpipe bearing`'s own coefficients: one magnet pulls, another is its controller's.
    """
    of = built(bearings="magnets")
    place = variant("magnets").rig.bearings[0]
    free = of.model.matrices(of.model.means, 0.0, supported=False).stiffness
    # Of a rotor as declared, and of one in which heavily damped modes are near each other.
    drawn_values = drawn(of, np.random.default_rng(5))
    for values, spin in ((of.model.means, 200.0), (drawn_values, 4400.0), (drawn_values, 1460.0)):
        roots = of.model.roots(values, spin, 16, slopes=False)
        assert roots.values.size >= 8
        for root, shape in zip(roots.values, roots.shapes.T, strict=True):
            whole = of.model.matrices(values, spin, omega=root.imag)
            stiffness = root**2 * whole.mass + root * whole.at_speed(spin) + whole.restoring(spin)
            forces = np.abs(root) ** 2 * np.abs(whole.mass @ shape)
            assert np.abs(stiffness @ shape).max() < 1e-8 * forces.max()
            if values is of.model.means:
                point = place.bearing.at(OperatingPoint((0.0, -100.0), spin, float(root.imag)))
                assert (whole.stiffness - free)[4:6, 4:6] == pytest.approx(point.stiffness, rel=1e-9)


def test_magnets_off_their_stated_values_are_those_of_the_values_drawn() -> None:
    """K = K_i C(w) - k_s is linear in both: at +1/2 and -3/2 standard uncertainties of them, whatever lies
    between and beyond the bearings it is made from.
    """
    place = variant("magnets").rig.bearings[0]
    gain, pull = place.uncertainties
    theory = Theory(place, (0.0, -100.0), np.array([[0.0, 1.0], [0.0, 1.0]]))
    omega, magnets = np.array([50.0, 400.0]), place.bearing.settings
    moved = replace(
        magnets,
        force_per_current=magnets.force_per_current + gain.uncertainty.std_error / 2,
        negative_stiffness=magnets.negative_stiffness - 1.5 * pull.uncertainty.std_error,
    )
    expected = place.bearing.kind.dynamic(moved, omega)
    for matrix, values in (("stiffness", expected.real), ("damping", expected.imag / omega[:, None, None])):
        drawn_values = theory.block(matrix, np.ones((2, 2)), omega, omega, np.array([0.5, -1.5]))
        assert drawn_values == pytest.approx(values, rel=1e-9)


def test_a_seal_acts_as_long_as_the_rotor_turns() -> None:
    """k_yz = -k_zy, of a sign that is not known, and nothing at rest."""
    of = built(bearings="seal")
    at = of.model.number("seal k_cross")
    assert of.model.means[at] == 5e5 and of.model.errors[at] == 5e5 and of.model.unknowns[at].unit == "N/m"
    values = of.model.means.copy()
    values[at] = -3e5
    y, z = 24, 25
    turning, standing = (of.model.matrices(values, spin).stiffness for spin in (100.0, 0.0))
    assert turning[y, z] == -3e5 and turning[z, y] == 3e5
    assert standing[y, z] == standing[z, y] == 0


def test_what_estimate_frees_of_bearings(tmp_path: Path) -> None:
    """Clearance 15 %, viscosity 20 %, a seal's cross-coupling a tenth of the direct stiffness; what stands
    with its uncertainty keeps it, and oil of one source is one unknown.
    """
    file = yaml.safe_load((ROOT / "configs/rotors/two-discs.yaml").read_text())
    oil = {"kind": "journal-bearing", "diameter": "40 mm", "length": "20 mm", "clearance": "60 um"}
    file["bearings"] = [
        oil | {"name": "left", "node": 2, "viscosity": "20 mPa.s"},
        oil | {"name": "right", "node": 12, "viscosity": "20 mPa.s +- 5 %"},
        {"kind": "linear-bearing", "name": "seal", "node": 7, "k_yy": "1 MN/m", "k_zz": "3 MN/m"},
        {"kind": "linear-bearing", "name": "labyrinth", "node": 6, "k_yy": "1 MN/m", "k_cross": "1 MN/m"},
    ]
    file["estimate"] = ["clearance", "viscosity", "cross-coupling"]
    del file["pedestals"]
    (tmp_path / "rotor.yaml").write_text(yaml.safe_dump(file))
    system = load_system(tmp_path / "rotor.yaml")
    loads = system.rig.static_loads()
    # The middle one is a bearing and carries; what has `k_cross` is a seal and does not.
    assert loads["labyrinth"] == (0.0, 0.0) and loads["seal"][1] < 0
    mass = free_rotor(system.rig.rotor).mass[1::4, 1::4].sum()
    assert sum(z for _, z in loads.values()) == pytest.approx(-9.80665 * mass, rel=1e-6)
    model = build(system, SmallErrors(0, 0, 0, 0, 0), {}).model
    known = {unknown.name: unknown for unknown in model.unknowns}
    for name, mean, error in (
        ("left clearance", 60e-6, 9e-6),
        ("right clearance", 60e-6, 9e-6),
        ("left viscosity", 0.02, 0.004),
        ("right viscosity", 0.02, 0.001),
        ("seal k_cross", 0.0, 2e5),
    ):
        assert (known[name].mean, known[name].error) == pytest.approx((mean, error))
    names = [unknown.name for unknown in built(bearings="oil").model.unknowns]
    assert names.count("oil") == 1


def test_damping_that_turns_with_the_shaft_makes_it_unstable_above_the_critical_speed() -> None:
    """A flexible shaft with internal damping alone is unstable above its critical speed (Childs 1993): with
    damping that stands still as well, above it times 1 + standing over turning damping of the mode.
    """
    of = built()
    values = np.where(of.model.acting(RUNNING), true_values(of), 0.0)
    slow = of.model.roots(values, 100.0, slopes=False).values
    fast = of.model.roots(values, 3000.0, slopes=False).values
    assert slow.real.max() < 0 < fast.real.max()
    assert dof("2 z") == 9


def test_two_materials_of_one_modulus_keep_their_own_uncertainties(tmp_path: Path) -> None:
    """The cast one is known ten times worse, whatever its nominal numbers are."""
    whole = yaml.safe_load((ROOT / "configs/rotors/two-discs.yaml").read_text())
    forged = whole["materials"]["shaft steel"]
    whole["materials"]["cast"] = forged | {"elastic_modulus": "210 GPa +- 20 %"}
    piece = whole["elements"][0] | {"count": 6}
    whole["elements"] = [piece, piece | {"material": "cast"}]
    (tmp_path / "rotor.yaml").write_text(yaml.safe_dump(whole))
    young = load_system(tmp_path / "rotor.yaml").young
    assert {material.name: error for material, error in young.items()} == pytest.approx(
        {"shaft steel": 0.02, "cast": 0.2}
    )


def test_a_bearing_s_stated_uncertainty_counts_whatever_its_source(tmp_path: Path) -> None:
    """2 % of a stiffness, by its supplier, and 30 % of a damping."""
    left = "{kind: linear-bearing, node: 1, k_yy: 8 MN/m +- 2 % (source=supplier), c: 5 kN.s/m +- 30 %}"
    (tmp_path / "rotor.yaml").write_text(
        f"speed: 50 Hz\nelements: [{{length: 200 mm, diameter: 25 mm, count: 2}}]\nbearings:\n  - {left}\n"
        "  - {kind: linear-bearing, node: 3, k_yy: 8 MN/m, c: 5 kN.s/m}\n"
    )
    bearing = load_system(tmp_path / "rotor.yaml").linear["1"]
    assert np.diag(bearing.stiffness_error) == pytest.approx([0.02, 0.02])
    assert np.diag(bearing.damping_error) == pytest.approx([0.3, 0.3])


def test_a_rotor_without_damping_has_free_frequencies() -> None:
    """Only a damping ratio that was measured asks for damping; f is that of K and M alone."""
    of = system(False)
    model = build(replace(of, internal=(0.0, 0.0)), SmallErrors(), {}).model
    nothing = np.full(2, np.nan)
    hammer = FreeModes("hammer", np.array([1, 2]), np.ones(2), np.full(2, 0.01), nothing, nothing)
    free = model.matrices(model.means, 0.0, supported=False)
    plane = np.flatnonzero(np.isin(np.arange(model.n_dof) % 4, (0, 3)))
    stiffness, mass = (matrix[np.ix_(plane, plane)] for matrix in (free.stiffness, free.mass))
    omega = np.sqrt(linalg.eigh(stiffness, mass, eigvals_only=True)[2:4])
    residual, jacobian = hammer.residual(model, model.means)
    assert residual == pytest.approx(-np.log(omega / (2 * np.pi)) / 0.01, rel=1e-6)
    assert np.isfinite(jacobian()).all() and residual.size == 2


def test_a_test_named_at_speed_may_be_at_rest() -> None:
    of = build(system(), SmallErrors(), {"at speed": Sensors(("3 y",), 0.01)}).model
    acting = of.acting("at speed")
    assert not any(acting[n] for n, u in enumerate(of.unknowns) if u.group == "bearings")
    assert not of.acting(RUNNING)[of.number("gain at speed 3 y")]
