"""Valid files, mutated: bytes that are changed, cut, repeated and exchanged, and YAML whose entries are."""

from __future__ import annotations

import random
import re

# What readers stumble over: ends of ranges, lengths that lie, marks of formats, text that acts.
BYTES = (
    b"\x00", b"\xff", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\x00\x00\x00\x80", b"\xff\xff\xff\x7f",
    b"\xff\xfe", b"\xef\xbb\xbf",
    b"nan", b"inf", b"-1", b"1e999", b"-0", b"\x1b[31m", b"\xe2\x80\xae", b"\n", b"\r\n", b",,,,", b'"', b"'",
    b"[", b"{", b"PAR1",
)  # fmt: skip
WORDS = (
    "null", "~", "true", "[]", "{}", "-1", "0", "1e300 kg", "1 kg^(1/0)", "km^999", "1e-300", "10**30", "nan",
    ".inf", "0 Hz", "-5 s",
    "1e7 s", "1000000000000000000000", "50 %", "150 %", "x", "=cmd|calc", '"\\e[31m"', '"\\u202e"',
    "../../etc/passwd", "1-250 Hz",
    "250-1 Hz", "[1, [2, [3]]]", "{a: {b: c}}", "&a [*a]", "!!python/object:os.system", "|", ">", "*", "@",
    "a: b: c", "'", "90 deg",
    "1 N +- -1 N",
)  # fmt: skip
# Of numbers that stand in YAML with or without a unit, not within a word.
FACTORS = (0.0, -1.0, 1e-9, 1e-3, 0.1, 0.5, 0.9, 1.1, 2.0, 10.0, 1e3, 1e9)
_AMOUNT = re.compile(r"(?<=[\s\[:-])\d+(?:\.\d+)?(?=[\s,\]}-])")
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?")


def mutated_bytes(content: bytes, rng: random.Random) -> bytes:
    """The content with one to four changes."""
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        rng.choice(_CHANGES)(changed, rng)
    return bytes(changed)


def _place(content: bytearray, rng: random.Random) -> int:
    """Any place; half of them near an end, where headers and feet stand."""
    size = len(content)
    near = min(size, 256)
    return (
        rng.choice(
            (rng.randrange(size), rng.randrange(near), size - 1 - rng.randrange(near), rng.randrange(size))
        )
        if size
        else 0
    )


def _flip(content: bytearray, rng: random.Random) -> None:
    if content:
        content[_place(content, rng)] ^= 1 << rng.randrange(8)


def _overwrite(content: bytearray, rng: random.Random) -> None:
    place, piece = _place(content, rng), rng.choice(BYTES)
    content[place : place + len(piece)] = piece


def _insert(content: bytearray, rng: random.Random) -> None:
    place = _place(content, rng)
    content[place:place] = rng.choice(BYTES) * rng.choice((1, 1, 1, 50))


def _cut(content: bytearray, rng: random.Random) -> None:
    place = _place(content, rng)
    del content[place : place + rng.choice((1, 4, 64, 1 << 20))]


def _repeat(content: bytearray, rng: random.Random) -> None:
    place = _place(content, rng)
    content[place:place] = content[place : place + rng.choice((4, 32, 512))]


def _invert(content: bytearray, rng: random.Random) -> None:
    place = _place(content, rng)
    content[place : place + 20] = bytes(255 - byte for byte in content[place : place + 20])


def _number(content: bytearray, rng: random.Random) -> None:
    numbers = list(_NUMBER.finditer(bytes(content[:4096])))
    if numbers:
        match = rng.choice(numbers)
        content[match.start() : match.end()] = rng.choice(
            (b"0", b"-1", b"99999999999", b"1e400", b"nan", b"", b"1_0")
        )


_CHANGES = (_flip, _flip, _overwrite, _insert, _cut, _repeat, _invert, _number)


def mutated_yaml(text: str, rng: random.Random) -> str:
    """YAML with one to three entries replaced, removed, repeated, renamed or moved."""
    lines = text.splitlines()
    for _ in range(rng.choice((1, 1, 2, 3))):
        rng.choice(_YAML_CHANGES)(lines, rng)
    return "\n".join(lines) + "\n"


def mutated_amounts(text: str, rng: random.Random) -> str:
    """YAML of which one to three numbers have another size or sign: what is still understood, and must be
    made or refused.
    """
    places = list(_AMOUNT.finditer(text))
    for place in sorted(rng.sample(places, rng.choice((1, 1, 2, 3))), key=lambda one: -one.start()):
        number = f"{float(place[0]) * rng.choice(FACTORS):.6g}"
        text = text[: place.start()] + number + text[place.end() :]
    return text


def _value(lines: list[str], rng: random.Random) -> None:
    number = rng.randrange(len(lines))
    parts = re.split(r"(:\s+|,\s*|\[|\]|\{|\})", lines[number])
    parts[rng.randrange(len(parts))] = rng.choice(WORDS)
    lines[number] = "".join(parts)


def _line(lines: list[str], rng: random.Random) -> None:
    number = rng.randrange(len(lines))
    rng.choice(
        (
            lambda: lines.pop(number) if len(lines) > 1 else None,
            lambda: lines.insert(rng.randrange(len(lines)), lines[number]),
            lambda: lines.__setitem__(number, "  " + lines[number]),
            lambda: lines.__setitem__(number, lines[number].lstrip()),
        )
    )()


def _letters(lines: list[str], rng: random.Random) -> None:
    number = rng.randrange(len(lines))
    letters = bytearray(lines[number].encode())
    rng.choice(_CHANGES)(letters, rng)
    lines[number] = letters.decode("utf-8", "replace").replace("\n", " ").replace("\r", " ")


_YAML_CHANGES = (_value, _value, _value, _line, _letters)
