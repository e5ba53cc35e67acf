"""Magnetic bearings: coefficients of magnets and loops from tests, predictions, certificates, rigs."""
