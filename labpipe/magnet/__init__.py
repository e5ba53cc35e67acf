"""Magnets of a bearing: force per current and stiffness of the bias field, from currents and displacements in a closed loop."""
