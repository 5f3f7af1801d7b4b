"""One harness for each reader: bytes in, and out comes what they hold or a refusal in words.

A harness makes a file of the bytes and reads it. A `ValueError` or an `OSError` is a refusal;
anything else is a fault of ours. `seeds` are small valid files to begin from; the first byte of an
input chooses among the formats of a reader.
"""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from PIL import Image
from safetensors.numpy import save

from jaxshape import reading
from jaxshape.data.archives import list_meshes
from jaxshape.data.boxes import read_box
from jaxshape.data.clouds import read_cloud
from jaxshape.data.meshes import load
from jaxshape.data.sequences import open_sequence, read_trajectory
from jaxshape.data.sequences.frames import read_color, read_mask, read_raw_depth
from jaxshape.data.sequences.inspection import inspect_sequence
from jaxshape.model.weights import FORMAT, load_prior
from jaxshape.results.folder import camera_poses, extent, half_field_of_view, read_folder
from jaxshape.results.journal import Journal
from jaxshape.results.summary import headline, tracked, warnings_of
from jaxshape.results.traces import read_search

SIZE = 8
"""Rows of the images; they have 4 columns more."""

POSE = np.eye(4)
POSE[:3, 3] = 0.5, -1.25, 2


class Harness(NamedTuple):
    """A reader, and what to try it with.

    Attributes:
        read: Reads the bytes by way of a folder; raises `ValueError` or `OSError` where it refuses.
        seeds: Valid inputs.
    """

    read: Callable[[bytes, Path], object]
    seeds: Callable[[], list[bytes]]


def survives(harness: Harness, content: bytes, folder: Path) -> bool:
    """Whether a reader takes an input; raises where it neither takes nor refuses it."""
    try:
        harness.read(content, folder)
    except (ValueError, OSError) as refusal:
        if type(refusal) in (ValueError, UnicodeDecodeError) and "\n" in str(refusal):
            raise AssertionError(f"The refusal is no sentence: {refusal}") from refusal
        return False
    return True


def _written(content: bytes, folder: Path, names: tuple[str, ...]) -> Path:
    """A file of all but the first byte, which chooses its name."""
    path = folder / names[content[0] % len(names) if content else 0]
    path.write_bytes(content[1:])
    return path


def _chosen(*contents: bytes | str) -> list[bytes]:
    texts = (one.encode() if isinstance(one, str) else one for one in contents)
    return [bytes([i]) + one for i, one in enumerate(texts)]


# Text and JSON ---------------------------------------------------------------------------------


def _json(content: bytes, folder: Path) -> object:
    return reading.read_json(_written(b"\0" + content, folder, ("a.json",)))


def _trajectory(content: bytes, folder: Path) -> object:
    return read_trajectory(_written(content, folder, ("a.txt", "a.log", "a.json")))


def _trajectories() -> list[bytes]:
    rows = "\n".join(" ".join(map(str, row)) for row in POSE)
    parameters = [{"extrinsic": POSE.T.ravel().tolist()}] * 2
    tum = "# time\n1.5 0.5 -1.25 2 0 0 0 1\n1.6,0,0,0,0,0,0.6,0.8\n"
    return _chosen(tum, f"0 0 1\n{rows}\n3 3 4\n{rows}\n", json.dumps({"parameters": parameters}))


def _box(content: bytes, folder: Path) -> object:
    return read_box(_written(b"\0" + content, folder, ("box.json",)))


def _boxes() -> list[bytes]:
    hole = {"min": [-1, 0, 0], "max": [0, 1, 1]}
    oriented = {"T_world_object": POSE.tolist(), "size": [1, 0.5, 2], "exclude": [hole]}
    ranges = {"X": [0, 1], "Y": [0, 1], "h": [0, 1]}
    level = {"world_to_level": POSE.tolist(), "chair_box_level": ranges}
    level["exclude_level"] = "X > 0.5 and h < -0.25 (that)"
    return [json.dumps(one).encode() for one in (oriented, level)]


def _journal(content: bytes, folder: Path) -> object:
    return Journal(_written(b"\0" + content, folder, ("scores.json",)), {"a": 1}).rows


# Images and recordings -------------------------------------------------------------------------


def _image(content: bytes, folder: Path) -> object:
    path = _written(content, folder, ("a.png", "a.jpg", "a.tif", "a.pgm", "a.npy"))
    shape, refusals = (SIZE, SIZE + 4), []
    for read in (read_raw_depth, read_color, read_mask):
        try:
            return read(path, shape)
        except ValueError as refusal:
            refusals.append(refusal)
    raise refusals[0]


def _images() -> list[bytes]:
    depth = np.arange(SIZE * (SIZE + 4), dtype=np.uint16).reshape(SIZE, -1) * 20 + 1000
    color = np.repeat((depth % 251).astype(np.uint8)[..., None], 3, axis=-1)

    def encoded(pixels: np.ndarray, kind: str) -> bytes:
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, kind)
        return file.getvalue()

    array = io.BytesIO()
    np.save(array, depth / 1000)
    return [
        *_chosen(
            encoded(depth, "PNG"), encoded(color, "JPEG"), encoded(depth, "TIFF"),
            encoded(depth, "PPM"), array.getvalue(),
        ),
        *_chosen(encoded(color, "PNG")),
    ]  # fmt: skip


RECORDINGS = (
    "transforms.json", "scene_camera.json", "scene_gt.json", "metadata.json", "cam_params.json",
    "camera.json", "trajectory.json", "cam_K.txt", "calibration.txt", "cam_poses.txt",
    "odometry.csv", "camera_matrix.csv", "depth.txt", "groundtruth.txt", "traj.txt",
)  # fmt: skip
"""Files beside the images of a recording, each of which makes it one of a layout, or tells more."""


def _recording(content: bytes, folder: Path) -> object:
    """Two depth images with one file of some layout beside them."""
    for old in folder.glob("*.*"):
        old.unlink()
    (folder / "depth").mkdir(exist_ok=True)
    for index, image in enumerate((_images()[0], _images()[2])):
        path = folder / "depth" / f"{index}.{'png' if index == 0 else 'tif'}"
        path.write_bytes(image[1:])
    np.savetxt(folder / "cam_K.txt", [[10, 0, 6], [0, 10, 4], [0, 0, 1]])
    rows = " ".join(map(str, POSE.ravel()))
    (folder / "traj.txt").write_text(f"{rows}\n{rows}\n")
    _written(content, folder, RECORDINGS)
    return inspect_sequence(open_sequence(folder))


def _recordings() -> list[bytes]:
    K, pose = [10, 0, 6, 0, 10, 4, 0, 0, 1], POSE.tolist()
    frame = {"file_path": "depth/0.png", "depth_file_path": "depth/0.png", "transform_matrix": pose}
    camera = {"fl_x": 10, "fl_y": 10, "cx": 6, "cy": 4, "w": 12, "h": 8, "frames": [frame] * 2}
    bop = {"cam_K": K, "depth_scale": 1.0}
    seen = {"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 900], "obj_id": 1}
    phone = {"w": 12, "h": 8, "K": K, "poses": [[0, 0, 0, 1, 0, 0, 0.5]] * 2}
    phone["perFrameIntrinsicCoeffs"] = [[10, 10, 6, 4]] * 2
    rendered = {"fx": 10, "fy": 10, "cx": 6, "cy": 4, "w": 12, "h": 8, "scale": 1000}
    open3d = {
        "width": 12,
        "height": 8,
        "intrinsic_matrix": np.reshape(K, (3, 3)).T.ravel().tolist(),
    }
    path = {"parameters": [{"extrinsic": POSE.T.ravel().tolist(), "intrinsic": open3d}] * 2}
    row = " ".join(map(str, POSE.ravel()))
    odometry = (
        "timestamp, frame, x, y, z, qx, qy, qz, qw\n0.1, 0, 0, 0, 0, 0, 0, 0, 1\n0.2,1,1,,0,0,0,0,1"
    )
    return _chosen(
        json.dumps(camera), json.dumps({"0": bop, "1": bop}), json.dumps({"0": [seen], "1": []}),
        json.dumps(phone), json.dumps({"camera": rendered}), json.dumps(open3d), json.dumps(path),
        "10 0 6\n0 10 4\n0 0 1\n", "10 10 6 4\n", f"0 {row}\n1 {row}\n", odometry,
        "10,0,6\n0,10,4\n0,0,1\n", "1.0 depth/0.png\n1.1 depth/1.tif\n",
        "1.0 0 0 0 0 0 0 1\n1.1 0 0 0.5 0 0 0 1\n", f"{row}\n{row}\n",
    )  # fmt: skip


def _npz(content: bytes, folder: Path) -> object:
    sequence = open_sequence(_written(b"\0" + content, folder, ("scan.npz",)))
    return sequence[0]


def _saved(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def _npzs() -> list[bytes]:
    K = np.array([[10.0, 0, 6], [0, 10, 4], [0, 0, 1]])
    depth, color = np.full((2, 8, 12), 1.5, np.float32), np.zeros((2, 8, 12, 3), np.uint8)
    times, poses = np.array([0.0, 0.1]), np.stack([POSE, POSE])
    return [_saved(depth=depth, color=color, K=K, poses=poses, times=times)]


# Meshes, clouds and weights --------------------------------------------------------------------

MESHES = ("a.obj", "a.off", "a.ply", "a.stl", "a.glb", "a.gltf", "a.zip", "a.sh3f")


def _mesh(content: bytes, folder: Path) -> object:
    for old in folder.glob("a.*"):
        old.unlink()
    return [load(source) for source in list_meshes(_written(content, folder, MESHES))[:3]]


def _meshes() -> list[bytes]:
    box = trimesh.creation.box((1, 2, 3))
    kinds = ("obj", "off", "ply", "stl", "glb")
    made = [box.export(file_type=kind) for kind in kinds]
    gltf = json.loads(trimesh.Scene(box).export(file_type="gltf", merge_buffers=True)["model.gltf"])
    for buffer in gltf["buffers"]:
        buffer["uri"] = "data:application/octet-stream;base64," + "AAAA" * 200
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("b/box.off", made[1])
    return _chosen(*made, json.dumps(gltf), archive.getvalue(), archive.getvalue())


def _cloud(content: bytes, folder: Path) -> object:
    return read_cloud(_written(content, folder, ("a.ply", "a.pcd")))


def _clouds() -> list[bytes]:
    points = np.random.default_rng(0).normal(size=(120, 3)).astype(np.float32)
    header = "# .PCD v0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 120\nHEIGHT 1\n"
    header += "VIEWPOINT 0 0 1 1 0 0 0\nPOINTS 120\nDATA "
    lines = "\n".join(" ".join(f"{x:.3f}" for x in point) for point in points)
    ply = trimesh.PointCloud(points).export(file_type="ply")
    binary = header.encode() + b"binary\n" + points.tobytes()
    flat = points.T.tobytes()
    runs = b"".join(bytes([31]) + flat[i : i + 32] for i in range(0, len(flat), 32))
    packed = len(runs).to_bytes(4, "little") + len(flat).to_bytes(4, "little") + runs
    compressed = header.encode() + b"binary_compressed\n" + packed
    ascii_points = f"{header}ascii\n{lines}\n".encode()
    return [b"\0" + ply, *(b"\1" + one for one in (binary, compressed, ascii_points))]


def _weights(content: bytes, folder: Path) -> object:
    return load_prior(_written(b"\0" + content, folder, ("a.safetensors",)))


def _all_weights() -> list[bytes]:
    tensors = {
        "components": np.zeros((2, 8, 8, 8), np.float16), "mean": np.zeros((8, 8, 8), np.float16),
        "variances": np.ones(2, np.float16), "slope": np.float16(8), "noise": np.float16(0.1),
        "code_mean": np.zeros(2, np.float32), "code_covariance": np.eye(2, dtype=np.float32),
    }  # fmt: skip
    arrays = {name: np.asarray(x) for name, x in tensors.items()}
    return [save(arrays, {"format": FORMAT, "kind": "pca", "card": "{}"})]


# Results ---------------------------------------------------------------------------------------

RESULTS = ("result.json", "keyframes.json", "grid.npz", "mesh.ply", "trace.npz")


def _result(content: bytes, folder: Path) -> object:
    """All that the report and the viewer tell in words of a result with one file from elsewhere."""
    for old in folder.iterdir():
        old.unlink()
    for seed in _results():
        _written(seed, folder, RESULTS)
    _written(content, folder, RESULTS)
    found = read_folder(folder)
    said = [*headline(found), *warnings_of(found), *map(tracked, found.keyframes)]
    placed = camera_poses(found), extent(found), half_field_of_view(found)
    return said, placed, read_search(folder)


def _results() -> list[bytes]:
    result = {"object": "a <chair>", "method": "cma", "frames": 3, "objective_encoder": 0.2,
              "objective_refined": 0.1, "mesh_measured": 0.5, "seconds": 3.0, "warnings": ["a"],
              "verdict": "good", "quality": {"size": [1, 2, 3], "explained": 0.9}}  # fmt: skip
    frame = {"index": 0, "name": "0", "status": "keyframe", "T_world_camera": POSE.tolist()}
    keyframes = {"intrinsics": [10, 10, 6, 4], "shape": [8, 12], "frames": [frame, frame],
                 "keyframes": [frame | {"inlier_fraction": 0.9, "rmse": 0.01}]}  # fmt: skip
    grid = np.zeros((4, 4, 4), bool)
    grids = _saved(occupied=grid, composed=~grid, origin=np.zeros(3), voxel_size=np.ones(3),
                   T_world_object=POSE)  # fmt: skip
    row = np.zeros(3, np.float32)
    trace = _saved(best_loss=row, loss=row, spread=row, evaluations=row)
    ply = trimesh.creation.box().export(file_type="ply")
    return _chosen(json.dumps(result), json.dumps(keyframes), grids, ply, trace)


HARNESSES = {
    "json": Harness(_json, lambda: [b'{"a": [1, -2.5e3, "b\\"]", null, true], "c": {}}']),
    "trajectory": Harness(_trajectory, _trajectories),
    "box": Harness(_box, _boxes),
    "journal": Harness(
        _journal, lambda: [b'{"settings": {"a": 1}, "seconds": 2.5, "rows": {"b": {"c": 1}}}']
    ),
    "image": Harness(_image, _images),
    "recording": Harness(_recording, _recordings),
    "npz": Harness(_npz, _npzs),
    "mesh": Harness(_mesh, _meshes),
    "cloud": Harness(_cloud, _clouds),
    "weights": Harness(_weights, _all_weights),
    "result": Harness(_result, _results),
}
"""Readers by name."""
