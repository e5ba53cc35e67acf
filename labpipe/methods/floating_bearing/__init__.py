"""Floating bearings: the dynamic stiffness of a seal or bearing from forces on its stator."""
