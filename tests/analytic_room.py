"""Depth images of a room of axis-aligned boxes, by intersecting each pixel's ray with them."""

from typing import NamedTuple

import numpy as np

WIDTH, HEIGHT = 160, 120
K = np.array([[131.0, 0, 80], [0, 131, 60], [0, 0, 1]])

FLOOR = [((-5, -0.1, -5), (5, 0, 5))]
WALLS = [((-5, 0, -1.9), (5, 3, -1.8)), ((1.9, 0, -5), (2, 3, 5))]
CHAIR = [
    ((-0.22, 0.42, -0.22), (0.22, 0.47, 0.22)),
    ((-0.22, 0.47, -0.22), (0.22, 0.95, -0.17)),
    *(
        ((x - 0.03, 0, z - 0.03), (x + 0.03, 0.42, z + 0.03))
        for x in (-0.19, 0.19)
        for z in (-0.19, 0.19)
    ),
]
CRATE = [((-0.95, 0, -0.3), (-0.5, 0.45, 0.15))]
TABLE = [
    ((0.6, 0.7, -0.6), (1.6, 0.74, 0.4)),
    *(
        ((x - 0.03, 0, z - 0.03), (x + 0.03, 0.7, z + 0.03))
        for x in (0.66, 1.54)
        for z in (-0.54, 0.34)
    ),
]


class Room(NamedTuple):
    """A view of the room; `label` tells which group of boxes each pixel shows, -1 for none."""

    depth: np.ndarray
    label: np.ndarray
    T_world_camera: np.ndarray


def look_from(eye, target=(0, 0.45, 0)) -> np.ndarray:
    """T_world_camera of a camera that looks at a point, upright in a world whose +y is up."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, (0, 1, 0))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    return T


def room(groups, eye=(0.9, 1.4, 1.8), target=(0, 0.45, 0), *, noise=1.0, seed=0) -> Room:
    """A view of groups of boxes, each `(low, high)`, with the noise of a Kinect times `noise`."""
    T = look_from(eye, target)
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T @ T[:3, :3].T
    depth, label = np.full(u.shape, np.inf), np.full(u.shape, -1)
    for i, group in enumerate(groups):
        for low, high in group:
            ends = (np.array([low, high])[:, None, None] - T[:3, 3]) / rays
            enter, leave = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
            hit = (0 < enter) & (enter < leave) & (enter < depth)
            depth, label = np.where(hit, enter, depth), np.where(hit, i, label)
    rng = np.random.default_rng(seed)
    depth += noise * 1.4e-3 * np.nan_to_num(depth, posinf=0) ** 2 * rng.normal(size=depth.shape)
    return Room(depth.astype(np.float32), label, T)


def iou(a, b) -> float:
    return float((a & b).sum() / (a | b).sum())
