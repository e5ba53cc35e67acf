"""Other libraries' views of a record, made above the records and loaded when they are asked for. VIEWS by name."""

from __future__ import annotations

from labpipe.registry import Registry

VIEWS = Registry(
    "view",
    {
        "frame": "labpipe.scripting.frames:to_frame",
        "xarray": "labpipe.scripting.frames:to_xarray",
    },
)
