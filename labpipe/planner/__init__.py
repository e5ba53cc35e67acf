"""Excitations planned before a test: which force spectrum determines the wanted coefficients best within the limits of the rig."""
