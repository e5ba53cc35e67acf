"""Run-ups of a pipeline before anything is fitted: what was known to act on a recorded run, and on its
residual.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from labpipe.artefacts.writing import OutputFolder
from labpipe.methods.run_ups import section as run_ups_reading
from labpipe.methods.run_ups.measured import excitation_text
from labpipe.methods.run_ups.records import RunUp
from labpipe.methods.run_ups.rotor import RunUpRotor
from labpipe.methods.run_ups.section import read_run
from labpipe.methods.run_ups.settings import RunSettings
from labpipe.records.recording import Recording
from labpipe.records.rig import Rig
from labpipe.records.uncertain import ChannelUncertainty, Uncertainty
from labpipe.spectra.settings import ShaftLines
from tests.methods.run_ups.test_run_up_orders import sweep


class Anything:
    def excite(self, run: RunUp) -> None:
        pass


def test_the_residual_of_a_recorded_run_has_no_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """The run is tracked at 100 to 300 rad/s, the residual at 150 to 400: the difference is that of the
    weight, where both are known.
    """

    def tracked(path: Path, _lines: object, settings: RunSettings, unbalance: dict[str, complex]) -> RunUp:
        is_residual = path.name == "left.parquet"
        speed = np.linspace(150.0, 400.0, 26) if is_residual else np.linspace(100.0, 300.0, 21)
        response = np.broadcast_to(1e-5 if is_residual else 3e-5 + 1e-5j, (speed.size, 2, 2)).astype(complex)
        error = np.full(response.shape, 1e-7)
        planes = ("disc 1", "disc 2")
        return RunUp(
            path.name,
            8.0,
            speed,
            planes,
            response,
            amplitude_error=error,
            phase_error=error / 1e-5,
            unbalance=unbalance,
        )

    monkeypatch.setattr(run_ups_reading, "_open", lambda path, *_: path)
    monkeypatch.setattr(run_ups_reading, "_track", tracked)
    monkeypatch.setattr(run_ups_reading, "_cascades", lambda *_: ())
    settings = RunSettings(
        recording="run.parquet", tacho="n", load=8.0, unbalance=(("disc 2", 2e-5 + 0j),),
        path=Path("run.parquet"),
        subtract="left.parquet", subtracted=Path("left.parquet"), recorded_by=Rig("", ()),
    )  # fmt: skip
    run = read_run(settings, cast("RunUpRotor", Anything()), cast("OutputFolder", None), Path()).run
    np.testing.assert_allclose(run.speed, np.arange(150.0, 301.0, 10.0))
    np.testing.assert_allclose(run.response, 2e-5 + 1e-5j)
    assert excitation_text(run.unbalance, run.shaker) == "disc 2: 20 g mm at 0 deg"
    assert all(np.all(values > 0) for values in (run.amplitude_error, run.phase_error))


def test_a_stated_load_is_that_of_the_residual_run_as_well(tmp_path: Path) -> None:
    """A table of twice the amplitudes less one of once, both under 3 N by themselves."""
    text = "# load: 3 N\n# unbalance d: {0} g.mm at 0 deg\n# amplitude error: 1 %\n# phase error: 1 deg\n"
    text += "speed [rpm],d x amplitude [um],d x phase [deg],d y amplitude [um],d y phase [deg]\n"
    text += "600,{0},0,{0},90\n"
    for name, size in (("run.csv", 2), ("left.csv", 1)):
        (tmp_path / name).write_text(text.format(size), encoding="utf-8")
    files = {"file": "run.csv", "path": tmp_path / "run.csv", "subtract": "left.csv"}
    settings = RunSettings(**files, subtracted=tmp_path / "left.csv", load=5.0)  # type: ignore[arg-type]
    run = run_ups_reading.read_measured_run(settings, cast("OutputFolder", None), tmp_path).run
    assert run.load == 5.0 and np.abs(run.response) == pytest.approx(1e-6)


SETTINGS = RunSettings(recording="a.parquet", tacho="tacho", load=8.0, unbalance=(("disc 1", 2e-5 + 0j),))


def delayed(source: Recording, *names: str) -> Recording:
    """The recording with one error of 0.1 ms in the delay of the channels of these *names*."""
    error = ChannelUncertainty("delay", Uncertainty("logger", 1e-4, "s"))
    channels = (replace(c, uncertainties=(error,) * (c.name in names)) for c in source.channels)
    return replace(source, channels=tuple(channels))


def test_a_delay_of_the_tacho_is_one_of_all_phasors() -> None:
    """0.1 ms turns them by w times that; where the probes are as late, nothing turns."""

    def changes(*names: str) -> tuple[RunUp, np.ndarray]:
        source = delayed(sweep(10.0), *names)
        run = run_ups_reading._track(source, ShaftLines(tacho="tacho"), SETTINGS, {"disc 1": 1e-5 + 0j})
        return run, run.changes()["logger"]

    run, turned = changes("tacho")
    np.testing.assert_allclose(turned, -1e-4j * run.speed[:, None, None] * run.response)
    np.testing.assert_allclose(changes("tacho", "a", "b")[1], 0, atol=1e-20)


def test_a_cascade_shows_displacements_alone() -> None:
    source = sweep(10.0)
    source = replace(
        source,
        channels=(source.channels[0], replace(source.channels[1], quantity="velocity"), source.channels[2]),
    )
    shown = run_ups_reading._cascades(source, ShaftLines(tacho="tacho"))
    assert [cascade.label for cascade in shown] == ["a"]
