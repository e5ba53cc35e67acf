"""The plant for robust control design: nominal response, the band that holds the true one, the weight."""

from __future__ import annotations

import numpy as np

from labpipe.records.fit_details import FitDetailKind, RobustPlant
from labpipe.records.identification import Fit
from labpipe.report.chart import PALETTE_SIZE, Axis, Series, curve, stack
from labpipe.report.document import Block, Figure, Paragraph
from labpipe.report.figures import over_frequency
from labpipe.report.wording import fit_title


def robust_blocks(fit: Fit, plant: RobustPlant) -> list[Block]:
    size: list[Series] = []
    weights: list[Series] = []
    pairs = [(o, i) for o in range(len(plant.outputs)) for i in range(len(plant.inputs))]
    for number, (o, i) in enumerate(pairs):
        label, colour = f"{plant.outputs[o]}/{plant.inputs[i]}", number % PALETTE_SIZE
        nominal, radius = 1e6 * np.abs(plant.nominal[:, o, i]), 1e6 * plant.radius[:, o, i]
        low = np.maximum(nominal - radius, 1e-2 * nominal)
        size.append(
            curve(label, plant.frequency, nominal, colour, band=(low, nominal + radius), opacity=0.25)
        )
        weights.append(curve(f"{label} weight", plant.frequency, plant.weight[:, o, i], colour))
        bound = plant.bound(o, i)
        weights.append(curve(f"{label} overbound", plant.frequency, bound, colour, "--", width=0.9))
    panels = (
        over_frequency(Axis("displacement per current", "um/A", logarithmic=True), size, 3.0),
        over_frequency(Axis("weight", "1", logarithmic=True), weights, 2.0),
    )
    confidence = f"{100 * plant.confidence:g} %"
    title = fit_title(fit)
    what = f"{title}: nominal plant and the band that holds the true one at all lines ({confidence})"
    sentence = (
        "For robust control design: the true plant lies within the radius around the nominal one at all "
        f"lines together with {confidence}, the smallest band that covers the measured scatter. `labpipe "
        "export` writes it as `band` (CSV) and with the state space as `plant` (MATLAB file)."
    )
    return [
        Paragraph(sentence, "note"),
        Figure(
            stack(panels, 5.0), f"{what}; weight: radius / |G|.", f"Nominal plant of {title} with its band"
        ),
    ]


ROBUST_DETAIL = FitDetailKind(RobustPlant, robust_blocks)
