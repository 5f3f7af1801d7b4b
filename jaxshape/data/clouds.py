"""Point clouds and fused models of one object, from PLY and PCD files. [host]"""

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jaxshape.data.archives import MeshSource, read_bytes
from jaxshape.data.formats.ply import parse_ply
from jaxshape.data.meshes import sample_oriented
from jaxshape.data.pcd import parse_pcd

SUFFIXES = (".ply", ".pcd")

MAX_POINTS = 200_000
"""Largest number of points; of larger clouds, this number is drawn."""

FEWEST = 100
"""Smallest number of points that can be completed."""

NEIGHBOURS, FARTHER, FAR = 8, 8.0, 0.05
"""A point is a stray if the distance to its eighth neighbour is over eight times that of nearly all
points, and over a twentieth of the cloud's extent."""

LARGE = 2000
"""Coordinates are large from so many extents of the cloud on."""

STEPS = 256
"""Least number of steps that single precision must leave to the coordinates within the cloud."""


class Cloud(NamedTuple):
    """Points on the surface of one object, in the frame and the unit of their file.

    Attributes:
        points: The points `[n 3]`.
        normals: Outward normals `[n 3]`, of length 1; None if they are not known.
        sensor: Position of the sensor that measured all points `[3]`; None if it is not known.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"] | None
    sensor: Float[np.ndarray, " 3"] | None


def read_cloud(path: str | os.PathLike[str], *, seed: int = 0) -> Cloud:
    """Read a point cloud or a fused model.

    For a triangle mesh, points are sampled over its surface, with its normals. Points that are not
    finite are left out, and so is the origin if it occurs more than once: cameras write it for
    pixels without a measurement. All normals are dropped if one of them has no length.

    Args:
        path: A `.ply` or `.pcd` file.
        seed: Seed of the draw of points, 0 or more.

    Returns:
        Up to `MAX_POINTS` points, with their normals and the sensor's position if the file has
        them.

    Raises:
        ValueError: The file is of another kind, damaged, or holds too few points.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"There is no file {path}; give a point cloud, .ply or .pcd.")
    kind = path.suffix.lower()
    if kind not in SUFFIXES:
        raise ValueError(f"{path} is no point cloud; expected {' or '.join(SUFFIXES)}: convert it.")
    try:
        content = read_bytes(MeshSource(path.stem, str(path)))
        found = _measured(_read_ply(content, seed) if kind == ".ply" else _read_pcd(content))
    except Exception as error:  # parsers of foreign files may raise anything
        reason = " ".join(f"{error or type(error).__name__}".split())[:300].rstrip(".")
        raise ValueError(
            f"{path} cannot be read as a point cloud ({reason}); expected a whole PLY or PCD file: "
            "save it again."
        ) from error
    cloud = _drawn(found, seed)
    if len(cloud.points) < FEWEST or np.ptp(cloud.points, axis=0).max() == 0:
        raise ValueError(
            f"{path} holds {len(cloud.points)} usable points; expected {FEWEST} or more, of one "
            "object."
        )
    if cloud.sensor is not None and surrounds(without_strays(cloud).points, cloud.sensor):
        return cloud._replace(sensor=None)  # the cloud was moved after it was measured
    return cloud


def surrounds(points: Float[np.ndarray, "n 3"], place: Float[np.ndarray, " 3"]) -> bool:
    """Whether a place lies between the points along every axis.

    Args:
        points: The points.
        place: The place, in their frame.
    """
    return bool(((points.min(axis=0) < place) & (place < points.max(axis=0))).all())


def moved(cloud: Cloud, by: Float[np.ndarray, " 3"]) -> Cloud:
    """The cloud at another place.

    Args:
        cloud: The cloud.
        by: How far it is moved, in its unit.
    """
    sensor = None if cloud.sensor is None else cloud.sensor + by
    return cloud._replace(points=cloud.points + by, sensor=sensor)


def offset_of(cloud: Cloud) -> Float[np.ndarray, " 3"]:
    """The middle of a cloud in whole units if its coordinates are large (`LARGE`), else zeros.

    Args:
        cloud: The cloud.
    """
    if np.abs(cloud.points).max() < LARGE * np.ptp(cloud.points, axis=0).max():
        return np.zeros(3)
    return np.rint(np.median(cloud.points, axis=0))


def without_strays(cloud: Cloud) -> Cloud:
    """The cloud without single points and small groups that are far from all others, as when a
    pixel at an edge is measured in the air.

    Args:
        cloud: The cloud.
    """
    low, high = np.quantile(cloud.points, (0.01, 0.99), axis=0)
    distance = KDTree(cloud.points).query(cloud.points, k=NEIGHBOURS + 1)[0][:, -1]
    usual = np.quantile(distance, 0.95)
    kept = distance <= max(FARTHER * usual, FAR * (high - low).max())
    normals = None if cloud.normals is None else cloud.normals[kept]
    return cloud._replace(points=cloud.points[kept], normals=normals)


def _read_ply(content: bytes, seed: int) -> Cloud:
    vertices, faces, columns = parse_ply(content)
    if len(faces):
        return _from_faces(vertices, faces, seed)
    return Cloud(vertices, _normals_of(columns, len(vertices)), None)


def _from_faces(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], seed: int
) -> Cloud:
    corners = vertices[faces]
    area = trimesh.triangles.area(corners)
    used = np.isfinite(corners).all(axis=(1, 2)) & (area > 0)
    if not used.any() or not np.isfinite(area[used].sum()):
        raise ValueError("its triangles have no area")
    usable = trimesh.Trimesh(vertices, faces[used], process=False)
    return Cloud(*sample_oriented(usable, MAX_POINTS, seed), None)


def _read_pcd(content: bytes) -> Cloud:
    values, viewpoint = parse_pcd(content)
    if missing := [axis for axis in "xyz" if axis not in values]:
        raise ValueError(f"it has no field {missing[0]}")
    points = np.stack([values[axis] for axis in "xyz"], axis=-1)
    return Cloud(points, _normals_of(values, len(points)), viewpoint)


def _normals_of(columns: dict[str, Any], count: int) -> Float[np.ndarray, "n 3"] | None:
    """Normals from fields with the names of PLY (nx) or PCD (normal_x)."""
    for pattern in ("n{}", "normal_{}"):
        wanted = [pattern.format(axis) for axis in "xyz"]
        if all(name in columns for name in wanted):
            normals = np.stack([np.ravel(columns[name]) for name in wanted], axis=-1)
            return normals.astype(np.float64) if normals.shape == (count, 3) else None
    return None


def _measured(cloud: Cloud) -> Cloud:
    kept = np.isfinite(cloud.points).all(axis=1) & (np.abs(cloud.points) < 1e9).all(axis=1)
    away = cloud.points.any(axis=1)
    if np.sum(~away) > 1:
        kept &= away
    normals = None if cloud.normals is None else cloud.normals[kept]
    if normals is not None:
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        is_known = np.isfinite(lengths).all() and (lengths > 1e-6).all()
        normals = normals / lengths if is_known else None
    _require_precision(cloud.points[kept])
    return Cloud(cloud.points[kept], normals, cloud.sensor)


def _require_precision(points: Float[np.ndarray, "n 3"]) -> None:
    """Refuse coordinates so large that the single precision of their file has rounded the shape."""
    if not len(points):
        return
    step = float(np.spacing(np.float32(np.abs(points).max())))
    is_rounded = (points == points.astype(np.float32)).all()
    if is_rounded and STEPS * step > np.ptp(points, axis=0).max():
        raise ValueError(
            f"its coordinates reach {np.abs(points).max():.3g}, where single precision has steps "
            f"of {step:.2g}: subtract their middle before the file is written, or write doubles"
        )


def _drawn(cloud: Cloud, seed: int) -> Cloud:
    if len(cloud.points) <= MAX_POINTS:
        return cloud
    chosen = np.random.default_rng(seed).permutation(len(cloud.points))[:MAX_POINTS]
    normals = None if cloud.normals is None else cloud.normals[chosen]
    return Cloud(cloud.points[chosen], normals, cloud.sensor)
