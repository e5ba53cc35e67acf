"""A small valid file of every kind that labpipe reads, by the name that it has on disk, and how it is read to
numbers.
"""

from __future__ import annotations

import gzip
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.io import savemat, wavfile

from labpipe.artefacts.dataset_file import DatasetPart, read_part
from labpipe.artefacts.header import Header
from labpipe.artefacts.identification_file import read_fits, read_identification
from labpipe.artefacts.measured_files import read_decays, read_spectra, write_decays
from labpipe.artefacts.recording_file import open_recording
from labpipe.cli.main import run_command
from labpipe.methods.calibration.section import CalibrationSettings, calibrate
from labpipe.methods.planning.plan_file import read_plan
from labpipe.methods.run_ups.run_up_csv import read_run_up_csv
from labpipe.project.catalogue import INDEX, Filter, open_index
from labpipe.project.catalogue_search import found_values
from labpipe.project.exports import write_csv, write_mat, write_uff, write_uff58b
from labpipe.project.ready_response import load_response
from labpipe.project.rig_file import load_rig
from labpipe.project.scaffold import scaffold
from labpipe.raw_files.geometry import read_geometry
from labpipe.raw_files.screening import ChannelScreen
from labpipe.raw_files.table import open_table
from labpipe.raw_files.uff import read_shapes_uff
from labpipe.records.response import Port
from labpipe.records.spectra import FreeDecay, FreeDecays
from tests.project.laboratory import PIPELINE, RIG, done, laboratory
from tests.raw_files.test_uff_shapes import FIRST, POLE, THIRD, complex_mode, normal

N_ROW = 60
FOREIGN = Path(__file__).parents[2] / "sample_data/foreign"
# What was read: numbers by name, and the codes of findings.
Content = tuple[dict[str, Any], tuple[str, ...]]
Read = Callable[[Path], Content]


def table_content(path: Path) -> Content:
    """The columns of a table."""
    table = open_table(path)
    names = list(dict.fromkeys(table.columns))
    screen = ChannelScreen(names)
    chunks = []
    for chunk in table.chunks(names):
        screen.add(chunk)
        chunks.append(chunk)
    values_of = np.concatenate(chunks) if chunks else np.empty((0, len(names)))
    columns = {name: values_of[:, number].tobytes() for number, name in enumerate(names)}
    return {**columns, "rate": table.sample_rate, "units": dict(table.units)}, tuple(
        finding.code for finding in screen.findings()
    )


def rates_content(path: Path) -> Content:
    """The columns of a table, and of those at its other rates."""
    content, codes = table_content(path)
    others = getattr(open_table(path), "others", ())
    chunks = [chunk.tobytes() for table in others for chunk in table.chunks(table.columns)]
    return {**content, "others": chunks}, codes


def first_look_content(path: Path) -> Content:
    """The files that `init` writes."""
    project = scaffold((path,), path.parent)
    return {
        "rig": project.rig.replace(path.name, ""),
        "pipeline": project.pipeline.replace(path.name, ""),
    }, ()


def response_content(path: Path) -> Content:
    """The numbers of a response."""
    response = load_response(path)
    numbers = {
        name: getattr(response, name)
        for name in ("frequency", "matrix", "coherence", "multiple_coherence", "covariance")
    }
    labels = [port.label for port in (*response.outputs, *response.inputs)]
    content = {name: None if array is None else array.tobytes() for name, array in numbers.items()}
    return {**content, "labels": labels, "form": response.form}, tuple(
        finding.code for finding in response.findings
    )


def whole(read: Callable[[Path], Any]) -> Read:
    """A reader of an artefact, its record as text."""

    def content(path: Path) -> Content:
        with np.printoptions(threshold=1 << 30, floatmode="unique"):
            record = read(path)
            fields = dict(getattr(record, "__dict__", {}))
            # The digest itself is not a number.
            fields.pop("digest", None)
            return {"record": f"{record!r} {fields!r}"}, ()

    return content


def index_content(path: Path) -> Content:
    """What a list of a folder with this index says."""
    return {"values": repr(found_values(path.parent, Filter()))}, ()


def calibration_content(path: Path) -> Content:
    """The line through a calibration table."""
    (fit,) = calibrate([CalibrationSettings("", "x [um]", "y [V]", path=path)])
    return {"record": repr(fit.parameters)}, tuple(finding.code for finding in fit.findings)


def sensor_content(path: Path) -> Content:
    """The frequency response of a sensor, read with the rig file that names it."""
    rig = path.with_name("rig.yaml")
    rig.write_text(RIG.replace("role: output, dof: y", f"role: output, dof: y, response: {path.name}"))
    return {"response": repr([one.channel.response for one in load_rig(rig).channels])}, ()


ARTEFACTS: dict[str, Read] = {
    "a.recording.parquet": whole(lambda path: open_recording(path).in_memory()),
    "a.frf.parquet": response_content,
    "a.decay.parquet": whole(read_decays),
    "a.spectra.parquet": whole(read_spectra),
    "a.results.parquet": whole(lambda path: read_part(DatasetPart(path, "", ""))),
    "identification.json": whole(read_identification),
    "fits.json": whole(read_fits),
    "plan.json": whole(read_plan),
    INDEX: index_content,
}
RESPONSES: dict[str, Read] = dict.fromkeys(("frf.csv", "frf.uff", "frf-b.uff", "frf.mat"), response_content)
TABLES: dict[str, Read] = dict.fromkeys(
    (
        "a.csv", "blanks.txt", "wide.csv", "a.csv.gz", "a.parquet", "a.uff", "b.uff", "a.mat", "a.h5",
        "a.wav", "b.wav", "a.npy", "a.npz",
        "a.lvm", "a.tdms", "a.xlsx", "a.mf4",
    ),
    table_content,
)  # fmt: skip
# Tables and universal files that describe something else than signals.
OTHERS: dict[str, Read] = {
    "run-up.csv": whole(read_run_up_csv),
    "geometry.csv": whole(read_geometry),
    "geometry.uff": whole(read_geometry),
    "calibration.csv": calibration_content,
    "sensor.csv": sensor_content,
    "shapes.uff": whole(read_shapes_uff),
    "structures.mat": table_content,
    "rates.lvm": rates_content,
    "rates.mf4": rates_content,
}
# What `init` looks at: recordings and FRFs of other programs.
LOOKS: dict[str, Read] = dict.fromkeys(
    ("look.csv", "look.tdms", "look.lvm", "open.uff", "variables.mat", "no-header.txt"), first_look_content
)
READS: dict[str, Read] = {**TABLES, **RESPONSES, **OTHERS, **LOOKS, **ARTEFACTS}

LVM = """LabVIEW Measurement
Writer_Version\t2
Reader_Version\t2
Separator\tTab
Decimal_Separator\t.
Multi_Headings\tNo
X_Columns\tOne
Time_Pref\tRelative
***End_of_Header***

Channels\t2
Samples\t60\t60
Y_Unit_Label\tN\tum
X_Dimension\tTime\tTime
X0\t0.0\t0.0
Delta_X\t0.01\t0.01
***End_of_Header***
X_Value\tforce\ty\tComment
"""
RUN_UP = """# load: 3.66 N
# unbalance disc 1: 50 g.mm at 90 deg
# threshold: 2772 rpm +- 6 rpm
# amplitude error: 1 %
# phase error: 1 deg
speed [rpm],disc 1 x amplitude [um],disc 1 x phase [deg],disc 1 y amplitude [um],disc 1 y phase [deg]
600,10,90,20,0
900,20.5,10,31,-33
1200,30,-90,40,180
"""
GEOMETRY = "point; x [mm]; y [mm]; z [mm]; to\na; 0; 0; 0; b c\nb; 100; 0; 0; c\nc; 0; 100; 50;\n"
GEOMETRY_UFF = """    -1
   164
         1SI units                    2
  1.0000000000000000E+00  1.0000000000000000E+00  1.0000000000000000E+00
  2.7314999999999998E+02
    -1
    -1
    15
         1         0         0         8  0.0000000E+00  0.0000000E+00  0.0000000E+00
         2         0         0         8  1.0000000E-01  0.0000000E+00  0.0000000E+00
         3         0         0         8  0.0000000E+00  1.0000000E-01  0.0000000E+00
    -1
    -1
    82
         1         3         1
outline
         1         2         3
    -1
    -1
  2412
         1        91         1         1         7         3
         1         2         3
    -1
"""
PLAN = """title: Planned
plan:
  model: sdof
  mass: 0.79 kg
  expected: {k: 134.5 kN/m, c: 3.682 N.s/m}
  noise: {force: 20 mN, displacement: 0.3 um}
  sample_rate: 256 Hz
  band: 60-72 Hz
  period: 1 s
  force_limit: 1 N
  duration: 4 s
"""
DATASET = (
    PIPELINE.replace("title: Small", "title: Small\nresults: dataset").split("accept:")[0]
    + "report: {formats: []}\n"
)
CALIBRATION = "x [um],y [V]\n0,0.01\n10,0.08\n20,0.17\n30,0.24\n40,0.33\n"
SENSOR = "frequency_hz,gain,phase_deg\n0,1,0\n20,1.005,-0.4\n50,1.01,-1\n"


def write_seeds(folder: Path) -> None:
    """Write one file of every kind; the laboratory that made the artefacts stands in "laboratory"."""
    rng = np.random.default_rng(1)
    t, force, y = np.arange(N_ROW) / 100, rng.normal(size=N_ROW), rng.normal(size=N_ROW)
    _write_texts(folder, np.column_stack([t, force, y]))
    _write_binaries(folder, t, force, y)
    _write_looks(folder, t, force, y)
    _write_artefacts(folder)


def _write_looks(folder: Path, t: np.ndarray, force: np.ndarray, y: np.ndarray) -> None:
    """Shapes, channels at two rates and in structures, and what `init` makes something of."""
    (folder / "shapes.uff").write_text(normal(30.0, 0.01, FIRST) + complex_mode(POLE, THIRD))
    fields = [("Name", object), ("Unit", object), ("Data", object)]
    x = np.array([[("Time", "s", t)]], fields)
    channels = np.array([[("Model/force", "N", force), ("Model/x", "um", y)]], fields)
    savemat(folder / "structures.mat", {"meas": {"X": x, "Y": channels}})
    slower = LVM.replace("Samples\t60\t60", "Samples\t60\t30").replace(
        "Delta_X\t0.01\t0.01", "Delta_X\t0.01\t0.02"
    )
    rows = [f"{t[n]:.6f}\t{force[n]:.6f}\t" + (f"{y[n]:.6f}\t\n" if n < 30 else "\t\n") for n in range(60)]
    (folder / "rates.lvm").write_text(slower + "".join(rows))
    _write_mdf(folder / "rates.mf4", t, force, y, half=True)
    for suffix in (".csv", ".tdms", ".lvm"):
        (folder / f"look{suffix}").write_bytes((folder / f"a{suffix}").read_bytes())
    (folder / "open.uff").write_bytes((FOREIGN / "5.uff").read_bytes())
    frequency = np.arange(1.0, 61.0)
    h = 1 / (900 - frequency**2 + 0.6j * frequency)
    savemat(
        folder / "variables.mat", {"Freq_domain": frequency, "Hf_chan_2": h, "Hf_coh_chan_2": np.ones(60)}
    )
    np.savetxt(folder / "no-header.txt", np.column_stack([frequency, h.real, h.imag]))


def _write_texts(folder: Path, rows: np.ndarray) -> None:
    text = "t [s],force [N],y [um]\n" + "".join(
        ",".join(f"{number:.6g}" for number in row) + "\n" for row in rows
    )
    (folder / "a.csv").write_text(text)
    (folder / "blanks.txt").write_text("# made by hand\n" + text.replace(",", "   ").replace(" [", "["))
    (folder / "wide.csv").write_bytes(text.replace(",", ";").encode("utf-16"))
    (folder / "a.csv.gz").write_bytes(gzip.compress(text.encode(), mtime=0))
    for name, content in {
        "run-up.csv": RUN_UP, "geometry.csv": GEOMETRY, "geometry.uff": GEOMETRY_UFF,
        "calibration.csv": CALIBRATION, "sensor.csv": SENSOR,
    }.items():  # fmt: skip
        (folder / name).write_text(content)
    (folder / "a.lvm").write_text(
        LVM + "".join("\t".join(f"{number:.6f}" for number in row) + "\t\n" for row in rows)
    )


def _write_binaries(folder: Path, t: np.ndarray, force: np.ndarray, y: np.ndarray) -> None:
    pq.write_table(pa.table({"t [s]": t, "force [N]": force, "y [um]": y}), folder / "a.parquet")
    savemat(folder / "a.mat", {"t": t, "force": force, "y": y, "fs": 100.0})
    with h5py.File(folder / "a.h5", "w") as file:
        file["run/force"], file["run/y"] = force, y
        file["run/fs"] = 100.0
        file["run/force"].attrs["unit"] = "N"
        file.create_dataset("run/packed", data=y, chunks=(20,), compression="gzip")
    samples = np.column_stack([force, y]) / 4
    wavfile.write(folder / "a.wav", 1000, (samples * 30000).astype(np.int16))
    wavfile.write(folder / "b.wav", 1000, samples.astype(np.float32))
    np.save(folder / "a.npy", np.column_stack([t, force, y]))
    np.savez(folder / "a.npz", force=force, y=y, fs=100.0)
    _write_tdms(folder / "a.tdms", force, y)
    _write_mdf(folder / "a.mf4", t, force, y)
    _write_xlsx(folder / "a.xlsx", np.column_stack([t, force, y]))


def _write_tdms(path: Path, force: np.ndarray, y: np.ndarray) -> None:
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(str(path)) as writer:
        steps = {"wf_increment": 0.01}
        writer.write_segment(
            [ChannelObject("run", name, column, steps) for name, column in (("force", force), ("y", y))]
        )


def _write_mdf(path: Path, t: np.ndarray, force: np.ndarray, y: np.ndarray, *, half: bool = False) -> None:
    """Both channels in one group, or *y* at half the rate in another."""
    from asammdf import MDF, Signal

    signals = [Signal(force, t, name="force", unit="N"), Signal(y, t, name="y", unit="um")]
    with MDF(version="4.10") as file:
        if half:
            file.append(signals[:1])
            signals = [Signal(y[::2], t[::2], name="y", unit="um")]
        file.append(signals)
        file.save(path)


def _write_xlsx(path: Path, rows: np.ndarray) -> None:
    import openpyxl

    book = openpyxl.Workbook()
    for row in [["t [s]", "force [N]", "y [um]"], *rows[:20].tolist()]:
        book.active.append(row)
    book.save(path)
    assert zipfile.is_zipfile(path)


def _write_artefacts(folder: Path) -> None:
    lab = folder / "laboratory"
    lab.mkdir()
    done(laboratory(lab), lab / "out")
    spectra = lab / "spectra.yaml"
    spectra.write_text(PIPELINE.replace("skip: 0", "skip: 0, result: spectra").split("identify:")[0])
    _measured(spectra, lab / "spectra")
    (lab / "plan.yaml").write_text(PLAN)
    assert run_command(["plan", str(lab / "plan.yaml"), "-o", str(lab / "plan"), "-q"]) == 0
    dataset = lab / "dataset.yaml"
    dataset.write_text(DATASET)
    assert run_command(["run", str(dataset), "-o", str(lab / "dataset"), "-q"]) == 0
    decay = FreeDecay("soft", 0.1, np.random.default_rng(1).normal(size=(50, 1)))
    decays = FreeDecays(100.0, (Port("y", "displacement", "y"),), ("m",), (decay,), name="soft")
    write_decays(folder / "a.decay.parquet", decays, Header("decay", {}, inputs=()))
    names = {
        "a.recording.parquet": "out/recordings/soft.recording.parquet",
        "a.frf.parquet": "out/soft.frf.parquet",
        "a.spectra.parquet": "spectra/soft.spectra.parquet",
        "identification.json": "out/identification.json",
        "fits.json": "out/fits/soft.json",
        "plan.json": "plan/plan.json",
    }
    (part,) = (lab / "dataset").rglob("*.results.parquet")
    (folder / "a.results.parquet").write_bytes(part.read_bytes())
    for name, source in names.items():
        (folder / name).write_bytes((lab / source).read_bytes())
    open_index(lab / "out")
    (folder / INDEX).write_bytes((lab / "out" / INDEX).read_bytes())
    frf, recording = folder / "a.frf.parquet", folder / "a.recording.parquet"
    for name, write in {
        "frf.csv": write_csv,
        "frf.uff": write_uff,
        "frf-b.uff": write_uff58b,
        "frf.mat": write_mat,
    }.items():
        write(frf, folder / name)
    for name, write in {"a.uff": write_uff, "b.uff": write_uff58b}.items():
        write(recording, folder / name)


def _measured(pipeline: Path, target: Path) -> None:
    from labpipe.artefacts.writing import output_folder
    from labpipe.project.pipeline_file import load_pipeline
    from labpipe.project.run import Manner, measure_tests

    with output_folder(target) as output:
        measure_tests(load_pipeline(pipeline), output, Manner())
