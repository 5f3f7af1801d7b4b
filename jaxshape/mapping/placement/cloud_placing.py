"""A point cloud of one object, placed by the prior and turned into F and M. [host]

    place_cloud    the directions up and to the front, and the position of its box
    cloud_grids    F of the points, and M of the space that no ray passed

Rays run from the sensor's position to each point. Without a sensor position, they run a short way
along the normals, since a surface can only be measured from outside. Without normals either, no
space is known to be free.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxshape.data.boxes import Box
from jaxshape.data.clouds import Cloud, surrounds, without_strays
from jaxshape.data.meshes import axes_to_canonical
from jaxshape.geometry import fusion
from jaxshape.geometry.grid import GridFrame
from jaxshape.geometry.grids import Grids
from jaxshape.mapping.placement import placing
from jaxshape.mapping.placement.placing import Placement, PlacementConfig
from jaxshape.mapping.placement.rays import FREE_GAP, FREE_POINTS, SURFACE_POINTS, RaySamples
from jaxshape.model.shapes import ShapePrior

AXES = ("y", "z", "-y", "-z", "x", "-x")
"""Directions that may be up, the likelier first."""

SURE_OF_UP, SURE_OF_FRONT = 0.02, 0.01
"""Least margin over other directions, in nats per point, for the up or front direction to be
sure."""

BELIEVED = (0.3, 2.5)
"""Range of a cloud's largest extent, in metres, for which a unit of the file is plausible."""

SEARCH = PlacementConfig(yaws=12, overhangs=(0.0, 0.25), kept=3, steps=12, steps_again=50)
"""A short search for each direction that may be up; the best one is then improved further."""

CARVING_RAYS = 20_000
"""Largest number of rays that mark free space."""

NORMAL_REACH = 4 / 32
"""Length of the free space along a normal, as a share of the grid."""

CLEARANCE = 1.5
"""Distance in front of a point, in voxels, that its ray does not mark as free, because of noise and
slanted surfaces."""


class PlacedCloud(NamedTuple):
    """A cloud in the world of its file, and the box that the prior found for it.

    Attributes:
        box: The object's box, in the frame of the file and in metres.
        metres: Metres in a unit of the file.
        up: Axis of the file that points up.
        misfit: Negative log-likelihood of the points, in nats per point.
        warnings: What a user should look at, in sentences.
    """

    box: Box
    metres: float
    up: str
    misfit: float
    warnings: tuple[str, ...]


def place_cloud(
    cloud: Cloud,
    prior: ShapePrior,
    *,
    up: str | None = None,
    front: str | None = None,
    seed: int = 0,
) -> PlacedCloud:
    """Find the object's frame and box, with the up direction that fits best.

    A cloud whose size in metres is not plausible for the object is scaled to the usual size. Single
    points far from all others do not count.

    Args:
        cloud: The cloud.
        prior: The shape prior, of whose class the object is.
        up: Axis of the file that points up, as "y" or "-z"; None to find it.
        front: Axis of the file along which the object's front looks; None to find it.
        seed: Seed of the points that are drawn, 0 or more.

    Raises:
        ValueError: The axes are not perpendicular, the sensor lies in the object, or nothing can be
            placed.
    """
    config, warnings = SEARCH, []
    every, cloud = len(cloud.points), without_strays(cloud)
    if strays := every - len(cloud.points):
        warnings.append(f"{strays} points lie far away from all others and are left out.")
    if cloud.sensor is not None and surrounds(cloud.points, cloud.sensor):
        low, high = (
            " ".join(f"{x:.3g}" for x in f(cloud.points, axis=0)) for f in (np.min, np.max)
        )
        raise ValueError(
            f"The sensor at {' '.join(f'{x:.3g}' for x in cloud.sensor)} lies within the object, "
            f"whose points reach from {low} to {high}; expected a place outside, in the frame and "
            "the unit of the file: correct --sensor, or leave it out."
        )
    metres = _metres(cloud, config)
    if metres != 1:
        extent = np.ptp(cloud.points, axis=0).max()
        warnings.append(
            f"The cloud is {extent:.3g} units large, which cannot be metres; it is taken as "
            f"{extent * metres:.2f} m."
        )
    if front is not None:  # the search starts from it and makes small turns
        config = replace(SEARCH, yaws=1)
    found = {
        one: _placed(cloud, prior, _level(one, front) * metres, config, seed)
        for one in ((up,) if up else AXES)
        if front is None or one[-1] != front[-1]
    }
    if not found:
        axes_to_canonical(str(up), str(front))  # raises if they are not perpendicular
    best = min(found, key=lambda one: float(found[one].misfit))
    if not np.isfinite(found[best].misfit):
        raise ValueError("The cloud cannot be placed: too few of its points are finite.")
    others = [float(found[one].misfit) for one in found if one != best]
    if min(others, default=np.inf) - float(found[best].misfit) < SURE_OF_UP:
        warnings.append(f"The up direction is not sure: {best} is used; state it with --up.")
    # The front is judged here, since the search that follows keeps to it.
    if front is None and float(found[best].margin) < SURE_OF_FRONT:
        warnings.append(
            "The front is not sure, because the object is symmetric; state it with --front."
        )
    final = _placed(cloud, prior, _level(best, front) * metres, config, seed, found[best])
    T = np.asarray(final.T_world_object.as_matrix(), np.float64)
    T[:3] = _level(best, front).T @ T[:3]
    box = Box(T, np.asarray(final.size, np.float64))
    return PlacedCloud(box, metres, best, float(final.misfit), tuple(warnings))


def _metres(cloud: Cloud, config: PlacementConfig) -> float:
    """Metres in a unit: 1 or 0.001 if the size is then plausible, else the scale to usual size."""
    extent = float(np.ptp(cloud.points, axis=0).max())
    low, high = BELIEVED
    likely = next((unit for unit in (1.0, 0.001) if low <= extent * unit <= high), None)
    return likely or max(config.typical_size) / extent


def _level(up: str, front: str | None) -> Float[np.ndarray, "3 3"]:
    """The rotation of the file's frame to one with +y up."""
    sideways = front or ("z" if up[-1] != "z" else "x")
    return axes_to_canonical(up, sideways)


def _placed(
    cloud: Cloud,
    prior: ShapePrior,
    level_from_file: Float[np.ndarray, "3 3"],
    config: PlacementConfig,
    seed: int,
    known: Placement | None = None,
) -> Placement:
    seen = _samples(cloud, level_from_file, np.random.default_rng(seed))
    known = placing.nothing_known(prior) if known is None else known
    return _place(prior, seen, jnp.float32(jnp.nan), known, config)


_place = jax.jit(placing.place, static_argnames="config")


def _samples(
    cloud: Cloud, level_from_file: Float[np.ndarray, "3 3"], rng: np.random.Generator
) -> RaySamples:
    """Points on the object, and free points in front of them, in a level frame and in metres."""
    points = cloud.points @ level_from_file.T
    extent = np.ptp(points, axis=0).max()
    surface = points[rng.integers(len(points), size=SURFACE_POINTS)]
    chosen = rng.integers(len(points), size=FREE_POINTS)
    middle, away = points.mean(axis=0), np.zeros(3)
    if cloud.sensor is not None:
        sensor = level_from_file @ cloud.sensor
        ray = sensor - points[chosen]
        length = np.minimum(np.linalg.norm(ray, axis=1), 1.2 * extent)
        away = (middle - sensor) / np.linalg.norm(middle - sensor)
    elif cloud.normals is not None:
        ray = _outward(cloud)[chosen] @ level_from_file.T
        length = np.full(FREE_POINTS, 2 * NORMAL_REACH * extent)
    else:  # free points so far away that they carry no information
        ray, length = np.ones((FREE_POINTS, 3)), np.full(FREE_POINTS, 20 * extent)
    ray = ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-9)
    gap = FREE_GAP * extent
    share = rng.random(FREE_POINTS) if length[0] < 10 * extent else np.ones(FREE_POINTS)
    free = points[chosen] + ray * (gap + share * np.maximum(length - gap, 0))[:, None]
    return RaySamples(jnp.float32(surface), jnp.float32(free), jnp.float32(away))


def _outward(cloud: Cloud) -> Float[np.ndarray, "n 3"]:
    """The normals, all flipped if they mostly point towards the middle of the cloud."""
    assert cloud.normals is not None
    middle = (cloud.points.min(axis=0) + cloud.points.max(axis=0)) / 2
    outside = np.sum(cloud.normals * (cloud.points - middle))
    return cloud.normals if outside >= 0 else -cloud.normals


# F and M ---------------------------------------------------------------------------------------


def cloud_grids(
    cloud: Cloud, placed: PlacedCloud, frame: GridFrame, resolution: int, *, seed: int = 0
) -> Grids:
    """F of the points of a cloud, and M of the space that no ray to them is known to have passed.

    Args:
        cloud: The cloud.
        placed: Its box, from `place_cloud`.
        frame: Voxel frame of the grids, in the object frame.
        resolution: Voxels along each axis of the grids.
        seed: Seed of the rays that are drawn, 0 or more.
    """

    def to_voxels(p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        R, t = placed.box.T_world_object[:3, :3], placed.box.T_world_object[:3, 3]
        return ((p * placed.metres - t) @ R - np.asarray(frame.origin)) / np.asarray(
            frame.voxel_size
        )

    points = to_voxels(cloud.points)
    occupied = np.asarray(fusion.count_points(jnp.float32(points), resolution)) > 0
    chosen = np.random.default_rng(seed).permutation(len(points))[:CARVING_RAYS]
    free = np.zeros_like(occupied)
    if cloud.sensor is not None:
        ends = np.broadcast_to(to_voxels(cloud.sensor[None]), (len(chosen), 3))
        free = _passed(points[chosen], ends, occupied, stops=False)
    elif cloud.normals is not None:
        ahead = to_voxels(cloud.points[chosen] + _outward(cloud)[chosen]) - points[chosen]
        ahead *= NORMAL_REACH * resolution / np.linalg.norm(ahead, axis=1, keepdims=True)
        free = _passed(points[chosen], points[chosen] + ahead, occupied, stops=True)
    return Grids(jnp.asarray(occupied), jnp.asarray(~(occupied | free)))


def _passed(
    start: Float[np.ndarray, "n 3"],
    end: Float[np.ndarray, "n 3"],
    occupied: Bool[np.ndarray, "x y z"],
    *,
    stops: bool,
) -> Bool[np.ndarray, "x y z"]:
    """Empty voxels on lines from surface points; `stops` ends each line at an occupied voxel."""
    n = occupied.shape[0]
    line = end - start
    length = np.linalg.norm(line, axis=1)
    line = line / np.maximum(length, 1e-9)[:, None]
    passed, is_open = np.zeros_like(occupied), np.ones(len(start), bool)
    for far in np.arange(CLEARANCE, min(float(length.max(initial=0)), 2.0 * n), 0.5):
        index = np.floor(start + far * line).astype(int)
        inside = ((index >= 0) & (index < n)).all(axis=1) & (far < length) & is_open
        x, y, z = index[inside].T
        passed[x, y, z] = True
        if stops:
            is_open[inside] &= ~occupied[x, y, z]
    return passed & ~occupied
