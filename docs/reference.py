"""The reference pages, made from what reads the files: settings, units, codes of findings, and the help of
every command.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Collection
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
    "span": "whole number, or two as `2-60`",
    "flag": "`true` or `false`",
    "text": "text",
    "names": "name or list of names",
    "mass": "number, list, matrix or `estimate`",
    "values": "number or list of numbers",
    "matrix": "list of rows",
    "coefficients": "numbers by name",
    "groups": "lists of names",
    "series": "lists of numbers by name",
    "file": "file",
    "roots": "list of complex numbers, `-50 +- 300j` for a pair",
    "phasors": "`SIZE at ANGLE` by name",
    "texts": "texts by name",
    "section": "section, below",
    "sections": "sections by name, below",
    "entries": "list of sections, below",
}
# What stands between the name of a nested section and its table.
BELOW = {"section": "", "sections": " one entry per name", "entries": " a list; each entry holds"}


@functools.cache
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


def table(owner: type, known: str = "", without: Collection[str] = ()) -> str:
    """The settings of a dataclass as a table.

    Sections and lists of them follow below it, each under its dotted name.
    """
    from labpipe.estimation.settings import FitSettings, models_text
    from labpipe.records.settings import settings_of
    from labpipe.uncertainty.settings import CompareSettings, kinds_text

    taken = {FitSettings: models_text, CompareSettings: kinds_text}.get(owner, lambda _key: "")
    defaults = {field.name: field.default for field in dataclasses.fields(owner)}
    rows = ["| key | what it is | form | default |", "|---|---|---|---|"]
    below = []
    for name, (setting, needed) in settings_of(owner).items():
        if name in without:
            continue
        otherwise = "**needed**" if needed else default(defaults[name], setting.unit)
        rows.append(f"| `{name}` | {cell(setting.help)}{taken(name)} | {form(setting)} | {otherwise} |")
        if setting.section is not None:
            below.append(
                f"\n`{known}{name}:`{BELOW[setting.kind]}\n\n" + table(setting.section, f"{known}{name}.")
            )
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

    from labpipe.cli.main import COMMANDS, group

    codes = "Exit codes: 0 done and accepted; 1 done, but a rule fails; 2 not done."
    parts = ["# Commands", f"Every command, as `labpipe COMMAND --help` prints it. {codes}"]
    parent = click.Context(group, info_name="labpipe", terminal_width=100)
    for name in COMMANDS:
        context = click.Context(
            COMMANDS[name], info_name=name, parent=parent, terminal_width=100, max_content_width=100
        )
        parts.append(f"## {name}\n\n```text\n{COMMANDS[name].get_help(context)}\n```")
    return "\n\n".join(parts) + "\n"


def rig_page() -> str:
    from labpipe.project.calibrations import CertificateSettings
    from labpipe.project.rig_file import ChannelSettings, RigSettings

    return (
        "# Rig files\n\nWhat the rig is. `channels:` holds one entry per channel, under the name used "
        "everywhere else.\n\n"
        "`constants:` holds numbers with their uncertainty for channels that are sums of others (`derived`): "
        "[a floating stator](../how-to/floating.md#channels-that-are-sums-of-others).\n\n"
        f"{table(RigSettings)}\n## channels\n\n{table(ChannelSettings)}\n"
        "## sensitivity from a certificate\n\n[Calibration certificates](../how-to/certificates.md) in place "
        f"of a typed number:\n\n{table(CertificateSettings)}"
    )


def pipeline_page() -> str:
    from labpipe.project.pipeline_file import ReportSettings, UncertaintySettings, section_names
    from labpipe.records.frf_layout import FrfLayout
    from labpipe.records.sections import sections
    from labpipe.spectra.settings import FrfSettings

    named = ", ".join(f"`{name}`" for name in section_names())
    head = (DOCS / "pipeline-head.md").read_text(encoding="utf-8").strip()
    words = {
        "frfs": (
            "An entry that describes its file. How it is used: [FRFs of any "
            "layout](../how-to/frf-table.md#any-layout).",
            FrfLayout,
        ),
        "frf": ("How recordings become frequency responses.", FrfSettings),
        "uncertainty": (
            "How uncertainties are propagated, for all fits: [uncertainty budget](../how-to/budget.md).",
            UncertaintySettings,
        ),
        **{name: (section.words, section.settings) for name, section in sections()},
        "report": ("What `labpipe run` writes.", ReportSettings),
    }
    parts = ["# Pipeline files", f"What to do. Sections: {named}.", head]
    for name, (what, owner) in words.items():
        parts.append(f"## {name}\n\n{what}\n\n{table(owner, f'{name}.')}")
        parts += own_parts(name)
    return "\n\n".join(parts) + "\n"


def own_parts(section: str) -> list[str]:
    """The sections that some models have within a fit, and some kinds within a comparison."""
    from labpipe.estimation.settings import MODELS, model_kind
    from labpipe.uncertainty.settings import COMPARISONS, comparison_kind

    tables = {
        "identify": ("fit", "model", MODELS, model_kind),
        "compare": ("comparison", "kind", COMPARISONS, comparison_kind),
    }
    if section not in tables:
        return []
    what, key, names, kind_of = tables[section]
    own = ((name, kind) for name in names if (kind := kind_of(name)).settings is not None)
    return [
        f"`{kind.section}:` of a {what} with `{key}: {name}`\n\n{table(kind.settings, f'{kind.section}.')}"
        for name, kind in own
    ]


def bearing_page() -> str:
    from labpipe.bearings.kinds import BEARINGS

    parts = ["# Bearing files", "What `labpipe bearing` reads. `kind` chooses the model."]
    for name in BEARINGS:
        kind = BEARINGS[name]
        bare = "".join(f"\n\nA bare number of `{key}` is in {unit}." for key, unit in kind.bare_units.items())
        parts.append(f"## {name}\n\n{table(kind.settings)}{bare}")
    return "\n\n".join(parts) + "\n"


def rotor_page() -> str:
    from labpipe.methods.rotor.rotor_file import LISTS, DampingSettings, MaterialSettings, RotorSettings
    from labpipe.methods.run_ups.rotor_file import PinnedSettings

    words = "A shaft of beam elements on bearings of any kind. Nodes are numbered from 1, from left to right."
    parts = ["# Rotor files", words, table(RotorSettings)]
    parts += [f"## {name}\n\nA list; each entry holds:\n\n{table(owner)}" for name, owner in LISTS.items()]
    parts += rotor_bearing_parts()
    parts.append(
        f"## materials\n\nOne entry per material beside steel and aluminium.\n\n{table(MaterialSettings)}"
    )
    parts.append(f"## damping\n\n{table(DampingSettings)}")
    pinned = (
        "A rotor for run-ups runs between `pins: [NODE, NODE]` on one bearing, and names where it is "
        "measured: `planes: {NAME: NODE}`. It has no loads, and these entries in place of those above:"
    )
    parts.append(f"## pins\n\n{pinned}\n\n{table(PinnedSettings)}")
    return "\n\n".join(parts) + "\n"


def rotor_bearing_parts() -> list[str]:
    """What an entry of a rotor's bearings holds, kind by kind."""
    from labpipe.bearings.kinds import BEARINGS

    words = (
        "A list; each entry holds `node`, `kind` and the entries of that kind. Load and speed follow "
        "from the rotor."
    )
    parts = [f"## bearings\n\n{words}"]
    for name in BEARINGS:
        kind = BEARINGS[name]
        if kind.on_rotor is not None:
            parts.append(f"### {name}\n\n{table(kind.on_rotor)}")
        else:
            left_out = "".join(f", without `{entry}`" for entry in kind.operating)
            parts.append(f"### {name}\n\nAs in its [bearing file](bearing.md#{name}){left_out}.")
    return parts


def virtual_page() -> str:
    from labpipe.simulate.virtual_rigs import VIRTUAL_RIGS

    parts = [
        "# Virtual rigs",
        "What `labpipe simulate` and the section `study:` read. `kind` chooses the rig.",
    ]
    for name in VIRTUAL_RIGS:
        owner = VIRTUAL_RIGS[name].settings
        parts.append(f"## {name}\n\n{summary(owner)}\n\n{table(owner)}")
    return "\n\n".join(parts) + "\n"


def summary(owner: object) -> str:
    return (owner.__doc__ or "").strip().split("\n")[0]


def units_page() -> str:
    from labpipe.quantities import _BASE, _FIXED, _PREFIX, QUANTITIES

    rows = [f"| `{q.name}` | {q.symbol} | {q.si_unit} | {q.display_unit} |" for q in QUANTITIES.values()]
    return (
        "# Quantities and units\n\nFiles may use any unit of the right dimension. Inside labpipe, in "
        "`identification.json` and in exported tables all is in SI units, frequencies in Hz, angles in "
        "rad.\n\n| quantity | symbol | SI unit | shown in |\n|---|---|---|---|\n"
        + "\n".join(rows)
        + "\n\n## Units\n\nWith a prefix ("
        + ", ".join(f"`{prefix}`" for prefix in _PREFIX)
        + "): "
        + ", ".join(f"`{unit}`" for unit in _BASE)
        + ".\n\nAs they are: "
        + ", ".join(f"`{unit}`" for unit in _FIXED)
        + ".\n\nCompound units are written with `.`, `*` or a blank, `^` and one `/`: `N.s/m`, `m/(N.s^2)`, "
        "`N/m^1.5`.\n"
    )


def warnings_page() -> str:
    told = explained()
    rows = [
        f"| `{code}` | {cell(told[code][0])} | {cell(told[code][1])} |"
        for code in sorted(codes())
        if code in told
    ]
    return (
        "# Warnings and notes\n\nA warning limits how far a number can be trusted; a note only says what "
        "was done. Both travel with the "
        "result: recording, FRF, `identification.json`, report. Rules can ask for them: `accept: "
        "{direct.warnings: not collinear}`.\n\n"
        "| code | meaning | what to do |\n|---|---|---|\n" + "\n".join(rows) + "\n"
    )


def explained() -> dict[str, list[str]]:
    """code -> (meaning, what to do)."""
    text = (DOCS.parent / "labpipe/records/warnings.yaml").read_text(encoding="utf-8")
    told: dict[str, list[str]] = yaml.safe_load(text)
    return told


def codes() -> set[str]:
    """Every code that the source gives to a finding."""
    sources = (path.read_text(encoding="utf-8") for path in (ROOT / "labpipe").rglob("*.py"))
    return {code for source in sources for code in re.findall(r'\b(?:Finding|note)\(\s*"([^"]+)"', source)}
