"""A result as XML after the Digital Calibration Certificate (DCC), for programs that read certificates.

It is like a DCC and is none: labpipe knows no laboratory, customer or responsible person. What the schema
asks for and nobody stated is said to be not stated; days stand in it only where a test states its date.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

from labpipe import __version__
from labpipe.artefacts.identification_file import read_identification
from labpipe.errors import DataError
from labpipe.project.deciding import stated_error
from labpipe.raw_files.certificate import DCC, SI, dsi_unit
from labpipe.records.finding import Parameter
from labpipe.records.identification import Fit, Identification, RuleOutcome

SCHEMA = "3.3.0"
NOT_STATED = "not stated"
# ISO 3166-1 keeps it for users: no country.
NO_COUNTRY = "ZZ"
# Outcomes of decisions as the schema writes them.
_CONFORMITY = {"conditional-pass": "conditionalPass", "conditional-fail": "conditionalFail"}


def write_dcc(artefact: Path, target: Path) -> None:
    """The parameters of a result with their expanded uncertainties, and the outcomes of its rules; the same
    bytes for the same result. DataError for an artefact that is no result.
    """
    if artefact.suffix != ".json":
        raise DataError("cannot be written as a certificate", artefact, "name an identification.json")
    identification = read_identification(artefact)
    ET.register_namespace("dcc", DCC[1:-1])
    ET.register_namespace("si", SI[1:-1])
    root = ET.Element(f"{DCC}digitalCalibrationCertificate", schemaVersion=SCHEMA)
    _administrative(_child(root, "administrativeData"), identification)
    results = _child(root, "measurementResults")
    for number, fit in enumerate(identification.fits):
        _fit(_child(results, "measurementResult", id=f"fit{number + 1}"), fit, f"fit{number + 1}")
    ET.indent(root)
    target.write_bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _child(owner: ET.Element, name: str, text: str = "", space: str = DCC, **attributes: str) -> ET.Element:
    child = ET.SubElement(owner, f"{space}{name}", attributes)
    if text:
        child.text = _readable(text)
    return child


def _readable(text: str) -> str:
    """A text without the characters that XML cannot hold."""
    return re.sub(r"[^\t\n\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", text)


def _name(owner: ET.Element, name: str, text: str) -> ET.Element:
    """An element whose name is a text."""
    child = _child(owner, name)
    _child(_child(child, "name"), "content", text)
    return child


def _administrative(owner: ET.Element, identification: Identification) -> None:
    software = _name(_child(owner, "dccSoftware"), "software", "labpipe")
    _child(software, "release", identification.version or __version__)
    core = _child(owner, "coreData")
    _child(core, "countryCodeISO3166_1", NO_COUNTRY)
    _child(core, "usedLangCodeISO639_1", "en")
    _child(core, "mandatoryLangCodeISO639_1", "en")
    _child(core, "uniqueIdentifier", f"labpipe:{identification.digest or NOT_STATED}")
    days = sorted(
        conditions["date"] for conditions in identification.test_conditions.values() if "date" in conditions
    )
    if days:
        _child(core, "beginPerformanceDate", days[0])
        _child(core, "endPerformanceDate", days[-1])
    _child(core, "performanceLocation", "other")
    item = _name(_child(owner, "items"), "item", identification.rig.get("name") or NOT_STATED)
    identity = _child(_child(item, "identifications"), "identification")
    _child(identity, "issuer", "other")
    _child(identity, "value", identification.title or NOT_STATED)
    _locate(_name(_child(owner, "calibrationLaboratory"), "contact", NOT_STATED))
    _name(_child(_child(owner, "respPersons"), "respPerson"), "person", NOT_STATED)
    _locate(_name(owner, "customer", NOT_STATED))
    if identification.outcomes:
        statements = _child(owner, "statements")
        for outcome in identification.outcomes:
            _statement(_child(statements, "statement"), outcome)


def _locate(contact: ET.Element) -> None:
    _child(_child(contact, "location"), "countryCode", NO_COUNTRY)


def _statement(owner: ET.Element, outcome: RuleOutcome) -> None:
    """A rule as a statement of conformity, with what it found."""
    declared = f"{outcome.section}: {outcome.rule}; {outcome.found}"
    _child(_child(owner, "declaration"), "content", declared)
    word = "pass" if outcome.passed else "fail"
    if outcome.decision is not None:
        word = outcome.decision.outcome
    _child(owner, "conformity", _CONFORMITY.get(word, word))


def _fit(owner: ET.Element, fit: Fit, key: str) -> None:
    title = " ".join(filter(None, (fit.name, fit.term, f"[{fit.test}]" if fit.test else "")))
    _child(_child(owner, "name"), "content", title)
    band = f"{fit.band_hz[0]:g} Hz to {fit.band_hz[1]:g} Hz"
    _name(_child(owner, "usedMethods"), "usedMethod", f"{fit.model}, {fit.estimator}, {band}")
    result = _name(_child(owner, "results"), "result", title)
    listed = _child(_child(result, "data"), "list")
    for parameter in fit.parameters:
        _quantity(listed, parameter, key)


def _quantity(owner: ET.Element, parameter: Parameter, key: str) -> None:
    """A parameter with the half width of its stated interval as expanded uncertainty."""
    name = re.sub(r"[^A-Za-z0-9_.-]", "-", parameter.name)
    quantity = _name(owner, "quantity", parameter.name)
    quantity.set("id", f"{key}_{name}")
    real = _child(quantity, "real", space=SI)
    _child(real, "value", repr(parameter.value), SI)
    _child(real, "unit", dsi_unit(parameter.unit), SI)
    error = stated_error(parameter)
    if parameter.ci95 is None or not error:
        return
    half = (parameter.ci95[1] - parameter.ci95[0]) / 2
    univariate = _child(real, "measurementUncertaintyUnivariate", space=SI)
    expanded = _child(univariate, "expandedMU", space=SI)
    _child(expanded, "valueExpandedMU", repr(half), SI)
    _child(expanded, "coverageFactor", repr(half / error), SI)
    _child(expanded, "coverageProbability", "0.95", SI)
