"""What the numbers of a result say of each other, whatever method they come from, and its report of them: an
independent reader of both, by the definitions of the pages. Every `labpipe run` of the tests is held to it.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np

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
        *(_of_run_ups(result["run_ups"]) if result.get("run_ups") else ()),
        *(_of_rotor_system(result["rotor_system"]) if result.get("rotor_system") else ()),
    ]


def _is(a: float, b: float, size: float = 0.0) -> bool:
    return abs(a - b) <= SAME * max(abs(a), abs(b), size)


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


def _of_parameter(p: Entry, is_fitted: bool = False) -> Iterator[str]:
    """Each statement with whether it fails; of a fit, derived values have no test of their own."""
    name, value, error, full = p["name"], p["value"], p["std_error"], _full(p)
    budget, repeats = p["budget"], p["repeats"]
    statements = {
        f"at its bound with {error}": p["at_bound"] and error is not None,
        f"{value} outside {p['ci95']}": p["ci95"] is not None and not p["ci95"][0] <= value <= p["ci95"][1],
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


def _goodness(fit: Entry) -> Iterator[str]:
    gof, n = fit["gof"], fit["equations"]
    if not gof["r2_adjusted"] <= gof["r2"] <= 1:
        yield f"R2 {gof}"
    if gof["chi2_reduced"] is not None and gof["chi2_reduced"] < 0:
        yield f"chi2 {gof}"
    if gof["chi2_p"] is not None and not 0 <= gof["chi2_p"] <= 1:
        yield f"chi2 {gof}"
    if not 0 < fit["dof"] < n:
        yield f"{fit['dof']} degrees of freedom of {n} equations"


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
    for amount in comparison["amounts"]:
        yield from (f"{comparison['name']} {text}" for text in _of_parameter(amount))
    for band in comparison["bands"]:
        where = f"{comparison['name']} {band['test']} {band['parameter']}"
        if (
            band["other"]
            and band["ratio"] is not None
            and not _is(band["ratio"], band["value"] / band["other"])
        ):
            yield f"{where}: ratio {band['ratio']} of {band['value']} and {band['other']}"
        if (
            band["ratio_ci95"] is not None
            and not band["ratio_ci95"][0] <= band["ratio"] <= band["ratio_ci95"][1]
        ):
            yield f"{where}: ratio {band['ratio']} outside {band['ratio_ci95']}"
        if band["p_value"] is not None and not 0 <= band["p_value"] <= 1:
            yield f"{where}: p {band['p_value']}"
    for point in comparison["points"]:
        where = f"{comparison['name']} {point['test']}"
        if point["ci95"] is not None and not point["ci95"][0] <= point["value"] <= point["ci95"][1]:
            yield f"{where}: {point['value']} outside {point['ci95']}"
        if point["ratio_ci95"] is not None and not (
            point["ratio_ci95"][0] <= point["ratio"] <= point["ratio_ci95"][1]
        ):
            yield f"{where}: ratio {point['ratio']} outside {point['ratio_ci95']}"


def _of_matrix(matrix: Entry) -> Iterator[str]:
    for point in matrix["points"]:
        for value in point["values"]:
            yield from (
                f"{matrix['name']} {point['place']} {text}" for text in _of_parameter(value["parameter"])
            )
            if value["p_value"] is not None and not 0 <= value["p_value"] <= 1:
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


def _of_run_ups(result: Entry) -> Iterator[str]:
    for run in result["runs"]:
        speed, critical = run["speed"], run["critical_speed"]
        if critical is not None and not speed[0] <= critical["value"] <= speed[-1]:
            yield f"{run['name']}: critical speed {critical} outside {speed[0]} to {speed[-1]}"
    for method in result["methods"]:
        if method["unknowns"] and method["rank"] is not None and method["rank"] > method["unknowns"]:
            yield f"{method['name']}: rank {method['rank']} of {method['unknowns']}"
        if method["chi2_p"] is not None and not 0 <= method["chi2_p"] <= 1:
            yield f"{method['name']}: p {method['chi2_p']}"
        for parameter in method["parameters"]:
            yield from (f"{method['name']} {text}" for text in _of_parameter(parameter))


def _of_rotor_system(result: Entry) -> Iterator[str]:
    for critical in result["criticals"]:
        for name in ("speed", "amplification", "amplitude"):
            low, high = critical[f"{name}_interval"]
            if not low <= critical[name] <= high:
                yield f"{critical['place']}: {name} {critical[name]} outside {low} to {high}"
    if not 0 <= result["decrement"][2] <= 1 or any(
        not 0 <= test["probability"] <= 1 for test in result["tests"]
    ):
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


def _printed(text: str) -> tuple[float, float]:
    """A printed number, and half of its last place."""
    mantissa, _, power = text.strip().partition(" × 10")
    size = 10.0 ** float(power.translate(POWERS) or 0)
    return float(mantissa) * size, 0.500001 * 10.0 ** -len(mantissa.partition(".")[2]) * size


def _differs(text: str, value: float | None, per: float = 1.0) -> bool:
    """Whether a cell says anything else than a value [SI], *per*: SI per unit of the cell."""
    try:
        number, half = _printed(text)
    except ValueError:
        return value is not None
    size = max(half, 0.0 if "." in text else 10.0 ** (math.floor(math.log10(abs(number) or 1)) - 4))
    return value is None or abs(number - value / per) > size + 1e-12 * abs(number)


def misprints(page: str, result: Entry) -> list[str]:
    """Cells of a report's tables of parameters and of their uncertainty that differ from the result."""
    fits = {f"Parameters of {_title(fit)}": fit for fit in result.get("fits", ())}
    budgets = {f"Uncertainty of {fit['name']}": fit for fit in result.get("fits", ())}
    wrong: list[str] = []
    for caption, rows in _tables(page):
        for row in rows if caption in fits else ():
            p = next(p for p in fits[caption]["parameters"] if p["name"] == row["parameter"])
            wrong += [f"{caption}: {text}" for text in _parameter_row(row, p)]
        for row in rows if caption in budgets and len(result["fits"]) == 1 else ():
            p = next(p for p in budgets[caption]["parameters"] if p["name"] == row["parameter"])
            per = _factor(row["unit"].replace(" ", "."))
            wanted = {head: p[head] for head in ("systematic", "combined", "expanded")}
            wrong += [
                f"{caption}: {p['name']} {head} {row[head]}, not {value}"
                for head, value in wanted.items()
                if _differs(row[head], value, per)
            ]
            if _differs(row["k"], p["coverage_factor"]):
                wrong.append(f"{caption}: {row['k']}")
            if row.get("relative") and _differs(
                row["relative"].rstrip(" %"), 100 * p["expanded"] / abs(p["value"])
            ):
                wrong.append(f"{caption}: {row['relative']}")
    return wrong


def _title(fit: Entry) -> str:
    return f"{fit['name']}, test {fit['test']}" if fit["test"] else fit["name"]


def _parameter_row(row: Mapping[str, str], p: Entry) -> Iterator[str]:
    per = _factor(row["unit"].replace(" ", "."))
    wanted: dict[str, tuple[str, float | None, float]] = {
        "value": (row["value"], p["value"], per),
        "std. error": (row["std. error"], _full(p), per),
        "t-ratio": (row.get("t-ratio", ""), None if p["derived"] else p["t_ratio"], 1.0),
        "VIF": (row.get("VIF", ""), p["vif"], 1.0),
    }
    ends = row["95 % interval"].split(" to ")
    for n, end in enumerate(p["ci95"] or ()):
        wanted[f"end {n}"] = (ends[n], end, per)
    for head, (text, value, unit) in wanted.items():
        if _differs(text, value, unit):
            yield f"{p['name']} {head} {text} {row['unit']}, not {value}"
