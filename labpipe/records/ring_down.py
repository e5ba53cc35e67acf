"""What a fitted free decay shows beside its parameters: the course over time, and damping and frequency over amplitude."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

from labpipe.arrays import FloatArray


@dataclass(frozen=True)
class AmplitudeLaw:
    """A' = -w (zeta_rest + zeta_slope A) A, phase' = w + frequency_slope A; A amplitude [SI unit of the output], w [rad/s].

    p_value: chance of residuals so unlike noise if the law is right.
    """

    omega: float
    zeta_rest: float
    zeta_slope: float
    frequency_slope: float
    p_value: float


@dataclass(frozen=True)
class OverAmplitude:
    """One mode piece by piece: damping ratio (n,) [1] and frequency (n,) [Hz] over amplitude (n,) [SI unit of the output].

    Each with its standard error of the same shape and unit. law: where damping or frequency depend on the amplitude, else None.
    """

    amplitude: FloatArray
    damping: FloatArray
    damping_std_error: FloatArray
    frequency: FloatArray
    frequency_std_error: FloatArray
    _: KW_ONLY
    law: AmplitudeLaw | None = None


@dataclass(frozen=True)
class RingDown:
    """The largest decay of a fit over time (n,) [s]: measured, fitted and residual, each (n,) [SI unit of the output].

    Of long decays the least and the largest value of every short stretch stand one after the other. *modes*: in ascending frequency.
    """

    recording: str
    output: str
    unit: str
    time: FloatArray
    measured: FloatArray
    fitted: FloatArray
    residual: FloatArray
    modes: tuple[OverAmplitude, ...] = ()
