"""The section on measurements: every response with its quality and spectral figures."""

from __future__ import annotations

from labpipe.records.identification import Identification
from labpipe.report import figures
from labpipe.report.document import Block, Paragraph, Section
from labpipe.report.spectral_figures import spectral_blocks


def measurement_sections(identification: Identification) -> tuple[Section, ...]:
    """One section with all measured responses, if there are any."""
    return (Section("Measurement", _measurement(identification)),) if identification.responses else ()


def _measurement(identification: Identification) -> tuple[Block, ...]:
    blocks: list[Block] = []
    for response in identification.responses:
        size = f"{len(response.outputs)} x {len(response.inputs)} (responses x forces), {response.n_frequency} lines"
        averages = f"{response.averages:.4g} effective averages"
        blocks.append(Paragraph(f"{response.name or 'Measurement'}: {response.form}, {size}, {averages}."))
        blocks.append(figures.response_figure(response))
        blocks.extend(spectral_blocks(response))
    return tuple(blocks)
