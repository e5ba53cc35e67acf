"""Writes pedestal.r16: the sample recording of the pedestal as the small logger would have stored it."""

import json
import sys

import numpy as np
import pandas as pd

columns = pd.read_csv("sample_data/hmb/pedestal.csv", comment="#")
force, probe = columns["force [N]"].to_numpy(), columns["y [V]"].to_numpy()
scales = [float(np.max(np.abs(values))) / 32000 for values in (force, probe)]
channels = [
    {"name": name, "unit": unit, "scale": scale}
    for name, unit, scale in zip(("force", "y"), ("N", "V"), scales, strict=True)
]
head = {"rate_hz": 1000, "channels": channels}
samples = np.round(np.column_stack([force / scales[0], probe / scales[1]])).astype("<i2")
with open(sys.argv[1], "wb") as stream:
    stream.write(json.dumps(head).encode() + b"\n" + samples.tobytes())
