"""Surfaces enclose the volumes of closed forms, look outwards, and are smooth; looks follow their seed."""

from __future__ import annotations

import colorsys
import math

import numpy as np
import pytest
import torch
from drawn import volume

from torchdlo.coupling.robot.robot_kinematics import panda
from torchdlo.errors import InputError
from torchdlo.vision.arm_surfaces import link_surfaces
from torchdlo.vision.look import Look, Paint, draw_look
from torchdlo.vision.surfaces import Surface, blended_isosurface, isosurface, plate, solid

BALL = 4 / 3 * math.pi
CLOSED = {
    "box": ((0.1, 0.2, 0.3), 8 * 0.006),
    "sphere": ((0.1, 0, 0), BALL * 0.001),
    "capsule": ((0.1, 0.2, 0), BALL * 0.001 + math.pi * 0.01 * 0.4),
    "cylinder": ((0.1, 0.2, 0), math.pi * 0.01 * 0.4),
    "cone": ((0.1, 0.2, 0), math.pi * 0.01 * 0.2 / 3),
    "torus": ((0.1, 0.02, 0), 2 * math.pi**2 * 0.1 * 0.0004),
    "ring": ((0.1, 0.02, 4.0), 4 * 0.1 * math.pi * 0.0004 + BALL * 0.02**3),
}


def outwards(surface: Surface, share: float = 1.0) -> bool:
    """Whether normals agree with triangles, or with a share of them, and have length 1."""
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    facing = (across * surface.normals[surface.faces].mean(1)).sum(1)[np.linalg.norm(across, axis=1) > 1e-12]
    return float((facing > 0).mean()) >= share and np.allclose(np.linalg.norm(surface.normals, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("shape", CLOSED)
def test_closed_forms_enclose_their_volumes(shape: str):
    size, expected = CLOSED[shape]
    # A polygon of n corners has 1 - 2/3 (pi / n)^2 of the area of its circle.
    assert volume(solid(shape, np.array(size, float), 80)) == pytest.approx(expected, rel=0.012)
    assert outwards(solid(shape, np.array(size, float)))


def test_bodies_stand_where_their_centre_of_mass_is():
    for shape, (size, _) in CLOSED.items():
        made = solid(shape, np.array(size, float), 80)
        a, b, c = (made.vertices[made.faces[:, k]] for k in range(3))
        part = (a * np.cross(b, c)).sum(1) / 6
        centre = (part[:, None] * (a + b + c) / 4).sum(0) / part.sum()
        assert np.abs(centre).max() < 2e-3 * max(size), shape


def test_isosurfaces_are_found_on_grids():
    low, spacing = np.array([-0.15, -0.16, -0.14]), np.array([0.01, 0.011, 0.009])
    nodes = low + spacing * np.stack(np.meshgrid(*(np.arange(32),) * 3, indexing="ij"), -1)
    made = isosurface(np.linalg.norm(nodes, axis=-1) - 0.1, low, spacing)
    assert np.abs(np.linalg.norm(made.vertices, axis=1) - 0.1).max() < 1e-3
    assert volume(made) == pytest.approx(BALL * 0.001, rel=0.02) and outwards(made)


def test_blended_surfaces_are_exact_on_coarse_grids():
    made = blended_isosurface(lambda p: np.linalg.norm(p, axis=1) - 0.1, np.full(3, -0.1), np.full(3, 0.1), 0.03)
    np.testing.assert_allclose(np.linalg.norm(made.vertices, axis=1), 0.1, rtol=1e-6)
    np.testing.assert_allclose(made.normals, made.vertices / 0.1, atol=1e-5)


def test_tables_have_their_height():
    made = plate((-1.0, -2.0), (3.0, 4.0), 0.2, 0.04)
    assert made.vertices.min(0).tolist() == pytest.approx([-1, -2, 0.16])
    assert made.vertices.max(0).tolist() == pytest.approx([3, 4, 0.2])


def test_arms_are_closed_and_as_large_as_their_links():
    parts = link_surfaces(panda(), 0.02)
    assert {p.link for p in parts} == {*(f"link{k}" for k in range(8)), "hand", "left_finger", "right_finger"}
    for part in parts:
        assert outwards(part.surface, 0.99), part.link
        assert volume(part.surface) > 0, part.link
        # Nothing is far from the link's frame: the forearm is 38 cm long.
        assert np.linalg.norm(part.surface.vertices, axis=1).max() < 0.4, part.link


def test_other_robots_look_as_their_contact_shapes_do():
    text = (
        '<robot name="one"><link name="a"/><link name="b"><collision><origin xyz="0 0 1"/><geometry>'
        '<sphere radius="0.1"/></geometry></collision></link><joint name="j" type="revolute"><parent link="a"/>'
        '<child link="b"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )
    from torchdlo.coupling.robot.robot_kinematics import load_robot

    (part,) = link_surfaces(load_robot(text))
    np.testing.assert_allclose(np.linalg.norm(part.surface.vertices - [0, 0, 1], axis=1), 0.1)


def test_looks_follow_their_seed():
    one, two, other = (draw_look(torch.Generator().manual_seed(k)) for k in (4, 4, 5))
    assert one == two and one != other
    assert hash(one) == hash(two)


def test_ropes_can_be_told_from_tables():
    # Lightness of the rope and of the table differ, or one is far more colourful.
    for seed in range(40):
        look = draw_look(torch.Generator().manual_seed(seed))
        table = colorsys.rgb_to_hsv(*look.table.color)
        for rope in look.ropes:
            _, strong, value = colorsys.rgb_to_hsv(*rope.color)
            assert abs(value - table[2]) > 0.3 or strong - table[1] > 0.04, seed


def test_a_pattern_that_is_not_known_is_named():
    with pytest.raises(InputError, match="stripes"):
        Paint((1, 1, 1), pattern="stripes")
    assert Look().ropes[0].pattern == "twisted"
