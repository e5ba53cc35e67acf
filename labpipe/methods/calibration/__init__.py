"""Calibration lines of sensors, actuators and preloads."""
