"""base: a mass on a spring and a damper whose base moves; its transmissibility, absolute or relative to the base.

m x'' = -k (x - b) - c (x' - b'). Absolute T = X / B = (k + j w c) / (k + j w c - w^2 m), relative T_r = (X - B) / B = T - 1
= w^2 m / (k + j w c - w^2 m) (Thomson and Dahleh, Theory of Vibration with Applications, sec. 3.5; den Hartog, sec. 2.11). So
(T - 1) / w^2 = m / (k + j w c - w^2 m) [s^2] is the receptance of a mass under the force m, linear in k and c, in either case.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from labpipe.errors import ConfigError
from labpipe.identify.model import DynamicModel, Term
from labpipe.identify.model_kinds import linear_kind
from labpipe.identify.settings import ESTIMATE, FitSettings
from labpipe.identify.setup import Setup, entry_term, fixed_matrices, labels
from labpipe.spectra.convert import DERIVATIVES, TRANSMISSIBILITY, FormView

BASE = "base"
# Coefficients of a mass that is not given, and their units.
PER_MASS = {"k": ("stiffness_per_mass", "1/s^2"), "c": ("damping_per_mass", "1/s")}


def form_view(form: str, settings: FitSettings) -> FormView:
    """The view of a model on a response of that *form*; ConfigError for a base without its motion, and for a transmissibility elsewhere."""
    if settings.kind.of_base and form != TRANSMISSIBILITY:
        what = f"model {BASE} needs the motion of the base as input, this FRF is of a force" if form in DERIVATIVES else _no_motion(form)
        raise ConfigError(
            what, hint="in the rig file: role: input for the acceleration (velocity, displacement) of the base; or model: sdof"
        )
    if not settings.kind.of_base and form == TRANSMISSIBILITY:
        raise ConfigError(f"model {settings.model} needs a force as input, this FRF is of the motion of a base", hint=f"model: {BASE}")
    if form == TRANSMISSIBILITY:
        return FormView(form, 0.0 if settings.relative else 1.0)
    return FormView(form)


def _no_motion(form: str) -> str:
    return f"model {BASE} needs the motion of the base as input, and a motion as output; this FRF is of the form '{form}'"


def base_excited(setup: Setup) -> DynamicModel:
    """(k + j w c - w^2 m) (T - 1) / w^2 = m; without a mass k / m and c / m, since a transmissibility knows no more.

    ConfigError for several responses or bases, or for a mass that is none. Equation (frf-base).
    """
    if setup.shape != (1, 1):
        what = f"{BASE} takes one response and one base, found {labels(setup.outputs)} and {labels(setup.inputs)}"
        raise ConfigError(what, hint="name them with `output` and `input`")
    given = setup.settings.mass
    if given != ESTIMATE and not (isinstance(given, float | int) and given > 0):
        raise ConfigError(f"{BASE} takes one positive mass", hint="for example mass: 0.92 kg; without it f_n and zeta are identified")
    shape = (1, 1)
    terms = (entry_term("k", "stiffness", [(0, 0)], shape), entry_term("c", "damping", [(0, 0)], shape))
    if isinstance(given, float | int):
        return DynamicModel(BASE, terms, fixed_matrices(np.array([[float(given)]]), float(given) * np.ones(shape)))
    return DynamicModel(BASE, tuple(map(_per_mass, terms)), fixed_matrices(np.ones(shape), np.ones(shape)))


def _per_mass(term: Term) -> Term:
    name, unit = PER_MASS[term.name]
    return replace(term, name=name, unit=unit)


BASE_EXCITED = linear_kind(base_excited, "relative", one_mode=True, of_base=True)
