"""The estimation kernel: models linear in their parameters, estimators, judgement of the residual, intervals
and budgets.
"""
