"""A whole project: YAML files to parameters, one way through a run for one test or 100,000, rules, results,
catalogue, archive.
"""
