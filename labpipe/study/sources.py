"""Where a study's responses come from: a virtual rig, its noise level, a seed; and the truth behind them. SOURCES by kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from labpipe.errors import ConfigError
from labpipe.identify.constraints import constrained
from labpipe.identify.measured import measured_part, select_ports
from labpipe.identify.output_error import OutputError
from labpipe.identify.settings import MODELS, FitSettings
from labpipe.identify.setup import Setup
from labpipe.identify.weights import whitener
from labpipe.records.response import FrequencyResponse
from labpipe.simulate import magnetic_rig, mdof_rig
from labpipe.simulate.magnetic_rig import RUNS
from labpipe.simulate.mdof_rig import VirtualMdofRig
from labpipe.simulate.one_dof import ONE_DOF, expected_std_error
from labpipe.simulate.settings import VirtualRig
from labpipe.spectra.bands import lines_in
from labpipe.spectra.measurement import measure
from labpipe.spectra.settings import FrfSettings

Truth = dict[str, float]


class Source(Protocol):
    """Responses of a virtual rig, as many as wanted, all with one truth."""

    @property
    def truth(self) -> Truth: ...
    @property
    def n_line(self) -> int: ...
    def response(self, seed: tuple[int, ...]) -> FrequencyResponse: ...
    def bounds(self, settings: FitSettings) -> dict[str, float]:
        """Cramer-Rao standard deviations of a fit's parameters by name, as far as they are known."""
        ...


@dataclass(frozen=True)
class MdofSource:
    """FRFs of a virtual mdof rig."""

    rig: VirtualMdofRig

    @property
    def truth(self) -> Truth:
        return mdof_rig.truth(self.rig)

    @property
    def n_line(self) -> int:
        return self.rig.lines.count

    def response(self, seed: tuple[int, ...]) -> FrequencyResponse:
        return mdof_rig.simulated_response(self.rig, np.random.default_rng(seed))

    def bounds(self, settings: FitSettings) -> dict[str, float]:
        """sqrt(diag((J^T J)^-1)) of the weighted output error at the truth; empty where the fit's parameters are not the rig's."""
        exact = mdof_rig.simulated_response(self.rig, None)
        rows, columns = select_ports(exact, settings.input, settings.output)
        setup = Setup(tuple(exact.outputs[row] for row in rows), tuple(exact.inputs[column] for column in columns), settings)
        model = constrained(MODELS[settings.model](setup), settings)
        if any(name not in self.truth for name in model.names):
            return {}
        measured = measured_part(exact, rows, columns, _lines(exact.frequency, settings))
        problem = OutputError(measured, model, whitener(measured))
        jacobian = problem.jacobian(np.array([self.truth[name] for name in model.names]))
        deviations = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
        return {name: float(deviation) for name, deviation in zip(model.names, deviations, strict=True)}


@dataclass(frozen=True)
class MagneticSource:
    """FRFs measured from recordings of the virtual magnetic-bearing rig."""

    rig: VirtualRig
    runs: tuple[str, ...]
    frf: FrfSettings

    @property
    def truth(self) -> Truth:
        (first, *_) = magnetic_rig.simulate(self.rig, 0, self.runs[:1])
        return {name: float(value) for name, value in first.truth.items() if isinstance(value, (int, float))}

    @property
    def n_line(self) -> int:
        return self.response((0, 0)).n_frequency

    def response(self, seed: tuple[int, ...]) -> FrequencyResponse:
        recordings = [run.recording for run in magnetic_rig.simulate(self.rig, _joined(seed), self.runs) if run.recording is not None]
        return measure(recordings, self.frf)

    def bounds(self, settings: FitSettings) -> dict[str, float]:
        """Of k and c of a one-dof run whose mass is known; empty for others."""
        if self.runs[0] not in ONE_DOF or settings.model != "sdof" or isinstance(settings.mass, str):
            return {}
        return expected_std_error(self.rig, self.runs[0], settings.band or self.frf.band or (0.0, np.inf))


def _lines(frequency: NDArray[np.floating], settings: FitSettings) -> NDArray[np.bool_]:
    return np.ones(frequency.shape, bool) if settings.band is None else lines_in(frequency, settings.band)


def _joined(seed: tuple[int, ...]) -> int:
    """One integer from several, different for different tuples of up to a million repeats."""
    joined = 0
    for part in seed:
        joined = joined * 1_000_003 + part
    return joined


def source_of(rig: Any, noise: float, lines: int | None, runs: tuple[str, ...], frf: FrfSettings | None) -> Source:
    """The source of a virtual rig at a noise level; ConfigError where the study asks what the rig cannot give."""
    return SOURCES[rig.kind](rig, noise, lines, runs, frf)


def _mdof(rig: VirtualMdofRig, noise: float, lines: int | None, runs: tuple[str, ...], frf: FrfSettings | None) -> Source:  # noqa: ARG001
    if runs:
        raise ConfigError("'runs': this rig has none", hint="leave it out")
    own_lines = rig.lines if lines is None else replace(rig.lines, count=lines)
    return MdofSource(replace(rig, noise=noise, lines=own_lines))


def _magnetic(rig: VirtualRig, noise: float, lines: int | None, runs: tuple[str, ...], frf: FrfSettings | None) -> Source:
    if lines is not None:
        raise ConfigError("'lines': the lines of this rig follow from its excitation", hint="leave it out")
    unknown = [run for run in runs if run not in RUNS]
    if not runs or unknown:
        raise ConfigError(f"'runs': {'no run ' + repr(unknown[0]) if unknown else 'is missing'}", hint=f"known: {', '.join(RUNS)}")
    if frf is None:
        raise ConfigError("the study needs the frf: section to measure this rig's recordings")
    own = rig.noise
    noisy = replace(own, displacement=noise * own.displacement, force=noise * own.force, hover=noise * own.hover)
    return MagneticSource(replace(rig, noise=noisy), runs, frf)


SOURCES: dict[str, Callable[[Any, float, int | None, tuple[str, ...], FrfSettings | None], Source]] = {
    mdof_rig.KIND: _mdof,
    "virtual-magnetic-rig": _magnetic,
}
