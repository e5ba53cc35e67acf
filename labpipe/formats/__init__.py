"""Foreign files at the edge: READERS by suffix."""
