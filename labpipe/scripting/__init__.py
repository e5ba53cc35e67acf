"""What scripts and notebooks call: files read and pipelines run through one door, things by name, results as tables."""
