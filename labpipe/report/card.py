"""The card of a file: its entries, levels, findings, and a small plot of every channel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from labpipe import __version__
from labpipe.records.finding import Finding
from labpipe.records.recording import ChannelOverview, Overview
from labpipe.records.response import FORMS, FrequencyResponse
from labpipe.records.spectra import ChannelSpectra
from labpipe.report.chart import PALETTE_SIZE, WIDTH, Axis, Chart, Panel, curve, dots, stack
from labpipe.report.document import Block, Document, Figure, Paragraph, Section, Table
from labpipe.report.figures import PHASE, element_names, over_frequency, phase_degrees, response_figure
from labpipe.report.measurement import channel_blocks, spectral_blocks

# Height of a channel's two plots side by side [in].
HEIGHT = 2.1
# Lower end of a spectrum's axis relative to its largest line: smaller lines are rounding.
DEEPEST = 1e-7
# Ends of the axis of a phase [deg].
PHASE_END = 185.0


def recording_card(overview: Overview) -> Document:
    """The card of a recording or a raw file."""
    sections = (
        Section("The file", _facts(overview)),
        Section("Findings", _findings(overview.findings, "No gaps, no clipping, no constant channel.")),
        *_against_the_rig(overview.contradictions),
        Section("Levels", (_levels(overview.plotted),)),
        Section("Channels", tuple(channel_figure(channel, overview) for channel in overview.plotted)),
    )
    return _card(overview.file, overview.kind.capitalize(), sections)


def response_card(response: FrequencyResponse, file: str) -> Document:
    """The card of a file that holds FRFs."""
    shown = (response_figure(response), phase_figure(response), *spectral_blocks(response))
    sections = (
        Section("The file", _response_facts(response, file)),
        Section("Findings", _content_blocks(response.findings)),
        Section("Frequency response", shown),
    )
    return _card(file, "Frequency response", sections)


def spectra_card(spectra: ChannelSpectra, file: str) -> Document:
    """The card of a file that holds spectra of all channels."""
    sections = (
        Section("The file", (Paragraph(f"File {file}, test {spectra.name or '(without a name)'}."),)),
        Section("Findings", _content_blocks(spectra.findings)),
        Section("Spectra of all channels", channel_blocks(spectra)),
    )
    return _card(file, "Spectra of all channels", sections)


def _card(file: str, kind: str, sections: tuple[Section, ...]) -> Document:
    return Document(file, f"{kind}, read by labpipe {__version__}", sections, to_sign=False)


def _facts(overview: Overview) -> tuple[Block, ...]:
    length, rate = "not known", overview.rate
    if overview.sample_rate is not None:
        length = f"{overview.n_sample / overview.sample_rate:.6g} s"
        rate = rate if "Hz" in rate else f"{overview.sample_rate:g} Hz ({rate})"
    rows = [("samples per channel", str(overview.n_sample)), ("rate", rate), ("length", length)]
    if overview.time:
        rows.append(("time column", overview.time))
    channels = tuple(
        (channel.name, channel.unit or "not stated", channel.about) for channel in overview.plotted
    )
    return (
        Table(("what", "which"), tuple(rows), "Entries of the file"),
        Table(("channel", "unit", "role and direction"), channels, "Channels"),
    )


def _response_facts(response: FrequencyResponse, file: str) -> tuple[Block, ...]:
    frequency = response.frequency
    uncertainties = [name for name in ("covariance", "coherence") if getattr(response, name) is not None]
    neither = "neither covariance nor coherence: ml needs one, ls does not"
    rows = (
        ("file", file),
        ("form", f"{response.form} [{FORMS[response.form]}]"),
        ("lines", f"{frequency.size}, {frequency[0]:g} to {frequency[-1]:g} Hz"),
        ("averages", f"{response.averages:.4g}" if response.averages > 1 else "1, or not stated"),
        ("uncertainty", " and ".join(uncertainties) or neither),
    )
    drive = "base" if response.form == "transmissibility" else "force"
    kinds = [("response", port) for port in response.outputs] + [(drive, port) for port in response.inputs]
    ports = tuple(
        (kind, port.label, port.dof, "" if port.angle is None else f"{np.degrees(port.angle):g}")
        for kind, port in kinds
    )
    return (
        Table(("what", "which"), rows, "Entries of the file"),
        Table(("kind", "label", "dof", "angle [deg]"), ports, "Rows and columns of the matrix", (3,)),
    )


def _findings(findings: Sequence[Finding], nothing: str, kind: str = "passed") -> tuple[Block, ...]:
    if not findings:
        return (Paragraph(nothing, kind),)
    return tuple(Paragraph(f"{finding.code}: {finding.message}", finding.level) for finding in findings)


def _content_blocks(findings: Sequence[Finding]) -> tuple[Block, ...]:
    """What the file says of itself: that it says nothing is not a test that was passed."""
    return _findings(findings, "The file carries no warnings; nothing was checked here.", "note")


def _against_the_rig(contradictions: Sequence[str] | None) -> tuple[Section, ...]:
    if contradictions is None:
        return ()
    agreement = Paragraph("File and rig file agree in columns, units and rate.", "passed")
    blocks = tuple(Paragraph(sentence, "failed") for sentence in contradictions) or (agreement,)
    return (Section("Against the rig file", blocks),)


def _levels(channels: Sequence[ChannelOverview]) -> Table:
    rows = tuple(
        (
            channel.label,
            *(f"{value:.5g}" for value in (channel.minimum, channel.maximum, channel.mean, channel.rms)),
            _crest(channel),
        )
        for channel in channels
    )
    header = ("channel", "min", "max", "mean", "rms (ac)", "peak / rms")
    return Table(header, rows, "Levels, in the unit of the channel; rms is about the mean", (1, 2, 3, 4, 5))


def _crest(channel: ChannelOverview) -> str:
    """Crest factor about the mean; many noise-like signals have 4, hits far more, a sine 1.41."""
    peak = max(channel.maximum - channel.mean, channel.mean - channel.minimum)
    return f"{peak / channel.rms:.3g}" if channel.rms > 0 else ""


def channel_figure(channel: ChannelOverview, overview: Overview) -> Figure:
    """Envelope over time beside the spectrum of one channel."""
    panels = (_envelope(channel, overview.sample_rate), _spectrum(channel, overview.sample_rate))
    step, blocks = channel.envelope.step, channel.spectrum.blocks
    stretch = f", smallest and largest of every {step} samples" if step > 1 else ""
    averaged = f"mean of {blocks} block{'s' if blocks > 1 else ''}" if blocks else "no block without gaps"
    caption = f"{channel.label}: the signal over time{stretch}; its spectrum, {averaged}."
    chart = Chart(panels, 1, 2, (WIDTH, HEIGHT), legend="none")
    return Figure(chart, caption, f"{channel.label} over time and its spectrum")


def _envelope(channel: ChannelOverview, rate: float | None) -> Panel:
    envelope = channel.envelope
    starts = np.arange(envelope.low.size) * envelope.step / (rate or 1.0)
    x = Axis("time", "s") if rate else Axis("sample")
    y = Axis(channel.name, "" if channel.unit in channel.name else channel.unit)
    if envelope.step == 1:
        return Panel(x, y, (curve("signal", starts, envelope.low, width=0.8),))
    both = np.column_stack([envelope.low, envelope.high]).reshape(-1)
    return Panel(x, y, (curve("signal", np.repeat(starts, 2), both, width=0.6),))


def _spectrum(channel: ChannelOverview, rate: float | None) -> Panel:
    spectrum = channel.spectrum
    largest = float(np.max(spectrum.density, initial=0.0))
    density = np.maximum(spectrum.density, DEEPEST * largest)
    x = Axis("frequency", "Hz" if rate else "cycles per sample")
    y = Axis(
        "spectrum" if rate else "root of the density",
        f"{channel.unit or 'unit'}/Hz^0.5" if rate else "",
        logarithmic=largest > 0,
    )
    return Panel(x, y, (curve("spectrum", spectrum.frequency, density, 1, width=0.8),))


def phase_figure(response: FrequencyResponse) -> Figure:
    """The phase of every element over frequency."""
    phase = phase_degrees(response.matrix)
    series = [
        dots(name, response.frequency, phase[:, o, i], number % PALETTE_SIZE, size=1.0)
        for number, (o, i, name) in enumerate(element_names(response))
    ]
    ticks = tuple((float(angle), str(angle)) for angle in range(-180, 181, 90))
    y = Axis(PHASE.title, PHASE.unit, -PHASE_END, PHASE_END, ticks=ticks)
    chart = stack([over_frequency(y, series)], 2.4)
    return Figure(chart, f"Phase of the {response.form}.", f"Phase of the {response.form} over frequency")
