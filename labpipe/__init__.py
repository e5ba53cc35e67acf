"""labpipe: from recorded test-rig runs to stiffness and damping with their doubt."""

__version__ = "0.1.0"
