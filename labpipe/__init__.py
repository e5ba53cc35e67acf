"""labpipe: from recorded test-rig runs to stiffness and damping with their doubt.

The same functions as on the command line, records in and records out::

    import labpipe

    result = labpipe.run("pipeline.yaml")                                  # everything, as `labpipe run`
    recording = labpipe.read("pedestal.csv", rig="rig.yaml")               # or TDMS, UFF, MAT, HDF5, WAV, FRF files, results
    response = labpipe.measure([recording], labpipe.FrfSettings("periodic", period="2 s", skip=3))
    pedestal, = labpipe.fit(response, labpipe.FitSettings("sdof", mass="0.79 kg", band="60-70 Hz"))
    print(pedestal)
    html = labpipe.html_report(labpipe.Identification((pedestal,), "My rig"))

Names are imported when they are used, so that ``import labpipe`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    # Files, pipelines and things by name.
    "read": "labpipe.scripting.reading:read",
    "run": "labpipe.scripting.running:run",
    "bearing": "labpipe.scripting.by_name:bearing",
    "rotor": "labpipe.scripting.by_name:rotor",
    "virtual_rig": "labpipe.scripting.by_name:virtual_rig",
    # The stages as functions.
    "measure": "labpipe.spectra.measurement:measure",
    "channel_spectra": "labpipe.spectra.all_channels:channel_spectra",
    "free_decays": "labpipe.spectra.free_decays:free_decays",
    "fit": "labpipe.identify.fitting:identify",
    "fit_line": "labpipe.identify.calibration:fit_line",
    "run_study": "labpipe.study.study:run_study",
    "recordings": "labpipe.simulate.virtual_rigs:recordings",
    "simulated_response": "labpipe.simulate.virtual_rigs:simulated_response",
    "design_multisine": "labpipe.signals.excitation:design_multisine",
    "html_report": "labpipe.document.render:html_report",
    "markdown_report": "labpipe.document.render:markdown_report",
    "plot": "labpipe.document.plot:plot",
    # Their settings.
    "FrfSettings": "labpipe.spectra.settings:FrfSettings",
    "FitSettings": "labpipe.identify.settings:FitSettings",
    "Sliding": "labpipe.identify.settings:Sliding",
    "Support": "labpipe.identify.settings:Support",
    "StudySettings": "labpipe.study.settings:StudySettings",
    "Uncertain": "labpipe.records.settings:Uncertain",
    # Records.
    "Channel": "labpipe.records.recording:Channel",
    "Recording": "labpipe.records.recording:Recording",
    "Port": "labpipe.records.response:Port",
    "FrequencyResponse": "labpipe.records.response:FrequencyResponse",
    "ChannelSpectra": "labpipe.records.channel_spectra:ChannelSpectra",
    "FreeDecays": "labpipe.records.free_decay:FreeDecays",
    "Parameter": "labpipe.records.parameter:Parameter",
    "Fit": "labpipe.records.identification:Fit",
    "Identification": "labpipe.records.identification:Identification",
    "LabpipeError": "labpipe.errors:LabpipeError",
}
__all__ = ["__version__", *_PUBLIC]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'labpipe' has no attribute '{name}'")
    module, _, attribute = _PUBLIC[name].partition(":")
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return __all__
