"""The section on measurements: every response and all spectra with their quality and figures."""

from __future__ import annotations

from labpipe.records.identification import Identification
from labpipe.report import figures
from labpipe.report.channel_figures import channel_blocks
from labpipe.report.document import Block, Paragraph, Section
from labpipe.report.spectral_figures import spectral_blocks


def measurement_sections(identification: Identification) -> tuple[Section, ...]:
    """One section with all measured responses and spectra, if there are any."""
    measured = identification.responses or identification.spectra
    return (Section("Measurement", _measurement(identification)),) if measured else ()


def _measurement(identification: Identification) -> tuple[Block, ...]:
    blocks: list[Block] = []
    for response in identification.responses:
        sides = "responses x bases" if response.form == "transmissibility" else "responses x forces"
        size = f"{len(response.outputs)} x {len(response.inputs)} ({sides}), {response.n_frequency} lines"
        averages = f"{response.averages:.4g} effective averages"
        blocks.append(Paragraph(f"{response.name or 'Measurement'}: {response.form}, {size}, {averages}."))
        blocks.append(figures.response_figure(response))
        blocks.extend(spectral_blocks(response))
    for spectra in identification.spectra:
        blocks.extend(channel_blocks(spectra))
    return tuple(blocks)
