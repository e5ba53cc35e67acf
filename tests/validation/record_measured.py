"""Records what labpipe and two other programs make of raw files that others published: nothing is fetched,
nothing of them is shipped.

    python -m tests.validation.record_measured --data FOLDER

FOLDER holds a clone of each repository below, named owner+name (a bare one may lie one folder deeper). The
pipelines and rig files are those of `words/measured.md`; commit and SHA-256 digest of every raw file go into
the record.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import yaml
from scipy.optimize import curve_fit
from scipy.stats import f as f_distribution

import labpipe
from labpipe.records.identification import Fit
from labpipe.spectra.settings import FreeDecaySettings, FrfSettings
from tests.validation.independent import PERIOD, RATE, equivalent_frequency, mode_of_frf, modes_of_record
from tests.validation.measured_page import BLOCKS, RIGS

FILE = Path(__file__).parent / "recorded/measured.json"
TIMEOUT = 120.0


@dataclass(frozen=True)
class RawSet:
    """Raw files of one repository: *files* by the name that the pipelines use, its path at *commit*."""

    repository: str
    commit: str
    files: dict[str, str]


BEARING = "experimental-modal-analysis/data/experimental_modal_analysis_journal"
TOOL = "ExperimentalModalAnalysis/Point_{}_Channel_1_CH1.txt"
BEAM = "Example/SignalCalc/ASCII0000{0}/Hxysv0000{0}.txt"
VIEWS = ("0", "0_02", "0_03", "0_04", "1")
WING = ("rand_20", "pseudorand_20", "pseudorand_200")
SETS = {
    "bearing": RawSet(
        "runehoejlund/superconducting-magnetic-bearing",
        "c3e822ea71a4f5acdaabe62acccc566fa56f6b7b",
        {f"experimental_modal_analysis_journal_{axis}.csv": f"{BEARING}_{axis}.csv" for axis in "rz"},
    ),
    "beams": RawSet(
        "deepfe/dexpilab1",
        "5bb911f6ec8af99920d05e18aa987275fedbb0d6",
        {"VDeXpiLab1_Exp.mat": "20220317_VD1/VDeXpiLab1_Exp.mat"},
    ),
    "tool": RawSet(
        "leekunhwee/Vibration-Signal-Processing",
        "d9edffe54f69bf34368cd47f9389b78fc3d360cf",
        {
            **{f"tool_{point}.txt": TOOL.format(point) for point in range(1, 6)},
            "Point1_Channel1_CH1.txt": "ImpactTesting/Point1_Channel1_CH1.txt",
        },
    ),
    "ruler": RawSet(
        "torebutlin/pydvma",
        "df9328623808ad189fdad09930e4db4a274e67e4",
        {"ruler_grid_acc_3.mat": "data/examples/ruler_grid_acc_3.mat"},
    ),
    "free beam": RawSet(
        "alxhslm/ModeLAB",
        "4a27c9822565ba9eb282d479333d3d920899182c",
        {f"Hxysv0000{point}.txt": BEAM.format(point) for point in range(1, 10)},
    ),
    "kit": RawSet(
        "gergelytakacs/AutomationShield",
        "bc0778f97a156d4ea5158725e09068d438e59a39",
        {
            "Data_time.mat": "simulink/examples/MagnetoShield/"
            "MagnetoShield_AlternativeModel_Examples/Models_comparison/Data_time.mat"
        },
    ),
}

SETS |= {
    "piezo": RawSet(
        "elchape99/SSCSA",
        "aaf445cbb0df3616089fa3c7ab309bfdfd2b8695",
        {"FRF_sc_sc_new.mat": "FRF/FRF_sc_sc_new.mat"},
    ),
    "hammer": RawSet(
        "EngAdrianoDiegues/ANALISE-MODAL-EXPERIMENTAL-",
        "8f32d64058500f8491054e90074a07b31f09ce1a",
        {f"{point}.uff": f"FRF/{point}.uff" for point in range(1, 10)},
    ),
    "plate": RawSet(
        "ladisk/mssp-image-tutorial",
        "f74a3cc85429ea30b5bc1fa2137e2145b55fc427",
        {f"view_{name}.hdf5": f"data/measured_signals/view_{name}.hdf5" for name in VIEWS},
    ),
    "bench": RawSet(
        "HoriFujimotoLab/FdiTools",
        "5925fae7e65f091b4111b1ba123e08dd869cb590",
        {f"MultisineType{of}.mat": f"Examples/private/MultisineType{of}.mat" for of in "AB"},
    ),
    "wing": RawSet(
        "SanthoshKumarArroju/FRF-Techniques-H1-Hv-H2-",
        "6b726ce044acf6ec3a35b5528f220dfbfcd0b00e",
        {f"{of}avg_10hz.mat": f"{of}avg_10hz.mat" for of in WING},
    ),
}

FRAME = ("set1_nomass", "set2_nomass", "set3_no_mass")
CLAMPED = "Experimentos/Biengastada/Sem piezo/Sem força magnética/Testes de impacto/"
SETS |= {
    "frame": RawSet(
        "Sidwrittenallover/Experimental_Modal_Analysis",
        "7a8669f9d01380234efc3066f49ed2f4c7492b18",
        {f"imp_ham_{of}.CSV": f"data/imp_ham_{of}.CSV" for of in FRAME},
    ),
    "clamped beam": RawSet(
        "catarinaluz/non_linear_beam",
        "b0dc87be513d28828fa67a6c0c76f9538194ce6d",
        {f"mec-t1-{of}.txt": f"{CLAMPED}mec-t1-{of}.txt" for of in ("force", "velocity")},
    ),
    "silverbox": RawSet(
        "Rafa7046/Non_Linear_Identification",
        "e5c9b006b0a2ec1650bc018a5fb38d2f4363d4c7",
        {"SNLS80mV.csv": "src/data/SNLS80mV.csv"},
    ),
}


@dataclass(frozen=True)
class Run:
    """A pipeline of the page with *changes* of its entries, by dotted names."""

    raw: str
    title: str
    changes: dict[str, Any] = field(default_factory=dict)


ONE_RADIAL, ONE_AXIAL = {"start": "24.35 s", "end": "25.374 s"}, {"start": "1.561 s", "end": "2.243 s"}
RUNS = {
    "radial, all hits": Run("bearing", "Radial, all hits"),
    "radial, one hit": Run("bearing", "Radial, all hits", {"frf.decay": ONE_RADIAL}),
    "axial, all hits": Run("bearing", "Axial, all hits"),
    "axial, one hit": Run("bearing", "Axial, all hits", {"frf.decay": ONE_AXIAL}),
    "steel": Run("beams", "Steel beam"),
    "aluminium": Run("beams", "Steel beam", {"rig": "aluminium.yaml"}),
    "tool, automatic": Run("tool", "Tool in a spindle"),
    "tool, poles": Run(
        "tool", "Tool in a spindle", {"identify.modes.modal": {"poles": ["1074 Hz", "1961 Hz", "2617 Hz"]}}
    ),
    "tool, one hit": Run("tool", "One hit"),
    **{
        f"tool, {band} Hz": Run(
            "tool",
            "Tool in a spindle",
            {"identify.modes.band": f"{band} Hz", "identify.modes.modal": {"poles": ["2617 Hz"]}},
        )
        for band in ("2485-2725", "2500-2725", "2450-2750", "2400-2900", "2300-2900")
    },
    "ruler": Run("ruler", "Ruler, ten points"),
    "free beam": Run("free beam", "Free beam, nine points"),
    "kit": Run("kit", "Magnet of a levitation kit"),
    "piezo, recording": Run("piezo", "Beam with piezo patches, from the recording"),
    "piezo, analyser": Run("piezo", "Beam with piezo patches, the analyser's FRF"),
    "hammer": Run("hammer", "Beam, nine points by hammer"),
    "plate": Run("plate", "Plate on a shaker, five sweeps"),
    **{
        f"bench {of}": Run("bench", "Motor bench in a closed loop", {"recordings": f"MultisineType{of}.mat"})
        for of in "AB"
    },
    **{
        f"wing {of}": Run("wing", "Wing under three excitations", {"frfs.file": f"{of}avg_10hz.mat"})
        for of in WING
    },
    "frame": Run("frame", "Three-storey frame, three decays"),
    "clamped beam, whole decay": Run("clamped beam", "Clamped beam"),
    "clamped beam, 0.5 to 4 s": Run(
        "clamped beam", "Clamped beam", {"frf.decay": {"start": "0.5 s", "end": "4 s"}}
    ),
    "clamped beam, hit": Run("clamped beam", "Clamped beam, force and velocity"),
    "silverbox, multisines": Run("silverbox", "Silverbox, ten realisations"),
    "silverbox, noise": Run("silverbox", "Silverbox, the noise while it is weak"),
}
# Decays that curve_fit is given as well: recording, column, band [Hz].
DECAYS = {
    "radial, all hits": ("y", (15.0, 60.0)),
    "radial, one hit": ("y", (15.0, 60.0)),
    "axial, all hits": ("y", (20.0, 60.0)),
    "axial, one hit": ("y", (20.0, 60.0)),
    "steel": ("a", (1.0, 15.0)),
    "aluminium": ("a", (1.0, 15.0)),
    **{f"clamped beam, {of}": ("v", (120.0, 150.0)) for of in ("whole decay", "0.5 to 4 s")},
}


def blob(data: Path, of: RawSet, path: str) -> bytes:
    """The file at the pinned commit, from a clone under *data*."""
    folder = data / of.repository.replace("/", "+")
    folder = folder / "repo" if (folder / "repo").exists() else folder
    asked = ["git", "-C", str(folder), "show", f"{of.commit}:{path}"]
    return subprocess.run(asked, check=True, capture_output=True, timeout=TIMEOUT).stdout


def unpacked(data: Path, of: RawSet, folder: Path) -> dict[str, str]:
    """Raw files and rig files in *folder*; digests by name."""
    digests = {}
    for name, path in of.files.items():
        content = blob(data, of, path)
        (folder / name).write_bytes(content)
        digests[name] = hashlib.sha256(content).hexdigest()
    for name, text in RIGS.items():
        (folder / name).write_text(text, encoding="utf-8")
    return digests


def pipeline_of(run: Run) -> dict[str, Any]:
    (text,) = (block for block in BLOCKS if yaml.safe_load(block)["title"] == run.title)
    pipeline: dict[str, Any] = yaml.safe_load(text)
    for name, value in run.changes.items():
        *parents, last = name.split(".")
        entry = pipeline
        for parent in parents:
            entry = entry[parent]
        entry[last] = value
    return pipeline


def said(fit: Fit) -> dict[str, Any]:
    """Values, 95 % intervals where there are any, and warnings."""
    values = {
        parameter.name: {
            "value": parameter.value,
            "interval": list(parameter.ci95) if parameter.ci95 is not None else None,
        }
        for parameter in fit.parameters
    }
    return {
        "values": values,
        "warnings": sorted({finding.code for finding in fit.findings if finding.level == "warning"}),
    }


def oscillator(
    t: np.ndarray, size: float, phase: float, frequency: float, ratio: float, offset: float
) -> np.ndarray:
    w = 2 * np.pi * frequency
    return offset + size * np.exp(-ratio * w * t) * np.cos(w * np.sqrt(1 - ratio**2) * t + phase)


def fitted_decays(folder: Path, run: Run, band: tuple[float, float]) -> dict[str, list[float]]:
    """Each decay as labpipe cuts it out, by scipy's curve_fit of one oscillator with offset and free
    frequency, the record as it is.
    """
    pipeline = pipeline_of(run)
    recording = labpipe.read(folder / pipeline["recordings"], rig=folder / pipeline["rig"])
    settings = pipeline["frf"]
    asked = {name: float(str(value).split()[0]) for name, value in settings.get("decay", {}).items()}
    decays = labpipe.free_decays([recording], FrfSettings("decay", decay=FreeDecaySettings(**asked)))
    found: dict[str, list[float]] = {"frequency": [], "ratio": []}
    for decay in decays.decays:
        y = decay.samples[:, 0]
        t = np.arange(y.size) / decays.sample_rate
        spectrum, lines = np.abs(np.fft.rfft(y - y.mean())), np.fft.rfftfreq(y.size, 1 / decays.sample_rate)
        inside = (lines > band[0]) & (lines < band[1])
        start = lines[inside][np.argmax(spectrum[inside])]
        try:
            best, _ = curve_fit(oscillator, t, y, (np.ptp(y) / 2, 0.0, start, 0.03, y.mean()), maxfev=20000)
        except RuntimeError:
            continue
        if band[0] < best[2] < band[1] and best[3] > 0:
            found["frequency"].append(float(best[2]))
            found["ratio"].append(float(best[3]))
    return found


def by_peaks(folder: Path) -> dict[str, dict[str, list[float]]]:
    """The way of the beams' authors: logarithms of the peaks from 1 to 3 s over their number, as they are and
    without the offset, the mean of the record. The frequency is that of the peaks.
    """
    from scipy.io import loadmat
    from scipy.signal import find_peaks

    said, file = {}, loadmat(folder / "VDeXpiLab1_Exp.mat", squeeze_me=True, struct_as_record=False)
    for title, name in (("steel", "Fe"), ("aluminium", "Al")):
        y, rate = file[name].Out.Acc[1], 2048
        at = find_peaks(y, distance=0.05 * rate, height=0)[0]
        at = at[(at + 1 > rate) & (at + 1 < 3 * rate)]
        slopes = [-np.polyfit(np.arange(at.size), np.log(y[at] - off), 1)[0] for off in (0.0, np.mean(y))]
        as_it_is, ratio = (float(slope / np.hypot(2 * np.pi, slope)) for slope in slopes)
        damped = rate * (at.size - 1) / float(at[-1] - at[0])
        said[title] = {
            "frequency": [damped / float(np.sqrt(1 - ratio**2))],
            "ratio": [ratio],
            "with offset": [as_it_is],
        }
    return said


def lscf(
    frequency: np.ndarray, h: np.ndarray, band: tuple[float, float], form: str, near: list[float]
) -> dict[str, dict[str, list[float]]]:
    """The pole nearest each frequency in the orders 10 to 60 of sdypy-EMA's LSCF.

    Frequency: 5th percentile, median, 95th; damping ratio, which scatters into the negative: quartiles.
    """
    import sdypy.EMA as peer

    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        model = peer.Model(h, frequency, lower=band[0], upper=band[1], pol_order_high=60, frf_form=form)
        model.get_poles(method="lscf", show_progress=False)
    found = {}
    for place in near:
        nearest = []
        for poles, ratios in zip(model.pole_freq[10:], model.pole_xi[10:], strict=True):
            if len(poles):
                number = int(np.argmin(np.abs(np.asarray(poles) - place)))
                nearest.append((np.asarray(poles)[number], np.asarray(ratios)[number]))
        frequencies, ratios_of = np.array(nearest).T
        found[f"{place:g}"] = {
            "frequency": np.percentile(frequencies, [5, 50, 95]).tolist(),
            "ratio": np.percentile(ratios_of, [25, 50, 75]).tolist(),
        }
    return found


PEERS = {
    "tool, automatic": ((700.0, 3000.0), "receptance", [1074.0, 1961.0, 2617.0]),
    "ruler": ((20.0, 600.0), "accelerance", [39.38, 108.55, 212.81, 351.78, 525.50, 551.5]),
    "free beam, mode_1": ((105.0, 119.0), "accelerance", [111.99]),
    "free beam, mode_2": ((297.0, 315.0), "accelerance", [306.86]),
    "free beam, mode_3": ((585.0, 605.0), "accelerance", [596.37]),
    "free beam, mode_4": ((965.0, 985.0), "accelerance", [974.14]),
    "piezo, mode_1": ((17.5, 24.0), "mobility", [20.13]),
    "piezo, mode_2": ((109.0, 123.0), "mobility", [115.7]),
    "piezo, mode_3": ((304.0, 324.0), "mobility", [314.0]),
    "hammer": ((20.0, 1600.0), "receptance", [43.9, 176.5, 385.7, 682.5, 1018.0, 1506.0]),
}
# Single modes fitted to one FRF each by the independent calculation: band and start, by the place in `PEERS`.
SINGLE = {
    "hammer": {
        "43.9": ((36, 56), (44.0, 0.017)),
        "176.5": ((165, 190), (176.5, 0.007)),
        "385.7": ((365, 405), (385.5, 0.008)),
        "682.5": ((660, 705), (682.5, 0.003)),
        "1018": ((985, 1060), (1018.0, 0.008)),
        "1506": ((1460, 1550), (1506.0, 0.012)),
    },
    "bench": {"76.3": ((55, 100), (76.3, 0.017))},
    "wing": {
        "13.56": ((12, 15.5), (13.56, 0.003)),
        "124.8": ((121, 129), (124.8, 0.0046)),
        "227.7": ((222, 234), (227.7, 0.009)),
    },
}


def around(
    line: float, places: dict[float, float]
) -> dict[str, tuple[tuple[float, float], tuple[float, float]]]:
    """Bands of four half-power widths, or eight lines [Hz], about places [Hz] with their damping ratios."""
    half = {place: 8 * max(place * ratio, line) for place, ratio in places.items()}
    return {f"{at:g}": ((at - half[at], at + half[at]), (at, ratio)) for at, ratio in places.items()}


SINGLE["ruler"] = around(
    0.61, {39.38: 0.0065, 108.55: 0.0063, 212.81: 0.012, 351.78: 0.007, 525.5: 0.005, 551.5: 0.0012}
)
SINGLE["free beam"] = around(0.0195, {111.99: 1.4e-4, 306.86: 1.2e-4, 596.37: 9e-5, 974.14: 9e-5})
PIEZO = {
    "20.13": ((17.5, 24.0), (20.13, 0.009)),
    "115.7": ((110.0, 122.0), (115.7, 0.0046)),
    "314": ((304.0, 324.0), (314.0, 0.0036)),
}
STOREYS = {"2.17": (0.5, 0.003), "6.89": (0.7, 0.0017), "13.24": (0.65, 0.0013)}
PLATE = {
    "76.4": 0.023,
    "109.5": 0.024,
    "126": 0.0145,
    "149": 0.04,
    "213.3": 0.019,
    "264": 0.025,
    "347": 0.027,
    "450": 0.037,
}


def independent(folder: Path, name: str) -> dict[str, dict[str, list[float]]]:
    """Frequencies [Hz] and ratios of every mode by the independent calculation, of each FRF or record."""
    if name == "plate":
        starts = [(float(place), ratio) for place, ratio in PLATE.items()]
        records = [
            modes_of_record(*samples(folder / file), 25600.0, (66.0, 490.0), starts)
            for file in SETS[name].files
        ]
        of_mode = {place: [modes[n] for modes in records] for n, place in enumerate(PLATE)}
    elif name == "piezo":
        force, velocity = samples(folder / "FRF_sc_sc_new.mat")
        parts = [slice(None), *(slice(first, first + 20700) for first in range(0, 82000, 20700))]
        of_mode = {
            place: [modes_of_record(force[p], velocity[p], 1000.0, band, [start])[0] for p in parts]
            for place, (band, start) in PIEZO.items()
        }
    elif name == "frame":
        records = [columns(folder / file, 6) for file in SETS[name].files]
        of_mode = {
            place: [
                modes_of_record(of[:, 5], of[:, floor], 50.0, (at - half, at + half), [(at, ratio)])[0]
                for of in records
                for floor in (1, 2, 3)
            ]
            for place, (half, ratio) in STOREYS.items()
            for at in (float(place),)
        }
    elif name == "silverbox":
        return silverbox(columns(folder / "SNLS80mV.csv", 2))
    elif name in SINGLE:
        single = [frfs(folder, title) for title in TITLES.get(name, [name])]
        every = [(f, h) for f, rows in single for h in rows]
        of_mode = {
            place: [mode_of_frf(f, h, band, start) for f, h in every]
            for place, (band, start) in SINGLE[name].items()
        }
    else:
        return {}
    return {
        place: {"frequency": [mode[0] for mode in modes], "ratio": [mode[1] for mode in modes]}
        for place, modes in of_mode.items()
    }


def silverbox(record: np.ndarray) -> dict[str, dict[str, list[float]]]:
    """The oscillator by output error on each steady multisine, 14.2413 s apart, and on the whole and the
    quarters of the weak noise; its frequencies by statistical linearisation as well.
    """
    firsts = [round(RATE * (67.0 + round(14.2413 * number, 2))) for number in range(10)]
    periods = [record[first : first + PERIOD] for first in firsts]
    noise = record[round(2.2 * RATE) : round(15 * RATE)]
    found = {}
    for place, parts in (("multisines", periods), ("noise", [noise, *np.array_split(noise, 4)])):
        modes = [modes_of_record(*part.T, RATE, (10.0, 150.0), [(69.0, 0.048)])[0] for part in parts]
        variance = float(np.mean([part[:, 1].var() for part in parts]))
        linearised = [equivalent_frequency(period, variance) for period in periods]
        found[place] = {
            "frequency": [*(mode[0] for mode in modes), *linearised],
            "ratio": [mode[1] for mode in modes],
        }
    return found


def of_spectra(folder: Path, name: str) -> dict[str, float]:
    """What FRFs are compared with: an analyser's from the same recording, and two halves of a record against
    each other by the variances of both.
    """
    if name == "piezo":
        test = pipeline_of(RUNS["piezo, recording"])
        (folder / "page.yaml").write_text(yaml.safe_dump(test), encoding="utf-8")
        (response,) = labpipe.run(folder / "page.yaml", folder / "spectra").responses
        frequency, (theirs,) = analyser_frf(folder, name)
        theirs = np.interp(response.frequency, frequency, theirs)
        off = np.abs(response.matrix[:, 0, 0] - theirs) / np.abs(theirs)
        return {"median difference": float(np.median(off)), "largest difference": float(np.max(off))}
    if name != "bench":
        return {}
    shares = []
    for of in "AB":
        test = pipeline_of(RUNS[f"bench {of}"])
        recording = labpipe.read(folder / test["recordings"], rig=folder / test["rig"])
        halves = [
            labpipe.measure([replace(recording, samples=recording.samples[part])], FrfSettings(**PERIODS))
            for part in (slice(0, 27500), slice(25000, 50000))
        ]
        lines = np.intersect1d(*(half.frequency for half in halves))
        chosen = [np.isin(half.frequency, lines) for half in halves]
        difference = np.subtract(*(half.matrix[at] for half, at in zip(halves, chosen, strict=True)))
        for output in range(2):
            variance = sum(
                half.covariance_of(output, output).real[at] for half, at in zip(halves, chosen, strict=True)
            )
            ratio = np.abs(difference[:, output, 0]) ** 2 / variance
            dof = 2 * min(half.covariance_dof for half in halves)
            shares.append(float(np.mean(ratio < f_distribution.ppf(0.95, 2, dof))))
    return {"lines held": float(np.mean(shares))}


PERIODS = {"excitation": "periodic", "period": 1.0, "skip": 1, "band": (8.0, 250.0), "reference": ("r",)}
# FRFs of a set that are in several files.
TITLES = {"bench": ["bench, A", "bench, B"], "wing": [f"wing, {of}" for of in WING]}


def samples(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Force and response of a record, straight from the file."""
    if path.suffix == ".hdf5":
        import h5py

        with h5py.File(path) as file:
            columns = file["InputTask/data"][:]
        return columns[:, 0], columns[:, 1]
    from scipy.io import loadmat

    of = loadmat(path, squeeze_me=True)
    return of["Data1_AI_Aminus1_Current"].astype(float), of["Data1_AI_Aminus2_Velocity"].astype(float)


def quotient(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Lines that the reference of a multisine excites, and both angles over the current there."""
    from scipy.io import loadmat

    of = loadmat(path, squeeze_me=True)
    r, u, motor, load = (
        np.fft.rfft(of[name].reshape(20, 2500)[1:], axis=1)
        for name in ("iq_refx", "iq_adx", "theta_mx", "theta_my")
    )
    level = np.abs(r.mean(axis=0))
    lines = np.flatnonzero(level > 0.02 * level.max())
    h = [np.sum(y * r.conj(), axis=0) / np.sum(u * r.conj(), axis=0) for y in (motor, -load)]
    return lines.astype(float), np.array(h)[:, lines]


def frfs(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Frequency (n_line,) and FRFs (n_point, n_line) straight from the files, without labpipe."""
    if name == "ruler":
        from scipy.io import loadmat

        h = loadmat(folder / "ruler_grid_acc_3.mat")["yspec"].T
        return 0.6103515625 * np.arange(h.shape[1]), h
    if name.startswith("bench"):
        return quotient(folder / f"MultisineType{name[-1]}.mat")
    if name.startswith(("wing", "piezo")):
        return analyser_frf(folder, name)
    if name == "hammer":
        import pyuff

        records = [pyuff.UFF(str(folder / file)).read_sets(0) for file in SETS[name].files]
        return np.array(records[0]["x"]), np.array([record["data"] for record in records])
    pattern = "tool_*.txt" if name.startswith("tool") else "Hxysv*.txt"
    tables = [columns(path) for path in sorted(folder.glob(pattern))]
    return tables[0][:, 0], np.array([table[:, 1] + 1j * table[:, 2] for table in tables])


def analyser_frf(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """An FRF among the variables of an analyser's MATLAB file."""
    from scipy.io import loadmat

    if name.startswith("wing"):
        of = loadmat(folder / f"{name.removeprefix('wing, ')}avg_10hz.mat", squeeze_me=True)
        return of["Freq_domain"], of["Hf_chan_2"][None]
    of = loadmat(folder / "FRF_sc_sc_new.mat", squeeze_me=True)
    stem = "Data1_MT_FRF_H1_2Zplus_1Zplus"
    return of["Data1_X_MT_MIF__Z"], (of[f"{stem}_Ampl"] * np.exp(1j * of[f"{stem}_Phase"]))[None]


def columns(path: Path, n: int = 3) -> np.ndarray:
    """The numeric lines of a text file, *n* columns."""
    rows = []
    for line in path.read_text(encoding="latin-1").splitlines():
        with contextlib.suppress(ValueError):
            rows.append([float(cell) for cell in line.replace(",", " ").split()[:n]])
    return np.array([row for row in rows if len(row) == n])


def recorded(data: Path, names: Sequence[str] = tuple(SETS)) -> Iterator[tuple[str, Any]]:
    """Everything by set: digests, labpipe's fits by run, peers."""
    for name in names:
        of = SETS[name]
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            entry: dict[str, Any] = {
                "repository": of.repository,
                "commit": of.commit,
                "sha256": unpacked(data, of, folder),
            }
            entry["labpipe"], entry["curve_fit"], entry["lscf"] = {}, {}, {}
            if name == "beams":
                entry["by peaks"] = by_peaks(folder)
            for title, run in RUNS.items():
                if run.raw != name:
                    continue
                (folder / "page.yaml").write_text(yaml.safe_dump(pipeline_of(run)), encoding="utf-8")
                fits = labpipe.run(folder / "page.yaml", folder / "out").fits
                entry["labpipe"][title] = {fit.name: said(fit) for fit in fits}
                if title in DECAYS:
                    entry["curve_fit"][title] = fitted_decays(folder, run, DECAYS[title][1])
                print(name, title, flush=True)
            for title, (band, form, near) in PEERS.items():
                if title.split(",")[0].startswith(name):
                    entry["lscf"][title] = lscf(*frfs(folder, title), band, form, near)
            entry["independent"], entry["spectra"] = independent(folder, name), of_spectra(folder, name)
            yield name, entry


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.validation.record_measured", description=__doc__)
    parser.add_argument(
        "--data", type=Path, required=True, help="folder with one clone for each repository, named owner+name"
    )
    parser.add_argument("--only", nargs="*", choices=SETS, default=list(SETS), help="sets; the others stay")
    asked = parser.parse_args()
    anew = dict(recorded(asked.data, asked.only))
    sets = json.loads(FILE.read_text(encoding="utf-8"))["sets"] | anew
    record = {
        "date": f"{date.today():%Y-%m-%d}",
        "program": f"labpipe {labpipe.__version__}, sdypy-EMA, scipy",
        "command": "python -m tests.validation.record_measured --data FOLDER",
    }
    FILE.write_text(
        json.dumps({**record, "sets": {name: sets[name] for name in SETS if name in sets}}, indent=1) + "\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
