"""Monte Carlo studies: errors and coverage of a pipeline's fits on a virtual rig."""
