"""A project from a recording: rig.yaml and pipeline.yaml, marked where a person must decide."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import DataError, LabpipeError
from labpipe.project import first_guess
from labpipe.project.guessed_frfs import GuessedFrf, guessed_frf
from labpipe.project.proposals import (
    UNSEEN,
    FirstLook,
    Proposal,
    Tests,
    decay_bands,
    drive_of,
    excitation_of,
    first_look,
    proposal_of,
    proposals,
    propose,
    quote,
    recordings_in,
    remark,
    turning_tacho,
    widen_bands,
    without_table,
)
from labpipe.project.ready_response import is_response, load_described, load_response
from labpipe.project.rig_file import DEFAULT_ROLES
from labpipe.project.settings_reader import DECIDE
from labpipe.project.tests import ReadyFrf
from labpipe.raw_files.first_look import Excitation
from labpipe.raw_files.joined_table import JoinedTable
from labpipe.raw_files.table import guard, open_table
from labpipe.raw_files.text_table import plain_suffix
from labpipe.raw_files.uff import UFF_SUFFIXES
from labpipe.records.frf_layout import FrfLayout, form_of_unit

MARK = "# <- decide:"
# What stands where a person must decide, before what.
OPEN = f"{DECIDE}    {MARK}"
# What init asks for: no recording shows it.
NOT_SHOWN = (
    "# mass: 1 kg                   # that moves with the response; without it the mass is estimated",
    "# What no recording shows counts as zero in every interval until it is stated (standard uncertainties):",
    "#   sensitivity: 10 mV/N +- 1 %   # the gain of every channel: k, c and m are wrong by as much",
    "#   mass: 1 kg +- 0.01 kg         # a sensor of mass m_t lowers f_n by m_t / 2 m of itself",
    "# A second test at half the force shows what the level does; `damping: hysteretic`, what its law does.",
)


@dataclass(frozen=True)
class Scaffold:
    """The text of the two files; *rig* is empty where the files are FRFs. *tacho*: the channel that shows a
    shaft that turns in a recording without a force. *left_out*: files of a folder that are not among its
    recordings, with the reason.
    """

    rig: str
    pipeline: str
    tacho: str | None = None
    left_out: tuple[str, ...] = ()

    @property
    def decisions(self) -> list[str]:
        """The marked lines, with the file that they stand in."""
        files = (("rig.yaml", self.rig), ("pipeline.yaml", self.pipeline))
        lines = ((name, n, line) for name, text in files for n, line in enumerate(text.splitlines(), 1))
        return [f"{name}:{n}" for name, n, line in lines if MARK in line]


def scaffold(named: Sequence[Path], folder: Path) -> Scaffold:
    """The project in *folder* for recordings, or for FRFs, without a rig, and for those of a folder that is
    *named*. DataError for unreadable files.
    """
    left_out: dict[str, str] = {}
    files: list[Path] = []
    for path in named:
        readable, others = recordings_in(path) if path.is_dir() else ([path], {})
        files, left_out = [*files, *readable], {**left_out, **others}
    of_files = _scaffold(files, folder)
    return replace(of_files, left_out=tuple(f"{name}: {why}" for name, why in left_out.items()))


def _scaffold(files: Sequence[Path], folder: Path) -> Scaffold:
    files, conditions = without_table(files)
    paths = [Path(os.path.relpath(path, folder)).as_posix() for path in files]
    if is_response(files[0]):
        try:
            return Scaffold("", _text(_pipeline_of_responses(files, paths, conditions)))
        except DataError:
            if plain_suffix(files[0]) not in UFF_SUFFIXES:
                raise
    guessed = guard(guessed_frf, files[0]) if files[0].is_file() else None
    if guessed is not None:
        return Scaffold("", _text(_pipeline_of_tables(guessed, files, paths)))
    running = [len(files) > 1 and _is_run_up(file) for file in files]
    together: list[str] = []
    if any(running) and not all(running):
        together = _rotor_lines(files, paths, running)
        files = [file for file, turns in zip(files, running, strict=True) if not turns]
        paths = [path for path, turns in zip(paths, running, strict=True) if not turns]
    joined = _join_files(files) if len(files) > 1 else None
    complete = first_look(joined or open_table(files[0]))
    first = complete.with_one_quantity()
    pairs = zip(complete.channels, first.channels, strict=True)
    references = [after.key for before, after in pairs if before != after]
    if joined:
        paths = [f"{{join: {quote(paths)}}}"]
    tests = Tests(files, paths, conditions)
    others = [] if len(paths) == 1 else [first_look(open_table(file)) for file in tests.further_files()]
    tacho = None if first.column_of("input") else turning_tacho(first)
    pipeline = _text([*_pipeline(first, tests, tacho, others), *together])
    if references:
        pipeline += BESIDE.format(", ".join(references))
    if "model: modal" in pipeline:
        # Forces act at no point of a response: its phase denies it.
        apart = (replace(c, dof=c.key) if c.role == "input" else c for c in first.channels)
        first = replace(first, channels=tuple(apart))
    return Scaffold(_text(_rig(first, files[0])), pipeline, tacho)


def _text(lines: Sequence[str]) -> str:
    return "\n".join(lines) + "\n"


def _join_files(files: Sequence[Path]) -> JoinedTable | None:
    """The files as one table where no two of them hold a channel of one name and unit: a force in one, its
    response in another. None for the recordings of several tests.
    """
    tables, held = [open_table(file) for file in files], Counter[tuple[str, str | None]]()
    common: list[str] = []
    for table in tables:
        names, rows = first_guess.first_rows(table)
        times = first_guess.time_columns(names, rows)
        common = [name for name in times if name in common or table is tables[0]]
        held.update((name, table.units.get(name)) for name in names if name not in times)
    if max(held.values(), default=2) > 1:
        return None
    with suppress(DataError):
        joined = JoinedTable(tables, common[0] if common else None)
        first_guess.first_rows(joined)
        return joined
    return None


def _is_run_up(file: Path) -> bool:
    """Whether a recording looks like that of a turning rotor: no force, and a tacho or another reference."""
    with suppress(LabpipeError):
        channels = first_look(open_table(file)).channels
        turns = any(channel.quantity == "tacho" or channel.role == "reference" for channel in channels)
        return turns and all(channel.role != "input" for channel in channels)
    return False


def _rotor_lines(files: Sequence[Path], paths: Sequence[str], running: Sequence[bool]) -> list[str]:
    lines = [
        "# Tests at rest and run-ups of one rotor are one posterior; of another rotor, leave it out.",
        "rotor_system:",
        f"  rotor: {OPEN} the rotor file, with what is known of it and how well",
        f"  small_errors: {{together: {DECIDE}}}    {MARK} how much all bearings may change together between "
        "rest and speed, 30 % for example, 0 % where they cannot; a run-up below the critical speed hardly "
        "tells it",
        "  tests:",
    ]
    for file, path, turns in zip(files, paths, running, strict=True):
        name = quote(file.stem)
        if turns:
            run = f"{{recording: {quote(path)}, rig: {DECIDE}, tacho: {DECIDE}}}"
            mark = f"{MARK} the rig file of its probes, and the channel of the tacho; load: where it has one"
            lines.append(f"    - {{name: {name}, kind: run-up, run: {run}}}    {mark}")
        else:
            lines.append(f"    - {{name: {name}, kind: response, test: {name}}}    # free: true on strings")
    return lines


def _rig(first: FirstLook, path: Path) -> list[str]:
    lines = [f"# The rig, as far as {path.name} describes it. Marked lines need a decision.", "name: My rig"]
    if first.time:
        lines.append(f"time: {quote(first.time)}")
    elif not first.rate:
        what = "the sampling rate, for example 20 kHz; the file does not state it"
        lines.append(f"sample_rate: {OPEN} {what}")
    lines.append("channels:                      # key = the name used everywhere else")
    undecided = [channel for channel in first.channels if channel.unit == DECIDE]
    open_units = [channel.quantity for channel in undecided if channel.quantity != DECIDE]
    seen: set[str] = set()
    for channel in first.channels:
        several = channel.unit == DECIDE and open_units.count(channel.quantity) > 1
        anchor = "*" if channel.quantity in seen else "&"
        lines.append(channel_line(channel, anchor if several else ""))
        if channel.unit == DECIDE:
            seen.add(channel.quantity)
    return [*lines, *(f"# not used: {unused}" for unused in first.unused), *NOT_SHOWN]


def channel_line(channel: first_guess.GuessedChannel, anchor: str) -> str:
    """A channel; *anchor*: '&' for a shared unit that is to be decided, '*' for a reference to it."""
    entries = {"column": quote(channel.column), "quantity": channel.quantity, "unit": quote(channel.unit)}
    if anchor:
        entries["unit"] = f"{anchor}{channel.quantity}" + (f" {DECIDE}" if anchor == "&" else "")
    entries |= {"role": channel.role, "dof": channel.dof} if channel.role else {"dof": channel.dof}
    if channel.sensitivity:
        entries["sensitivity"] = channel.sensitivity
    if channel.invert:
        entries["invert"] = "true"
    decisions = f"  {MARK} {'; '.join(channel.decisions)}" if channel.decisions else ""
    if anchor == "*":
        decisions = "  # the same unit" + (f"; {channel.guess}" if channel.guess else "")
    listed = ", ".join(f"{key}: {text}" for key, text in entries.items())
    return f"  {channel.key}: {{{listed}}}{decisions}".replace(f'"{DECIDE}"', DECIDE)


def _pipeline(first: FirstLook, tests: Tests, tacho: str | None, others: Sequence[FirstLook]) -> list[str]:
    paths = tests.paths
    inputs, outputs = first.column_of("input"), first.column_of("output")
    driven = first.driven()[:1]
    excitation = excitation_of(first.rows[:, driven[0]], first.rate or 1.0) if inputs else None
    decays = {} if inputs or tacho else decay_bands([first, *others], outputs)
    # Displacements and accelerations of a stator, which one response matrix cannot hold.
    quantities = {first.channels[number].quantity for number in outputs}
    if excitation is not None and {"displacement", "acceleration"} <= quantities:
        return _pipeline_of_stator(first, excitation, paths)
    peaks: Mapping[str, Proposal] = {}
    drive = None
    if excitation is not None:
        drive = drive_of(first, driven[0], excitation)
        if drive is not None:
            excitation = replace(excitation, band=excitation_of(first.rows[:, drive], first.rate or 1.0).band)
        if first.rate:
            peaks, excitation = proposals(first, driven, outputs, excitation, drive)
            for other in others:
                seen, _ = proposals(other, other.driven()[:1], outputs, excitation, drive)
                peaks = widen_bands(peaks, seen)
    recordings = tests.lines("recordings")
    acting = sorted(look.driven() for look in (first, *others))
    # No recording by itself tells its forces apart where all act with periods, or one of several.
    partial = acting == [[n] for n in inputs] or (excitation and excitation.kind == "periodic" and inputs[1:])
    if partial and len(acting) == len(paths) > 1 and not tests.conditions:
        recordings = [remark(_recordings(paths), "together they tell the forces apart")]
    lines = [
        f"# Evaluation of the recording{'s' if len(paths) > 1 else ''}. Paths are relative to this file.",
        "title: Stiffness and damping of my rig",
        "rig: rig.yaml",
        *recordings,
        *(RUNNING.format(paths[0], tacho).splitlines() if tacho else []),
        *(_frf_lines(excitation, first.rate) if not decays else DECAYING),
        *([remark(f"  reference: {first.channels[drive].key}", DRIVES)] if drive is not None else []),
        "identify:",
    ]
    if decays:
        return lines + [line for fit in decays.items() for line in _decay_lines(*fit, first.rate)]
    unknown = f"{OPEN} the channel of {{}}, once rig.yaml knows one"
    force = first.channels[driven[0]].key if inputs else unknown.format("the force")
    keys = [first.channels[number].key for number in outputs]
    keys = keys or [channel.key for channel in first.channels if channel.quantity == DECIDE]
    if not keys:
        lines.extend(_fit_lines("fit", force, unknown.format("a response"), UNSEEN))
    # A motion that drives is that of a base.
    of_base = bool(inputs) and DEFAULT_ROLES.get(first.channels[inputs[0]].quantity) == "output"
    if of_base:
        peaks = {key: replace(peaks.get(key, UNSEEN), model="base") for key in keys}
    fits = {key: (f"fit_{key}", peaks.get(key, UNSEEN)) for key in keys}
    common = [] if of_base else _common_fit(first, peaks, excitation)
    lines.extend(common or _lines_of_all_fits(force, fits))
    coupled = "# Coupled responses: model: mdof, with one force after the other. See docs/pages/models.md."
    return [*lines, coupled]


# Responses that look like a mode, from which on all of them are one modal test.
MODAL_TEST = 3
BESIDE = """# Not among the FRFs: {}, in case they are of the same points. Where they are not, `role: output`
# in rig.yaml takes them in. `result: spectra` holds all quantities of all points.
"""
DECAYING = ["frf:", "  excitation: decay            # a guess: there is no force, and the responses die away"]
RUNNING = """# No force, and a tacho: the shaft runs, and its unbalance is the force. From this folder
#   labpipe orders {} -r rig.yaml --tacho {} -o orders
# follows 1x over the speeds; with --slow-roll and --speed-range it judges critical speeds."""
DRIVES = "drives the shaker: lines that it lacks are distortion, no excitation"


def _decay_lines(output: str, band: tuple[float, float], rate: float) -> list[str]:
    lines = [f"  ring_{output}:", "    model: decay", "    modes: 1", f"    output: {output}"]
    return [*lines, _band_line(*band, "around the highest peak", 4)] if rate else lines


def _band_line(low: float, high: float, why: str, digits: int = 6) -> str:
    return remark(f"    band: {low:.{digits}g}-{high:.{digits}g} Hz", why)


def _recordings(paths: Sequence[str]) -> str:
    return f"recordings: [{', '.join(map(quote, paths))}]"


def _pipeline_of_stator(first: FirstLook, excitation: Excitation, paths: Sequence[str]) -> list[str]:
    return [
        "# Displacements and accelerations side by side, as on a stator that floats around its shaft. Paths "
        "are relative to this file.",
        "# For an FRF of one quantity give the others role: reference in rig.yaml, and leave `result` out.",
        "title: Dynamic stiffness of my rig",
        "rig: rig.yaml",
        _recordings(paths),
        *_frf_lines(excitation, first.rate),
        "  result: spectra",
        "identify:",
        "  film:",
        "    model: dynamic-stiffness",
        "    dynamic_stiffness:",
        f"      stator_mass: {OPEN} the mass that moves with the stator, with its uncertainty: "
        "60 kg +- 0.1 kg",
    ]


def _frf_lines(excitation: Excitation | None, rate: float) -> list[str]:
    if excitation is None:
        kinds = "periodic (with period: 1 s), random or impact (with block: 1 s), decay (no force)"
        return ["frf:", f"  excitation: {OPEN} {kinds}"]
    why = {
        "periodic": f"period of {excitation.length} samples, {excitation.repeats} times",
        "random": "force without a period",
        "impact": f"{excitation.repeats} hits",
        "stepped-sine": f"{excitation.repeats} dwells",
        "sweep": f"{excitation.repeats} sweep(s)",
    }[excitation.kind]
    low, high = excitation.band
    length = f"{OPEN} the time that {excitation.length} samples take"
    length = f"{excitation.length / rate:.12g} s" if rate else length
    lines = ["frf:", remark(f"  excitation: {excitation.kind}", why)]
    if excitation.kind in ("random", "impact"):
        lines.append(f"  block: {length}")
    if excitation.kind == "periodic":
        lines += [
            f"  period: {length}",
            remark(f"  skip: {int(excitation.repeats > 2)}", "transient periods"),
        ]
    if rate and excitation.kind != "stepped-sine":
        # The line at 0 Hz says nothing of a motion.
        low = low or rate / excitation.length
        lines.append(remark(f"  band: {low:.6g}-{high:.6g} Hz", "where the force has power"))
    return lines


# Fits by their responses: names and proposals.
Fits = Mapping[str, tuple[str, Proposal]]


def _lines_of_all_fits(force: str, fits: Fits, estimator: str = "ml") -> list[str]:
    """A fit for each response, as comments where no peak looks like a mode and others have one."""
    some = any(proposal.is_mode for _, proposal in fits.values())
    lines: list[str] = []
    for output, (name, proposal) in fits.items():
        fit = _fit_lines(name, force, output, proposal, estimator)
        if some and not proposal.is_mode:
            fit = [f"# no peak of {output} looks like a mode:", *(f"# {line}" for line in fit)]
        lines += fit
    return lines


def _common_fit(first: FirstLook, peaks: Mapping[str, Proposal], excitation: Excitation | None) -> list[str]:
    """One fit of all responses: of a rotor, where two forces act along those of two responses, or of modes,
    where MODAL_TEST or more look like one; else no lines.
    """
    forces, responses = (
        [first.channels[number].dof for number in first.column_of(role)] for role in ("input", "output")
    )
    if sum(proposal.is_mode for proposal in peaks.values()) >= MODAL_TEST and excitation is not None:
        what = "all responses together; `sdof` gives k and c where force and response meet"
        low, high = excitation.band
        low = low or 1 / (excitation.length / first.rate)
        band = _band_line(low, high, "a narrower one is fitted faster")
        return ["  modes:", remark("    model: modal", what), band]
    if len(forces) != 2 or sorted(forces) != sorted(responses) or not set(forces) < set("xyz"):
        return []
    mass = f"    mass: {OPEN} what moves in the bearings, with its uncertainty: 1 kg +- 0.01 kg"
    lines = ["  rotor:", remark("    model: rotor-2dof", "k and c of both directions and across"), mass]
    bands = [proposal.band for proposal in peaks.values() if proposal.band is not None]
    if bands:
        lines.append(_band_line(min(bands)[0], max(high for _, high in bands), "around the highest peaks"))
    return lines


def _fit_lines(name: str, force: str, output: str, proposal: Proposal, estimator: str = "ml") -> list[str]:
    by_model = {
        "sdof": ["    model: sdof", f"    estimator: {estimator}"],
        "modal": [remark("    model: modal", "`sdof` gives k and c where force and response meet")],
        "base": [remark("    model: base", "f_n and zeta; with mass: 1 kg also k and c")],
    }
    last = {"modal": [remark("    modal: {order: 6}", "few poles for one peak; higher for close modes")]}
    lines = [f"  {name}:", *by_model[proposal.model], f"    input: {force}", f"    output: {output}"]
    if proposal.band is not None:
        lines.append(_band_line(*proposal.band, "around the highest peak"))
    # Between lines of noise a mode needs more orders to return.
    return lines + last.get(proposal.model if proposal.is_mode else "", [])


def _mode_lines(files: Sequence[Path], guessed: GuessedFrf) -> list[str]:
    """A modal fit for each peak of the mobility of all *files*, root mean square over their points."""
    parts = (guard(guessed_frf, file) for file in files)
    sizes = [np.abs(part.values[:, 0]) for part in parts if part is not None]
    if any(size.shape != sizes[0].shape for size in sizes):
        return MODES
    moving = guessed.frequency > 0
    frequency = guessed.frequency[moving]
    mobility = np.sqrt(np.mean(np.square(sizes), axis=0))[moving] * frequency ** _order(guessed)
    peaks = first_guess.peaks_of(mobility)
    ends = [*(peaks[:-1] + peaks[1:]) // 2, frequency.size - 1]
    # Stretches of lines with their peaks: those that are too short for a fit go with the next.
    stretches: list[tuple[int, list[int]]] = []
    begin, inside = 0, []
    for peak, end in zip(peaks.tolist(), ends, strict=False):
        inside.append(peak)
        if end - begin >= first_guess.MODAL_LINES or end == ends[-1]:
            stretches.append((begin, inside))
            begin, inside = int(end), []
    if len(stretches) > 1 and ends[-1] - stretches[-1][0] < first_guess.MODAL_LINES:
        begin, inside = stretches.pop()
        stretches[-1][1].extend(inside)
    lines = []
    after = [*(begin for begin, _ in stretches[1:]), frequency.size - 1]
    for number, ((begin, inside), end) in enumerate(zip(stretches, after, strict=True), 1):
        part = slice(begin, end + 1)
        bands = [
            first_guess.band_of(frequency[part], mobility[part], peak - begin, first_guess.MODAL_LINES)
            for peak in inside
        ]
        band = _band_line(bands[0][0], bands[-1][1], "around a peak of all points")
        lines += [f"  mode_{number}:", "    model: modal", band]
    return lines or MODES


MODES = ["  modes:", "    model: modal"]
HEAD_OF_FRFS = (
    "# What to do with the FRFs. Paths are relative to this file.",
    "title: Stiffness and damping from measured FRFs",
)


def _pipeline_of_responses(
    files: Sequence[Path], paths: Sequence[str], conditions: Mapping[str, Mapping[str, str]]
) -> list[str]:
    """Files that state their dofs: parts of one matrix where these fit together, else a test each."""
    response = load_response(files[0])
    if len(files) > 1:
        layout, dofs = FrfLayout(each=tuple(map(str, files))), ((),) * len(files)
        with suppress(DataError):
            whole = load_described(ReadyFrf(tuple(files), layout, dofs, dofs), layout, "", {})
            size = f"{len(whole.outputs)} responses by {len(whole.inputs)} forces, by the dofs in the files"
            lines = [remark("frfs:", f"one matrix of {size}"), f"  each: {quote(list(paths))}"]
            return [*HEAD_OF_FRFS, *lines, "identify:", *MODES]
    estimator = "ml" if response.covariance is not None else "ls"
    lines = [*HEAD_OF_FRFS, *Tests(files, paths, conditions).lines("frfs"), "identify:"]
    fits = {
        quote(port.label): (f"fit_{row + 1}", proposal_of(response, row, stated=True))
        for row, port in enumerate(response.outputs)
    }
    return [*lines, *_lines_of_all_fits(quote(response.inputs[0].label), fits, estimator)]


def _pipeline_of_tables(guessed: GuessedFrf, files: Sequence[Path], paths: Sequence[str]) -> list[str]:
    """A pipeline that begins with FRFs of another program: one file, or one for each point."""
    guessed = _with_falling_phase(guessed)
    lines = [*HEAD_OF_FRFS, *(f"# a guess, {guess}" for guess in guessed.guesses), "frfs:"]
    pattern = _pattern_of([Path(path).stem for path in paths])
    if len(paths) > 1:
        guess = remark(f"  pattern: {quote(pattern)}", "a guess: the one part in which the names differ")
        where = "where the dofs stand in the files' names, for example 'H_{output}_{input}'"
        lines += [f"  each: {quote(list(paths))}", guess if pattern else f"  pattern: {OPEN} {where}"]
    else:
        lines.append(f"  file: {quote(paths[0])}")
    if guessed.word:
        lines.append(f"  {guessed.word}: {_flow(guessed.columns)}")
    if guessed.conjugate:
        lines.append(remark("  conjugate: true", "the phase rises through the highest peak"))
    if any("coherence" in parts for parts in (guessed.columns, *guessed.elements.values())):
        lines.append(remark("  # averages: 16", "how many: with the coherence they give the noise"))
    lines += [
        remark("  # window: hann", "of the blocks; beside it, of random data:"),
        remark("  # excitation: random", "with overlap: 50 %, for example: takes the leakage out"),
        *_unit_lines(guessed),
    ]
    outputs, force = ["y"], quote(guessed.reference) if guessed.reference else "f"
    if guessed.elements:
        outputs = list(guessed.elements) if guessed.reference else _labels(guessed.elements)
        lines.append("  elements:                    # the dof of each response: any name, such as 3.z")
        pairs = zip(outputs, guessed.elements.values(), strict=True)
        lines += [f"    {quote(name)}: {_flow(parts)}" for name, parts in pairs]
    elif len(paths) == 1:
        lines.append(remark("  output: y", "the dof of the response: any name, such as 3.z"))
    if len(paths) == 1 or pattern:
        lines.append(remark(f"  input: {force}", "the dof of the force"))
    lines.append("identify:")
    if pattern:
        return [*lines, *_mode_lines(files, guessed)]
    if len(paths) > 1:
        outputs = [f"{OPEN} the dof of a response"]
        force = f"{OPEN} the dof of the force"
    fits = _fits_of(guessed, [*map(quote, outputs)] if guessed.reference else outputs)
    return [*lines, *_lines_of_all_fits(force, fits, "ls")]


def _fits_of(guessed: GuessedFrf, outputs: Sequence[str]) -> Fits:
    mobility, moving = _mobility(guessed), guessed.frequency > 0
    fits = {}
    for number, output in enumerate(outputs):
        proposal = UNSEEN
        if moving.sum() > 1 and number < mobility.shape[1]:
            # Without a form there is no stiffness.
            at_one_point = bool(guessed.unit or guessed.form)
            proposal = propose(guessed.frequency[moving], mobility[:, number], at_one_point=at_one_point)
        fits[output] = ("fit" if len(outputs) == 1 else f"fit_{number + 1}", proposal)
    return fits


def _mobility(guessed: GuessedFrf) -> FloatArray | ComplexArray:
    """Mobilities (n_line, n_element) [1] of FRFs above 0 Hz; amplitudes where nothing else is known."""
    moving, order = guessed.frequency > 0, _order(guessed)
    mobility = guessed.values[moving] * guessed.frequency[moving, None] ** order
    return mobility * 1j**order if np.iscomplexobj(mobility) else np.abs(mobility)


def _with_falling_phase(guessed: GuessedFrf) -> GuessedFrf:
    if not guessed.word or np.sum(guessed.frequency > 0) < 3:
        return guessed
    mobility = _mobility(guessed)
    peak, _ = first_guess.highest_peak(np.sqrt(np.mean(np.abs(mobility) ** 2, axis=1)))
    if not first_guess.phase_rises(mobility, peak):
        return guessed
    return replace(guessed, values=guessed.values.conj(), conjugate=True)


def _pattern_of(names: Sequence[str]) -> str:
    """The pattern of file names that differ in one part between `_`, `-`, dots and blanks; '' for others."""
    parts = [re.split(r"([-_.\s]+)", name) for name in names]
    if len(names) < 2 or len({len(row) for row in parts}) > 1:
        return ""
    varying = [n for n, column in enumerate(zip(*parts, strict=True)) if len(set(column)) > 1]
    if len(varying) != 1:
        return ""
    column = [row[varying[0]] for row in parts]
    # Letters before numbers, as in p1, p2, are no part of the dof.
    before = re.match(r"[^\d{}]*", column[0])
    word = before[0] if before and all(re.fullmatch(re.escape(before[0]) + r"\d+", p) for p in column) else ""
    if len(set(column)) < len(column) or any(set("{}") & set(name) for name in names):
        return ""
    row = list(parts[0])
    row[varying[0]] = word + "{output}"
    return "".join(row)


def _order(guessed: GuessedFrf) -> int:
    """The power of frequency from FRFs to mobilities; without a form for accelerance, which most are."""
    form = guessed.form or form_of_unit(guessed.unit)
    return {"receptance": 1, "mobility": 0}.get(form, -1)


def _flow(columns: Mapping[str, str]) -> str:
    entries = (f"{kind}: {quote(name)}" for kind, name in columns.items())
    return f"{{{', '.join(entries)}}}"


def _unit_lines(guessed: GuessedFrf) -> list[str]:
    if guessed.unit:
        return [f"  unit: {quote(guessed.unit)}"]
    if guessed.label:
        form = [f"  form: {guessed.form}"] if guessed.form else []
        mark = f"{MARK} the unit of the numbers, for example g/N; the records say {guessed.label}"
        return [*form, f"  unit: {DECIDE}    {mark}"]
    if guessed.form:
        return [remark(f"  form: {guessed.form}", "in SI units; for others add unit: g/N, for example")]
    return [f"  unit: {OPEN} the unit of the numbers, for example g/N, or m/(N.s^2)"]


def _labels(elements: Mapping[str, object]) -> list[str]:
    names = list(elements)
    differing = (n for n, letters in enumerate(zip(*names, strict=False)) if len(set(letters)) > 1)
    start = next(differing, min(map(len, names)))
    labels = [re.sub(r"\W+", "_", name[start:]).strip("_") or name for name in names]
    return labels if len(set(labels)) == len(labels) else [f"y{n}" for n in range(1, len(names) + 1)]
