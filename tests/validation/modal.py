"""Modes of a measured beam: what its package prints, what a public LSCF makes of the same FRF."""

from __future__ import annotations

import contextlib
import io
from functools import cache, partial

import numpy as np
import sdypy.EMA as peer

import labpipe
from labpipe.identify.fitting import identify
from labpipe.identify.settings import FitSettings
from labpipe.records.identification import Fit
from labpipe.records.recording import Recording
from labpipe.spectra.free_decays import free_decays
from labpipe.spectra.settings import FrfSettings
from tests.validation.claims import Claim, Method, among, within
from tests.validation.gaps import gaps
from tests.validation.shipped import LINE, PACKAGE, PRINTED_MODE, analysed, last_hit, variables

MEASURED, SOURCE = "measured public data", f"{PACKAGE}, case1"


@cache
def lscf() -> tuple[np.ndarray, np.ndarray]:
    """Frequency [Hz] and damping ratio of the pole nearest the mode, orders 5 to 20 over 204-220 Hz, by sdypy-EMA."""
    of = variables("case1.mat")
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        frequency = of["Freq_domain"].ravel().astype(float)
        model = peer.Model(of["Hf_chan_2"].T, frequency, lower=204, upper=220, pol_order_high=20, frf_form="receptance")
        model.get_poles(method="lscf", show_progress=False)
    found = []
    for poles, ratios in zip(model.pole_freq[5:], model.pole_xi[5:], strict=True):
        nearest = int(np.argmin(np.abs(np.asarray(poles) - PRINTED_MODE)))
        found.append((np.asarray(poles)[nearest], np.asarray(ratios)[nearest]))
    frequency_of, ratio = np.array(found).T
    return frequency_of, ratio


@cache
def modal(low: float, high: float) -> Fit:
    (fit,) = labpipe.fit(analysed(), labpipe.FitSettings("modal", band=(low, high), name="mode"))
    return fit


def frequencies(fit: Fit) -> list[float]:
    return [parameter.value for parameter in fit.parameters if parameter.name.startswith("f_n")]


def beam() -> list[Claim]:
    """The averaged FRF of case1: accepted is the range of what package and LSCF say (5th to 95th percentile over its orders)."""
    frequency, ratio = lscf()
    others, ratios = np.percentile(frequency, [5, 95]).tolist(), np.percentile(ratio, [5, 95]).tolist()
    (sdof,) = labpipe.fit(analysed(), labpipe.FitSettings("sdof", estimator="ls", band=(204.0, 220.0), name="mode"))
    alone = modal(204.0, 220.0)
    mode, damping = alone.parameter("f_n_1"), alone.parameter("zeta_1")
    assert mode.ci95 is not None
    half = (mode.ci95[1] - mode.ci95[0]) / 2
    leakage = "the interval holds the record's noise, not the analyser's window: the warning *leakage* stands beside it"
    wide = "0.02 Hz or 8 % of a line away; *model-mismatch* says that one dof does not explain the peak, and gives no interval"
    return [
        among("f_n of a beam, sdof", sdof.parameter("f_n").value, PRINTED_MODE, others, "Hz", MEASURED, SOURCE, wide),
        among("f_n of a beam, modal", mode.value, PRINTED_MODE, others, "Hz", MEASURED, SOURCE),
        among(
            "zeta of a beam, modal",
            1e3 * damping.value,
            1e3 * float(np.median(ratio)),
            [1e3 * x for x in ratios],
            "10^-3",
            MEASURED,
            SOURCE,
        ),
        within(
            "its distance in half widths of its 95 % interval", (mode.value - PRINTED_MODE) / half, 0.0, 1.0, "1", MEASURED, SOURCE, leakage
        ),
        within("f_n, modal against LSCF", mode.value, float(np.median(frequency)), LINE / 10, "Hz", "peer program", "sdypy-EMA"),
    ]


def number_of_modes() -> list[Claim]:
    """One mode stands between 190 and 235 Hz."""
    found = []
    for low, high in ((190.0, 235.0), (200.0, 224.0), (204.0, 220.0)):
        second = [f"{value:.2f} Hz" for value in frequencies(modal(low, high)) if abs(value - PRINTED_MODE) > 0.1]
        why = f"a second mode at {', '.join(second)} that is none, with an interval; *leakage* warns of it" if second else ""
        name = f"number of modes, {low:.0f} to {high:.0f} Hz"
        found.append(within(name, len(frequencies(modal(low, high))), 1.0, 0.5, "1", MEASURED, SOURCE, why))
    return found


def decayed(band: tuple[float, float]) -> Fit:
    hit = last_hit()
    alone = Recording((hit.channels[1],), hit.samples[:, 1:], hit.sample_rate, "case1")
    (fit,) = identify(free_decays([alone], FrfSettings("decay")), FitSettings("decay", band=band))
    return fit


def free_decay() -> list[Claim]:
    """One hit's decay against the averaged FRF: 50 ppm and 10 %. The second harmonic of the mains of 60 Hz is no mode."""
    ring, hum = decayed((204.0, 220.0)), decayed((100.0, 130.0))
    interval = hum.parameter("zeta_1").ci95
    assert interval is not None
    inside, averaged = float(interval[0] < 0 < interval[1]), 1e3 * float(np.median(lscf()[1]))
    return [
        within("f_n from one decay", ring.parameter("f_n_1").value, PRINTED_MODE, 5e-5, "Hz", MEASURED, SOURCE, relative=True),
        within("zeta from one decay", 1e3 * ring.parameter("zeta_1").value, averaged, 0.1, "10^-3", MEASURED, SOURCE, relative=True),
        within("frequency of the hum", hum.parameter("f_n_1").value, 120.0, 0.03, "Hz", MEASURED, SOURCE),
        within("its interval of damping holds zero (1: yes)", inside, 1.0, 0.5, "1", MEASURED, SOURCE),
    ]


METHOD = Method(
    "modal",
    "Modes and decays",
    {"beam": beam, "number of modes": number_of_modes, "free decay": free_decay, "not tested": partial(gaps, "modal")},
)
