"""The procedural family: deterministic, canonical, closed, varied, of real sizes."""

import hashlib

import jaxtyping
import numpy as np
import pytest
import trimesh

from jaxshape.data.chairs import FREQUENCIES, STYLES, VOLUMINOUS, random_chair
from jaxshape.data.chairs.draw import Draw
from jaxshape.data.chairs.primitives import (
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

NO_BACK_OR_A_TRAY = {"stool", "bar stool", "bench", "folding", "pouffe", "high chair"}


def pieces_of(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    return list(mesh.split(only_watertight=False))


def digest(mesh: trimesh.Trimesh) -> bytes:
    """A hash of the normalised vertices to 1 % of the box, so that a rescaled copy collides."""
    unit = np.rint(mesh.vertices * (100 / np.ptp(mesh.vertices, axis=0))).astype(np.int8)
    return hashlib.blake2b(unit.tobytes(), digest_size=12).digest()


def voxels(mesh: trimesh.Trimesh) -> np.ndarray:
    points = trimesh.sample.sample_surface(mesh, 4000, seed=0)[0]
    cells = np.clip(np.floor((points / mesh.extents + 0.5) * 16), 0, 15).astype(int)
    grid = np.zeros((16, 16, 16), bool)
    grid[tuple(cells.T)] = True
    return grid


@pytest.fixture
def without_shape_checks():
    """Off where a test makes many chairs: they triple the time, and another test has them on."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)


@pytest.mark.parametrize("style", STYLES)
def test_pieces_are_closed_finite_and_face_outward(style):
    for seed in range(5):
        mesh = random_chair(seed, style=style)
        assert np.isfinite(mesh.vertices).all()
        for piece in pieces_of(mesh):
            assert piece.is_watertight and piece.is_winding_consistent
            assert piece.volume > 0


@pytest.mark.parametrize("style", STYLES)
def test_box_is_centred_and_of_a_real_size(style, without_shape_checks):
    for seed in range(20):
        mesh = random_chair(seed, style=style)
        scale = 0.55 if mesh.metadata["drawn"].get("for") == "child" else 1.0
        assert np.allclose(mesh.bounds.sum(0), 0, atol=1e-9)
        low, high = np.array([0.25, 0.3, 0.25]) * scale, np.array([2.6, 1.6, 2.3])
        assert (mesh.extents > low).all() and (mesh.extents < high).all(), (seed, mesh.extents)


@pytest.mark.parametrize("style", sorted(set(STYLES) - NO_BACK_OR_A_TRAY))
def test_the_back_is_behind(style, without_shape_checks):
    """Above the middle of the box, the surface lies behind its centre."""
    offsets = []
    for seed in range(20):
        mesh = random_chair(seed, style=style)
        high = mesh.triangles_center[:, 1] > 0.35 * mesh.extents[1]
        offsets.append(np.average(mesh.triangles_center[high, 2], weights=mesh.area_faces[high]))
    assert np.mean(np.array(offsets) < 0) >= 0.95


@pytest.mark.parametrize("style", ["side chair", "armchair", "stool", "bar stool", "office"])
def test_up_is_y(style, without_shape_checks):
    """A ray from above meets the seat where `seat height` says, above the floor."""
    for seed in range(10):
        mesh = random_chair(seed, style=style)
        if "seat height" not in mesh.metadata["drawn"] or "for" in mesh.metadata["drawn"]:
            continue
        hits, _, _ = mesh.ray.intersects_location([[0.01, 2.0, 0.0]], [[0.0, -1.0, 0.0]])
        top = hits[:, 1].max() - mesh.bounds[0, 1]
        assert abs(top - mesh.metadata["drawn"]["seat height"]) < 0.13


def test_same_seed_same_chair_and_style_is_the_only_difference():
    for seed in (0, 7, 123456789):
        first, second = random_chair(seed), random_chair(seed)
        assert np.array_equal(first.vertices, second.vertices)
        assert np.array_equal(first.faces, second.faces)
        assert first.metadata == second.metadata
        named = random_chair(seed, style=first.metadata["style"])
        assert np.array_equal(first.vertices, named.vertices)
        assert first.metadata["seed"] == seed and first.metadata["style"] in STYLES


@pytest.mark.parametrize("count", [1_000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_so_many_seeds_give_as_many_chairs_of_all_styles(count, without_shape_checks):
    digests, styles = set(), dict.fromkeys(STYLES, 0)
    for seed in range(count):
        mesh = random_chair(seed)
        digests.add(digest(mesh))
        styles[mesh.metadata["style"]] += 1
    assert len(digests) == count
    for style, seen in styles.items():
        expected = count * FREQUENCIES[style]
        assert abs(seen - expected) < 5 * np.sqrt(expected) + 1, style


def test_neighbouring_seeds_look_different(without_shape_checks):
    """Not only the digits: coarse voxel grids of one style overlap far from fully."""
    grids = [voxels(random_chair(seed, style="side chair")).ravel() for seed in range(60)]
    grids = np.array(grids, float)
    both = grids @ grids.T
    iou = both / (grids.sum(1)[:, None] + grids.sum(1) - both)
    assert (iou[np.triu_indices(60, 1)] < 0.9).all()


def test_voluminous_seats_fill_more_of_their_box(without_shape_checks):
    """Seen as the share of the box that lies between the lowest and the highest surface."""

    def filled(style: str) -> float:
        shares = []
        for seed in range(10):
            grid = voxels(random_chair(seed, style=style))
            below = np.maximum.accumulate(grid, 1)
            above = np.maximum.accumulate(grid[:, ::-1], 1)[:, ::-1]
            shares.append((below & above).mean())
        return float(np.mean(shares))

    assert VOLUMINOUS < set(STYLES)
    slender = max(filled(style) for style in ("side chair", "shell", "cantilever", "lounge"))
    assert min(filled(style) for style in VOLUMINOUS) > slender


def test_frequencies_are_a_distribution():
    assert tuple(FREQUENCIES) == STYLES
    assert np.isclose(sum(FREQUENCIES.values()), 1) and min(FREQUENCIES.values()) > 0


def test_bad_arguments_say_what_to_do():
    with pytest.raises(ValueError, match="side chair"):
        random_chair(0, style="throne")
    with pytest.raises(ValueError, match="-3"):
        random_chair(-3)


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
