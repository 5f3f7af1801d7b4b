"""A recorded sequence, in a world of its own, against fusion in the object frame."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from scene import T_WORLD_OBJECT, write_scene

from jaxshape.data.boxes import read_box
from jaxshape.data.chairs import random_chair
from jaxshape.data.sequences import SequenceError, open_sequence
from jaxshape.geometry import fusion, grid
from jaxshape.geometry.grid import MARGIN, RESOLUTION
from jaxshape.results.metrics import iou
from jaxshape.results.scan import observe_sequence

FRAMES = 3


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scan")
    scene = write_scene(folder, random_chair(4, style="armchair"), frames=FRAMES, masks=True)
    return scene, open_sequence(folder), read_box(folder / "box.json")


@pytest.fixture(scope="module")
def observed(recorded):
    _, sequence, box = recorded
    return observe_sequence(sequence, range(FRAMES), box)


def fused_in_the_object_frame(scene, frame, views=FRAMES):
    """One view after the other, with the poses the camera really had."""
    measurement = fusion.nothing_measured()
    for i in range(views):
        T_object_camera = jax.tree.map(lambda x, i=i: x[i], scene.T_object_camera)
        depth = jnp.asarray(scene.depth[i])
        new = fusion.measure(depth, depth > 0, scene.intrinsics, T_object_camera, frame)
        measurement = fusion.merge(measurement, new)
    return measurement


def agree(ours, expected):
    """Points on the border of two voxels may fall either way."""
    return expected.any() and iou(jnp.asarray(ours), expected) > 0.97


def test_the_world_does_not_matter(recorded, observed):
    scene, _, _ = recorded
    frame = grid.fit_box(jnp.float32(-scene.size / 2), jnp.float32(scene.size / 2))
    expected = fused_in_the_object_frame(scene, frame)
    assert agree(observed.occupied, fusion.occupied(expected))
    assert agree(observed.occluded, fusion.occluded(expected))
    np.testing.assert_allclose(observed.frame.origin, frame.origin, rtol=1e-6)
    np.testing.assert_array_equal(observed.T_world_object, T_WORLD_OBJECT)
    assert observed.truth is None


def test_only_the_chosen_frames_count(recorded):
    scene, sequence, box = recorded
    observed = observe_sequence(sequence, [0], box)
    expected = fused_in_the_object_frame(scene, observed.frame, views=1)
    assert agree(observed.occupied, fusion.occupied(expected))
    assert len(observed.depth) == 1


def test_depth_frames_to_show_are_cut_to_the_object(recorded, observed):
    scene, _, _ = recorded
    assert len(observed.depth) == FRAMES
    for shown, whole in zip(observed.depth, scene.depth, strict=True):
        assert np.isfinite(shown).any(axis=0)[[0, -1]].all()
        assert np.isfinite(shown).any(axis=1)[[0, -1]].all()
        np.testing.assert_allclose(shown[np.isfinite(shown)], whole[whole > 0])


def test_masks_tell_the_object_without_a_box(recorded, observed):
    """The box is then upright in the world: here the object's, turned by a quarter."""
    _, sequence, box = recorded
    found = observe_sequence(sequence, range(FRAMES), None)
    np.testing.assert_array_equal(found.T_world_object[:3, :3], np.eye(3))
    centre = found.T_world_object[:3, 3]
    np.testing.assert_allclose(centre, T_WORLD_OBJECT[:3, 3], atol=0.08)
    size = np.asarray(found.frame.voxel_size) * 30
    np.testing.assert_allclose(size, box.size[[2, 1, 0]], rtol=0.25)
    assert 0.5 < found.occupied.sum() / observed.occupied.sum() < 2


def test_points_outside_the_mask_are_not_the_object(tmp_path):
    """With half of the mask blacked out, what is left is what the mask shows."""
    write_scene(tmp_path, random_chair(4, style="armchair"), frames=1, masks=True)
    box = read_box(tmp_path / "box.json")
    whole = observe_sequence(open_sequence(tmp_path), [0], box)
    path = tmp_path / "frame-000000.mask.png"
    mask = np.array(Image.open(path))
    mask[:, mask.shape[1] // 2 :] = 0
    Image.fromarray(mask).save(path)
    half = observe_sequence(open_sequence(tmp_path), [0], box)
    assert 0 < half.occupied.sum() < 0.8 * whole.occupied.sum()
    assert not np.any(half.occupied & ~whole.occupied)


def test_neither_box_nor_masks_is_said_in_a_sentence(tmp_path):
    write_scene(tmp_path, random_chair(4, style="armchair"), frames=1)
    with pytest.raises(SequenceError, match="No frame has a mask .* give its box with --box"):
        observe_sequence(open_sequence(tmp_path), [0], None)


def test_more_hits_are_asked_of_a_voxel(recorded, observed):
    scene, sequence, box = recorded
    strict = observe_sequence(sequence, range(FRAMES), box, min_hits=2)
    expected = fused_in_the_object_frame(scene, observed.frame)
    assert agree(strict.occupied, expected.hits >= 2)
    assert strict.occupied.sum() < observed.occupied.sum()
    assert not np.any(strict.occupied & ~observed.occupied)


def test_isotropic_voxels_are_cubes_around_the_same_centre(recorded, observed):
    _, sequence, box = recorded
    found = observe_sequence(sequence, range(FRAMES), box, isotropic=True)
    np.testing.assert_allclose(
        found.frame.voxel_size, box.size.max() / (RESOLUTION - 2 * MARGIN), rtol=1e-5
    )
    np.testing.assert_allclose(found.frame.origin + 16 * found.frame.voxel_size, 0, atol=1e-5)
    assert np.ptp(np.asarray(observed.frame.voxel_size)) > 1e-3
