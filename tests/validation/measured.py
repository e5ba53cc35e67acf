"""Measurements by others, whose raw files are not shipped: rows from the record that `record_measured`
made.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from tests.validation.claims import Claim, Kind, Method, among, within
from tests.validation.gaps import gaps
from tests.validation.peers import recorded

MEASURED: Kind = "measured public data"
SETS: dict[str, Any] = recorded("measured")["sets"]
# Fits of single hits farther than this from their median, in median deviations, are astray.
ASTRAY = 5.0


def said(name: str, *titles: str) -> str:
    """The sentence below a table: what was recorded when, with which commit, and labpipe's warnings."""
    file, entry = recorded("measured"), SETS[name]
    warned = [
        f"{title}{'' if len(fits) == 1 else ' ' + fit}: " + ", ".join(f"*{code}*" for code in of["warnings"])
        for title, fits in entry["labpipe"].items()
        if title in titles or not titles
        for fit, of in fits.items()
    ]
    where = f"{entry['repository']} at {entry['commit'][:12]}"
    return (
        f"{file['date']}, {file['program']}, {where}, rerun with `{file['command']}`. Warnings: "
        f"{'; '.join(warned)}."
    )


def value(name: str, title: str, fit: str, parameter: str) -> float:
    return float(SETS[name]["labpipe"][title][fit]["values"][parameter]["value"])


def modes_of(name: str, title: str, fit: str = "modes") -> list[tuple[float, float]]:
    """Frequency [Hz] and damping ratio of all modes."""
    values = SETS[name]["labpipe"][title][fit]["values"]
    numbers = [key.removeprefix("f_n_") for key in values if key.startswith("f_n_")]
    return [(values[f"f_n_{number}"]["value"], values[f"zeta_{number}"]["value"]) for number in numbers]


def nearest(modes: list[tuple[float, float]], frequency: float) -> tuple[float, float]:
    return min(modes, key=lambda mode: abs(mode[0] - frequency))


def usual(values: list[float]) -> list[float]:
    """Smallest and largest of the single fits, without those astray."""
    middle = float(np.median(values))
    spread = float(np.median(np.abs(np.array(values) - middle)))
    kept = [one for one in values if abs(one - middle) <= ASTRAY * spread] or values
    return [min(kept), max(kept)]


def decay(
    name: str, title: str, frequency: float, ratio: float, source: str, why: dict[str, str] | None = None
) -> list[Claim]:
    """Frequency and damping ratio of a ring-down among the authors' and curve_fit's."""
    peer, why, note = SETS[name]["curve_fit"][title], why or {}, said(name)
    f_n, zeta = value(name, title, "ring", "f_n_1"), value(name, title, "ring", "zeta_1")
    ratios = [1e3 * one for one in usual(peer["ratio"])]
    return [
        among(
            f"f_n, {title}",
            f_n,
            frequency,
            usual(peer["frequency"]),
            "Hz",
            MEASURED,
            source,
            why.get("f_n", ""),
            note,
        ),
        among(
            f"zeta, {title}",
            1e3 * zeta,
            1e3 * ratio,
            ratios,
            "10^-3",
            MEASURED,
            source,
            why.get("zeta", ""),
            note,
        ),
    ]


def bearing() -> list[Claim]:
    """The authors give one hit; all hits are held against it and against curve_fit of every hit."""
    source = "Højlund 2021"
    return [
        *decay(
            "bearing",
            "radial, one hit",
            32.012,
            0.043,
            source,
            {
                "zeta": "one number for a damping that falls with the amplitude: labpipe states the course "
                "beside it; *amplitude-dependent*"
            },
        ),
        *decay("bearing", "radial, all hits", 32.012, 0.043, source),
        *decay("bearing", "axial, one hit", 38.594, 0.032, source),
        *decay("bearing", "axial, all hits", 38.594, 0.032, source),
    ]


def beams() -> list[Claim]:
    why = (
        "0.2 % beside the nearest of the others: one number for a damping that rises and falls; "
        "*amplitude-dependent*"
    )
    return [
        *decay("beams", "steel", 7.873, 0.00615, "dexpilab1, 2022"),
        *decay("beams", "aluminium", 6.853, 0.00512, "dexpilab1, 2022", {"zeta": why}),
    ]


TOOL = ((1074.0, 0.034), (1961.0, 0.045), (2617.0, 0.045))
SPLIT = (
    "split into several modes, none of them here; *model-mismatch* and *unphysical* warn, no interval "
    "is given"
)
MERGED = "the authors' formula takes one peak for what are several; sdypy-EMA's poles scatter as widely"
BY_HAND = "with three poles by hand the third goes astray; *model-mismatch* warns, no interval is given"


def tool() -> list[Claim]:
    """Three modes that the authors read by eye."""
    source, note, found = "Li 2019", said("tool"), []
    peer = SETS["tool"]["lscf"]["tool, automatic"]
    for title, why in (("tool, automatic", SPLIT), ("tool, poles", BY_HAND)):
        for frequency, _ in TOOL:
            ours, _ = nearest(modes_of("tool", title), frequency)
            others = peer[f"{frequency:g}"]["frequency"]
            found.append(among(f"{title}, f_n", ours, frequency, others, "Hz", MEASURED, source, why, note))
    for frequency, ratio in TOOL:
        _, ours = nearest(modes_of("tool", "tool, automatic"), frequency)
        others = [1e3 * one for one in peer[f"{frequency:g}"]["ratio"]]
        found.append(
            among(
                f"zeta of the mode at {frequency:.0f} Hz",
                1e3 * ours,
                1e3 * ratio,
                others,
                "10^-3",
                MEASURED,
                source,
                MERGED,
                note,
            )
        )
    number = len(modes_of("tool", "tool, automatic"))
    found.append(
        within("number of modes, 700 to 3000 Hz", number, 3, 0.5, "1", MEASURED, source, SPLIT, recorded=note)
    )
    hit, _ = modes_of("tool", "tool, one hit")[0]
    others = peer["1074"]["frequency"]
    found.append(
        among(
            "one hit, f_n; their DFT peaks at the reference",
            hit,
            1071.0,
            others,
            "Hz",
            MEASURED,
            source,
            recorded=note,
        )
    )
    return found


# Free uniform beam, scaled to the first mode, which is therefore no reference; the last one is a torsion that
# it does not have.
RULER = (39.38, 108.55, 212.81, 351.78, 525.50, 551.5)


def ruler() -> list[Claim]:
    source, note, found = "pydvma, Woodhouse", said("ruler"), []
    peer, modes = SETS["ruler"]["lscf"]["ruler"], modes_of("ruler", "ruler")
    why = (
        "the accelerometer is moved and loads the ruler elsewhere each time: one pole stands for ten; "
        "*model-mismatch*, no interval"
    )
    for frequency in RULER:
        of = peer[f"{frequency:g}"]["frequency"]
        reference = of[1] if frequency in (RULER[0], RULER[-1]) else frequency
        found.append(
            among(
                f"f_n near {frequency:g} Hz",
                nearest(modes, frequency)[0],
                reference,
                of,
                "Hz",
                MEASURED,
                source,
                why,
                note,
            )
        )
    found.append(
        within(
            "number of modes, 20 to 600 Hz",
            len(modes),
            len(RULER),
            0.5,
            "1",
            MEASURED,
            source,
            f"three are split in two: {why}",
            recorded=note,
        )
    )
    return found


def free_beam() -> list[Claim]:
    source, note, found = "ModeLAB", said("free beam"), []
    for number, frequency in enumerate((111.99, 306.86, 596.37, 974.14), start=1):
        ours, ratio = nearest(modes_of("free beam", "free beam", f"mode_{number}"), frequency)
        peer = SETS["free beam"]["lscf"][f"free beam, mode_{number}"][f"{frequency:g}"]
        found.append(
            among(
                f"f_n of mode {number}",
                ours,
                frequency,
                peer["frequency"],
                "Hz",
                MEASURED,
                source,
                recorded=note,
            )
        )
        ratios = [1e6 * one for one in peer["ratio"]]
        found.append(
            among(
                f"zeta of mode {number}, of LSCF",
                1e6 * ratio,
                ratios[1],
                ratios,
                "10^-6",
                "peer program",
                "sdypy-EMA",
                recorded=note,
            )
        )
    return found


def kit() -> list[Claim]:
    note, source = said("kit"), "AutomationShield"
    k_i, k_s = (value("kit", "kit", "magnet", name) for name in ("k_i", "k_s"))
    why = (
        "the force is not in proportion to the current: weight over mean current is no slope; "
        "*model-mismatch* warns"
    )
    return [
        within(
            "current over position at rest, k_s / k_i",
            k_s / k_i,
            6.23,
            0.16,
            "A/m",
            MEASURED,
            f"{source}, statics",
            recorded=note,
        ),
        within(
            "force per current k_i",
            abs(k_i),
            0.429,
            0.05,
            "N/A",
            MEASURED,
            f"{source}, weight over current",
            why,
            relative=True,
            recorded=note,
        ),
    ]


METHOD = Method(
    "measured",
    "Measurements by others",
    {
        "bearing": bearing,
        "beams": beams,
        "tool": tool,
        "ruler": ruler,
        "free beam": free_beam,
        "kit": kit,
        "not tested": partial(gaps, "measured"),
    },
)
