"""One rotor, all its tests: unknowns of shaft, sleeves, bearings and unbalance from every measurement."""
