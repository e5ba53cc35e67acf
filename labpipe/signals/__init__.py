"""Signals in time: test signals that excite a rig, and what a recording shows before it is transformed."""
