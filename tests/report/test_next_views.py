"""`jaxshape next`: a result folder whose back was not seen."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from known_shape import CODE, known_shape

from jaxshape.cli.looking import NextView
from jaxshape.geometry.grid import fit_box
from jaxshape.model.shapes import decode
from jaxshape.results.looking import look

SIZE = np.array([0.5, 0.9, 0.5])


@pytest.fixture
def folder(tmp_path):
    """The front half of a box was seen, and its samples differ all over."""
    prior = known_shape(trimesh.creation.box(SIZE), SIZE)
    frame = fit_box(jnp.float32(-SIZE / 2), jnp.float32(SIZE / 2))
    shape = np.asarray(prior.params["mean"]) > 0.5
    codes = np.random.default_rng(0).normal(size=(1, 4, CODE))
    occluded = np.ones((32, 32, 32), bool)
    occluded[:, :, 16:] = False
    np.savez(
        tmp_path / "grid.npz",
        occupied=shape & ~occluded,
        occluded=occluded,
        composed=shape,
        samples=np.float16(decode(prior, jnp.float32(codes))[0]),
        origin=np.asarray(frame.origin),
        voxel_size=np.asarray(frame.voxel_size),
        T_world_object=np.eye(4),
    )
    return tmp_path


def test_the_unseen_back_is_looked_at(folder, capsys):
    NextView(result=folder).run()
    kept = json.loads((folder / "next.json").read_text())
    poses = np.array([view["T_object_camera"] for view in kept["views"]])
    toward = poses[:, :3, 3] / np.linalg.norm(poses[:, :3, 3], axis=1, keepdims=True)
    assert toward[0, 2] < -0.5
    assert len(kept["views"]) == 3 and (toward @ toward.T)[~np.eye(3, dtype=bool)].max() < 0.77
    assert [view["where"] in capsys.readouterr().out for view in kept["views"][:1]] == [True]
    gains = [view["gain"] for view in kept["views"]]
    assert gains == sorted(gains, reverse=True) and gains[0] > 0
    assert (folder / "next_views.png").read_bytes()[:4] == b"\x89PNG"


def test_what_cannot_be_looked_at_is_refused(folder):
    with pytest.raises(ValueError, match="inside its box"):
        look(folder, distance=0.2)
    with np.load(folder / "grid.npz") as arrays:
        kept = dict(arrays)
    np.savez(folder / "grid.npz", **{name: x for name, x in kept.items() if name != "samples"})
    with pytest.raises(
        ValueError, match="no samples of the shape .*make the folder anew, with --samples 16"
    ):
        look(folder)
    (folder / "grid.npz").unlink()
    with pytest.raises(ValueError, match="no grid.npz"):
        look(folder)
