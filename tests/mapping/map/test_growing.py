"""Recordings that begin close up, with the legs and the floor out of sight.

The prior places the object; here a stand-in for it takes the ends of the points, and the floor.
"""

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from analytic_room import CHAIR, FLOOR, TABLE, WALLS, K, room
from PIL import Image

from jaxshape.data.sequences import open_sequence
from jaxshape.mapping.map.doubts import doubts_of
from jaxshape.mapping.map.recording import follow
from jaxshape.mapping.placement import finding
from jaxshape.mapping.placement.finding import find_start
from jaxshape.mapping.segmentation.segment import Prompt

GROUPS = [FLOOR, WALLS, CHAIR, TABLE]
CLOSE, ABOVE = ((0.4, 1.2, 0.75), (0, 0.85, 0)), ((0.3, 1.3, 0.8), (0, 0.8, 0))
FAR = [((a, 1.4, 1.8), (0, 0.45, 0)) for a in (0.9, 0.2, -0.5, -1.1)]
AWAY = (1.7, 1.3, 1.5), (1.6, 0.5, -0.5)


@pytest.fixture
def ends(monkeypatch):
    """The placement that takes the ends of the points as the box."""

    def place(prior, seen, floor, known, config):
        lower, upper = (jnp.quantile(seen.surface, q, axis=0) for q in (0.004, 0.996))
        lower = lower.at[1].set(jnp.where(jnp.isnan(floor), lower[1], floor))
        middle = jaxlie.SE3.from_translation((lower + upper) / 2)
        return known._replace(
            T_world_object=middle, size=upper - lower, misfit=jnp.float32(0), margin=jnp.float32(1)
        )

    monkeypatch.setattr(finding, "_place", place)


@pytest.fixture
def recorded(tmp_path, known, mapper, ends):
    def recorded(cameras):
        """The progress after each frame of a recording with poses."""
        views = [room(GROUPS, *one, seed=i) for i, one in enumerate(cameras)]
        for i, view in enumerate(views):
            depth = np.where(np.isfinite(view.depth), np.rint(view.depth * 1000), 0)
            path = tmp_path / f"frame-{i:06d}"
            Image.fromarray(depth.astype(np.uint16)).save(f"{path}.depth.png")
            np.savetxt(f"{path}.pose.txt", view.T_world_camera)
        np.savetxt(tmp_path / "camera-intrinsics.txt", K)
        sequence = open_sequence(tmp_path)
        v, u = np.nonzero(views[0].label == 2)
        middle = np.argmin(np.hypot(u - u.mean(), v - v.mean()))
        click = float(u[middle]), float(v[middle])
        start = find_start(sequence, known, Prompt(click=click))
        return views, list(follow(sequence, start, mapper, known, use_poses=True))

    return recorded


def ends_of(progress):
    """Lowest and highest corner in the world of a box that is turned by next to nothing."""
    box = progress.start.box
    half = np.abs(box.T_world_object[:3, :3]) @ box.size / 2
    return box.T_world_object[:3, 3] - half, box.T_world_object[:3, 3] + half


def test_a_short_first_box_grows_to_the_whole_chair(recorded):
    views, steps = recorded([CLOSE, ABOVE, *FAR])
    low, high = ends_of(steps[0])
    assert low[1] > 0.2 and np.isnan(steps[0].start.floor)
    low, high = ends_of(steps[-1])
    np.testing.assert_allclose(low, [-0.22, 0, -0.22], atol=0.04)
    np.testing.assert_allclose(high, [0.22, 0.95, 0.22], atol=0.04)
    # The legs are in the keyframes that show them, and the table is in none.
    for log, keyframe in steps[-1].of_keyframes():
        view, segmented = views[log.index], np.asarray(keyframe.segmented)
        assert segmented[view.label == 2].mean() > 0.85
        assert segmented[view.label == 3].mean() < 0.01


def test_a_floor_that_is_seen_late_sets_the_bottom_and_is_said_instead_of_the_doubt(recorded):
    _, steps = recorded([CLOSE, *FAR])
    assert np.isnan(steps[0].start.floor)
    assert any("floor" in one for one in steps[0].start.warnings)
    last = steps[-1].start
    level = last.T_level_world[:3, :3]
    assert np.degrees(np.arccos(level[1, 1])) < 1.5
    assert last.floor == pytest.approx(0, abs=0.03)
    assert ends_of(steps[-1])[0][1] == pytest.approx(0, abs=0.03)
    assert not any("floor" in one for one in last.warnings)
    assert any("later keyframe" in one for one in last.notes)


def test_a_first_box_that_is_right_stays(recorded):
    _, steps = recorded([FAR[0], *FAR])
    first, last = steps[0], steps[-1]
    np.testing.assert_allclose(ends_of(first), ends_of(last), atol=0.03)
    assert last.start.floor == first.start.floor
    np.testing.assert_array_equal(first.start.T_level_world, last.start.T_level_world)


def test_what_was_not_seen_is_said(recorded):
    _, steps = recorded([CLOSE, ABOVE])
    said = " ".join(doubts_of(steps[-1]))
    assert "was not seen at its" in said and "bottom" in said and "back" in said
    _, steps = recorded([FAR[0], *FAR, AWAY])
    said = " ".join(doubts_of(steps[-1]))
    assert "No pixel was segmented as the object in frame-000005" in said
    assert "lowest" not in said and "top" not in said


def test_what_the_box_leaves_out_of_the_first_frame_is_said(recorded):
    _, steps = recorded([FAR[0], FAR[1]])
    last = steps[-1]
    assert "first frame" not in " ".join(doubts_of(last))
    first, *others = last.state.keyframes
    rows = jnp.arange(first.segmented.shape[0])[:, None]
    upper = first.segmented & (rows < jnp.median(jnp.nonzero(first.segmented)[0]))
    cut = last.state._replace(keyframes=(first._replace(segmented=upper), *others))
    said = " ".join(doubts_of(last._replace(state=cut)))
    share = int(said.split("% of the points segmented as the object in the first frame")[0][-2:])
    assert 40 < share < 65
