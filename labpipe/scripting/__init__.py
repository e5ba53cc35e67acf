"""Interface for scripts and notebooks: read files, run pipelines, bearings and rotors by name, results as tables."""
