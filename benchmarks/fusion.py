"""Fusion and mask of one 640 x 480 depth frame, against NumPy and Open3D."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

import jaxshape as js
from benchmarks.harness import Metric, alternate, compiled, optional, speedup
from benchmarks.problems import FIRST_CHAIR
from benchmarks.rivals import numpy_fusion
from jaxshape.geometry import distance, grid

WIDTH, HEIGHT = 640, 480
DISTANCE = 1.5
"""Of the camera from the chair's centre, in metres: near, so that many pixels show it."""

WALL = 3.0
"""Depth of what stands behind the chair, in metres."""


class Frame(NamedTuple):
    """One frame of a depth camera, and the cubic voxels it is fused into."""

    depth: jax.Array
    segmented: jax.Array
    intrinsics: js.Intrinsics
    T_object_camera: jaxlie.SE3
    grid: js.GridFrame


def run(quick: bool) -> list[Metric]:
    frame = chair_frame()
    budget = 2.0 if quick else 10.0
    ours, compile_seconds = compiled(js.measure, *frame)
    functions = {"jaxshape": partial(ours, *frame)}
    functions["numpy"] = numpy_measure(frame)
    functions["numpy_add_at"] = partial(functions["numpy"], add_at=True)
    if open3d := optional("open3d_fusion"):
        functions["open3d"] = open3d_measure(open3d, frame)
    seconds = alternate(functions, budget=budget, at_least=5)
    distances, compile_distances = compiled(distance.measure, *frame)
    tsdf = {"jaxshape": partial(distances, *frame)}
    if open3d:
        tsdf["open3d"] = open3d_integrate(open3d, frame)
    tsdf_seconds = alternate(tsdf, budget=budget, at_least=5)

    pixels = int(frame.segmented.sum())
    metrics = [Metric("fusion/compile", compile_seconds, "s")]
    for name, times in seconds.items():
        note = f"{pixels} of {WIDTH * HEIGHT} pixels show the chair" if name == "jaxshape" else ""
        metrics.append(Metric(f"fusion/{name}", 1e3 * np.median(times), "ms", note=note))
    metrics.append(Metric("fusion/distances/compile", compile_distances, "s"))
    for name, times in tsdf_seconds.items():
        note = (
            f"{distance.FINE * grid.RESOLUTION}^3 voxels, all of them" if name == "jaxshape" else ""
        )
        median = 1e3 * np.median(times)
        metrics.append(Metric(f"fusion/distances/{name}", median, "ms", "lower", note=note))
    for name in [rival for rival in functions if rival != "jaxshape"]:
        metrics.append(
            Metric(
                f"fusion/{name}/speedup",
                speedup(seconds, "jaxshape", name),
                "x",
                "higher",
                target=10.0 if name == "numpy" else None,
            )
        )
        metrics += _agreement(name, functions["jaxshape"](), functions[name]())
    return metrics


def chair_frame() -> Frame:
    """A chair before a wall, as a Kinect sees it; a twentieth of the pixels know nothing."""
    mesh = js.random_chair(FIRST_CHAIR)
    T = js.orbit(1, DISTANCE)
    seen = js.capture(mesh, T, noise=False, seed=0, camera=js.VirtualCamera(WIDTH, WIDTH, None))
    edge = (WIDTH - HEIGHT) // 2
    depth = np.array(seen.depth[0, edge:-edge])
    segmented = np.isfinite(depth)
    depth[~segmented] = WALL
    depth[np.random.default_rng(0).random(depth.shape) < 0.05] = 0
    return Frame(
        jnp.asarray(depth),
        jnp.asarray(segmented),
        seen.intrinsics._replace(cy=jnp.float32(HEIGHT / 2)),
        jaxlie.SE3(T.wxyz_xyz[0]),
        grid.fit_box_isotropic(*jnp.float32(mesh.bounds)),
    )


def numpy_measure(frame: Frame) -> partial:
    """NumPy's fusion of the frame, as a function of nothing."""
    depth, segmented, *_ = host = jax.tree.map(np.array, frame)
    pose = np.array(frame.T_object_camera.as_matrix())
    return partial(
        numpy_fusion.measure, depth, segmented, tuple(map(float, host.intrinsics)), pose, *host.grid
    )


def open3d_measure(open3d, frame: Frame) -> partial:
    depth, segmented = np.array(frame.depth), np.array(frame.segmented)
    pose = np.array(frame.T_object_camera.as_matrix())
    camera = open3d.camera_of(tuple(map(float, frame.intrinsics)), pose, depth.shape)
    origin, size = np.array(frame.grid.origin), float(frame.grid.voxel_size[0])
    return partial(open3d.measure, depth, segmented, camera, origin, size)


def open3d_integrate(open3d, frame: Frame) -> partial:
    """Open3D's integration into voxels of the same size, near the surface alone."""
    depth = np.where(np.array(frame.segmented), np.array(frame.depth), 0)
    pose = np.array(frame.T_object_camera.as_matrix())
    size = float(distance.fine_frame(frame.grid).voxel_size[0])
    return open3d.integration(depth, tuple(map(float, frame.intrinsics)), pose, size)


def _agreement(name: str, ours: js.Measurement, theirs: tuple) -> list[Metric]:
    """Voxels that come out otherwise: rounding at the faces of voxels and the edges of pixels."""
    hits, seen_through = map(np.asarray, theirs)
    other = {
        "occupied": np.sum((np.asarray(ours.hits) > 0) != (hits > 0)),
        "seen_through": np.sum(np.asarray(ours.seen_through) != seen_through),
    }
    by_corners = "Open3D interpolates depth at a voxel's eight corners"
    return [
        Metric(f"fusion/{name}/other_{what}", float(count), "voxels", note=by_corners)
        if (name, what) == ("open3d", "seen_through")
        else Metric(f"fusion/{name}/other_{what}", float(count), "voxels", "lower", limit=30.0)
        for what, count in other.items()
    ]
