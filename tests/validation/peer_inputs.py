"""Inputs that labpipe and programs recorded elsewhere are both given: plain numbers, so that neither needs
the other installed.
"""

from __future__ import annotations

# The two-disc rotor of ROSS's tutorial, after Friswell et al. (2010): six elements, discs on the third and
# fifth node, two bearings.
SHAFT = {"element": 0.25, "diameter": 0.05, "number": 6}
MATERIAL = {"density": 7810.0, "elastic": 211e9, "shear": 81.2e9}
# Node from 1, inner and outer diameter, length [m].
DISCS = ((3, 0.05, 0.28, 0.07), (5, 0.05, 0.35, 0.07))
# k horizontal and vertical [N/m], c [N s/m].
SUPPORTS = {"isotropic": (1e6, 1e6, 0.0), "orthotropic": (1e6, 0.8e6, 100.0)}
RPM = (0.0, 4000.0)
UNBALANCE = {"node": 3, "size": 1e-3, "rpm": (500.0, 1000.0, 2000.0, 4000.0), "output": 3}
# The short journal bearing of Friswell et al., example 5.5.1: N, m, Pa s, rpm.
SHORT = {"load": 525.0, "length": 0.03, "diameter": 0.1, "clearance": 1e-4, "viscosity": 0.1, "rpm": 1500.0}
