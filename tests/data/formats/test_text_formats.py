"""OBJ, OFF, PLY and STL: the whole file, or a sentence on what is missing."""

import numpy as np
import pytest
import trimesh

from jaxshape.data.formats.obj import read_obj
from jaxshape.data.formats.off import read_off
from jaxshape.data.formats.parts import NotSupported, Unreadable
from jaxshape.data.formats.ply import read_ply
from jaxshape.data.formats.stl import read_stl

BOX = trimesh.creation.box((1, 2, 3))
OFF = BOX.export(file_type="off")


def test_numbers_below_zero_count_back_from_the_face():
    """Two blocks that each refer to the four corners before them."""
    block = "v {0} 0 0\nv {0} 1 0\nv {0} 1 1\nv {0} 0 1\nf -4/-4 -3/-3 -2/-2\nf -4 -2 -1\n"
    (part,) = read_obj((block.format(0) + block.format(5)).encode())
    assert part.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    assert set(part.vertices[part.faces][2:, :, 0].ravel()) == {5}


def test_objects_and_groups_are_parts_under_their_names():
    text = "o chair\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1//1 2//1 3//1\ng UCX_chair\nf 3 2 \\\n 1 # x\n"
    parts = read_obj(text.replace("\n", "\r\n").encode("utf-16"))
    assert [(part.name, part.faces.tolist()) for part in parts] == [
        ("chair", [[0, 1, 2]]), ("chair/UCX_chair", [[2, 1, 0]])
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "does not hold"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\n", "does not hold"),
        ("v 0 0 0\nf 0 1 1\n", "counts from 1"),
        ("v 0 0\nf 1 1 1\n", "not three numbers"),
        ("v 0,5 0,5 0,5\nf 1 1 1\n", "not three numbers"),
        ("v 0 0 0\nf 1 a 1\n", "not a list of numbers"),
    ],
)
def test_a_damaged_obj_is_refused(text, said):
    with pytest.raises(Unreadable, match=said):
        read_obj(text.encode())


def test_a_comment_begins_a_word_and_ends_with_its_line():
    """A path may end a comment with a backslash, and Windows writes NaN with a `#`."""
    obj = "v 0 0 0 # first\n#\nv 1 0 0\nv 0 1 0\n# C:\\chairs\\\nf 1 2 3\n"
    (part,) = read_obj(obj.encode())
    assert part.faces.tolist() == [[0, 1, 2]] and part.vertices.tolist()[1] == [1, 0, 0]
    with pytest.raises(Unreadable, match="not three numbers"):
        read_obj(obj.replace("1 0 0", "1 0 1.#QNAN").encode())
    with pytest.raises(Unreadable, match="not three numbers"):
        read_off(OFF.replace("-1.5000000000\n", "-1.#IND\n", 1).encode())


def test_surfaces_that_are_no_polygons_are_refused():
    with pytest.raises(NotSupported, match="free-form surfaces"):
        read_obj(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\ncstype bspline\nsurf 0 1 0 1 1 2 3\n")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (OFF.replace("8 12 0", "8 11 0"), "says 8 vertices and 11 faces"),
        (OFF.replace("8 12 0", "8 13 0"), "so 21 lines, but 20 follow"),
        (OFF.rstrip().rpartition("\n")[0], "but 19 follow"),
        (OFF.rstrip()[:-2], "fewer corners"),
        ("OFF\n", "numbers of vertices"),
    ],
)
def test_an_off_file_that_holds_more_or_less_than_it_says_is_refused(text, said):
    with pytest.raises(Unreadable, match=said):
        read_off(text.encode())


def test_other_kinds_of_off_are_read_or_refused():
    lines = OFF.split("\n")
    coloured = [f"{line} 0.5 0.5 0.5" if 1 < i < 10 else line for i, line in enumerate(lines)]
    (part,) = read_off("\n".join(["COFF", *coloured[1:]]).encode())
    assert len(part.faces) == 12 and np.ptp(part.vertices, axis=0).tolist() == [1, 2, 3]
    with pytest.raises(NotSupported, match="4OFF"):
        read_off(b"4OFF\n0 0 0\n")


HEADER = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    "property float z\nelement {} 1\nproperty list int int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0\n0 1 0\n1 1 1\n"
)


def test_strips_of_a_ply_file_are_triangles():
    (part,) = read_ply((HEADER.format("tristrips") + "8 0 1 2 3 -1 0 1 2\n").encode())
    assert part.faces.tolist() == [[0, 1, 2], [1, 3, 2], [0, 1, 2]]


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [
        (HEADER.format("patch") + "3 0 1 2\n", NotSupported, "'patch'"),
        (HEADER.format("face") + "3 0 1\n", Unreadable, "ends before"),
        (HEADER.format("face") + "3 0 1 2 3 0 1 3\n", Unreadable, "does not mention"),
        (HEADER.format("face") + "3 0 1 9\n", Unreadable, "does not hold"),
        (HEADER.replace("float z", "tensor z").format("face"), Unreadable, "not understood"),
        (HEADER.format("vertex") + "3 0 1 2\n", Unreadable, "two elements of one name"),
    ],
)
def test_a_ply_file_is_whole_or_refused(text, error, said):
    with pytest.raises(error, match=said):
        read_ply(text.encode())


@pytest.mark.parametrize("kind", ["int8", "int64", "uint64", "float16"])
def test_numbers_of_a_ply_file_have_any_width(kind):
    """Some scanners write the time of each point in 8 bytes."""
    header, _, _ = HEADER.format("face").partition("end_header")
    header = header.replace("ascii", "binary_little_endian")
    header = header.replace("float z", f"float z\nproperty {kind} time")
    rows = np.zeros(4, [("xyz", "<f4", 3), ("time", kind)])
    rows["xyz"] = np.arange(12).reshape(4, 3)
    face = np.array([3, 0, 1, 2], "<i4")
    (part,) = read_ply(header.encode() + b"end_header\n" + rows.tobytes() + face.tobytes())
    np.testing.assert_array_equal(part.vertices, rows["xyz"])


@pytest.mark.parametrize("end", ["\n", "\r\n", " \n", "\t\r\n"])
def test_a_ply_header_ends_with_the_line_of_its_end(end):
    """Blanks may follow the word, and a comment may hold it."""
    header, _, data = BOX.export(file_type="ply").partition(b"end_header\n")
    header = header.replace(b"element vertex", b"comment of end_header\nelement vertex")
    (part,) = read_ply(header + b"end_header" + end.encode() + data)
    np.testing.assert_allclose(part.vertices[part.faces], BOX.triangles)


def test_stl_is_whole_or_refused():
    binary, text = BOX.export(file_type="stl"), BOX.export(file_type="stl_ascii").encode()
    others = (b"\xef\xbb\xbf" + text, text.upper(), text.replace(b" ", b"\t"))
    for content in (binary, b"solid " + binary[6:], text, *others):
        (part,) = read_stl(content)
        np.testing.assert_allclose(part.vertices[part.faces], BOX.triangles, atol=1e-6)
    named = text.replace(b"solid", b"solid vertex of a facet")  # at the beginning and the end
    line = text.replace(b"solid", b"solid vertex of a facet", 1).replace(b"\n", b" ")
    for content in (named, line):
        (part,) = read_stl(content)
        np.testing.assert_allclose(part.vertices[part.faces], BOX.triangles, atol=1e-6)
    for content in (binary[:-50], binary + binary[-50:], text[: len(text) // 2]):
        with pytest.raises(Unreadable, match="does not fit|not whole"):
            read_stl(content)
