# %% [markdown]
# # Your own decoder: principal components
#
# A shape prior is a `ShapeModel`, two pure functions, with its parameters and the statistics of the
# training codes. Here the decoder is linear: a code holds the weights of the principal components
# of training chairs. One singular value decomposition trains it. `docs/examples/own_decoder.py` has
# a neural decoder in the manner of DeepSDF.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import jaxshape as js
from jaxshape.report.pictures import render_voxels

CHAIRS, CODE = 120, 24
SLOPE = 8.0  # logits rise by 8 from an empty to a full voxel
NOISE = 0.3  # standard deviation of a voxel from the best linear fit

# %% [markdown]
# ## Training data
#
# Surface voxels of procedural side chairs.


# %%
def film(seed, frames):
    chair = js.random_chair(seed, style="side chair")
    return js.capture(chair, js.orbit(frames, 2.0), noise=False, seed=0)


surfaces = jnp.stack([film(seed, 1).surface for seed in range(CHAIRS)]).astype(jnp.float32)

# %% [markdown]
# ## Training
#
# Components are scaled so that each number of a code has variance 1 over the training chairs.

# %%
mean = surfaces.mean(axis=0)
_, sizes, axes = jnp.linalg.svd((surfaces - mean).reshape(CHAIRS, -1), full_matrices=False)
components = (sizes[:CODE, None] / CHAIRS**0.5 * axes[:CODE]).reshape(CODE, 32, 32, 32)
params = {"mean": mean, "components": components}

# %% [markdown]
# ## The model
#
# `decode` maps codes `[n d]` to logits `[n x y z]`. `encode` maps F and M of a batch to first
# codes. The first code is the most probable code given the known voxels, the solution of a small
# linear system.


# %%
def decode(prepared, codes):
    params = prepared.shared
    occupancy = params["mean"] + jnp.tensordot(codes, params["components"], 1)
    return SLOPE * (occupancy - 0.5)


def encode(params, grids):
    def one(F, M):
        seen = params["components"] * (1 - M)
        gram = jnp.einsum("kxyz,lxyz->kl", seen, seen) / NOISE**2 + jnp.eye(CODE)
        right = jnp.einsum("kxyz,xyz->k", seen, F - params["mean"]) / NOISE**2
        return jnp.linalg.solve(gram, right)

    return jax.vmap(one)(grids.occupied, grids.occluded)


model = js.ShapeModel(kind="linear", encode=encode, decode=decode)
prior = js.ShapePrior(model, params, jnp.zeros(CODE), jnp.eye(CODE))
js.save_prior("linear.safetensors", prior, {"data": f"{CHAIRS} procedural side chairs"})

# %% [markdown]
# ## Search
#
# All functions of the package work with the new prior. Adam searches the codes of two new chairs.

# %%
new = [film(seed, 4) for seed in (1_000_001, 1_000_002)]
frames = [js.merge_all(js.measure_frames(one)) for one in new]
F, M = (jnp.stack([grid(x) for x in frames]) for grid in (js.occupied, js.occluded))
truth = jnp.stack([one.surface for one in new])

prior, config = js.load_prior("linear.safetensors", model), js.RefineConfig(iterations=60)
refiner = js.refiner_for("gradient:adam", prior, config)
found = js.reconstruct(jax.random.key(0), prior, F, M, refiner, config)

shapes = {
    "measured": F,
    "first code": found.completed_first,
    "searched": found.completed,
    "composed": found.composed,
    "truth": truth,
}
figure, rows = plt.subplots(len(new), len(shapes), figsize=(12, 2.6 * len(new)))
for title, column, shape in zip(shapes, rows.T, shapes.values(), strict=True):
    print(f"{title}: IoU {float(js.iou(shape, truth).mean()):.3f}")
    for axis, grid in zip(column, jax.device_get(shape), strict=True):
        axis.imshow(render_voxels(grid))
        axis.set_title(title)
        axis.axis("off")
plt.show()
