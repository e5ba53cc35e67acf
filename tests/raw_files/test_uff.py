"""Universal files: labpipe's writer and reader against each other and against pyuff, an independent
program.
"""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import pyuff

from labpipe.errors import DataError
from labpipe.project.ready_response import read_frf_file
from labpipe.raw_files.table import open_table
from labpipe.raw_files.uff import read_uff
from labpipe.raw_files.uff_read import UffTable, read_frf_uff
from labpipe.raw_files.uff_write import write_frf_uff, write_recording_uff
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse, Port

FREQUENCY = 10 + 0.125 * np.arange(9)


def response(
    rng: np.random.Generator, frequency: np.ndarray = FREQUENCY, form: str = "receptance"
) -> FrequencyResponse:
    matrix = rng.normal(size=(frequency.size, 2, 2)) + 1j * rng.normal(size=(frequency.size, 2, 2))
    ports = (Port("x", "x", "x", 0.0), Port("y", "y", "y", np.pi / 2))
    forces = (Port("f", "f", "x", 0.0), Port("45 deg", "45 deg", "45 deg", np.pi / 4))
    return FrequencyResponse(
        frequency, matrix * 1e-6, ports, forces, form=form, coherence=rng.random(matrix.shape), name="run 1"
    )


def function(rng: np.random.Generator, **entries: object) -> dict:
    """One pyuff record: accelerance 1+X per force 2+Y, 9 lines."""
    values = rng.normal(size=9) + 1j * rng.normal(size=9)
    known = {
        "type": 58, "func_type": 4, "rsp_node": 1, "rsp_dir": 1, "ref_node": 2, "ref_dir": 2, "data": values,
        "x": FREQUENCY,
        "abscissa_spacing": 1, "abscissa_spec_data_type": 18, "ordinate_spec_data_type": 12,
        "orddenom_spec_data_type": 13,
    }  # fmt: skip
    return {**known, **entries}


def units(length: float, force: float) -> dict:
    return {
        "type": 164,
        "units_code": 9,
        "length": length,
        "force": force,
        "temp": 1.0,
        "temp_offset": 273.15,
    }


def written(path: Path, *sets: dict) -> Path:
    """A new file by pyuff, which overwrites its own binary headers in any mode but "add", and leaves files
    open.
    """
    path.unlink(missing_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        pyuff.UFF(str(path)).write_sets(list(sets), "add")
    return path


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("form", ["receptance", "mobility", "accelerance"])
def test_round_trip_of_a_response(tmp_path: Path, rng, binary: bool, form: str) -> None:
    made = response(rng, form=form)
    write_frf_uff(tmp_path / "h.uff", made, binary)
    read = read_frf_file(tmp_path / "h.uff", "run 1")
    assert (read.outputs, read.inputs, read.form, read.name) == (made.outputs, made.inputs, form, "run 1")
    # Text holds 12 digits, so that the last is right to 5e-12; binary numbers are kept to the last bit.
    np.testing.assert_allclose(read.matrix, made.matrix, rtol=0 if binary else 1e-11)
    np.testing.assert_allclose(read.coherence, made.coherence, rtol=0 if binary else 5e-12)
    np.testing.assert_array_equal(read.frequency, made.frequency)


@pytest.mark.parametrize("binary", [False, True])
def test_uneven_frequencies_keep_what_the_format_holds(tmp_path: Path, rng, binary: bool) -> None:
    """Text: six digits in 13 columns; binary: all of them."""
    made = response(rng, np.sort(rng.uniform(10, 20, 7)))
    write_frf_uff(tmp_path / "h.uff", made, binary)
    np.testing.assert_allclose(
        read_frf_uff(tmp_path / "h.uff").frequency, made.frequency, rtol=0 if binary else 5e-6
    )


@pytest.mark.parametrize("binary", [False, True])
def test_pyuff_reads_what_labpipe_writes(tmp_path: Path, rng, binary: bool) -> None:
    made = response(rng)
    write_frf_uff(tmp_path / "h.uff", made, binary)
    sets = [
        entry
        for entry in pyuff.UFF(str(tmp_path / "h.uff")).read_sets()
        if entry["type"] == 58 and entry["func_type"] == 4
    ]
    assert [(entry["rsp_dir"], entry["ref_dir"]) for entry in sets] == [(1, 1), (1, 0), (2, 1), (2, 0)]
    np.testing.assert_allclose(
        np.array([entry["data"] for entry in sets]).T.reshape(made.matrix.shape), made.matrix, rtol=1e-11
    )
    np.testing.assert_allclose(sets[3]["x"], made.frequency, rtol=1e-12)
    assert (sets[0]["ordinate_spec_data_type"], sets[0]["orddenom_spec_data_type"]) == (8, 13)


@pytest.mark.parametrize("binary", [0, 1])
@pytest.mark.parametrize("even", [0, 1])
def test_what_pyuff_writes(tmp_path: Path, rng, binary: int, even: int) -> None:
    """Several records per file.

    Pyuff's binary abscissa is in double precision, which the format does not provide.
    """
    made = [function(rng, rsp_dir=d, binary=binary, abscissa_spacing=even) for d in (1, 2)]
    read = read_frf_uff(written(tmp_path / "h.uff", *[dict(entry) for entry in made]))
    assert [(port.label, port.dof, port.angle) for port in read.outputs] == [
        ("1.x", "1.x", 0.0),
        ("1.y", "1.y", np.pi / 2),
    ]
    assert (read.inputs[0].label, read.form) == ("2.y", "accelerance")
    np.testing.assert_allclose(
        read.matrix[:, :, 0], np.array([entry["data"] for entry in made]).T, rtol=1e-10
    )
    np.testing.assert_allclose(read.frequency, FREQUENCY, rtol=1e-7)


def big_endian(path: Path, rng, n: int = 9, ordinate: int = 6) -> np.ndarray:
    """The file of `function` in binary, its numbers turned to the byte order of the other kind of machine by
    hand.
    """
    values = rng.normal(size=2 * n)
    text = written(path, function(rng, binary=1)).read_bytes()
    head = b"".join(text.splitlines(True)[:13]).replace(b"58b     1", b"58b     2", 1)
    head = head.replace(b"         6         9", f"{ordinate:10d}{n:10d}".encode(), 1)
    path.write_bytes(head + struct.pack(f">{2 * n}{'d' if ordinate == 6 else 'f'}", *values) + b"\n    -1\n")
    return values[::2] + 1j * values[1::2]


@pytest.mark.parametrize(("ordinate", "rtol"), [(6, 0), (5, 1e-6)])
def test_big_endian_numbers_of_either_precision(tmp_path: Path, rng, ordinate: int, rtol: float) -> None:
    values = big_endian(tmp_path / "h.uff", rng, ordinate=ordinate)
    np.testing.assert_allclose(read_frf_uff(tmp_path / "h.uff").matrix[:, 0, 0], values, rtol=rtol)


@pytest.mark.parametrize("ends", [(-1, 2), (1, -2), (-1, -2)])
def test_negative_directions_turn_the_sign(tmp_path: Path, rng, ends: tuple[int, int]) -> None:
    entry = function(rng, rsp_dir=ends[0], ref_dir=ends[1])
    read = read_frf_uff(written(tmp_path / "h.uff", dict(entry)))
    np.testing.assert_allclose(read.matrix[:, 0, 0], np.sign(ends[0] * ends[1]) * entry["data"], rtol=1e-10)
    assert (read.outputs[0].angle, read.inputs[0].angle) == (0.0, np.pi / 2)


@pytest.mark.parametrize(
    ("sets", "factor"),
    [
        (lambda rng: [], 1.0),
        (lambda rng: [units(1000.0, 1.0)], 1e-3),  # mm, N
        (lambda rng: [units(1 / 0.0254, 1 / 4.4482216152605)], 0.0254 / 4.4482216152605),  # in, lbf
    ],
)
def test_units_of_record_164(tmp_path: Path, rng, sets, factor: float) -> None:
    entry = function(rng)
    read = read_frf_uff(written(tmp_path / "h.uff", *sets(rng), dict(entry)))
    np.testing.assert_allclose(read.matrix[:, 0, 0], factor * entry["data"], rtol=1e-10)


@pytest.mark.parametrize(
    ("label", "per", "factor"),
    [
        ("mm/s2", "NONE", 1e-3),
        ("g", "N", 9.80665),
        ("g/N", "N", 9.80665),
        ("m/s^2", "kN", 1e-3),
        ("NONE", "kN", 1e-3),
        ("(m/s^2)/N", "NONE", 1.0),
    ],
)
def test_units_of_labels(tmp_path: Path, rng, label: str, per: str, factor: float) -> None:
    entry = function(rng, ordinate_axis_units_lab=label, orddenom_axis_units_lab=per)
    read = read_frf_uff(written(tmp_path / "h.uff", dict(entry)))
    np.testing.assert_allclose(read.matrix[:, 0, 0], factor * entry["data"], rtol=1e-10)


@pytest.mark.parametrize(
    ("changes", "fragment"),
    [
        ([{"ordinate_axis_units_lab": "furlong"}], "unknown unit 'furlong'"),
        (
            [{"ordinate_axis_units_lab": "m/s^2", "orddenom_axis_units_lab": "stone"}],
            "unknown unit 'm/s.2 per stone'",
        ),
        ([{"abscissa_axis_units_lab": "rad/s"}], "its abscissa is in rad/s; Hz is needed"),
        (
            [{"ordinate_spec_data_type": 0}],
            r"are not displacement \(8\), velocity \(11\) or acceleration \(12\) per force \(13\); state it",
        ),
        ([{"rsp_dir": 4}], "rotations and moments are not supported"),
        ([{}, {}], "has the same dofs as"),
        ([{}, {"rsp_dir": 2, "ref_dir": 1}], "no FRF record for response 1 x and reference 2 x"),
        ([{}, {"rsp_dir": 2, "ordinate_spec_data_type": 8}], "is a receptance"),
        ([{}, {"rsp_dir": 2, "x": FREQUENCY + 0.05}], "the frequencies of record 2"),
        (
            [{}, {"rsp_dir": 2, "x": FREQUENCY[:5], "data": np.ones(5) + 1j}],
            "has 5 frequencies, the first FRF record 9",
        ),
        ([{"data": np.ones(9)}], "an FRF of real numbers"),
        ([{"func_type": 1}], "holds no FRF records"),
    ],
)
def test_what_is_no_frf_matrix_is_refused(tmp_path: Path, rng, changes: list[dict], fragment: str) -> None:
    path = written(tmp_path / "h.uff", *[function(rng, **change) for change in changes])
    with pytest.raises(DataError, match=fragment) as caught:
        read_frf_uff(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("label", "stated", "factor"),
    [
        ("", ("mobility", None), 1.0),
        ("V", ("accelerance", None), 1.0),
        ("g/N", ("accelerance", None), 9.80665),
        ("V", ("receptance", 1e-6), 1e-6),
    ],
)
def test_an_analyser_that_leaves_the_axes_open(
    tmp_path: Path, rng, label: str, stated: tuple[str, float | None], factor: float
) -> None:
    """By hand: data types 0 per 12, as some B&K exports have them, are what the entry states; a label counts
    where it is a unit of that form.
    """
    record = function(
        rng, ordinate_spec_data_type=0, orddenom_spec_data_type=12, ordinate_axis_units_lab=label
    )
    path = written(tmp_path / "h.uff", record)
    if label == "g/N":
        # What a label says is read without anybody's word.
        alone = read_frf_uff(path)
        assert alone.form == "accelerance"
        np.testing.assert_allclose(alone.matrix[:, 0, 0], record["data"] * factor, rtol=1e-5)
    else:
        with pytest.raises(DataError, match="data types 0 per 12"):
            read_frf_uff(path)
    response = read_frf_uff(path, "", stated)
    assert response.form == stated[0]
    np.testing.assert_allclose(response.matrix[:, 0, 0], record["data"] * factor, rtol=1e-5)


def test_a_stated_form_does_not_overrule_the_file(tmp_path: Path, rng) -> None:
    path = written(tmp_path / "h.uff", function(rng))
    with pytest.raises(DataError, match="holds accelerance by its data types, receptance by the entry"):
        read_frf_uff(path, "", ("receptance", None))
    turned = written(tmp_path / "t.uff", function(rng, rsp_dir=4, ordinate_spec_data_type=0))
    with pytest.raises(DataError, match="rotations and moments are not supported"):
        read_frf_uff(turned, "", ("receptance", None))


def test_a_label_that_contradicts_record_164(tmp_path: Path, rng) -> None:
    path = written(tmp_path / "h.uff", units(1.0, 1.0), function(rng, ordinate_axis_units_lab="mm/s2"))
    with pytest.raises(DataError, match="contradicts the units of record 164"):
        read_frf_uff(path)
    time = {"func_type": 1, "abscissa_spec_data_type": 17, "ordinate_axis_units_lab": "g"}
    samples = function(rng, data=rng.normal(size=20), x=np.arange(20) / 100, **time)
    path = written(tmp_path / "t.uff", units(1.0, 1.0), samples)
    with pytest.raises(DataError, match=r"t.uff: record 1 .*: the label 'g' contradicts the units of record"):
        UffTable(path)


CHANNELS = (
    Channel("force", "force", "input", "x", 0.0),
    Channel("acc", "acceleration", "output", "y", np.pi / 2),
)


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("rate", [1000.0, 65536.0, 3000.0])
def test_round_trip_of_a_recording(tmp_path: Path, rng, binary: bool, rate: float) -> None:
    made = Recording(CHANNELS, rng.normal(size=(1001, 2)), rate)
    write_recording_uff(tmp_path / "r.uff", made, binary)
    table = open_table(tmp_path / "r.uff")
    assert (table.columns, table.units, table.sample_rate) == (
        ("force", "acc"),
        {"force": "N", "acc": "m/s^2"},
        rate,
    )
    read = np.concatenate(list(table.chunks(("acc", "force"))))
    np.testing.assert_allclose(read[:, ::-1], made.samples, rtol=0 if binary else 1e-11, atol=0)


def sine(n: int = 50, **entries: object) -> dict:
    known = {
        "type": 58, "func_type": 1, "rsp_node": 3, "rsp_dir": 2, "ref_node": 0, "ref_dir": 0,
        "data": np.sin(0.1 * np.arange(n)),
        "x": 0.01 * np.arange(n), "abscissa_spacing": 1, "abscissa_spec_data_type": 17,
        "ordinate_spec_data_type": 12,
        "orddenom_spec_data_type": 0,
    }  # fmt: skip
    return {**known, **entries}


def test_names_and_units_of_time_records(tmp_path: Path) -> None:
    path = written(
        tmp_path / "r.uff",
        sine(),
        sine(),
        sine(rsp_ent_name="Mic 1", ordinate_spec_data_type=15, ordinate_axis_units_lab="Pa"),
        sine(rsp_node=0, rsp_dir=0, ordinate_axis_lab="strain 7", ordinate_spec_data_type=3),
        sine(rsp_node=0, rsp_dir=0, id1="probe", ordinate_axis_units_lab="g", binary=1),
    )
    table = UffTable(path)
    assert table.columns == ("3+Y", "3+Y_2", "Mic 1", "strain 7", "probe")
    assert table.units == {"Mic 1": "Pa", "probe": "gn"} and table.sample_rate == 100.0
    np.testing.assert_allclose(
        np.concatenate(list(table.chunks(["probe"])))[:, 0], sine()["data"], rtol=1e-15
    )


def test_record_164_scales_time_records(tmp_path: Path) -> None:
    """In units of which 1000 are a metre and 10 a newton."""
    kinds = {8: "m", 11: "m/s", 12: "m/s^2", 9: "N", 13: "N"}
    records = [sine(rsp_ent_name=f"{kind}", ordinate_spec_data_type=kind) for kind in kinds]
    table = UffTable(written(tmp_path / "r.uff", units(1000.0, 10.0), *records))
    assert table.units == {f"{kind}": unit for kind, unit in kinds.items()}
    expected = sine()["data"][:, None] * [1e-3, 1e-3, 1e-3, 0.1, 0.1]
    np.testing.assert_allclose(
        np.concatenate(list(table.chunks(table.columns))), expected, rtol=1e-10, atol=1e-15
    )


@pytest.mark.parametrize(
    ("others", "fragment"),
    [
        ([sine(40)], "has 40 values"),
        ([sine(x=1.0 + 0.01 * np.arange(50))], "0.01 s apart from 1 s on; record 1"),
        ([sine(abscissa_axis_units_lab="ms")], "its abscissa is in ms; s is needed"),
        ([sine(x=0.02 * np.arange(50))], "0.02 s apart"),
        ([sine(abscissa_spacing=0)], "not evenly spaced"),
        ([sine(data=np.ones(50) + 1j)], "complex values"),
    ],
)
def test_time_records_that_differ_are_refused(tmp_path: Path, others: list[dict], fragment: str) -> None:
    with pytest.raises(DataError, match=fragment):
        UffTable(written(tmp_path / "r.uff", sine(), *[dict(other) for other in others]))


@pytest.mark.parametrize("binary", [0, 1])
def test_a_file_cut_off_anywhere_is_refused(tmp_path: Path, binary: int) -> None:
    whole = written(tmp_path / "r.uff", sine(binary=binary)).read_bytes()
    for length in range(1, len(whole.rstrip()), 7):
        (tmp_path / "cut.uff").write_bytes(whole[:length])
        with pytest.raises(DataError):
            list(UffTable(tmp_path / "cut.uff").chunks(["3+Y"]))


@pytest.mark.parametrize(
    ("content", "fragment"),
    [
        (b"", "the file is empty"),
        (b"PK\x03\x04 zip\n", "is not a universal file"),
        (b"    -1\n    15\n    -1\n", "holds no record 58"),
        (b"    -1\n   164\n  x\n 0.0 0.0\n    -1\n", "units record 164 cannot be read"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: bytes, fragment: str) -> None:
    (tmp_path / "r.uff").write_bytes(content)
    with pytest.raises(DataError, match=fragment):
        read_uff(tmp_path / "r.uff")


@pytest.mark.parametrize(
    ("old", "new", "fragment"),
    [
        (b"58b     1", b"58b     7", "byte order"),
        (b"         4        50", b"         4         0", "holds no values"),
        (b"         4        50", b"         4        49", "closing -1 does not follow"),
        (b"         4        50", b"         3        50", "unknown ordinate data type 3"),
        (b"         4        50", b"         4        5x", "invalid literal"),
        (b"         3   2", b"         3   9", "unknown direction 9"),
    ],
)
def test_damaged_headers_are_refused(tmp_path: Path, old: bytes, new: bytes, fragment: str) -> None:
    path = written(tmp_path / "r.uff", sine(binary=1))
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(DataError, match=fragment):
        read_uff(path)


def test_long_exponents_that_touch_and_exponents_with_d(tmp_path: Path) -> None:
    """Six fields of 13 columns, the way a logger writes three-digit exponents; and FORTRAN's D."""
    path = written(tmp_path / "r.uff", sine(6))
    lines = path.read_text().splitlines()
    values = ("-5.00000E-005", "-1.25000E+000") * 3
    lines[8] = lines[8].replace("         4         6", "         2         6")
    for text in ("".join(values), "  ".join(values).replace("E", "D")):
        path.write_text("\n".join([*lines[:13], text, "    -1", ""]))
        np.testing.assert_array_equal(
            np.concatenate(list(UffTable(path).chunks(["3+Y"])))[:, 0], [-5e-5, -1.25] * 3
        )


def test_names_too_long_for_the_format(tmp_path: Path, rng) -> None:
    channels = (
        Channel("temperature 1", "temperature", "reference", "none"),
        Channel("temperature 2", "temperature", "reference", "none"),
    )
    with pytest.raises(DataError, match="the same name in a universal file"):
        write_recording_uff(tmp_path / "r.uff", Recording(channels, rng.normal(size=(10, 2)), 1.0))


def test_a_response_at_one_frequency(tmp_path: Path, rng) -> None:
    made = response(rng, FREQUENCY[:1])
    write_frf_uff(tmp_path / "h.uff", made)
    read = read_frf_uff(tmp_path / "h.uff")
    np.testing.assert_allclose(read.matrix, made.matrix, rtol=5e-12)
    np.testing.assert_array_equal(read.frequency, made.frequency)
