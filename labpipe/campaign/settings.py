"""The parameters of one comparison of tests; *name* is its key under ``compare:``."""

from __future__ import annotations

from dataclasses import dataclass

from labpipe.campaign.certificate_settings import CertificateSettings
from labpipe.errors import ConfigError
from labpipe.records.settings import Settings, Uncertain, setting

KINDS = ("trend", "difference", "repeatability", "ratio", "rayleigh", "reciprocity", "prediction", "bands", "sensitivity", "certificate")
# Kinds whose theory is a magnetic-bearing file, unchanged unless a condition sets one of its entries.
MAGNETIC_KINDS = ("prediction", "sensitivity", "certificate")
TWO_GROUPS = ("difference", "bands")
# Kinds that go over two conditions as well as over one.
TWO_CONDITIONS = ("trend", "difference", "ratio", "rayleigh")
LOAD = "loads.z"
LAWS = ("line", "power")


@dataclass(frozen=True)
class TheorySettings(Settings):
    """The bearing file of the theory, and how the rig measures the bearing."""

    bearing: str = setting("file", "bearing file with the shaft on it, relative to this file", file_kind="bearing")
    entry: tuple[str, ...] = setting("names", "entry of the bearing file that the condition sets; of two conditions two", default=(LOAD,))
    shaft: Uncertain | None = setting("uncertain", "radial stiffness of the bending shaft; default: rigid", unit="N/m", default=None)
    arm: float | None = setting("value", "tilts are measured as displacements at this distance", unit="m", default=None)

    def __post_init__(self) -> None:
        if self.shaft is not None and not self.shaft.value > 0:
            raise ConfigError("'shaft' must be above zero")
        if self.arm is not None and not self.arm > 0:
            raise ConfigError("'arm' must be above zero")


@dataclass(frozen=True, kw_only=True)
class CompareSettings(Settings):
    """One entry under ``compare:``."""

    kind: str = setting("choice", "kind of comparison", choices=KINDS)
    fit: str = setting("text", "fit whose parameter is compared", default="")
    term: str = setting("text", "diagonal term of a fit of peaks", default="")
    parameter: str = setting("text", "parameter that is compared", default="k")
    over: tuple[str, ...] = setting("names", "condition over which tests are ordered or paired, or two of them", default=())
    tolerance: float = setting("value", "difference: values closer than this share of the largest are one", unit="1", default=1e-6)
    group: str = setting("text", "condition that makes the groups (difference, repeatability, bands)", default="")
    groups: tuple[str, ...] = setting("names", "difference, bands: the two groups, the second against the first", default=())
    law: str = setting("choice", "trend: straight line, or power law", choices=LAWS, default="line")
    setting_error: float = setting("value", "relative standard error of setting the condition", unit="1", default=0.0)
    theory: TheorySettings | None = setting("section", "theory to compare with", section=TheorySettings, default=None)
    estimate: tuple[str, ...] = setting("names", "prediction, sensitivity, certificate: unknowns of the bearing file, fitted", default=())
    before: str = setting("text", "sensitivity: response ahead of the sum at which the excitation is added", default="before")
    after: str = setting("text", "sensitivity: response behind that sum", default="after")
    certificate: CertificateSettings | None = setting(
        "section", "certificate: what was recorded, and the limits", section=CertificateSettings, default=None
    )
    level: float = setting("value", "level of significance of tests", unit="1", default=0.05)
    name: str = ""

    def __post_init__(self) -> None:
        for needed in NEEDED[self.kind]:
            if not getattr(self, needed):
                raise ConfigError(f"'{needed}' is missing", hint=f"a comparison of kind {self.kind} needs it")
        if self.kind in TWO_GROUPS and len(self.groups) != 2:
            raise ConfigError(f"two groups are compared, not {len(self.groups)}", hint="for example groups: [up, down]")
        self._check_over()
        if not 0 < self.level < 1:
            raise ConfigError("'level' must lie between 0 and 100 %")
        if self.setting_error < 0:
            raise ConfigError("'setting_error' must not be negative")
        if self.estimate and (self.kind not in MAGNETIC_KINDS or self.theory is None):
            hint = f"it goes with theory: {{bearing: FILE}} of the kinds {' and '.join(MAGNETIC_KINDS)}"
            raise ConfigError("'estimate' has no loop whose unknowns can be fitted", hint=hint)
        if len(set(self.estimate)) < len(self.estimate):
            raise ConfigError("'estimate' names an unknown twice", hint=", ".join(dict.fromkeys(self.estimate)))
        self._check_theory()
        if self.certificate is not None and self.kind != "certificate":
            raise ConfigError(f"'certificate' is not for the kind {self.kind}", hint="kind: certificate", field="certificate")

    @property
    def condition(self) -> str:
        """The first condition, along the abscissa; empty where none is named."""
        return self.over[0] if self.over else ""

    @property
    def second(self) -> str:
        """The second condition; empty where there is none."""
        return self.over[1] if len(self.over) > 1 else ""

    def _check_over(self) -> None:
        """ConfigError for more conditions than the kind takes, and for a tolerance that is no share."""
        most = 2 if self.kind in TWO_CONDITIONS else 1
        if len(self.over) > most:
            what = f"a comparison of kind {self.kind} goes over {most} condition(s), not {len(self.over)}"
            raise ConfigError(what, hint=f"two: {', '.join(TWO_CONDITIONS)}; more: matrix", field="over")
        if len(set(self.over)) < len(self.over):
            raise ConfigError(f"'over' names '{self.condition}' twice", field="over")
        if not 0 <= self.tolerance < 1:
            raise ConfigError("'tolerance' must be at least 0 and below 100 %")

    def _check_theory(self) -> None:
        """ConfigError for a theory without the entries that the conditions set, or with an estimate of one of them."""
        if self.theory is None:
            return
        if not self.over:
            if self.kind not in MAGNETIC_KINDS:
                raise ConfigError("'over' is missing", hint="the condition at which the theory is evaluated")
            return
        if self.kind in MAGNETIC_KINDS and self.theory.entry == (LOAD,):
            hint = "for example theory: {bearing: FILE, entry: loop.proportional}"
            raise ConfigError(f"'theory.entry' is missing, the entry that '{self.condition}' sets", hint=hint)
        if len(self.theory.entry) != len(self.over):
            what = f"'theory.entry' names {len(self.theory.entry)} entries for {len(self.over)} conditions"
            raise ConfigError(what, hint="for example over: [speed, load] with entry: [speed, loads.z]")
        estimated = next((entry for entry in self.theory.entry if entry.rpartition(".")[2] in self.estimate), None)
        if estimated is not None:
            raise ConfigError(f"'{estimated}' is set by '{self.condition}', so it is not estimated", hint="leave one of them out")


NEEDED: dict[str, tuple[str, ...]] = {
    "trend": ("fit", "over"),
    "difference": ("fit", "group"),
    "repeatability": ("fit", "group"),
    "ratio": ("fit", "over", "theory"),
    "rayleigh": ("fit", "over"),
    "reciprocity": (),
    "prediction": ("fit", "theory"),
    "bands": ("fit", "group"),
    "sensitivity": (),
    "certificate": (),
}
