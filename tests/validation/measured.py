"""Measurements by others, whose raw files are not shipped: rows from the record that `record_measured`
made. A row holds where labpipe's 95 % interval holds the median of what others say.
"""

from __future__ import annotations

from functools import partial

from tests.validation.claims import Claim, Kind, Method, within
from tests.validation.gaps import gaps
from tests.validation.held import (
    Place,
    band_places,
    beams_places,
    bearing_places,
    bench_places,
    clamped_places,
    frame_places,
    free_beam_places,
    hammer_places,
    intervals,
    piezo_places,
    plate_places,
    quantities,
    ruler_places,
    silverbox_places,
    tool_places,
    wing_places,
)
from tests.validation.peers import recorded

MEASURED: Kind = "measured public data"
SETS = recorded("measured")["sets"]


def said(name: str) -> str:
    """The sentence below a table: what was recorded when, with which commit, and labpipe's warnings."""
    file, entry = recorded("measured"), SETS[name]
    warned = [
        f"{title}{'' if len(fits) == 1 else ' ' + fit}: "
        + (", ".join(f"*{code}*" for code in of["warnings"]) or "none")
        for title, fits in entry["labpipe"].items()
        for fit, of in fits.items()
    ]
    where = f"{entry['repository']} at {entry['commit'][:12]}"
    return (
        f"{file['date']}, {file['program']}, {where}, rerun with `{file['command']}`. Warnings: "
        f"{'; '.join(warned)}."
    )


def value(name: str, title: str, fit: str, parameter: str) -> float:
    return float(SETS[name]["labpipe"][title][fit]["values"][parameter]["value"])


def stated(places: list[Place], source: str, why: str) -> list[Claim]:
    """Rows of modes with their intervals, and *why* one misses."""
    note = said(places[0].set)
    return [of.claim(source, why, note) for place in places for of in quantities(place)]


def number_of_modes(name: str, band: str, expected: int, source: str, why: str) -> Claim:
    ((_, fits), *_) = SETS[name]["labpipe"].items()
    (fit,) = fits.values()
    n = sum(parameter.startswith("f_n_") for parameter in fit["values"])
    return within(
        f"number of modes, {band}", n, expected, 0.5, "1", MEASURED, source, why, recorded=said(name)
    )


ONE_NUMBER = "one number for a damping that changes with the amplitude, by its peaks and by all samples"
SPLIT = "several poles stand for one peak of 3 to 5 % damping; sdypy-EMA's scatter as widely"
BANDS = "another band finds another of the poles that stand for this peak"
MOVED = "from point to point the mode moves, and a pair of poles fits better than one"
CHANCE = (
    "the reference lies up to 0.2 half-widths beyond the end; near 20.13 Hz a weak mode at 23.9 Hz is fitted "
    "beside it, which the references leave out; elsewhere the quarters of the record scatter by 1.3 of "
    "their standard errors, so that no drift shows, and of 300 simulated records of this length, block and "
    "noise the intervals of f_n hold in 99 and 97 %, those of zeta in 93 and 93 % (modes 2 and 3)"
)
SWEPT = "the five records differ in this mode by 3 %, and not every one of them shows it"
EXCITED = (
    "the excitations differ by more than the noise of one of them; the mode at 13.6 Hz is half a line wide"
)


def tool() -> list[Claim]:
    source = "Li 2019; sdypy-EMA"
    bands = [of for place in band_places() for of in quantities(place)]
    ends = [of.interval for of in bands if of.interval is not None]
    widest = max(high - low for low, high in ends)
    shared = min(high for _, high in ends) - max(low for low, _ in ends)
    return [
        *stated(tool_places(), source, SPLIT),
        *stated(band_places(), source, BANDS),
        Claim(
            "what the intervals of five bands share",
            shared,
            widest,
            "Hz",
            0.0,
            widest,
            MEASURED,
            source,
            BANDS if shared < 0 or len(ends) < len(bands) else "",
            said("tool"),
        ),
        number_of_modes("tool", "700 to 3000 Hz", 3, source, SPLIT),
    ]


def ruler() -> list[Claim]:
    source = "pydvma, Woodhouse; sdypy-EMA; independent"
    return [
        *stated(ruler_places(), source, MOVED),
        number_of_modes("ruler", "20 to 600 Hz", 6, source, MOVED),
    ]


def kit() -> list[Claim]:
    note, source = said("kit"), "AutomationShield"
    k_i, k_s = (value("kit", "kit", "magnet", name) for name in ("k_i", "k_s"))
    why = (
        "the force is not in proportion to the current: weight over mean current is not a slope; "
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
        "intervals": intervals,
        "bearing": lambda: stated(bearing_places(), "Højlund 2021; curve_fit", ONE_NUMBER),
        "beams": lambda: stated(beams_places(), "dexpilab1, 2022; curve_fit", ONE_NUMBER),
        "tool": tool,
        "ruler": ruler,
        "free beam": lambda: stated(free_beam_places(), "ModeLAB; sdypy-EMA; independent", ""),
        "kit": kit,
        "piezo": lambda: stated(piezo_places(), "SSCSA; sdypy-EMA; independent", CHANCE),
        "hammer": lambda: stated(hammer_places(), "Diegues 2025; sdypy-EMA; independent", MOVED),
        "plate": lambda: stated(plate_places(), "Gorjup 2026; independent", SWEPT),
        "bench": lambda: stated(bench_places(), "FdiTools; independent", ""),
        "wing": lambda: stated(wing_places(), "Arroju 2018; independent", EXCITED),
        "frame": lambda: stated(frame_places(), "Sid 2026; independent", MOVED),
        "clamped beam": lambda: stated(clamped_places(), "non_linear_beam, 2024; curve_fit", ONE_NUMBER),
        "silverbox": lambda: stated(silverbox_places(), "Rafa7046, 2023; independent", ""),
        "not tested": partial(gaps, "measured"),
    },
)
