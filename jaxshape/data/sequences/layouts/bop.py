"""BOP datasets (Hodan et al., ECCV 2018), YCB-Video among them: one scene of many objects."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxshape.data.sequences.cameras import Calibration
from jaxshape.data.sequences.documents import matrix_of, read_json_object
from jaxshape.data.sequences.frames import Finding, FrameFiles, SequenceError
from jaxshape.data.sequences.listing import (
    COLOR_SUFFIXES,
    Contents,
    Listed,
    depth_images,
    files_in,
    has_depth_folder,
    partners,
)
from jaxshape.data.sequences.poses import known

Instance = tuple[int, int]
"""Number of an object, and its index among the objects with this number in an image."""


def fits(contents: Contents) -> bool:
    return "scene_camera.json" in contents.files and has_depth_folder(contents)


def list_frames(contents: Contents) -> Listed:
    """`depth/`, `rgb/` or `gray/`, `scene_camera.json`, and perhaps `scene_gt.json` with masks.

    Each image has its own camera and its own unit of depth. The world frame comes from `cam_R_w2c`
    if every image has one; otherwise it is the frame of the object that most images show.
    """
    source = contents.folder / "scene_camera.json"
    about = _by_key(source)
    every = depth_images(contents)
    depth = {name: path for name, path in every.items() if _key(name) in about}
    if not depth:
        raise SequenceError(f"{source} names none of the depth images; copy it again.")
    images = [about[_key(name)] for name in depth]
    truth = _ground_truth(contents)
    instance, findings = _instance(truth)
    color = partners(depth, files_in(contents, ("rgb", "gray"), COLOR_SUFFIXES))
    return Listed(
        files=tuple(
            FrameFiles(name, path, color[i], _mask(contents, truth, name, instance))
            for i, (name, path) in enumerate(depth.items())
        ),
        depth_scale=_depth_scale(images, source),
        read_pose=_poses(images, [truth.get(_key(name), []) for name in depth], instance, source),
        calibration=Calibration(_cameras(images, source), None, source.name),
        findings=(*findings, *_left_out(len(every) - len(depth), source)),
    )


def _left_out(count: int, source: Path) -> tuple[Finding, ...]:
    if not count:
        return ()
    advice = "They are left out; copy the file again, if it should name them."
    return (Finding(f"{count} depth images are not in {source.name}", advice),)


def _key(name: str) -> str:
    """The key of an image: its number without zeros in front, as the JSON files usually have it."""
    return (name.lstrip("0") or "0") if name.isdecimal() else name


def _by_key(source: Path) -> dict[str, Any]:
    """The entries of a JSON file by the keys of their images."""
    return {_key(name): entry for name, entry in read_json_object(source).items()}


def _cameras(images: list[Any], source: Path) -> Float[np.ndarray, "n 3 3"]:
    K = np.stack([matrix_of(_entry(one, "cam_K"), (3, 3), source, "cam_K") for one in images])
    K[:, :2, 2] += 0.5  # their coordinates start at the centre of the first pixel
    return K


def _entry(image: Any, name: str) -> Any:
    return image.get(name) if isinstance(image, dict) else None


def _depth_scale(images: list[Any], source: Path) -> float:
    """Depth units per metre, from the millimetres per unit, which all images must share."""
    units = {
        float(matrix_of(_entry(one, "depth_scale") or 1.0, (), source, "depth_scale"))
        for one in images
    }
    if len(units) != 1 or not all(np.isfinite(unit) and unit > 0 for unit in units):
        raise SequenceError(
            f"{source} gives the depth scales {sorted(units)[:3]}; expected one that is positive, "
            "of all images: split the scene, or save its depth images in one unit."
        )
    return 1000.0 / units.pop()


# Objects and poses -----------------------------------------------------------------------------


def _ground_truth(contents: Contents) -> dict[str, Any]:
    if "scene_gt.json" not in contents.files:
        return {}
    return _by_key(contents.folder / "scene_gt.json")


def _instances(objects: Any) -> list[Instance]:
    """The objects of one image, in the order of its list."""
    seen: Counter[int] = Counter()
    found = []
    for one in objects if isinstance(objects, list) else []:
        number = _entry(one, "obj_id")
        number = number if isinstance(number, int) else -1
        found.append((number, seen[number]))
        seen[number] += 1
    return found


def _instance(truth: dict[str, Any]) -> tuple[Instance | None, tuple[Finding, ...]]:
    """The object that most images show; the first one of several."""
    shown = Counter(instance for objects in truth.values() for instance in _instances(objects))
    if not shown:
        return None, ()
    chosen = min(shown, key=lambda instance: (-shown[instance], instance))
    if len(shown) == 1:
        return chosen, ()
    return chosen, (
        Finding(
            f"the scene holds {len(shown)} objects; masks and object poses belong to object "
            f"{chosen[0]}, which most images show",
            "For another object, remove the folders mask_visib and mask, and --click it.",
        ),
    )


def _mask(
    contents: Contents, truth: dict[str, Any], name: str, instance: Instance | None
) -> Path | None:
    order = _instances(truth.get(_key(name)))
    if instance not in order:
        return None
    for folder in ("mask_visib", "mask"):
        path = contents.folder / folder / f"{name}_{order.index(instance):06d}.png"
        if folder in contents.folders and path.is_file():
            return path
    return None


def _poses(images: list[Any], truth: list[Any], instance: Instance | None, source: Path):
    if all(_entry(one, "cam_R_w2c") is not None for one in images):
        return lambda index: _inverse(images[index], "w2c", source)
    if instance is None:
        return None

    def read(index: int) -> Float[np.ndarray, "4 4"] | None:
        order = _instances(truth[index])
        if instance not in order:
            return None
        return _inverse(truth[index][order.index(instance)], "m2c", source)

    return read


def _inverse(entry: Any, frames: str, source: Path) -> Float[np.ndarray, "4 4"] | None:
    """Camera to world, or to model, from the rotation and translation (in mm) of the inverse."""
    T = np.eye(4)
    T[:3, :3] = matrix_of(_entry(entry, f"cam_R_{frames}"), (3, 3), source, f"cam_R_{frames}")
    T[:3, 3] = matrix_of(_entry(entry, f"cam_t_{frames}"), (3,), source, f"cam_t_{frames}") / 1000
    T_camera = known(T, f"A pose of {source.parent}")
    return None if T_camera is None else np.linalg.inv(T_camera)
