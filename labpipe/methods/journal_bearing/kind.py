"""Journal bearings as a kind of bearing: settings of their file, and coefficients from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from labpipe.bearings.kinds import Amount, BearingCoefficients, BearingKind, PressureField
from labpipe.errors import SettingError
from labpipe.methods.journal_bearing.bearing import NO_LOAD, JournalBearing, converged_equilibrium
from labpipe.records.settings import Settings, choice, quantity, section, text
from labpipe.report.chart import WIDTH, Drawing
from labpipe.report.document import Figure

HEIGHT = 5.2


def film_figure(name: str, film: PressureField) -> Figure:
    caption = (
        f"{name}: pressure of the oil film against ambient, unrolled; below, at mid width (full) with "
        "the film's thickness (dashed)."
    )
    drawing = Drawing("film", film, (WIDTH, HEIGHT))
    return Figure(drawing, caption, f"Pressure of the oil film of {name} over angle and width")


JOURNAL = "journal-bearing"
DOFS = ("y", "z")


@dataclass(frozen=True)
class Wear(Settings):
    """Wear of the bushing after Dufrane: an arc of larger radius."""

    depth: float = quantity("deepest wear", "m", 0.0)
    angle: float = quantity("angle of the deepest wear from the bottom, positive with the spin", "rad", 0.0)


@dataclass(frozen=True, kw_only=True)
class JournalSettings(Settings):
    """A journal bearing without load and speed, as in a rotor file."""

    kind: str = choice("which kind of bearing", (JOURNAL,))
    name: str = text("name of the bearing")
    diameter: float = quantity("diameter of the journal", "m")
    length: float = quantity("length of the bearing", "m")
    clearance: float = quantity("radial clearance", "m")
    viscosity: float = quantity("dynamic viscosity of the oil", "Pa.s")
    temperature: float | None = quantity(
        "temperature of the film; default: that at which the viscosity is given", "K", None
    )
    viscosity_temperature: float | None = quantity("temperature at which the viscosity is given", "K", None)
    viscosity_slope: float = quantity(
        "relative fall of the viscosity per kelvin (Reynolds), 3 %/K", "1/K", 0.0
    )
    cavitation_pressure: float = quantity("pressure at which the film tears, against ambient", "Pa", 0.0)
    groove_width: float = quantity("width of two axial grooves at the horizontal split", "rad", 0.0)
    wear: Wear = section("wear of the bushing", Wear, Wear())

    def __post_init__(self) -> None:
        if self.temperature is not None and (self.viscosity_temperature is None or not self.viscosity_slope):
            what = "the viscosity at it needs 'viscosity_temperature' and 'viscosity_slope'"
            hint = "viscosity_temperature: 40 degC, viscosity_slope: 3 %/K"
            raise SettingError("temperature", what, hint)
        self.require_not_negative("viscosity_slope")
        self.bearing()

    @property
    def film_viscosity(self) -> float:
        """Viscosity at the film's temperature [Pa.s], eta exp(-b (T - T_0)) (Reynolds 1886)."""
        if self.temperature is None or self.viscosity_temperature is None:
            return self.viscosity
        return self.viscosity * float(
            np.exp(-self.viscosity_slope * (self.temperature - self.viscosity_temperature))
        )

    def bearing(self) -> JournalBearing:
        """The bearing; ConfigError for impossible values."""
        return JournalBearing(
            diameter=self.diameter,
            length=self.length,
            clearance=self.clearance,
            viscosity=self.film_viscosity,
            wear_depth=self.wear.depth,
            wear_angle=self.wear.angle,
            cavitation_pressure=self.cavitation_pressure,
            groove_width=self.groove_width,
        )


@dataclass(frozen=True, kw_only=True)
class JournalFile(JournalSettings):
    """A journal-bearing file: the bearing at its load and speed."""

    speed: float = quantity("speed of the shaft, in Hz or rpm", "Hz")
    load: float = quantity("static load, downwards (-z)", "N")
    side_load: float = quantity("static load in y (horizontal)", "N", 0.0)
    accuracy: float = quantity("mesh error allowed, of the largest coefficient", "1", 0.01)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.speed > 0:
            raise SettingError("speed", f"an oil film needs a speed above zero, not {self.speed:g} Hz")
        if not np.hypot(self.load, self.side_load) > 0:
            raise SettingError("load", NO_LOAD, "for example load: 58.82 N")
        if not 1e-4 <= self.accuracy <= 0.5:
            raise SettingError("accuracy", "must lie between 0.01 % and 50 %")


def journal_coefficients(settings: JournalFile) -> BearingCoefficients:
    """On the coarsest mesh that is accurate enough."""
    load = (settings.side_load, -settings.load)
    state = converged_equilibrium(settings.bearing(), load, 2 * np.pi * settings.speed, settings.accuracy)
    film = PressureField(state.theta, state.axial, state.pressure, state.film_thickness)
    y, z = state.position
    assert state.error is not None
    return BearingCoefficients(
        dofs=DOFS,
        stiffness=state.stiffness,
        damping=state.damping,
        rest=(
            Amount("eccentricity_ratio", state.eccentricity_ratio, "1"),
            Amount("attitude_angle", state.attitude, "rad"),
            Amount("sommerfeld", state.sommerfeld, "1"),
            Amount("y", float(y), "m"),
            Amount("z", float(z), "m"),
            Amount("film_thickness_min", float(state.film_thickness.min()), "m"),
            Amount("pressure_max", float(state.pressure.max()), "Pa"),
        ),
        notes=(
            Amount("cells_around", float(state.mesh.around), "1"),
            Amount("cells_across", float(state.mesh.across), "1"),
            Amount("mesh_error", state.error, "1"),
        ),
        film=film,
    )


JOURNAL_KIND = BearingKind(
    JournalFile,
    lambda settings: [journal_coefficients(entry) for entry in settings],
    on_rotor=JournalSettings,
    mount=JournalSettings.bearing,
    figures=lambda name, coefficients: (
        {} if coefficients.film is None else {"pressure.svg": film_figure(name, coefficients.film)}
    ),
)
