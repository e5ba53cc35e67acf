"""Signed archives and reports of which one byte was changed, the digests inside made anew: every one is
noticed.

By hand, ten thousand: python -m tests.hostile.signatures --count 10000
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import re
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from fpdf import FPDF

from labpipe.errors import DataError
from labpipe.project.signing import Key, Trust, sign, signatures
from tests.project.signing_people import SECRET, authority

METADATA = "ro-crate-metadata.json"
MEMBERS = {
    "experiment/project/recording.csv": b"t [s],force [N]\n0,1.25\n0.001,1.5\n",
    "experiment/project/pipeline.yaml": b"title: T\nframe: {period: 2 s}\n",
    "experiment/results/identification.json": b'{"fits": [{"name": "k", "value": 134500.0}]}\n',
}


def packed(members: dict[str, bytes]) -> bytes:
    """An archive whose metadata list the digests of its members."""
    listed = {name: hashlib.sha256(content).hexdigest() for name, content in members.items()}
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in {**members, METADATA: json.dumps(listed).encode()}.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return stream.getvalue()


def report() -> bytes:
    """A report of one page."""
    document = FPDF()
    document.add_page()
    document.set_font("helvetica", size=12)
    document.cell(text="k = 134.50 kN/m")
    return bytes(document.output())


class Signed:
    """An archive and a report that two people signed, in a folder of their own."""

    def __init__(self, folder: Path) -> None:
        people = authority(folder)
        self.trust = Trust((people.pem,))
        self.archive, self.pdf = folder / "evidence.zip", folder / "report.signed.pdf"
        self.archive.write_bytes(packed(MEMBERS))
        (folder / "report.pdf").write_bytes(report())
        ann, bob = (Key(file=people.person(name), secret=SECRET) for name in ("Ann", "Bob"))
        self.signature = sign(self.archive, ann, "measured")
        sign(folder / "report.pdf", ann, "measured")
        sign(self.pdf, bob, "approved")
        self.whole = self.archive.read_bytes(), self.pdf.read_bytes()

    def noticed(self, rng: np.random.Generator, kind: int) -> bool:
        """Whether one changed byte is noticed: in a file of the archive with new digests, anywhere in the
        archive, anywhere in the report but in the last signature itself.
        """
        archive, pdf = self.whole
        if kind == 0:
            name = str(rng.choice(list(MEMBERS)))
            changed = {**MEMBERS, name: flipped(rng, MEMBERS[name], [])}
            self.archive.write_bytes(packed(changed))
            faults = self._faults(self.signature)
            return any(name in fault for fault in faults) and any(METADATA in fault for fault in faults)
        if kind == 1:
            self.archive.write_bytes(flipped(rng, archive, []))
            return bool(self._faults(self.signature))
        gap = list(re.finditer(rb"/Contents <[0-9a-fA-F]+>", pdf))[-1].span()
        self.pdf.write_bytes(flipped(rng, pdf, [range(*gap)]))
        return bool(self._faults(self.pdf))

    def _faults(self, path: Path) -> list[str]:
        try:
            listed = list(signatures(path, self.trust))
        except DataError as error:
            return [error.what]
        missing = [] if len(listed) == (2 if path == self.pdf else 1) else ["a signature is missing"]
        return [*missing, *(fault for signature in listed for fault in signature.faults)]


def flipped(rng: np.random.Generator, content: bytes, spared: list[range]) -> bytes:
    """The content with another byte at one place that is not spared."""
    while True:
        place = int(rng.integers(len(content)))
        if not any(place in span for span in spared):
            break
    other = (content[place] + int(rng.integers(1, 256))) % 256
    return content[:place] + bytes([other]) + content[place + 1 :]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    with tempfile.TemporaryDirectory() as folder:
        signed = Signed(Path(folder))
        missed = sum(not signed.noticed(rng, number % 3) for number in range(options.count))
    print(f"{options.count} changes of one byte: {missed} not noticed")
    raise SystemExit(1 if missed else 0)


if __name__ == "__main__":
    main()
