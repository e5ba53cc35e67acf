"""What the numbers of a result say of each other, whatever method they come from, and its report of them: an
independent reader of both, by the definitions of the pages. Every `labpipe run` of the tests is held to it.
"""

from __future__ import annotations

import itertools
import json
import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np

from labpipe.uncertainty.settings import comparison_kind

Entry = Mapping[str, Any]
# Relative: files hold all digits of what was computed once, and a sum of it is rounded again.
SAME = 1e-6
PREFIXES = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9}
POWERS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
# A rule as it is written: address, comparison, number, unit, tolerance and its unit.
_NUMBER = r"([+-]?[\d.]+(?:e[+-]?\d+)?)(?: ?(%)| ([^ +-]\S*))?"
RULE = re.compile(rf"(.+?)(\.covers)? (?:(>=|<=|<|>) )?{_NUMBER}(?: \+- {_NUMBER})?")


def held(folder: Path) -> None:
    """AssertionError where a result in the folder, or its report, contradicts itself."""
    path = folder / "identification.json"
    if not path.is_file():
        return
    result = json.loads(path.read_text("utf-8"))
    found = disagreements(result)
    if (report := folder / "report.html").is_file():
        found += misprints(report.read_text("utf-8"), result)
    assert not found, found[:5]


def disagreements(result: Entry) -> list[str]:
    """Every number of a result that contradicts another one, with both."""
    return [
        *itertools.chain.from_iterable(_of_fit(fit) for fit in result.get("fits", ())),
        *itertools.chain.from_iterable(_of_comparison(entry) for entry in result.get("comparisons", ())),
        *itertools.chain.from_iterable(_of_matrix(entry) for entry in result.get("matrices", ())),
        *itertools.chain.from_iterable(_of_response(entry) for entry in result.get("responses", ())),
        *itertools.chain.from_iterable(_of_rule(rule) for rule in (*result["accept"], *result["expect"])),
        *(_of_rotor_system(result["rotor_system"]) if result.get("rotor_system") else ()),
    ]


def _is(a: float, b: float, size: float = 0.0) -> bool:
    return abs(a - b) <= SAME * max(abs(a), abs(b), size)


def _outside(value: float | None, ends: Sequence[float | None] | None = (0, 1)) -> bool:
    """Whether a value lies outside; an end that is none is infinite."""
    if value is None or ends is None:
        return False
    low, high = ends
    return not (low is None or low <= value) or not (high is None or value <= high)


def _of_fit(fit: Entry) -> Iterator[str]:
    title = f"{fit['name']} [{fit['test']}] {fit['band_hz']}"
    parameters = fit["parameters"]
    for parameter in parameters:
        yield from (f"{title} {text}" for text in _of_parameter(parameter, True))
    yield from (f"{title}: {text}" for text in (*_goodness(fit), *_derived(parameters), *_candidates(fit)))
    correlation = np.array(fit["correlation"], float)
    estimates = [p for p in parameters if not p["derived"]]
    if correlation.size and np.all(np.isfinite(correlation)):
        if not np.allclose(np.diag(correlation), 1) or not np.allclose(correlation, correlation.T):
            yield f"{title}: correlation {correlation}"
        if np.max(np.abs(correlation)) > 1 + SAME or len(correlation) < len(estimates):
            yield f"{title}: correlation {correlation} of {len(estimates)}"
    if fit["curve"] is not None:
        low, high = fit["band_hz"]
        lines = np.array(fit["curve"]["frequency"])
        if lines.size and not low * (1 - SAME) <= lines[0] <= lines[-1] <= high * (1 + SAME):
            yield f"{title}: lines {lines[0]} to {lines[-1]} Hz"
    if fit["budget"] is not None:
        yield from (f"{title}: {text}" for text in _budget(fit["budget"], parameters))
    yield from (f"{title}: {text}" for text in _modes(fit))


def _of_parameter(p: Entry, is_fitted: bool = False) -> Iterator[str]:
    """Each statement with whether it fails; of a fit, derived values have no test of their own."""
    name, value, error, full = p["name"], p["value"], p["std_error"], _full(p)
    budget, repeats = p["budget"], p["repeats"]
    statements = {
        f"at its bound with {error}": p["at_bound"] and error is not None,
        f"{value} outside {p['ci95']}": _outside(value, p["ci95"]),
        f"{full} below {error} of noise": error is not None and full < error * (1 - SAME),
        f"t {p['t_ratio']} of {value} and {full}": p["t_ratio"] is not None
        and bool(full)
        and not _is(p["t_ratio"] * full, value),
        "is derived, yet tested": is_fitted
        and p["derived"]
        and (p["t_ratio"], p["significant"]) != (None, None),
        f"expanded {p['expanded']} of {p['combined']}": p["combined"] is not None
        and not _is(p["expanded"], p["coverage_factor"] * p["combined"]),
        f"shares {budget} of {p['combined']}": bool(budget)
        and not (
            _is(sum(part["share"] for part in budget), 1.0)
            and all(_is(part["share"], (part["contribution"] / p["combined"]) ** 2, 1e-3) for part in budget)
        ),
        f"parts {p['interval']} of {full}, {error}": p["interval"] is not None
        and bool(full)
        and not (_is(math.hypot(*p["interval"].values()), full) and _is(p["interval"]["noise"], error)),
        f"{value} of {repeats}": repeats is not None
        and not (
            len(repeats["values"]) == repeats["used"] <= repeats["n"]
            and (repeats["covariate"] or min(repeats["values"]) <= value <= max(repeats["values"]))
        ),
        f"{p['discrepancy']}": p["discrepancy"] is not None
        and not _is(sum(p["discrepancy"]["shares"].values()), 1.0, 10.0),
    }
    return (f"{name}: {text}" for text, fails in statements.items() if fails)


def _full(p: Entry) -> float | None:
    """The standard error that is shown: with all that widens it."""
    return p["std_error"] if p["std_error_inflated"] is None else p["std_error_inflated"]


def _modes(fit: Entry) -> Iterator[str]:
    """Modes are those of the parameters, and as like themselves as nothing else."""
    if (modes := fit.get("modes")) is None:
        return
    of = {p["name"]: p["value"] for p in fit["parameters"] if p["fitted"] is None and p["repeats"] is None}
    for number, pair in enumerate(zip(modes["frequency"], modes["damping_ratio"], strict=True), 1):
        for name, value in zip((f"f_n_{number}", f"zeta_{number}"), pair, strict=True):
            if name in of and not _is(of[name], value):
                yield f"{name} {of[name]}, of the modes {value}"
    mac = np.array(modes["mac"])
    if not (
        np.allclose(np.diag(mac), 1) and np.allclose(mac, mac.T) and np.all((mac > -SAME) & (mac < 1 + SAME))
    ):
        yield f"MAC {mac}"


def _goodness(fit: Entry) -> Iterator[str]:
    gof = fit["gof"]
    if not gof["r2_adjusted"] <= gof["r2"] <= 1 or (gof["chi2_reduced"] or 0) < 0 or _outside(gof["chi2_p"]):
        yield f"goodness {gof}"
    # What is known beforehand of a parameter is an equation for it.
    if not 0 < fit["dof"] <= fit["equations"]:
        yield f"{fit['dof']} degrees of freedom of {fit['equations']} equations"


def _derived(parameters: Sequence[Entry]) -> Iterator[str]:
    """Closed forms between parameters of one mode."""
    of = {p["name"]: p["value"] for p in parameters if p["fitted"] is None and p["repeats"] is None}
    for name, zeta in of.items():
        mode = name.removeprefix("zeta")
        if not name.startswith("zeta") or mode.strip("_0123456789"):
            continue
        k, c, f = (of.get(f"{letter}{mode}") for letter in ("k", "c", "f_n"))
        if None not in (k, c, f) and not _is(np.pi * f * c, zeta * k, 0.0):
            yield f"zeta {zeta} of k {k}, c {c}, f_n {f}"
        decrement = of.get(f"log_decrement{mode}")
        if decrement is not None and not _is(decrement, 2 * np.pi * zeta / math.sqrt(1 - zeta**2)):
            yield f"log_decrement{mode} {decrement} of zeta {zeta}"


def _candidates(fit: Entry) -> Iterator[str]:
    for entry in fit["candidates"]:
        if not _is(entry["aic"], entry["chi2"] + 2 * entry["parameters"]):
            yield f"AIC {entry}"
        bic = entry["chi2"] + entry["parameters"] * math.log(fit["equations"])
        if entry["bic"] is not None and not _is(entry["bic"], bic):
            yield f"BIC {entry}, not {bic}"
    criteria = [entry["aic" if entry["bic"] is None else "bic"] for entry in fit["candidates"]]
    if criteria != sorted(criteria):
        yield f"candidates {criteria}"


def _budget(budget: Entry, parameters: Sequence[Entry]) -> Iterator[str]:
    of = {p["name"]: p for p in parameters}
    changes = np.array(budget["changes"], float).reshape(-1, len(budget["names"]))
    systematic = np.sqrt(np.sum(changes**2, axis=0))
    for name, random, part in zip(budget["names"], budget["random"], systematic, strict=True):
        p = of[name]
        if p["systematic"] is not None and not _is(p["systematic"], part):
            yield f"{name}: systematic {p['systematic']}, by its sources {part}"
        if p["combined"] is not None and not _is(p["combined"], math.hypot(random, part)):
            yield f"{name}: combined {p['combined']} of {random} and {part}"


def _of_comparison(comparison: Entry) -> Iterator[str]:
    known = comparison_kind(comparison["kind"]).verdicts
    if known and comparison["verdict"] not in known:
        yield f"{comparison['name']}: '{comparison['verdict']}' is no verdict of its kind"
    for amount in comparison["amounts"]:
        yield from (f"{comparison['name']} {text}" for text in _of_parameter(amount))
    for band in comparison["bands"]:
        where, ratio = f"{comparison['name']} {band['test']} {band['parameter']}", band["ratio"]
        if band["other"] and ratio is not None and not _is(ratio, band["value"] / band["other"]):
            yield f"{where}: ratio {ratio} of {band['value']} and {band['other']}"
        if _outside(ratio, band["ratio_ci95"]) or _outside(band["p_value"]):
            yield f"{where}: ratio {ratio}, {band['ratio_ci95']}, p {band['p_value']}"
    for point in comparison["points"]:
        if _outside(point["value"], point["ci95"]) or _outside(point["ratio"], point["ratio_ci95"]):
            yield f"{comparison['name']}: {point} outside its interval"


def _of_matrix(matrix: Entry) -> Iterator[str]:
    for point in matrix["points"]:
        for value in point["values"]:
            yield from (f"{matrix['name']} {text}" for text in _of_parameter(value["parameter"]))
            if _outside(value["p_value"]):
                yield f"{matrix['name']}: {value}"
    for amount in matrix["amounts"]:
        yield from (f"{matrix['name']} {text}" for text in _of_parameter(amount))


def _of_response(response: Entry) -> Iterator[str]:
    """Shares of power lie between 0 and 1, and several forces explain no less than one of them."""
    name, one, all_forces = response["test"], response["coherence"], response["multiple_coherence"]
    for part in (one, all_forces, response["partial_coherence"]):
        if part is not None and not np.all((np.array(part) > -SAME) & (np.array(part) < 1 + SAME)):
            yield f"{name}: a coherence outside 0 to 1"
    if one and all_forces and np.any(np.max(one, axis=2) > np.array(all_forces) + 1e-3):
        yield f"{name}: the multiple coherence lies below the ordinary one"
    if np.any(np.diff(response["frequency_hz"]) <= 0):
        yield f"{name}: lines do not rise"


def _factor(unit: str | None) -> float:
    """SI per unit of a rule, which states it in the parameter's own unit but for prefixes."""
    if not unit:
        return 1.0
    if unit in ("%", "rpm", "deg"):
        return {"%": 0.01, "rpm": 1 / 60, "deg": math.pi / 180}[unit]
    if unit in ("kg", "m", "mm", "um", "g"):
        return {"kg": 1.0, "g": 1e-3, "m": 1.0, "mm": 1e-3, "um": 1e-6}[unit]
    prefix = re.match(r"[numkMG](?=[NPsmHrV])", unit)
    first = PREFIXES[prefix[0]] if prefix else 1.0
    below = re.search(r"/([numk])m$", unit)
    return first / (PREFIXES[below[1]] if below else 1.0)


def _of_rule(rule: Entry) -> Iterator[str]:
    """A rule on a number is judged again from its words."""
    match = RULE.fullmatch(rule["rule"])
    if match is None or rule["value"] is None or rule.get("decision"):
        return
    _, covers, sign, number, share, unit, tolerance, of_share, of = match.groups()
    if isinstance(rule["value"], str) and " to " not in rule["value"]:
        return
    wanted = float(number) * _factor(share or unit)
    if covers:
        low, high = map(float, rule["value"].split(" to "))
        holds = low <= wanted <= high
    elif tolerance:
        reach = float(tolerance) * (abs(wanted) / 100 if of_share else _factor(of))
        holds = abs(rule["value"] - wanted) <= reach * (1 + SAME)
    else:
        value = rule["value"]
        holds = {
            ">=": value >= wanted, "<=": value <= wanted, ">": value > wanted, "<": value < wanted,
            None: _is(value, wanted),
        }[sign]  # fmt: skip
    if holds != rule["passed"]:
        yield f"{rule['rule']}: {rule['value']} is said to be {rule['passed']}"


def _of_rotor_system(result: Entry) -> Iterator[str]:
    for critical in result["criticals"]:
        for name in ("speed", "amplification", "amplitude"):
            if _outside(critical[name], critical[f"{name}_interval"]):
                yield f"{critical['place']}: {name} of {critical}"
        apart = 100 * abs(1 - critical["speed"] / result["operating"])
        if critical["margin"] is not None and not _is(critical["margin"][0], apart):
            yield f"{critical['place']}: margin {critical['margin']}, by its speed {apart}"
    if any(map(_outside, (result["decrement"][2], *(test["probability"] for test in result["tests"])))):
        yield f"decrement {result['decrement']}, tests {result['tests']}"
    if (balance := result["balance"]) is not None:
        vibration = balance["vibration"]
        if np.any(np.array(vibration["low"]) > vibration["high"]) or balance["after"] > balance["before"]:
            yield f"balance {balance['before']} to {balance['after']}"


def _tables(page: str) -> Iterator[tuple[str, list[dict[str, str]]]]:
    """Caption and rows by their heads of every table of a page."""
    for table in re.findall(r"<table.*?</table>", page, re.DOTALL):
        caption = unescape("".join(re.findall(r"<caption>(.*?)</caption>", table)))
        heads, *rows = (
            [unescape(cell) for cell in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL)]
            for row in re.findall(r"<tr>(.*?)</tr>", table, re.DOTALL)
        )
        yield caption, [dict(zip(heads, row, strict=True)) for row in rows]


def _differs(text: str, value: float | None, per: float = 1.0) -> bool:
    """Whether a cell says anything else than a value [SI] to its last place, *per*: SI per unit of the cell.

    Zeros at the end of a whole number may stand for digits that its error does not support.
    """
    mantissa, _, power = text.strip().rstrip("*").partition(" × 10")
    if not re.fullmatch(r"[+-]?[\d.]+", mantissa):
        return bool(value) and text not in ("none", "")
    zeros = len(mantissa) - len(mantissa.rstrip("0")) if "." not in mantissa and float(mantissa) else 0
    size = 10.0 ** float(power.translate(POWERS) or 0)
    half = 0.500001 * 10.0 ** (zeros - len(mantissa.partition(".")[2]))
    return value is None or abs(float(mantissa) - value / per / size) > half


Cells = Iterator[tuple[str, float | None, float]]


def _parameter_cells(row: Mapping[str, str], p: Entry, per: float) -> Cells:
    """Value, error, interval, t-ratio and inflation of a parameter or an amount."""
    yield row["value"], p["value"], per
    yield row["std. error"], _full(p), per
    ends = row["95 % interval"].split(" to ")
    shown = zip(ends, p["ci95"] or (), strict=False)
    yield from ((text, end, per) for text, end in shown if end is not None)
    yield row.get("t-ratio", ""), None if p["derived"] else p["t_ratio"], 1.0
    yield row.get("VIF", ""), p["vif"], 1.0


def _budget_cells(row: Mapping[str, str], p: Entry, per: float) -> Cells:
    for head in ("value", "systematic", "combined", "expanded"):
        yield row[head], p[head], per
    yield row["k"], p["coverage_factor"], 1.0
    yield row.get("relative", "").removesuffix(" %"), 100 * p["expanded"] / abs(p["value"] or 1.0), 1.0


def _cells(caption: str, number: int, row: Mapping[str, str], result: Entry) -> Cells:
    """The cells of a row that a result has numbers for, by the caption of their table."""
    per = _factor(row.get("unit", "").replace(" ", "."))
    what, _, title = caption.partition(" of ")
    fits = [fit for fit in result.get("fits", ()) if title in (_title(fit), fit["name"])]
    if what in ("Parameters", "Uncertainty") and len(fits) == 1:
        (p,) = (p for p in fits[0]["parameters"] if p["name"] == row["parameter"])
        yield from (_parameter_cells if what == "Parameters" else _budget_cells)(row, p, per)
    if what == "Amounts":
        for comparison in result.get("comparisons", ()):
            if comparison["name"] == title:
                (p,) = (p for p in comparison["amounts"] if p["name"] == row["amount"])
                yield from _parameter_cells({"std. error": "", "95 % interval": "", **row}, p, per)


def misprints(page: str, result: Entry) -> list[str]:
    """Cells of a report's tables that say anything else than the result."""
    return [
        f"{caption}, row {number}: {text} is {value}, a unit {per}"
        for caption, rows in _tables(page)
        for number, row in enumerate(rows)
        for text, value, per in _cells(caption, number, row, result)
        if _differs(text, value, per)
    ]


def _title(fit: Entry) -> str:
    name = f"{fit['name']} of {fit['term']}" if fit["term"] else fit["name"]
    return f"{name}, test {fit['test']}" if fit["test"] else name


if __name__ == "__main__":
    for folder in sys.argv[1:]:
        held(Path(folder))
