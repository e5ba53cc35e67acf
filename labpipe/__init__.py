"""labpipe: from recorded test-rig runs to stiffness and damping with their doubt.

The same functions as on the command line, records in and records out::

    import labpipe

    recording = labpipe.Recording(channels, samples, sample_rate)          # or labpipe.open_recording(path)
    response = labpipe.measure([recording], labpipe.FrfSettings("periodic", period=1.0))
    pedestal, = labpipe.fit(response, labpipe.FitSettings("sdof", mass=0.79, band=(60.0, 70.0)))
    pedestal.parameter("k").ci95
    html = labpipe.html_report(labpipe.Identification((pedestal,), "My rig"))

Names are imported when they are used, so that ``import labpipe`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "Channel": "labpipe.records.recording:Channel",
    "Recording": "labpipe.records.recording:Recording",
    "FrequencyResponse": "labpipe.records.response:FrequencyResponse",
    "Port": "labpipe.records.response:Port",
    "Parameter": "labpipe.records.identification:Parameter",
    "Fit": "labpipe.records.identification:Fit",
    "Identification": "labpipe.records.identification:Identification",
    "LabpipeError": "labpipe.errors:LabpipeError",
    "FrfSettings": "labpipe.spectra.settings:FrfSettings",
    "FitSettings": "labpipe.identify.settings:FitSettings",
    "Sliding": "labpipe.identify.settings:Sliding",
    "Support": "labpipe.identify.settings:Support",
    "Uncertain": "labpipe.records.settings:Uncertain",
    "measure": "labpipe.spectra.measurement:measure",
    "fit": "labpipe.identify.fitting:identify",
    "fit_line": "labpipe.identify.calibration:fit_line",
    "design_multisine": "labpipe.signals.excitation:design_multisine",
    "VirtualRig": "labpipe.simulate.settings:VirtualRig",
    "simulate_rig": "labpipe.simulate.magnetic_rig:simulate",
    "VirtualMdofRig": "labpipe.simulate.mdof_rig:VirtualMdofRig",
    "simulated_response": "labpipe.simulate.mdof_rig:simulated_response",
    "StudySettings": "labpipe.study.settings:StudySettings",
    "run_study": "labpipe.study.study:run_study",
    "open_recording": "labpipe.artefacts.recording_file:open_recording",
    "read_response": "labpipe.artefacts.response_file:read_response",
    "read_frf_csv": "labpipe.formats.frf_csv:read_frf_csv",
    "read_identification": "labpipe.artefacts.identification_file:read_identification",
    "html_report": "labpipe.document.render:html_report",
    "markdown_report": "labpipe.document.render:markdown_report",
    "plot": "labpipe.document.plot:plot",
}
__all__ = ["__version__", *_PUBLIC]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'labpipe' has no attribute '{name}'")
    module, _, attribute = _PUBLIC[name].partition(":")
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return __all__
