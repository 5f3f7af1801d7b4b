"""All families of procedural objects: closed, deterministic, varied, drawn by their frequencies."""

import hashlib

import numpy as np
import pytest
import trimesh
from marks import slow
from procedural_shapes import voxels

from jaxshape.data.chairs import random_chair
from jaxshape.data.chairs.family import CHAIRS
from jaxshape.data.procedural.draw import Draw
from jaxshape.data.procedural.family import make
from jaxshape.data.procedural.primitives import (
    assemble,
    bars,
    bend,
    both_sides,
    box,
    cushion,
    lathe,
    loft,
    slab,
    superellipse,
    tilt,
    tubes,
)
from jaxshape.data.tables import TABLES, random_table

FAMILIES = {family.name: family for family in (CHAIRS, TABLES)}
STYLES = [(name, style) for name, family in FAMILIES.items() for style in family.styles]

every_family = pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES)


def pieces_of(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    return list(mesh.split(only_watertight=False))


def digest(mesh: trimesh.Trimesh) -> bytes:
    """A hash of the normalised vertices to 1 % of the box, so that a rescaled copy collides."""
    unit = np.rint(mesh.vertices * (100 / np.ptp(mesh.vertices, axis=0))).astype(np.int8)
    return hashlib.blake2b(unit.tobytes(), digest_size=12).digest()


@pytest.mark.parametrize(("name", "style"), STYLES)
def test_pieces_are_closed_finite_and_face_outward(name, style):
    for seed in range(5):
        mesh = make(FAMILIES[name], seed, style)
        assert np.isfinite(mesh.vertices).all()
        for piece in pieces_of(mesh):
            assert piece.is_watertight and piece.is_winding_consistent
            assert piece.volume > 0


@every_family
def test_same_seed_same_object_and_style_is_the_only_difference(family):
    for seed in (0, 7, 123456789):
        first, second = make(family, seed), make(family, seed)
        assert np.array_equal(first.vertices, second.vertices)
        assert np.array_equal(first.faces, second.faces)
        assert first.metadata == second.metadata
        named = make(family, seed, first.metadata["style"])
        assert np.array_equal(first.vertices, named.vertices)
        assert first.metadata["seed"] == seed and first.metadata["style"] in family.styles


@every_family
@pytest.mark.parametrize("count", [1_000, slow(10_000)])
def test_so_many_seeds_give_as_many_objects_of_all_styles(family, count, without_shape_checks):
    digests, styles = set(), dict.fromkeys(family.styles, 0)
    for seed in range(count):
        mesh = make(family, seed)
        digests.add(digest(mesh))
        styles[mesh.metadata["style"]] += 1
    assert len(digests) == count
    for style, seen in styles.items():
        expected = count * family.frequencies[style]
        assert abs(seen - expected) < 5 * np.sqrt(expected) + 1, style


@pytest.mark.parametrize(("name", "style"), [("chair", "side chair"), ("table", "dining")])
def test_neighbouring_seeds_look_different(name, style, without_shape_checks):
    """Not only the digits: coarse voxel grids of one style overlap far from fully, but for a pair
    or two of plain tables."""
    grids = [voxels(make(FAMILIES[name], seed, style)).ravel() for seed in range(60)]
    grids = np.array(grids, float)
    both = grids @ grids.T
    iou = both / (grids.sum(1)[:, None] + grids.sum(1) - both)
    assert np.mean(iou[np.triu_indices(60, 1)] > 0.9) < 0.005


@every_family
def test_frequencies_are_a_distribution(family):
    assert tuple(family.frequencies) == tuple(family.styles)
    shares = family.frequencies.values()
    assert np.isclose(sum(shares), 1) and min(shares) > 0


def test_bad_arguments_say_what_to_do():
    with pytest.raises(ValueError, match="chair style 'throne'.*side chair"):
        random_chair(0, style="throne")
    with pytest.raises(ValueError, match="table style 'throne'.*dining"):
        random_table(0, style="throne")
    with pytest.raises(ValueError, match="-3"):
        random_table(-3)


def test_primitive_volumes():
    """Closed forms: box, bar, cylinder, ring, slab, mirrored pair, tilted box."""
    circle = np.pi * 0.5**2
    angle = 2 * np.pi * np.arange(96) / 96
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    grid = np.stack([*np.meshgrid(np.linspace(0, 2, 5), np.linspace(0, 3, 4)), np.zeros((4, 5))], 2)
    expected = [
        (box((1, 2, 3), (0.5, 2, 3)), 3.0),
        (bars((0, 0, 0), (3, 4, 0), 0.2, 0.5), 0.5),
        (bars([[0, 0, 0], [1, 0, 0]], [[0, 2, 0], [1, 2, 0]], 0.1), 0.04),
        (lathe([(0.5, 0), (0.5, 2)], sides=96), 2 * circle),
        (tubes(ring, 0.1, sides=64, loop=True), 2 * np.pi * np.pi * 0.01),
        (tubes(np.array([[0.0, 0, 0], [0, 3, 0]]), 0.5, sides=96), 3 * circle),
        (slab(grid, 0.1), 0.6),
        (both_sides(box((3, 0, 0), (1, 1, 1))), 2.0),
        (tilt(box((0, 0, 0), (1, 2, 3)), 0.7, (0, 5, 5)), 6.0),
        (loft(np.stack([np.insert(superellipse(2, 96) * 0.5, 1, y, 1) for y in (0, 1)])), circle),
    ]
    for part, volume in expected:
        assert assemble([part]).volume == pytest.approx(volume, rel=5e-3)


def test_cushion_stays_in_its_box():
    part = cushion((1, 2, 3), (0.6, 0.2, 0.4), edge=0.4)
    assert np.allclose(np.ptp(part.vertices[0], axis=0), (0.6, 0.2, 0.4))
    assert np.allclose(part.vertices[0].mean(0), (1, 2, 3), atol=1e-6)


def test_tilt_leans_the_top_backward():
    part = tilt(box((0, 0.5, 0), (0.1, 1, 0.1)), 0.3, (0, 0, 0))
    top = part.vertices[0][part.vertices[0][:, 1] > 0.5]
    assert (top[:, 2] < 0).all()


def test_bend_keeps_the_ends_and_cuts_the_corners():
    path = bend([(0, 0, 0), (1, 0, 0), (1, 1, 0)], 0.2)
    assert np.allclose(path[[0, -1]], [(0, 0, 0), (1, 1, 0)])
    assert np.linalg.norm(path - (1, 0, 0), axis=1).min() > 0.05


def test_draws_follow_their_weights():
    draw = Draw(np.random.default_rng(0))
    names = [draw.pick({"a": 3.0, "b": 1.0}) for _ in range(4000)]
    assert abs(names.count("a") - 3000) < 150
    assert {draw.count(2, 4) for _ in range(200)} == {2, 3, 4}
    assert all(-1 <= draw.between(-1, 2) < 2 for _ in range(200))
