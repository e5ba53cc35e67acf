"""Views of a record for other libraries, loaded on first use. VIEWS by name."""

from __future__ import annotations

from labpipe.registry import Registry

VIEWS = Registry(
    "view",
    {
        "frame": "labpipe.scripting.frames:to_frame",
        "xarray": "labpipe.scripting.frames:to_xarray",
    },
)
