"""Detection lines of labpipe excite: what is left out of the file's spectrum."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def test_one_line_of_every_group_is_left_out(tmp_path: Path, labpipe) -> None:
    wanted = ("--band", "1-80 Hz", "--spacing", "1 Hz", "--rate", "200 Hz", "--periods", 1, "--odd", "--leave-out", 4, "--seed", 3)
    ended = labpipe("excite", "-o", tmp_path / "a.csv", *wanted)
    assert ended.code == 0 and "31 lines, 1-79 Hz" in ended.out
    signal = np.genfromtxt(tmp_path / "a.csv", delimiter=",", skip_header=1)[:, -1]
    size = np.abs(np.fft.rfft(signal))
    present = np.flatnonzero(size > 1e-3 * size.max())
    # 40 odd lines; nine whole groups of four between the first line and the last lose one each.
    assert present.size == 31 and np.all(present % 2 == 1) and {1, 79} <= set(present)
    assert labpipe("excite", "-o", tmp_path / "b.csv", *wanted[:-4], "--leave-out", 1).code == 2
