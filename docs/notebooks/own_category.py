# %% [markdown]
# # Your own category: from a folder of meshes to a rebuilt object
#
# The shipped weights know chairs. For another category, jaxshape needs a folder of meshes and one
# command. Here the category is tables. Principal components, trained in a few seconds, replace the
# network, whose training takes hours on a CPU.

# %%
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import jaxshape as js
from jaxshape.report.pictures import render_mesh, render_voxels

TABLES, CODE = 80, 32

# %% [markdown]
# ## 1. A folder of meshes
#
# Your meshes would come from files: OBJ, OFF, PLY, GLB or STL, all with the same up and front axes.
# If these are not +y up and +z to the front, state them: `jaxshape train --up z --front -y`.

# %%
folder = Path("tables")
folder.mkdir(exist_ok=True)
for seed in range(TABLES):
    js.random_table(seed).export(folder / f"table-{seed:03d}.ply")

# %% [markdown]
# ## 2. Train
#
# The command films each mesh along camera paths, keeps every tenth mesh out, trains, scores the
# weights on the meshes it kept out, and writes a model card. Leave `--model pca` and `--code` out
# to train the network of the shipped weights.

# %%
command = f"train --meshes tables --name table --model pca --code {CODE}"
subprocess.run([sys.executable, "-m", "jaxshape", *command.split()], check=True)
print(Path("out/table/table.md").read_text()[:600])

# %% [markdown]
# ## 3. Rebuild
#
# The new weights replace the shipped ones. On the command line, use `jaxshape reconstruct scan/
# --weights out/table/table.safetensors`.

# %%
prior = js.load_prior("out/table/table.safetensors")
table = js.random_table(1_000_001)
film = js.capture(table, js.orbit(3, 2.0), noise=False, seed=0)
frames = js.merge_all(js.measure_frames(film))
F, M = js.occupied(frames)[None], js.occluded(frames)[None]
config = js.RefineConfig(iterations=40)
refiner = js.refiner_for("gradient:adam", prior, config)
found = js.reconstruct(jax.random.key(0), prior, F, M, refiner, config)
for name, shape in (("measured", F), ("composed", found.composed)):
    print(f"{name}: IoU {float(js.iou(shape[0], film.surface)):.3f}")

# %%
grids = {"measured": F[0], "composed": found.composed[0], "truth": jnp.asarray(film.surface)}
figure, axes = plt.subplots(1, 4, figsize=(12, 3))
axes[0].imshow(render_mesh(table))
axes[0].set_title("a new table")
for axis, (title, grid) in zip(axes[1:], grids.items(), strict=True):
    axis.imshow(render_voxels(jax.device_get(grid)))
    axis.set_title(title)
for axis in axes:
    axis.axis("off")
plt.show()
