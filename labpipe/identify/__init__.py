"""Stiffness and damping from frequency responses: models, estimators, their intervals, and whether to believe them."""
