"""Registration of two depth frames with small_gicp, on both cores."""

import os
from functools import partial

import numpy as np
import small_gicp

from benchmarks.rivals.variant import Variant

THREADS = min(len(os.sched_getaffinity(0)), 8) if hasattr(os, "sched_getaffinity") else 1
REACHES = (0.3, 0.05)
"""Metres that a match may lie away: for steps of up to 30 degrees, then to be exact."""

FAR = 3.0  # metres; deeper pixels, the noisiest, are left out, as for Open3D


def variants() -> dict[str, Variant]:
    """Both methods that suit depth frames, on clouds thinned out to three voxel sizes."""
    return {
        f"{method}, voxels of {size:g} m": Variant(
            partial(_prepare, size=size), partial(_align, method=method)
        )
        for method in ("GICP", "PLANE_ICP")
        for size in (0.02, 0.04, 0.08)
    }


def _prepare(depth, intrinsics, *, size):
    fx, fy, cx, cy = intrinsics
    row, column = np.nonzero((depth > 0) & (depth < FAR))
    z = depth[row, column].astype(np.float64)
    x, y = (column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z
    points = np.stack([x, y, z], axis=1)
    return small_gicp.preprocess_points(points, size, num_threads=THREADS)


def _align(reference, frame, *, method):
    T = np.eye(4)
    for reach in REACHES:
        T = small_gicp.align(
            reference[0],
            frame[0],
            reference[1],
            T,
            registration_type=method,
            max_correspondence_distance=reach,
            num_threads=THREADS,
            max_iterations=50,
            rotation_epsilon=1e-3,
            translation_epsilon=1e-4,
        ).T_target_source
    return T
