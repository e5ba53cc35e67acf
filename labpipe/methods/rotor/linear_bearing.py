"""A bearing of constant coefficients, as a test or a supplier states them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.arrays import FloatArray
from labpipe.bearings.kinds import BearingCoefficients, BearingKind
from labpipe.errors import SettingError
from labpipe.records.settings import Settings, setting, text


@dataclass(frozen=True, kw_only=True)
class LinearBearingSettings(Settings):
    """kind: linear-bearing; y horizontal, z up, `k_yz` = force in y per displacement in z."""

    kind: str = setting("choice", "which bearing", choices=("linear-bearing",))
    name: str = text("name of the bearing")
    k_yy: float = setting("value", "stiffness in y", unit="N/m")
    k_zz: float | None = setting("value", "stiffness in z; default: k_yy", unit="N/m", default=None)
    k_yz: float = setting("value", "cross-coupled stiffness", unit="N/m", default=0.0)
    k_zy: float = setting("value", "cross-coupled stiffness", unit="N/m", default=0.0)
    k_cross: float | None = setting(
        "value",
        "cross-coupled stiffness of a seal, k_yz = -k_zy; above zero it drives forward whirl",
        unit="N/m",
        default=None,
    )
    c: float | None = setting("value", "damping in y and z alike", unit="N.s/m", default=None)
    c_yy: float = setting("value", "damping in y", unit="N.s/m", default=0.0)
    c_zz: float = setting("value", "damping in z", unit="N.s/m", default=0.0)
    c_yz: float = setting("value", "cross-coupled damping", unit="N.s/m", default=0.0)
    c_zy: float = setting("value", "cross-coupled damping", unit="N.s/m", default=0.0)

    def __post_init__(self) -> None:
        if self.c is not None and (self.c_yy or self.c_zz):
            raise SettingError("c", "'c' is damping in both directions", "c, or c_yy and c_zz")
        if self.k_cross is not None and (self.k_yz or self.k_zy):
            raise SettingError("k_cross", "'k_cross' is k_yz and -k_zy", "k_cross, or k_yz and k_zy")

    @property
    def stiffness(self) -> FloatArray:
        """(2, 2) [N/m]."""
        k_yz, k_zy = (self.k_yz, self.k_zy) if self.k_cross is None else (self.k_cross, -self.k_cross)
        return np.array([[self.k_yy, k_yz], [k_zy, self.k_yy if self.k_zz is None else self.k_zz]])

    @property
    def damping(self) -> FloatArray:
        """(2, 2) [N s/m]."""
        diagonal = (self.c_yy, self.c_zz) if self.c is None else (self.c, self.c)
        return np.array([[diagonal[0], self.c_yz], [self.c_zy, diagonal[1]]])


LINEAR = BearingKind(
    LinearBearingSettings,
    lambda each: [BearingCoefficients(("y", "z"), stated.stiffness, stated.damping) for stated in each],
)
