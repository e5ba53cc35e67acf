"""What tests say together: comparisons, matrices of conditions, Monte Carlo studies, control limits and
trends.
"""
