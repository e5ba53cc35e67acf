"""Worlds of run-ups: a bearing of the family that the joint fit knows, run up anew by probes and a keyphasor
that are off.

The joint fit weighs what is expected of a bearing beforehand (`PRIOR`) with the run-ups. Its uncertainties
are those of bearings that scatter so; therefore every world has a bearing of its own. What is tallied is
result less truth of the world, about the value of the rotor file.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from labpipe.errors import FitError
from labpipe.methods.rotor.response import GROWTH_TOLERANCE
from labpipe.methods.run_ups.joint import family_about, fit_jointly
from labpipe.methods.run_ups.records import DIRECTIONS, TRAINED, RunUp
from labpipe.methods.run_ups.rotor import PARAMETERS, PRIOR, FilmFamily, RunUpRotor, with_search_range
from labpipe.methods.run_ups.section import read_run
from labpipe.methods.run_ups.settings import ProbeUncertainties
from labpipe.project.pipeline_file import Pipeline
from labpipe.records.finding import Parameter
from labpipe.records.uncertain import Uncertain, Uncertainty
from tests.draws.usual import Errors

USUAL = ProbeUncertainties(
    Uncertain(1.0, 0.01),
    Uncertain(0.0, np.radians(0.5)),
    Uncertain(0.0, 5e-6),
    Uncertain(0.0, np.radians(1.0)),
)
TWO_SIDED = 1.959964


@dataclass(frozen=True)
class RunUpWorlds:
    """The *runs* of a section, those the fit sees first; *loads* at which it predicts, as they are called."""

    rig: RunUpRotor
    family: FilmFamily
    runs: tuple[RunUp, ...]
    loads: tuple[tuple[str, float], ...]
    known: tuple[str, ...]

    def truth(self) -> dict[str, float]:
        """The bearing of the rotor file, about which those of the worlds scatter."""
        return dict.fromkeys(PARAMETERS, 0.0) | self._speeds(np.zeros(len(PARAMETERS)))

    def amounts(self, errors: Errors, rng: np.random.Generator | None) -> dict[str, Parameter]:
        """Parameters (logarithms) [1], critical and threshold speeds [rad/s] of the joint fit, less what is
        true in this world.
        """
        true = PRIOR * np.array(
            [errors.of(Uncertainty(f"bearing's {name}", 1.0, "1")) for name in PARAMETERS]
        )
        true[[name in self.known for name in PARAMETERS]] = 0.0
        fit = fit_jointly(
            self.rig, [self._recorded(run, true, errors, rng) for run in self.runs], known=self.known
        )
        if fit.rejected:
            raise FitError("the bearing is rejected, and no interval is given")
        found = {
            name: Uncertain(float(value - beside), float(error))
            for name, value, beside, error in zip(PARAMETERS, fit.values, true, fit.std_error, strict=True)
            if error > 0
        }
        middle, speeds = self._speeds(np.zeros(len(PARAMETERS))), self._speeds(true)
        for name, load in self.loads:
            for kind, at in (("critical_speed", fit.critical_speed), ("threshold", fit.threshold)):
                key = f"{kind}[{name}]"
                # A bearing may have no peak within the speeds, or no threshold: then there is nothing to hold
                # a prediction against.
                with suppress(FitError):
                    predicted = at(load)
                    if predicted is not None and key in speeds and key in middle:
                        found[key] = replace(predicted, value=predicted.value - speeds[key] + middle[key])
        return {name: _parameter(name, number) for name, number in found.items()}

    def _speeds(self, values: np.ndarray) -> dict[str, float]:
        found = {}
        for name, load in self.loads:
            coefficients = self.family.at_load(values, load)
            threshold = self.rig.threshold(coefficients)
            with suppress(FitError):
                found |= {f"critical_speed[{name}]": self.rig.critical_speed(coefficients)}
            found |= {} if threshold is None else {f"threshold[{name}]": threshold}
        return found

    def _recorded(
        self, run: RunUp, values: np.ndarray, errors: Errors, rng: np.random.Generator | None
    ) -> RunUp:
        """The run with the true bearing at the speeds where it is stable, read by probes that are off, with
        noise of the stated size.
        """
        coefficients = self.family.at_load(values, run.load)
        steady = self.rig.stability.growth(run.speed, *coefficients(run.speed)) <= GROWTH_TOLERANCE
        if not np.any(steady):
            raise FitError("the rotor is unstable at every speed")
        # Errors of a table are relative to what was read.
        sizes, phases = (run.amplitude_error / np.abs(run.response))[steady], run.phase_error[steady]
        speed = run.speed[steady]
        blank = {
            "speed": speed,
            "response": np.ones(sizes.shape) + 0j,
            "amplitude_error": sizes,
            "phase_error": phases,
        }
        exact = self.rig.excite(replace(run, **blank)).response(*coefficients(speed)).reshape(sizes.shape)
        read = exact * _factors(run.planes, speed, errors)
        noise = np.zeros((2, *sizes.shape)) if rng is None else rng.standard_normal((2, *sizes.shape))
        read = read * (1 + sizes * noise[0]) * np.exp(1j * phases * noise[1])
        threshold = self.rig.threshold(coefficients)
        if threshold is not None and run.threshold is not None:
            relative = run.threshold.std_error / run.threshold.value
            threshold = Uncertain(
                threshold * (1 + relative * (0.0 if rng is None else rng.standard_normal())),
                threshold * relative,
            )
        return replace(
            run, **blank | {"response": read, "amplitude_error": sizes * np.abs(read)}, threshold=threshold
        )


def _factors(planes: Sequence[str], speed: np.ndarray, errors: Errors) -> np.ndarray:
    """What probes and keyphasor read over what they should, (n_speed, n_plane, 2) complex, not only to first
    order.
    """
    factor = np.ones((speed.size, len(planes), 2), complex)
    for at, plane in enumerate(planes):
        for axis, direction in enumerate(DIRECTIONS):
            gain, phase, delay = (
                errors.of(Uncertainty(f"{plane} {direction}.{effect}", number.std_error, ""))
                for effect, number in (("gain", USUAL.gain), ("phase", USUAL.phase), ("delay", USUAL.delay))
                if number is not None
            )
            factor[:, at, axis] = (1 - gain) * np.exp(1j * (phase + speed * delay))
    assert USUAL.keyphasor is not None
    turned: np.ndarray = factor * np.exp(
        1j * errors.of(Uncertainty("keyphasor", USUAL.keyphasor.std_error, "rad"))
    )
    return turned


def _parameter(name: str, number: Uncertain) -> Parameter:
    reach = TWO_SIDED * number.std_error
    return Parameter(
        name, number.value, "1", std_error=number.std_error, ci95=(number.value - reach, number.value + reach)
    )


def run_up_worlds(pipeline: Pipeline) -> RunUpWorlds | None:
    """The worlds of a pipeline's joint fit; None where it has none."""
    settings = pipeline.sections.get("run_ups")
    if settings is None or "joint" not in settings.methods:
        return None
    read = [read_run(one, settings.rig, None, pipeline.folder, USUAL) for one in settings.runs]
    trained = tuple(one.run for one in read if one.settings.role == TRAINED)
    rig = with_search_range(settings.rig, trained)
    family = family_about(rig, [run.load for run in trained])
    ends = {one.run.name: one.run.load for one in (read[0], read[len(trained) - 1], read[-1])}
    return RunUpWorlds(rig, family, trained, tuple(ends.items()), settings.known)
