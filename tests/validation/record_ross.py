"""Records what ROSS makes of `peer_inputs`: `python -m tests.validation.record_ross`, in an environment with
ross-rotordynamics.

labpipe is not needed there, and nothing of it is imported. The rows compute labpipe's side anew each time.
"""

from __future__ import annotations

import json
import sys
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock

import numpy as np

from tests.validation import peer_inputs as given

FILE = Path(__file__).parent / "recorded/ross.json"
RPM = np.pi / 30


def ross() -> ModuleType:
    """ROSS imports a compressor library for its labyrinth seals, which nothing here uses and which needs a
    licence of its own.
    """
    sys.modules.setdefault("ccp", MagicMock())
    import ross

    return ross


def rotor(rs: ModuleType, stiffness: tuple[float, float, float]) -> Any:
    material = rs.Material(
        "given", rho=given.MATERIAL["density"], E=given.MATERIAL["elastic"], G_s=given.MATERIAL["shear"]
    )
    shaft = [
        rs.ShaftElement(L=given.SHAFT["element"], idl=0, odl=given.SHAFT["diameter"], material=material)
        for _ in range(int(given.SHAFT["number"]))
    ]
    discs = [
        rs.DiskElement.from_geometry(n=node - 1, material=material, width=length, i_d=inner, o_d=outer)
        for node, inner, outer, length in given.DISCS
    ]
    k_x, k_y, c = stiffness
    bearings = [
        rs.BearingElement(n=n, kxx=k_x, kyy=k_y, cxx=c, cyy=c) for n in (0, int(given.SHAFT["number"]))
    ]
    return rs.Rotor(shaft, discs, bearings)


def lateral(modes: Any, n: int) -> tuple[list[float], list[float]]:
    """Damped frequencies [Hz] and logarithmic decrements of the first lateral modes.

    Axial and torsional ones move no y.
    """
    dofs = modes.number_dof
    shapes = np.abs(modes.modal if hasattr(modes, "modal") else modes.evectors)[
        : dofs * (int(given.SHAFT["number"]) + 1)
    ]
    across = np.isin(np.arange(shapes.shape[0]) % dofs, (0, 1, 3, 4) if dofs == 6 else range(4))
    keep = [
        i
        for i in range(len(modes.wd))
        if i < shapes.shape[1] and shapes[across, i].max() > 1e-6 * shapes[:, i].max()
    ]
    return (np.asarray(modes.wd)[keep][:n] / (2 * np.pi)).tolist(), np.asarray(modes.log_dec)[keep][
        :n
    ].tolist()


def unbalance(whole: Any) -> list[list[float]]:
    """Amplitudes [m] in the two directions at the output node, by speed."""
    speeds = np.array(given.UNBALANCE["rpm"]) * RPM
    response = whole.run_unbalance_response(given.UNBALANCE["node"] - 1, given.UNBALANCE["size"], 0.0, speeds)
    first = whole.number_dof * (given.UNBALANCE["output"] - 1)
    return np.abs(response.forced_resp[first : first + 2]).T.tolist()


def short_bearing(rs: ModuleType) -> dict[str, float]:
    inputs = given.SHORT
    bearing = rs.CylindricalBearing(
        n=0,
        speed=np.array([inputs["rpm"]]) * RPM,
        weight=inputs["load"],
        bearing_length=inputs["length"],
        journal_diameter=inputs["diameter"],
        radial_clearance=inputs["clearance"],
        oil_viscosity=inputs["viscosity"],
    )
    names = ("kxx", "kxy", "kyx", "kyy", "cxx", "cxy", "cyx", "cyy", "eccentricity")
    return {name: float(np.ravel(getattr(bearing, name))[0]) for name in names}


def main() -> None:
    rs = ross()
    recorded: dict[str, Any] = {
        "program": f"ROSS {version('ross-rotordynamics')}",
        "command": "python -m tests.validation.record_ross",
    }
    recorded["modes"] = {}
    for name, stiffness in given.SUPPORTS.items():
        whole = rotor(rs, stiffness)
        for rpm in given.RPM:
            frequency, decrement = lateral(whole.run_modal(rpm * RPM, num_modes=24), 8)
            recorded["modes"][f"{name}, {rpm:.0f} rpm"] = {"frequency": frequency, "log decrement": decrement}
    recorded["unbalance"] = unbalance(rotor(rs, given.SUPPORTS["orthotropic"]))
    recorded["short bearing"] = short_bearing(rs)
    FILE.write_text(json.dumps(recorded, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
