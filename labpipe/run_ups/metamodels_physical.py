"""The physical fit as a metamodel: the film's family with the parameters of a joint fit, for any load and speed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.bearings.journal import JournalBearing
from labpipe.records.run_up import RunUp
from labpipe.rigs.film_family import FilmFamily
from labpipe.rigs.run_up_rotor import RunUpRotor
from labpipe.run_ups.joint import fit_jointly
from labpipe.run_ups.joint_result import JointFit
from labpipe.run_ups.metamodels_grid import SAME_LOAD, Extent


@dataclass(frozen=True)
class PhysicalFit:
    """Logarithms *values* (12,) and *covariance* (12, 12), widened, [-] of a *family*; *extent*: loads and speeds of the fit."""

    extent: Extent
    family: FilmFamily
    values: FloatArray
    covariance: FloatArray

    kind: ClassVar[str] = "physical"

    @property
    def speeds(self) -> tuple[float, float]:
        """Range of speeds [rad/s] that it holds for: all, as far as the film's table goes."""
        return (0.0, float("inf"))

    @classmethod
    def of(cls, fit: JointFit, speeds: tuple[float, float]) -> PhysicalFit:
        """Of a joint fit to run-ups between two *speeds* [rad/s]."""
        return cls(Extent((min(fit.loads), max(fit.loads)), speeds), fit.family, fit.values, fit.covariance * fit.widening**2)

    @property
    def statement(self) -> str:
        """Statement on the fit and its validation."""
        return "the film's own coefficients with the parameters of the joint fit, refitted without each load in turn for the validation"

    def predict(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """The eight coefficients (n_point, 8) [N/m, N s/m] at loads [N] and speeds [rad/s]; FitError outside the film's table."""
        return self.family.coefficients(self.values, load, speed)

    def std_error(self, load: FloatArray | float, speed: FloatArray) -> FloatArray:
        """Standard errors (n_point, 8) [N/m, N s/m] at loads [N] and speeds [rad/s]."""
        places = np.broadcast_arrays(np.asarray(load, np.float64), np.asarray(speed, np.float64))
        _, slopes = self.family.coefficients_and_slopes(self.values, *(np.ravel(place) for place in places))
        return np.asarray(np.sqrt(np.einsum("nij,jk,nik->ni", slopes, self.covariance, slopes)))

    def to_entries(self) -> dict[str, Any]:
        return {
            "kind": self.kind,
            **self.extent.to_entries(),
            "bearing": dataclasses.asdict(self.family.bearing),
            "reference": [self.family.load, self.family.speed],
            "values": self.values.tolist(),
            "covariance": self.covariance.tolist(),
        }

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any]) -> PhysicalFit:
        load, speed = entries["reference"]
        family = FilmFamily(JournalBearing(**entries["bearing"]), float(speed), float(load))
        values, covariance = (np.array(entries[name], np.float64) for name in ("values", "covariance"))
        return cls(Extent.from_entries(entries), family, values, covariance)


def physical_without(rig: RunUpRotor, runs: Iterable[RunUp]) -> Callable[[float], PhysicalFit]:
    """For a validation: the joint fit of all *runs* but those of one load [N], again for every load."""
    all_runs = list(runs)

    def refitted(load: float) -> PhysicalFit:
        training = [run for run in all_runs if abs(run.load / load - 1) > SAME_LOAD]
        speeds = (min(float(run.speed[0]) for run in training), max(float(run.speed[-1]) for run in training))
        return PhysicalFit.of(fit_jointly(rig, training), speeds)

    return refitted
