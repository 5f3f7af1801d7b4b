"""The state of a map: how many keyframes it may hold."""

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxshape.data.boxes import Box
from jaxshape.geometry.camera import Intrinsics
from jaxshape.mapping.config import MappingConfig
from jaxshape.mapping.map import state as map_state
from jaxshape.mapping.map.state import assemble, capacity_for, realigned_poses
from jaxshape.mapping.tracking.keyframes import PreparedFrame, keyframe_of, place_of
from jaxshape.mapping.tracking.views import view_of


@given(st.integers(1, 10**6))
def test_capacities_double_and_hold_every_map(count):
    capacity = capacity_for(count)
    assert capacity >= count
    assert capacity == 8 or capacity < 2 * count
    assert capacity.bit_count() == 1
    assert capacity_for(capacity) == capacity and capacity_for(capacity + 1) == 2 * capacity


@pytest.mark.slow
def test_a_map_of_more_than_512_keyframes_is_realigned(monkeypatch, linear_prior):
    """What the joint problem is asked: all keyframes, padded, each with its own odometry."""
    asked = []

    def solve(clouds, T, is_keyframe, lattice, probability, odometry, is_fixed, center):
        asked.append((is_keyframe, is_fixed, np.asarray(odometry.information)))
        return T

    monkeypatch.setattr(map_state, "_realign", solve)
    place = place_of(Box(np.eye(4), np.ones(3)), 32)
    lens = Intrinsics(*jnp.float32([4, 4, 2, 2]))
    prepared = PreparedFrame(view_of(jnp.ones((4, 4)), lens), jnp.ones((4, 4), bool))
    odometry = (jaxlie.SE3.identity(), jnp.eye(6))
    first = keyframe_of(prepared, place, jaxlie.SE3.identity(), odometry)
    poses = np.float32([[1, 0, 0, 0, 0.01 * i, 0, 0] for i in range(513)])
    keyframes = tuple(first._replace(T_world_camera=jaxlie.SE3(pose)) for pose in poses)
    few = assemble(linear_prior, place, (first,), prepared.view, MappingConfig())
    found = realigned_poses([few._replace(keyframes=keyframes)])
    np.testing.assert_array_equal([T.wxyz_xyz for T in found], poses)
    ((is_keyframe, is_fixed, information),) = asked
    assert len(is_keyframe) == 1024 and is_keyframe[:513].all() and not is_keyframe[513:].any()
    assert is_fixed[0] and not is_fixed[1:].any()
    assert (information[513:] == 0).all() and (information[:513] == np.eye(6)).all()
