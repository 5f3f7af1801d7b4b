"""Small recordings as phones, datasets and renderers write them, one writer for each format.

Each writer takes what was recorded, with a camera of each frame, and writes it with the units, axes
and names of its format, whose own camera is that of `lenses` or else of the first frame.
"""

import json
from typing import NamedTuple

import numpy as np
import recordings
from PIL import Image
from recordings import CX, CY, FX, H, W, raw, save
from scipy.spatial.transform import Rotation

from jaxshape.data.sequences.cameras import intrinsic_numbers

NOWHERE = np.eye(4)
TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


class DeviceFrame(NamedTuple):
    depth: np.ndarray
    color: np.ndarray
    mask: np.ndarray
    T_world_camera: np.ndarray
    K: np.ndarray
    """Ours, of each frame."""

    @property
    def opencv(self):
        return self.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]


def shoot(count=5, zoom=0.0):
    """The camera of `recordings.record`, whose focal length grows by a share in each frame."""
    seen = recordings.record(count)
    K = np.stack([np.diag([1 + zoom * i, 1 + zoom * i, 1]) @ recordings.K for i in range(count)])
    K[:, :2, 2] = CX, CY
    v, u = np.mgrid[:H, :W] + 0.5
    pixels = np.stack([u, v, np.ones((H, W))], -1)
    depth = [
        recordings._depth(pixels @ np.linalg.inv(k).T @ T[:3, :3].T, T[:3, 3])
        for k, T in zip(K, seen.T_world_camera, strict=True)
    ]
    depth = np.rint(np.stack(depth) * 1000) / 1000
    return DeviceFrame(depth, seen.color, seen.mask, seen.T_world_camera, K)


def write_scannet(folder, seen):
    for i, T in enumerate(seen.T_world_camera):
        save(folder / f"depth/{i}.png", raw(seen.depth[i], 1000))
        save(folder / f"color/{i}.png", seen.color[i])
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{i}.txt", T)
    (folder / "intrinsic").mkdir()
    K = np.eye(4)
    K[:3, :3] = seen.opencv[0]
    np.savetxt(folder / "intrinsic/intrinsic_depth.txt", K)


def write_bop(folder, seen, unit=0.1, w2c=True, T_world_object=NOWHERE):
    """`unit` is the millimetres in a unit of depth; two objects, the first one in every image."""
    cameras, truth = {}, {}
    for i, T in enumerate(seen.T_world_camera):
        name = f"{i + 1:06d}"
        save(folder / f"depth/{name}.png", raw(seen.depth[i], 1000 / unit))
        save(folder / f"rgb/{name}.png", seen.color[i])
        save(folder / f"mask_visib/{name}_000001.png", seen.mask[i].astype(np.uint8) * 255)
        inverse = np.linalg.inv(T)
        about = {"cam_K": seen.opencv[i].ravel().tolist(), "depth_scale": unit}
        if w2c:
            about["cam_R_w2c"] = inverse[:3, :3].ravel().tolist()
            about["cam_t_w2c"] = (inverse[:3, 3] * 1000).tolist()
        model = inverse @ T_world_object
        ours = {
            "cam_R_m2c": model[:3, :3].ravel().tolist(),
            "cam_t_m2c": (1000 * model[:3, 3]).tolist(),
            "obj_id": 4,
        }
        cameras[str(i + 1)], truth[str(i + 1)] = about, [{**ours, "obj_id": 9}, ours]
    truth["1"][0]["obj_id"] = 7  # object 9 is not in the first image
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    (folder / "scene_gt.json").write_text(json.dumps(truth))


def write_wild_rgbd(folder, seen):
    lines = []
    for i, T in enumerate(seen.T_world_camera):
        save(folder / f"depth/{i:05d}.png", raw(seen.depth[i], 1000))
        save(folder / f"rgb/{i:05d}.png", seen.color[i])
        save(folder / f"masks/{i:05d}.png", seen.mask[i].astype(np.uint8) * 255)
        lines.append(" ".join(map(repr, [i, *T.ravel().tolist()])))
    (folder / "cam_poses.txt").write_text("\n".join(lines) + "\n")
    about = {"w": W, "h": H, "K": seen.opencv[0].T.ravel().tolist()}
    (folder / "metadata").write_text(json.dumps(about))


def write_stray_scanner(folder, seen, own_cameras=True, unpacked=True):
    """The film has 30 times as many pixels on a side as the depth images; so has its camera."""
    film = np.diag([30.0, 30.0, 1.0]) @ seen.K
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw" + ", fx, fy, cx, cy" * own_cameras]
    for i, T in enumerate(seen.T_world_camera):
        save(folder / f"depth/{i:06d}.png", raw(seen.depth[i], 1000))
        confidence = np.where(seen.mask[i], 2, 0).astype(np.uint8)
        save(folder / f"confidence/{i:06d}.png", confidence)
        if unpacked:
            save(
                folder / f"rgb/{i:06d}.png", np.kron(seen.color[i], np.ones((30, 30, 1), np.uint8))
            )
        numbers = [5e4 + i / 60, i, *T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        numbers += intrinsic_numbers(film[i]) * own_cameras
        lines.append(
            ", ".join(str(float(x)) if j != 1 else f"{i:06d}" for j, x in enumerate(numbers))
        )
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    np.savetxt(folder / "camera_matrix.csv", film[0], delimiter=", ")
    (folder / "rgb.mp4").write_bytes(b"")


def write_record3d(folder, seen):
    """Depth in metres; the camera is that of colour images four times as large."""
    large = np.diag([4.0, 4.0, 1.0]) @ seen.K
    (folder / "depth").mkdir(parents=True)
    poses = []
    for i, T in enumerate(seen.T_world_camera @ TO_OPENGL):
        np.save(folder / f"depth/{i}.npy", seen.depth[i].astype(np.float32))
        save(folder / f"rgb/{i}.png", seen.color[i])
        poses.append([*Rotation.from_matrix(T[:3, :3]).as_quat().tolist(), *T[:3, 3].tolist()])
    about = {
        "w": 4 * W,
        "h": 4 * H,
        "K": large[0].T.ravel().tolist(),
        "poses": poses,
        "perFrameIntrinsicCoeffs": [intrinsic_numbers(k) for k in large],
        "fps": 60,
    }
    (folder / "metadata.json").write_text(json.dumps(about))


def write_nerfstudio(folder, seen, applied_scale=1.0):
    frames = []
    for i, T in enumerate(seen.T_world_camera @ TO_OPENGL):
        T[:3, 3] *= applied_scale
        name = f"frame_{i + 1:05d}.png"
        save(folder / "depth" / name, raw(seen.depth[i], 1000))
        save(folder / "images" / name, seen.color[i])
        save(folder / "masks" / name, seen.mask[i].astype(np.uint8) * 255)
        fx, fy, cx, cy = intrinsic_numbers(np.diag([2.0, 2.0, 1.0]) @ seen.K[i])
        frames.append(
            {
                "file_path": f"./images/{name}",
                "depth_file_path": f"./depth/{name}",
                "mask_path": f"masks/{name}",
                "transform_matrix": T.tolist(),
                **{"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": 2 * W, "h": 2 * H},
            }
        )
    about = {"camera_model": "OPENCV", "frames": frames[::-1], "k1": 0.0}
    if applied_scale != 1:
        about["applied_scale"] = applied_scale
    (folder / "transforms.json").write_text(json.dumps(about))


def write_replica(folder, seen):
    for i in range(len(seen.depth)):
        save(folder / f"results/depth{i:06d}.png", raw(seen.depth[i], 6553.5))
        save(folder / f"results/frame{i:06d}.png", seen.color[i])
    np.savetxt(folder / "traj.txt", seen.T_world_camera.reshape(-1, 16))
    camera = {"w": W, "h": H, "fx": FX, "fy": FX, "cx": CX - 0.5, "cy": CY - 0.5, "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))


def write_npz(folder, seen):
    np.savez(
        folder / "scan.npz",
        depth=seen.depth.astype(np.float32),
        color=seen.color,
        masks=seen.mask,
        K=seen.opencv,
        poses=seen.T_world_camera,
    )


def write_icl_nuim(folder, seen):
    """Its own y axes point up, in the camera and in the world; the images do not."""
    mirror, lines = np.diag([1.0, -1.0, 1.0, 1.0]), []
    for i, T in enumerate(seen.T_world_camera):
        save(folder / f"depth/{i}.png", raw(seen.depth[i], 5000))
        save(folder / f"rgb/{i}.png", seen.color[i])
        theirs = mirror @ T @ mirror
        numbers = [i, *theirs[:3, 3], *Rotation.from_matrix(theirs[:3, :3]).as_quat()]
        lines.append(" ".join(map(repr, map(float, numbers))))
    (folder / "associations.txt").write_text("0 depth/0.png 0 rgb/0.png\n")
    (folder / "livingRoom1.gt.freiburg").write_text("\n".join(lines) + "\n")
    np.savetxt(folder / "cam_K.txt", seen.opencv[0])


def write_realsense(folder, seen):
    """The cameras of depth and colour do not start at the same time."""
    for i in range(len(seen.depth)):
        time = 1_600_000_000_000.5 + 33.333 * i
        raw(seen.depth[i], 1000).astype("<u2").tofile(folder / f"walk_Depth_{time:.8f}.raw")
        save(folder / f"walk_Color_{time + 4:.8f}.png", seen.color[i])
    np.savetxt(folder / "cam_K.txt", seen.opencv[0])


def save_float_tiff(path, depth):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(depth.astype(np.float32)).save(path)


WRITERS = {
    "scannet": write_scannet,
    "bop": write_bop,
    "wildrgb-d": write_wild_rgbd,
    "stray-scanner": write_stray_scanner,
    "record3d": write_record3d,
    "nerfstudio": write_nerfstudio,
    "replica": write_replica,
    "icl-nuim": write_icl_nuim,
    "npz": write_npz,
}
OWN_CAMERAS = ("bop", "stray-scanner", "record3d", "nerfstudio", "npz")
"""Formats in which each frame has a camera of its own."""
