"""A whole pipeline: its tests one by one or side by side, then the stages that need them all."""
