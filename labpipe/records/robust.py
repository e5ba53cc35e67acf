"""A plant for robust control design: nominal model as state space, and the band around it that holds the true plant."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.arrays import ComplexArray, FloatArray


@dataclass(frozen=True)
class RobustPlant:
    """Nominal plant dx/dt = A x + B u, y = C x + D u, and |G - G_nominal| <= radius at all lines together with *confidence*.

    frequency (n_line,) [Hz]; nominal, radius [unit] and weight [1], (n_line, n_output, n_input): the weight is the radius over the largest
    singular value of G_nominal, |G| of one axis. a (n, n), b (n, n_input), c (n_output, n), d (n_output, n_input) [SI]. overbound
    (n_output, n_input, 3): k [1], zero and pole [Hz] of the least k (1 + j f / zero) / (1 + j f / pole) nowhere below the weight.
    """

    frequency: FloatArray
    nominal: ComplexArray
    radius: FloatArray
    weight: FloatArray
    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: FloatArray
    overbound: FloatArray
    confidence: float
    unit: str
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
