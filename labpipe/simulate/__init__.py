"""Virtual rigs: recordings and frequency responses of rigs whose coefficients are known."""
