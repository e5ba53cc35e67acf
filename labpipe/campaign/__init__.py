"""Campaigns: comparison of fits of tests that differ in a condition, with each other and with a theory."""
