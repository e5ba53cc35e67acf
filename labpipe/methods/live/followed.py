"""One fit of a pipeline, followed average by average, with all that its interval holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import LinAlgError

from labpipe.arrays import ComplexArray, FloatArray
from labpipe.errors import ConfigError, LabpipeError
from labpipe.estimation.damping import damped
from labpipe.estimation.derived import reported_parameters
from labpipe.estimation.fitting import identify
from labpipe.estimation.linear_models import form_view
from labpipe.estimation.measured import chosen_ports
from labpipe.estimation.model import DynamicModel, Setup
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import Estimate as FitEstimate
from labpipe.estimation.transfer_mode import transfer_of
from labpipe.methods.live.averages import Average
from labpipe.methods.live.charts import Charts
from labpipe.methods.live.running_fit import HALF_WIDTH, Directions, Equation, Estimate, RunningFit
from labpipe.records.finding import NORMAL, Parameter
from labpipe.records.identification import Goodness
from labpipe.records.response import FrequencyResponse
from labpipe.records.settings import ESTIMATE
from labpipe.spectra.bands import lines_in
from labpipe.spectra.covariance import covariance_of_periodic
from labpipe.spectra.ports import Layout, sensor_response
from labpipe.spectra.settings import FrfSettings

# The fit of a run is made of the averages so far when there are so many in every direction, and again when
# there are so many times more: what it adds to noise moves little from average to average.
FIRST_LOOK, NEXT_LOOK = 3, 1.4


@dataclass(frozen=True)
class Common:
    """What more averages do not take from the interval of a coefficient: the standard uncertainty *error* of
    model error and of stated numbers, the *shift* [parameter unit] of the value by the former, the *reason*.
    """

    error: float
    shift: float
    reason: str

    @property
    def half(self) -> float:
        return NORMAL * self.error


class FollowedFit:
    """One fit of the pipeline, followed average by average on its own lines and channels."""

    def __init__(self, settings: FitSettings, layout: Layout, frequency: FloatArray, hits: bool) -> None:
        rows = chosen_ports(layout.outputs, settings.output, "response")
        columns = chosen_ports(layout.inputs, settings.input, "force")
        outputs = tuple(layout.outputs[row] for row in rows)
        inputs = tuple(layout.inputs[column] for column in columns)
        self.settings, self.setup = settings, Setup(outputs, inputs, settings)
        if settings.mass == ESTIMATE and settings.kind.one_frf and transfer_of(self.setup):
            raise ConfigError(
                f"identify.{settings.name}: a transfer FRF of unknown mass is not followed live",
                hint="give the mass, or measure at the point of the force",
            )
        model = damped(settings.kind.model(self.setup), settings)
        if not isinstance(model, DynamicModel):
            raise ConfigError(
                f"identify.{settings.name}: damping: {settings.damping} is not followed live", hint="viscous"
            )
        self._channels = [layout.output_columns[0][row] for row in rows]
        self._channels += [layout.input_columns[0][column] for column in columns]
        band = settings.band or (settings.bands[0] if settings.bands else None)
        self._lines = np.flatnonzero(lines_in(frequency, band))
        if self._lines.size <= len(model.names):
            raise ConfigError(
                f"identify.{settings.name}: {self._lines.size} lines in the band cannot tell "
                f"{len(model.names)} coefficients",
                hint="widen the band",
            )
        chosen, view = frequency[self._lines], form_view(layout.form, settings)
        sensors = (*layout.output_sensors, *layout.input_sensors)
        picked = [sensors[row] for row in rows]
        picked += [sensors[len(layout.outputs) + column] for column in columns]
        self._sensors = np.array([sensor_response(sensor, chosen) for sensor in picked]).T
        self._sensors[:, : len(rows)] *= (2j * np.pi * chosen[:, None]) ** layout.derivatives
        self._form = layout.form
        equation = Equation(model, 2 * np.pi * chosen, view.factor(chosen), view.offset)
        self.fit = RunningFit(equation, settings.coverage)
        self.sums = Directions(hits)
        self.charts = Charts(self.fit)
        self.model = model
        self.estimate: Estimate | None = None
        self.widths: dict[str, list[float]] = {}
        self.common: Mapping[str, Common] = {}
        self._looked_at, self._next_look = 0, FIRST_LOOK

    def picked(self, average: Average) -> ComplexArray:
        """The amplitudes of the fit's lines and channels, (n_line, 1, n_channel) [channels' units], sensors
        taken out.
        """
        z = average.amplitude[self._lines][:, self._channels] / self._sensors
        return z[:, None, :]

    def add(self, z: ComplexArray, direction: int) -> None:
        """Take in an average's amplitudes *z* (n_line, 1, n_channel) [channels' units] in that direction."""
        sums = self.sums.of(direction)
        sums.add(z)
        if sums.n == 2:
            # What another direction tells is far from where the one before left the coefficients.
            self.fit.values = None
        if sums.n >= 2:
            self.estimate = self.fit.update(self.sums)
        if self.estimate is not None and self.estimate.least >= self._next_look:
            self.look()

    def look(self) -> None:
        """Ask the fit of a run for what it adds to noise, of the averages so far.

        Where it cannot be made, what was known before stays.
        """
        estimate = self.estimate
        assert estimate is not None
        if self._looked_at == estimate.n:
            return
        self._looked_at = estimate.n
        self._next_look = int(np.ceil(NEXT_LOOK * estimate.least))
        try:
            response = self._response()
            fits = [] if response is None else list(identify(response, replace(self.settings, test=())))
        except (LabpipeError, LinAlgError):
            return
        now = {parameter.name: parameter.value for parameter in self._of_noise()}
        self.common = {
            parameter.name: Common(
                float(np.hypot(parts.discrepancy, parts.systematic)),
                parameter.value - now[parameter.name] if parts.discrepancy else 0.0,
                parameter.reason,
            )
            for parameter in (fits[0].parameters if fits else ())
            if (parts := parameter.interval) is not None and parameter.name in now
        }

    def _response(self) -> FrequencyResponse | None:
        n_output = len(self.setup.outputs)
        mean, noise = self.sums.mean, self.sums.covariance()
        motion, force = (part.swapaxes(1, 2) for part in (mean[..., :n_output], mean[..., n_output:]))
        if force.shape[2] < force.shape[1]:
            return None
        inverse = np.linalg.pinv(force)
        matrix = motion @ inverse
        forces_first = np.roll(np.arange(mean.shape[2]), -n_output)
        noise = noise[:, :, forces_first][..., forces_first].swapaxes(0, 1)
        least = int(self.sums.counts.min())
        return FrequencyResponse(
            frequency=self.fit.equation.omega / (2 * np.pi),
            matrix=matrix,
            outputs=self.setup.outputs,
            inputs=self.setup.inputs,
            form=self._form,
            covariance=covariance_of_periodic(matrix, inverse, noise),
            averages=float(least),
            covariance_dof=float((least - 1) * (2 * HALF_WIDTH + 1)),
        )

    def parameters(self) -> tuple[Parameter, ...]:
        """The coefficients and what is derived of them, with the interval that holds at this moment: of
        noise, model error and stated uncertainties.
        """
        return tuple(self._whole(parameter) for parameter in self._of_noise())

    def _whole(self, parameter: Parameter) -> Parameter:
        common = self.common.get(parameter.name)
        if common is None or parameter.ci95 is None:
            return parameter
        low, high = parameter.ci95
        value, half = parameter.value + common.shift, float(np.hypot((high - low) / 2, common.half))
        return replace(
            parameter,
            value=value,
            ci95=(value - half, value + half),
            reason=common.reason or parameter.reason,
        )

    @property
    def by_chi_square(self) -> float:
        """The factor on noise [1] by which a misfit widens an interval as long as its model error is
        unknown.
        """
        estimate = self.estimate
        assert estimate is not None
        return float(np.sqrt(estimate.reduced)) if estimate.misfit and not self.common else 1.0

    def _of_noise(self) -> tuple[Parameter, ...]:
        """The coefficients and what is derived of them, with intervals of noise, and of the misfit as long as
        nothing better is known of it.
        """
        estimate = self.estimate
        assert estimate is not None
        dof = np.maximum(estimate.dof.astype(int), 1)
        design = (
            np.linalg.cholesky(_scaled(estimate.information)).T if estimate.identifiable else np.eye(dof.size)
        )
        widened = 1 + 2 / float(estimate.dof.min())
        both = []
        for factor in (1.0, widened * self.by_chi_square**2):
            fitted = FitEstimate(
                values=estimate.values,
                covariance=factor * estimate.covariance,
                scaled_design=design,
                gof=Goodness(0.0, 0.0, estimate.reduced, None),
                dof=int(dof.min()),
                parameter_dof=dof,
            )
            both.append(reported_parameters(fitted, self.model, self.setup))
        plain, wide = both
        return tuple(
            replace(parameter, std_error=narrow.std_error)
            for narrow, parameter in zip(plain, wide, strict=True)
        )


def _scaled(information: FloatArray) -> FloatArray:
    scale = np.sqrt(np.diag(information))
    return np.asarray(information / np.outer(scale, scale))


def is_followed(settings: FitSettings, frf: FrfSettings) -> bool:
    """Whether a fit can be followed average by average: a model linear in its parameters, by maximum
    likelihood, on plain periods or hits.
    """
    plain = not (settings.eliminate or settings.bootstrap or settings.monte_carlo or settings.compare)
    single = settings.sliding is None and not settings.peaks and len(settings.bands) <= 1
    return (
        settings.kind.equations is not None
        and settings.estimates.likelihood
        and plain
        and single
        and frf.single_averages
    )


def names_of_fit(settings: FitSettings, layout: Layout) -> tuple[str, ...]:
    """The coefficients that a fit will have, those derived of one mode among them."""
    rows = chosen_ports(layout.outputs, settings.output, "response")
    columns = chosen_ports(layout.inputs, settings.input, "force")
    setup = Setup(
        tuple(layout.outputs[row] for row in rows), tuple(layout.inputs[c] for c in columns), settings
    )
    names = settings.kind.model(setup).names
    return (*names, "f_n", "zeta") if settings.kind.one_mode else names
