r"""Distance of meshes from the true surface: fused and completed, from voxels, and from Open3D.

    python experiments/surface_accuracy.py --meshes cad_chairs/

Every eighth of the 78 CAD seats, seen by a Kinect's noisy frames along an orbit, with true poses.
Three meshes are compared: fused distances completed by the encoder's shape, with measured and
predicted vertices apart; composed voxels, smoothed, as before; and Open3D's block grid of signed
distances with voxels of the same size (where open3d is installed). The figures are distances from
their vertices to the CAD surface, and from the visible part of that surface to the mesh, in
millimetres: mean and 90th percentile.

Results: experiments/results/surface_accuracy.json; seats that are done are kept.
Time: 4 minutes on two cores.
"""

import importlib.util
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro
from jaxtyping import Float
from scipy.spatial import KDTree

import runs
from filming import from_orbit
from jaxshape.data import render
from jaxshape.data.capture import Capture, fuse_frames
from jaxshape.data.dataset import Object
from jaxshape.data.virtual_cameras import CAMERAS
from jaxshape.geometry import camera, evidence
from jaxshape.geometry.distance import fine_frame
from jaxshape.geometry.grids import Grids, binary
from jaxshape.model.shapes import ShapePrior, decode, encode
from jaxshape.model.weights import fingerprint, load_prior
from jaxshape.results.fused_surface import fuse_surface
from jaxshape.results.journal import Journal
from jaxshape.results.output import SMOOTHING
from jaxshape.results.surface import surface
from jaxshape.search.composition import compose
from study import listed

DEVICE = CAMERAS["kinect"]
SAMPLES, POINTS = 200_000, 15_000
"""Number of points that represent a surface, and of points whose distance to it is measured."""


@dataclass(frozen=True)
class Config(runs.Config):
    """Settings of the experiment."""

    meshes: Path | None = None
    """Folder of the CAD seats; without it, procedural chairs kept for tests."""
    every: int = 8
    """Take every n-th seat."""
    frames: tuple[int, ...] = (4, 18)
    """Numbers of frames that are fused."""
    weights: Path = Path("chair-autoencoder")
    """Weights of the shape prior; the package's by default."""


def main(config: Config) -> None:
    journal = run(config.reduced(meshes=None, every=39, frames=(2, 4)))
    for k, ways in means(journal.rows)["means"].items():
        for way, values in ways.items():
            print(f"{k:>3} frames  {way:<24}" + "".join(f"{x:8.2f}" for x in values))


def run(config: Config) -> Journal:
    """Measure the meshes of every chair, and write the results."""
    prior = load_prior(config.weights)
    journal = config.journal(
        "surface_accuracy",
        set="procedural" if config.meshes is None else "CAD",
        every=config.every,
        frames=config.frames,
        weights=fingerprint(prior),
        open3d=importlib.util.find_spec("open3d") is not None,
    )
    chairs = listed(config.meshes, 78)[:: config.every]
    runs.complete(journal, {one.name: partial(row, one, prior, config) for one in chairs}, means)
    return journal


def row(chair: Object, prior: ShapePrior, config: Config) -> dict[str, Any]:
    """Mean and 90th percentile, in millimetres, of every mesh after every number of frames."""
    truth, captured = from_orbit(chair, max(config.frames), DEVICE)
    return {str(k): _after(k, truth, captured, prior) for k in config.frames}


def _after(k: int, truth: trimesh.Trimesh, captured: Capture, prior: ShapePrior) -> dict[str, Any]:
    first = captured._replace(
        depth=captured.depth[:k],
        T_object_camera=jax.tree.map(lambda x: x[:k], captured.T_object_camera),
    )
    field = jax.tree.map(lambda x: x[0], fuse(first, (k,)))
    grids = jax.jit(evidence.soft_grids)(field)
    F, M, _ = binary(grids)
    logits = propose(prior, grids)
    fused = fuse_surface(field, np.asarray(logits), captured.frame)
    voxels = surface(compose(F, M, logits > 0), captured.frame, smoothing=SMOOTHING)
    visible = visible_points(truth, first)
    at = fused.mesh.vertices
    figures = {
        "measured to CAD": _both(at[fused.measured], truth),
        "predicted to CAD": _both(at[~fused.measured], truth),
        "seen to fused": _both(visible, fused.mesh),
        "voxels to CAD": _both(voxels.vertices, truth),
        "seen to voxels": _both(visible, voxels),
        "dropped, closed": [fused.dropped, float(fused.mesh.is_watertight)],
    }
    if importlib.util.find_spec("open3d") is not None:
        theirs = open3d_mesh(first)
        figures["Open3D to CAD"] = _both(theirs.vertices, truth)
        figures["seen to Open3D"] = _both(visible, theirs)
    return figures


fuse = jax.jit(fuse_frames, static_argnums=1)


@jax.jit
def propose(prior: ShapePrior, grids: Grids) -> jax.Array:
    """The encoder's shape, as logits."""
    return decode(prior, encode(prior, grids))


def _both(points: Float[np.ndarray, "n 3"], mesh: trimesh.Trimesh) -> list[float]:
    """Mean and 90th percentile of distances to a mesh, in millimetres."""
    if not len(points):
        return [0.0, 0.0]
    far = 1e3 * distances(np.asarray(points), mesh)
    return [round(float(far.mean()), 2), round(float(np.percentile(far, 90)), 2)]


def distances(points: Float[np.ndarray, "n 3"], mesh: trimesh.Trimesh) -> Float[np.ndarray, " n"]:
    """Distance in metres to the triangles on which the nearest of many surface points lie."""
    sampled: Any = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    samples, face = map(np.asarray, sampled)
    nearest = np.asarray(KDTree(samples).query(points, k=3)[1])
    to_triangle = partial(_to_triangles, points, mesh.triangles)
    return np.min([to_triangle(face[nearest[:, i]]) for i in range(3)], axis=0)


def _to_triangles(points: np.ndarray, triangles: np.ndarray, face: np.ndarray) -> np.ndarray:
    nearest = trimesh.triangles.closest_point(triangles[face], points)
    return np.linalg.norm(nearest - points, axis=1)


def visible_points(truth: trimesh.Trimesh, captured: Capture) -> Float[np.ndarray, "n 3"]:
    """Points of the true surface that the frames see, in the object frame."""
    size = captured.depth.shape[1:]
    poses = captured.T_object_camera
    depth, _ = render.render_depth(truth, poses, captured.intrinsics, (size[0], size[1]))
    points = camera.unproject(captured.intrinsics, jnp.asarray(depth))
    T = np.asarray(poses.as_matrix(), np.float64)
    seen = np.argwhere(np.isfinite(depth))
    chosen = seen[np.random.default_rng(0).permutation(len(seen))[:POINTS]]
    view = chosen[:, 0]
    p = np.asarray(points, np.float64)[tuple(chosen.T)]
    return np.einsum("nij,nj->ni", T[view, :3, :3], p) + T[view, :3, 3]


def open3d_mesh(captured: Capture) -> trimesh.Trimesh:
    """The mesh of Open3D's block grid of signed distances, truncated at 4 voxels."""
    import open3d as o3d  # pyright: ignore[reportMissingImports]
    import open3d.core as o3c  # pyright: ignore[reportMissingImports]

    fx, fy, cx, cy = map(float, captured.intrinsics)
    lens = o3c.Tensor(np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1.0]]))
    volume = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight"),
        attr_dtypes=(o3c.float32, o3c.float32),
        attr_channels=(1, 1),
        voxel_size=float(jnp.mean(fine_frame(captured.frame).voxel_size)),
        block_count=20_000,
    )
    poses = np.asarray(captured.T_object_camera.as_matrix(), np.float64)
    for depth, T in zip(np.asarray(captured.depth), poses, strict=True):
        image = o3d.t.geometry.Image(o3c.Tensor(np.where(np.isfinite(depth), depth, 0)))
        seen = image, lens, o3c.Tensor(np.linalg.inv(T)), 1.0, 10.0, 4.0
        volume.integrate(volume.compute_unique_block_coordinates(*seen), *seen)
    mesh = volume.extract_triangle_mesh(weight_threshold=0.5).to_legacy()
    return trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles), process=False)


def means(rows: dict[str, Any]) -> dict[str, Any]:
    """Means over chairs: `means[frames][way]`, mean and 90th percentile in millimetres."""
    each = list(rows.values())
    found = {
        k: {
            way: [round(float(x), 2) for x in np.mean([row[k][way] for row in each], axis=0)]
            for way in ways
        }
        for k, ways in each[0].items()
    }
    return {"means": found}


if __name__ == "__main__":
    main(tyro.cli(Config))
