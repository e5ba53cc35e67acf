"""The command line: one module per command, what they share, and how they end."""
