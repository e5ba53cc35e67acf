"""The reference pages, made from what reads the files: settings, units, codes of findings, and the help of every command."""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

DOCS = Path(__file__).parent
ROOT = DOCS.parent
KINDS = {
    "value": "number with unit",
    "uncertain": "number with unit, may carry `+- error`",
    "band": "range, as `60-70 Hz`",
    "bands": "list of ranges",
    "peaks": "ranges by dof",
    "integer": "whole number",
    "flag": "`true` or `false`",
    "text": "text",
    "names": "name or list of names",
    "mass": "number, list, matrix or `estimate`",
    "values": "number or list of numbers",
    "matrix": "list of rows",
    "coefficients": "numbers by name",
    "groups": "lists of names",
    "series": "lists of numbers by name",
    "section": "section, below",
}


def reference_pages() -> dict[str, str]:
    """Name -> Markdown of every page of the reference."""
    return {
        "commands": commands_page(),
        "rig": rig_page(),
        "pipeline": pipeline_page(),
        "bearing": bearing_page(),
        "rotor": rotor_page(),
        "virtual": virtual_page(),
        "units": units_page(),
        "warnings": warnings_page(),
    }


def table(owner: type, known: str = "") -> str:
    """The settings of a dataclass as a table; sections follow below it, each under its dotted name."""
    from labpipe.records.settings import settings_of

    defaults = {field.name: field.default for field in dataclasses.fields(owner)}
    rows = ["| key | what it is | form | default |", "|---|---|---|---|"]
    below = []
    for name, (setting, needed) in settings_of(owner).items():
        otherwise = "**needed**" if needed else default(defaults[name], setting.unit)
        rows.append(f"| `{name}` | {cell(setting.help)} | {form(setting)} | {otherwise} |")
        if setting.section is not None:
            below.append(f"\n`{known}{name}:`\n\n" + table(setting.section, f"{known}{name}."))
    return "\n".join(rows) + "\n" + "\n".join(below)


def form(setting: Any) -> str:
    """What may be written, with the SI unit in which a bare number is meant."""
    if setting.kind == "choice":
        return ", ".join(f"`{choice}`" for choice in setting.choices)
    return KINDS[setting.kind] + (f" [{setting.unit}]" if setting.unit not in ("", "1") else "")


def default(value: object, unit: str) -> str:
    if dataclasses.is_dataclass(value) or value is None or value == () or value == "":
        return ""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple):
        return cell(", ".join(f"`{one}`" for one in value))
    return f"`{value:g} {unit}`".replace(" 1`", "`") if isinstance(value, float) else f"`{value}`"


def cell(text: str) -> str:
    return text.replace("|", "\\|")


def commands_page() -> str:
    import click

    from labpipe.cli.main import COMMANDS, TABLE, group

    codes = "Exit codes: 0 done and accepted; 1 done, but a rule fails; 2 not done."
    parts = ["# Commands", f"Every command, as `labpipe COMMAND --help` prints it. {codes}"]
    parent = click.Context(group, info_name="labpipe", terminal_width=100)
    for name in COMMANDS:
        context = click.Context(TABLE[name], info_name=name, parent=parent, terminal_width=100, max_content_width=100)
        parts.append(f"## {name}\n\n```text\n{TABLE[name].get_help(context)}\n```")
    return "\n\n".join(parts) + "\n"


def rig_page() -> str:
    from labpipe.config.rig import ChannelSettings, RigSettings

    return (
        "# Rig files\n\nWhat the rig is. `channels:` holds one entry per channel, under the name used everywhere else.\n\n"
        f"{table(RigSettings)}\n## channels\n\n{table(ChannelSettings)}"
    )


def pipeline_page() -> str:
    from labpipe.campaign.settings import CompareSettings
    from labpipe.config.calibration import CalibrationSettings
    from labpipe.config.pipeline import SECTIONS, ReportSettings
    from labpipe.identify.settings import FitSettings
    from labpipe.rigs.unbalance_runs import UnbalanceSettings, WearCase
    from labpipe.run_ups.settings import RunSettings, RunUpSettings
    from labpipe.spectra.settings import FrfSettings
    from labpipe.study.settings import StudySettings

    sections = {
        "frf": ("How recordings become frequency responses.", FrfSettings),
        "identify": ("One entry per fit, under a name of your choice.", FitSettings),
        "compare": ("One entry per question to tests that differ in a condition, under a name of your choice.", CompareSettings),
        "calibrate": ("One entry per straight line to be fitted.", CalibrationSettings),
        "study": ("The fits repeated on a virtual rig.", StudySettings),
        "unbalance": ("The model's response to unbalance over speed.", UnbalanceSettings),
        "run_ups": ("Coefficients from unbalance run-ups.", RunUpSettings),
        "report": ("What `labpipe run` writes.", ReportSettings),
    }
    below = {
        UnbalanceSettings: ("`unbalance.cases:` one entry per state of wear", WearCase),
        RunUpSettings: ("`run_ups.runs:` one entry per run", RunSettings),
    }
    named = ", ".join(f"`{name}`" for name in SECTIONS)
    parts = ["# Pipeline files", f"What to do. Sections: {named}.", (DOCS / "pipeline-head.md").read_text(encoding="utf-8").strip()]
    for name, (words, owner) in sections.items():
        parts.append(f"## {name}\n\n{words}\n\n{table(owner, f'{name}.')}")
        if owner in below:
            parts.append(f"{below[owner][0]}\n\n{table(below[owner][1])}")
    return "\n\n".join(parts) + "\n"


def bearing_page() -> str:
    from labpipe.bearings.kinds import BEARINGS

    parts = ["# Bearing files", "What `labpipe bearing` reads. `kind` chooses the model."]
    for name in BEARINGS:
        kind = BEARINGS[name]
        bare = "".join(f"\n\nA bare number of `{key}` is in {unit}." for key, unit in kind.bare_units.items())
        parts.append(f"## {name}\n\n{table(kind.settings)}{bare}")
    return "\n\n".join(parts) + "\n"


def rotor_page() -> str:
    from labpipe.config.rotor import LISTS, DampingSettings, MaterialSettings, RotorSettings

    words = "A shaft of beam elements in journal bearings. Nodes are numbered from 1, from left to right."
    parts = ["# Rotor files", words, table(RotorSettings)]
    parts += [f"## {name}\n\nA list; each entry holds:\n\n{table(owner)}" for name, owner in LISTS.items()]
    parts.append(f"## materials\n\nOne entry per material beside steel and aluminium.\n\n{table(MaterialSettings)}")
    parts.append(f"## damping\n\n{table(DampingSettings)}")
    return "\n\n".join(parts) + "\n"


def virtual_page() -> str:
    from labpipe.config.virtual_rig import VIRTUAL_RIGS

    parts = ["# Virtual rigs", "What `labpipe simulate` and the section `study:` read. `kind` chooses the rig."]
    parts += [f"## {name}\n\n{summary(VIRTUAL_RIGS[name])}\n\n{table(VIRTUAL_RIGS[name])}" for name in VIRTUAL_RIGS]
    return "\n\n".join(parts) + "\n"


def summary(owner: object) -> str:
    return (owner.__doc__ or "").strip().split("\n")[0]


def units_page() -> str:
    from labpipe.quantities import _BASE, _FIXED, _PREFIX, QUANTITIES

    rows = [f"| `{q.name}` | {q.symbol} | {q.si_unit} | {q.display_unit} |" for q in QUANTITIES.values()]
    return (
        "# Quantities and units\n\nFiles may use any unit of the right dimension. Inside labpipe, in `identification.json` and in exported "
        "tables all is in SI units, frequencies in Hz, angles in rad.\n\n| quantity | symbol | SI unit | shown in |\n|---|---|---|---|\n"
        + "\n".join(rows)
        + "\n\n## Units\n\nWith a prefix ("
        + ", ".join(f"`{prefix}`" for prefix in _PREFIX)
        + "): "
        + ", ".join(f"`{unit}`" for unit in _BASE)
        + ".\n\nAs they are: "
        + ", ".join(f"`{unit}`" for unit in _FIXED)
        + ".\n\nCompound units are written with `.`, `*` or a blank, `^` and one `/`: `N.s/m`, `m/(N.s^2)`, `N/m^1.5`.\n"
    )


def warnings_page() -> str:
    told = explained()
    rows = [f"| `{code}` | {cell(told[code][0])} | {cell(told[code][1])} |" for code in sorted(codes()) if code in told]
    return (
        "# Warnings and notes\n\nA warning limits how far a number can be trusted; a note only says what was done. Both travel with the "
        "result: recording, FRF, `identification.json`, report. Rules can ask for them: `accept: {direct.warnings: not collinear}`.\n\n"
        "| code | meaning | what to do |\n|---|---|---|\n" + "\n".join(rows) + "\n"
    )


def explained() -> dict[str, list[str]]:
    """code -> (meaning, what to do)."""
    told: dict[str, list[str]] = yaml.safe_load((DOCS / "warnings.yaml").read_text(encoding="utf-8"))
    return told


def codes() -> set[str]:
    """Every code that the source gives to a finding."""
    return {code for path in sorted((ROOT / "labpipe").rglob("*.py")) for code in _codes_in(path)}


def _codes_in(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("Finding", "note") and node.args:
            code = node.args[0]
            if isinstance(code, ast.Constant) and isinstance(code.value, str):
                yield code.value
