"""Tests planned before they are made: signals, conditions and runs that determine what is wanted best."""
