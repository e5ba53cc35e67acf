"""Theory of bearings: stiffness and damping from geometry, load and speed. Pure functions of arrays and frozen records."""
