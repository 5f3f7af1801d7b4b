"""Axes that point up and to the front, found by a prior that knows one shape."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxshape.data.capture import true_surface
from jaxshape.data.chairs import random_chair
from jaxshape.data.meshes import axes_to_canonical, canonical
from jaxshape.geometry import grid
from jaxshape.model.facing import _turned, are_known, dissenting, facing_scores, usual_axes

AXES = [("y", "z"), ("z", "-y"), ("-x", "z")]


@pytest.fixture(scope="module")
def chair():
    return canonical(random_chair(3))


def surface_of(mesh):
    return np.asarray(true_surface(mesh, grid.fit_box(*jnp.float32(mesh.bounds)), 0, 32))


def lying(mesh, axes):
    """The mesh in a file whose axes point up and to the front."""
    vertices = np.asarray(mesh.vertices) @ axes_to_canonical(*axes)
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


@pytest.mark.parametrize("axes", AXES)
def test_a_grid_is_turned_as_a_mesh_is(chair, axes):
    turned = _turned(surface_of(lying(chair, axes)), axes)
    assert np.mean(turned != surface_of(chair)) < 0.01 * turned.mean()  # corners between voxels


@pytest.mark.parametrize("axes", AXES)
def test_a_prior_knows_its_shape_however_it_lies(chair, axes, linear_prior):
    logits = jnp.asarray(surface_of(chair), jnp.float32)
    params = linear_prior.params | {
        "mean": 0.3 + 0.4 * logits, "components": 0 * linear_prior.params["components"],
        "slope": jnp.float32(10),
    }  # fmt: skip
    scores = facing_scores(linear_prior._replace(params=params), lying(chair, axes))
    assert max(scores, key=lambda pair: scores[pair]) == axes


def test_unclear_meshes_go_with_the_others():
    a, b = ("y", "z"), ("y", "x")
    scores = {f"clear-{i}": {a: -0.5, b: -0.3} for i in range(3)} | {
        "stool": {a: -0.3, b: -0.31}, "other": {a: -0.2, b: -0.5}
    }  # fmt: skip
    assert usual_axes(scores, a) == b
    assert dissenting(scores, b) == {"other": a}
    assert are_known(scores) and not are_known({"mug": {a: -0.4}}) and not are_known({})
    assert usual_axes({"stool": scores["stool"]}, b) == b and usual_axes({}, b) == b
