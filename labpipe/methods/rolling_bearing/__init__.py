"""Ball and roller bearings: stiffness after Lim and Singh, a shaft on one of them, and tests against this
theory.
"""
