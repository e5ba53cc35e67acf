"""Drawings in few bytes: paths by steps instead of places, one font named once."""

from __future__ import annotations

import re

# Parts of a point to which places are kept: a long curve is drawn as finely as any screen shows it, a mark or a letter finer.
LONG_PATH, COARSE, FINE = 400, 10, 100
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")
PLACES = re.compile(r"\b(x|y)=\"(-?\d+\.\d\d)\d+\"")
PATH = re.compile(r"(\sd=\")([^\"]*)\"")
FONTS = re.compile(r"; font-family: 'DejaVu Sans'[^;\"]*")
PIECE = re.compile(r"([MLCz])([^MLCz]*)")
MARKS = re.compile(r"(?:<use [^>]*/>){3,}")
REFERENCE = re.compile(r"(?<=[\"(]#)([^\")]+)")
NAMED = re.compile(r' id="([^"]*)"')
COARSER = re.compile(r"\b(x|y)=\"(-?\d+\.\d)\d+\"")
STYLE = re.compile(r' style="[^"]*"')
EMPTY_SPACE = re.compile(r">\s+<")


def smaller(svg: str) -> str:
    """The same drawing; its font is left to the style of the page."""
    svg = PATH.sub(lambda found: f'{found[1]}{smaller_path(found[2])}"', svg)
    svg = EMPTY_SPACE.sub("><", FONTS.sub("", PLACES.sub(r'\1="\2"', svg)))
    return MARKS.sub(lambda found: _styled_once(found[0]), _with_short_names(svg))


def _with_short_names(svg: str) -> str:
    """What something refers to is named by a number, nothing else is named."""
    short = {name: f"{number:x}" for number, name in enumerate(dict.fromkeys(REFERENCE.findall(svg)))}
    svg = REFERENCE.sub(lambda found: found[0].replace(found[1], short[found[1]]), svg)
    return NAMED.sub(lambda found: f' id="{short[found[1]]}"' if found[1] in short else "", svg)


def _styled_once(marks: str) -> str:
    """Marks in a row, their style named once where they share it."""
    styles = set(STYLE.findall(marks))
    if len(styles) != 1:
        return marks
    plain = COARSER.sub(r'\1="\2"', STYLE.sub("", marks).replace(" xlink:href=", " href="))
    return f"<g{styles.pop()}>{plain}</g>"


def smaller_path(path: str) -> str:
    """The same path in steps from point to point: M, L and C by their relative twins, rounded so that no error adds up."""
    parts: list[str] = []
    here, scale = (0, 0), COARSE if len(path) > LONG_PATH and "C" not in path else FINE
    for letter, places in PIECE.findall(path):
        if letter == "z":
            # Matplotlib begins anew after it, so where the pen stands does not matter.
            parts.append("z")
            continue
        numbers = [round(scale * float(number)) for number in NUMBER.findall(places)]
        points = list(zip(numbers[0::2], numbers[1::2], strict=True))
        if letter == "M":
            parts.append(f"M{_joined(points, scale)}")
        else:
            parts.append(letter.lower() + _joined([(x - here[0], y - here[1]) for x, y in points], scale))
        here = points[-1]
    return _without_repeats(parts)


def _joined(points: list[tuple[int, int]], scale: int) -> str:
    """Numbers with as few characters as tell them apart."""
    text = ""
    for value in (part for point in points for part in point):
        short = f"{value / scale:.2f}".rstrip("0").rstrip(".")
        if 0 < abs(value) < scale:
            short = short.replace("0.", ".", 1)
        text += short if not text or short.startswith("-") else f" {short}"
    return text


def _without_repeats(parts: list[str]) -> str:
    """Steps of one letter after each other name it once."""
    text, last = "", ""
    for part in parts:
        numbers = part[1:]
        same = part[0] == last and last == "l"
        text += (numbers if numbers.startswith("-") else f" {numbers}") if same else part
        last = part[0]
    return text
