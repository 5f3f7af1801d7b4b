# %% [markdown]
# # Quickstart: a whole chair from four depth frames
#
# A virtual Kinect films a chair from four sides. jaxshape fuses the frames, and a network that
# was trained on other chairs predicts the voxels that no frame has seen. This takes half a minute
# on a laptop.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxshape as js
from jaxshape.report.pictures import render_mesh, render_voxels

FRAMES = 4
SEED = 1_000_001  # training never used seeds from 1,000,000 on

# %% [markdown]
# ## Film
#
# The camera stands on a circle around the chair. Its depth images have the noise of a Kinect.

# %%
chair, camera = js.random_chair(SEED), js.virtual_camera("kinect")
poses = js.orbit(FRAMES, js.camera_distance(chair, camera))
film = js.capture(chair, poses, noise=True, seed=0, camera=camera)
print(f"{len(film.depth)} depth images of {film.depth.shape[1]} x {film.depth.shape[2]} pixels")

# %% [markdown]
# ## Fuse
#
# Signed distances of all frames are averaged on a fine grid. They give two grids of 32 x 32 x 32
# voxels: F, the probability that a voxel is surface, and M, the probability that it is unknown.

# %%
field = js.fuse_frames(film, (FRAMES,))
grids = js.soft_grids(field)
measured = (grids.occupied > 0.5) & (grids.occluded < 0.5)

# %% [markdown]
# ## Complete
#
# `reconstruct` takes a batch of objects, here one object. The default network needs no search, so
# the refiner is `None`. The composed grid keeps measured voxels and takes the others from the
# network.

# %%
prior = js.load_prior()
found = js.reconstruct(
    jax.random.key(0), prior, grids.occupied, grids.occluded, None, js.RefineConfig()
)
before, after = (float(js.iou(x[0], film.surface)) for x in (measured, found.composed))
print(f"IoU with the true surface: {before:.3f} measured, {after:.3f} composed")

# %% [markdown]
# ## The mesh
#
# The mesh has the camera's resolution where the surface was measured. `measured` marks the measured
# vertices, which are drawn in blue; predicted vertices are orange.

# %%
fused = js.fuse_surface(jax.tree.map(lambda x: x[0], field), found.fill_logits[0], film.frame)
js.write_mesh(fused.mesh, "chair.ply")
colors = np.where(fused.measured[:, None], [70, 130, 220], [255, 140, 0]).astype(np.uint8)

# %%
pictures = {
    "a depth image": film.depth[0],
    "measured": render_voxels(jax.device_get(measured[0])),
    "composed": render_voxels(jax.device_get(found.composed[0])),
    "truth": render_voxels(jax.device_get(film.surface)),
    "mesh": render_mesh(fused.mesh, color=colors),
}
figure, axes = plt.subplots(1, len(pictures), figsize=(15, 3))
for axis, (title, picture) in zip(axes, pictures.items(), strict=True):
    axis.imshow(picture)
    axis.set_title(title)
    axis.axis("off")
plt.show()
