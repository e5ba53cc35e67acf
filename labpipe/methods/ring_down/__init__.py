"""Free decays: natural frequency and damping of a few modes by maximum likelihood in the time domain."""
