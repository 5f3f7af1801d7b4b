"""What is read of files that anyone may have made: regular files, within limits, and numbers."""

import json
import os
import sys
import zipfile

import numpy as np
import pytest

from jaxshape import limits, reading


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_what_is_no_regular_file_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", "/dev/zero", tmp_path):
        with pytest.raises((ValueError, IsADirectoryError), match="regular file|directory"):
            reading.read_bytes(path, 100)
    with pytest.raises(OSError):
        reading.read_bytes(tmp_path / "nothing", 100)


def test_a_link_to_a_file_is_read_and_a_large_file_is_not(tmp_path):
    (tmp_path / "file").write_bytes(b"x" * 100)
    (tmp_path / "link").symlink_to(tmp_path / "file")
    assert reading.read_bytes(tmp_path / "link", 100) == b"x" * 100
    with pytest.raises(ValueError, match="more than"):
        reading.read_bytes(tmp_path / "link", 99)


# JSON ------------------------------------------------------------------------------------------


def nested(depth):
    return "[" * depth + "1" + "]" * depth


@pytest.mark.parametrize(
    "text",
    ['"[[[[\\"]]"', '{"a": "}}{{", "b\\\\": [1, {"c": []}]}', "[]", "3", "[[], [], [[]]]", " 1e5 "],
)
def test_json_is_what_json_says(text):
    assert reading.parse_json(text) == json.loads(text)


@pytest.mark.parametrize("opening", ["[", '{"a":', '[{"b":['])
def test_nesting_ends_at_its_limit_whatever_is_nested(opening):
    per = opening.count("[") + opening.count("{")
    closing = "".join({"[": "]", "{": "}"}[one] for one in reversed(opening) if one in "[{")
    most = limits.JSON_NESTING // per
    reading.parse_json(opening * most + "1" + closing * most)
    for deep in (most + 1, 100_000):
        with pytest.raises(ValueError, match="nested more than"):
            reading.parse_json(opening * deep + "1" + closing * deep)


def test_brackets_in_texts_are_not_nesting():
    deep = nested(1000)
    assert reading.parse_json(json.dumps({"a": deep, 'b\\"' + deep: 1}))["a"] == deep
    with pytest.raises(ValueError, match="not JSON"):  # of which the second text never ends
        reading.parse_json('{"a": "' + deep + '", "' + deep)


def test_many_values_are_refused_before_they_are_made(monkeypatch):
    monkeypatch.setattr(limits, "JSON_VALUES", 100)
    assert len(reading.parse_json(json.dumps([0] * 101))) == 101
    with pytest.raises(ValueError, match="more than 100 values"):
        reading.parse_json(json.dumps([0] * 102))


@pytest.mark.parametrize("digits", [18, 19, 400, sys.get_int_max_str_digits() + 1])
def test_numbers_of_any_length_are_numbers(digits):
    assert float(reading.parse_json("[" + "9" * digits + "]")[0]) == float("9" * digits)


@pytest.mark.parametrize(
    "value, shape",
    [
        ([1, "2"], (2,)),
        ([True, 0], (2,)),
        ([None, 1], (2,)),
        ("12", (2,)),
        ([1, 2, 3], (2,)),
        ([[1, 2], [3]], (3,)),
        ([{}], (1,)),
        ({}, ()),
        (None, ()),
        ([], (1,)),
    ],
)
def test_what_is_no_number_is_not_made_one(value, shape):
    with pytest.raises(ValueError):
        reading.numbers_of(value, shape)


def test_numbers_get_their_shape():
    np.testing.assert_array_equal(reading.numbers_of([1, 2.5, -3, 0], (2, 2)), [[1, 2.5], [-3, 0]])
    assert reading.numbers_of(3, ()) == 3
    assert reading.numbers_of([1] * 14, (-1, 7)).shape == (2, 7)


# Arrays ----------------------------------------------------------------------------------------


def test_arrays_are_read_by_name(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.arange(5), b=np.eye(3))
    assert reading.array_names(path) == {"a", "b"}
    assert set(reading.read_arrays(path, ("b", "c"))) == {"b"}
    np.testing.assert_array_equal(reading.read_arrays(path)["a"], np.arange(5))


def test_a_small_file_that_unpacks_to_much_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, depth=np.zeros(10_000_000, np.uint8))
    reading.read_arrays(path)
    monkeypatch.setattr(limits, "ARRAY_FREE", 1_000_000)
    with pytest.raises(ValueError, match="bytes unpack to"):
        reading.read_arrays(path)
    reading.read_arrays(path, ("nothing",))  # which is not unpacked
    monkeypatch.setattr(limits, "ARRAY_BYTES", 9_000_000)
    with pytest.raises(ValueError, match="more than"):
        reading.read_arrays(path)


def header(text):
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize(
    "member",
    [
        header(b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}\n"),
        header(b"{'descr': '<f8', 'fortran_order': False, 'shape': (-5,)}\n"),
        header(b"{'descr': '|O', 'fortran_order': False, 'shape': (1,)}\n") + b"\x80\x04N.",
        header(b"(" * 500),
        b"\x93NUMPY\x09\x00",
        b"",
    ],
)
def test_arrays_that_promise_more_or_hold_objects_are_refused(tmp_path, member):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", member)
    with pytest.raises(ValueError):
        reading.read_arrays(tmp_path / "a.npz")
