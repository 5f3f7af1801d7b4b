"""A checkpoint is what a run left off with: going on is as if nothing had happened."""

import jax
import numpy as np
import pytest

from jaxshape.data.sequences import SequenceError
from jaxshape.mapping.config import MappingConfig
from jaxshape.mapping.map.recording import follow
from jaxshape.results.checkpoint import STATE, load_state, remove_state, save_state

CUT, LAST = 5, 8
SETTINGS = {"method": "cma", "seed": 0, "box": [1.0, 2.0]}


@pytest.fixture(scope="module")
def last_keyframe(steps):
    """The last progress after a keyframe before frame CUT + 1, when a run is saved."""
    return [one for one in steps[: CUT + 1] if one.logs[-1].status == "keyframe"][-1]


def load(folder, sequence, prior, settings=SETTINGS):
    return load_state(folder, sequence, prior, settings, MappingConfig())


def assert_identical(ours, theirs):
    """Bit by bit, but for the seconds that things took."""
    for one in (ours, theirs):
        assert one.state.poses_are_given == theirs.state.poses_are_given
    jax.tree.map(np.testing.assert_array_equal, ours.state, theirs.state)
    for ours_log, log in zip(ours.logs, theirs.logs, strict=True):
        assert ours_log[:5] == log[:5]
        if log.T_keyframe_camera is None:
            assert ours_log.T_keyframe_camera is None
        else:
            np.testing.assert_array_equal(ours_log.T_keyframe_camera, log.T_keyframe_camera)
        for name in ("inlier_fraction", "overlap", "rmse", "conditioning"):
            assert ours_log.figures.get(name) == log.figures.get(name)


def test_what_is_read_is_what_was_saved(tmp_path, sequence, known, last_keyframe):
    save_state(tmp_path, last_keyframe, SETTINGS)
    found = load(tmp_path, sequence, known)
    assert_identical(found, last_keyframe)
    assert found.start.notes == last_keyframe.start.notes and found.shape is None


def test_going_on_gives_what_an_uninterrupted_run_gives(
    tmp_path, sequence, known, mapper, steps, last_keyframe
):
    save_state(tmp_path, last_keyframe, SETTINGS)
    earlier = load(tmp_path, sequence, known)
    rest = list(follow(sequence, earlier.start, mapper, known, chosen=range(LAST), earlier=earlier))
    assert [one.logs[-1].index for one in rest] == list(range(earlier.logs[-1].index + 1, LAST))
    assert_identical(rest[-1], steps[-1])
    states = [mapper.finish(one.state)[0] for one in (rest[-1], steps[-1])]
    np.testing.assert_array_equal(states[0].logits, states[1].logits)


def test_a_checkpoint_is_small_and_forgotten_at_the_end(tmp_path, sequence, known, last_keyframe):
    assert load(tmp_path, sequence, known) is None
    save_state(tmp_path, last_keyframe, SETTINGS)
    keyframes = len(last_keyframe.state.keyframes)
    assert (tmp_path / STATE).stat().st_size < 200_000 + 10_000 * keyframes
    remove_state(tmp_path)
    remove_state(tmp_path)
    assert not list(tmp_path.iterdir())


def test_other_settings_are_refused(tmp_path, sequence, known, last_keyframe):
    save_state(tmp_path, last_keyframe, SETTINGS)
    with pytest.raises(
        SequenceError, match="with other settings; give the same settings .* --fresh"
    ):
        load(tmp_path, sequence, known, SETTINGS | {"seed": 1})
    assert load(tmp_path, sequence, known) is not None


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not one", None])
def test_a_damaged_checkpoint_is_refused(tmp_path, sequence, known, last_keyframe, content):
    save_state(tmp_path, last_keyframe, SETTINGS)
    path = tmp_path / STATE
    path.write_bytes(path.read_bytes()[:3000] if content is None else content)
    with pytest.raises(SequenceError, match="cannot be read .* remove it, or add --fresh"):
        load(tmp_path, sequence, known)
