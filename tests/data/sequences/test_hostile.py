"""Recordings that someone made to do harm: each fault costs its frame, or ends in one sentence."""

import json
import os
import struct
import zlib
from contextlib import suppress

import numpy as np
import pytest
from changed_json import changed
from device_recordings import WRITERS, shoot
from PIL import Image
from recordings import record, save, write_7_scenes, write_open3d, write_tum

from jaxshape import limits
from jaxshape.data.sequences import SequenceError, open_sequence, rasters, read_trajectory
from jaxshape.data.sequences.frames import read_color
from jaxshape.data.sequences.inspection import inspect_sequence

SEEN = record(4)
DEEP = "[" * 100_000


def fault_of(folder):
    """The sentence with which a recording is refused."""
    with pytest.raises(SequenceError) as refusal:
        inspect_sequence(open_sequence(folder))
    return str(refusal.value)


# Images ----------------------------------------------------------------------------------------


def png_header(width, height, bits=16, mode=0):
    """The beginning of a PNG that says that it is large."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, bits, mode, 0, 0, 0)
    chunks = [struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))]
    data = b"IDAT" + zlib.compress(b"")
    chunks.append(struct.pack(">I", len(data) - 4) + data + struct.pack(">I", zlib.crc32(data)))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\n%%EndComments\nshowpage\n%%EOF\n"


@pytest.mark.parametrize(
    "content",
    [
        png_header(50_000, 50_000),
        png_header(12_000, 12_000),
        png_header(8_192, 8_192),
        png_header(0, 0),
        png_header(64, 48, bits=7),
        b"II*\x00" + b"\xff" * 60,  # TIFF
        b"P5\n64 48\n99999999999\n",
        b"P5\n" + b"9" * 5000,
        EPS,
        b"BM" + bytes(200),
        b"",
    ],
)
def test_an_image_in_mid_recording_costs_its_frame_and_is_named(tmp_path, content, recwarn):
    write_7_scenes(tmp_path, SEEN)
    (tmp_path / "frame-000001.depth.png").write_bytes(content)
    (tmp_path / "frame-000002.color.png").write_bytes(content)
    sequence = open_sequence(tmp_path)
    for index in (1, 2):
        with pytest.raises(SequenceError, match=f"frame-00000{index}.*cannot be read as an image"):
            sequence[index]
    assert sequence[0].color is not None and sequence[3].color is not None
    said = [warning.sentence for warning in inspect_sequence(sequence).warnings]
    assert any("depth images that cannot be used: 1" in one for one in said)
    assert any("colour images or masks that cannot be used: 1" in one for one in said)
    assert not recwarn.list


def test_no_other_program_is_started(tmp_path, monkeypatch):
    """Pillow draws EPS by Ghostscript."""
    import subprocess

    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("a program is started"))
    for name in ("a.png", "a.jpg", "a.eps"):
        (tmp_path / name).write_bytes(EPS)
        with pytest.raises(SequenceError, match="cannot identify"):
            read_color(tmp_path / name, (48, 64))


def test_pixels_are_counted_before_they_are_decoded(tmp_path, monkeypatch):
    save(tmp_path / "a.png", SEEN.color[0])
    monkeypatch.setattr(limits, "COLOR_PIXELS", 48 * 64 - 1)
    monkeypatch.setattr(Image.Image, "load", lambda _: pytest.fail("it is decoded"))
    with pytest.raises(ValueError, match="64 x 48 pixels; 3,071 at most"):
        with rasters.open_picture(tmp_path / "a.png", limits.COLOR_PIXELS):
            pass


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((0, 5)),
        np.full((48, 64), 1e300),
        np.zeros((48, 64), "datetime64[s]"),
        np.zeros((48, 64, 2)),
    ],
)
def test_arrays_that_are_no_depth_are_refused(tmp_path, array):
    write_open3d(tmp_path, SEEN)
    (tmp_path / "depth" / "depth_1.png").unlink()
    np.save(tmp_path / "depth" / "depth_1.npy", array)
    sequence = open_sequence(tmp_path)
    if array.shape == (48, 64) and array.dtype.kind == "f":
        assert not sequence[1].depth.any()  # beyond what a depth camera writes
    else:
        with pytest.raises(SequenceError, match="cannot be read as an image"):
            sequence[1]


# Files -----------------------------------------------------------------------------------------


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_pipes_devices_and_links_to_nothing_are_passed_over_and_named(tmp_path):
    write_open3d(tmp_path, SEEN)
    os.mkfifo(tmp_path / "trajectory.json")
    (tmp_path / "camera.json").symlink_to(tmp_path / "nothing")
    (tmp_path / "poses.log").symlink_to("/dev/zero")
    (tmp_path / "circle.json").symlink_to(tmp_path / "circle.json")
    (tmp_path / "depth" / "depth_2.png").unlink()
    os.mkfifo(tmp_path / "depth" / "depth_2.png")
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 4 and sequence.has_poses
    with pytest.raises(SequenceError, match="depth_2.png.*not a regular file"):
        sequence[2]
    (finding,) = [one for one in sequence.findings if "not regular files" in one.evidence]
    assert "camera.json, circle.json, poses.log, trajectory.json" in finding.evidence


@pytest.mark.parametrize(
    "name",
    ["../outside.png", "/dev/zero", "../../../../etc/passwd", "a\0b.png", "x" * 2000, "link.png"],
)
def test_a_list_names_files_of_its_own_folder_only(tmp_path, name):
    (tmp_path / "scan").mkdir()
    write_tum(tmp_path / "scan", SEEN)
    save(tmp_path / "outside.png", SEEN.color[0])
    (tmp_path / "scan" / "link.png").symlink_to(tmp_path / "outside.png")
    with open(tmp_path / "scan" / "depth.txt", "a") as file:
        file.write(f"200.0 {name}\n")
    said = fault_of(tmp_path / "scan")
    assert "outside of" in said or "expected a path" in said


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="open files are not listed here")
def test_no_file_stays_open(tmp_path):
    for number, damage in enumerate((None, png_header(50_000, 50_000), EPS)):
        write_open3d(tmp_path / str(number), SEEN)
        if damage is not None:
            (tmp_path / str(number) / "depth" / "depth_1.png").write_bytes(damage)
    before = len(os.listdir("/proc/self/fd"))
    for number in range(60):
        sequence = open_sequence(tmp_path / str(number % 3))
        for index in (0, 1):
            with suppress(SequenceError):
                sequence[index]
    assert len(os.listdir("/proc/self/fd")) == before


# Numbers ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("time", ["nan", "inf", "-inf"])
def test_a_time_is_finite(tmp_path, time):
    write_tum(tmp_path, SEEN)
    with open(tmp_path / "depth.txt", "a") as file:
        file.write(f"{time} depth/100.000000.png\n")
    assert "a time is not finite" in fault_of(tmp_path)


OPEN3D = {"width": 64, "height": 48, "intrinsic_matrix": [60, 0, 0, 0, 60, 0, 31.5, 23.5, 1]}


@pytest.mark.parametrize(
    "change",
    [
        {"width": 0, "height": 0},
        {"width": 1e400, "height": 1e400},
        {"width": -64, "height": -48},
        {"width": 64.5, "height": 48.375},
        {"width": "64", "height": 48},
        {"width": 6.4e30, "height": 4.8e30},
        {"intrinsic_matrix": [1e30, 0, 0, 0, 1e30, 0, 31.5, 23.5, 1]},
        {"intrinsic_matrix": [0, 0, 0, 0, 0, 0, 0, 0, 0]},
        {"intrinsic_matrix": [True, 0, 0, 0, True, 0, 31.5, 23.5, 1]},
        {"intrinsic_matrix": ["60", 0, 0, 0, "60", 0, 31.5, 23.5, 1]},
        {"intrinsic_matrix": [10**400, 0, 0, 0, 60, 0, 31.5, 23.5, 1]},
    ],
)
def test_a_camera_is_of_numbers_that_a_camera_has(tmp_path, change):
    write_open3d(tmp_path, SEEN)
    (tmp_path / "camera_primesense.json").write_text(json.dumps(OPEN3D | change))
    assert "camera_primesense.json" in fault_of(tmp_path)


@pytest.mark.parametrize("name", ["camera_primesense.json", "trajectory.json"])
def test_nesting_is_refused(tmp_path, name):
    write_open3d(tmp_path, SEEN)
    (tmp_path / "trajectory.log").unlink()
    (tmp_path / name).write_text(DEEP)
    assert "nested more than" in fault_of(tmp_path)


@pytest.mark.parametrize(
    "name, text",
    [
        ("a.json", json.dumps({"parameters": [{"extrinsic": np.zeros(16).tolist()}]})),
        ("a.json", json.dumps({"parameters": [{"extrinsic": ["1"] * 16}]})),
        ("a.json", json.dumps({"parameters": {"extrinsic": 3}})),
        ("a.json", '{"parameters": ' + DEEP),
        ("a.log", "9" * 5000 + " 0 1\n" + "1 0 0 0\n" * 4),
        ("a.log", "99999999999999999999 0 1\n" + "1 0 0 0\n" * 4),
        ("a.txt", "1 1e30 0 0 0 0 0 1\n" * 2),
    ],
)
def test_trajectories_of_no_use_are_refused(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(SequenceError, match=r"(again|least|most)[^.]*\.$"):
        read_trajectory(tmp_path / name)


WORST = (None, True, "\0", {}, 0, 1e-300, 1e300, float("nan"), float("inf"))
"""What stands in a JSON file where a number should."""


@pytest.mark.parametrize("name, file", [
    ("bop", "scene_camera.json"), ("nerfstudio", "transforms.json"), ("wildrgb-d", "metadata"),
    ("record3d", "metadata.json"), ("replica", "cam_params.json"),
])  # fmt: skip
def test_anything_in_place_of_anything_ends_in_a_sentence_or_a_recording(tmp_path, name, file):
    """Every entry of the first two levels, by everything that is none, one at a time."""
    WRITERS[name](tmp_path, shoot(2))
    content = json.loads((tmp_path / file).read_text())
    for path, _ in list(entries(content)):
        for worst in WORST:
            (tmp_path / file).write_text(json.dumps(changed(content, path, worst)))
            try:
                sequence = open_sequence(tmp_path)
                assert sequence[0].depth.shape == sequence.shape
            except SequenceError as refusal:
                assert str(refusal).endswith(".")


def entries(content, path=(), depth=3):
    """Places of the entries of a JSON content, with the first of each list."""
    if path:
        yield path, content
    inside = content.items() if isinstance(content, dict) else enumerate(content[:1]) if isinstance(
        content, list) else ()  # fmt: skip
    for key, value in inside if depth else ():
        yield from entries(value, (*path, key), depth - 1)
