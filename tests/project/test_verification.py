"""Two folders of results, compared with each other byte by byte."""

from __future__ import annotations

from pathlib import Path

from labpipe.project.verification import differences


def test_what_is_another_and_what_is_missing_is_named(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        (folder / "fits").mkdir(parents=True)
        (folder / "identification.json").write_text("same")
        (folder / "notes.txt").write_text(f"of {folder.name}: no artefact")
        (folder / "fits/soft.json").write_text(folder.name)
    (first / "soft.frf.parquet").write_text("alone")
    assert sorted(differences(first, second)) == [
        f"{first}/fits/soft.json: running again gives another content",
        f"{first}/soft.frf.parquet: is not made by this pipeline",
    ]
    assert differences(second, second) == []
