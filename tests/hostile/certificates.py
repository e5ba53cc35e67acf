"""Certificates that were damaged: refused in words, or read as the same numbers.

By hand, ten thousand of them: python -m tests.hostile.certificates --count 10000
"""

from __future__ import annotations

import argparse
import copy
import re
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from labpipe.quantities import UnitError
from labpipe.raw_files.certificate import DCC, SI, read_certificate

# A certificate after the published schema 3.3: a sensitivity at 80 Hz, and one over frequency with its phase.
CERTIFICATE = r"""<?xml version="1.0" encoding="utf-8"?>
<dcc:digitalCalibrationCertificate
  xmlns:dcc="https://ptb.de/dcc" xmlns:si="https://ptb.de/si" schemaVersion="3.3.0">
  <dcc:administrativeData>
    <dcc:dccSoftware><dcc:software><dcc:name><dcc:content>writer</dcc:content></dcc:name>
      <dcc:release>1</dcc:release></dcc:software></dcc:dccSoftware>
    <dcc:coreData>
      <dcc:countryCodeISO3166_1>DE</dcc:countryCodeISO3166_1>
      <dcc:usedLangCodeISO639_1>en</dcc:usedLangCodeISO639_1>
      <dcc:mandatoryLangCodeISO639_1>en</dcc:mandatoryLangCodeISO639_1>
      <dcc:uniqueIdentifier>2026-0417</dcc:uniqueIdentifier>
      <dcc:beginPerformanceDate>2026-01-30</dcc:beginPerformanceDate>
      <dcc:endPerformanceDate>2026-01-31</dcc:endPerformanceDate>
      <dcc:performanceLocation>laboratory</dcc:performanceLocation>
    </dcc:coreData>
    <dcc:items><dcc:item><dcc:name><dcc:content>probe</dcc:content></dcc:name><dcc:identifications>
      <dcc:identification><dcc:issuer>manufacturer</dcc:issuer>
        <dcc:value>SN 1234</dcc:value></dcc:identification>
    </dcc:identifications></dcc:item></dcc:items>
    <dcc:calibrationLaboratory><dcc:contact><dcc:name><dcc:content>laboratory</dcc:content></dcc:name>
      <dcc:location><dcc:city>B</dcc:city></dcc:location></dcc:contact></dcc:calibrationLaboratory>
    <dcc:respPersons><dcc:respPerson>
      <dcc:person><dcc:name><dcc:content>person</dcc:content></dcc:name></dcc:person>
    </dcc:respPerson></dcc:respPersons>
    <dcc:customer><dcc:name><dcc:content>customer</dcc:content></dcc:name>
      <dcc:location><dcc:city>C</dcc:city></dcc:location></dcc:customer>
    <dcc:statements>
      <dcc:statement refType="basic_recalibration"><dcc:date>2027-01-31</dcc:date></dcc:statement>
    </dcc:statements>
  </dcc:administrativeData>
  <dcc:measurementResults>
    <dcc:measurementResult>
      <dcc:name><dcc:content>results</dcc:content></dcc:name>
      <dcc:results>
        <dcc:result>
          <dcc:name><dcc:content>at one frequency</dcc:content></dcc:name>
          <dcc:data><dcc:quantity id="s80" refType="vib_sensitivity">
            <dcc:name><dcc:content lang="en">Sensitivity</dcc:content></dcc:name>
            <si:real><si:value>8.004</si:value><si:unit>\kilo\volt\per\metre</si:unit>
              <si:measurementUncertaintyUnivariate><si:expandedMU>
                <si:valueExpandedMU>0.032</si:valueExpandedMU>
                <si:coverageFactor>2</si:coverageFactor>
                <si:coverageProbability>0.95</si:coverageProbability>
              </si:expandedMU></si:measurementUncertaintyUnivariate></si:real>
          </dcc:quantity></dcc:data>
        </dcc:result>
        <dcc:result>
          <dcc:name><dcc:content>over frequency</dcc:content></dcc:name>
          <dcc:data><dcc:list>
            <dcc:quantity refType="vib_frequency"><si:realListXMLList>
              <si:valueXMLList>20 80 500</si:valueXMLList>
              <si:unitXMLList>\hertz</si:unitXMLList></si:realListXMLList></dcc:quantity>
            <dcc:quantity refType="vib_amplitude"><si:realListXMLList>
              <si:valueXMLList>8.1 8.004 7.6</si:valueXMLList>
              <si:unitXMLList>\kilo\volt\per\metre</si:unitXMLList>
              <si:expandedUncXMLList>
                <si:uncertaintyXMLList>0.032 0.032 0.0608</si:uncertaintyXMLList>
                <si:coverageFactorXMLList>2</si:coverageFactorXMLList>
                <si:coverageProbabilityXMLList>0.95</si:coverageProbabilityXMLList>
              </si:expandedUncXMLList></si:realListXMLList></dcc:quantity>
            <dcc:quantity refType="vib_phase"><si:realListXMLList>
              <si:valueXMLList>0 -1 -6</si:valueXMLList><si:unitXMLList>\degree</si:unitXMLList>
              <si:measurementUncertaintyUnivariateXMLList><si:standardMUXMLList>
                <si:valueStandardMUXMLList>0.5</si:valueStandardMUXMLList>
              </si:standardMUXMLList></si:measurementUncertaintyUnivariateXMLList>
            </si:realListXMLList></dcc:quantity>
          </dcc:list></dcc:data>
        </dcc:result>
      </dcc:results>
    </dcc:measurementResult>
  </dcc:measurementResults>
</dcc:digitalCalibrationCertificate>
"""
ASKED = ("s80", "vib_frequency", "vib_amplitude", "vib_phase")
# What states a number: a digit changed here gives another certificate, which only its digest or signature
# shows.
_STATING = re.compile(
    rb"<si:(?:value|unit|uncertainty|coverageFactor)\w*>[^<]*</|refType=\"vib_\w*\"|id=\"s80\"|xmlns:si=\"[^\"]*\""
)


def numbers(path: Path) -> list[tuple[object, ...]]:
    """What the certificate states of all that is asked for; UnitError for one that cannot be read."""
    certificate = read_certificate(path)
    quantities = [certificate.quantity(name) for name in ASKED]
    for quantity in quantities:
        # Of a sensitivity and a phase without an uncertainty a rig takes nothing; frequencies need none.
        if quantity.std_errors is None and quantity.unit != "Hz":
            raise UnitError("states no uncertainty")
    return [(quantity.values, quantity.unit, quantity.std_errors) for quantity in quantities]


def mutations(seed: int) -> Iterator[bytes]:
    """Damaged certificates without end: elements gone, twice, renamed, swapped or emptied; bytes changed,
    inserted or cut off outside of what states a number.
    """
    rng = np.random.default_rng(seed)
    tree = ET.fromstring(CERTIFICATE)
    plain = CERTIFICATE.encode()
    stating = [range(*match.span()) for match in _STATING.finditer(plain)]
    while True:
        yield _in_tree(rng, copy.deepcopy(tree))
        yield _in_bytes(rng, bytearray(plain), stating)


def _in_tree(rng: np.random.Generator, root: ET.Element) -> bytes:
    for _ in range(rng.integers(1, 3)):
        owners = [element for element in root.iter() if len(element)]
        owner = owners[rng.integers(len(owners))]
        place = int(rng.integers(len(owner)))
        child = owner[place]
        match rng.integers(6):
            case 0:
                owner.remove(child)
            case 1:
                owner.insert(int(rng.integers(len(owner) + 1)), copy.deepcopy(child))
            case 2:
                child.tag = (
                    f"{DCC if rng.random() < 0.5 else SI}{rng.choice(['text', 'other', 'real', 'data'])}"
                )
            case 3:
                owner.remove(child)
                owner.append(child)
            case 4:
                child.text = ""
            case 5:
                other = owners[rng.integers(len(owners))]
                other.append(copy.deepcopy(child))
    return ET.tostring(root)


def _in_bytes(rng: np.random.Generator, content: bytearray, stating: list[range]) -> bytes:
    places = [place for place in range(len(content)) if not any(place in span for span in stating)]
    match rng.integers(3):
        case 0:
            for place in rng.choice(places, rng.integers(1, 4)):
                content[place] = rng.integers(256)
        case 1:
            del content[int(rng.choice(places)) :]
        case 2:
            place = int(rng.choice(places))
            content[place:place] = rng.choice([b"<!DOCTYPE a [<!ENTITY b 'c'>]>", b"&b;", b"<", b"\0", b"9"])
    return bytes(content)


def judged(count: int, seed: int) -> tuple[int, int, list[bytes]]:
    """How many were refused and read the same, and those that were read as other numbers."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "c.xml"
        path.write_text(CERTIFICATE)
        wanted = numbers(path)
        refused, same, others = 0, 0, []
        for content, _ in zip(mutations(seed), range(count), strict=False):
            path.write_bytes(content)
            try:
                stated = numbers(path)
            except UnitError as error:
                refused += bool(error.what)
                continue
            if stated == wanted:
                same += 1
            else:
                others.append(content)
    return refused, same, others


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    refused, same, others = judged(options.count, options.seed)
    print(f"{options.count} certificates: {refused} refused, {same} the same numbers, {len(others)} others")
    for content in others[:3]:
        print(content.decode(errors="replace"))
    raise SystemExit(1 if others else 0)


if __name__ == "__main__":
    main()
