"""Which meshes are held out: about one in ten, always the same ones, by their shapes alone."""

import numpy as np
import pytest
import trimesh

from jaxshape.data.archives import MeshSource, list_meshes
from jaxshape.data.meshes import Skipped
from jaxshape.data.split import hold_out, same_shapes
from jaxshape.data.survey import Surveyed, survey


def meshes(count, folder="/anywhere"):
    """Meshes of as many shapes; those of more begin with those of fewer."""
    signatures = np.random.default_rng(0).random((count, 13))
    return [
        Surveyed(MeshSource(f"mug-{i}", f"{folder}/{i}"), 1.0, tuple(row), False, None)
        for i, row in enumerate(signatures)
    ]


def sides(meshes):
    """The meshes to train on, and the held-out ones, as files."""
    training, held_out = hold_out(meshes)
    return training, [mesh.source for mesh in held_out]


def names(sources):
    return {source.name for source in sources}


@pytest.mark.parametrize("count", [2, 3, 12, 1000])
def test_every_mesh_is_on_one_side_and_none_is_empty(count):
    training, held_out = sides(meshes(count))
    assert names(training) | names(held_out) == names(m.source for m in meshes(count))
    assert len(training) + len(held_out) == count and training and held_out
    assert training == sorted(training, key=lambda s: int(s.name[4:]))  # their order
    if count == 1000:
        assert 70 < len(held_out) < 130


def test_a_mesh_stays_on_its_side_as_the_collection_grows():
    small, large = (names(sides(meshes(n))[0]) for n in (300, 3000))
    assert small <= large and not small & names(sides(meshes(3000))[1])


def test_names_order_and_place_of_the_files_do_not_matter():
    renamed = [
        mesh._replace(source=mesh.source._replace(name=f"x/{mesh.source.name}"))
        for mesh in reversed(meshes(50, "/other"))
    ]
    held_out = {f"x/{name}" for name in names(sides(meshes(50))[1])}
    assert names(sides(renamed)[1]) == held_out


def test_copies_are_on_one_side():
    """A copy in another format, whose numbers were rounded, of each of 100 meshes."""
    ours = meshes(100)
    copies = [
        m._replace(source=MeshSource(f"copy-{i}", f"/copy/{i}"),
                   signature=tuple(np.round(m.signature, 4)))
        for i, m in enumerate(ours)
    ]  # fmt: skip
    training, held_out = sides(ours + copies)
    for side in (training, held_out):
        kept = [int(source.name.split("-")[1]) for source in side]
        assert sorted(kept[::2]) and all(kept.count(i) == 2 for i in kept)


def test_what_cannot_be_used_is_never_held_out():
    broken = [
        m._replace(signature=(), skipped=Skipped(m.source.name, "empty", "Nothing."))
        for m in meshes(40)[:20]
    ]
    training, held_out = sides(broken + meshes(40)[20:])
    assert len(training) + len(held_out) == 40
    assert names(held_out) <= {f"mug-{i}" for i in range(20, 40)}


@pytest.mark.parametrize(
    ("some", "said"), [(meshes(1), "Only 1 mesh of 1"), (meshes(1) * 3, "^3 meshes of 1 shape")]
)
def test_fewer_than_two_shapes_cannot_be_split(some, said):
    with pytest.raises(ValueError, match=said):
        hold_out(some)


def test_a_shape_is_known_in_any_format_frame_and_unit(tmp_path):
    """Copies of one chair, and a chair that is a little wider."""
    legs = [trimesh.creation.box((0.04, 0.45, 0.04)).apply_translation((x, 0.2, z))
            for x in (-0.2, 0.2) for z in (-0.2, 0.2)]  # fmt: skip
    seat, back = trimesh.creation.box((0.4, 0.04, 0.4)), trimesh.creation.box((0.4, 0.4, 0.03))
    chair = trimesh.util.concatenate(
        [*legs, seat.apply_translation((0, 0.45, 0)), back.apply_translation((0, 0.7, -0.2))]
    )
    for name in ("a.obj", "b.ply", "c.glb", "d.off"):
        chair.export(tmp_path / name)
    lying = chair.copy().apply_transform(
        trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0))
    )
    lying.apply_scale(1000).subdivide().export(tmp_path / "e.obj")
    chair.apply_scale((1.02, 1, 1)).export(tmp_path / "f.obj")
    found = dict(survey(list_meshes(tmp_path)))
    groups = same_shapes([found[i] for i in range(6)])
    assert len(set(groups[:5])) == 1 and groups[5] != groups[0]
    assert [found[i].lies for i in range(6)] == [False] * 4 + [True, False]
    assert found[4].size == pytest.approx(1000 * found[0].size)
