"""Geometry files: CSV by hand, universal files as another program (pyuff) writes them, and shapes as that
program reads them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyuff

from labpipe.errors import DataError
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.modal.settings import ModalSettings
from labpipe.project.exports import shape_table
from labpipe.raw_files.geometry import read_geometry
from labpipe.raw_files.uff_write import write_shapes_uff
from labpipe.records.fit_details import Modes
from labpipe.records.identification import Fit
from labpipe.records.response import FrequencyResponse, Port
from tests.methods.modal.structures import beam, beam_geometry


@pytest.fixture
def table(tmp_path: Path):
    def write(text: str, name: str = "points.csv") -> Path:
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return write


def test_a_table_of_points(table) -> None:
    found = read_geometry(
        table("# plate\npoint; x [mm]; y [in]; z; to\na;100;1;0.5;b c\nb;200;0;0;\nc;0;0;0;a\n")
    )
    assert found.names == ("a", "b", "c")
    np.testing.assert_allclose(found.positions, [[0.1, 0.0254, 0.5], [0.2, 0, 0], [0, 0, 0]])
    assert found.lines.tolist() == [[0, 1], [0, 2], [2, 0]]
    flat = read_geometry(table("point,x [cm],y [cm]\n1,1,2\n"))
    np.testing.assert_allclose(flat.positions, [[0.01, 0.02, 0]])
    assert flat.lines.shape == (0, 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("point,x [mm],y [mm]\n1,0,zero\n", r"points.csv:2: the coordinate 'zero' is not a number"),
        ("point,x [mm],y [mm]\n1,0\n", r"points.csv:2: the coordinate '' is not a number"),
        ("point,x [mn],y [mm]\n1,0,0\n", r"points.csv:2: unknown unit 'mn'"),
        ("point,x [mm],q [mm]\n1,0,0\n", r"points.csv:1: column 'q \[mm\]' is unknown"),
        ("point,x [mm]\n1,0\n", r"points.csv:1: column 'y' is missing"),
        ("point,x [mm],y [mm],to\n1,0,0,2,3\n2,0,1\n3,1,0\n", r"points.csv:2: a row has more cells than"),
        ("point,x [mm],y [mm],to\n1,0,0,2\n", r"points.csv:2: there is no point '2' to draw a line to"),
        ("point,x [mm],y [mm]\n1,0,0\n1,1,1\n", r"points.csv: point '1' stands twice"),
        ("point,x [mm],y [mm]\n", r"points.csv: holds no point"),
        ("", r"points.csv: holds no point"),
    ],
)
def test_faults_of_a_table_are_said_with_their_place(table, text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read_geometry(table(text))


def written(path: Path, *sets: dict[str, object]) -> Path:
    file = pyuff.UFF(str(path))
    for one in sets:
        file.write_sets(one, "add")
    return path


def test_nodes_lines_and_elements_of_another_program(tmp_path: Path) -> None:
    nodes, x, y, z = [11, 12, 15, 20], [0.0, 1.5, 1.5, 0.0], [0.0, 0.0, -2.5, -2.5], [0.0, 0.25, 0.5, 0.75]
    # Millimetres: SI value = value / factor.
    units = pyuff.prepare_164(
        units_code=5,
        units_description="mm",
        temp_mode=1,
        length=1000.0,
        force=1.0,
        temp=1.0,
        temp_offset=273.15,
    )
    line = pyuff.prepare_82(trace_num=1, n_nodes=4, color=1, id="line", nodes=np.array([11, 12, 0, 20]))
    single = pyuff.prepare_15(node_nums=nodes, def_cs=[0] * 4, disp_cs=[0] * 4, color=[0] * 4, x=x, y=y, z=z)
    found = read_geometry(written(tmp_path / "test.uff", units, single, line))
    assert found.names == ("11", "12", "15", "20") and found.lines.tolist() == [[0, 1]]
    np.testing.assert_allclose(found.positions, 1e-3 * np.array([x, y, z]).T, rtol=1e-5)
    arrays = [np.array(values) for values in (nodes, [0] * 4, [0] * 4, [0] * 4)]
    keys = ("node_nums", "def_cs", "disp_cs", "color")
    double = pyuff.prepare_2411(
        **dict(zip(keys, arrays, strict=True)), x=np.array(x) / 3, y=np.array(y), z=np.array(z)
    )
    element = {
        "element_nums": 1,
        "fe_descriptor": 44,
        "phys_table": 1,
        "mat_table": 1,
        "color": 1,
        "num_nodes": 4,
        "nodes_nums": nodes,
    }
    rod = {
        **element,
        "fe_descriptor": 11,
        "beam_orientation": 0,
        "beam_foreend_cross": 1,
        "beam_aftend_cross": 1,
    }
    rod |= {"num_nodes": 2, "nodes_nums": [11, 15]}
    found = read_geometry(written(tmp_path / "mesh.unv", double, {"type": 2412, 44: [element], 11: [rod]}))
    np.testing.assert_allclose(found.positions[:, 0], np.array(x) / 3, rtol=1e-15)
    assert found.lines.tolist() == [[0, 1], [0, 2], [1, 2], [2, 3], [3, 0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("    -1\n    15\n         1         0         0\n    -1\n", "the record 15 cannot be read"),
        ("    -1\n    15\n 1 0 0 0 0. 0. 0.\n 1 0 0 0 1. 0. 0.\n    -1\n", "node 1 lies at two places"),
        ("    -1\n    82\n         1         1         1\nname\n         1\n    -1\n", "holds no nodes"),
        ("not a universal file", "holds no nodes"),
        ("    -1\n    1\xb2\n    -1\n", "holds no nodes"),
        (
            "    -1\n    15\n 1 0 0 0 0. 0. 0.\n    -1\n    -1\n    82\n 1 2 1\nname\n 1 9\n    -1\n",
            "leads to node 9, which is not in",
        ),
    ],
)
def test_faults_of_a_universal_file_are_said(table, text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read_geometry(table(text, "points.uff"))


@pytest.fixture(scope="module")
def fit() -> Fit:
    (found,) = identify(
        beam(1), FitSettings("modal", name="beam", model_settings=ModalSettings(structure=beam_geometry()))
    )
    return found


def test_shapes_are_read_by_another_program(fit: Fit, tmp_path: Path) -> None:
    """Names that are not numbers ("left") make the nodes count from 1: point n of the beam is node n + 1."""
    assert fit.detail(Modes) is not None
    write_shapes_uff(tmp_path / "shapes.uff", [fit])
    file = pyuff.UFF(str(tmp_path / "shapes.uff"))
    assert file.get_set_types().tolist() == [164, 15, 82, 55, 55, 55]
    np.testing.assert_allclose(file.read_sets(1)["x"], 0.1 * np.arange(11))
    for n in range(3):
        mode = file.read_sets(3 + n)
        w, zeta = 2 * np.pi * fit.detail(Modes).frequency[n], fit.detail(Modes).damping_ratio[n]
        assert mode["mode_n"] == n + 1 and mode["analysis_type"] == 3
        assert mode["eig"] == pytest.approx(complex(-zeta * w, w * np.sqrt(1 - zeta**2)), rel=1e-5)
        np.testing.assert_allclose(mode["r3"][1:-1], fit.detail(Modes).shapes[:, n], atol=1e-5)
        assert not mode["r1"].any() and not mode["r3"][[0, -1]].any()
    again = read_geometry(tmp_path / "shapes.uff")
    np.testing.assert_array_equal(again.lines, beam_geometry().lines)


def test_modal_a_and_b_scale_shapes_to_residues(tmp_path: Path) -> None:
    """By the state-space form of Allemang (1999), a_r = psi^T (2 lambda M + C) psi and b_r = -lambda a_r, of
    two masses with one damper to ground, whose modes are complex; psi the eigenvectors of scipy, largest 1.
    """
    mass, stiffness = np.diag([1.0, 1.5]), np.array([[3e5, -1e5], [-1e5, 2.5e5]])
    damping = np.array([[30.0, -2.0], [-2.0, 2.0]])
    frequency = np.arange(30.0, 150.0, 0.1)
    w = 2 * np.pi * frequency[:, None, None]
    matrix = np.linalg.inv(stiffness + 1j * w * damping - w**2 * mass)
    noise = np.random.default_rng(5).normal(size=(2, *matrix.shape)) * 1e-6 * np.abs(matrix).max()
    ports = tuple(Port(f"{n}.z", f"{n}.z", f"{n}.z") for n in (1, 2))
    response = FrequencyResponse(frequency, matrix + noise[0] + 1j * noise[1], ports, ports, name="masses")
    write_shapes_uff(tmp_path / "masses.uff", identify(response, FitSettings("modal", name="masses")))
    zero, one = np.zeros((2, 2)), np.eye(2)
    state = np.block([[zero, one], [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)]])
    poles, vectors = np.linalg.eig(state)
    for n, index in enumerate(np.argsort(np.where(poles.imag > 0, poles.imag, np.inf))[:2]):
        psi = vectors[:2, index] / vectors[np.argmax(np.abs(vectors[:2, index])), index]
        modal_a = psi @ (2 * poles[index] * mass + damping) @ psi
        mode = pyuff.UFF(str(tmp_path / "masses.uff")).read_sets(2 + n)
        assert mode["modal_a"] == pytest.approx(modal_a, rel=1e-3)
        assert mode["modal_b"] == pytest.approx(-poles[index] * modal_a, rel=1e-3)


def test_directions_alone_are_those_of_one_node_and_tilts_are_left_out(fit: Fit, tmp_path: Path) -> None:
    """Dofs x, z and by of a shaft: the shape's first two rows stand in x and z of node 1."""
    assert fit.detail(Modes) is not None
    shaft = replace(
        fit.detail(Modes),
        geometry=None,
        dofs=("x", "z", "by"),
        points=("x", "z", "by"),
        shapes=fit.detail(Modes).shapes[:3],
    )
    write_shapes_uff(tmp_path / "shaft.uff", [replace(fit, details=(shaft,))])
    mode = pyuff.UFF(str(tmp_path / "shaft.uff")).read_sets(2)
    assert mode["node_nums"].tolist() == [1] and not mode["r2"].any()
    np.testing.assert_allclose([mode["r1"][0], mode["r3"][0]], shaft.shapes[:2, 0], atol=1e-5)
    with pytest.raises(DataError, match="has tilts only"):
        write_shapes_uff(
            tmp_path / "tilts.uff", [replace(fit, details=(replace(shaft, dofs=("bx", "by", "bz")),))]
        )


def test_shapes_as_a_table(fit: Fit) -> None:
    assert fit.detail(Modes) is not None
    table = shape_table([fit])
    assert len(table) == 27 and table["x_m"].tolist()[:2] == pytest.approx([0.1, 0.2])
    second = table[table["mode"] == 2]
    np.testing.assert_allclose(second["real"] + 1j * second["imaginary"], fit.detail(Modes).shapes[:, 1])
    assert second["frequency_hz"].iloc[0] == fit.detail(Modes).frequency[1]
