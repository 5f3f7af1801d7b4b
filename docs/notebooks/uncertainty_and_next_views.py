# %% [markdown]
# # Uncertainty and next views
#
# One depth frame shows half of a chair, and many chairs agree with this frame. This notebook draws
# samples of the complete shape, shows where they disagree, and finds the camera position that would
# resolve most of the uncertainty.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxshape as js
from jaxshape.report.pictures import render_voxels

SAMPLES = 16
AZIMUTHS, ELEVATIONS = 36, 7

# %% [markdown]
# ## One frame

# %%
chair, camera = js.random_chair(1_000_002), js.virtual_camera("kinect")
distance = js.camera_distance(chair, camera)
film = js.capture(chair, js.orbit(1, distance), noise=True, seed=0, camera=camera)
grids = js.soft_grids(js.fuse_frames(film, (1,)))

# %% [markdown]
# ## Samples
#
# The setting `samples` requests samples of the posterior. `found.probability` is the
# calibrated probability of surface in each voxel; `found.samples` are logits of complete shapes.

# %%
prior, config = js.load_prior(), js.RefineConfig(samples=SAMPLES)
found = js.reconstruct(jax.random.key(0), prior, grids.occupied, grids.occluded, None, config)
unknown = grids.occluded[0] > 0.5
number, share = js.hypotheses(found.samples[0], unknown, count=2)
p = jnp.clip(found.probability[0], 1e-6, 1 - 1e-6)
entropy = -p * jnp.log(p) - (1 - p) * jnp.log1p(-p)
print(f"entropy of the shape: {float(entropy.sum()):.0f} nats")

# %% [markdown]
# The figure shows the two samples that differ most, with their probabilities, and the entropy of
# the voxels, summed along the line of sight from the side.

# %%
figure, axes = plt.subplots(1, 4, figsize=(13, 3.3))
for axis, sample, weight in zip(axes, found.samples[0][number], share, strict=False):
    axis.imshow(render_voxels(np.asarray(sample > 0)))
    axis.set_title(f"hypothesis, {float(weight):.0%}")
axes[2].imshow(np.asarray(entropy.sum(axis=0)), origin="lower", cmap="magma")
axes[2].set_title("entropy, seen from the side")
axes[3].imshow(render_voxels(np.asarray(film.surface)))
axes[3].set_title("truth")
for axis in axes:
    axis.axis("off")
plt.show()

# %% [markdown]
# ## Next views
#
# `reachable_views` lists cameras that a person can hold around the object. `next_views` ranks
# them by the expected drop in entropy.

# %%
floor = float(chair.bounds[0, 1])
views = js.reachable_views(distance, floor, azimuths=AZIMUTHS, elevations=ELEVATIONS)
one = js.Grids(grids.occupied[0], grids.occluded[0])
ranked = js.next_views(
    found.samples[0], one, film.frame, views, film.intrinsics, film.depth.shape[1:]
)
best = int(ranked.ranking[0])
eye = np.asarray(ranked.T_object_camera.translation())
azimuth = np.degrees(np.arctan2(eye[:, 0], eye[:, 2]))
settled = float(ranked.gain[best] / ranked.entropy)
print(f"best camera at azimuth {azimuth[best]:.0f} degrees settles {settled:.0%} of the entropy")

# %%
figure, axis = plt.subplots(subplot_kw={"projection": "polar"}, figsize=(5, 5))
axis.set_theta_zero_location("S")
axis.scatter(np.radians(azimuth), eye[:, 1] - floor, c=np.asarray(ranked.gain), s=40)
axis.scatter(np.radians(azimuth[best]), eye[best, 1] - floor, marker="*", s=300, c="red")
axis.set_title("azimuth and height of cameras, by expected gain (star: best)")
plt.show()
