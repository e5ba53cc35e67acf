"""Campaigns: fits of tests that differ in a condition, held against each other and against a theory."""
