"""Wear of a journal bearing from the response of its rotor."""
