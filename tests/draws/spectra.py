"""Worlds of the spectra of all channels: what they would be if a fitted balance held exactly, recorded with
errors and new noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from labpipe.estimation.fitting import identify
from labpipe.estimation.settings import FitSettings
from labpipe.methods.floating_bearing.fit import fitted_model, given_baseline
from labpipe.methods.floating_bearing.settings import Given, projection
from labpipe.methods.floating_bearing.stator import direction, stator_of
from labpipe.methods.magnetic_bearing.balance import Between, levitation_of, magnet_model
from labpipe.records.fit_details import DynamicStiffness
from labpipe.records.identification import Fit
from labpipe.records.spectra import ChannelSpectra
from labpipe.spectra.bands import lines_in
from tests.draws.usual import Errors, angle_error, factor_of


@dataclass(frozen=True)
class SpectraWorlds:
    """Worlds about *spectra* whose vectors satisfy the balance.

    Root (n_line, n_run, n_channel, n_channel) of their covariance.
    """

    spectra: ChannelSpectra
    root: np.ndarray

    def recorded(self, errors: Errors, rng: np.random.Generator | None) -> ChannelSpectra:
        spectra = self.spectra
        omega = 2 * np.pi * spectra.frequency
        vectors = spectra.vectors.copy()
        for quantity in dict.fromkeys(channel.quantity for channel in spectra.channels):
            self._aim(vectors, quantity, errors)
        vectors *= np.stack(
            [factor_of(channel.uncertainties, omega, errors) for channel in spectra.channels], axis=1
        )[:, None]
        if rng is not None:
            assert not spectra.line_correlation
            parts = rng.standard_normal((2, *vectors.shape)) / np.sqrt(2)
            vectors = vectors + np.einsum("lrab,lrb->lra", self.root, parts[0] + 1j * parts[1])
        return replace(spectra, vectors=vectors)

    def _aim(self, vectors: np.ndarray, quantity: str, errors: Errors) -> None:
        """Channels in the directions that they have: a motion is projected on them, forces add up to the one
        that acts.
        """
        columns = [
            n
            for n, one in enumerate(self.spectra.channels)
            if one.quantity == quantity and one.angle is not None
        ]
        if len(columns) != 2:
            return
        channels = [self.spectra.channels[n] for n in columns]
        written = np.array([direction(channel) for channel in channels])
        true = written - np.array([angle_error(channel.uncertainties, errors) for channel in channels])
        old, new = (np.stack([np.cos(angles), np.sin(angles)]) for angles in (written, true))
        turn = np.linalg.solve(new, old) if channels[0].quantity == "force" else np.linalg.solve(old, new).T
        vectors[..., columns] = vectors[..., columns] @ turn.T


def spectra_worlds(spectra: ChannelSpectra, settings: FitSettings) -> tuple[SpectraWorlds, Fit]:
    """Worlds about the fit to the *spectra*: vectors without the part of their noise that breaks the
    balance.
    """
    (fit,) = identify(spectra, settings)
    band = settings.band or (float(spectra.frequency[0]), float(spectra.frequency[-1]))
    lines = lines_in(spectra.frequency, band)
    spectra = replace(
        spectra,
        frequency=spectra.frequency[lines],
        vectors=spectra.vectors[lines],
        covariance=spectra.covariance[lines],
    )
    rows = (_of_magnet if settings.model == "magnet" else _of_stator)(spectra, settings, fit)
    left = (rows[:, None] @ spectra.vectors[..., None])[..., 0]
    held = rows.conj().swapaxes(1, 2)[:, None]
    inner = rows[:, None] @ spectra.covariance @ held
    clean = spectra.vectors - (spectra.covariance @ held @ np.linalg.solve(inner, left[..., None]))[..., 0]
    values, vectors = np.linalg.eigh(spectra.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return SpectraWorlds(replace(spectra, vectors=clean), root), fit


def _of_stator(spectra: ChannelSpectra, settings: FitSettings, fit: Fit) -> np.ndarray:
    """B (n_line, 2, n_channel) of the balance B z = 0 of a stator."""
    own, shown = settings.model_settings, fit.detail(DynamicStiffness)
    assert shown is not None
    stator = stator_of(spectra, settings.band, settings.input, settings.output)
    given = Given(own.stator_mass, given_baseline(own), own.motion == "absolute")
    to_balance = projection(stator, given) @ stator.to_axes
    return to_balance[:, :2] - fitted_model(shown).stiffness(shown.values, stator.omega) @ to_balance[:, 2:]


def _of_magnet(spectra: ChannelSpectra, settings: FitSettings, fit: Fit) -> np.ndarray:
    """B (n_line, n, n_channel) of the balance of a levitated rotor."""
    own = settings.model_settings
    rotor = levitation_of(spectra, settings.band, (settings.input, settings.output), settings.mass, own)
    between = None if own.hold is None else Between(own.hold, own.amplifier_bandwidth)
    model = magnet_model(rotor.labels, rotor.bearing, rotor.mass, own.coupling, own.passive_damping, between)
    return (
        model.rows(np.array([fit.parameter(name).value for name in model.names]), rotor.omega) @ rotor.to_axes
    )
