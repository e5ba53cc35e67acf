"""Frequencies and dampings of measurements by others with labpipe's 95 % intervals: does each mode have one,
and does it hold what others say?
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tests.validation.claims import Claim, Kind
from tests.validation.peers import recorded

MEASURED: Kind = "measured public data"
SETS = recorded("measured")["sets"]
NAMES = {"frequency": "f_n", "ratio": "zeta"}
# Aims: shares of modes with an interval and of intervals that hold the reference [%], half-width over half
# the range of the others.
WITH_INTERVAL, HELD, AS_WIDE = 95.0, 90.0, 3.0


@dataclass(frozen=True)
class Place:
    """A mode of a *run* of a *set*, fitted under the name *fit*: what others say of it, by quantity."""

    set: str
    run: str
    fit: str
    others: dict[str, tuple[float, ...]]


@dataclass(frozen=True)
class Stated:
    """A quantity of a mode with labpipe's interval, if any, warnings, and what others say."""

    place: Place
    quantity: str
    value: float
    interval: tuple[float, float] | None
    warnings: tuple[str, ...]

    @property
    def others(self) -> tuple[float, ...]:
        return self.place.others[self.quantity]

    @property
    def reference(self) -> float:
        """The median of the others."""
        return float(np.median(self.others))

    @property
    def holds(self) -> bool:
        return self.interval is not None and self.interval[0] <= self.reference <= self.interval[1]

    @property
    def reference_error(self) -> float:
        """Of the median of p results, 1.25 s / sqrt(p) with s = 1.483 median |x - median| (ISO 13528)."""
        off = np.abs(np.array(self.others) - self.reference)
        return float(1.25 * 1.483 * np.median(off) / np.sqrt(len(self.others)))

    @property
    def agrees(self) -> bool:
        """Whether E_n = |x - X| / sqrt(U_x^2 + U_X^2) is at most 1 (ISO 13528), U_x up to the end of the
        interval that is on the side of the reference, U_X = 2 u(X).
        """
        assert self.interval is not None
        off = self.reference - self.value
        reach = self.interval[1] - self.value if off > 0 else self.value - self.interval[0]
        return bool(abs(off) <= np.hypot(reach, 2 * self.reference_error))

    @property
    def beyond(self) -> float:
        """Distance of the reference from the nearer end, in half-widths; 0 where it is held."""
        low, high = self.interval or (np.nan, np.nan)
        return max(low - self.reference, self.reference - high, 0.0) / ((high - low) / 2)

    def claim(self, source: str, why: str, note: str) -> Claim:
        factor, unit = (1.0, "Hz") if self.quantity == "frequency" else (1e3, "10^-3")
        low, high = self.interval or (np.nan, np.nan)
        run = self.place.run.removeprefix(self.place.set).lstrip(", ").replace("_", " ").replace("beam", "")
        return Claim(
            f"{NAMES[self.quantity]} near {np.median(self.place.others['frequency']):.4g} Hz"
            + (f", {run}" if run else ""),
            factor * self.value,
            factor * self.reference,
            unit,
            factor * min(self.others),
            factor * max(self.others),
            MEASURED,
            source,
            "" if self.holds else why or "labpipe states no interval",
            note,
            stated=(factor * low, factor * high),
        )


def quantities(place: Place) -> Iterator[Stated]:
    """Frequency and damping of the mode of a fit that is nearest to what others say."""
    of = SETS[place.set]["labpipe"][place.run][place.fit]
    values = of["values"]
    # The one mass of a model has its frequency without a number.
    numbers = [name.removeprefix("f_n") for name in values if name.startswith("f_n")]
    reference = float(np.median(place.others["frequency"]))
    number = min(numbers, key=lambda at: abs(values[f"f_n{at}"]["value"] - reference))
    for quantity, name in NAMES.items():
        if quantity in place.others:
            one = values[f"{name}{number}"]
            interval = None if one["interval"] is None else (one["interval"][0], one["interval"][1])
            yield Stated(place, quantity, one["value"], interval, tuple(of["warnings"]))


def nearest_places(name: str) -> dict[str, list[dict[str, list[float]]]]:
    """What the other calculations of a set say by the place of a mode."""
    found: dict[str, list[dict[str, list[float]]]] = {}
    for peers in SETS[name]["lscf"].values():
        for place, of in peers.items():
            found.setdefault(place, []).append(
                {"frequency": list(of["frequency"]), "ratio": list(of["ratio"])}
            )
    for place, of in SETS[name].get("independent", {}).items():
        found.setdefault(place, []).append(of)
    return found


def joined(*said: dict[str, list[float]]) -> dict[str, tuple[float, ...]]:
    return {
        quantity: tuple(value for of in said for value in of.get(quantity, ()))
        for quantity in NAMES
        if any(of.get(quantity) for of in said)
    }


# What the software of the analyser's owners says.
PIEZO_AUTHORS = {
    "20.13": {"frequency": [20.122], "ratio": [0.010033]},
    "115.7": {"frequency": [115.74], "ratio": [0.0047168]},
    "314": {"frequency": [314.24], "ratio": [0.0028293]},
}


def piezo_places() -> list[Place]:
    of = nearest_places("piezo")
    return [
        Place("piezo", f"piezo, {run}", f"mode_{number}", joined(PIEZO_AUTHORS[at], *of[at]))
        for run in ("recording", "analyser")
        for number, at in enumerate(PIEZO_AUTHORS, start=1)
    ]


def hammer_places() -> list[Place]:
    return [
        Place("hammer", "hammer", f"mode_{number}", joined(*said))
        for number, said in enumerate(nearest_places("hammer").values(), start=1)
    ]


def plate_places() -> list[Place]:
    return [Place("plate", "plate", "modes", joined(*said)) for said in nearest_places("plate").values()]


def bench_places() -> list[Place]:
    (said,) = nearest_places("bench").values()
    return [Place("bench", f"bench {of}", "modes", joined(*said)) for of in "AB"]


def wing_places() -> list[Place]:
    """Each excitation against the other two."""
    places = []
    for number, (run, _) in enumerate(SETS["wing"]["labpipe"].items()):
        for mode, said in enumerate(nearest_places("wing").values(), start=1):
            others = {
                quantity: tuple(np.delete(values, number).tolist())
                for quantity, values in joined(*said).items()
            }
            places.append(Place("wing", run, f"mode_{mode}", others))
    return places


# What the authors read off the peaks of an FRF, and off all peaks of a filtered record.
FRAME_AUTHORS = {"2.17": 2.17, "6.89": 6.89, "13.24": 13.263}
CLAMPED_AUTHORS = {"frequency": [139.826], "ratio": [0.0012069]}


def frame_places() -> list[Place]:
    return [
        Place("frame", "frame", f"mode_{number}", joined({"frequency": [FRAME_AUTHORS[at]]}, *said))
        for number, (at, said) in enumerate(nearest_places("frame").items(), start=1)
    ]


def clamped_places() -> list[Place]:
    """Two decays against their own curve_fit, the hit against both."""
    by_run = SETS["clamped beam"]["curve_fit"]
    decays = [
        Place("clamped beam", run, "ring", joined(CLAMPED_AUTHORS, said)) for run, said in by_run.items()
    ]
    both = joined(CLAMPED_AUTHORS, *by_run.values())
    return [*decays, Place("clamped beam", "clamped beam, hit", "first", both)]


def silverbox_places() -> list[Place]:
    said = nearest_places("silverbox")
    return [
        Place("silverbox", run, "oscillator", joined(*said[run.partition(", ")[2]]))
        for run in SETS["silverbox"]["labpipe"]
    ]


def decays_of(name: str) -> list[Place]:
    """Every run of the ring-downs of a set: its authors, and curve_fit of each decay."""
    places = []
    for run, by_fit in SETS[name]["labpipe"].items():
        authors = SETS[name].get("by peaks", {}).get(run) or DECAYS[run.partition(",")[0]]
        others = joined(authors, SETS[name]["curve_fit"][run])
        places += [Place(name, run, fit, others) for fit in by_fit]
    return places


def bearing_places() -> list[Place]:
    return decays_of("bearing")


def beams_places() -> list[Place]:
    return decays_of("beams")


def tool_places() -> list[Place]:
    """Three modes that the authors read by eye; of one hit, the first."""
    places, of = [], nearest_places("tool")
    for at, ratio in {"1074": 0.034, "1961": 0.045, "2617": 0.045}.items():
        others = joined({"frequency": [float(at)], "ratio": [ratio]}, *of[at])
        runs = ("tool, automatic", "tool, poles", *(("tool, one hit",) if at == "1074" else ()))
        places += [Place("tool", run, "modes", others) for run in runs]
    return places


def band_places() -> list[Place]:
    """The third of them in five bands."""
    others = joined({"frequency": [2617.0]}, *nearest_places("tool")["2617"])
    runs = [run for run in SETS["tool"]["labpipe"] if run.endswith(" Hz")]
    return [Place("tool", run, "modes", {"frequency": others["frequency"]}) for run in runs]


def ruler_places() -> list[Place]:
    return [Place("ruler", "ruler", "modes", joined(*said)) for said in nearest_places("ruler").values()]


def free_beam_places() -> list[Place]:
    return [
        Place("free beam", "free beam", f"mode_{number}", joined({"frequency": [float(at)]}, *said))
        for number, (at, said) in enumerate(nearest_places("free beam").items(), start=1)
    ]


# The authors' frequency [Hz] and damping ratio of the ring-downs.
DECAYS = {
    "radial": {"frequency": [32.012], "ratio": [0.043]},
    "axial": {"frequency": [38.594], "ratio": [0.032]},
}


def everything() -> list[Stated]:
    places = [
        *bearing_places(),
        *beams_places(),
        *tool_places(),
        *ruler_places(),
        *free_beam_places(),
        *piezo_places(),
        *hammer_places(),
        *plate_places(),
        *bench_places(),
        *wing_places(),
        *frame_places(),
        *clamped_places(),
        *silverbox_places(),
    ]
    return [stated for place in places for stated in quantities(place)]


def intervals() -> list[Claim]:
    """Counts over all sets, of frequencies and of dampings."""
    claims, everyone = [], everything()
    for quantity, name in (("frequency", "frequencies"), ("ratio", "dampings")):
        of = [stated for stated in everyone if stated.quantity == quantity]
        with_interval = [stated for stated in of if stated.interval is not None]
        held = [stated for stated in with_interval if stated.holds]
        alike = [stated for stated in with_interval if stated.agrees]
        silent = [stated for stated in with_interval if not stated.agrees and not stated.warnings]
        ratios = [
            (stated.interval[1] - stated.interval[0]) / (max(stated.others) - min(stated.others))
            for stated in with_interval
            if stated.interval is not None and len(stated.others) > 2
        ]
        share, held_share, alike_share = (
            100 * len(part) / len(whole)
            for part, whole in ((with_interval, of), (held, with_interval), (alike, with_interval))
        )
        for said, value, aim, low, high, unit in (
            (f"{name} with an interval, of {len(of)}", share, 100.0, WITH_INTERVAL, 100.0, "%"),
            (f"intervals of {name} that hold the reference", held_share, 95.0, HELD, 100.0, "%"),
            (f"{name} that agree with it by both uncertainties", alike_share, 95.0, HELD, 100.0, "%"),
            (
                f"half-width over half the range of the others, {name}, median of {len(ratios)}",
                float(np.median(ratios)),
                1.0,
                0.0,
                AS_WIDE,
                "1",
            ),
            (f"{name} wrong without a warning", float(len(silent)), 0.0, -0.5, 0.5, "1"),
        ):
            places = dict.fromkeys(f"{stated.place.run}" for stated in of if stated.interval is None)
            missed = [
                f"{stated.place.run} near {np.median(stated.place.others['frequency']):.4g} Hz "
                f"({stated.beyond:.2f})"
                for stated in with_interval
                if not stated.holds
            ]
            differ = [f"{stated.place.run}" for stated in with_interval if not stated.agrees]
            alone = dict.fromkeys(stated.place.run for stated in silent)
            why = {
                0: f"none in {', '.join(places)}",
                1: f"missed, in brackets by how many half-widths beyond the end: {', '.join(missed)}",
                2: f"not in {', '.join(differ)}",
                3: "too long",
                4: f"in {', '.join(alone)}",
            }[len(claims) % 5]
            claims.append(Claim(said, value, aim, unit, low, high, MEASURED, "all sets below", why))
    return claims
