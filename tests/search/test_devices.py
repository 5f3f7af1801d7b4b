"""Objects are spread over all devices by themselves, and find what one device finds."""

import json
import subprocess
import sys

import four_devices
import numpy as np
import pytest
from forced_devices import environment
from four_devices import METHODS, OBJECTS


@pytest.fixture(scope="module")
def found():
    """What searches find on one device, and on four."""

    def begin(devices):
        command = [sys.executable, four_devices.__file__]
        pipe = subprocess.PIPE
        return subprocess.Popen(
            command, env=environment(devices), stdout=pipe, stderr=pipe, text=True
        )

    def outcome(process):
        output, errors = process.communicate(timeout=300)
        assert process.returncode == 0, errors
        return json.loads(output.splitlines()[-1])

    return [outcome(process) for process in [begin(1), begin(4)]]


def assert_same(found, expected):
    assert found.keys() == expected.keys()
    for name, x in expected.items():
        # Searches that divide by their curvature magnify the rounding of other shards.
        np.testing.assert_allclose(found[name], x, rtol=1e-2, atol=1e-3, err_msg=name)


@pytest.mark.parametrize("method", METHODS)
def test_four_devices_find_what_one_finds(found, method):
    one, four = found
    assert (one["devices"], four["devices"]) == (1, 4)
    assert_same(four["searched"][method], one["searched"][method])


def test_a_reconstruction_lies_on_all_devices_which_say_nothing_to_each_other(found):
    one, four = found
    assert (one["places"], four["places"]) == (1, 4)
    assert one["collectives"] == four["collectives"] == []
    assert_same(four["rebuilt"], one["rebuilt"])


def test_devices_share_what_does_not_divide(found):
    one, four = found
    assert len(one["five"]["loss"]) == 5
    assert_same(four["five"], one["five"])


def test_a_callback_hears_of_every_object_from_its_device(found):
    one, four = found
    assert sorted(i for objects, _ in one["heard"] for i in objects) == sorted([*range(5)] * 5)
    assert sorted(i for objects, _ in four["heard"] for i in objects) == sorted([*range(8)] * 5)
    assert {len(objects) for objects, _ in four["heard"]} == {2}


@pytest.mark.parametrize("method", METHODS[:3])
def test_a_shard_map_of_ones_own_needs_no_settings(found, method):
    one, four = found
    assert_same(four["shard_map"][method], one["searched"][method])


@pytest.mark.parametrize("method", METHODS[:2])
@pytest.mark.parametrize("mesh", ["Auto", "Explicit"])
def test_objects_stay_where_a_mesh_has_them(found, mesh, method):
    one, four = found
    assert_same(four[mesh][method], one["searched"][method])


def test_a_mesh_that_is_set_is_used_and_a_device_that_was_chosen_is_kept(found):
    one, four = found
    assert_same(four["set_mesh"], one["searched"]["cma"])
    assert four["placed"] == 1
    assert OBJECTS % 4 == 0  # or the collectives that move the last objects would be counted
