"""A rotor on its bearings: unbalance, forward response, critical and threshold speeds."""
