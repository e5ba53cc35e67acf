"""Magnetic bearings: margins and poles against closed forms and python-control, factors of an electromagnet,
a measured stiffness.
"""

from __future__ import annotations

import os
from functools import cache, partial
from pathlib import Path
from typing import Any

# python-control loads matplotlib.
os.environ.setdefault("MPLBACKEND", "Agg")

import control
import numpy as np

from labpipe.methods.magnetic_bearing.bearing import MU_0, Magnet, magnet_factors
from labpipe.methods.magnetic_bearing.loop import ControlLoop, dynamic_stiffness, margins
from labpipe.methods.magnetic_bearing.stability import (
    PADE_ORDER,
    Suspended,
    closed_loop_poles,
    open_loop,
    sensitivity_peak,
)
from labpipe.project.bearing_file import open_bearing
from tests.validation.claims import Claim, Method, within, worst
from tests.validation.gaps import gaps

CONFIGS = Path(__file__).parents[2] / "configs/bearings"
PEER = "python-control"
K_P, K_D, PULL = 9.0, 2.0, 4.0


def closed_forms() -> list[Claim]:
    """A double integrator and an unstable plant under PD, the third-order loop of textbooks, an ideal
    sensitivity at rest.
    """
    double = margins(lambda w: (K_P + 1j * K_D * w) / (1j * np.maximum(w, 1e-9)) ** 2, 1e4)
    crossing = np.sqrt((K_D**2 + np.sqrt(K_D**4 + 4 * K_P**2)) / 2)
    unstable = margins(lambda w: (K_P + 1j * K_D * w) / (-(w**2) - PULL), 1e4)
    third = margins(lambda w: 10 / ((1j * w + 1e-300) * (1j * w + 1) * (1j * w + 5)), 1e3)
    at_rest = sensitivity_peak(Suspended(ControlLoop(), 33106.0, 0.065))
    phase, kind = float(np.degrees(np.arctan(K_D * crossing / K_P))), "closed form"
    return [
        within(
            "phase margin, double integrator under PD",
            np.degrees(double.phase),
            phase,
            1e-5,
            "deg",
            kind,
            "atan(k_d w / k_p)",
        ),
        within(
            "lower gain margin, unstable plant under PD",
            unstable.gain_lower,
            PULL / K_P,
            1e-6,
            "1",
            kind,
            "a / k_p",
        ),
        within("gain margin of 10 / (s (s + 1) (s + 5))", third.gain_upper, 3.0, 1e-6, "1", kind, "Ogata"),
        within(
            "|S| at rest of a soft bearing",
            at_rest.value,
            33106 / 1694,
            1e-5,
            "1",
            kind,
            "ratio of stiffnesses",
        ),
    ]


def electromagnet() -> list[Claim]:
    """Straight poles, no permanent magnet: k_i = 4 mu_0 N^2 A i_0 / g^2, k_n = 4 mu_0 N^2 A i_0^2 / g^3 of
    two rings.
    """
    factors = magnet_factors(Magnet(turns=180, gap=0.45e-3, pole_area=60e-6, bias_current=0.2))
    pair, kind, source = 4 * MU_0 * 180**2 * 60e-6, "closed form", "Schweitzer, Maslen"
    k_i, k_n = pair * 0.2 / 0.45e-3**2, pair * 0.2**2 / 0.45e-3**3
    return [
        within(
            "force per current of an electromagnet",
            factors.force_per_current,
            k_i,
            1e-6,
            "N/A",
            kind,
            source,
            relative=True,
        ),
        within(
            "negative stiffness", factors.negative_stiffness, k_n, 1e-6, "N/m", kind, source, relative=True
        ),
    ]


@cache
def peer_loop(name: str) -> tuple[Any, Suspended]:
    """L(s) = K C(s) e^{-s tau} / (1 + s / w_a) / (m s^2 - k_n) as python-control has it, the delay by its own
    Pade approximation.
    """
    plant = open_bearing(CONFIGS / f"{name}.yaml").settings().suspension()
    loop, s = plant.loop, control.tf("s")
    if name == "levitated":
        # Written out from the file: 5000 + 20000 / s + 12 s / (1 + 0.2 ms s).
        law = 5000 + 20000 / s + 12 * s / (1 + 0.2e-3 * s)
    else:
        law = (
            loop.proportional
            + loop.derivative * s / (1 + loop.derivative_time * s)
            + loop.lag / (1 + loop.lag_time * s)
        )
    late = control.tf(*control.pade(loop.delay, PADE_ORDER))
    gain = loop.sensor * loop.amplifier * loop.force_per_current
    chain = gain * law * late / (1 + s / (2 * np.pi * loop.bandwidth))
    return chain / (plant.mass * s**2 - plant.negative_stiffness), plant


LOOPS = {"hmb-magnetic": "hybrid bearing", "levitated": "levitated rotor"}


def of_python_control() -> list[Claim]:
    """Margins of two shipped bearing files; labpipe's delay is exact, the other's a Pade approximation."""
    found = []
    for name, title in LOOPS.items():
        peer, plant = peer_loop(name)
        gains, phases, distances, *_ = control.stability_margins(peer, returnall=True)
        ours = margins(lambda w, of=plant: open_loop(of, w).loop, 20e3)
        theirs = {
            "lower": max(gain for gain in gains if gain < 1),
            "upper": min(gain for gain in gains if gain > 1),
        }
        rows = (
            ("lower gain margin", ours.gain_lower, theirs["lower"], "1"),
            ("upper gain margin", ours.gain_upper, theirs["upper"], "1"),
            ("phase margin", float(np.degrees(ours.phase)), float(np.min(np.abs(phases))), "deg"),
        )
        found += [
            within(f"{what}, {title}", value, peer_value, 1e-4, unit, "peer program", PEER, relative=True)
            for what, value, peer_value, unit in rows
        ]
        if name == "levitated":
            found.append(
                within(
                    f"peak of S, {title}",
                    ours.peak,
                    1 / min(distances),
                    1e-4,
                    "1",
                    "peer program",
                    PEER,
                    relative=True,
                )
            )
        found.append(poles(title, plant, peer))
    return found


def poles(title: str, plant: Suspended, peer: Any) -> Claim:
    """Closed-loop poles below 1 kHz, real and imaginary parts in per cent of their distance from the
    origin.
    """
    theirs = np.asarray(control.poles(control.minreal(control.feedback(peer, 1), verbose=False)))
    each = []
    for pole in closed_loop_poles(plant):
        if abs(pole) < 2 * np.pi * 1000 and pole.imag >= 0:
            nearest = theirs[np.argmin(np.abs(theirs - pole))]
            for part, value, reference in (
                ("real", pole.real, nearest.real),
                ("imaginary", pole.imag, nearest.imag),
            ):
                share = 100 / abs(nearest)
                where = f"{part} part of the pole at {abs(pole) / 2 / np.pi:.3g} Hz"
                each.append(
                    within(where, value * share, reference * share, 0.01, "% of |pole|", "peer program", PEER)
                )
    return worst(each, f"poles, {title}")


def measured_stiffness() -> list[Claim]:
    """Lim and others, figure 33: the radial stiffness of the hybrid bearing at 2 Hz."""
    plant = open_bearing(CONFIGS / "hmb-magnetic.yaml").settings().suspension()
    k = dynamic_stiffness(plant.loop, plant.negative_stiffness, np.array([4 * np.pi]))[0].real
    why = (
        "the bearing file subtracts the lag, as the sign of the measured damping asks; the stiffness then "
        "rises from its static 1694 N/m already below 2 Hz, which was not measured. With the printed sign it "
        "falls and the rotor alone is unstable"
    )
    return [
        within(
            "radial stiffness at 2 Hz",
            k,
            1650.0,
            0.1,
            "N/m",
            "printed measurement",
            "Lim 2009",
            why,
            relative=True,
        )
    ]


METHOD = Method(
    "magnetic",
    "Magnetic bearings",
    {
        "closed forms": closed_forms,
        "electromagnet": electromagnet,
        "python-control": of_python_control,
        "measured stiffness": measured_stiffness,
        "not tested": partial(gaps, "magnetic"),
    },
)
