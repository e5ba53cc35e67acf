"""The drawing of a rotor stands where its file says, each rotor once."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from labpipe.methods.rotor.rotor_file import load_rotor
from labpipe.methods.rotor.section import (
    UnbalanceRuns,
    bearing_dimensions,
    disc_dimensions,
    node_positions,
    rotor_figure,
    rotor_figures,
    rotor_rings,
    shaft_diameter,
)
from labpipe.methods.rotor.shaft import ALUMINIUM, Disc
from labpipe.records.identification import Identification
from labpipe.report.build import build
from labpipe.report.chart import Chart
from labpipe.report.document import Figure

ROTORS = Path(__file__).parents[3] / "configs" / "rotors"


def entries(name: str) -> dict[str, Any]:
    """A rotor file as identification.json holds it."""
    found: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(load_rotor(ROTORS / f"{name}.yaml"))))
    return found


def boxes(name: str, label: str) -> list[tuple[float, float, float, float]]:
    """(left, bottom, width, height) [mm] of the drawn boxes of one kind."""
    chosen = [ring for ring in rotor_rings(entries(name)) if ring.part == label]
    return [(ring.left, bottom, ring.length, height) for ring in chosen for bottom, height in ring.boxes]


def test_shaft_is_drawn_element_by_element_in_mm() -> None:
    """Lengths and diameters of the rotor file; its total of 590 mm is their sum by hand."""
    shaft = boxes("mendes", "shaft")
    assert len(shaft) == 15
    assert shaft[0] == pytest.approx((0.0, -6.0, 60.0, 12.0)) and shaft[2] == pytest.approx(
        (120.0, -15.5, 10.0, 31.0)
    )
    assert shaft[-1][0] + shaft[-1][2] == pytest.approx(590.0)


def test_sleeves_lie_around_their_elements() -> None:
    above, below = boxes("mendes", "sleeve")[:2]
    assert above == pytest.approx((360.0, 15.0, 40.0, 5.0)) and below == pytest.approx(
        (360.0, -20.0, 40.0, 5.0)
    )


def test_bearings_are_centred_on_their_nodes_with_their_length() -> None:
    bearings = boxes("mendes", "bearing")
    assert [round(left + width / 2, 6) for left, _, width, _ in bearings[::2]] == [130.0, 550.0]
    assert all(width == pytest.approx(18.0) for _, _, width, _ in bearings)
    assert bearings[0][1] == pytest.approx(15.5)


@pytest.mark.parametrize(
    ("bearing", "size"),
    [
        ({"diameter": 0.031, "length": 0.018}, (0.031, 0.018)),
        ({"settings": {"diameter": 0.05, "length": 0.006}}, (0.05, 0.006)),
        ({"settings": {"elements": 9}}, (0.02, 0.01)),
        ({"settings": {"diameter": None, "length": None}}, (0.02, 0.01)),
    ],
)
def test_a_bearing_without_size_is_drawn_round_the_shaft(
    bearing: dict[str, Any], size: tuple[float, float]
) -> None:
    """On a shaft of 20 mm: its bore, and half of it along the shaft.

    The entries of kinds other than films stand under settings.
    """
    assert bearing_dimensions(bearing, 0.02) == size


def test_disc_of_the_laval_rotor_has_the_size_of_its_file() -> None:
    """90 mm by 20 mm in the file; the drawing knows mass and inertia only."""
    left, bottom, width, height = boxes("laval", "disc")[0]
    assert (left, bottom, width, height) == pytest.approx((325.0, 7.5, 20.0, 37.5))


def test_disc_dimensions_turn_the_formulas_of_the_cylinder_round() -> None:
    disc = dataclasses.asdict(Disc.of_dimensions(1, 0.012, 0.025, 0.02, ALUMINIUM))
    assert disc_dimensions(disc, 0.012) == pytest.approx((0.012, 0.025, 0.02))


def test_a_disc_without_inertia_is_still_seen() -> None:
    point = {"mass": 1.0, "polar_inertia": 0.0, "transverse_inertia": 0.0}
    assert disc_dimensions(point, 0.02) == pytest.approx((0.02, 0.024, 0.0))


def test_every_node_bearing_and_place_of_excitation_is_named() -> None:
    """Nodes 3 and 15 carry the bearings, node 10 at 400 mm the force, as the rotor file says."""
    graphic = rotor_figure(entries("mendes")).graphic
    assert isinstance(graphic, Chart)
    words = [
        (text, x)
        for one in graphic.panels[0].series
        if one.kind == "text"
        for text, x in zip(one.texts[0], one.x, strict=True)
    ]
    assert {"bearing 1", "bearing 2", "force", "response", *map(str, range(1, 17))} == {
        text for text, _ in words
    }
    assert dict(words)["force"] == dict(words)["10"] == pytest.approx(400.0)


def test_positions_and_diameters_at_nodes() -> None:
    rotor = entries("mendes")["rotor"]
    positions = node_positions(rotor)
    assert len(positions) == 16 and positions[9] == pytest.approx(0.4)
    assert [shaft_diameter(rotor, node) for node in (1, 3, 4, 16)] == [0.012, 0.031, 0.031, 0.012]


def fits(*rigs: dict[str, Any] | None) -> dict[str, Any]:
    return {
        "identify": [
            {"name": str(n), "model_settings": None if rig is None else {"rig": rig}}
            for n, rig in enumerate(rigs)
        ]
    }


def test_fits_on_one_rotor_draw_it_once_and_other_fits_none() -> None:
    mendes, laval = entries("mendes"), entries("laval")
    assert len(rotor_figures(fits(mendes, mendes, None, laval))) == 2
    assert rotor_figures(fits(None)) == [] and rotor_figures({}) == []
    assert rotor_figures({"identify": [{"name": "old"}]}) == []


def test_report_has_a_section_for_the_rotor_only_where_there_is_one() -> None:
    sections = {
        section.heading: section.blocks
        for section in build(
            Identification(
                (),
                settings=fits(entries("laval")),
                sections={"unbalance": UnbalanceRuns("laval", "", 1, (1.0, 2.0), ())},
            )
        ).sections
    }
    (figure,) = sections["Rotor"]
    assert isinstance(figure, Figure) and figure.caption.startswith(
        "Laval rig after Machado and Cavalca: the rotor"
    )
    assert "Rotor" not in [section.heading for section in build(Identification(())).sections]
