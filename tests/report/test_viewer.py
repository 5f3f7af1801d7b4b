"""The live view: what it serves, and that it follows the folder."""

import io
import json
import shutil
import socket
import time
import urllib.request

import numpy as np
import pytest
from browser import opened_browser
from PIL import Image
from result_folder import KEYFRAMES, change_json, write_json

from jaxshape.cli import common, viewing

pytest.importorskip("viser", reason="viser, of the extra viewer, is not installed")
from jaxshape.report import viewer
from jaxshape.report.guard import is_own
from jaxshape.report.viewer import LiveView, view

GRIDS = {"/occupied", "/occluded", "/encoder", "/refined", "/composed", "/truth"}


@pytest.fixture
def open_view():
    """Serve folders at free ports of this machine alone."""
    opened = []

    def serve(folder):
        opened.append(LiveView(folder, host="127.0.0.1", port=0))
        return opened[-1]

    yield serve
    for live in opened:
        live.stop()


def nodes(live):
    return set(live._drawn)


def test_it_answers_at_the_address_it_tells(folder, open_view):
    live = open_view(folder)
    assert live.url.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(live.url, timeout=10) as answer:
        assert answer.status == 200 and b"<html" in answer.read()


def answer(live, host, origin=None, upgrade=False):
    """The first line of the answer to a request."""
    port = live.server.get_port()
    lines = ["GET / HTTP/1.1", f"Host: {host.format(port=port)}"]
    lines += [f"Origin: {origin.format(port=port)}"] if origin else []
    if upgrade:
        lines += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
        lines += ["Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol: viser-v1"]
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        return connection.recv(100).decode().split("\r\n")[0]


def test_pages_of_others_get_nothing(folder, open_view):
    """A page from anywhere can ask at 127.0.0.1, and a name of anyone can point there."""
    live, own = open_view(folder), "127.0.0.1:{port}"
    for upgrade, status in ((False, "200"), (True, "101")):
        for host in (own, "localhost:{port}", "[::1]:{port}"):
            assert status in answer(live, host, f"http://{host}", upgrade=upgrade)
        assert status in answer(live, own, upgrade=upgrade)
        for host, origin in (
            ("evil.example:{port}", None),
            ("evil.example:{port}", "http://evil.example:{port}"),
            (own, "http://evil.example"),
            (own, "null"),
            (own, "http://127.0.0.1:1"),
            ("127.0.0.1.evil.example", None),
        ):
            assert "403" in answer(live, host, origin, upgrade=upgrade), (host, origin)


@pytest.mark.parametrize("served", ["0.0.0.0", "192.168.1.7"])
def test_on_a_network_the_machine_is_asked_by_its_number_or_its_name(served):
    own = (f"{socket.gethostname()}:8080", "192.168.1.7:8080", "[fe80::1]:8080")
    assert all(is_own([host], [f"http://{host}"], served) for host in own)
    assert not is_own(["evil.example"], [], served)
    assert not is_own([own[0]], ["http://evil.example"], served)
    assert not is_own([], [], served) and not is_own([own[1], own[1]], [], served)


def test_the_scene_holds_shape_grids_and_cameras(folder, open_view):
    live = open_view(folder)
    cameras = {f"/cameras/{i}" for i in range(KEYFRAMES)}
    assert nodes(live) == {"/mesh", "/trajectory"} | GRIDS | cameras
    assert "a chair" in live.figures.content and "0.5000 → 0.2500" in live.figures.content
    assert live.boxes["mesh"].value and not live.boxes["occupied"].value
    _, mesh = live._drawn["/mesh"]
    _, occupied = live._drawn["/occupied"]
    assert mesh.visible and not occupied.visible
    live.boxes["occupied"].value = True
    live._show()
    assert occupied.visible


def test_the_mesh_is_painted_as_chosen(painted, open_view):
    live = open_view(painted)
    assert live.paint.visible and len(live.paint.options) == 2
    first = live._drawn["/mesh"][1]
    live.paint.value = live.paint.options[1]
    live._scene()
    second = live._drawn["/mesh"][1]
    assert second is not first and second.visible
    before = second
    live._scene()
    assert live._drawn["/mesh"][1] is before  # nothing changed


def test_a_plain_mesh_has_no_choice_of_colours(folder, open_view):
    assert not open_view(folder).paint.visible


def test_cubes_lie_on_the_voxels(folder, open_view):
    _, truth = open_view(folder)._drawn["/truth"]
    low, high = truth.batched_positions.min(axis=0), truth.batched_positions.max(axis=0)
    origin, size = np.array([-0.32, -0.48, -0.32]), np.array([0.02, 0.03, 0.02])
    np.testing.assert_allclose(low, origin + (np.array([4, 1, 4]) + 0.5) * size, atol=1e-6)
    np.testing.assert_allclose(high, origin + (np.array([27, 30, 27]) + 0.5) * size, atol=1e-6)


def test_it_follows_the_folder_and_redraws_only_what_changed(folder, open_view):
    live = open_view(folder)
    assert not live.refresh()
    before = dict(live._drawn)
    content = json.loads((folder / "keyframes.json").read_text())
    content["keyframes"] = content["keyframes"][:1]
    write_json(folder / "keyframes.json", content)
    change_json(folder / "result.json", running=True)
    assert live.refresh() and not live.refresh()
    assert nodes(live) == {"/mesh", "/trajectory", "/cameras/0"} | GRIDS
    assert all(live._drawn[name] is before[name] for name in nodes(live) & GRIDS)
    assert "still running" in live.figures.content


def test_a_folder_that_fills_is_shown_as_it_does(made, tmp_path, open_view):
    folder = tmp_path / "result"
    folder.mkdir()
    live = open_view(folder)
    assert not nodes(live)
    shutil.copytree(made / "keyframes", folder / "keyframes")
    (folder / "mesh.ply").write_bytes(b"half")
    shutil.copy(made / "keyframes.json", folder)
    assert live.refresh() and len(nodes(live)) == KEYFRAMES + 1
    assert "mesh.ply cannot be read" in live.figures.content
    assert live.slider.value == KEYFRAMES - 1  # the newest
    for name in ("mesh.ply", "grid.npz", "result.json"):
        shutil.copy(made / name, folder)
    assert live.refresh() and {"/mesh"} | GRIDS <= nodes(live)
    assert "cannot be read" not in live.figures.content


def test_the_last_picture_stays_when_the_folder_goes(folder, open_view):
    live = open_view(folder)
    before = nodes(live)
    shutil.rmtree(folder)
    assert not live.refresh() and nodes(live) == before


def test_the_objects_of_a_room_stand_in_their_boxes(tmp_path, open_view):
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    box = {"T_world_object": T.tolist(), "size": [0.5, 0.9, 0.6]}
    damaged = {"name": "object-3", "T_world_object": "here", "size": [1, 1, 1]}
    worse = {"name": 4, "size": 5, "sure": "so", "verdict": "good", "verdict_reasons": 6}
    first = {"name": "chair-1", "class": "chair", "sure": 0.9, **box}
    entries = [first, damaged, "no object", worse]
    content = {"objects": entries}
    (tmp_path / "scene.json").write_text(json.dumps(content | {"running": True}))
    live = open_view(tmp_path)
    assert nodes(live) == {"/objects/0"}
    assert "still running" in live.figures.content
    assert "chair-1: chair (90% sure), 0.50 x 0.90 x 0.60 m" in live.figures.content
    before = live._drawn["/objects/0"][1]
    assert np.allclose(before.position, 0)  # the first object is what everything is turned by
    entries.append({"name": "object-2", **box, "size": [0.3, 0.3, 0.3]})
    (tmp_path / "scene.json").write_text(json.dumps(content))
    assert live.refresh() and nodes(live) == {"/objects/0", "/objects/1"}
    assert live._drawn["/objects/0"][1] is before
    live.boxes["objects"].value = False
    live._show()
    assert not before.visible


def test_text_from_the_folder_stays_text(folder, open_view):
    change_json(folder / "result.json", object="<b>x</b>", warnings=["<i>y</i>"])
    shown = open_view(folder).figures.content
    assert "&lt;b&gt;x" in shown and "&lt;i&gt;y" in shown


def test_an_address_of_another_machine_is_refused(folder):
    with pytest.raises(ValueError, match="address of this machine"):
        LiveView(folder, host="192.0.2.1", port=0)


def test_an_interrupt_ends_it(folder, monkeypatch):
    addresses = []

    def interrupt(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer.time, "sleep", interrupt)
    view(folder, host="127.0.0.1", port=0, on_start=addresses.append)
    monkeypatch.undo()
    time.sleep(0.2)
    with pytest.raises(OSError):
        urllib.request.urlopen(addresses[0], timeout=2)


def test_a_browser_shows_the_scene(folder, open_view):
    live = open_view(folder)
    with opened_browser() as browser:
        tab = browser.new_page(viewport={"width": 900, "height": 600})
        tab.goto(live.url)
        tab.get_by_text("a chair").wait_for()
        orange = lambda: (  # noqa: E731
            np.abs(
                np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"), int)
                - (0xE6, 0x9F, 0)
            ).sum(axis=-1)
            < 150
        ).mean()
        end = time.monotonic() + 20
        while orange() < 0.01 and time.monotonic() < end:
            tab.wait_for_timeout(300)
        assert orange() > 0.01


# --- the command ------------------------------------------------------------------------------


def test_missing_files_are_named_in_a_sentence(folder, tmp_path, monkeypatch):
    with pytest.raises(common.BadInput, match="no folder"):
        viewing.ViewResult(tmp_path / "none").run()
    with pytest.raises(common.BadInput, match="--port"):
        viewing.ViewResult(folder, port=0).run()
    monkeypatch.setattr(viewing, "find_spec", lambda name: None)
    with pytest.raises(common.BadInput, match=r"pip install 'jaxshape\[viewer\]'"):
        viewing.ViewResult(folder).run()
