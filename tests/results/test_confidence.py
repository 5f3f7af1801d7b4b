"""How sure each vertex of a mesh is."""

import numpy as np

from jaxshape.geometry.grid import GridFrame
from jaxshape.results.confidence import confidence_at


def test_a_vertex_takes_the_most_probable_of_the_eight_voxels_around_it():
    rng = np.random.default_rng(0)
    probability = rng.random((4, 5, 6))
    frame = GridFrame(np.array([1.0, 2, 3]), np.array([0.1, 0.2, 0.3]))
    vertices = frame.origin + rng.uniform(-0.2, 6, (200, 3)) * frame.voxel_size
    found = confidence_at(vertices, probability, frame)
    centres = np.stack(np.meshgrid(*map(np.arange, (4, 5, 6)), indexing="ij"), -1) + 0.5
    for vertex, value in zip((vertices - frame.origin) / frame.voxel_size, found, strict=True):
        inside = np.clip(vertex, 0.5, np.array([4, 5, 6]) - 0.5)
        near = (np.abs(centres - inside) < 1).all(-1)
        assert value >= probability[near].max() - 1e-12
        assert value in probability
