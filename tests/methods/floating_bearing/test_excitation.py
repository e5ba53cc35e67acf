"""What other excitations would give, as forecast from one test and as those tests themselves say."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from labpipe.records.fit_details import DynamicStiffness
from labpipe.records.identification import Fit
from tests.methods.floating_bearing.floating_rig import FloatingRig
from tests.methods.floating_bearing.test_fit import EVEN, GIVEN, fitted


@dataclass(frozen=True)
class ShapedRig(FloatingRig):
    """Forces that go with a power of the frequency, of the same r.m.s..

    The noise stays that of the flat spectrum.
    """

    exponent: int = 0

    def forces(self) -> np.ndarray:
        shape = self.frequency**self.exponent
        return super().forces() * (shape / np.sqrt(np.mean(shape**2)))[:, None, None]

    def std(self) -> np.ndarray:
        return FloatingRig(
            **{name: getattr(self, name) for name in ("bearing", "baseline", "frequency", "noise")}
        ).std()


def shaped(exponent: int, excitation: str = "hadamard") -> FloatingRig:
    return ShapedRig(
        EVEN.bearing, baseline=EVEN.baseline, noise=1e-3, exponent=exponent, excitation=excitation
    )


def errors(fit: Fit) -> dict[str, float]:
    """Geometric means of the standard errors of K, C and M."""
    groups = {
        letter: [p.std_error for p in fit.parameters if p.name.startswith(f"{letter}_") and not p.derived]
        for letter in "kcm"
    }
    return {letter: float(np.exp(np.mean(np.log(group)))) for letter, group in groups.items()}


@pytest.mark.parametrize(("exponent", "name"), [(-1, "amplitude ~ 1/f"), (1, "amplitude ~ f")])
def test_a_shape_does_what_was_forecast(exponent: int, name: str) -> None:
    rng = np.random.default_rng(1)
    flat, other = (fitted(shaped(power).draw(rng), **GIVEN) for power in (0, exponent))
    (forecast,) = [e for e in flat.detail(DynamicStiffness).excitations if e.name == name]
    now, then = errors(flat), errors(other)
    assert forecast.matrices == ("k", "c", "m")
    assert forecast.ratios == pytest.approx([then[letter] / now[letter] for letter in "kcm"], rel=0.05)


def test_flat_forces_are_what_they_are() -> None:
    fit = fitted(shaped(0).draw(np.random.default_rng(1)), **GIVEN)
    assert [e.name for e in fit.detail(DynamicStiffness).excitations if "once" in e.name] == []
    assert fit.detail(DynamicStiffness).excitations[1].ratios == pytest.approx((1.0, 1.0, 1.0), rel=1e-3)


def test_one_force_at_a_time_hears_what_both_would_give() -> None:
    """Equal time and peak: two runs each; zipper: one run of twice the time, whose half of the lines may be
    sqrt 2 as large.
    """
    rng = np.random.default_rng(1)
    alternating = fitted(shaped(0, "alternating").draw(rng), **GIVEN)
    (forecast,) = [e for e in alternating.detail(DynamicStiffness).excitations if "once" in e.name]
    one, both = errors(alternating), errors(fitted(shaped(0).draw(rng), **GIVEN))
    assert forecast.ratios == pytest.approx([both[letter] / one[letter] for letter in "kcm"], rel=0.05)
    zipper = replace(shaped(0, "zipper"), force=500.0 * np.sqrt(2))
    spectra = zipper.draw(rng)
    spectra = replace(spectra, covariance=spectra.covariance / 2)
    longer = errors(fitted(spectra, **GIVEN))
    assert [longer[letter] / both[letter] for letter in "kcm"] == pytest.approx([1, 1, 1], rel=0.1)
    assert any("hold for motions of this size" in note for note in alternating.notes)
