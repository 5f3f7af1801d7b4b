"""A result folder live in a browser, through viser; drawn anew whenever its files change. [host]"""

import io
import os
import socket
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import viser  # pyright: ignore[reportMissingImports] - of the extra `viewer`
import viser.transforms  # pyright: ignore[reportMissingImports]
from jaxtyping import Bool, Float
from scipy.ndimage import binary_erosion
from trimesh.visual import ColorVisuals

from jaxshape.report.guard import guarded
from jaxshape.report.paint import Paint, paints
from jaxshape.report.palette import LAYERS
from jaxshape.results.folder import (
    KeyframeRecord,
    ObjectBox,
    ResultFolder,
    camera_poses,
    extent,
    half_field_of_view,
    mesh_in_object,
    object_boxes,
    picture,
    read_folder,
    thumbnail,
)
from jaxshape.results.summary import headline, objects_in_words, tracked, warnings_of

WATCHED = ("mesh.ply", "grid.npz", "keyframes.json", "result.json", "scene.json")
PLAIN = "one colour"
SECONDS_BETWEEN_LOOKS = 0.5
LINES: Any = {"thickness": 2.0, "thickness_units": "screen"}

Draw = Callable[[], Any]


class LiveView:
    """A server of one result folder; `refresh` shows its changes."""

    def __init__(self, folder: str | os.PathLike[str], *, host: str, port: int) -> None:
        """Serve on `host`, at `port` or the next free one, and draw the folder."""
        self.folder = Path(folder)
        self.found = read_folder(self.folder)  # refuses a missing folder before a server is up
        _require_own(host)
        with redirect_stdout(io.StringIO()), guarded(host):  # hides a banner
            self.server = viser.ViserServer(host=host, port=port, label="jaxshape", verbose=False)
        self.url = f"http://{host}:{self.server.get_port()}"
        self._stamps: dict[str, Any] = {}
        self._drawn: dict[str, tuple[bytes, Any]] = {}
        self._is_placed = False
        self.server.scene.set_up_direction("+y")
        self._panel()
        self.refresh()

    def refresh(self) -> bool:
        """Draw the changes of the folder since last time; returns whether there were any."""
        stamps = {name: _stamp(self.folder / name) for name in WATCHED}
        if stamps == self._stamps or not self.folder.is_dir():
            return False
        self._stamps = stamps  # taken before reading: a change while reading is seen next time
        self.found = read_folder(self.folder)
        with self.server.atomic():
            self._tell()
            self._scene()
        return True

    def stop(self) -> None:
        self.server.stop()

    # -------------------------------------------------------------- the panel

    def _panel(self) -> None:
        """Build the panel next to the picture: figures, layers to show, keyframes."""
        gui = self.server.gui
        # Sharing would send the scene through another machine.
        gui.configure_theme(show_logo=False, show_share_button=False)
        self.figures = gui.add_html("")
        self.boxes = {}
        with gui.add_folder("Show"):
            for name, layer in LAYERS.items():
                self.boxes[name] = gui.add_checkbox(layer.label, layer.shown)
                self.boxes[name].on_update(lambda _: self._show())
            self.paint: Any = gui.add_dropdown("Mesh in", (PLAIN,), visible=False)
            self.paint.on_update(lambda _: self._scene())
        with gui.add_folder("Keyframe") as self.keyframes:
            self.slider = gui.add_slider("number", 0, 1, 1, 1)
            self.slider.on_update(lambda _: self._choose())
            self.chosen = gui.add_html("")
            self.image = gui.add_image(np.full((3, 4, 3), 255, np.uint8))
            gui.add_button("Look from here").on_click(self._look)

    def _tell(self) -> None:
        figures = headline(self.found)
        lines = [f"<b>{escape(name)}</b>: {escape(value)}" for name, value, _ in figures]
        lines += map(escape, objects_in_words(self.found.result))
        lines += [f"⚠ {escape(text)}" for text in warnings_of(self.found)]
        state = "still running" if self.found.result.get("running") else ""
        name = escape(str(self.found.result.get("object", self.found.name)))
        self.figures.content = _html([f"<b>{name}</b> {state}", *lines])
        count = len(self.found.keyframes)
        self.keyframes.visible = count > 0
        was_last = self.slider.value >= self.slider.max or self.slider.value >= count
        self.slider.max = max(1, count - 1)
        if was_last and count:
            self.slider.value = count - 1  # follow a running reconstruction
        self._choose()

    def _choose(self) -> None:
        """Show the keyframe that the slider is at."""
        keyframe = self._at_slider()
        if keyframe is None:
            return
        self.chosen.content = _html([f"<b>{escape(keyframe.name)}</b>", escape(tracked(keyframe))])
        image = picture(keyframe, "image")
        self.image.visible = image is not None
        if image is not None:
            self.image.image = image

    def _at_slider(self) -> KeyframeRecord | None:
        keyframes = self.found.keyframes
        return keyframes[min(int(self.slider.value), len(keyframes) - 1)] if keyframes else None

    def _look(self, event: Any) -> None:
        """Move the asking client's view to the camera of the chosen keyframe."""
        keyframe = self._at_slider()
        for of, T_object_camera in camera_poses(self.found):
            if of is keyframe and event.client is not None:
                with event.client.atomic():
                    event.client.camera.wxyz = _wxyz(T_object_camera)
                    event.client.camera.position = T_object_camera[:3, 3]

    # -------------------------------------------------------------- the scene

    def _scene(self) -> None:
        """Draw new and changed parts, and remove missing ones."""
        nodes = _nodes(self.server.scene, self.found, self._paint())
        for name in set(self._drawn) - set(nodes):
            self._drawn.pop(name)[1].remove()
        for name, (content, draw) in nodes.items():
            if self._drawn.get(name, (None,))[0] != content:
                self._drawn[name] = content, draw()
        self._show()
        if not self._is_placed and nodes:
            self._is_placed = self.found.mesh is not None or bool(self.found.grids)
            center, radius = extent(self.found)
            start = self.server.initial_camera
            start.look_at, start.fov = center, np.radians(45.0)
            start.position = center + 4.5 * radius * np.array([0.52, 0.42, 0.74])

    def _paint(self) -> Paint | None:
        """The chosen colours of the mesh, among the available ones."""
        there = {paint.label: paint for paint in paints(self.found).values()}
        if tuple(there) != self.paint.options and there:
            self.paint.options = tuple(there)
        self.paint.visible = bool(there)
        return there.get(self.paint.value)

    def _show(self) -> None:
        """Show the layers that are ticked, and boxes for the layers there are."""
        drawn = list(self._drawn.items())
        for name, (_, node) in drawn:
            node.visible = self.boxes[_layer(name)].value
        there = {_layer(name) for name, _ in drawn}
        for layer, box in self.boxes.items():
            box.visible = layer in there


def view(
    folder: str | os.PathLike[str], *, host: str, port: int, on_start: Callable[[str], Any]
) -> None:
    """Serve a result folder until interrupted; `on_start` gets the address once it is up."""
    live = LiveView(folder, host=host, port=port)
    on_start(live.url)
    try:
        while True:
            time.sleep(SECONDS_BETWEEN_LOOKS)
            live.refresh()
    except KeyboardInterrupt:  # how it is meant to end
        live.stop()


def _require_own(host: str) -> None:
    """Refuse an address of another machine, for which viser would try one port after the other."""
    try:
        socket.create_server((host, 0)).close()
    except OSError as problem:
        raise ValueError(
            f"Nothing can be served at {host!r}: {problem}. Give an address of this machine, "
            "such as 127.0.0.1."
        ) from None


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size


def _html(lines: list[str]) -> str:
    style = "padding: 0.2em 1em; font-size: 0.85em; overflow-wrap: anywhere"
    return f'<div style="{style}">{"<br>".join(lines)}</div>'


# ------------------------------------------------------------------ nodes of the scene


def _nodes(
    scene: viser.SceneApi, found: ResultFolder, paint: Paint | None
) -> dict[str, tuple[bytes, Draw]]:
    """Nodes by name: the bytes that identify the content of each, and how to draw it."""
    nodes: dict[str, tuple[bytes, Draw]] = {}
    mesh, path = mesh_in_object(found), found.trajectory
    if mesh is not None:
        content = mesh.vertices.tobytes() + mesh.faces.tobytes()
        content += b"" if paint is None else paint.colors.tobytes()
        nodes["/mesh"] = content, partial(_mesh, scene, mesh, paint)
    for name, grid in found.grids.items():
        content = grid.tobytes() + found.origin.tobytes() + found.voxel_size.tobytes()
        if grid.any():
            nodes[f"/{name}"] = content, partial(_cubes, scene, f"/{name}", found, grid)
    for number, (keyframe, T) in enumerate(camera_poses(found)):
        name, content = f"/cameras/{number}", T.tobytes() + str(keyframe.files).encode()
        nodes[name] = content, partial(_camera, scene, name, found, keyframe, T)
    if len(path):
        nodes["/trajectory"] = path.tobytes(), partial(_path, scene, path)
    for number, one in enumerate(object_boxes(found)):
        name, content = f"/objects/{number}", one.T.tobytes() + one.size.tobytes()
        nodes[name] = content + one.name.encode(), partial(_box, scene, name, one)
    return nodes


def _layer(name: str) -> str:
    return name.split("/")[1]


def _mesh(scene: viser.SceneApi, mesh: trimesh.Trimesh, paint: Paint | None) -> Any:
    if paint is not None:
        mesh.visual = ColorVisuals(mesh, vertex_colors=paint.colors)
        return scene.add_mesh_trimesh("/mesh", mesh)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    return scene.add_mesh_simple("/mesh", vertices, faces, color=_rgb("mesh"), side="double")


def _path(scene: viser.SceneApi, path: Float[np.ndarray, "s 2 3"]) -> Any:
    return scene.add_line_segments("/trajectory", path, _rgb("trajectory"), **LINES)


def _box(scene: viser.SceneApi, name: str, one: ObjectBox) -> Any:
    """The edges of an object's box, with its name above."""
    corners = one.size * (trimesh.bounds.corners([[-0.5] * 3, [0.5] * 3]))
    pairs = [(a, b) for a in range(8) for b in range(a) if (corners[a] != corners[b]).sum() == 1]
    frame = scene.add_frame(name, show_axes=False, wxyz=_wxyz(one.T), position=one.T[:3, 3])
    scene.add_line_segments(f"{name}/box", corners[np.array(pairs)], _rgb("objects"), **LINES)
    scene.add_label(f"{name}/label", one.name, position=(0.0, 0.55 * one.size[1], 0.0))
    return frame


def _cubes(
    scene: viser.SceneApi, name: str, found: ResultFolder, grid: Bool[np.ndarray, "x y z"]
) -> Any:
    """A cube, drawn once for each voxel that is not enclosed."""
    shut_in = np.asarray(binary_erosion(grid), bool)
    centers = np.argwhere(grid & ~shut_in) + 0.5
    cube = trimesh.creation.box(extents=found.voxel_size)
    return scene.add_batched_meshes_simple(
        name,
        np.asarray(cube.vertices),
        np.asarray(cube.faces),
        batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(centers), 1)),
        batched_positions=found.origin + centers * found.voxel_size,
        batched_colors=_rgb(name[1:]),
        opacity=0.3 if name == "/occluded" else None,
        flat_shading=True,
        lod="off",
        cast_shadow=False,
    )


def _camera(
    scene: viser.SceneApi,
    name: str,
    found: ResultFolder,
    keyframe: KeyframeRecord,
    T_object_camera: Float[np.ndarray, "4 4"],
) -> Any:
    half_width, half_height = half_field_of_view(found)
    image = picture(keyframe, "image")
    return scene.add_camera_frustum(
        name,
        2 * float(np.arctan(half_height)),
        half_width / half_height,
        scale=0.15 * extent(found)[1],
        color=_rgb("cameras"),
        image=None if image is None else thumbnail(image, 160),
        **LINES,
        wxyz=_wxyz(T_object_camera),
        position=T_object_camera[:3, 3],
    )


def _rgb(layer: str) -> tuple[int, int, int]:
    red, green, blue = bytes.fromhex(LAYERS[layer].color[1:])
    return red, green, blue


def _wxyz(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 4"]:
    return viser.transforms.SO3.from_matrix(T[:3, :3]).wxyz
