"""Magnetic bearings: magnet and control-loop coefficients from tests, predictions, certificates, and virtual
rigs.
"""
