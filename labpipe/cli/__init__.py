"""The command line: a lazy group of commands, what they share, and how they end."""
