# %% [markdown]
# # A recording: from RGB-D files to a mesh
#
# This notebook writes a small recording in the layout of the TUM RGB-D benchmark, inspects it,
# and maps it frame by frame. For your own recording, begin at "Open". From the shell, `jaxshape
# reconstruct scan/ --click COLUMN ROW` does the same.

# %%
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

import jaxshape as js
from jaxshape.report.pictures import render_mesh

FRAMES, WIDTH, HEIGHT = 12, 640, 480

# %% [markdown]
# ## Write a recording
#
# A virtual Kinect films a chair on a floor along an arc. Depth images are 16-bit PNG files
# with 5,000 units per metre. `groundtruth.txt` has a line `time x y z qx qy qz qw` for each
# camera-to-world pose.

# %%
folder = Path("scan")
chair = js.random_chair(1_000_001)
floor = trimesh.creation.box((3, 0.05, 3))
floor.apply_translation([0, chair.bounds[0, 1] - 0.025, 0])
scene = trimesh.util.concatenate([chair, floor])
camera = replace(js.virtual_camera("kinect"), width=WIDTH, height=HEIGHT)
poses = js.orbit(FRAMES, js.camera_distance(chair, camera), step=10)
film = js.capture(scene, poses, noise=True, seed=0, camera=camera)

(folder / "depth").mkdir(parents=True, exist_ok=True)
depth_lines, pose_lines = [], []
for i, T in enumerate(np.asarray(poses.as_matrix(), float)):
    time, name = f"{i / 10:.6f}", f"depth/{i / 10:.6f}.png"
    depth = np.where(np.isfinite(film.depth[i]), film.depth[i], 0)
    Image.fromarray(np.rint(5000 * depth).astype(np.uint16)).save(folder / name)
    depth_lines.append(f"{time} {name}\n")
    numbers = (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())
    pose_lines.append(f"{time} {' '.join(f'{x:.9f}' for x in numbers)}\n")
(folder / "depth.txt").write_text("".join(depth_lines))
(folder / "groundtruth.txt").write_text("".join(pose_lines))
fx, fy, cx, cy = map(float, film.intrinsics)
(folder / "calibration.txt").write_text(f"{fx} {fy} {cx - 0.5} {cy - 0.5}\n")

# %% [markdown]
# ## Open
#
# `open_sequence` recognises the layout. `findings` are remarks on files that look wrong;
# `jaxshape inspect scan/` prints them with the evidence.

# %%
sequence = js.open_sequence(folder)
print(f"{len(sequence)} frames, layout {sequence.layout}, {len(sequence.findings)} remarks")

# %% [markdown]
# ## Find the object
#
# The box is known here. Without `box`, `js.Prompt(click=(column, row))` names a pixel of the
# object, and `find_start` segments it and estimates the box.

# %%
size = chair.extents * 1.04
above = np.array([[[-9, -9, -9], [9, 0.03 - size[1] / 2, 9]]])  # excludes the floor
prior, config = js.load_prior(), js.RefineConfig()
box = js.Box(np.eye(4), size, above)
start = js.find_start(sequence, prior, js.Prompt(), box=box)

# %% [markdown]
# ## Map
#
# `follow` yields the progress after each frame. A frame becomes a keyframe if the camera has moved
# enough since the last keyframe.

# %%
mapper = js.build_mapper(prior, None, config, js.MappingConfig(), js.TrackingConfig())
for progress in js.follow(sequence, start, mapper, prior, use_poses=True):
    print(progress.logs[-1].name, progress.logs[-1].status)
state, found = mapper.finish(progress.state)

# %% [markdown]
# ## Mesh
#
# Measured vertices are blue, predicted ones orange.

# %%
fused = js.fuse_surface(state.measurement, found.fill_logits[0], state.place.frame)
js.write_mesh(fused.mesh, "chair.glb")
colors = np.where(fused.measured[:, None], [70, 130, 220], [255, 140, 0]).astype(np.uint8)
figure, axes = plt.subplots(1, 3, figsize=(12, 4))
axes[0].imshow(sequence[0].depth)
axes[0].set_title("first depth image")
axes[1].imshow(render_mesh(fused.mesh, color=colors))
axes[1].set_title("reconstruction")
axes[2].imshow(render_mesh(chair))
axes[2].set_title("truth")
for axis in axes:
    axis.axis("off")
plt.show()
