"""`jaxshape next`: a result folder whose back was not seen."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from known_shape import CODE, known_shape

from jaxshape.cli.looking import NextView
from jaxshape.geometry.grid import fit_box
from jaxshape.model.weights import save_prior
from jaxshape.results.looking import look

SIZE = np.array([0.5, 0.9, 0.5])


@pytest.fixture(scope="module")
def prior():
    return known_shape(trimesh.creation.box(SIZE), SIZE)


@pytest.fixture
def folder(tmp_path, prior):
    """The front half of a box was seen."""
    save_prior(tmp_path / "weights.safetensors", prior, {})
    frame = fit_box(jnp.float32(-SIZE / 2), jnp.float32(SIZE / 2))
    shape = np.asarray(prior.params["mean"]) > 0.5
    occluded = np.ones((32, 32, 32), bool)
    occluded[:, :, 16:] = False
    np.savez(
        tmp_path / "grid.npz",
        occupied=shape & ~occluded,
        occluded=occluded,
        composed=shape,
        code=np.zeros(CODE),
        origin=np.asarray(frame.origin),
        voxel_size=np.asarray(frame.voxel_size),
        T_world_object=np.eye(4),
    )
    (tmp_path / "result.json").write_text(
        json.dumps({"weights": str(tmp_path / "weights.safetensors")})
    )
    return tmp_path


def test_the_unseen_back_is_looked_at(folder, capsys):
    NextView(result=folder, samples=4).run()
    kept = json.loads((folder / "next.json").read_text())
    poses = np.array([view["T_object_camera"] for view in kept["views"]])
    toward = poses[:, :3, 3] / np.linalg.norm(poses[:, :3, 3], axis=1, keepdims=True)
    assert toward[0, 2] < -0.5
    assert len(kept["views"]) == 3 and (toward @ toward.T)[~np.eye(3, dtype=bool)].max() < 0.77
    assert [view["where"] in capsys.readouterr().out for view in kept["views"][:1]] == [True]
    gains = [view["gain"] for view in kept["views"]]
    assert gains == sorted(gains, reverse=True) and gains[0] > 0
    assert (folder / "next_views.png").read_bytes()[:4] == b"\x89PNG"


def test_what_cannot_be_looked_at_is_refused(folder, prior):
    with pytest.raises(ValueError, match="inside its box"):
        look(folder, prior, distance=0.2)
    with np.load(folder / "grid.npz") as arrays:
        kept = dict(arrays)
    np.savez(folder / "grid.npz", **kept | {"code": np.zeros(CODE + 1)})
    with pytest.raises(ValueError, match="made with other weights"):
        look(folder, prior)
    (folder / "grid.npz").unlink()
    with pytest.raises(ValueError, match="no grid.npz"):
        look(folder, prior)
