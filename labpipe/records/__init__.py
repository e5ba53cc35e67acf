"""Records between the stages: frozen, read-only, checked at construction, without computations."""
