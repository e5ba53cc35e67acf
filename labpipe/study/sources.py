"""Responses of a study from a virtual rig, noise level and seed, and their true parameters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from labpipe.arrays import BoolArray, FloatArray
from labpipe.errors import ConfigError
from labpipe.identify.constraints import constrained
from labpipe.identify.measured import measured_part, select_ports
from labpipe.identify.output_error import OutputError
from labpipe.identify.settings import FitSettings
from labpipe.identify.setup import Setup
from labpipe.identify.weights import whitener
from labpipe.records.channel_spectra import ChannelSpectra
from labpipe.records.response import FrequencyResponse
from labpipe.simulate.virtual_rigs import Truth, VirtualRig, chosen_runs, kind_of, simulated_response
from labpipe.spectra.bands import lines_in
from labpipe.spectra.settings import FrfSettings


@dataclass(frozen=True)
class Source:
    """Responses of a virtual *rig* from its *runs*, with the same true parameters; *frf*: how recordings are measured."""

    rig: VirtualRig
    runs: tuple[str, ...]
    frf: FrfSettings | None

    @cached_property
    def truth(self) -> Truth:
        """True parameters by name [SI units]."""
        return kind_of(self.rig).parameters(self.rig, self.runs)

    @cached_property
    def n_line(self) -> int:
        """Number of frequency lines of a response."""
        return int(self.response((0, 0)).frequency.size)

    def response(self, seed: tuple[int, ...]) -> FrequencyResponse | ChannelSpectra:
        """The response, or the spectra, with the noise of a *seed*."""
        return simulated_response(self.rig, seed, self.runs or None, self.frf)

    def bounds(self, settings: FitSettings) -> Truth:
        """Cramer-Rao standard deviations of a fit's parameters by name, as far as the rig provides them."""
        kind = kind_of(self.rig)
        if kind.response is not None:
            return _bounds_of_response(kind.response(self.rig, None), self.truth, settings)
        if kind.std_errors is None or not settings.kind.one_frf or isinstance(settings.mass, str):
            return {}
        whole = self.frf.band if self.frf is not None else None
        return kind.std_errors(self.rig, self.runs, settings.band or whole or (0.0, np.inf))


def _bounds_of_response(exact: FrequencyResponse, truth: Truth, settings: FitSettings) -> Truth:
    """sqrt(diag((J^T J)^-1)) of the weighted output error at the truth; empty where the fit's parameters differ from the rig's."""
    rows, columns = select_ports(exact, settings.input, settings.output)
    setup = Setup(tuple(exact.outputs[row] for row in rows), tuple(exact.inputs[column] for column in columns), settings)
    model = constrained(settings.kind.model(setup), settings)
    if any(name not in truth for name in model.names):
        return {}
    measured = measured_part(exact, rows, columns, _lines(exact.frequency, settings))
    problem = OutputError(measured, model, whitener(measured))
    jacobian = problem.jacobian(np.array([truth[name] for name in model.names]))
    deviations = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    return {name: float(deviation) for name, deviation in zip(model.names, deviations, strict=True)}


def _lines(frequency: FloatArray, settings: FitSettings) -> BoolArray:
    return np.ones(frequency.shape, bool) if settings.band is None else lines_in(frequency, settings.band)


def source_of(rig: VirtualRig, noise: float, lines: int | None, runs: tuple[str, ...], frf: FrfSettings | None) -> Source:
    """The source of a virtual rig at a noise level; ConfigError for lines or runs that the rig does not have."""
    kind = kind_of(rig)
    if kind.response is None and kind.recordings is None:
        raise ConfigError(f"a {rig.kind} gives no frequency response", hint="studies repeat fits of frequency responses")
    if lines is not None and kind.with_lines is None:
        raise ConfigError("'lines': the lines of this rig follow from its excitation", hint="leave it out")
    available = kind.runs(rig)
    if runs and not available:
        raise ConfigError("'runs': this rig has none", hint="leave it out")
    if available and not runs:
        raise ConfigError("'runs': is missing", hint=f"known: {', '.join(available)}")
    if available:
        chosen_runs(rig, runs)
    if kind.response is None and frf is None:
        raise ConfigError("the study needs the frf: section to measure this rig's recordings")
    noisy: VirtualRig = kind.noisy(rig, noise)
    if lines is not None and kind.with_lines is not None:
        noisy = kind.with_lines(noisy, lines)
    return Source(noisy, runs, frf)
