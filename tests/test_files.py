import json
import os
import stat

import pytest

from jaxshape.files import atomic_path, write_json, write_text


def test_the_file_appears_whole_and_alone(tmp_path):
    target = tmp_path / "new folder" / "picture.png"
    with atomic_path(target) as temporary:
        temporary.write_bytes(b"first half, ")
        assert not target.exists()
        with open(temporary, "ab") as file:
            file.write(b"second half")
    assert target.read_bytes() == b"first half, second half"
    assert os.listdir(target.parent) == ["picture.png"]


def test_the_temporary_file_shares_folder_and_suffix(tmp_path):
    with atomic_path(tmp_path / "chair.tar.gz") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".gz"


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_a_failure_leaves_the_former_file_and_no_litter(tmp_path, failure):
    target = tmp_path / "chair.ply"
    target.write_text("former")
    with pytest.raises(failure), atomic_path(target) as temporary:
        temporary.write_text("half of the n")
        raise failure
    assert target.read_text() == "former"
    assert os.listdir(tmp_path) == ["chair.ply"]


def test_a_writer_may_replace_the_temporary_file_itself(tmp_path):
    target = tmp_path / "chair.ply"
    with atomic_path(target) as temporary:
        temporary.unlink()
        temporary.write_text("new")
    assert target.read_text() == "new"


def test_permissions_are_those_of_an_ordinary_file_or_of_the_former_one(tmp_path):
    ordinary, fresh, former = tmp_path / "ordinary", tmp_path / "fresh", tmp_path / "former"
    ordinary.touch()
    former.touch()
    former.chmod(0o640)
    for path in (fresh, former):
        with atomic_path(path) as temporary:
            temporary.write_text("text")
    assert stat.S_IMODE(fresh.stat().st_mode) == stat.S_IMODE(ordinary.stat().st_mode)
    assert stat.S_IMODE(former.stat().st_mode) == 0o640


def test_text_and_json_are_read_back(tmp_path):
    write_text(tmp_path / "new" / "name.txt", "Möbel 椅子\n")
    assert (tmp_path / "new" / "name.txt").read_bytes() == "Möbel 椅子\n".encode()
    content = {"name": "Möbel", "scores": [0.1, None, True], "frames": {"1": {}}}
    write_json(tmp_path / "scores.json", content)
    assert json.loads((tmp_path / "scores.json").read_text("ascii")) == content


def test_what_json_does_not_know_leaves_the_former_file(tmp_path):
    write_json(tmp_path / "scores.json", {"iou": 1})
    with pytest.raises(TypeError):
        write_json(tmp_path / "scores.json", {"iou": 2, "grid": object()})
    assert json.loads((tmp_path / "scores.json").read_text()) == {"iou": 1}
    assert os.listdir(tmp_path) == ["scores.json"]
