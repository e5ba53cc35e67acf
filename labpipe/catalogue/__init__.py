"""Catalogue of a results folder: an index of every identification.json below it, and queries."""
