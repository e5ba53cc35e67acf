"""Modes of a measured beam: what its package prints, what a public LSCF makes of the same FRF."""

from __future__ import annotations

from functools import cache, partial

import labpipe
from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.records.recording import Recording
from labpipe.spectra.free_decays import free_decays
from labpipe.spectra.settings import FrfSettings
from tests.validation.claims import Claim, Method, among, within
from tests.validation.gaps import gaps
from tests.validation.peers import recorded, words
from tests.validation.shipped import LINE, PACKAGE, PRINTED_MODE, analysed, last_hit

MEASURED, SOURCE = "measured public data", f"{PACKAGE}, case1"
# 5th percentile, median and 95th of frequency [Hz] and damping ratio.
LSCF = recorded("lscf")


@cache
def modal(low: float, high: float) -> Fit:
    (fit,) = labpipe.fit(analysed(), labpipe.FitSettings("modal", band=(low, high), name="mode"))
    return fit


def frequencies(fit: Fit) -> list[float]:
    return [parameter.value for parameter in fit.parameters if parameter.name.startswith("f_n")]


def beam() -> list[Claim]:
    """The averaged FRF of case1: accepted is the range of what package and LSCF say (5th to 95th percentile
    over its orders).
    """
    others, ratios, note = LSCF["frequency"], [1e3 * ratio for ratio in LSCF["ratio"]], words("lscf")
    (sdof,) = labpipe.fit(
        analysed(), labpipe.FitSettings("sdof", estimator="ls", band=(204.0, 220.0), name="mode")
    )
    alone = modal(204.0, 220.0)
    mode, damping = alone.parameter("f_n_1"), alone.parameter("zeta_1")
    assert mode.ci95 is not None and damping.ci95 is not None
    half = (mode.ci95[1] - mode.ci95[0]) / 2
    leakage = (
        "the interval holds the record's noise, not the analyser's window: the warning *leakage* "
        "stands beside it"
    )
    wide = (
        "0.02 Hz or 8 % of a line away; *model-mismatch* says that one dof does not explain the peak, "
        "and gives no interval"
    )
    return [
        among(
            "f_n of a beam, sdof",
            sdof.parameter("f_n").value,
            PRINTED_MODE,
            others,
            "Hz",
            MEASURED,
            SOURCE,
            wide,
            note,
        ),
        among(
            "f_n of a beam, modal", mode.value, PRINTED_MODE, others, "Hz", MEASURED, SOURCE, recorded=note
        ),
        among(
            "zeta of a beam, modal",
            1e3 * damping.value,
            ratios[1],
            ratios,
            "10^-3",
            MEASURED,
            SOURCE,
            "*model-mismatch*: a value between one mode and two, whose interval, which a window of the "
            f"analyser widens to zero, goes to {1e3 * damping.ci95[1]:.2f}",
            note,
        ),
        within(
            "its distance in half widths of its interval",
            (mode.value - PRINTED_MODE) / half,
            0.0,
            1.0,
            "1",
            MEASURED,
            SOURCE,
            leakage,
        ),
        within(
            "f_n, modal against LSCF",
            mode.value,
            others[1],
            LINE / 10,
            "Hz",
            "peer program",
            "sdypy-EMA",
            recorded=note,
        ),
    ]


def number_of_modes() -> list[Claim]:
    """One mode stands between 190 and 235 Hz."""
    found = []
    for low, high in ((190.0, 235.0), (200.0, 224.0), (204.0, 220.0)):
        name = f"number of modes, {low:.0f} to {high:.0f} Hz"
        found.append(within(name, len(frequencies(modal(low, high))), 1.0, 0.5, "1", MEASURED, SOURCE))
    return found


def decayed(band: tuple[float, float]) -> Fit:
    hit = last_hit()
    alone = Recording((hit.channels[1],), hit.samples[:, 1:], hit.sample_rate, "case1")
    (fit,) = identify(free_decays([alone], FrfSettings("decay")), FitSettings("decay", band=band))
    return fit


def free_decay() -> list[Claim]:
    """One hit's decay against the averaged FRF: 50 ppm and 10 %.

    The second harmonic of the mains of 60 Hz is not a mode.
    """
    ring, hum = decayed((204.0, 220.0)), decayed((100.0, 130.0))
    interval = hum.parameter("zeta_1").ci95
    assert interval is not None
    inside, averaged = float(interval[0] < 0 < interval[1]), 1e3 * LSCF["ratio"][1]
    return [
        within(
            "f_n from one decay",
            ring.parameter("f_n_1").value,
            PRINTED_MODE,
            5e-5,
            "Hz",
            MEASURED,
            SOURCE,
            relative=True,
        ),
        within(
            "zeta from one decay",
            1e3 * ring.parameter("zeta_1").value,
            averaged,
            0.1,
            "10^-3",
            MEASURED,
            SOURCE,
            relative=True,
        ),
        within("frequency of the hum", hum.parameter("f_n_1").value, 120.0, 0.03, "Hz", MEASURED, SOURCE),
        within("its interval of damping holds zero (1: yes)", inside, 1.0, 0.5, "1", MEASURED, SOURCE),
    ]


METHOD = Method(
    "modal",
    "Modes and decays",
    {
        "beam": beam,
        "number of modes": number_of_modes,
        "free decay": free_decay,
        "not tested": partial(gaps, "modal"),
    },
    long=("number of modes",),
)
