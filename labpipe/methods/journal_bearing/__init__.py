"""Journal bearings: the oil film by finite volumes, its coefficients, tables and curves."""
