"""Responses with a known covariance as estimators read them."""

from __future__ import annotations

import numpy as np

from labpipe.estimation.measured import Measured
from labpipe.records.response import FrequencyResponse


def measured(response: FrequencyResponse) -> Measured:
    return Measured(
        omega=2 * np.pi * response.frequency,
        matrix=response.matrix,
        covariance=response.covariance,
        noise_dof=np.inf,
        noise_lines=1.0,
        outputs=response.outputs,
        inputs=response.inputs,
    )
