"""Rebuild dense objects from a few RGB-D frames with a learned shape prior, in JAX.

A deep auto-encoder learns the space of shapes of one class as a short code over occupancy grids.
Depth frames are fused into a measurement grid **F** and an occlusion mask **M**; the encoder gives
a first code, and CMA-ES populations or gradients search for the code whose decoded grid agrees with
the measurement in measured voxels, and with the prior elsewhere. After Hu, Cao, Wu and Kneip,
"Dense Object Reconstruction from RGBD Images with Embedded Deep Shape Representations" (2018); "the
paper" in all docstrings. The default prior goes further: its decoder takes F and M, so that its
first code fills what is hidden without a search.

Conventions, stated here once:

- Object frame: right-handed, +y up, the object's front along +z, metres. A CAD model's bounding box
  is centred at the origin.
- Camera: OpenCV (x right, y down, z forward). Depth is z, not ray length, in metres; 0 stands for
  a missing depth, infinity for a ray that hit nothing. The centre of pixel (row, column) is at (u,
  v) = (column + 0.5, row + 0.5).
- Poses: `T_a_b` transforms points from frame b to frame a, `p_a = T_a_b @ p_b`; `T_world_camera` is
  camera to world. `jaxlie.SE3` in JAX, 4x4 matrices in files.
- Grids are indexed `[x, y, z]`, 32^3 unless a prior was trained otherwise. Voxel i covers
  [i, i + 1) in voxel coordinates, its centre is at i + 0.5; a `GridFrame` maps to the object frame,
  each axis with its own scale.
- Occupied voxels are those that hold a piece of the SURFACE; the inside of a solid is free.
- A boolean array is named for what True means: `occupied` is F, `occluded` is M.
- `decode` gives logits; a voxel is occupied where they are positive. Losses are in nats per voxel.
- `PAPER`, `BALANCED` and `SOFT` are residuals, the objectives of a search: Eq. 7 as printed, Eq. 7
  with a third of the weight on measured free space, and the latter with voxels weighted by how sure
  their measurement is (`help(js.Residual)`). By default, soft grids get `SOFT` and binary ones
  `BALANCED`.
- Leading axes `*batch` broadcast; `b` or `object` is one batch axis.

Data flows in one direction, and so do imports:

    geometry   cameras, voxel frames, fusion of frames into F and M or signed distances
    data       meshes, procedural objects, virtual cameras, training pairs, RGB-D recordings
    model      convolutions, auto-encoder, conditional network, weights, training
    search     objective (Eq. 7), refiners, the batched search, composed shapes
    mapping    segmentation, the object's frame, ICP, keyframes, realignment of a recording
    results    surfaces, metrics, evaluation, the files of a result
    report     pictures, plots, the report page, the live view, the model card
    bench      a frozen set of problems, searches against each other on it, their board
    cli        the `jaxshape` command
"""

import lazy_loader

# The public names are listed in __init__.pyi; each is imported when it is first used, so that
# `jaxshape --help` need not wait for JAX.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
