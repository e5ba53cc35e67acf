"""What a file of another program shows of the FRFs in it: the columns of a table, or the variables, that are
frequency, complex numbers or their parts, and coherence.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError
from labpipe.quantities import unit_of
from labpipe.raw_files import frf_described
from labpipe.raw_files.table import TEXT_SUFFIXES
from labpipe.raw_files.text_table import plain_suffix
from labpipe.raw_files.uff import FRF, UFF_SUFFIXES, read_uff
from labpipe.raw_files.uff_read import frf_values, titled_form
from labpipe.records.frf_layout import form_of_unit
from labpipe.records.response import FORMS

_NAMES = (
    ("frequency", r"^freq|frequenz|^f$|^f ?[\[(]"),
    ("coherence", r"coh|kohärenz|gamma"),
    ("phase_rad", r"(phase|arg|winkel).*\brad"),
    ("phase_deg", r"phase|arg\b|winkel"),
    ("re", r"^re(al|\b)|\breal|realteil"),
    ("im", r"^im(ag|\b)|\bimag|imaginärteil"),
    ("amplitude_db", r"(amp|mag|betrag|abs|h\b|frf).*\bdb\b"),
    ("amplitude", r"amp|mag|betrag|\babs|^\|?h\|?\b"),
)
_WHOLE = (("re", "im"), ("amplitude", "phase"), ("amplitude_db", "phase"))


@dataclass(frozen=True)
class GuessedFrf:
    """*columns*: names by what they hold; *unit* where the header states one of an FRF; frequency
    (n_frequency,) [Hz] and values (n_frequency, n_element) [unit of the file], complex or amplitudes. word:
    what the entry calls the columns, '' for records. elements: the columns of each element of a matrix. form:
    where a name says it. guesses: what is a guess. label: of records, where it is not a unit of an FRF.
    conjugate: *values* are conjugates of the file's. reference: the force, where named; elements are then
    named by their responses.
    """

    columns: dict[str, str]
    unit: str
    frequency: FloatArray
    values: FloatArray | ComplexArray
    word: str = "columns"
    elements: dict[str, dict[str, str]] = field(default_factory=dict)
    form: str = ""
    guesses: tuple[str, ...] = ()
    label: str = ""
    conjugate: bool = False
    reference: str = ""


def guessed_frf(path: Path) -> GuessedFrf | None:
    """The FRFs of a table, of variables or of universal records without a form; None for other files."""
    suffix = plain_suffix(path)
    if suffix in frf_described.VARIABLE_SUFFIXES:
        return _guess_variables(frf_described.columns_of_variables(path))
    if suffix in UFF_SUFFIXES:
        return _guess_records(path)
    return _guess_table(path) if suffix in TEXT_SUFFIXES else None


def _guess_records(path: Path) -> GuessedFrf | None:
    frfs = [record for record in read_uff(path) if record.function == FRF]
    if not frfs:
        return None
    form = titled_form(frfs[0])
    guesses = (f"{form}: by the title '{frfs[0].title}'",) if form else ()
    label = frfs[0].ordinate.unit
    frequency, values = frf_values(path, frfs)
    return GuessedFrf({}, "", frequency, values, "", form=form, guesses=guesses, label=label)


# Rows of a table without a header whose first column is a frequency and no time: steps of a recording's time
# are shorter.
LEAST_STEP = 0.05


def _guess_table(path: Path) -> GuessedFrf | None:
    """The FRF of a text table by its header, or without one of three columns, the first a frequency."""
    table = frf_described.TextColumns(path)
    if len(table.columns) == 3 and not any(re.search(r"[A-Za-z]{2}", name) for name in table.columns):
        return _guess_without_header(table)
    columns: dict[str, str] = {}
    for name in table.columns:
        kind = next((kind for kind, pattern in _NAMES if re.search(pattern, name, re.IGNORECASE)), "")
        if kind and kind not in columns:
            columns[kind] = name
    phase = next((kind for kind in ("phase_deg", "phase_rad") if kind in columns), "phase")
    parts = next(
        (pair for pair in _WHOLE if {part.replace("phase", phase) for part in pair} <= columns.keys()), None
    )
    if parts is None or "frequency" not in columns:
        return None
    used = ["frequency", *(part.replace("phase", phase) for part in parts), "coherence"]
    columns = {kind: columns[kind] for kind in used if kind in columns}
    numbers = {kind: table.column(table.columns.index(name)).real for kind, name in columns.items()}
    values = numbers["re"] + 1j * numbers["im"] if parts == ("re", "im") else numbers[parts[0]]
    unit = _unit_of_frf(table.units.get(columns[parts[0]], ""))
    return GuessedFrf(columns, unit, numbers["frequency"], values[:, None])


def _unit_of_frf(unit: str) -> str:
    form = form_of_unit(unit)
    return FORMS[form] if form and unit_of(unit, FORMS[form]).factor == 1 else unit if form else ""


def _guess_without_header(table: frf_described.TextColumns) -> GuessedFrf | None:
    """Three columns of numbers: steps of one size in the first, which is not a time, and a complex number."""
    frequency, re_, im = (table.column(n).real for n in range(3))
    steps = np.diff(frequency)
    if frequency.size < LEAST_LINES or frequency[0] < 0 or not steps.min() >= LEAST_STEP:
        return None
    if np.ptp(steps) > 1e-3 * steps.mean() or not (np.any(re_ < 0) and np.any(im)):
        return None
    guesses = ("frequency [Hz], real and imaginary part: by the numbers, for the table has no header",)
    columns = {"frequency": "1", "re": "2", "im": "3"}
    return GuessedFrf(columns, "", frequency, (re_ + 1j * im)[:, None], guesses=guesses)


# Variables: fewest lines of an FRF, most elements that are listed, names of FRFs, of their frequencies and of
# spectra that are no FRFs.
LEAST_LINES, MOST_ELEMENTS = 16, 40
_FRF = re.compile(
    r"(^|[^a-z])(h[f\d]*|tf|frfs?)([^a-z]|$)|frf|recep|mobil|inertan|accelerance|transfer", re.I
)
_AXIS = re.compile(r"freq|(^|[^a-z])(f|hz)([^a-z]|$)", re.IGNORECASE)
_SPECTRUM = re.compile(r"spec|cross|psd|csd|fft|corr", re.IGNORECASE)
_TIME = re.compile(r"time|(^|[^a-z])t([^a-z]|$)", re.IGNORECASE)
_FORMS = (("receptance", r"recep|complian"), ("mobility", r"mobil"), ("accelerance", r"inertan|accelerance"))
_PARTS = (("amplitude", r"ampl?(itude)?|mag(nitude)?|abs"), ("re", r"re(al)?"))
_OTHERS = {"amplitude": ("phase", r"phase|arg|ang(le)?"), "re": ("im", r"im(ag)?")}


def _guess_variables(source: frf_described.DescribedColumns) -> GuessedFrf | None:
    """The FRFs among variables: complex vectors, or amplitudes and phases, beside a rising vector."""
    vectors = _vectors(source)
    elements, guesses = _complex_elements(vectors)
    if not elements:
        elements, guesses = _pairs(vectors)
    sizes = [_first(vectors, parts).size for parts in elements.values()]
    size = max(sizes, key=sizes.count, default=0)
    elements = {name: parts for name, parts in elements.items() if _first(vectors, parts).size == size}
    axis = _axis_of(vectors, size, elements)
    lines, frequency = (
        ({"frequency": axis}, vectors[axis].real) if axis else frf_described.equal_steps(source, size)
    )
    if not elements or not lines:
        return None
    real = [name for name, part in vectors.items() if part.size == size and not np.iscomplexobj(part)]
    coherences = [name for name in real if re.search(r"coh", name, re.IGNORECASE) and name != axis]
    if len(elements) == 1 and len(coherences) == 1:
        next(iter(elements.values()))["coherence"] = coherences[0]
    elements = dict(list(elements.items())[:MOST_ELEMENTS])
    first = next(iter(elements))
    form = next((form for form, pattern in _FORMS if re.search(pattern, first, re.IGNORECASE)), "")
    form_text = (f"{form}: by the name {first}",) if form else ()
    values = np.asarray(np.stack([_first(vectors, parts) for parts in elements.values()], axis=1))
    unit = _unit_of_frf(source.unit(next(iter(elements[first].values()))))
    columns = {**lines, **(elements[first] if len(elements) == 1 else {})}
    listed, reference = ({}, "") if len(elements) == 1 else _elements_by_labels(source, elements)
    notes = (*form_text, *guesses)
    return GuessedFrf(columns, unit, frequency, values, "variables", listed, form, notes, reference=reference)


def _first(vectors: Vectors, parts: Mapping[str, str]) -> ComplexArray | FloatArray:
    return vectors[next(iter(parts.values()))]


def _elements_by_labels(source: frf_described.DescribedColumns, elements: Elements) -> tuple[Elements, str]:
    labels: dict[str, str] = {}
    references: set[str] = set()
    for part in source.signals:
        labels |= {f"{part.values}_{n}": label for n, label in enumerate(part.labels, 1)}
        references.update(part.references)
    named = [labels.get(name, "") for name in elements]
    if len(references) != 1 or "" in (*named, *references) or len(set(named)) < len(named):
        return elements, ""
    return dict(zip(named, elements.values(), strict=True)), references.pop()


def _vectors(source: frf_described.DescribedColumns) -> dict[str, ComplexArray | FloatArray]:
    """Vectors (n,) of numbers among the variables, and the columns of matrices as NAME_1, NAME_2, ..."""
    vectors: dict[str, ComplexArray | FloatArray] = {}
    for name in source.names:
        try:
            values = source.values(name)
        except DataError:
            continue
        if values.ndim == 1:
            vectors[name] = values if np.any(values.imag) else values.real
        elif values.ndim == 2 and np.any(values.imag):
            columns = values if values.shape[0] >= values.shape[1] else values.T
            for number, column in enumerate(columns.T, 1):
                vectors[f"{name}_{number}"] = column if np.any(column.imag) else column.real
    return {name: vector for name, vector in vectors.items() if vector.size >= LEAST_LINES}


Elements = dict[str, dict[str, str]]
Vectors = Mapping[str, ComplexArray | FloatArray]


def _complex_elements(vectors: Vectors) -> tuple[Elements, tuple[str, ...]]:
    complex_ = [name for name, vector in vectors.items() if np.iscomplexobj(vector)]
    for chosen in (
        [name for name in complex_ if _FRF.search(name) and not _SPECTRUM.search(name)],
        [name for name in complex_ if not _SPECTRUM.search(name)],
    ):
        if chosen:
            return {name: {"complex": name} for name in chosen}, ()
    if len(complex_) < len(vectors):
        return {}, ()
    # What is called a spectrum may be an FRF where nothing else is in the file.
    return {name: {"complex": name} for name in complex_}, ("FRFs, for the file holds nothing else",)


def _pairs(vectors: Vectors) -> tuple[Elements, tuple[str, ...]]:
    """Amplitudes with their phases, and real with imaginary parts, whose names differ in that word alone."""
    elements: Elements = {}
    guesses: list[str] = []
    for name, vector in vectors.items():
        alike = [other for other, part in vectors.items() if part.size == vector.size]
        for kind, pattern in _PARTS:
            match = re.search(rf"_?({pattern})$", name, re.IGNORECASE)
            is_axis = bool(np.all(np.diff(vector) > 0))
            if match is None or not match.start() or is_axis or not _FRF.search(name):
                continue
            stem, (other, wanted) = name[: match.start()], _OTHERS[kind]
            partner_name = re.compile(rf"{re.escape(stem)}_?({wanted})", re.IGNORECASE)
            partner = next(filter(partner_name.fullmatch, alike), "")
            if partner and other == "phase":
                other = "phase_rad" if np.abs(vectors[partner]).max() <= np.pi * (1 + 1e-6) else "phase_deg"
                guesses.append(f"{other} by its largest number")
            if partner:
                elements[stem] = {kind: name, other: partner}
    return elements, tuple(dict.fromkeys(guesses))


def _axis_of(vectors: Vectors, size: int, elements: Elements) -> str:
    """The rising vector of *size* numbers that is the frequency: by name, matrix, or as the only one."""
    real = {name: part for name, part in vectors.items() if part.size == size and not np.iscomplexobj(part)}
    rising = [name for name, part in real.items() if part[0] >= 0 and np.all(np.diff(part) > 0)]
    stems = {name.rpartition("_")[0] for name in elements}
    for group in (
        [name for name in rising if any(stem and stem in name for stem in elements)],
        [name for name in rising if _AXIS.search(name) and not _FRF.search(name.replace("freq", ""))],
        [name for name in rising if name.rpartition("_")[0] in stems],
        [name for name in rising if not _TIME.search(name)],
    ):
        if group:
            return group[0]
    return ""
