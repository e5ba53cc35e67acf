"""Tests planned before they are made: signals, operating conditions and runs that determine the wanted
coefficients best.
"""
