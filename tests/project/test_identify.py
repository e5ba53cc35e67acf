"""The settings that a result keeps, so that another lab can repeat the work."""

from __future__ import annotations

from pathlib import Path

from labpipe.project.identify import settings_entry
from labpipe.project.pipeline_file import load_pipeline

PIPELINE = """rig: rig.yaml
frf: {excitation: periodic, period: 1 s, band: 1-100 Hz}
tests:
  - {name: dry, recordings: runs/a.csv, frf: {band: 5-50 Hz}, conditions: {load: 3 N}}
  - {name: wet, recordings: runs/b.csv}
"""


def test_a_test_s_own_spectra_are_kept_with_it(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(
        "sample_rate: 1 kHz\nmass: 2 kg\nchannels:\n  f: {quantity: force}\n  x: {quantity: displacement}\n"
    )
    (tmp_path / "runs").mkdir()
    for name in ("runs/a.csv", "runs/b.csv"):
        (tmp_path / name).write_text("f,x\n1,2\n")
    (tmp_path / "p.yaml").write_text(PIPELINE)
    entry = settings_entry(load_pipeline(tmp_path / "p.yaml"))
    dry, wet = entry["tests"]
    assert entry["frf"]["band"] == [1.0, 100.0] and dry["frf"]["band"] == [5.0, 50.0] and "frf" not in wet
    assert (
        (dry["name"], wet["name"]) == ("dry", "wet")
        and list(dry["conditions"]) == ["load"]
        and wet["conditions"] == {}
    )
