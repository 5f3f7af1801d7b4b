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
from jaxshape.data.clouds import Cloud, moved, surrounds, without_strays
from jaxshape.data.config import UNITS, UnitName, check_axes
from jaxshape.data.meshes import axis_named
from jaxshape.geometry import fusion
from jaxshape.geometry.grid import GridFrame
from jaxshape.geometry.grids import Grids
from jaxshape.mapping.placement import placing
from jaxshape.mapping.placement.placing import Placement, PlacementConfig
from jaxshape.mapping.placement.rays import FREE_GAP, FREE_POINTS, SURFACE_POINTS, RaySamples
from jaxshape.mapping.segmentation.planes import dominant_planes
from jaxshape.model.shapes import ShapePrior

AXES = ("y", "z", "-y", "-z", "x", "-x")
"""Directions that may be up, the likelier first."""

SURE_OF_UP, SURE_OF_FRONT = 0.02, 0.01
"""Least margin over other directions, in nats per point, for the up or front direction to be
sure."""

BELIEVED = (0.3, 3.0)
"""Range of a cloud's largest extent, in metres, for which a unit of the file is plausible."""

FLAT, TILTED = 0.08, 10.0
"""Least share of the points for a plane, and its least angle to all axes of the file in degrees,
for its normal to be a direction that may be up: seats are level."""

FLAT_CLOUD = 0.05
"""A cloud is flat if its smallest deviation, along a principal axis, is below this share of its
largest."""

DEEPER = (0.17, 0.35, 0.52)
"""Distances, in usual heights, by which the object may reach further down than its points."""

EXPLAINED, POORLY, EVIDENCE = 0.05, 0.12, 0.02
"""Misfits in nats per point: below the first the points are explained as they are; above the second
they are explained poorly. The third is the evidence that a lower bottom needs. Of eight CAD seats,
five are below the second misfit if they are whole, and four without their legs; the bottom of all
nine is then right to 5 cm."""

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
        up: Axis of the file that points up, as "-y"; or the direction, as "0.05 -0.91 -0.42".
        misfit: Negative log-likelihood of the points, in nats per point.
        warnings: What a user should look at, in sentences.
        cloud: The cloud without points far from all others.
    """

    box: Box
    metres: float
    up: str
    misfit: float
    warnings: tuple[str, ...]
    cloud: Cloud


def place_cloud(
    cloud: Cloud,
    prior: ShapePrior,
    *,
    up: str | None = None,
    front: str | None = None,
    unit: UnitName | None = None,
    seed: int = 0,
) -> PlacedCloud:
    """Find the object's frame and box, with the up direction that fits best.

    Up may be an axis of the file or, as in the frame of a tilted camera, the normal of a large
    plane of the cloud. The object stands on its lowest point, unless the prior is sure that its
    lower part was not measured. Single points far from all others do not count.

    Args:
        cloud: The cloud.
        prior: The shape prior, of whose class the object is.
        up: Axis of the file that points up, as "y" or "-z"; None to find it.
        front: Axis of the file along which the object's front looks; None to find it.
        unit: Unit of the file; None for the metre, centimetre or millimetre, with which the cloud
            has a plausible size. Where none has, the cloud is scaled to the usual size.
        seed: Seed of the points that are drawn, 0 or more.

    Raises:
        ValueError: The axes are not perpendicular, the sensor lies in the object, or nothing can be
            placed.
    """
    config, warnings = SEARCH, []
    every, cloud = len(cloud.points), without_strays(cloud)
    if strays := every - len(cloud.points):
        warnings.append(f"{strays} points lie far away from all others and are left out.")
    thin = np.linalg.svd(cloud.points - cloud.points.mean(axis=0), compute_uv=False)
    if thin[-1] < FLAT_CLOUD * thin[0]:
        warnings.append("The points lie in one plane, which shows little of an object.")
    if cloud.sensor is not None and surrounds(cloud.points, cloud.sensor):
        low, high = (
            " ".join(f"{x:.3g}" for x in f(cloud.points, axis=0)) for f in (np.min, np.max)
        )
        raise ValueError(
            f"The sensor at {' '.join(f'{x:.3g}' for x in cloud.sensor)} lies within the object, "
            f"whose points reach from {low} to {high}; expected a place outside, in the frame and "
            "the unit of the file: correct --sensor, or leave it out."
        )
    if up and front:
        check_axes(up, front)
    metres, said = (UNITS[unit], ()) if unit else _metres(cloud, config)
    warnings += said
    middle = (cloud.points.min(axis=0) + cloud.points.max(axis=0)) / 2
    kept, cloud = cloud, moved(cloud, -middle)  # so that single precision is enough
    if front is not None:  # the search starts from it and makes small turns
        config = replace(SEARCH, yaws=1)
    levels = {
        name: _level(direction, front) * metres
        for name, direction in _directions(cloud, metres, up).items()
        if front is None or abs(direction @ axis_named(front)) < np.cos(np.pi / 4)
    }
    found = {
        name: _placed(cloud, prior, level, config, seed, np.nan) for name, level in levels.items()
    }
    best = min(found, key=lambda one: float(found[one].misfit))
    if not np.isfinite(found[best].misfit):
        raise ValueError("The cloud cannot be placed: too few of its points are finite.")
    others = [float(found[one].misfit) for one in found if one != best]
    if min(others, default=np.inf) - float(found[best].misfit) < SURE_OF_UP:
        warnings.append(f"The up direction is not sure: {best} is used; state it with --up.")
    if best not in (up, *AXES):
        warnings.append(
            f"Up is taken to be {best}, the normal of a plane of the cloud, and no axis of the "
            "file; if this is wrong, turn the cloud upright and give --up."
        )
    # The front is judged here, since the search that follows keeps to it.
    if front is None and float(found[best].margin) < SURE_OF_FRONT:
        warnings.append(
            "The front is not sure, because the object is symmetric; state it with --front."
        )
    level, known = levels[best], found[best]
    final = _placed(cloud, prior, level, config, seed, _lowest(cloud, level), known)
    # The free space along normals ends within the object, which raises the misfit of any shape.
    is_comparable = cloud.normals is None or cloud.sensor is not None
    if is_comparable and float(final.misfit) > EXPLAINED:
        final = _perhaps_deeper(cloud, prior, level, config, seed, final)
    if is_comparable and float(final.misfit) > POORLY:
        warnings.append(
            "No shape that the prior knows explains the points well: the box and all that is "
            "predicted are doubtful. The object may be of another kind, incomplete, or not upright."
        )
    T = np.asarray(final.T_world_object.as_matrix(), np.float64)
    T[:3] = (level / metres).T @ T[:3]
    T[:3, 3] += metres * middle
    box = Box(T, np.asarray(final.size, np.float64))
    return PlacedCloud(box, metres, best, float(final.misfit), tuple(warnings), kept)


def _perhaps_deeper(
    cloud: Cloud,
    prior: ShapePrior,
    level: Float[np.ndarray, "3 3"],
    config: PlacementConfig,
    seed: int,
    standing: Placement,
) -> Placement:
    """The placement on the lowest point, or a lower one that explains the points far better."""
    lowest, height = _lowest(cloud, level), config.typical_size[1]
    deeper = [
        _placed(cloud, prior, level, config, seed, lowest - share * height) for share in DEEPER
    ]
    best = min(deeper, key=lambda one: float(one.misfit))
    if float(best.misfit) > min(POORLY, float(standing.misfit) - EVIDENCE):
        return standing
    return _placed(cloud, prior, level, config, seed, np.nan, best)


def _metres(cloud: Cloud, config: PlacementConfig) -> tuple[float, tuple[str, ...]]:
    """Metres in a unit of the file, and a warning where the unit is not the metre."""
    extent = float(np.ptp(cloud.points, axis=0).max())
    low, high = BELIEVED
    metres = {name: UNITS[name] for name in ("m", "cm", "mm")}
    likely = [name for name, one in metres.items() if low <= extent * one <= high]
    if likely == ["m"]:
        return 1.0, ()
    begins = f"The cloud is {extent:.3g} units large"
    if likely:
        name = likely[0]
        return metres[name], (f"{begins}: they are taken as {name}; else give --unit.",)
    usual = max(config.typical_size)
    return usual / extent, (
        f"{begins}, which no object in a room is in m, cm or mm: it is scaled to {usual:.2f} m, so "
        "that no length is measured; give --unit.",
    )


def _directions(cloud: Cloud, metres: float, up: str | None) -> dict[str, Float[np.ndarray, " 3"]]:
    """The directions that may be up, by name: `AXES`, and normals of large planes between them."""
    if up is not None:
        return {up: axis_named(up)}
    found = {name: axis_named(name) for name in AXES}
    # The tolerance of a plane grows with the depth of its points; here they have no depth.
    apart = metres * cloud.points + np.array([0.0, 0.0, 2.0])
    planes = [plane for plane in dominant_planes(apart, count=3) if plane.share >= FLAT]
    for plane in planes:
        if np.abs(plane.normal).max() < np.cos(np.deg2rad(TILTED)):
            for normal in (plane.normal, -plane.normal):
                found[" ".join(f"{x:.2f}" for x in normal)] = normal
    return found


def _level(up: Float[np.ndarray, " 3"], front: str | None) -> Float[np.ndarray, "3 3"]:
    """The rotation of the file's frame to one with +y up, and +z as close to the front as can be.

    Without a front, +z is an axis of the file across.
    """
    across = axis_named(front or ("z" if abs(up[2]) < np.cos(np.pi / 4) else "x"))
    z = across - (across @ up) * up
    z /= np.linalg.norm(z)
    return np.stack([np.cross(up, z), up, z])


def _lowest(cloud: Cloud, level_from_file: Float[np.ndarray, "3 3"]) -> float:
    """Height of the lowest points in a level frame, in metres, without the last stray ones."""
    return float(np.quantile(cloud.points @ level_from_file[1], 0.001))


def _placed(
    cloud: Cloud,
    prior: ShapePrior,
    level_from_file: Float[np.ndarray, "3 3"],
    config: PlacementConfig,
    seed: int,
    floor: float,
    known: Placement | None = None,
) -> Placement:
    seen = _samples(cloud, level_from_file, np.random.default_rng(seed))
    known = placing.nothing_known(prior) if known is None else known
    return _place(prior, seen, jnp.float32(floor), known, config)


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
