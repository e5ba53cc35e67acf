"""Results as tables: pandas data frames, and responses as xarray data sets where xarray is installed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from labpipe.errors import ConfigError
from labpipe.records.identification import Fit, Identification
from labpipe.records.listed import ListedParameter, listed_parameters, of_fit
from labpipe.records.recording import Recording
from labpipe.records.response import FrequencyResponse

if TYPE_CHECKING:
    import xarray


def to_frame(record: Fit | Identification | FrequencyResponse | Recording) -> pd.DataFrame:
    """Parameters of a fit or of a whole result, one row each; a response over frequency [Hz]; a recording over time [s]. SI units.

    A response has for every element the columns ``o/i``, complex, and ``o/i:std``, its standard deviation, where the noise is known.
    """
    if isinstance(record, Fit):
        return pd.DataFrame([_row(listed) for listed in of_fit(record)])
    if isinstance(record, Identification) and record.dataset is not None:
        raise ConfigError("the numbers of so many tests stand in a dataset", hint="pandas.read_parquet('OUT/dataset') reads it")
    if isinstance(record, Identification):
        return pd.DataFrame([_row(listed) for listed in listed_parameters(record)])
    if isinstance(record, FrequencyResponse):
        return _response_frame(record)
    if isinstance(record, Recording):
        time = pd.Index(np.arange(record.n_sample) / record.sample_rate, name="time [s]")
        return pd.DataFrame(record.samples, index=time, columns=[f"{channel.name} [{channel.unit}]" for channel in record.channels])
    raise ConfigError(f"a {type(record).__name__} has no table", hint="a fit, a result, a response or a recording has")


def _row(listed: ListedParameter) -> dict[str, Any]:
    parameter = listed.parameter
    low, high = parameter.ci95 or (None, None)
    return {
        **{name: getattr(listed, name) for name in ("fit", "test", "term", "model", "estimator")},
        **{"low_hz": listed.band_hz[0], "high_hz": listed.band_hz[1]},
        **{"parameter": parameter.name, "value": parameter.value, "unit": parameter.unit, "std_error": parameter.std_error},
        **{"ci_low": low, "ci_high": high, "significant": parameter.significant, "derived": parameter.derived},
        "warnings": ", ".join(listed.warnings),
    }


def _response_frame(response: FrequencyResponse) -> pd.DataFrame:
    columns: dict[str, Any] = {}
    for o, output in enumerate(response.outputs):
        for i, force in enumerate(response.inputs):
            columns[f"{output.label}/{force.label}"] = response.matrix[:, o, i]
            if response.variance is not None:
                columns[f"{output.label}/{force.label}:std"] = np.sqrt(response.variance[:, o, i])
    return pd.DataFrame(columns, index=pd.Index(response.frequency, name="frequency [Hz]"))


def to_xarray(response: FrequencyResponse) -> xarray.Dataset:
    """The response over frequency, output and input, with variance and coherence where they are known.

    ConfigError where xarray is not installed.
    """
    try:
        import xarray
    except ImportError:
        raise ConfigError("to_xarray needs the package xarray", hint="pip install xarray") from None
    dims = ("frequency", "output", "input")
    variables = {"response": response.matrix, "variance": response.variance, "coherence": response.coherence}
    coords = {
        "frequency": response.frequency,
        "output": [port.label for port in response.outputs],
        "input": [port.label for port in response.inputs],
    }
    present = {name: (dims, values) for name, values in variables.items() if values is not None}
    return xarray.Dataset(present, coords, {"form": response.form, "name": response.name, **response.conditions})
