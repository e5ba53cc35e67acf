"""The things that flow: frozen, read-only, checked at birth, computing nothing."""
