"""Journal coefficients from the run-ups of a rotor: settings, methods, metamodels, predictions."""
