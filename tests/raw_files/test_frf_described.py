"""FRF tables and variables of any layout: every layout gives the closed form it was written from, every fault
its place.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from labpipe.errors import ConfigError, DataError
from labpipe.raw_files.frf_csv import read_frf_csv
from labpipe.raw_files.frf_described import Dofs, read_described
from labpipe.records.frf_layout import ElementColumns, FrfColumns, FrfLayout, WindowedSettings

FREQUENCY = np.arange(2.0, 9.0, 0.5)
OMEGA = 2 * np.pi * FREQUENCY
# 1 / (k - m w^2 + j w c) of 2 kN/m, 1 kg, 3 N.s/m, and its accelerance [m/(N.s^2)].
H = 1 / (2000.0 - OMEGA**2 + 3j * OMEGA)
A = -(OMEGA**2) * H
X_F = Dofs(("x",), ("f",))
SIGNED = [f"{value.real:.12e}{value.imag:+.12e}" for value in H]


def rows(*columns: np.ndarray, between: str = " ", decimal: str = ".") -> str:
    return "".join(
        between.join(f"{value:.12e}".replace(".", decimal) for value in row) + "\n"
        for row in zip(*columns, strict=True)
    )


def read(path: Path, text: str, columns: dict[str, str], dofs: Dofs = X_F, **entries: object):
    path.write_text(text)
    return read_described(path, FrfLayout(file=path.name, columns=FrfColumns(**columns), **entries), dofs)


SI = {"form": "receptance"}
LAYOUTS = [
    pytest.param(
        rows(FREQUENCY, H.real, H.imag), {"frequency": "1", "re": "2", "im": "3"}, id="blanks, no header"
    ),
    pytest.param(
        "f re im\n" + rows(FREQUENCY, H.real, H.imag), {"frequency": "f", "re": "re", "im": "im"}, id="names"
    ),
    pytest.param(
        rows(H.real, H.imag, OMEGA, between=",  "), {"omega": "3", "re": "1", "im": "2"}, id="omega"
    ),
    pytest.param(
        rows(FREQUENCY, abs(H), np.rad2deg(np.angle(H)), between=";", decimal=","),
        {"frequency": "1", "amplitude": "2", "phase_deg": "3"},
        id="degrees, decimal commas",
    ),
    pytest.param(
        rows(FREQUENCY, abs(H), np.angle(H) + 2 * np.pi),
        {"frequency": "1", "amplitude": "2", "phase_rad": "3"},
        id="radians",
    ),
    pytest.param(
        rows(FREQUENCY, 20 * np.log10(abs(H)), np.rad2deg(np.angle(H))),
        {"frequency": "1", "amplitude_db": "2", "phase_deg": "3"},
        id="dB",
    ),
    pytest.param(
        "".join(f"{f};{value}j\n" for f, value in zip(FREQUENCY, SIGNED, strict=True)),
        {"frequency": "1", "complex": "2"},
        id="complex, j",
    ),
    pytest.param(
        "f\tH\n"
        + "".join(
            f"{f:g}\t({value}i)\n".replace(".", ",") for f, value in zip(FREQUENCY, SIGNED, strict=True)
        ),
        {"frequency": "f", "complex": "H"},
        id="complex, i, commas",
    ),
    pytest.param(
        "f [kHz],r,i\n" + rows(FREQUENCY / 1e3, H.real, H.imag, between=","),
        {"frequency": "1", "re": "r", "im": "i"},
        id="kHz",
    ),
    pytest.param(
        rows(H.real, H.imag),
        {"start": "2 Hz", "step": "0.5 Hz", "re": "1", "im": "2"},
        id="no frequency column",
    ),
    pytest.param(
        "a,a,a\n" + rows(FREQUENCY, H.real, H.imag, between=","),
        {"frequency": "1", "re": "2", "im": "3"},
        id="one name for all",
    ),
]


@pytest.mark.parametrize(("text", "columns"), LAYOUTS)
def test_every_layout_gives_the_response_it_was_written_from(
    tmp_path: Path, text: str, columns: dict[str, str]
) -> None:
    response = read(tmp_path / "h.txt", text, columns, **SI)
    np.testing.assert_allclose(response.frequency, FREQUENCY, rtol=1e-11)
    np.testing.assert_allclose(response.matrix[:, 0, 0], H, rtol=1e-10)
    assert (response.form, response.outputs[0].dof, response.outputs[0].angle, response.inputs[0].label) == (
        "receptance",
        "x",
        0.0,
        "f",
    )


@pytest.mark.parametrize(
    ("unit", "form", "factor"),
    [
        ("g/N", "accelerance", 9.80665),
        ("g/lbf", "accelerance", 9.80665 / 4.4482216152605),
        ("mg/N", "accelerance", 9.80665e-3),
        ("m/s^2/N", "accelerance", 1.0),
        ("mil/lbf", "receptance", 2.54e-5 / 4.4482216152605),
        ("in/lbf", "receptance", 0.0254 / 4.4482216152605),
        ("mm/kN", "receptance", 1e-6),
        ("mm/(N.s)", "mobility", 1e-3),
    ],
)
def test_the_unit_says_form_and_scale(tmp_path: Path, unit: str, form: str, factor: float) -> None:
    """Factors of the definitions: g = 9.80665 m/s^2, lbf = 4.4482216152605 N, in = 25.4 mm."""
    response = read(
        tmp_path / "h.txt",
        rows(FREQUENCY, A.real, A.imag),
        {"frequency": "1", "re": "2", "im": "3"},
        unit=unit,
    )
    assert response.form == form
    np.testing.assert_allclose(response.matrix[:, 0, 0], A * factor, rtol=1e-10)


def test_several_elements_of_one_file_with_their_coherence(tmp_path: Path) -> None:
    """Two responses to one force: H and 3 H."""
    coherence = np.linspace(0.9, 1.0, FREQUENCY.size)
    elements = {
        name: ElementColumns(re=str(2 + 3 * n), im=str(3 + 3 * n), coherence=str(4 + 3 * n))
        for n, name in enumerate(("x", "y/f"))
    }
    text = rows(FREQUENCY, H.real, H.imag, coherence, 3 * H.real, 3 * H.imag, coherence**2)
    response = read(tmp_path / "h.txt", text, {"frequency": "1"}, Dofs((), ("f",)), elements=elements, **SI)
    np.testing.assert_allclose(response.matrix[:, :, 0], np.column_stack([H, 3 * H]), rtol=1e-10)
    np.testing.assert_allclose(
        response.coherence[:, :, 0], np.column_stack([coherence, coherence**2]), rtol=1e-10
    )
    assert [port.label for port in response.outputs] == ["x", "y"]


def matrix() -> np.ndarray:
    """(n_frequency, 2 outputs, 3 inputs), all elements different."""
    return H[:, None, None] * (1 + np.arange(6).reshape(2, 3))


@pytest.mark.parametrize(
    ("stored", "axes"),
    [
        (matrix(), ()),
        (matrix().transpose(1, 2, 0), ()),
        (matrix().transpose(2, 1, 0), ("input", "output", "frequency")),
    ],
)
@pytest.mark.parametrize("save", [savemat, lambda path, arrays: h5_of(path, arrays)], ids=["mat", "hdf5"])
def test_a_matrix_of_variables_in_any_order(
    tmp_path: Path, stored: np.ndarray, axes: tuple[str, ...], save: Callable[[Path, dict], None]
) -> None:
    path = tmp_path / "h.mat"
    save(path, {"H": stored, "f": FREQUENCY})
    layout = FrfLayout(file="h.mat", variables=FrfColumns(frequency="f", matrix="H"), axes=axes, unit="mm/N")
    response = read_described(path, layout, Dofs(("x", "y"), ("a", "b", "c")))
    np.testing.assert_allclose(response.matrix, matrix() * 1e-3, rtol=1e-12)


def h5_of(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values


def test_the_structures_of_an_analyser(tmp_path: Path) -> None:
    """Axis by start and increment, values in a structure, as Simcenter Testlab exports them."""
    axis = {"start_value": 2.0, "increment": 0.5, "number_of_values": 14}
    savemat(tmp_path / "h.mat", {"FRF": {"x_values": axis, "y_values": {"values": H[:, None]}}})
    columns = FrfColumns(
        start="FRF.x_values.start_value", step="FRF.x_values.increment", complex="FRF.y_values.values"
    )
    response = read_described(
        tmp_path / "h.mat", FrfLayout(file="h.mat", variables=columns, form="receptance"), X_F
    )
    np.testing.assert_allclose(response.frequency, FREQUENCY, rtol=1e-12)
    np.testing.assert_allclose(response.matrix[:, 0, 0], H, rtol=1e-12)


def test_columns_of_a_table_that_is_no_text(tmp_path: Path) -> None:
    """Named or counted from 1; coherence as it stands."""
    coherence = np.linspace(0.5, 1.0, FREQUENCY.size)
    table = {"f": FREQUENCY, "re": H.real, "im": H.imag, "g": coherence}
    pq.write_table(pa.table(table), tmp_path / "h.parquet")
    for columns in (
        {"frequency": "f", "re": "re", "im": "im", "coherence": "g"},
        {"frequency": "1", "re": "2", "im": "3", "coherence": "4"},
    ):
        layout = FrfLayout(file="h.parquet", columns=FrfColumns(**columns), **SI)
        response = read_described(tmp_path / "h.parquet", layout, X_F)
        np.testing.assert_allclose(response.matrix[:, 0, 0], H, rtol=1e-12)
        np.testing.assert_array_equal(response.coherence[:, 0, 0], coherence)


def test_a_gap_in_a_table_that_is_no_text_is_named_by_its_row(tmp_path: Path) -> None:
    imaginary = np.where(np.arange(FREQUENCY.size) == 3, np.nan, H.imag)
    pq.write_table(pa.table({"f": FREQUENCY, "re": H.real, "im": imaginary}), tmp_path / "h.parquet")
    layout = FrfLayout(file="h.parquet", columns=FrfColumns(frequency="f", re="re", im="im"), **SI)
    with pytest.raises(DataError, match=r"h\.parquet: row 4: .*'im' has no number at value 4"):
        read_described(tmp_path / "h.parquet", layout, X_F)


def test_a_square_matrix_needs_the_order_of_its_dimensions(tmp_path: Path) -> None:
    savemat(tmp_path / "h.mat", {"H": matrix()[:, :, :2], "f": FREQUENCY})
    layout = FrfLayout(file="h.mat", variables=FrfColumns(frequency="f", matrix="H"), form="receptance")
    with pytest.raises(
        DataError, match=r"could be ordered in several ways; name their order, for example axes: \[output"
    ):
        raise_text(tmp_path / "h.mat", layout, Dofs(("x", "y"), ("a", "b")))
    layout = FrfLayout(
        file="h.mat",
        variables=FrfColumns(frequency="f", matrix="H"),
        form="receptance",
        axes=("frequency", "output", "input"),
    )
    np.testing.assert_allclose(
        read_described(tmp_path / "h.mat", layout, Dofs(("x", "y"), ("a", "b"))).matrix, matrix()[:, :, :2]
    )


def raise_text(path: Path, layout: FrfLayout, dofs: Dofs = X_F) -> None:
    try:
        read_described(path, layout, dofs)
    except DataError as error:
        raise DataError(str(error)) from None


AMPLITUDE = {"frequency": "1", "amplitude": "2", "phase_deg": "3"}
GOOD = rows(FREQUENCY, H.real, H.imag)
RE_IM = {"frequency": "1", "re": "2", "im": "3"}


@pytest.mark.parametrize(
    ("text", "columns", "entries", "fault"),
    [
        (GOOD + "9 1 x\n", RE_IM, SI, "h.txt:15: column '3': 'x' is not a number"),
        (GOOD + "9 1\n", RE_IM, SI, "h.txt:15: 2 fields, 3 are needed as in the rows before"),
        (GOOD + "9 1 nan\n", RE_IM, SI, "h.txt:15: column '3' has no number at value 15"),
        (GOOD + "8 1 1\n", RE_IM, SI, "h.txt:15: column '1': the frequency does not increase (8)"),
        (GOOD, {**RE_IM, "im": "4"}, SI, "h.txt: no column 4: the table has 3"),
        ("f Re Im\n" + GOOD, {**RE_IM, "im": "Imm"}, SI, "h.txt: no column 'Imm'; did you mean 'Im'?"),
        (
            "f r r\n" + GOOD,
            {**RE_IM, "re": "r"},
            SI,
            "h.txt: the column 'r' appears 2 times; write its number, counted from 1",
        ),
        (
            GOOD,
            {"frequency": "1", "complex": "2"},
            SI,
            "h.txt: column '2' has no imaginary part anywhere; an amplitude needs its phase",
        ),
        (GOOD, AMPLITUDE, SI, "holds the negative amplitude"),
        (
            "f;H\n" + "1;1+2j\n2;2+1j\n",
            {"frequency": "f", "re": "H", "im": "f"},
            SI,
            "h.txt:2: column 'H' holds complex numbers",
        ),
        (
            "f,a (um/N),p\n1,2,3\n2,3,4\n",
            {"frequency": "f", "amplitude": "2", "phase_deg": "p"},
            SI,
            "is in um/N by the file's own header",
        ),
        (
            "f,a,p [rad]\n1,2,3\n2,3,4\n",
            {"frequency": "f", "amplitude": "2", "phase_deg": "3"},
            SI,
            "in rad by the file's own header; write",
        ),
        (
            "f,a,p [mrad]\n1,2,3\n2,3,4\n",
            {"frequency": "f", "amplitude": "2", "phase_rad": "3"},
            SI,
            "in mrad by the file's own header; write",
        ),
        (
            "f,a [m/N],p\n1,2,3\n2,3,4\n",
            {"frequency": "f", "amplitude_db": "a [m/N]", "phase_deg": "3"},
            SI,
            "'a [m/N]' is in m/N by the file's own header, not in decibels; write amplitude",
        ),
        (
            "f,a [dB],p\n1,2,3\n2,3,4\n",
            {"frequency": "f", "amplitude": "2", "phase_deg": "3"},
            SI,
            "'2' is in decibels by the file's own header; write amplitude_db",
        ),
        (
            "f,a,p,c\n1,2,3,95\n2,3,4,97\n",
            {"frequency": "f", "amplitude": "2", "phase_deg": "3", "coherence": "c"},
            SI,
            "holds the coherence 97; they lie between 0 and 1, and are not in per cent",
        ),
        (
            "f,v [m/s],p\n1,2,3\n2,3,4\n",
            {"frequency": "f", "amplitude": "2", "phase_deg": "3"},
            SI,
            "multiples are; divide a response by the force at which it was measured",
        ),
        (
            "f [N],a,p\n1,2,3\n2,3,4\n",
            {"frequency": "1", "amplitude": "2", "phase_deg": "3"},
            SI,
            "in N by the file's own header, which is no",
        ),
    ],
)
def test_faults_have_their_place(
    tmp_path: Path, text: str, columns: dict[str, str], entries: dict[str, str], fault: str
) -> None:
    with pytest.raises(DataError) as caught:
        read(tmp_path / "h.txt", text, columns, **entries)
    assert fault in str(caught.value)


@pytest.mark.parametrize(
    ("entries", "fault"),
    [
        ({}, "one of 'file' and 'each' is needed"),
        ({"file": "a", "each": ("b",)}, "one of 'file' and 'each' is needed"),
        ({"file": "a", "unit": "g/N"}, "neither 'columns' nor 'variables'"),
        ({"file": "a", "columns": {"frequency": "1", "re": "2", "im": "3"}}, "form or unit is needed"),
        (
            {"file": "a", "columns": {"frequency": "1", "re": "2", "im": "3"}, "unit": "kg"},
            "'kg' is not a unit of an FRF",
        ),
        ({"file": "a", "columns": {"frequency": "1"}, "form": "mobility"}, "name no element of H"),
        (
            {"file": "a", "columns": {"frequency": "1", "re": "2"}, "form": "mobility"},
            "re alone is not a complex number",
        ),
        (
            {"file": "a", "columns": {"re": "2", "im": "3"}, "form": "mobility"},
            "one frequency axis is needed",
        ),
        (
            {"file": "a", "columns": {"start": "2 Hz", "re": "2", "im": "3"}, "form": "mobility"},
            "one frequency axis is needed",
        ),
        (
            {
                "file": "a",
                "variables": {"frequency": "f", "matrix": "H"},
                "form": "mobility",
                "axes": ("output",),
            },
            "must name frequency",
        ),
        ({"file": "a", "averages": 1}, "the coherence of one average"),
        ({"file": "a", "averages": 2, "windowed": WindowedSettings(1.0)}, "noise of a windowed hit"),
    ],
)
def test_descriptions_that_cannot_be_meant(entries: dict[str, object], fault: str) -> None:
    with pytest.raises(ConfigError, match=fault):
        FrfLayout(**entries)


def test_parts_of_one_number_are_of_one_length(tmp_path: Path) -> None:
    np.savez(tmp_path / "h.npz", f=FREQUENCY, re=H.real, im=H.imag[:1])
    columns = FrfColumns(frequency="f", re="re", im="im")
    with pytest.raises(DataError, match="'re' has 14 values, 'im' 1"):
        read_described(tmp_path / "h.npz", FrfLayout(file="h.npz", variables=columns, **SI), X_F)


@pytest.mark.parametrize(
    "comment",
    ["# Form: mobility", "#form = mobility", "# of today\n\n # form : mobility", '"# form: mobility"'],
)
def test_the_form_above_a_table_is_read_as_people_write_it(tmp_path: Path, comment: str) -> None:
    (tmp_path / "h.csv").write_text(f"{comment}\nfrequency_hz,x/f:re,x/f:im\n1,1,2\n2,1,2\n")
    assert read_frf_csv(tmp_path / "h.csv").form == "mobility"


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("# a\n# form: mobilty\nfrequency_hz,x/f:re,x/f:im\n1,1,2\n", r"h\.csv:2: unknown form 'mobilty'"),
        ("frequency_hz,x/f:re,x/f:im,x/f:var,x/f:var\n1,1,2,3,4\n", "'x/f:var' appears 2 times"),
        ("frequency_hz,x/f:re,x/f:im,x/f:var\n1,1,2,-3\n", "holds the negative variance -3"),
    ],
)
def test_faults_of_a_table_of_frfs(tmp_path: Path, text: str, fault: str) -> None:
    (tmp_path / "h.csv").write_text(text)
    with pytest.raises(DataError, match=fault):
        read_frf_csv(tmp_path / "h.csv")


@pytest.mark.parametrize(
    ("units", "what"), [("Hz,um/N,um/N", "'x/f:re' is in um/N"), ("kHz,m/N,m/N", "'frequency_hz' is in kHz")]
)
def test_a_row_of_units_that_are_not_si_is_no_table_of_ours(tmp_path: Path, units: str, what: str) -> None:
    """Its numbers were taken as m/N at Hz."""
    (tmp_path / "h.csv").write_text(f"frequency_hz,x/f:re,x/f:im\n{units}\n1,2,3\n2,3,4\n")
    with pytest.raises(DataError, match=what):
        read_frf_csv(tmp_path / "h.csv")
    (tmp_path / "h.csv").write_text("frequency_hz,x/f:re,x/f:im\nHz,m/N,m/N\n1,2,3\n2,3,4\n")
    assert read_frf_csv(tmp_path / "h.csv").matrix[0, 0, 0] == 2 + 3j
