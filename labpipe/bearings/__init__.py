"""Bearings of any kind: what a kind states, its coefficients, and how it stands on a rotor."""
