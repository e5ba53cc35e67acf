"""Tables of comparisons band by band, and of correlations between fitted unknowns."""

from __future__ import annotations

from labpipe.display import written
from labpipe.quantities import display_unit, to_display
from labpipe.records.comparison import ComparedBand, Comparison
from labpipe.records.finding import WARNING, of_level
from labpipe.report.document import Block, Paragraph, Table
from labpipe.report.wording import unit_text


def loop_blocks(comparison: Comparison) -> list[Block]:
    """Correlations of fitted unknowns, and the bands."""
    blocks: list[Block] = []
    warnings = of_level(WARNING, comparison.findings)
    if warnings:
        blocks.append(Paragraph(f"{'; '.join(f'{finding.code}: {finding.message}' for finding in warnings)}.", "warning"))
    if comparison.correlations:
        rows = tuple((first, second, f"{value:+.3f}") for first, second, value in comparison.correlations)
        blocks.append(Table(("unknown", "and", "correlation"), rows, f"Correlation of the unknowns of {comparison.name}", (2,)))
    # Fitted unknowns are judged by their errors; the bands of the loop as stated belong to a comparison without them.
    if comparison.bands and not comparison.correlations:
        blocks.extend(_band_table(comparison, name) for name in dict.fromkeys(band.parameter for band in comparison.bands))
    return blocks


def _band_table(comparison: Comparison, name: str) -> Table:
    """A row for every band and test: value, interval, reference value, ratio; * where they differ."""
    bands = [band for band in comparison.bands if band.parameter == name]
    several = not bands[0].p_value and len({band.test for band in bands}) > 1
    tested = bands[0].p_value is not None
    other, last = ("the other test", ("p-value, corrected",)) if tested else ("predicted", ())
    header = (f"{name} [{unit_text(bands[0].unit)}]", "95 % interval", other, "ratio with 95 % interval", *last)
    first = ("test", "band [Hz]") if several else ("band [Hz]",)
    rows = tuple(_row(band, several) for band in bands)
    meaning = f"{bands[0].test}" if tested else "* where the 95 % interval does not hold the prediction"
    caption = f"{name} in the bands of {comparison.name}; {meaning}"
    return Table((*first, *header), rows, caption, tuple(range(len(first), len(first) + len(header))))


def _row(band: ComparedBand, several: bool) -> tuple[str, ...]:
    unit = display_unit(band.unit)
    value, low, high, other = (to_display(amount, unit) for amount in (band.value, *band.ci95, band.other))
    error = abs(high - low) / 4
    mark = "" if band.holds or band.p_value is not None else " *"
    last = () if band.p_value is None else (f"{band.p_value:.2g}",)
    ends = "" if band.ratio_ci95 is None else f" ({band.ratio_ci95[0]:.3f} to {band.ratio_ci95[1]:.3f})"
    ratio = "" if band.ratio is None else f"{band.ratio:.3f}{ends}"
    first = (*([band.test] if several else []), f"{band.band_hz[0]:g}-{band.band_hz[1]:g}")
    shown, _, lower, upper, reference = written(value, error, low, high, other)
    return (*first, shown + mark, f"{lower} to {upper}", reference, ratio, *last)
