"""The pictures of a report as data URIs, and its scene in 3D as JSON. [host]"""

import base64
import io
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from jaxshape.report.paint import paints
from jaxshape.report.palette import LAYERS
from jaxshape.report.panels import Panel, depth_panels, grid_panel, measurement_panel
from jaxshape.report.pictures import render_mesh
from jaxshape.results.folder import (
    KeyframeRecord,
    ResultFolder,
    camera_poses,
    extent,
    half_field_of_view,
    mesh_in_object,
    picture,
    thumbnail,
)

_WIDTH = 320  # pixels of a keyframe's pictures
_FRUSTUM = 0.12  # length of a drawn camera, in radii of the scene


class Picture(NamedTuple):
    """A picture of the report.

    Attributes:
        title: Text above the picture.
        uri: The picture as a data URI.
        description: Text for readers who cannot see the picture.
        note: Text below the picture.
    """

    title: str
    uri: str
    description: str
    note: str = ""


# ------------------------------------------------------------------ in 3D


def scene(found: ResultFolder) -> dict[str, Any]:
    """The scene that page.js draws: layers in the object frame, and the view.

    Numbers are stored as base64 of their little-endian bytes, grids as bits, 4 KiB each, which the
    page turns into cubes.
    """
    mesh, origin, voxel_size = mesh_in_object(found), found.origin, found.voxel_size
    grid = next(iter(found.grids.values()), np.zeros((32, 32, 32), bool))
    geometry: dict[str, Any] = {}
    if mesh is not None:
        geometry["mesh"] = {
            "vertices": _base64(mesh.vertices, "<f4"),
            "faces": _base64(mesh.faces, "<u4"),
            "paints": {name: _base64(paint.colors, "u1") for name, paint in paints(found).items()},
        }
    for name, voxels in found.grids.items():
        geometry[name] = {"voxels": _base64(np.packbits(voxels), "u1")}
    center, radius = extent(found)
    if cameras := [_frustum(found, T, _FRUSTUM * radius) for _, T in camera_poses(found)]:
        geometry["cameras"] = {"lines": _base64(np.concatenate(cameras), "<f4")}
    if len(found.trajectory):
        geometry["trajectory"] = {"lines": _base64(found.trajectory, "<f4")}
    layers = [
        {
            "name": name,
            "color": layer.color,
            "shown": layer.shown,
            "opacity": 0.3 if name == "occluded" else 1,
            **geometry[name],
        }
        for name, layer in LAYERS.items()
        if name in geometry
    ]
    return {
        "layers": layers,
        "origin": origin.tolist(),
        "voxel_size": voxel_size.tolist(),
        "shape": list(grid.shape),
        "center": center.tolist(),
        "radius": radius,
    }


def _base64(values: Any, dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype).tobytes()).decode()


def _frustum(
    found: ResultFolder, T_object_camera: Float[np.ndarray, "4 4"], length: float
) -> Float[np.ndarray, "s 2 3"]:
    """Edges of a camera's pyramid, with a notch at the top of its image."""
    half_width, half_height = half_field_of_view(found)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (half_width, half_height)
    notch = np.array([[-0.4, -1], [0, -1.5], [0.4, -1]]) * (half_width, half_height)
    rim = np.concatenate([corners, corners[:1]])
    image = np.concatenate([_pairs(rim), _pairs(notch)])
    edges = np.stack([np.zeros((4, 2)), corners], axis=1)
    points = np.concatenate(
        [np.insert(image, 2, 1, axis=-1), np.insert(edges, 2, [[0, 1]], axis=-1)]
    )
    return length * points @ T_object_camera[:3, :3].T + T_object_camera[:3, 3]


def _pairs(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n-1 2 2"]:
    return np.stack([points[:-1], points[1:]], axis=1)


def still(found: ResultFolder) -> Picture | None:
    """A still picture of the mesh, for pages that cannot show it in 3D."""
    mesh = mesh_in_object(found)
    if mesh is None:
        return None
    first = next(iter(paints(found).values()), None)
    color = LAYERS["mesh"].color if first is None else first.colors
    image = render_mesh(mesh, color=color, size=480)
    return Picture("mesh", _png(image), "The rebuilt mesh, from the front, right and above")


# ------------------------------------------------------------------ grids, frames, search


def grids(found: ResultFolder) -> list[Picture]:
    """F and M in one picture, then each predicted grid, with its IoU where that is known."""
    panels: list[Panel] = []
    have = found.grids
    if "occupied" in have and "occluded" in have:
        panels.append(measurement_panel("F (blue) and M", have["occupied"], have["occluded"]))
    for name in ("encoder", "refined", "composed"):
        if name in have:
            score = found.result.get(f"iou_{name}")
            note = f"IoU {score:.3f}" if isinstance(score, float) else ""
            title = "prior (encoder)" if name == "encoder" else name
            panels.append(_grid_panel(title, name, have, note))
    if "truth" in have:
        panels.append(grid_panel("truth", have["truth"], "truth"))
    return [
        Picture(p.title, _png(p.image), f"Grid as cubes: {p.title}", note=p.note) for p in panels
    ]


def _grid_panel(title: str, name: str, have: dict[str, Any], note: str) -> Panel:
    """A predicted grid; measured voxels of the composed grid are blue."""
    if name == "composed" and "occupied" in have:
        labels = np.where(have["occupied"], 1, 2 * have["composed"])
        return grid_panel(title, labels, "measured", "predicted", note=note)
    return grid_panel(title, have[name], "predicted", note=note)


def keyframes(chosen: Sequence[KeyframeRecord]) -> list[list[Picture]]:
    """For each keyframe, colour with the object's outline and depth, if the images exist."""
    depths = [_depth(keyframe) for keyframe in chosen]
    panels = iter(depth_panels([depth for depth in depths if depth is not None]))
    pictured = []
    for keyframe, depth in zip(chosen, depths, strict=True):
        pictures, color = [], picture(keyframe, "image")
        if color is not None:
            image = _outlined(thumbnail(color, _WIDTH), picture(keyframe, "mask"))
            pictures.append(Picture("colour", _jpeg(image), f"Colour image of {keyframe.name}"))
        if depth is not None:
            image = next(panels).image
            pictures.append(Picture("depth", _jpeg(image), f"Depth image of {keyframe.name}"))
        pictured.append(pictures)
    return pictured


def _depth(keyframe: KeyframeRecord) -> Float[np.ndarray, "h w"] | None:
    stored = picture(keyframe, "depth")
    return None if stored is None else thumbnail(stored, _WIDTH).astype(np.float32) / 1000


def _outlined(image: UInt8[np.ndarray, "h w 3"], mask: Any) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a bright line inside a dark one around the mask, to be visible on any background."""
    from scipy.ndimage import binary_dilation

    if mask is None:
        return image
    rows, columns = (
        np.arange(n) * m // n for n, m in zip(image.shape[:2], mask.shape[:2], strict=True)
    )
    inside = (mask if mask.ndim == 2 else mask[..., 0])[np.ix_(rows, columns)] > 0
    line = binary_dilation(inside, iterations=2) & ~inside
    rim = binary_dilation(line) & ~inside & ~line
    drawn = image.copy()
    drawn[line] = (0xF0, 0xE4, 0x42)
    drawn[rim] = 0
    return drawn


def convergence(folder: Path) -> Picture | None:
    """The course of the last search, drawn by `plot_search`; `None` where none was kept."""
    from jaxshape.report.plots import plot_search
    from jaxshape.results.traces import read_search

    try:
        with tempfile.TemporaryDirectory() as temporary:
            path = Path(temporary) / "search.svg"
            plot_search(path, read_search(folder))
            svg = path.read_bytes()
    except (ValueError, KeyError, TypeError, AttributeError, IndexError):
        return None  # no search, or one of another version
    uri = f"data:image/svg+xml;base64,{base64.b64encode(svg).decode()}"
    return Picture("search", uri, "Plots of the objective and the step size over the evaluations")


def _png(image: UInt8[np.ndarray, "h w 3"]) -> str:
    return _encoded(image, "png", optimize=True)


def _jpeg(image: UInt8[np.ndarray, "h w 3"]) -> str:
    return _encoded(image, "jpeg", quality=82)


def _encoded(image: UInt8[np.ndarray, "h w 3"], form: str, **settings: Any) -> str:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, form, **settings)
    return f"data:image/{form};base64,{base64.b64encode(buffer.getvalue()).decode()}"
