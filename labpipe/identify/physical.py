"""unphysical: a resonance that the structure cannot have, or that the band does not hold, however well the curve follows."""

from __future__ import annotations

from collections.abc import Sequence

from labpipe.identify.settings import ESTIMATE
from labpipe.identify.setup import Setup
from labpipe.identify.transfer_mode import transfer_of
from labpipe.records.finding import Finding
from labpipe.records.identification import Parameter


def mode_findings(parameters: Sequence[Parameter], band: tuple[float, float], setup: Setup) -> list[Finding]:
    """Warnings on the one mode of sdof or base in its *band* [Hz]: negative mass at a driving point, negative damping, resonance beside it.

    They do not wait for significance, which is for coefficients that may be zero: a mode has a mass and damping. Without an estimated
    mass the band may well lie beside the resonance, and coefficients stand for themselves. What a closed loop holds need have no resonance.
    """
    if not setup.settings.kind.one_mode or setup.settings.mass != ESTIMATE:
        return []
    by_name = {parameter.name: parameter for parameter in parameters}
    beside = [] if setup.closed_loop else _beside(by_name, band)
    said = [*_negative(by_name, driving=not transfer_of(setup)), *beside]
    return [Finding("unphysical", f"{'; '.join(said)}; its numbers are not those of a mode of the structure")] if said else []


def _negative(by_name: dict[str, Parameter], *, driving: bool) -> list[str]:
    said = []
    mass, zeta = by_name.get("m"), by_name.get("zeta")
    if driving and mass is not None and mass.value < 0:
        said.append(
            f"m = {mass.value:.3g} kg is negative, which no driving point has: check the signs of the channels, whether force and response "
            "are at one point (`dof`), and the band"
        )
    if zeta is not None and zeta.value < 0:
        said.append(f"zeta = {zeta.value:.3g} is negative: the fitted mode would grow by itself")
    return said


def _beside(by_name: dict[str, Parameter], band: tuple[float, float]) -> list[str]:
    f_n = by_name.get("f_n")
    if f_n is None:
        k, m = by_name.get("k"), by_name.get("m")
        if k is not None and m is not None and k.value * m.value <= 0:
            return [f"k = {k.value:.3g} N/m and m = {m.value:.3g} kg have different signs: there is no resonance"]
        return []
    if band[0] <= f_n.value <= band[1]:
        return []
    return [f"f_n = {f_n.value:.4g} Hz lies outside the band {band[0]:g}-{band[1]:g} Hz: the lines show no resonance"]
