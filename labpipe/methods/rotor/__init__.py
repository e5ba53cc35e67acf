"""Rotors on their bearings: Timoshenko shafts, response, modes, stability, unbalance."""
