"""What no residual can show, and no number states: gains, attached masses, level of force, law of damping.

It counts as zero in the intervals, and is listed by name: type B of the GUM, known from elsewhere alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from labpipe.errors import ConfigError
from labpipe.estimation.measured import select_ports
from labpipe.estimation.settings import VISCOUS, FitSettings
from labpipe.records.identification import Fit, Unstated
from labpipe.records.response import FrequencyResponse, Port
from labpipe.records.settings import ESTIMATE
from labpipe.spectra.convert import TRANSMISSIBILITY

GAIN = "gain"


def with_unstated(fit: Fit, response: FrequencyResponse, settings: FitSettings) -> Fit:
    """The fit of a *response* with what its numbers take for granted."""
    try:
        rows, columns = select_ports(response, settings.input, settings.output)
    except ConfigError:
        # Peaks choose their ports one by one.
        rows, columns = list(range(len(response.outputs))), list(range(len(response.inputs)))
    ports = [*(response.inputs[n] for n in columns), *(response.outputs[n] for n in rows)]
    of_base = response.form == TRANSMISSIBILITY
    entries = [
        *_gains(ports, settings, of_base=of_base),
        *([] if of_base else _attached(settings)),
        Unstated("level of the force", "what changes with the amplitude: repeat the test at half the force"),
        *_law(fit, settings),
    ]
    return replace(fit, not_stated=tuple(entries))


def _gains(ports: Sequence[Port], settings: FitSettings, *, of_base: bool) -> Iterator[Unstated]:
    silent = [port.label for port in ports if not _has_gain(port)]
    if not silent:
        return
    what = "gain of " + ", ".join(dict.fromkeys(silent))
    if of_base:
        yield Unstated(what, "k and c by about as much")
    elif settings.mass == ESTIMATE:
        yield Unstated(what, "k, c and m each by as much; f_n and zeta not at all")
    else:
        yield Unstated(what, "the resonance against the given mass: c by as much, k less near resonance")


def _has_gain(port: Port) -> bool:
    return any(calibration.effect == GAIN for calibration in port.uncertainties)


def _attached(settings: FitSettings) -> Iterator[Unstated]:
    if settings.mass == ESTIMATE:
        yield Unstated(
            "mass m_t of what is attached to the structure",
            "m by m_t; f_n and zeta of the structure alone by m_t / 2 m of themselves",
        )


def _law(fit: Fit, settings: FitSettings) -> Iterator[Unstated]:
    """k - m w^2 is what a resonance shows: the split follows the law of damping."""
    values = {parameter.name: parameter.value for parameter in fit.parameters}
    zeta = values.get("zeta")
    if settings.damping == VISCOUS and settings.mass == ESTIMATE and zeta and {"k", "m"} <= set(values):
        yield Unstated("law of damping", f"k and m together by about zeta, {100 * abs(zeta):.2g} %")
