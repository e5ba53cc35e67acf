"""The bench: averages in, after each the wanted coefficients with intervals that hold at this moment.

Stopping on the width of a corrected interval keeps its coverage, stopping on the value does not: a rule of
`--until` names a width.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import LinAlgError

from labpipe.arrays import ComplexArray, FloatArray, IntArray
from labpipe.errors import ConfigError, FitError, LabpipeError
from labpipe.estimation.damping import damp
from labpipe.estimation.derived import reported_parameters
from labpipe.estimation.fitting import identify
from labpipe.estimation.linear_models import form_view
from labpipe.estimation.measured import chosen_ports
from labpipe.estimation.model import DynamicModel, Equation, Setup
from labpipe.estimation.settings import FitSettings
from labpipe.estimation.statistics import Estimate as FitEstimate
from labpipe.estimation.transfer_mode import transfer_of
from labpipe.methods.live import charts, cutters, running_fit
from labpipe.records.finding import NORMAL, Finding, Parameter
from labpipe.records.identification import Fit, Goodness
from labpipe.records.recording import Channel, Recording
from labpipe.records.response import FrequencyResponse
from labpipe.records.settings import ESTIMATE
from labpipe.records.uncertain import MatrixError, Uncertainty
from labpipe.spectra.bands import lines_in
from labpipe.spectra.covariance import covariance_of_periodic
from labpipe.spectra.period_average import LineSpectrum, excited_lines, smoothed_noise
from labpipe.spectra.periodic import no_line
from labpipe.spectra.ports import Layout, find_layout, sensor_response
from labpipe.spectra.settings import SPECTRA, FrfSettings

# The fit of a run is made of the averages so far when there are so many in every direction, and again when
# there are so many times more: what it adds to noise moves little from average to average.
FIRST_LOOK, NEXT_LOOK = 3, 1.4
RINGS_ON = "the response rings on at the end of the block, lengthen `block`"


class FollowedFit:
    """One fit of the pipeline, followed average by average on its own lines and channels, among *lines* of
    those that *cutter* makes. *block*: how long the response is followed after a hit [s], 0 for periods.
    """

    def __init__(
        self, settings: FitSettings, layout: Layout, cutter: cutters.Cutter, lines: IntArray, block: float
    ) -> None:
        self.settings = settings
        self.per_hit = block > 0 and settings.repeats == "each" and len(layout.inputs) == 1
        self.setup, rows, columns = _setup(settings, layout)
        model = damp(settings.kind.model(self.setup), settings)
        assert isinstance(model, DynamicModel)
        ports = [*rows, *(len(layout.outputs) + column for column in columns)]
        places = (*layout.output_columns[0], *layout.input_columns[0])
        self._channels = [places[port] for port in ports]
        self._columns = columns
        frequency = cutter.frequency[lines]
        band = settings.band or (settings.bands[0] if settings.bands else None)
        self._lines = np.flatnonzero(lines_in(frequency, band))
        if self._lines.size <= len(model.names):
            what = f"{self._lines.size} lines in the band cannot tell {len(model.names)} coefficients"
            raise ConfigError(f"identify.{settings.name}: {what}", hint="widen the band")
        chosen, view = frequency[self._lines], form_view(layout.form, settings)
        sensors = (*layout.output_sensors, *layout.input_sensors)
        self._sensors = np.array([sensor_response(sensors[port], chosen) for port in ports]).T
        self._sensors[:, : len(rows)] *= layout.motion_factor(chosen)[:, rows]
        self._form = layout.form
        equation = Equation(model, 2 * np.pi * chosen, view.factor(chosen), view.offset)
        self.fit = running_fit.RunningFit(equation)
        size, shapes = np.abs(self._sensors[:, -1:]), cutter.window_shapes(lines[self._lines])
        shapes = None if shapes is None else shapes * size / self._sensors[:, -1:]
        self.per_hit &= shapes is None
        at = running_fit.ForceLines(lines[self._lines], 1 / size[:, 0] ** 2, shapes)
        self.sums, self._block = running_fit.Directions(block > 0, at), block
        self._hits: list[ComplexArray] = []
        self.charts = charts.Charts(self.fit)
        self.model = model
        self.estimate: running_fit.RunningEstimate | None = None
        self.widths: dict[str, list[float]] = {}
        self.first: list[tuple[ComplexArray, int, FloatArray | None]] = []
        self.common: Mapping[str, charts.CommonPart] = {}
        self.by_run: Fit | None = None
        self._looked_at, self._next_look = 0, FIRST_LOOK
        self._by_turns: tuple[int, FloatArray] = 0, np.empty(0)

    @property
    def now(self) -> running_fit.RunningEstimate:
        """The estimate, of a fit that has one."""
        assert self.estimate is not None
        return self.estimate

    def pick(self, average: cutters.Average) -> ComplexArray:
        """The fit's lines and channels, sensors taken out, (n_line, 1, n_channel) [channels' units]."""
        z = average.amplitude[self._lines][:, self._channels] / self._sensors
        return z[:, None, :]

    def check(self, averages: Sequence[cutters.Average]) -> None:
        """FitError for the first *averages* of a direction that show no motion, or no noise at all."""
        z = np.array([self.pick(average) for average in averages])
        for number, port in enumerate(self.setup.outputs):
            if not z[..., number].any():
                what = f"{port.label} is zero at every line of the band; is the sensor connected?"
                raise FitError(f"identify.{self.settings.name}: {what}")
        if np.array_equal(z[0], z[1]):
            what = f"identify.{self.settings.name}: averages are equal to the last digit"
            raise FitError(what, hint="without noise no interval is known: a test cannot end by its width")

    def add(self, z: ComplexArray, direction: int, noise: FloatArray | None) -> None:
        """Take in an average's amplitudes *z* (n_line, 1, n_channel) [channels' units] in that direction, and
        the *noise* of its force.
        """
        sums = self.sums.of(direction)
        if sums.n < 2:
            self.first.append((z, direction, noise))
        self._count(z, direction, noise)
        if sums.n == 2:
            # What another direction tells is far from where the one before left the coefficients.
            self.fit.values = None
        if sums.n >= 2:
            self.estimate = self.fit.update(self.sums)
        if self.estimate is not None and self.estimate.least >= self._next_look:
            self.look()

    def _count(self, z: ComplexArray, direction: int, noise: FloatArray | None, sign: int = 1) -> None:
        sums = self.sums.of(direction)
        sums.add(z, sign)
        self._hits = [*self._hits, z] if sign > 0 else [hit for hit in self._hits if hit is not z]
        if noise is not None and isinstance(sums, running_fit.HitSums):
            sums.add_noise(noise, sign)

    def move(self, place: int, sign: int) -> None:
        """Take one of the first averages out (*sign* -1) or in again."""
        z, direction, noise = self.first[place]
        self._count(z, direction, noise, sign)
        self.estimate = self.fit.update(self.sums)

    def first_disagrees(self, place: int) -> bool:
        """Take one of the first averages out; whether it does not agree with the others."""
        self.move(place, -1)
        z, direction, _ = self.first[place]
        return self.charts.jumps(z, self.sums.of(direction), self.now)

    def look(self) -> None:
        """Ask the fit of a run for what it adds to noise; where none can be made, the last one stays."""
        if self._looked_at == self.now.n:
            return
        self._looked_at = self.now.n
        self._next_look = int(np.ceil(NEXT_LOOK * self.now.least))
        try:
            response = self.response()
            fits = [] if response is None else list(identify(response, replace(self.settings, test=())))
        except (LabpipeError, LinAlgError):
            return
        self.by_run = fits[0] if fits else None
        now = {parameter.name: parameter.value for parameter in self._noise_parameters()}
        rings = self._rings_on(now)
        lasts = charts.lasting(fits[0], response.errors) if fits and response is not None else {}
        self.common = {
            parameter.name: charts.CommonPart(
                math.hypot(lasts[parameter.name], rest := rings.get(parameter.name, 0.0)),
                parameter.value - now[parameter.name] if parts.discrepancy else 0.0,
                RINGS_ON if rest > lasts[parameter.name] else parameter.reason,
                charts.scatter_of_repeats(parameter),
            )
            for parameter in (fits[0].parameters if fits else ())
            if (parts := parameter.interval) is not None and parameter.name in now
        }

    def _rings_on(self, now: Mapping[str, float]) -> dict[str, float]:
        """Half-widths [parameter units] by what of a mode is left at the end of the block, e^(-zeta w T): all
        lines are that share of H off alike, at a phase that nothing tells.
        """
        if not self._block or "zeta" not in now:
            return {}
        remainder = math.exp(-2 * math.pi * now["f_n"] * max(now["zeta"], 0.0) * self._block)
        return {name: NORMAL * remainder / math.sqrt(2) * abs(now[name]) for name in self.model.names}

    def response(self) -> FrequencyResponse | None:
        """The FRFs on the fit's lines by all averages so far; None before every direction had two."""
        n_output = len(self.setup.outputs)
        mean, noise = self.sums.mean, self.sums.covariance()
        motion, force = (part.swapaxes(1, 2) for part in (mean[..., :n_output], mean[..., n_output:]))
        if force.shape[2] < force.shape[1]:
            return None
        inverse = np.linalg.pinv(force)
        matrix = motion @ inverse
        forces_first = np.roll(np.arange(mean.shape[2]), -n_output)
        changes = self.sums.common()[..., :n_output].swapaxes(2, 3)
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
            covariance_dof=float((least - 1) * (2 * running_fit.HALF_WIDTH + 1)),
            **charts.hits_as_repeats(self._hits if self.per_hit else (), n_output),
            errors=tuple(
                MatrixError(Uncertainty(f"noise of the force in its window {n}", 1.0, "1"), change, True)
                for n, change in enumerate(changes @ inverse, 1)
            ),
        )

    @property
    def by_chi_square(self) -> float:
        """The factor on noise [1] by a misfit whose model error is unknown as yet."""
        return float(np.sqrt(self.now.reduced)) if self.now.misfit and not self.common else 1.0

    def parameters(self) -> tuple[Parameter, ...]:
        """The coefficients and what derives from them, with the whole interval that holds at this moment."""
        parameters = []
        for parameter in self._noise_parameters():
            common = self.common.get(parameter.name)
            if common is not None and parameter.ci95 is not None:
                low, high = parameter.ci95
                value, half = common.whole(parameter.value, (high - low) / 2)
                ends, reason = (value - half, value + half), common.reason or parameter.reason
                parameter = replace(parameter, value=value, ci95=ends, reason=reason)
            parameters.append(parameter)
        return tuple(parameters)

    def _noise_parameters(self) -> tuple[Parameter, ...]:
        estimate = self.now
        dof = np.maximum(estimate.dof.astype(int), 1)
        design = running_fit.rescale(estimate.information)[0] if estimate.identifiable else np.eye(dof.size)
        # The scale is selected low where the width ends the test; what an interval has beyond noise.
        widened = (1 + 2 / float(estimate.dof.min())) * self.by_chi_square**2
        fitted = FitEstimate(
            values=estimate.values,
            covariance=widened * estimate.covariance,
            scaled_design=np.linalg.cholesky(design).T,
            gof=Goodness(0.0, 0.0, estimate.reduced, None),
            dof=int(dof.min()),
            parameter_dof=dof,
        )
        return tuple(
            replace(p, std_error=None if p.std_error is None else p.std_error / math.sqrt(widened))
            for p in reported_parameters(fitted, self.model, self.setup)
        )

    def forecast_other_forces(self, number: int, goal: float) -> charts.OtherForces | None:
        """What the forces that did not act yet would save of the averages until coefficient *number* has the
        half-width *goal* [parameter unit]; None where all did.
        """
        sizes = np.linalg.norm(self.sums.mean[..., len(self.setup.outputs) :], axis=0)
        acted = np.any(sizes >= cutters.ACTS * sizes.max(axis=1, keepdims=True), axis=0)
        forces = [int(n) for n in np.flatnonzero(~acted)]
        if not forces:
            return None
        if self._by_turns[0] != self.now.n:
            self._by_turns = self.now.n, self._round(forces)
        rounds = (NORMAL / goal) ** 2 * self._by_turns[1][number]
        per_direction = max(math.ceil(rounds), running_fit.LEAST_AVERAGES)
        more = int(np.maximum(per_direction - self.sums.counts, 0).sum()) + per_direction * len(forces)
        return charts.OtherForces(tuple(self.setup.inputs[n].label for n in forces), more)

    def _round(self, forces: Sequence[int]) -> FloatArray:
        """The variance (n_parameter,) [squared parameter units] by one average in each direction: those that
        were shaken, and *forces* as hard as they, by the coefficients and the noise so far.
        """
        n_output, mean, counts = len(self.setup.outputs), self.sums.mean, self.sums.counts
        level = np.sqrt(np.mean(np.sum(np.abs(mean[..., n_output:]) ** 2, axis=2), axis=1))
        z = np.zeros((mean.shape[0], len(forces), mean.shape[2]), np.complex128)
        z[:, np.arange(len(forces)), n_output + np.array(forces)] = level[:, None]
        gain = self.fit.equation.gain(self.now.values)
        moved = gain[..., n_output:] @ z[..., n_output:].swapaxes(1, 2)
        z[..., :n_output] = -np.linalg.solve(gain[..., :n_output], moved).swapaxes(1, 2)
        noise = np.mean(self.sums.covariance() * counts[:, None, None], axis=1, keepdims=True)
        _, _, multiplier, slopes, weighted = self.fit.parts(z, noise, self.now.values)
        added, _ = running_fit.normal_equations(slopes, weighted, multiplier)
        unit, scale = running_fit.rescale(self.now.information * counts.size / self.now.n + added)
        return np.diag(np.linalg.pinv(unit, hermitian=True)) / scale**2


def obstacle(settings: FitSettings, frf: FrfSettings, channels: Sequence[Channel], rate: float) -> str:
    """Why a fit cannot be followed average by average, '' where it can: that takes a model linear in its
    parameters, maximum likelihood, and plain periods or hits of these *channels* at *rate* [Hz].
    """
    excitation, model = frf.excitation, settings.model
    of_all = any((settings.eliminate, settings.bootstrap, settings.monte_carlo, settings.compare))
    several = settings.sliding is not None or settings.peaks or len(settings.bands) > 1
    reasons = (
        (excitation not in cutters.CUTTERS, f"{excitation} data are known by all samples together"),
        (not frf.single_averages, "its FRF follows from all averages together"),
        (settings.kind.of == SPECTRA, f"{model} balances all channels by mass and support, not an FRF"),
        (settings.kind.equations is None, f"the model {model} is not linear in its parameters"),
        (not settings.estimates.likelihood, "`estimator: ml` alone is followed"),
        (of_all, "what `eliminate`, `bootstrap`, `monte_carlo` and `compare` do takes all averages"),
        (several, "it has several bands"),
    )
    plain = next((text for stands, text in reasons if stands), "")
    if plain:
        return plain
    setup, _, _ = _setup(settings, layout_of(channels, rate))
    if settings.mass == ESTIMATE and settings.kind.one_frf and transfer_of(setup):
        return "a transfer FRF of unknown mass tells its coefficients by all lines alone"
    if not isinstance(damp(settings.kind.model(setup), settings), DynamicModel):
        return f"`damping: {settings.damping}` is not linear in its parameters"
    return ""


def layout_of(channels: Sequence[Channel], rate: float) -> Layout:
    """The responses and forces of *channels* that are sampled at *rate* [Hz]."""
    return find_layout([Recording(tuple(channels), np.zeros((2, len(channels))), rate)])


def _setup(settings: FitSettings, layout: Layout) -> tuple[Setup, list[int], list[int]]:
    rows = chosen_ports(layout.outputs, settings.output, "response")
    columns = chosen_ports(layout.inputs, settings.input, "force")
    outputs = tuple(layout.outputs[row] for row in rows)
    return Setup(outputs, tuple(layout.inputs[column] for column in columns), settings), rows, columns


def names_of_fit(settings: FitSettings, layout: Layout) -> tuple[str, ...]:
    """The coefficients that a fit will have, those derived of one mode among them."""
    names = settings.kind.model(_setup(settings, layout)[0]).names
    return (*names, "f_n", "zeta") if settings.kind.one_mode else names


# A coefficient that would take so many times the averages of the slowest reachable goal is not told by this
# direction.
OUT_OF_REACH = 20
# Averages of a direction after which its first two, with none before them, are compared with the others.
FIRST_AGAIN = 5


@dataclass(eq=False, repr=False)
class Bench(charts.GoalWatch):
    """All fits of a pipeline, followed over the samples of one stream."""

    def __post_init__(self) -> None:
        self.cutter: cutters.Cutter = cutters.CUTTERS[self.frf.excitation](
            self.channels, self.sample_rate, self.frf
        )
        self.layout = layout_of(self.cutter.channels, self.sample_rate)
        self.fits: list[FollowedFit] = []
        self.dropped = 0
        self._waiting: list[cutters.Average] = []
        self._energies: list[float] = []
        self._last_start = 0
        self._starts: list[int] = []
        self._unjudged: list[int] = []
        self._again = False
        self.findings: dict[tuple[str, str], Finding] = {}
        self.check_goals({fit.name: names_of_fit(fit, self.layout) for fit in self.settings})

    @property
    def hits(self) -> bool:
        return self.frf.excitation == "impact"

    def restart(self) -> None:
        self.cutter.restart()

    def add(self, block: FloatArray) -> list[charts.Update]:
        """What the next samples (n, n_channel) [SI] change, average by average."""
        made = []
        for average in self.cutter.add(block):
            self._last_start = average.start
            levels = {c.name: float(size) for c, size in zip(self.channels, average.peaks, strict=True)}
            update = replace(self._take(average), levels=levels)
            self.keep(update)
            made.append(update)
        return made

    def _take(self, average: cutters.Average) -> charts.Update:
        event = f"{self.what} {average.number} at {average.start / self.sample_rate:.3f} s"
        fault = average.fault
        if not fault and not self.fits:
            self._waiting.append(average)
            # Noise is told by two averages of one direction.
            alike = [earlier for earlier in self._waiting if earlier.direction == average.direction]
            self.averages = len(self._waiting)
            if len(alike) < 2:
                return self._update(())
            self._begin(alike)
            self.averages = 0
            for earlier in self._waiting[:-1]:
                self._follow(earlier)
        fault = fault or self._follow(average)
        if fault:
            self.dropped += 1
            event += f" is left out: {fault}"
        return self._update((event,))

    def _level(self, average: cutters.Average) -> float:
        """The size of all forces of an average [N]."""
        force = average.amplitude[:, list(self.layout.input_columns[0])]
        return float(np.sqrt(np.mean(np.abs(force) ** 2)))

    def _begin(self, alike: Sequence[cutters.Average]) -> None:
        frequency, amplitudes = self.cutter.frequency, np.array([average.amplitude for average in alike])
        acting = np.ones((frequency.size, 1), bool)
        if not self.hits:
            mean, forces = amplitudes.mean(axis=0), np.array(self.layout.input_columns[0])
            level = np.sqrt(np.mean(np.abs(mean[:, forces]) ** 2, axis=0))
            spread = amplitudes[0] - mean
            noise = spread[:, :, None] * spread[:, None, :].conj()
            raw = LineSpectrum(frequency, mean, noise, 2, np.ones(frequency.size))
            spectrum = smoothed_noise(raw, self.frf.smooth)
            strong = forces[level >= cutters.ACTS * level.max()]
            acting = np.stack([excited_lines(spectrum, [column]) for column in strong], axis=1)
        acting &= lines_in(frequency, self.frf.band, self.frf.exclude)[:, None]
        chosen = np.all(acting, axis=1)
        if not chosen.any():
            raise no_line(acting)
        self.lines = np.flatnonzero(chosen)
        block = self.hits * self.cutter.n_sample / self.sample_rate * (1 - self.frf.impact.pretrigger)
        self.fits = [FollowedFit(fit, self.layout, self.cutter, self.lines, block) for fit in self.settings]
        for fit in self.fits:
            fit.check([replace(average, amplitude=average.amplitude[self.lines]) for average in alike])

    def _follow(self, average: cutters.Average) -> str:
        average = replace(average, amplitude=average.amplitude[self.lines])
        direction, level = average.direction, self._level(average)
        parts = [fit.pick(average) for fit in self.fits]
        for fit, z in zip(self.fits, parts, strict=True):
            if fit.estimate is None:
                continue
            verdict = fit.charts.judge(z, fit.sums.of(direction), fit.estimate, level)
            if verdict.jump:
                return "it does not agree with the averages before it"
            if verdict.change is not None:
                begun = self._starts[min(verdict.change, len(self._starts)) - 1] / self.sample_rate
                when = f"average {verdict.change} ({begun:.1f} s)"
                message = f"{fit.settings.name}: the rig changes since about {when}"
                self._note(Finding("changes", message))
            if verdict.with_level:
                message = f"{fit.settings.name}: the coefficients follow the level of the hits"
                self._note(Finding("level-dependent", message))
        self._energies.append(level**2)
        self.averages += 1
        if self.fits[0].sums.of(direction).n < 2:
            self._unjudged.append(average.number)
        for fit, z in zip(self.fits, parts, strict=True):
            fit.add(z, direction, average.noise)
        self._again = self.fits[0].sums.of(direction).n == FIRST_AGAIN
        self._starts.append(average.start)
        return ""

    def _note(self, finding: Finding) -> None:
        self.findings.setdefault((finding.code, finding.message.split(":")[0]), finding)

    @property
    def seconds(self) -> float:
        """Time that one average takes, by those so far [s]."""
        if not self.hits:
            return self.cutter.n_sample / self.sample_rate
        return self._last_start / self.sample_rate / max(self.averages + self.dropped - 1, 1)

    def _update(self, events: tuple[str, ...]) -> charts.Update:
        variation = charts.hit_variation(self._energies) if self.hits else 0.0
        standings = self._standings(variation)
        if self.dropped > charts.MOST_DROPPED * max(self.averages + self.dropped, 5):
            share = 100 * self.dropped / (self.averages + self.dropped)
            message = f"{share:.0f} % of the averages are left out: a loose connection, or bad hits"
            self._note(Finding("bad-averages", message))
        enough = self._enough(standings)
        if enough or self._again:
            self._again = False
            events = (*events, *self._first_again())
            # The last word is that of the fit of all averages.
            for fit in self.fits if enough else ():
                fit.look()
            standings = self._standings(variation, again=True)
        return charts.Update(
            self.averages,
            standings=standings,
            findings=(*self.findings.values(), *self._fit_findings(standings)),
            stop=self._enough(standings),
            seconds=self.seconds,
            events=events,
        )

    def _first_again(self) -> list[str]:
        """The first two averages of a direction, which had none before them, compared with the others."""
        events = []
        for place, number in reversed(list(enumerate(self._unjudged))):
            if self.fits[0].sums.of(self.fits[0].first[place][1]).n < running_fit.LEAST_AVERAGES:
                continue
            # Every fit takes it out.
            disagree = [fit.first_disagrees(place) for fit in self.fits]
            if not any(disagree):
                for fit in self.fits:
                    fit.move(place, 1)
                continue
            events.append(f"{self.what} {number} is left out: it does not agree with the averages after it")
            self.averages, self.dropped = self.averages - 1, self.dropped + 1
            del self._unjudged[place]
            for fit in self.fits:
                del fit.first[place]
        return events

    def _standings(self, variation: float, again: bool = False) -> dict[str, charts.Standing]:
        standings: dict[str, charts.Standing] = {}
        for fit in self.fits:
            if fit.estimate is None:
                continue
            for parameter in fit.parameters():
                widths = fit.widths.setdefault(parameter.name, [])
                if again:
                    widths.pop()
                standing = self._standing(fit, parameter, variation)
                widths.append(standing.half)
                standings[f"{fit.settings.name}.{parameter.name}"] = standing
        return standings

    def _standing(self, fit: FollowedFit, parameter: Parameter, variation: float) -> charts.Standing:
        floor = fit.common[parameter.name].half if parameter.name in fit.common else 0.0
        wanted = self.goal_of(fit.settings.name, parameter, floor)
        if wanted is None:
            return charts.Standing(parameter)
        remaining = None
        if floor >= wanted:
            remaining = charts.Forecast(None)
        elif parameter.name in fit.model.names and fit.now.identifiable:
            number = fit.model.names.index(parameter.name)
            of_noise = math.sqrt(wanted**2 - floor**2) / fit.by_chi_square
            remaining = charts.forecast(fit.now, number, of_noise, variation)
            remaining = replace(remaining, others=fit.forecast_other_forces(number, of_noise))
        return charts.Standing(parameter, wanted, remaining, floor)

    def _fit_findings(self, standings: Mapping[str, charts.Standing]) -> list[Finding]:
        findings = []
        for fit in self.fits:
            estimate, name = fit.estimate, fit.settings.name
            if estimate is None:
                continue
            if not estimate.identifiable:
                turn = "turn the shaker, or excite a second direction"
                message = f"{name}: this excitation does not tell the coefficients apart; {turn}"
                findings.append(Finding("collinear", message))
            findings += fit.sums.findings(name)
            if estimate.misfit and estimate.n >= 3:
                message = (
                    f"{name}: chi-square per degree of freedom is {estimate.reduced:.3g}: the model does not "
                )
                message += "explain the averages within their noise; intervals count that"
                findings.append(Finding("model-mismatch", message))
            for label, standing in standings.items():
                owner, _, parameter = label.partition(".")
                if owner != name or standing.goal is None or standing.reached:
                    continue
                if standing.held_up:
                    findings.append(standing.no_help(label))
                elif not fit.common and estimate.misfit and charts.no_longer_falls(fit.widths[parameter]):
                    findings.append(standing.no_help(label, "model error"))
        return [*findings, *self._find_undetermined(standings)]

    def _find_undetermined(self, standings: Mapping[str, charts.Standing]) -> list[Finding]:
        missing = {
            label: (left, math.inf if left.expected is None else left.expected)
            for label, standing in standings.items()
            if (left := standing.remaining) is not None and not standing.held_up and not standing.reached
        }
        nearest = min((n for _, n in missing.values()), default=math.inf)
        findings = []
        for label, (left, n) in missing.items():
            if self.averages >= 5 and (n == math.inf or n > OUT_OF_REACH * max(nearest, 3)):
                turn = "turn the shaker, or raise the level"
                if left.others is not None:
                    text = left.others.text(self.what)
                    saves = 2 * left.others.more < n
                    turn = f"turn the shaker: {text}" if saves else f"raise the level ({text})"
                message = f"{label} is not identifiable with this direction and level; {turn}"
                findings.append(Finding("not-told", message))
        return findings

    def _enough(self, standings: Mapping[str, charts.Standing]) -> bool:
        wanted = [standing for standing in standings.values() if standing.goal is not None]
        judged = all(fit.estimate is not None and fit.estimate.judged for fit in self.fits)
        if not wanted or not judged or any(not standing.reached for standing in wanted):
            return False
        return not any(code in ("changes", "bad-averages") for code, _ in self.findings)

    def manual_intervals(self) -> dict[str, tuple[float, float]]:
        """Intervals that hold whenever one stops: t mixture sequence (Wang and Ramdas 2023) tuned to now."""
        intervals: dict[str, tuple[float, float]] = {}
        for fit in self.fits:
            if (estimate := fit.estimate) is None:
                continue
            for name, value, error, dof in zip(
                fit.model.names, estimate.values, estimate.std_error, estimate.dof, strict=True
            ):
                common = fit.common.get(name)
                half = fit.by_chi_square * error * charts.sequence_factor(estimate.n, estimate.n, float(dof))
                if common is not None:
                    value, half = common.whole(value, half)
                intervals[f"{fit.settings.name}.{name}"] = (float(value - half), float(value + half))
        return intervals
