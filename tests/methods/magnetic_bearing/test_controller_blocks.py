"""Controllers of blocks: closed forms of filters, the PID written as blocks, objects of other packages,
stability by Routh and by hand.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal

from labpipe.errors import ConfigError, LabpipeError
from labpipe.methods.magnetic_bearing.bearing import MAGNETIC_KIND, MagneticFile
from labpipe.methods.magnetic_bearing.loop import ControlLoop, controller, dynamic_stiffness, loop_stiffness
from labpipe.methods.magnetic_bearing.loop_problem import unknown, with_unknowns
from labpipe.methods.magnetic_bearing.sampled_loop import Suspended, sampled_loop
from labpipe.methods.magnetic_bearing.stability import (
    closed_loop_poles,
    sensitivity,
    sensitivity_matrix,
    sensitivity_peak,
    unstable_poles,
)
from labpipe.methods.magnetic_bearing.transfer import (
    ControllerBlock,
    CrossControl,
    Transfer,
    block_of,
    blocks_of_matrix,
    connect_series,
    matrix_of,
    transfer_of_polynomials,
)
from labpipe.project.bearing_file import open_bearing
from tests.methods.magnetic_bearing.certified import loop_response

OMEGA = 2 * np.pi * np.array([1.0, 30.0, 200.0, 700.0, 3000.0])
LOOP = ControlLoop()
# k_p + k_d s / (1 + s T_d) + k_i / (1 + s T_i) of ControlLoop's defaults, over one denominator.
T_D, T_I = 1e-4, 0.0318
PID = ControllerBlock(
    form="polynomial",
    numerator=np.polyadd(
        np.polyadd(np.polymul([T_D, 1.0], [T_I, 1.0]), np.polymul([6.5e-4, 0.0], [T_I, 1.0])),
        -0.25 * np.array([T_D, 1.0]),
    ),
    denominator=np.polymul([T_D, 1.0], [T_I, 1.0]),
)
BLOCKS = ControlLoop(controller=(PID,))


@pytest.mark.parametrize(
    ("block", "expected"),
    [
        ({"form": "gain", "gain": 2.5}, lambda s: 2.5 + 0 * s),
        (
            {"form": "lead-lag", "zero": "40 Hz", "pole": "400 Hz"},
            lambda s: (1 + s / (80 * np.pi)) / (1 + s / (800 * np.pi)),
        ),
        ({"form": "low-pass", "frequency": "1 kHz"}, lambda s: 1 / (1 + s / (2000 * np.pi))),
        (
            {"form": "low-pass", "frequency": "1 kHz", "order": 2, "damping": 0.5},
            lambda s: 1 / (1 + s / (2000 * np.pi) + (s / (2000 * np.pi)) ** 2),
        ),
        (
            {"form": "notch", "frequency": "200 Hz", "depth": 0.1, "width": 0.3},
            lambda s: (
                (s**2 + 0.03 * 400 * np.pi * s + (400 * np.pi) ** 2)
                / (s**2 + 0.3 * 400 * np.pi * s + (400 * np.pi) ** 2)
            ),
        ),
        (
            {
                "form": "pid",
                "proportional": 2,
                "integral": "30 1/s",
                "derivative": "1 ms",
                "derivative_time": "0.1 ms",
            },
            lambda s: 2 + 30 / s + 1e-3 * s / (1 + 1e-4 * s),
        ),
        (
            {"form": "roots", "zeros": ["-100 +- 300j"], "poles": ["-50", "-2000", "-900"], "gain": 7e3},
            lambda s: 7e3 * ((s + 100) ** 2 + 9e4) / ((s + 50) * (s + 2000) * (s + 900)),
        ),
        (
            {"form": "polynomial", "numerator": [0, 3.0, 60], "denominator": [1, 20, 400]},
            lambda s: (3 * s + 60) / (s**2 + 20 * s + 400),
        ),
    ],
)
def test_forms_are_their_closed_forms(block: dict[str, object], expected: object) -> None:
    np.testing.assert_allclose(
        ControllerBlock(**block).transfer.response(OMEGA), expected(1j * OMEGA), rtol=1e-12
    )  # type: ignore[arg-type, operator]


def test_a_notch_has_its_depth_and_width() -> None:
    """|G| at the centre is the depth; a full notch passes 1 / sqrt 2 at f (sqrt(1 + w^2 / 4) -+ w / 2)."""
    edges = 200.0 * (np.sqrt(1 + 0.3**2 / 4) + np.array([-0.15, 0.15]))
    full = ControllerBlock(form="notch", frequency=200.0, width=0.3).transfer
    np.testing.assert_allclose(np.abs(full.response(2 * np.pi * edges)), 2**-0.5, rtol=1e-12)
    tenth = ControllerBlock(form="notch", frequency=200.0, width=0.3, depth=0.1).transfer
    assert abs(tenth.response(np.array([400 * np.pi]))[0]) == pytest.approx(0.1, rel=1e-12)


def test_the_pid_as_a_polynomial_is_the_pid() -> None:
    """Stiffness, poles and sensitivity, with the numbers of the PID as the reference."""
    ours, theirs = Suspended(BLOCKS, 33106.0, 0.065), Suspended(LOOP, 33106.0, 0.065)
    np.testing.assert_allclose(
        dynamic_stiffness(BLOCKS, 33106.0, OMEGA), dynamic_stiffness(LOOP, 33106.0, OMEGA), rtol=1e-9
    )
    np.testing.assert_allclose(closed_loop_poles(ours), closed_loop_poles(theirs), rtol=1e-6)
    assert sensitivity_peak(ours).value == pytest.approx(sensitivity_peak(theirs).value, rel=1e-9)
    assert BLOCKS.at_rest == pytest.approx(LOOP.at_rest, rel=1e-12)
    assert unstable_poles(ours) == 0


def test_the_sampled_blocks_are_the_sampled_pid() -> None:
    """Bilinear transform of the whole against that of its terms: the same function of z."""
    responses = [
        loop_response(sampled_loop(Suspended(loop, 33106.0, 0.065)), OMEGA) for loop in (BLOCKS, LOOP)
    ]
    np.testing.assert_allclose(responses[0], responses[1], rtol=1e-7)


def test_discrete_blocks_have_the_poles_of_the_sampled_loop() -> None:
    """The bilinear PID as coefficients of z: s = f_s ln z of the matrices that the virtual rig runs on."""
    continuous, _ = connect_series((PID,))
    zeros, poles, gain = signal.bilinear_zpk(continuous.zeros, continuous.poles, continuous.gain, 20e3)
    numerator, denominator = signal.zpk2tf(zeros, poles, gain)
    block = ControllerBlock(form="polynomial", numerator=numerator, denominator=denominator, rate="20 kHz")
    found = closed_loop_poles(Suspended(ControlLoop(controller=(block,)), 33106.0, 0.065))[:3]
    z = np.linalg.eigvals(sampled_loop(Suspended(LOOP, 33106.0, 0.065)).a)
    expected = 20e3 * np.log(sorted(z.astype(complex), key=abs)[::-1][:3])
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(expected), rtol=1e-5)
    assert unstable_poles(Suspended(ControlLoop(controller=(block,)), 33106.0, 0.065)) == 0
    np.testing.assert_allclose(
        controller(ControlLoop(controller=(block,)), OMEGA[:3]), controller(LOOP, OMEGA[:3]), rtol=3e-3
    )


@pytest.mark.parametrize(("share", "unstable"), [(0.95, 0), (1.05, 2)])
def test_an_integrator_is_stable_up_to_routh_s_limit(share: float, unstable: int) -> None:
    """m s^3 + K k_d s^2 + (K k_p - k_n) s + K k_i: stable while K k_d (K k_p - k_n) > m K k_i (Routh)."""
    m, pull, k_p, k_d = 0.065, 33106.0, 1.0, 6.5e-4
    gain = loop_stiffness(LOOP)
    limit = k_d * (gain * k_p - pull) / m
    pid = ControllerBlock(form="pid", proportional=k_p, derivative=k_d, integral=share * limit)
    plant = Suspended(ControlLoop(controller=(pid,), delay=0.0, bandwidth=1e12), pull, m)
    assert unstable_poles(plant) == unstable
    assert np.sum(closed_loop_poles(plant).real > 0) == unstable
    assert sensitivity(plant, np.zeros(1))[0] == 0


def test_an_unstable_controller_is_counted() -> None:
    """(m s^2 - k_n)(s - 40)(s + 1e5) + K g (s + 300)(s + 1538): roots of the polynomial of the fourth
    degree.
    """
    counts = []
    for gain in (3.0, 0.1):
        block = ControllerBlock(form="roots", zeros=[-300.0, -1538.0], poles=["40", "-1e5"], gain=gain * 65.0)
        plant = Suspended(ControlLoop(controller=(block,), delay=0.0, bandwidth=1e12), 33106.0, 0.065)
        cubic = np.polyadd(
            np.polymul([0.065, 0.0, -33106.0], np.polymul([1.0, -40.0], [1.0, 1e5])),
            46400 * gain * 65.0 * np.polymul([1.0, 300.0], [1.0, 1538.0]),
        )
        counts.append(unstable_poles(plant))
        assert np.sum(np.roots(cubic).real > 0) == counts[-1]
    assert counts[0] == 0 < counts[1]


@pytest.mark.parametrize(("share", "unstable"), [(0.0, 0), (0.9, 0), (1.1, 2)])
def test_cross_coupling_destabilises_beyond_damping_times_frequency(share: float, unstable: int) -> None:
    """m z'' + c z' + (k - j q) z = 0 of z = x + j y is stable while q < c sqrt(k / m) (whirl under a
    cross-coupled stiffness).
    """
    m, pull, gain = 0.065, 33106.0, loop_stiffness(LOOP)
    c, k = gain * 6.5e-4, gain - pull
    q = share * c * np.sqrt(k / m) / gain
    pd = (ControllerBlock(form="pid", proportional=1.0, derivative=6.5e-4),)
    cross = (
        CrossControl(xy=[{"form": "gain", "gain": q}], yx=[{"form": "gain", "gain": -q}])
        if share
        else CrossControl()
    )
    plant = Suspended(ControlLoop(controller=pd, cross=cross, delay=0.0, bandwidth=1e12), pull, m)
    assert unstable_poles(plant) == unstable
    assert np.sum(closed_loop_poles(plant).real > 0) == unstable
    matrix = sensitivity_matrix(plant, OMEGA)
    np.testing.assert_allclose(matrix[:, 0, 0], matrix[:, 1, 1])
    assert bool(np.all(matrix[:, 0, 1] == 0)) == (share == 0)


def test_coupled_coefficients_stand_in_the_matrices() -> None:
    """k_xy = K q e^{-j w tau} / (1 + j w / w_a), which the skew coupling turns into -k_yx."""
    cross = CrossControl(xy=[{"form": "gain", "gain": 0.1}], yx=[{"form": "gain", "gain": -0.1}])
    file = MagneticFile(
        kind="magnetic-bearing",
        mass=0.065,
        frequency=50.0,
        negative_stiffness=33106.0,
        loop=replace(BLOCKS, cross=cross),
    )
    (found,) = MAGNETIC_KIND.coefficients([file])
    s = 2j * np.pi * 50
    coupling = 46400 * 0.1 * np.exp(-s * 75e-6) / (1 + s / (2000 * np.pi))
    assert found.stiffness[0, 1] == pytest.approx(coupling.real, rel=1e-12)
    assert found.damping[1, 0] == pytest.approx(-coupling.imag / (100 * np.pi), rel=1e-12)
    assert found.words["assumptions"].startswith("mass and magnet alike in both directions")


def test_an_integrating_controller_has_no_static_stiffness() -> None:
    pid = ({"form": "pid", "proportional": 1, "integral": 3, "derivative": 6.5e-4, "derivative_time": 1e-4},)
    loop = ControlLoop(controller=pid)
    with pytest.raises(ConfigError, match="integrates"):
        MagneticFile(
            kind="magnetic-bearing", mass=0.065, frequency=50.0, static_stiffness=1e3, loop=loop
        ).suspension()
    file = MagneticFile(
        kind="magnetic-bearing", mass=0.065, frequency=50.0, negative_stiffness=33106.0, loop=loop
    )
    (found,) = MAGNETIC_KIND.coefficients([file])
    assert "static_stiffness" not in [note.name for note in found.notes]


NUMERATOR, DENOMINATOR = [3.0, 60.0], [1.0, 20.0, 400.0]


@pytest.mark.parametrize(
    "system",
    [
        SimpleNamespace(num=[[NUMERATOR]], den=[[DENOMINATOR]], dt=0),
        SimpleNamespace(num=NUMERATOR, den=DENOMINATOR, dt=None),
        signal.TransferFunction(NUMERATOR, DENOMINATOR),
        signal.ZerosPolesGain(*signal.tf2zpk(NUMERATOR, DENOMINATOR)),
        signal.StateSpace(*signal.tf2ss(NUMERATOR, DENOMINATOR)),
    ],
)
def test_systems_of_other_packages_are_taken(system: object) -> None:
    """python-control holds num[output][input] and dt = 0, scipy.signal one polynomial and dt = None."""
    loop = ControlLoop(controller=system)
    expected = (3j * OMEGA + 60) / (-(OMEGA**2) + 20j * OMEGA + 400)
    np.testing.assert_allclose(connect_series(loop.controller)[0].response(OMEGA), expected, rtol=1e-9)


def test_discrete_and_coupled_systems_are_taken() -> None:
    system = SimpleNamespace(num=[[[1.0], [0.5]], [[-0.5], [1.0]]], den=[[[1.0, -0.5]] * 2] * 2, dt=1e-4)
    elements = blocks_of_matrix(system)
    uneven = SimpleNamespace(num=system.num, den=[[[1.0, -0.5], [1.0]], [[1.0], [1.0, -0.5]]], dt=1e-4)
    assert blocks_of_matrix(uneven)["xy"][0].transfer == Transfer((), (), 0.5, 1e4)
    assert elements["yx"][0].transfer == Transfer((), (0.5,), -0.5, 1e4)
    with pytest.raises(ConfigError, match="one input and one output"):
        ControlLoop(controller=system)
    with pytest.raises(ConfigError, match="no sampling time"):
        matrix_of(SimpleNamespace(num=[1.0], den=[1.0, 2.0], dt=True))
    with pytest.raises(ConfigError, match="not a transfer function"):
        matrix_of(SimpleNamespace(dt=None))


def test_a_state_space_of_two_loops_without_coupling() -> None:
    """x by y: states that the input moves and the output does not see."""
    a, unit = np.diag([-100.0, -200.0]), np.eye(2)
    elements = blocks_of_matrix(SimpleNamespace(A=a, B=unit, C=unit, D=0 * unit))
    omega = np.array([10.0, 300.0])
    for name, expected in (("xx", 1 / (1j * omega + 100)), ("xy", 0 * omega), ("yy", 1 / (1j * omega + 200))):
        np.testing.assert_allclose(elements[name][0].transfer.response(omega), expected, rtol=1e-12)


def test_coefficients_of_fast_filters_are_no_rounding() -> None:
    """Fifth order at some kHz: the highest coefficient is 1e-20 of the lowest one, and counts."""
    poles = -2 * np.pi * np.array([1e3, 2e3, 3e3, 4e3, 5e3])
    block = ControllerBlock(form="polynomial", numerator=[float(np.prod(-poles))], denominator=np.poly(poles))
    np.testing.assert_allclose(np.sort(np.real(block.transfer.poles)), np.sort(poles), rtol=1e-9)


@pytest.mark.parametrize("form", ["companion", "cascade"])
def test_state_spaces_of_fast_filters(form: str) -> None:
    """Four poles and three zeros at some kHz: the companion form has entries from 1 to 1e17."""
    zeros, poles = (
        np.array([-300.0, -9e3 + 2e4j, -9e3 - 2e4j]),
        np.array([-1e4, -2.5e4, -4e3 + 6e3j, -4e3 - 6e3j]),
    )
    system = signal.zpk2ss(zeros, poles, 5e3)
    if form == "cascade":
        turn = np.diag(np.logspace(0, -12, 4))
        system = (
            np.linalg.solve(turn, system[0] @ turn),
            np.linalg.solve(turn, system[1]),
            system[2] @ turn,
            system[3],
        )
    a, b, c, d = system
    ((found,),) = matrix_of(SimpleNamespace(A=a, B=b, C=c, D=d, dt=0))
    np.testing.assert_allclose(
        sorted(found.zeros, key=lambda root: root.imag), sorted(zeros, key=lambda root: root.imag), rtol=1e-6
    )
    np.testing.assert_allclose(
        found.response(OMEGA), Transfer(tuple(zeros), tuple(poles), 5e3).response(OMEGA), rtol=1e-6
    )


def test_coefficients_that_are_rounding_are_no_zeros() -> None:
    """tf2zpk of a state space leaves 1e-16 where powers cancel."""
    assert transfer_of_polynomials([1e-17, 2.0], [1.0, 3.0]) == Transfer((), (-3.0,), 2.0)
    assert block_of(Transfer((), (-3.0,), 2.0)).poles == (-3.0,)


HEAD = "kind: magnetic-bearing\nmass: 65 g\nfrequency: 50 Hz\nnegative_stiffness: 33 kN/m\nloop:\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("  controller: {form: gain}\n", r"6:3: loop.controller: a list is needed"),
        ("  controller: [{form: noch}]\n", r"6:17: .*unknown choice 'noch'; did you mean 'notch'"),
        ("  controller: [{form: notch}]\n", r"6:16: .*frequency: is missing for the form notch"),
        (
            "  controller:\n    - {form: notch, frequency: 80 Hz, order: 2}\n",
            r"7:39: .*order: is not for the form notch",
        ),
        ("  controller: [{form: roots, zeros: [-10+3j], poles: [-5]}]\n", r"6:30: .*without its conjugate"),
        (
            "  controller: [{form: roots, zeros: [-10+3j, -10+3j, -10-3j], poles: [-5, -6, -7]}]\n",
            r"6:30: .*-10\+3j stands without its conjugate",
        ),
        (
            "  controller: [{form: low-pass, frequency: 1 kHz, damping: 0.3}]\n",
            r"6:51: .*damping: is for a low-pass of order 2",
        ),
        ("  controller: [{form: roots, zeros: [ten]}]\n", r"6:30: .*'ten' is not a root"),
        ("  controller: [{form: polynomial, numerator: [1], denominator: [0]}]\n", r"6:51: .*is zero"),
        ("  proportional: 2\n  controller: [{form: gain}]\n", r"6:3: loop.proportional: belongs to the PID"),
        ("  cross: {xy: [{form: gain}]}\n", r"6:3: loop.cross: needs the element x by x"),
        (
            "  controller: [{form: roots, poles: [0.5], rate: 1 kHz}, {form: roots, poles: [0.5], rate: 2 "
            "kHz}]\n",
            r"6:3: loop.controller: blocks at 1000 Hz and 2000 Hz",
        ),
    ],
)
def test_faults_stand_at_their_place(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bearing.yaml"
    path.write_text(HEAD + text)
    with pytest.raises(LabpipeError, match=message):
        open_bearing(path).settings()


@pytest.mark.parametrize(
    ("blocks", "message"),
    [
        ([{"form": "pid", "proportional": 1.0, "derivative": 1e-3}], "more zeros than poles"),
        ([{"form": "roots", "poles": [0.5], "rate": 1e3}], "the loop at 20000 Hz"),
    ],
)
def test_what_cannot_be_sampled_is_refused(blocks: list[dict[str, object]], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        sampled_loop(Suspended(ControlLoop(controller=blocks), 33106.0, 0.065))


def test_entries_of_blocks_can_be_unknowns() -> None:
    notch = {"form": "notch", "frequency": 300.0}
    file = MagneticFile(
        kind="magnetic-bearing",
        mass=0.065,
        frequency=50.0,
        negative_stiffness=33106.0,
        loop=ControlLoop(controller=[PID, notch]),
    )
    assert unknown(file, "controller.2.frequency").value == 300.0
    assert with_unknowns(file, {"controller.2.frequency": 310.0}).loop.controller[1].frequency == 310.0
    for name, message in (
        ("controller.3.frequency", "no block"),
        ("controller.2.form", "not a number of a block"),
        ("controller.1.zero", "give it as zero of block 1 of the controller"),
    ):
        with pytest.raises(ConfigError, match=message):
            unknown(file, name)
