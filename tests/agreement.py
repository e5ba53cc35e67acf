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


def _tables(page: str) -> Iterator[tuple[str, list[list[tuple[str, str]]]]]:
    """Caption of every table of a page, and its rows as (head, cell)."""
    for table in re.findall(r"<table.*?</table>", page, re.DOTALL):
        caption = unescape("".join(re.findall(r"<caption>(.*?)</caption>", table)))
        heads, *rows = (
            [unescape(cell) for cell in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL)]
            for row in re.findall(r"<tr>(.*?)</tr>", table, re.DOTALL)
        )
        yield caption, [list(zip(heads, row, strict=True)) for row in rows]


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


Row = Sequence[tuple[str, str]]
Cells = Iterator[tuple[str, float | None, float]]


def _parameter_cells(row: Mapping[str, str], p: Entry, per: float) -> Cells:
    """Value, error, interval, t-ratio and inflation of a parameter or an amount."""
    yield row["value"], p["value"], per
    yield row["std. error"], _full(p), per
    ends = row["95 % interval"].split(" to ")
    yield from ((text, end, per) for text, end in zip(ends, p["ci95"] or (), strict=False))
    yield row.get("t-ratio", ""), None if p["derived"] else p["t_ratio"], 1.0
    yield row.get("VIF", ""), p["vif"], 1.0


def _budget_cells(row: Mapping[str, str], p: Entry, per: float) -> Cells:
    for head in ("value", "systematic", "combined", "expanded"):
        yield row[head], p[head], per
    yield row["k"], p["coverage_factor"], 1.0
    yield row.get("relative", "").removesuffix(" %"), 100 * p["expanded"] / abs(p["value"] or 1.0), 1.0


def _band_cells(row: Mapping[str, str], fit: Entry) -> Cells:
    yield row["centre [Hz]"], sum(fit["band_hz"]) / 2, 1.0
    yield row["G.o.F"], fit["gof"]["r2_adjusted"], 1.0
    of = {p["name"]: p for p in fit["parameters"]}
    for head, cell in row.items():
        if (name := head.partition(" [")[0]) in of and "(" not in cell:
            value, _, error = cell.removesuffix(" n.s.").partition(" ± ")
            yield value, of[name]["value"], _factor_of(head)
            yield error, _full(of[name]) if error else None, _factor_of(head)


def _run_cells(row: Mapping[str, str], run: Entry) -> Cells:
    """Speeds of the file are rad/s, those of the report revolutions per minute."""
    rpm = 2 * math.pi / 60
    yield row["load [N]"], run["load"], 1.0
    number, low, high = re.findall(r"[\d.]+", row["speeds [rpm]"])
    yield from ((number, len(run["speed"]), 1.0), (low, run["speed"][0], rpm), (high, run["speed"][-1], rpm))
    for name in ("critical_speed", "threshold"):
        value, _, error = row.get(f"{name.replace('_', ' ')} [rpm]", "").partition(" ± ")
        if run[name] is not None and error:
            yield value, run[name]["value"], rpm
            yield error, run[name]["std_error"], rpm


def _mode_cells(row: Mapping[str, str], modes: Entry) -> Cells:
    number = int(row["mode"]) - 1
    yield row["f [Hz]"], modes["frequency"][number], 1.0
    yield row["zeta [%]"], modes["damping_ratio"][number], 0.01
    yield row["phase collinearity"], modes["collinearity"][number], 1.0


def _circle_cells(row: Row, case: Entry, speed: Sequence[float]) -> Cells:
    forward, backward = (np.array(case[name]) for name in ("forward", "backward"))
    cells = [cell for _, cell in row]
    yield cells[1], case["depth"], 1e-6
    for text, radius in ((cells[3], forward), (cells[5], backward)):
        yield text.partition(" ± ")[0], radius.max(), 1e-6
    for text, radius in ((cells[4], forward), (cells[6], backward)):
        yield text, speed[int(np.argmax(radius))], 1.0
    yield cells[7], backward.max() / forward.max(), 1.0


# As on the first page: 134.50 ± 0.81 kN/m, (1.2 ± 0.1) × 10⁻⁷ m, 3.707 (3.612 to 3.796) N s/m.
IN_PRINT = re.compile(r"([-\d.]+) (?:± ([\d.]+)|\(([-\d.]+) to ([-\d.]+)\))(?: ([^×]*))?")


def _first_page_cells(rows: Sequence[Mapping[str, str]], number: int, fits: Sequence[Entry]) -> Cells:
    """A coefficient with its interval, of the fit that was named last."""
    named = [row["result of"] for row in rows[: number + 1] if row.get("result of")]
    name = rows[number]["coefficient"].split()[-1]
    p = next(
        p
        for fit in fits
        if not named or _title(fit) == named[-1]
        for p in fit["parameters"]
        if p["name"] == name
    )
    match = IN_PRINT.fullmatch(rows[number]["value with its 95 % interval"])
    if match is None or p["ci95"] is None:
        return
    value, reach, low, high, unit = match.groups()
    per, half = _factor((unit or "").replace(" ", ".")), (p["ci95"][1] - p["ci95"][0]) / 2
    yield value, p["value"], per
    yield from ((reach, half, per),) if reach else ((low, p["ci95"][0], per), (high, p["ci95"][1], per))
    relative = rows[number]["relative"].strip("± %")
    yield relative, 100 * half / abs(p["value"]) if relative else None, 1.0


def _factor_of(head: str) -> float:
    unit = re.search(r"\[(.*)\]", head)
    return _factor(unit[1].replace(" ", ".") if unit else None)


def _cells(caption: str, rows: Sequence[Row], number: int, result: Entry) -> Cells:
    """The cells of a row that a result has numbers for, by the caption of their table."""
    row, pairs = dict(rows[number]), rows[number]
    per = _factor(row.get("unit", "").replace(" ", "."))
    what, _, title = caption.partition(" of ")
    fits = [fit for fit in result.get("fits", ()) if title in (_title(fit), fit["name"])]
    if what in ("Parameters", "Uncertainty") and len(fits) == 1:
        (p,) = (p for p in fits[0]["parameters"] if p["name"] == row["parameter"])
        yield from (_parameter_cells if what == "Parameters" else _budget_cells)(row, p, per)
    if what == "Bands" and fits:
        yield from _band_cells(row, [fit for fit in fits if _title(fit) == title][number])
    if what == "Modes" and len(fits) == 1:
        yield from _mode_cells(row, fits[0]["modes"])
    if what == "Amounts":
        for comparison in result.get("comparisons", ()):
            if comparison["name"] == title:
                (p,) = (p for p in comparison["amounts"] if p["name"] == row["amount"])
                yield from _parameter_cells({"std. error": "", "95 % interval": "", **row}, p, per)
    if caption.startswith("Run-ups as measured"):
        yield from _run_cells(row, result["run_ups"]["runs"][number])
    if what.startswith("Results") and "coefficient" in row:
        keys = [(fit["name"], fit["term"], fit["test"]) for fit in result["fits"]]
        alone = [fit for fit, key in zip(result["fits"], keys, strict=True) if keys.count(key) == 1]
        yield from _first_page_cells([dict(other) for other in rows], number, alone)
    if caption.startswith("Largest radii"):
        yield from _circle_cells(pairs, result["unbalance"]["cases"][number], result["unbalance"]["speed"])


def misprints(page: str, result: Entry) -> list[str]:
    """Cells of a report's tables that say anything else than the result."""
    return [
        f"{caption}, row {number}: {text} is {value}, a unit {per}"
        for caption, rows in _tables(page)
        for number in range(len(rows))
        for text, value, per in _cells(caption, rows, number, result)
        if _differs(text, value, per)
    ]


def _title(fit: Entry) -> str:
    name = f"{fit['name']} of {fit['term']}" if fit["term"] else fit["name"]
    return f"{name}, test {fit['test']}" if fit["test"] else name


if __name__ == "__main__":
    for folder in sys.argv[1:]:
        held(Path(folder))
