"""The picture of the cameras from which an object should be filmed next. [host]"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxshape.geometry.grid import GridFrame
from jaxshape.report.figures import save_figure
from jaxshape.report.palette import BLUE, FOG, INK, ORANGE, PALE, RED
from jaxshape.report.pictures import rgb
from jaxshape.results.folder import camera_poses, extent
from jaxshape.results.looking import Looked
from jaxshape.results.surface import surface

NEAR = 1.6
"""Distance at which cameras are drawn, in radii of the object; they are farther away in reality."""


def write_next_views(path: Path, looked: Looked) -> None:
    """Draw the object, the cameras coloured by their information gain, and the best of them.

    Args:
        path: The picture to write.
        looked: The object and the next views that were found.
    """

    def draw(figure: Any) -> None:
        left, right = figure.add_gridspec(1, 2, width_ratios=(1.15, 1))
        _draw_sphere(figure, figure.add_subplot(left, projection="3d"), looked)
        _draw_map(figure.add_subplot(right, projection="polar"), looked)
        lines = [f"{n}  {text}" for n, text in enumerate(looked.sentences(), 1)]
        figure.supxlabel("\n".join(lines), fontsize=9, x=0.02, ha="left", color=INK)

    save_figure(path, (9.0, 5.4), draw, font=9.0)


def _draw_sphere(figure: Any, axes: Any, looked: Looked) -> None:
    """The object and the cameras, in space; the plot's axes are z, x, y of the object."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    views, radius = looked.views, NEAR * extent(looked.found)[1]
    if "composed" in looked.found.grids:
        frame = GridFrame(*jnp.float32([looked.found.origin, looked.found.voxel_size]))
        mesh = surface(looked.found.grids["composed"], frame, smoothing=10)
        shade = 0.55 + 0.45 * np.clip(mesh.face_normals @ [0.35, 0.8, 0.5], 0, 1)
        colors = np.outer(shade, rgb(ORANGE))
        faces = mesh.triangles[..., [2, 0, 1]]
        axes.add_collection3d(Poly3DCollection(faces, facecolors=colors, zorder=0))
    eyes = np.asarray(views.T_object_camera.translation())[:, [2, 0, 1]]
    eyes = eyes * (radius / np.linalg.norm(eyes, axis=1, keepdims=True))
    shown = axes.scatter(*eyes.T, c=views.gain, cmap="viridis", s=9, depthshade=False, zorder=1)
    for number, i in enumerate(looked.best, 1):
        axes.plot(*np.stack([eyes[i], 0.3 * eyes[i]]).T, color=RED, linewidth=1.2, zorder=2)
        axes.text(*(1.1 * eyes[i]), str(number), color=RED, weight="bold", fontsize=12, zorder=3)
    axes.quiver(0.5 * radius, 0, looked.floor, 0.3 * radius, 0, 0, color=BLUE, linewidth=1)
    axes.text(0.85 * radius, 0, looked.floor, "front", color=BLUE)
    axes.set(xlim=(-radius, radius), ylim=(-radius, radius), zlim=(looked.floor, radius))
    axes.set_box_aspect((2, 2, 1 - looked.floor / radius), zoom=1.3)
    axes.view_init(elev=28, azim=35)
    axes.set_axis_off()
    axes.computed_zorder = False
    bar = figure.colorbar(shown, ax=axes, shrink=0.5, orientation="horizontal", pad=0)
    bar.set_label("expected drop in entropy (nats)")


def _draw_map(axes: Any, looked: Looked) -> None:
    """The cameras seen from above: the front of the object points down, its left to the right."""
    views = looked.views
    eyes = np.asarray(views.T_object_camera.translation())
    azimuth, height = np.arctan2(eyes[:, 0], eyes[:, 2]), _elevation(eyes)
    axes.set_theta_zero_location("S")
    axes.scatter(azimuth, 90 - height, c=views.gain, cmap="viridis", s=22)
    filmed = np.array([T[:3, 3] for _, T in camera_poses(looked.found)]).reshape(-1, 3)
    if len(filmed):
        axes.plot(
            np.arctan2(filmed[:, 0], filmed[:, 2]), 90 - _elevation(filmed), "s",
            color=PALE, markeredgecolor=INK, markersize=5, label="keyframes",
        )  # fmt: skip
        axes.legend(loc="lower right", bbox_to_anchor=(1.15, -0.08), frameon=False)
    for number, i in enumerate(looked.best, 1):
        place = azimuth[i], 90 - height[i]
        axes.plot(*place, "o", markersize=17, markerfacecolor="white", markeredgecolor=RED)
        axes.text(*place, str(number), color=RED, weight="bold", ha="center", va="center")
    axes.set_xticks(np.radians([0, 90, 180, 270]), ["front", "its left", "back", "its right"])
    axes.set_yticks([])
    axes.grid(color=FOG, linewidth=0.4)
    axes.set_ylim(0, 112)
    axes.set_anchor("S")


def _elevation(eyes: np.ndarray) -> np.ndarray:
    return np.degrees(np.arctan2(eyes[:, 1], np.hypot(eyes[:, 0], eyes[:, 2])))
