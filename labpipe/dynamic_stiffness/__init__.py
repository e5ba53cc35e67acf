"""Floating bearing: the dynamic stiffness of a seal or bearing from forces on its stator, every channel taken as noisy."""
