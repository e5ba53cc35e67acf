"""Reciprocity of every test: H_ij = H_ji within the standard errors."""

from __future__ import annotations

from collections.abc import Sequence

from labpipe.campaign.amounts import chance
from labpipe.campaign.settings import CompareSettings
from labpipe.errors import DataError
from labpipe.records.comparison import ComparedPoint, Comparison
from labpipe.records.identification import Parameter
from labpipe.records.response import FrequencyResponse
from labpipe.spectra.reciprocity import reciprocity

# Relative rms difference beyond which both are noise: the dofs are not coupled.
UNCOUPLED = 0.7


def reciprocal(settings: CompareSettings, responses: Sequence[FrequencyResponse]) -> Comparison:
    """Every pair of dofs in every test with its p-value; the verdict takes the smallest one times their number (Bonferroni).

    The largest relative difference is that of coupled pairs. DataError without a response that can be tested. Equation (comp-reciprocity).
    """
    points = [
        ComparedPoint(response.name, pair.difference, group=f"{pair.first}-{pair.second}", p_value=pair.p_value)
        for response in responses
        for pair in reciprocity(response)
    ]
    if not points:
        raise DataError("there is no response whose reciprocity can be tested")
    least = min(point.p_value for point in points if point.p_value is not None)
    p_value = min(1.0, least * len(points))
    coupled = [point.value for point in points if point.value < UNCOUPLED]
    largest = max(coupled) if coupled else float("nan")
    verdict = "not reciprocal" if p_value < settings.level else "reciprocal"
    coupled_text = f"coupled pairs differ by at most {100 * largest:.2g} % rms" if coupled else "no pair is coupled above the noise"
    count = f"{len(points)} pair(s) of dofs in {len(responses)} test(s), {len(coupled)} of them coupled"
    return Comparison(
        name=settings.name,
        kind="reciprocity",
        subject="|H_ij - H_ji| / |H|",
        unit="1",
        points=tuple(points),
        amounts=(chance("p_value", p_value), Parameter("difference", largest, "1", derived=True)),
        verdict=verdict,
        statement=f"{count}; {coupled_text}: {verdict} (p = {p_value:.2g}, corrected for the number of pairs).",
    )
