"""Monte Carlo studies: how near to the truth, and how sure of it, a pipeline's fits are on a virtual rig."""
