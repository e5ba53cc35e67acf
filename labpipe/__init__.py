"""labpipe: from recorded test-rig runs to stiffness and damping with their uncertainty.

The same functions as on the command line, records in and records out::

    import labpipe

    result = labpipe.run("pipeline.yaml")                                  # everything, as `labpipe run`
    recording = labpipe.read("pedestal.csv", rig="rig.yaml")               # or TDMS, UFF, MAT, HDF5, WAV, FRF
    files, results response = labpipe.measure([recording], labpipe.FrfSettings("periodic", period="2 s",
    skip=3)) pedestal, = labpipe.fit(response, labpipe.FitSettings("sdof", mass="0.79 kg", band="60-70 Hz"))
    print(pedestal) html = labpipe.html_report(labpipe.Identification((pedestal,), "My rig"))

Names are imported when they are used, so that ``import labpipe`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# Module -> the names that it gives, those that the module calls otherwise as "name=other".
_MODULES = {
    "labpipe.project.scripting": "read run bearing rotor virtual_rig",
    "labpipe.spectra.measurement": "measure",
    "labpipe.spectra.all_channels": "channel_spectra",
    "labpipe.spectra.free_decays": "free_decays",
    "labpipe.estimation.fitting": "fit=identify",
    "labpipe.methods.calibration.section": "fit_line",
    "labpipe.uncertainty.study": "run_study StudySettings",
    "labpipe.uncertainty.compare": "compare Evidence",
    "labpipe.uncertainty.settings": "CompareSettings",
    "labpipe.simulate.virtual_rigs": "recordings simulated_response",
    "labpipe.raw_files.excitation": "design_multisine",
    "labpipe.document.render": "html_report markdown_report",
    "labpipe.document.charts": "plot",
    "labpipe.spectra.settings": "FrfSettings",
    "labpipe.estimation.settings": "FitSettings Sliding Support",
    "labpipe.records.uncertain": "Uncertain",
    "labpipe.records.recording": "Channel Recording",
    "labpipe.records.response": "Port FrequencyResponse",
    "labpipe.records.spectra": "ChannelSpectra FreeDecays",
    "labpipe.records.finding": "Parameter",
    "labpipe.records.identification": "Fit Identification",
    "labpipe.errors": "LabpipeError",
}
_PUBLIC = {
    text.partition("=")[0]: (module, text.rpartition("=")[2])
    for module, names in _MODULES.items()
    for text in names.split()
}
__all__ = ["__version__", *_PUBLIC]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'labpipe' has no attribute '{name}'")
    module, attribute = _PUBLIC[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return __all__
