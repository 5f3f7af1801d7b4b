import numpy as np
import pytest
from analytic_room import CHAIR, CRATE, FLOOR, HEIGHT, TABLE, WALLS, WIDTH, K, iou, room

from jaxshape.mapping.segmentation import clusters
from jaxshape.mapping.segmentation.segment import Prompt, segment

GROUPS = [FLOOR, WALLS, CHAIR, CRATE, TABLE]
COLORS = np.array([[90, 90, 95], [200, 190, 180], [120, 60, 30], [40, 90, 160], [30, 120, 60]])


@pytest.fixture(scope="module")
def seen():
    return room(GROUPS)


def painted(seen, colors=COLORS):
    """A colour image, with some noise."""
    noise = np.random.default_rng(0).normal(0, 4, (*seen.label.shape, 3))
    return np.clip(colors[seen.label] + noise, 0, 255).astype(np.uint8)


def middle_of(pixels):
    """`(u, v)` of the pixel which is nearest to the mean of some pixels."""
    row, column = np.nonzero(pixels)
    nearest = np.argmin(np.hypot(row - row.mean(), column - column.mean()))
    return float(column[nearest] + 0.5), float(row[nearest] + 0.5)


@pytest.mark.parametrize("eye", [(0.9, 1.4, 1.8), (-0.6, 1.3, 2.0), (0.1, 1.6, 1.7)])
def test_the_chair_in_the_middle_is_found(eye):
    seen = room(GROUPS, eye)
    found = segment(seen.depth, painted(seen), K)
    assert iou(found.segmented, seen.label == 2) > 0.9
    assert found.confidence > 0.5
    assert found.reason.endswith(".")


@pytest.mark.parametrize("eye", [(0.9, 1.4, 1.8), (-0.6, 1.3, 2.0)])
def test_legs_are_kept_down_to_their_feet(eye):
    seen = room(GROUPS, eye)
    points = (seen.label == 2) & (_height(seen) > 0.06)
    assert segment(seen.depth, None, K).segmented[points].mean() > 0.95


def _height(seen):
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    T = seen.T_world_camera
    return (rays * np.nan_to_num(seen.depth, posinf=0)[..., None]) @ T[1, :3] + T[1, 3]


@pytest.mark.parametrize("group", [2, 3])
def test_a_click_selects_what_is_under_it(seen, group):
    click = middle_of(seen.label == group)
    found = segment(seen.depth, None, K, Prompt(click=click))
    assert found.segmented[int(click[1]), int(click[0])]
    assert iou(found.segmented, seen.label == group) > 0.85


@pytest.mark.parametrize("eye", [(0.2, 1.6, 2.4), (1.7, 1.6, 1.7)])
def test_a_sofa_is_as_large_from_every_side(eye):
    sofa = [
        ((-1, 0, -0.5), (1, 0.42, 0.5)),
        ((-1, 0.42, -0.5), (1, 0.9, -0.25)),
        ((-1, 0.42, -0.5), (-0.85, 0.6, 0.5)),
        ((0.85, 0.42, -0.5), (1, 0.6, 0.5)),
    ]
    seen = room([FLOOR, WALLS, sofa], eye)
    found = segment(seen.depth, None, K, Prompt(click=middle_of(seen.label == 2)))
    assert iou(found.segmented, seen.label == 2) > 0.85
    assert found.confidence > 0.3


def test_a_table_top_is_segmented_only_if_it_is_clicked(seen):
    top = (seen.label == 4) & (_height(seen) > 0.71)
    assert segment(seen.depth, None, K).segmented[top].mean() < 0.05
    clicked = segment(seen.depth, None, K, Prompt(click=middle_of(top)))
    assert clicked.segmented[top].mean() > 0.9


def test_a_region_and_a_depth_range_choose_and_bound(seen):
    row, column = np.nonzero(seen.label == 3)
    region = tuple(float(x) for x in (column.min(), row.min(), column.max() + 1, row.max() + 1))
    found = segment(seen.depth, None, K, Prompt(region=region)).segmented
    assert iou(found, seen.label == 3) > 0.75  # the chair's leg may reach into the region
    outside = np.ones_like(found)
    outside[row.min() : row.max() + 1, column.min() : column.max() + 1] = False
    assert not (found & outside).any()

    far = float(np.median(seen.depth[seen.label == 2]))
    found = segment(seen.depth, None, K, Prompt(depth_range=(0.5, far))).segmented
    assert found.any()
    assert seen.depth[found].max() <= far


def test_a_mirrored_scene_gives_the_mirrored_mask(seen):
    mirrored_K = K.copy()
    mirrored_K[0, 2] = WIDTH - K[0, 2]
    plain = segment(seen.depth, painted(seen), K).segmented
    mirrored = segment(
        seen.depth[:, ::-1].copy(), painted(seen)[:, ::-1].copy(), mirrored_K
    ).segmented
    assert iou(plain, mirrored[:, ::-1]) > 0.95


def test_twice_the_resolution_gives_the_same_mask(seen):
    twice = np.repeat(np.repeat(seen.depth, 4, axis=0), 4, axis=1)
    found = segment(twice, None, K * [[4], [4], [1]]).segmented
    once = segment(seen.depth, None, K).segmented
    assert iou(found, np.repeat(np.repeat(once, 4, axis=0), 4, axis=1)) > 0.93


def test_colour_finds_feet_that_lie_flat_on_the_floor():
    base = [((-0.25, 0, -0.25), (0.25, 0.018, 0.25))]
    seen = room([FLOOR, WALLS, CHAIR, base])
    truth = seen.label >= 2
    colors = COLORS[[0, 1, 2, 2]]
    blind = iou(segment(seen.depth, None, K).segmented, truth)
    assert iou(segment(seen.depth, painted(seen, colors), K).segmented, truth) > blind + 0.1


def test_colours_that_do_not_tell_do_no_harm(seen):
    plain = segment(seen.depth, None, K)
    gray = segment(seen.depth, painted(seen, COLORS[[0] * 5]), K)
    np.testing.assert_array_equal(gray.segmented, plain.segmented)
    assert gray.confidence == plain.confidence


def test_a_floor_in_the_colours_of_the_object_is_not_taken_in(seen):
    """Half the floor in brown, as a shadow or a carpet: it lies too low to be a foot."""
    color = painted(seen)
    carpet = (seen.label == 0) & (np.arange(WIDTH) > WIDTH / 2)
    color[carpet] = painted(seen, COLORS[[2] * 5])[carpet]
    assert iou(segment(seen.depth, color, K).segmented, seen.label == 2) > 0.85


def test_a_given_mask_is_taken_where_depth_was_measured(seen):
    depth = seen.depth.copy()
    depth[:, ::3] = 0
    mask = seen.label == 4
    found = segment(depth, None, K, mask=mask)
    np.testing.assert_array_equal(found.segmented, mask & (depth > 0))
    assert found.confidence == 1


@pytest.mark.parametrize("value", [0.0, np.inf])
def test_an_image_without_depth_is_unsure_and_says_so(value):
    depth = np.full((HEIGHT, WIDTH), value, np.float32)
    found = segment(depth, None, K)
    assert not found.segmented.any()
    assert found.confidence == 0
    assert found.reason == "No pixel has a depth, so nothing is segmented."


def test_a_bare_room_holds_no_object():
    found = segment(room([FLOOR, WALLS]).depth, None, K)
    assert found.confidence < 0.1
    empty = segment(room([FLOOR, WALLS]).depth, None, K, mask=np.zeros((HEIGHT, WIDTH), bool))
    assert empty.confidence == 0 and "mask" in empty.reason


def test_what_is_hidden_or_cut_is_less_sure(seen):
    prompt = Prompt(click=middle_of(seen.label == 2))
    whole = segment(seen.depth, None, K, prompt)
    assert whole.confidence > 0.9 and "nothing speaks against it" in whole.reason
    board = [((-0.3, 0.5, 0.5), (0.2, 1.1, 0.52))]
    behind = room([*GROUPS, board])
    hidden = segment(behind.depth, None, K, Prompt(click=middle_of(behind.label == 2)))
    assert hidden.confidence < whole.confidence - 0.1
    cut = segment(seen.depth[:, 78:], None, K - [[0, 0, 78], [0, 0, 0], [0, 0, 0]])
    assert cut.confidence < whole.confidence - 0.1


@pytest.mark.parametrize(
    "prompt, said",
    [
        (Prompt(click=(200.0, 5.0)), "click is at 200, 5"),
        (Prompt(region=(500.0, 50.0, 540.0, 60.0)), "holds no pixel"),
    ],
)
def test_prompts_that_cannot_be_met_are_named(seen, prompt, said):
    with pytest.raises(ValueError, match=said):
        segment(seen.depth, None, K, prompt)


def test_the_corner_of_something_nearer_is_not_joined_at_the_border_of_the_image(monkeypatch):
    """A shelf before the seat, of which the image shows an end."""
    shelf = [((0.1, 0.56, 0.05), (0.9, 0.6, 0.3))]
    seen = room([FLOOR, WALLS, CHAIR, shelf], (0.3, 1.5, 1.6), (0.1, 0.4, 0))
    depth, label = seen.depth[:, :90], seen.label[:, :90]
    prompt = Prompt(click=middle_of(label == 2))
    found = segment(depth, None, K, prompt).segmented
    assert (label == 3).sum() > 50 and not found[label == 3].any()
    assert found[label == 2].mean() > 0.9
    monkeypatch.setattr(clusters, "corners", lambda labels, view: [])
    assert segment(depth, None, K, prompt).segmented[label == 3].any()


def test_the_core_is_what_was_clicked_without_what_was_joined_to_it():
    board = [((-0.3, 0.3, 0.5), (0.3, 0.44, 0.52))]  # hides where the legs begin
    seen = room([FLOOR, WALLS, CHAIR, board], (0.0, 0.9, 2.0))
    found = segment(seen.depth, None, K, Prompt(click=middle_of(seen.label == 2)))
    assert (found.core <= found.segmented).all()
    low = _height(seen) < 0.25
    assert found.segmented[(seen.label == 2) & low].mean() > 0.5
    assert not found.core[(seen.label == 2) & low].any()
    assert found.core[(seen.label == 2) & ~low].mean() > 0.5
