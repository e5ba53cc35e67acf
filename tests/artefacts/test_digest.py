"""The digest of an artefact: no change of one byte reaches a number, and no other reader is troubled by
it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from labpipe.artefacts.digest import DIGEST_KEY, DamagedError, parquet_digest
from labpipe.artefacts.header import Header
from labpipe.artefacts.identification_file import read_fits, read_identification
from labpipe.artefacts.measured_files import read_decays, read_response, read_spectra, write_decays
from labpipe.artefacts.recording_file import open_recording
from labpipe.artefacts.writing import output_folder
from labpipe.errors import DataError
from labpipe.project.pipeline_file import load_pipeline
from labpipe.project.run import Manner, measure_tests
from labpipe.records.response import Port
from labpipe.records.spectra import FreeDecay, FreeDecays
from tests.artefacts.any_record import same
from tests.project.laboratory import PIPELINE, done, laboratory

# Byte changes of every artefact; the command in the docs makes more.
CHANGES = 60
Read = Callable[[Path], Any]
READERS: dict[str, Read] = {
    "recordings/soft.recording.parquet": lambda path: open_recording(path).in_memory(),
    "soft.frf.parquet": read_response,
    "identification.json": read_identification,
    "fits/soft.json": lambda path: tuple(read_fits(path)),
    "decays/soft.decay.parquet": read_decays,
    "spectra/soft.spectra.parquet": read_spectra,
}


@pytest.fixture(scope="module")
def artefacts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with every kind of artefact."""
    folder = tmp_path_factory.mktemp("laboratory")
    done(laboratory(folder), folder / "out")
    pipeline = PIPELINE.replace("skip: 0", "skip: 0, result: spectra").split("identify:")[0]
    (folder / "spectra.yaml").write_text(pipeline)
    with output_folder(folder / "out/spectra") as output:
        measure_tests(load_pipeline(folder / "spectra.yaml"), output, Manner())
    (folder / "out/decays").mkdir()
    decay = FreeDecay("soft", 0.1, np.random.default_rng(1).normal(size=(50, 1)))
    decays = FreeDecays(
        100.0, (Port("y", "displacement", "y"),), ("m",), (decay,), name="soft", findings=(), conditions={}
    )
    write_decays(folder / "out/decays/soft.decay.parquet", decays, Header("decay", {}, inputs=()))
    return folder / "out"


@pytest.mark.parametrize("name", READERS)
def test_no_change_of_a_byte_reaches_a_number(artefacts: Path, tmp_path: Path, name: str) -> None:
    """Seed pinned. A change is refused in plain words, or what is read is what was written."""
    rng = np.random.default_rng(20)
    content, read = (artefacts / name).read_bytes(), READERS[name]
    whole = read(artefacts / name)
    path = tmp_path / Path(name).name
    refused = 0
    for place in [*rng.integers(0, len(content), CHANGES), *range(len(content) - 12, len(content))]:
        changed = bytearray(content)
        changed[place] ^= int(rng.integers(1, 256))
        path.write_bytes(changed)
        try:
            again = read(path)
        except DataError:
            refused += 1
        else:
            assert same(again, whole), f"byte {place}"
    # White space and the name of the digest carry no number.
    assert refused >= CHANGES * 0.9


def test_inverted_bytes_in_a_page_are_refused(artefacts: Path, tmp_path: Path) -> None:
    """Twenty of them once gave a multiple coherence of -4.19."""
    content = bytearray((artefacts / "soft.frf.parquet").read_bytes())
    content[400:420] = bytes(255 - byte for byte in content[400:420])
    (tmp_path / "a.frf.parquet").write_bytes(content)
    with pytest.raises(DamagedError, match="content does not match its digest"):
        read_response(tmp_path / "a.frf.parquet")


@pytest.mark.parametrize("part", [0, 0.3, 0.9, 0.999])
def test_a_shortened_file_is_refused(artefacts: Path, tmp_path: Path, part: float) -> None:
    for name, read in READERS.items():
        content = (artefacts / name).read_bytes()
        path = tmp_path / Path(name).name
        path.write_bytes(content[: int(part * len(content))])
        with pytest.raises(DataError):
            read(path)


def test_pages_have_checksums(artefacts: Path, tmp_path: Path) -> None:
    """Also a reader that does not know the digest notices a damaged page."""
    path = artefacts / "soft.frf.parquet"
    first = pq.ParquetFile(path).metadata.row_group(0).column(1)
    content = bytearray(path.read_bytes())
    content[first.data_page_offset + first.total_compressed_size - 3] ^= 0x55
    (tmp_path / "a.parquet").write_bytes(content)
    with pytest.raises(OSError, match="CRC"):
        pq.read_table(tmp_path / "a.parquet", page_checksum_verification=True)


def test_the_digest_of_a_result_is_that_of_its_other_lines(artefacts: Path) -> None:
    """As `grep -v '^"digest"' identification.json | sha256sum` gives it."""
    content = (artefacts / "identification.json").read_bytes()
    others = b"".join(line for line in content.splitlines(keepends=True) if not line.startswith(b'"digest"'))
    assert (
        json.loads(content)["digest"]
        == hashlib.sha256(others).hexdigest()
        == read_identification(artefacts / "identification.json").digest
    )


def test_the_digest_of_a_parquet_file_is_that_of_the_file_with_zeros_for_it(artefacts: Path) -> None:
    path = artefacts / "soft.frf.parquet"
    stated = pq.ParquetFile(path).metadata.metadata[DIGEST_KEY]
    assert path.read_bytes().count(stated) == 1
    assert (
        hashlib.sha256(path.read_bytes().replace(stated, b"0" * 64)).hexdigest()
        == stated.decode()
        == parquet_digest(path)
    )


@pytest.mark.parametrize("written", [{}, {"indent": 1}, {"ensure_ascii": False, "separators": (",", ":")}])
def test_a_result_that_another_program_wrote_again_is_the_same_result(
    artefacts: Path, tmp_path: Path, written: dict[str, Any]
) -> None:
    entries = json.loads((artefacts / "identification.json").read_text("utf-8"))
    path = tmp_path / "identification.json"
    path.write_text(json.dumps(entries, **written), "utf-8")
    assert read_identification(path).digest == entries["digest"]


@pytest.mark.parametrize("stated", [3, [], {}, "", "0" * 64, True])
def test_another_digest_is_refused(artefacts: Path, tmp_path: Path, stated: object) -> None:
    entries = json.loads((artefacts / "identification.json").read_text("utf-8"))
    path = tmp_path / "identification.json"
    path.write_text(json.dumps({**entries, "digest": stated}), "utf-8")
    with pytest.raises(DamagedError, match="content does not match its digest"):
        read_identification(path)


@pytest.mark.parametrize("name", ['"digect": "', '"`igest": "-1'])
def test_a_digest_whose_name_is_damaged_is_no_file_without_one(
    artefacts: Path, tmp_path: Path, name: str
) -> None:
    """Another damage beside it once gave other numbers."""
    content = (artefacts / "identification.json").read_text("utf-8")
    (tmp_path / "identification.json").write_text(
        content.replace('"digest": "', name).replace("0.79", "0.78"), "utf-8"
    )
    with pytest.raises(DamagedError, match="content does not match its digest"):
        read_identification(tmp_path / "identification.json")


def test_a_result_of_an_earlier_version_has_no_digest_and_is_read(artefacts: Path, tmp_path: Path) -> None:
    entries = json.loads((artefacts / "identification.json").read_text("utf-8"))
    del entries["digest"]
    (tmp_path / "identification.json").write_text(json.dumps(entries), "utf-8")
    assert read_identification(tmp_path / "identification.json").digest == ""
