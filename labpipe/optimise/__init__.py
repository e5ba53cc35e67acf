"""Optimisers that know no physics: Levenberg-Marquardt, pattern search."""
