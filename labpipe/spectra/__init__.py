"""From samples to spectra and frequency responses with their covariance, for every kind of excitation."""
