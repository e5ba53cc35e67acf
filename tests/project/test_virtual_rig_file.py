"""Virtual rig files: every shipped one is read, every kind of the table has one, faults stand at their
place.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from labpipe.errors import ConfigError
from labpipe.project.marked_yaml import load_marked
from labpipe.project.simulate import load_virtual_rig
from labpipe.records.settings import settings_of
from labpipe.simulate.virtual_rigs import VIRTUAL_RIGS, simulate

CONFIGS = Path(__file__).parents[2] / "configs"


def kind_of(path: Path) -> str:
    tree = load_marked(path)
    return tree.content["kind"].text if "kind" in tree.content else ""


SHIPPED = sorted(path for path in CONFIGS.glob("*.yaml") if kind_of(path) in VIRTUAL_RIGS.names())


def test_the_name_of_a_run_is_no_path_and_has_a_file_of_its_own(labpipe, tmp_path: Path) -> None:
    """A state of a rig named as a folder was written outside of the output, two alike in one file."""
    states = "states: {../../x: {}, a/b: {}, a b: {}}, cells_around: 24, cells_across: 4, duration: 2 s"
    rig = f"{{kind: virtual-journal-rig, rotor: {CONFIGS / 'rotors/mendes.yaml'}, {states}}}"
    (tmp_path / "rig.yaml").write_text(rig, encoding="utf-8")
    command = ("simulate", tmp_path / "rig.yaml", "-o", tmp_path / "a/b/out", "--run")
    assert labpipe(*command, "../../x-y").code == 0
    files = {path.name for path in (tmp_path / "a").rglob("*") if path.is_file()}
    assert files == {"..-..-x-y.parquet", "truth.json"}
    ended = labpipe(*command, "a/b-y", "--run", "a b-y")
    assert ended.code == 2 and "runs 'a/b-y' and 'a b-y' would write the same file" in ended.err


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_rig_is_read_into_the_class_of_its_kind(path: Path) -> None:
    rig = load_virtual_rig(path)
    assert isinstance(rig, VIRTUAL_RIGS.load(kind_of(path)).settings) and dataclasses.is_dataclass(rig)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("three-dof", "mass=[1 kg, 2 kg, []]", "mass does not fit 3 dofs"),
        ("virtual-hmb", "pedestal_mass=0 kg", "pedestal_mass must be positive"),
        ("virtual-hmb", "levitation.bearings=0", "bearings must be positive"),
        ("virtual-hmb", "levitation.corner=0 Hz", "corner must be positive"),
        ("virtual-hmb", "actuator_gain=0 N/V", "actuator_gain must be positive"),
        ("virtual-hmb", "pedestal_damping=-1 N.s/m", "pedestal_damping must not be negative"),
        ("virtual-hmb", "radial_force=-1 N", "radial_force must be positive"),
        (
            "virtual-hmb-loop",
            "levitation.loop.sensor=0 V/m",
            "sensor must not be zero; nothing closes the loop",
        ),
        ("virtual-levitated", "unbalance=-1 g.mm", "unbalance must not be negative"),
        ("virtual-levitated", "damping=-100 N.s/m", "damping must not be negative"),
        ("virtual-decay", "noise=-1 um", "noise must not be negative"),
        ("virtual-decay", "joint=-0.3 %", "joint must not be negative"),
        ("virtual-decay", "interval=20 ms", "frequencies must lie between 50 Hz, a period after a hit"),
        (
            "virtual-sweep",
            "duration=24 us",
            "band must lie between 41666.7 Hz, a period in a run, and 256 Hz",
        ),
        ("virtual-white-noise", "block=5 us", "a block holds less than a sample at 1024 Hz"),
        ("virtual-white-noise", "unbalance=-1 g.mm", "unbalance must not be negative"),
        # One direction without a restoring force: a pole at +509 rad/s, sqrt(620e3 / 2.4).
        (
            "virtual-white-noise",
            "stiffness=[[-620 kN/m, 0 N/m], [0 N/m, 690 kN/m]]",
            "the rotor is unstable with this stiffness and damping",
        ),
        ("virtual-journal", "unbalance=-1 g.mm", "unbalance must not be negative"),
        ("virtual-rotor", "probe_noise=-1 um", "probe_noise must not be negative"),
        ("virtual-rotor", "gain=-1 %", "gain must not be negative"),
        ("virtual-floating", "runout=[5 um, -2 um]", "runout must not be negative"),
        ("virtual-floating", "shaft_noise=-1 N", "shaft_noise must not be negative"),
        ("virtual-ball-bearing", "deep_groove.preloads=[427 N, -701 N]", "preloads must not be negative"),
        ("virtual-ball-bearing", "mountings=0", "mountings must be positive"),
        ("virtual-ball-bearing", "sampling.spacing=0 Hz", "spacing must be positive"),
        ("virtual-ball-bearing", "damping_factor=-1 us", "damping_factor must not be negative"),
    ],
)
def test_a_rig_that_cannot_be_is_refused(name: str, change: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_virtual_rig(CONFIGS / f"{name}.yaml", [change])


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_no_noise_is_below_zero(path: Path) -> None:
    noise = getattr(load_virtual_rig(path), "noise", None)
    for name in settings_of(type(noise)) if dataclasses.is_dataclass(noise) else ():
        with pytest.raises(ConfigError, match=f"{name} must (not be negative|be positive)"):
            dataclasses.replace(noise, **{name: -1.0})


def test_what_a_logger_cannot_hold_is_refused() -> None:
    """Of 16 bits, cN end at 327.67 N: more wrapped round."""
    for name, change, said in (
        ("virtual-ball-bearing", "sampling.force=1 kN", r"force \[cN\]: beyond 32767, where the logger ends"),
        ("virtual-decay", "amplitude=1 km", r"y \[nm\]: beyond 2147483647, where the logger ends"),
    ):
        rig = load_virtual_rig(CONFIGS / f"{name}.yaml", [change])
        with pytest.raises(ConfigError, match=said):
            simulate(rig, 1, ["6208-427N-up-x" if "ball" in name else "struck"])


def test_every_kind_has_a_shipped_example() -> None:
    assert {kind_of(path) for path in SHIPPED} == set(VIRTUAL_RIGS.names())


@pytest.mark.parametrize("kind", VIRTUAL_RIGS.names())
def test_every_kind_explains_its_entries(kind: str) -> None:
    declared = settings_of(VIRTUAL_RIGS.load(kind).settings)
    assert declared and all(setting.help for setting, _ in declared.values())


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_an_unknown_entry_is_named_with_its_place(path: Path) -> None:
    with pytest.raises(ConfigError, match="--set nonsense=1: nonsense: unknown key"):
        load_virtual_rig(path, ["nonsense=1"])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name: x\n", "rig.yaml:1:1: kind: is missing; known: virtual-mdof-rig"),
        (
            "kind: virtual-mdof\n",
            "rig.yaml:1:1: kind: unknown virtual rig 'virtual-mdof'; did you mean 'virtual-mdof-rig'?",
        ),
        ("kind: [a]\n", "kind: is missing"),
        ("- kind\n", "rig.yaml:1:1: a mapping of keys to values is needed"),
    ],
)
def test_a_rig_of_no_kind_is_refused(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "rig.yaml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_virtual_rig(tmp_path / "rig.yaml")
    assert said in str(caught.value)


def test_the_kind_may_be_set_from_outside(tmp_path: Path) -> None:
    text = (CONFIGS / "three-dof.yaml").read_text()
    (tmp_path / "rig.yaml").write_text(
        "\n".join(line for line in text.splitlines() if not line.startswith("kind:"))
    )
    assert load_virtual_rig(tmp_path / "rig.yaml", ["kind=virtual-mdof-rig"]) == load_virtual_rig(
        CONFIGS / "three-dof.yaml"
    )
