"""report.html: whole, alone, harmless, and drawn by a browser."""

import base64
import hashlib
import io
import json
import re
import shutil
from html.parser import HTMLParser

import numpy as np
import pytest
import trimesh
from browser import opened_browser
from made_result import T_WORLD_OBJECT
from PIL import Image
from result_folder import (
    INSIDE,
    KEYFRAMES,
    OCCLUDED,
    OCCUPIED,
    STATUSES,
    T_OBJECT_CAMERA,
    TRUTH,
    change_json,
    write_json,
)

from jaxshape.report import illustrations, plots
from jaxshape.report.page import write_report
from jaxshape.results.surface import read_ply

FILES = ("mesh.ply", "grid.npz", "trace.npz", "keyframes.json", "result.json")


@pytest.fixture
def quick(monkeypatch):
    """Without the slowest pictures, for tests of something else."""
    flat = np.arange(48, dtype=np.uint8).reshape(4, 4, 3) * 5
    monkeypatch.setattr(illustrations, "render_mesh", lambda mesh, **settings: flat)
    monkeypatch.setattr(plots, "plot_search", lambda path, search: path.write_text("<svg/>"))


class Page(HTMLParser):
    """The elements, attributes and text of a page."""

    def __init__(self, html):
        super().__init__()
        self.html, self.tags, self.attributes, self.text, self._inside = html, [], [], "", ""
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        self._inside = tag

    def handle_data(self, data):
        if self._inside not in ("script", "style"):
            self.text += " ".join(data.split()) + " "

    def all(self, name):
        return [value for _, key, value in self.attributes if key == name]

    def script(self, opening):
        return re.search(re.escape(opening) + "(.*?)</script>", self.html, re.DOTALL)[1]

    @property
    def scene(self):
        return json.loads(self.script('id="scene">'))


def report(folder):
    return Page(write_report(folder).read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def page(made, tmp_path_factory):
    return report(shutil.copytree(made, tmp_path_factory.mktemp("page") / "result"))


def layers(page):
    return {layer["name"]: layer for layer in page.scene["layers"]}


def pictures_of_keyframes(page):
    """The number of pictures of each keyframe that the page shows."""
    (section,) = re.findall("<h2>Keyframes</h2>.*?</section>", page.html, re.DOTALL)
    return [figure.count("<img") for figure in re.findall("<figure>.*?</figure>", section)]


def floats(text):
    return np.frombuffer(base64.b64decode(text), "<f4")


# --- whole and alone --------------------------------------------------------------------------


def test_nothing_is_fetched_from_anywhere(page):
    assert page.all("src") and all(src.startswith("data:image/") for src in page.all("src"))
    assert not page.all("href") and "link" not in page.tags and "iframe" not in page.tags
    style = re.search("<style>(.*?)</style>", page.html, re.DOTALL)[1]
    assert "url(" not in style and "@import" not in style
    script = page.script("<script>")
    assert not re.search(r"fetch\(|XMLHttpRequest|import\(|https?:", script)


def test_the_browser_is_told_to_load_nothing_and_to_run_only_this_script(page):
    (policy,) = [value for value in page.all("content") if "default-src" in value]
    digest = hashlib.sha256(page.script("<script>").encode()).digest()
    assert "default-src 'none'" in policy
    assert f"script-src 'sha256-{base64.b64encode(digest).decode()}'" in policy


def test_every_picture_can_be_decoded_and_is_described(page):
    for src in page.all("src"):
        kind, data = re.fullmatch(r"data:image/([a-z+]+);base64,(.*)", src).groups()
        if kind == "svg+xml":
            assert b"<svg" in base64.b64decode(data)
        else:
            with Image.open(io.BytesIO(base64.b64decode(data))) as image:
                assert np.ptp(np.asarray(image)) > 50
    assert pictures_of_keyframes(page) == [2] * KEYFRAMES
    assert len(page.all("alt")) == len(page.all("src")) and all(page.all("alt"))


def test_the_figures_are_told_with_their_units(page):
    result_iou = float((OCCUPIED & TRUTH).sum() / TRUTH.sum())
    assert result_iou < 1  # else the IoU below says nothing
    for text in (
        "a chair",
        f"{KEYFRAMES} of {len(STATUSES)}",
        "2 tracked, 1 lost, 1 unreadable",
        "0.5000 → 0.2500",
        "nats per voxel of the whole grid "
        "(Eq. 7 with a third of the weight on measured free space)",
        "12.3 s",
        "87 % inliers, 4.2 mm",
        "only 12 % agree",
        "1 of 7 frames were lost",
    ):
        assert text in page.text, text


def test_the_keyframe_table_tells_what_was_written_of_each(page):
    row = ("frame-2", INSIDE.sum(), "87", "64", "4.2", "0.0315", "0.11", "0.22", "1.33")
    assert "<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" in page.html
    assert "realign, s" not in page.text  # no keyframe has it


@pytest.mark.parametrize(
    "search, words",
    [
        ({"objective": "paper"}, "(Eq. 7 as printed)"),
        ({"objective": "robust"}, "(the objective robust)"),
        ({}, "(Eq. 7 or a variant of it)"),
    ],
)
@pytest.mark.usefixtures("quick")
def test_the_objective_is_said_in_words(folder, search, words):
    change_json(folder / "result.json", search=search)
    assert f"nats per voxel of the whole grid {words}" in report(folder).text


@pytest.mark.usefixtures("quick")
def test_a_reconstruction_that_runs_says_so(folder, page):
    change_json(folder / "result.json", running=True)
    assert "still running" in report(folder).text and "still running" not in page.text


# --- the scene --------------------------------------------------------------------------------


def test_grids_travel_as_bits(page):
    for name, grid in {"occupied": OCCUPIED, "occluded": OCCLUDED, "truth": TRUTH}.items():
        packed = np.frombuffer(base64.b64decode(layers(page)[name]["voxels"]), np.uint8)
        np.testing.assert_array_equal(np.unpackbits(packed).reshape(32, 32, 32), grid)
    np.testing.assert_allclose(page.scene["origin"], [-0.32, -0.48, -0.32])
    np.testing.assert_allclose(page.scene["voxel_size"], [0.02, 0.03, 0.02])


def test_the_mesh_is_shown_in_the_object_frame(page, made):
    mesh = trimesh.load_mesh(made / "mesh.ply")
    vertices = floats(layers(page)["mesh"]["vertices"]).reshape(-1, 3)
    faces = np.frombuffer(base64.b64decode(layers(page)["mesh"]["faces"]), "<u4")
    back = vertices @ T_WORLD_OBJECT[:3, :3].T + T_WORLD_OBJECT[:3, 3]
    np.testing.assert_allclose(back, mesh.vertices, atol=1e-5)
    np.testing.assert_array_equal(faces.reshape(-1, 3), mesh.faces)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    np.testing.assert_allclose(page.scene["center"], (low + high) / 2, atol=1e-5)
    assert page.scene["radius"] == pytest.approx(np.linalg.norm(high - low) / 2, rel=1e-4)


def test_the_mesh_can_be_seen_in_colours_and_by_its_source(painted, quick):
    page = report(painted)
    paints = layers(page)["mesh"]["paints"]
    color, source = (
        np.frombuffer(base64.b64decode(paints[name]), np.uint8).reshape(-1, 3)
        for name in ("color", "source")
    )
    written = read_ply(painted / "mesh.ply")
    np.testing.assert_array_equal(color, written.color)
    blue, orange = (0, 0x72, 0xB2), (0xE6, 0x9F, 0)
    np.testing.assert_array_equal(source, np.where(written.measured[:, None], blue, orange))
    assert page.all("id").count("paint") == 1
    options = [value for tag, _, value in page.attributes if tag == "option"]
    assert options == ["color", "source"]


def test_a_mesh_without_colours_offers_none(page):
    assert layers(page)["mesh"]["paints"] == {} and "paint" not in page.all("id")


def test_cameras_stand_where_they_were_and_look_ahead(page):
    lines = floats(layers(page)["cameras"]["lines"]).reshape(KEYFRAMES, -1, 3)
    keyframes = [i for i, status in enumerate(STATUSES) if status == "keyframe"]
    for index, drawn in zip(keyframes, lines, strict=True):
        apex = T_OBJECT_CAMERA[:3, 3] + [0.1 * index, 0, 0]
        values, counts = np.unique(drawn.round(5), axis=0, return_counts=True)
        np.testing.assert_allclose(values[counts == 4], [apex], atol=1e-5)  # of four edges
        image = drawn[np.abs(drawn - apex).max(axis=1) > 1e-4]
        assert (image[:, 2] < apex[2]).all()  # towards the object
        # As wide and high as the field of view, but for the notch, which is at the top.
        depth = apex[2] - image[0, 2]
        assert np.ptp(image[:, 0]) == pytest.approx(depth * 64 / 50, rel=1e-3)
        assert apex[1] - image[:, 1].min() == pytest.approx(depth * 24 / 50, rel=1e-3)
        assert image[:, 1].max() - apex[1] > 1.2 * depth * 24 / 50


def test_the_path_is_broken_where_frames_were_lost(page):
    path = floats(layers(page)["trajectory"]["lines"]).reshape(-1, 2, 3)
    np.testing.assert_allclose(path[..., 0], [[0, 0.1], [0.1, 0.2], [0.5, 0.6]], atol=1e-5)


# --- whatever is there ------------------------------------------------------------------------


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("name", FILES)
def test_each_file_may_be_missing(folder, page, name):
    """The layers of a missing file are left out, those of the other files stay."""
    (folder / name).unlink()
    lost = {
        "mesh.ply": {"mesh"},
        "grid.npz": {"occupied", "occluded", "encoder", "refined", "composed", "truth"},
        "keyframes.json": {"cameras", "trajectory"},
    }
    found = report(folder)
    assert set(layers(page)) - set(layers(found)) == lost.get(name, set())
    assert f"{name} cannot be read" not in found.text


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("content", [b"", b"damaged", b"[1, 2]"])
def test_every_file_may_be_damaged(folder, content):
    for name in FILES:
        (folder / name).write_bytes(content)
    page = report(folder)
    for name in set(FILES) - {"trace.npz"}:
        assert f"{name} cannot be read" in page.text, name


@pytest.mark.usefixtures("quick")
def test_one_damaged_file_does_not_hide_the_others(folder, page):
    archive = folder / "grid.npz"
    archive.write_bytes(archive.read_bytes()[: archive.stat().st_size // 2])
    spoilt = report(folder)
    assert "grid.npz cannot be read" in spoilt.text
    assert set(layers(page)) - set(layers(spoilt)) == {
        "occupied", "occluded", "encoder", "refined", "composed", "truth"
    }  # fmt: skip


@pytest.mark.usefixtures("quick")
def test_pictures_of_keyframes_may_be_missing_or_truncated(folder):
    """A keyframe loses the one picture whose file is damaged; a damaged mask costs no picture."""
    (folder / "keyframes/frame-0.jpg").unlink()
    depth = folder / "keyframes/frame-2.depth.png"
    depth.write_bytes(depth.read_bytes()[:60])
    (folder / "keyframes/frame-6.mask.png").write_bytes(b"")
    assert pictures_of_keyframes(report(folder)) == [1, 1, 2]


@pytest.mark.usefixtures("quick")
def test_figures_may_be_of_any_kind(folder):
    """Written by another version, or by hand."""
    content = json.loads((folder / "keyframes.json").read_text())
    for odd in (None, "x", [1], float("nan"), {}):
        for keyframe in content["keyframes"]:
            keyframe |= dict.fromkeys(("rmse", "seconds", "iou", "T_world_camera"), odd)
        write_json(folder / "keyframes.json", content | {"intrinsics": None})
        change_json(folder / "result.json", objective_refined=odd, seconds=odd, iou_refined=odd)
        assert "keyframes" not in layers(report(folder))


def test_an_empty_folder_gives_a_page(tmp_path):
    page = report(tmp_path)
    assert tmp_path.name in page.text and "section" not in page.tags


def test_no_folder_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no folder"):
        write_report(tmp_path / "none")


@pytest.mark.usefixtures("quick")
def test_before_the_object_is_found_the_first_camera_tells_what_is_up(folder):
    (folder / "grid.npz").unlink()
    (folder / "mesh.ply").unlink()
    path = floats(layers(report(folder))["trajectory"]["lines"]).reshape(-1, 3)
    np.testing.assert_allclose(path[:2], [[0, 0, 0], [0.1, 0, 0]], atol=1e-5)


@pytest.mark.usefixtures("quick")
def test_a_long_recording_makes_no_long_page(folder, page):
    frames = [{"index": i, "name": f"f{i}", "status": "tracked", "reason": ""} for i in range(9000)]
    frames[4000] |= {"status": "lost", "reason": "dark"}
    change_json(folder / "keyframes.json", frames=frames)
    long = report(folder)
    assert "f4001 to f8999" in long.text and "8999 tracked, 1 lost" in long.text
    assert len(long.html) < len(page.html) + 10_000


# --- harmless ---------------------------------------------------------------------------------

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(1)>\"'&$title${body}"


@pytest.mark.usefixtures("quick")
def test_text_from_the_folder_stays_text(folder, page):
    content = json.loads((folder / "keyframes.json").read_text())
    for keyframe in content["keyframes"]:
        keyframe["name"] = HOSTILE
    for frame in content["frames"]:
        frame |= {"name": HOSTILE, "reason": HOSTILE, "status": HOSTILE + str(frame["index"])}
    write_json(folder / "keyframes.json", content)
    odd = dict.fromkeys(("object", "method", "seed", HOSTILE), HOSTILE)
    change_json(folder / "result.json", **odd, warnings=[HOSTILE])
    hostile = report(folder)
    assert hostile.tags.count("script") == page.tags.count("script") == 2
    assert hostile.tags.count("img") == page.tags.count("img")
    assert not [name for _, name, _ in hostile.attributes if name.startswith("on")]
    assert "".join(HOSTILE.split()) in "".join(hostile.text.split())


@pytest.mark.usefixtures("quick")
def test_only_pictures_of_the_folder_are_shown(folder):
    Image.new("RGB", (64, 48), "red").save(folder.parent / "elsewhere.png")
    content = json.loads((folder / "keyframes.json").read_text())
    content["keyframes"][0]["image"] = "../elsewhere.png"
    content["keyframes"][1]["image"] = str(folder.parent / "elsewhere.png")
    write_json(folder / "keyframes.json", content)
    assert pictures_of_keyframes(report(folder)) == [1, 1, 2]


# --- in a browser -----------------------------------------------------------------------------


def shown(element):
    """The pixels of an element."""
    return np.asarray(Image.open(io.BytesIO(element.screenshot())).convert("RGB"), int)


def test_a_browser_draws_and_turns_the_shape(folder):
    path = write_report(folder)
    with opened_browser() as browser:
        tab = browser.new_page(viewport={"width": 390, "height": 800})
        heard = []
        tab.on("console", lambda message: heard.append(message.text))
        tab.on("pageerror", lambda error: heard.append(str(error)))
        tab.on("request", lambda request: heard.append(request.url))
        tab.goto(path.as_uri())
        tab.wait_for_selector("#shape.live canvas")
        canvas = tab.locator("#turnable")
        canvas.scroll_into_view_if_needed()
        tab.wait_for_timeout(200)
        first = shown(canvas)
        assert (np.abs(first - (0xE6, 0x9F, 0)).sum(axis=-1) < 100).mean() > 0.02  # the mesh
        box = canvas.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        tab.mouse.move(x, y)
        tab.mouse.down()
        tab.mouse.move(x + 120, y + 10)
        tab.mouse.up()
        tab.wait_for_timeout(200)
        turned = shown(canvas)
        assert (first != turned).any(axis=-1).mean() > 0.02
        tab.check("[data-layer=occupied]")
        tab.uncheck("[data-layer=mesh]")
        tab.wait_for_timeout(200)
        blue = np.abs(shown(canvas) - (0, 0x72, 0xB2)).sum(axis=-1) < 120
        assert blue.mean() > 0.01
        assert heard == [path.as_uri(), *[url for url in heard if url.startswith("data:")]]
        assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_a_browser_paints_the_mesh_as_chosen(painted):
    path = write_report(painted)
    with opened_browser() as browser:
        tab = browser.new_page(viewport={"width": 390, "height": 800})
        heard = []
        tab.on("pageerror", lambda error: heard.append(str(error)))
        tab.goto(path.as_uri())
        tab.wait_for_selector("#shape.live canvas")
        canvas = tab.locator("#turnable")
        canvas.scroll_into_view_if_needed()
        tab.wait_for_timeout(300)

        def share(color):
            return (np.abs(shown(canvas) - color).sum(axis=-1) < 120).mean()

        green, blue, orange = (20, 160, 60), (0, 0x72, 0xB2), (0xE6, 0x9F, 0)
        assert share(green) > 0.03 and share(orange) == 0
        tab.select_option("#paint", "source")
        tab.wait_for_timeout(300)
        assert share(blue) > 0.01 and share(orange) > 0.01 and share(green) < 0.01
        assert not heard


def test_without_webgl_there_is_a_picture(folder):
    path = write_report(folder)
    with opened_browser("--disable-3d-apis") as browser:
        tab = browser.new_page()
        tab.goto(path.as_uri())
        tab.wait_for_timeout(200)
        assert tab.locator("#shape.live").count() == 0
        assert np.ptp(shown(tab.locator("#shape img"))) > 100


def test_the_report_of_a_scene_lists_its_objects(tmp_path):
    entry = {
        "name": "chair-1",
        "class": "chair",
        "sure": 0.987,
        "size": [0.5, 0.9, 0.55],
        "verdict": "doubtful",
        "verdict_reasons": ["<b>"],
    }
    other = entry | {"name": "object-2", "class": None}
    content = {"objects": [entry, other], "events": ["Object 1 appeared."]}
    (tmp_path / "scene.json").write_text(json.dumps(content))
    text = write_report(tmp_path).read_text()
    assert "<td>chair-1</td><td>chair</td><td>99 %</td><td>0.50 × 0.90 × 0.55 m</td>" in text
    assert "<td>object-2</td><td>none</td>" in text
    assert "doubtful: &lt;b&gt;" in text and "<li>Object 1 appeared.</li>" in text
