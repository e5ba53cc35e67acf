"""Records what sdypy-EMA makes of the shipped measured beam: `python -m tests.validation.record_lscf`.

Its poles of high orders depend on the processor's linear algebra, so that rows computed anew would differ
from machine to machine.
"""

from __future__ import annotations

import contextlib
import io
import json
from importlib.metadata import version
from typing import Any

import numpy as np
import sdypy.EMA as peer

from tests.validation.peers import RECORDED
from tests.validation.shipped import PRINTED_MODE, variables


def poles() -> tuple[np.ndarray, np.ndarray]:
    """Frequency [Hz] and damping ratio of the pole nearest the mode, orders 5 to 20 over 204-220 Hz."""
    of = variables("case1.mat")
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        frequency = of["Freq_domain"].ravel().astype(float)
        model = peer.Model(
            of["Hf_chan_2"].T, frequency, lower=204, upper=220, pol_order_high=20, frf_form="receptance"
        )
        model.get_poles(method="lscf", show_progress=False)
    found = []
    for frequencies, ratios in zip(model.pole_freq[5:], model.pole_xi[5:], strict=True):
        nearest = int(np.argmin(np.abs(np.asarray(frequencies) - PRINTED_MODE)))
        found.append((np.asarray(frequencies)[nearest], np.asarray(ratios)[nearest]))
    of_frequency, of_ratio = np.array(found).T
    return of_frequency, of_ratio


def main() -> None:
    frequency, ratio = poles()
    shares = [5, 50, 95]
    record: dict[str, Any] = {
        "program": f"sdypy-EMA {version('sdypy-EMA')}",
        "command": "python -m tests.validation.record_lscf",
        "frequency": np.percentile(frequency, shares).tolist(),
        "ratio": np.percentile(ratio, shares).tolist(),
    }
    (RECORDED / "lscf.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
