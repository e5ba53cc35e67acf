"""File formats of other programs. READERS by suffix."""
