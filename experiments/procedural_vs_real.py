"""Does the procedural family of chairs cover real ones?

    python experiments/procedural_vs_real.py --cad CAD_FOLDER [--boxes BOX_CHAIRS.npz]

Compares 5,000 procedural chairs with two sets of real seats: CAD models (a folder of meshes, +y up,
front along +z) and, if given, chairs put together from oriented boxes. All are turned into the same
canonical grids of surface voxels, in which the seat fills each axis. Every statistic is one
geometric estimator that is applied to all of them, so that its errors are the same everywhere.

The file of box chairs holds `boxes` [n, 12] (centre, edge lengths, first axis, second axis) and
`count` (boxes of each chair, in order), +y up, back at -z. They are boxes only, so they show sizes,
places and frequencies of parts, but not how round a part is.

Expected mean IoU with the nearest neighbour: CAD seats 0.41 with procedural chairs and 0.38 with
box chairs; box chairs 0.43 with procedural chairs and 0.60 with other box chairs, many of which are
nearly the same; procedural chairs 0.49 with other procedural chairs.

Results: experiments/results/procedural_vs_real.json and .png. Time: four minutes on one core.
"""

import json
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import trimesh
import tyro
from jaxtyping import Bool, Float, Int
from rich.progress import track
from scipy import ndimage, stats

import runs
from jaxshape.data import meshes
from jaxshape.data.capture import SURFACE_SAMPLES, discretize
from jaxshape.data.chairs import random_chair
from jaxshape.files import write_json
from jaxshape.geometry import grid
from jaxshape.geometry.grid import MARGIN, RESOLUTION
from jaxshape.report.figures import save_figure
from jaxshape.report.palette import BLUE, FAINT, GREEN, ORANGE


@dataclass(frozen=True)
class Config(runs.Config):
    """Sources to compare, and output."""

    cad: Path = Path("cad_chairs")
    """Folder of CAD seats, +y up, front along +z."""
    boxes: Path | None = None
    """An .npz of box chairs; without it, the CAD seats are the only reference."""
    chairs: int = 5_000
    """Number of procedural chairs, with seeds from 0; also the number of box chairs in their place.
    """
    write_boxes: Path | None = None
    """Only write the first --chairs of --boxes here, as meshes to train on for comparison."""


# ------------------------------------------------------------------ sources


Named = Iterator[tuple[str, trimesh.Trimesh]]
Grid = Bool[np.ndarray, "x y z"]
Grids = Bool[np.ndarray, "n x y z"]
Points = Float[np.ndarray, "n 3"]
Values = Float[np.ndarray, " n"]


def procedural_chairs(count: int) -> Named:
    for seed in range(count):
        mesh = random_chair(seed)
        yield f"{seed} {mesh.metadata['style']}", mesh


def cad_seats(folder: Path) -> Named:
    for model in meshes.read_meshes(folder):
        if isinstance(model, meshes.Model):
            yield model.name, model.mesh


def box_chairs(path: Path, count: int | None) -> Named:
    with np.load(path) as file:
        ends = np.cumsum(file["count"])
        chairs = np.split(file["boxes"].astype(float), ends[:-1])
    order = np.random.default_rng(0).permutation(len(chairs))[:count]
    for i in order:
        yield str(i), meshes.canonical(box_mesh(chairs[i]))


def box_mesh(boxes: Float[np.ndarray, "n 12"]) -> trimesh.Trimesh:
    """A mesh of oriented boxes, each given by centre, edge lengths, first and second axis."""
    center, size, first, second = np.split(boxes, 4, axis=1)
    axes = np.stack([first, second, np.cross(first, second)], axis=1)
    cube = trimesh.creation.box()
    corners = center[:, None] + (cube.vertices * size[:, None]) @ axes
    faces = cube.faces + 8 * np.arange(len(boxes))[:, None, None]
    return trimesh.Trimesh(corners.reshape(-1, 3), faces.reshape(-1, 3), process=False)


# ------------------------------------------------------------------ statistics of a mesh


class Seats(NamedTuple):
    """A source of seats, ready to be compared."""

    names: list[str]
    surface: Bool[np.ndarray, "seat x y z"]
    extents: Float[np.ndarray, "seat 3"]
    leg_thickness: Float[np.ndarray, " seat"]
    """Relative to the seat's height from floor to top, like the next; NaN where there are no legs.
    """
    back_thickness: Float[np.ndarray, " seat"]


LEG_LAYER = 5
"""The layer in which legs are counted and measured: at 15 % of the height, above most feet and
runners, below most stretchers."""


def measure(source: Iterable[tuple[str, trimesh.Trimesh]], what: str) -> Seats:
    """Grids of all the meshes, and statistics that need finer detail than grids."""
    names, rows = [], []
    for seed, (name, mesh) in enumerate(track(source, what)):
        frame = grid.fit_box(*jnp.float32(mesh.bounds))
        points = meshes.sample_surface(mesh, SURFACE_SAMPLES, seed).astype(np.float32)
        surface = np.asarray(discretize(points, frame))
        voxels = (points - np.asarray(frame.origin)) / np.asarray(frame.voxel_size)
        height = mesh.extents[1]
        legs = leg_thickness(points, voxels.astype(int), surface) / height
        back = back_thickness(points, voxels.astype(int), seat_layer(surface[None])[0]) / height
        names.append(name)
        rows.append((surface, np.array(mesh.extents), legs, back))
    return Seats(names, *(np.array(column) for column in zip(*rows, strict=True)))


def leg_thickness(points: Points, voxel: Int[np.ndarray, "n 3"], surface: Grid) -> float:
    """The median, over the pieces of a layer near the floor, of the smaller horizontal extent."""
    pieces, count = components(surface)
    here = voxel[:, 1] == LEG_LAYER
    piece, places = pieces[voxel[here, 0], voxel[here, 2]], points[here][:, [0, 2]]
    members = [places[piece == i + 1] for i in range(count)]
    sizes = [np.ptp(m, axis=0).min() for m in members if len(m) >= 10]
    return float(np.median(sizes)) if sizes else np.nan


def components(surface: Grid) -> tuple[Int[np.ndarray, "x z"], int]:
    """The pieces, labelled from 1, into which the layer near the floor falls."""
    found: Any = ndimage.label(surface[:, LEG_LAYER], np.ones((3, 3)))
    return found


def back_thickness(points: Points, voxel: Int[np.ndarray, "n 3"], seat: float) -> float:
    """The median extent from front to back, over thin horizontal bars across the back's middle.

    The bars are one voxel wide and a quarter high, so that a back that leans seems little thicker.
    """
    if np.isnan(seat):
        return np.nan
    top = float(RESOLUTION - MARGIN)
    height = points[:, 1] - points[:, 1].min()
    height = 1 + height / height.max() * (top - 1)  # in voxels, from the floor
    sizes = []
    for level in seat + (top - seat) * np.linspace(0.35, 0.95, 7):
        near = np.abs(height - level) < 0.125
        for column in range(11, 21):
            z = points[near & (voxel[:, 0] == column), 2]
            if len(z) >= 4:
                sizes.append(np.ptp(z))
    return float(np.median(sizes)) if sizes else np.nan


# ------------------------------------------------------------------ statistics of a grid


Y, Z = np.arange(RESOLUTION)[None, :, None], np.arange(RESOLUTION)[None, None, :]
CENTER, FRONT, REAR = slice(12, 20), slice(12, 24), slice(0, 16)
INSIDE = RESOLUTION - 2 * MARGIN


def seat_layer(surface: Grids) -> Values:
    """The layer of the seat's upper face: the median of the highest voxels of the middle columns.

    NaN where nothing covers the middle.
    """
    middle = surface[:, CENTER, :, FRONT]
    top = RESOLUTION - 1 - np.argmax(middle[:, :, ::-1], axis=2)
    heights = np.where(middle.any(axis=2), top, np.nan).reshape(len(surface), -1)
    heights = np.where(np.isnan(heights).all(1, keepdims=True), 0, heights)
    layer = np.nanmedian(heights, axis=1)
    return np.where(layer > 0, layer, np.nan)


def grid_statistics(seats: Seats) -> dict[str, Values]:
    """Statistics of each seat; NaN if undefined, such as the thickness of a missing back."""
    surface, seat = seats.surface, seat_layer(seats.surface)
    above = surface & (Y > seat[:, None, None, None] + 2)
    occupied = surface.sum((1, 2, 3))
    has_back, outline = back_of(surface, seat), np.asarray(above.any(axis=3))
    width, height, depth = seats.extents.T
    return {
        "width / height": width / height,
        "depth / height": depth / height,
        "seat height / height": (seat + 1 - MARGIN) / INSIDE,
        "leg thickness / height": seats.leg_thickness,
        "back thickness / height": np.where(has_back, seats.back_thickness, np.nan),
        "filled share of the back": np.where(has_back, _filled_rows(outline), np.nan),
        "occupied voxels": occupied.astype(float),
        "share of them above the seat": above.sum((1, 2, 3)) / occupied,
        "enclosed share of the box": enclosed(surface).mean((1, 2, 3)),
    }


def _filled_rows(outline: Bool[np.ndarray, "n x y"]) -> Values:
    """Filled share of an outline between the first and the last voxel of each row."""
    between = _until(outline, 1) & _until(outline[:, ::-1], 1)[:, ::-1]
    return outline.sum((1, 2)) / np.maximum(between.sum((1, 2)), 1)


def _until(occupied: np.ndarray, axis: int) -> np.ndarray:
    return np.maximum.accumulate(occupied, axis=axis)


def enclosed(surface: Grids) -> Grids:
    """Voxels between surfaces along all three axes."""
    inside = np.ones_like(surface)
    for axis in (1, 2, 3):
        inside &= _until(surface, axis) & np.flip(_until(np.flip(surface, axis), axis), axis)
    return inside


def back_of(surface: Grids, seat: Values) -> Bool[np.ndarray, " n"]:
    """Whether voxels lie well above the seat, in the rear half, in most of the middle columns."""
    behind = (surface & (Y > seat[:, None, None, None] + 4))[:, 8:24, :, REAR]
    return behind.any(axis=(2, 3)).mean(axis=1) >= 0.5


def arms_of(surface: Grids, seat: Values) -> Bool[np.ndarray, " n"]:
    """Whether both sides have voxels over a length of five, above the seat, before the back."""
    over = Y - seat[:, None, None, None]
    beside = surface & (over > 2) & (over < 13) & (Z >= 12) & (Z < 28)
    left, right = beside[:, :8].any(axis=(1, 2)).sum(1), beside[:, -8:].any(axis=(1, 2)).sum(1)
    return np.minimum(left, right) >= 5


def parts(seats: Seats) -> dict[str, Bool[np.ndarray, " n"]]:
    """The parts that each seat has."""
    surface, seat = seats.surface, seat_layer(seats.surface)
    pieces = np.array([components(one)[1] for one in surface])
    feet = ("one foot", "two feet", "three feet", "four feet")
    return {
        "back": back_of(surface, seat),
        "arms": arms_of(surface, seat),
        **{name: pieces == i for i, name in enumerate(feet, start=1)},
        "more feet": pieces > 4,
        "voluminous": enclosed(surface).mean((1, 2, 3)) > VOLUMINOUS,
    }


VOLUMINOUS = 0.4
"""Enclosed share of its box above which a seat counts as voluminous."""


# ------------------------------------------------------------------ comparisons


def nearest(
    these: Grids, those: Bool[np.ndarray, "m x y z"], *, same: bool = False, block: int = 512
) -> tuple[Values, Int[np.ndarray, " n"]]:
    """The highest IoU of each grid with any of the others, and the index of that other grid.

    With `same`, the first grids are part of the second ones, and no grid is compared with itself.
    """
    ever = those.any(axis=0)
    B = those[:, ever].astype(np.float32)
    size_a, size_b = these.sum((1, 2, 3)), those.sum((1, 2, 3))
    best, which = [], []
    for start in range(0, len(these), block):
        rows = slice(start, start + block)
        both = these[rows][:, ever].astype(np.float32) @ B.T
        iou = both / (size_a[rows, None] + size_b - both)
        if same:
            iou[np.arange(len(iou)), start + np.arange(len(iou))] = -1
        best.append(iou.max(axis=1))
        which.append(iou.argmax(axis=1))
    return np.concatenate(best), np.concatenate(which)


def spread(values: Values) -> dict[str, float]:
    """Mean and quantiles of the values that are not NaN."""
    known = values[~np.isnan(values)]
    if not len(known):
        return {}
    marks = (1, 5, 25, 50, 75, 95, 99)
    quantiles = zip(marks, np.percentile(known, marks), strict=True)
    return {"mean": _round(known.mean())} | {f"{q} %": _round(v) for q, v in quantiles}


def compare(ours: Values, real: Float[np.ndarray, " m"]) -> dict[str, float]:
    """Coverage of one distribution by another.

    `covered`: share of the real values between our 1st and 99th percentile. `KS`: largest gap
    between the cumulative distributions. `Wasserstein`: mean distance between them, in standard
    deviations of the real values.
    """
    ours, real = ours[~np.isnan(ours)], real[~np.isnan(real)]
    if not (len(ours) and len(real)):
        return {}
    low, high = np.percentile(ours, (1, 99))
    distance = stats.wasserstein_distance(ours, real) / max(real.std(), 1e-9)
    smirnov: Any = stats.ks_2samp(ours, real)
    return {
        "covered": _round(np.mean((low <= real) & (real <= high))),
        "KS": _round(smirnov.statistic),
        "Wasserstein": _round(distance),
    }


def _round(value: Any) -> float:
    return round(float(value), 4)


# ------------------------------------------------------------------ the experiment

Numbers = Mapping[str, Mapping[str, Values]]
"""Statistics of the seats of each source."""


def main(config: Config) -> dict[str, Any] | None:
    """Compare the sources, and write the results and the figure."""
    config = config.reduced(chairs=20)
    if config.write_boxes:
        return write_box_chairs(config)
    start = time.perf_counter()
    sources = read_sources(config)
    ious, worst = nearest_neighbours(sources, config.chairs)
    numbers = {name: grid_statistics(seats) for name, seats in sources.items()}
    results = {
        "seats": {name: len(seats.names) for name, seats in sources.items()},
        "nearest neighbour IoU": {name: spread(iou) for name, iou in ious.items()},
        **compared(sources, numbers),
        "worst covered CAD seats": worst,
        "config": {"chairs": str(config.chairs), "smoke": str(config.smoke)},
        "seconds": round(time.perf_counter() - start),
    }
    write_json(config.results / "procedural_vs_real.json", results)
    plot(config.results / "procedural_vs_real.png", results, sources, numbers, ious)
    print(json.dumps(results["nearest neighbour IoU"], indent=1))
    return results


def read_sources(config: Config) -> dict[str, Seats]:
    wanted = {"procedural": procedural_chairs(config.chairs), "CAD": cad_seats(config.cad)}
    if config.boxes:
        wanted["boxes"] = box_chairs(config.boxes, 2 * config.chairs if config.smoke else None)
    return {name: measure(source, name) for name, source in wanted.items()}


def compared(sources: Mapping[str, Seats], numbers: Numbers) -> dict[str, Any]:
    """Statistics and parts of each source; how well the procedural chairs cover the others."""
    ours, *real = sources
    shares = {name: parts(seats) for name, seats in sources.items()}
    mean = {name: seats.surface.mean(0) for name, seats in sources.items()}
    return {
        "statistics": {
            statistic: {name: spread(numbers[name][statistic]) for name in sources}
            | {f"{ours} and {r}": compare(values, numbers[r][statistic]) for r in real}
            for statistic, values in numbers[ours].items()
        },
        "parts": {
            part: {name: _round(shares[name][part].mean()) for name in sources}
            for part in shares[ours]
        },
        "mean grids, mean absolute difference": {
            f"{ours} and {r}": _round(np.abs(mean[ours] - mean[r]).mean()) for r in real
        },
    }


def nearest_neighbours(
    sources: Mapping[str, Seats], chairs: int
) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
    """Coverage, realism and their yardsticks; and the ten CAD seats that are covered worst.

    Box chairs are split in two: as many as there are procedural chairs take their place in one
    comparison, and the others have to be covered, so that both families have the same chance.
    """
    ours, cad = sources["procedural"].surface, sources["CAD"].surface
    pairs = {
        "CAD to procedural": (cad, ours, False),
        "CAD to other CAD": (cad, cad, True),
    }
    if "boxes" in sources:
        known, held_out = np.split(sources["boxes"].surface, [chairs])
        pairs |= {
            "CAD to boxes": (cad, known, False),
            "boxes held out to procedural": (held_out, ours, False),
            "boxes held out to other boxes": (held_out, known, False),
            "procedural to boxes": (ours, known, False),
        }
    pairs |= {
        "procedural to other procedural": (ours[: chairs // 4], ours, True),
        "procedural to CAD": (ours, cad, False),
    }
    found = {name: nearest(a, b, same=same) for name, (a, b, same) in pairs.items()}
    covered, which = found["CAD to procedural"]
    worst = []
    for i in np.argsort(covered)[:10]:
        seat = {"seat": sources["CAD"].names[i], "IoU": _round(covered[i])}
        seat["nearest"] = sources["procedural"].names[which[i]]
        if "boxes" in sources:
            seat["IoU with boxes"] = _round(found["CAD to boxes"][0][i])
        worst.append(seat)
    return {name: iou for name, (iou, _) in found.items()}, worst


# ------------------------------------------------------------------ the figure

STYLE = {"procedural": (ORANGE, "-"), "CAD": (BLUE, "--"), "boxes": (GREEN, "-.")}


def plot(
    path: Path,
    results: dict[str, Any],
    sources: Mapping[str, Seats],
    numbers: Numbers,
    ious: Mapping[str, np.ndarray],
) -> None:
    def draw(figure: Any) -> None:
        upper, lower = figure.subfigures(2, 1, height_ratios=[1, 1.2], hspace=0.02)
        left, right = upper.subfigures(1, 2, width_ratios=[1, 1])
        _plot_projections(left, sources)
        dots, curves = right.subplots(2, 1, height_ratios=[1, 1.4])
        _plot_parts(dots, results)
        _plot_nearest(curves, ious)
        _plot_statistics(lower, results, numbers)

    save_figure(path, (10.0, 12.0), draw, font=9.0)


def _plot_projections(figure: Any, sources: Mapping[str, Seats]) -> None:
    """Frequency of occupied voxels, as the mean along each axis."""
    views = {"from the front": 0, "from the right": 1, "from above": 2}
    axes = figure.subplots(len(sources), 3, squeeze=False)
    image = None
    for row, (name, seats) in zip(axes, sources.items(), strict=True):
        mean = seats.surface.mean(axis=0)
        # Oriented for the viewer: the front of the seat is at the left, or at the bottom of the
        # picture.
        pictures = mean.mean(2).T[::-1], mean.mean(0)[::-1, ::-1], mean.mean(1).T
        for ax, (view, i) in zip(row, views.items(), strict=True):
            image = ax.imshow(pictures[i], vmin=0, vmax=0.3, cmap="viridis")
            ax.set(xticks=[], yticks=[])
            if row is axes[0]:
                ax.set_title(view)
        row[0].set_ylabel(f"{name} ({len(seats.names)})")
    label = "occupied share of the seats, mean along the line of sight"
    figure.colorbar(image, ax=axes, shrink=0.8, location="bottom", label=label, extend="max")


def _plot_parts(ax: Any, results: dict[str, Any]) -> None:
    names = list(results["parts"])
    for name, marker in zip(results["seats"], "osD", strict=False):
        share = [results["parts"][part][name] for part in names]
        ax.plot(share, range(len(names)), marker, color=STYLE[name][0], label=name, alpha=0.85)
    ax.set(yticks=range(len(names)), yticklabels=names, xlim=(0, 1), title="share of the seats")
    ax.invert_yaxis()
    ax.grid(color=FAINT)
    ax.legend(frameon=False)


def _plot_nearest(ax: Any, ious: Mapping[str, np.ndarray]) -> None:
    """Colours show the seats that search for a neighbour, lines the seats to choose from."""
    for name, iou in ious.items():
        these, those = name.split(" to ")
        line = {"procedural": "-", "CAD": ":", "boxes": "--"}[those.removeprefix("other ")]
        if those != "CAD":  # 78 are too few to be near to thousands
            label = f"{name}, mean {iou.mean():.2f}"
            _cumulative(ax, iou, STYLE[these.removesuffix(" held out")][0], line, label)
    ax.set(xlim=(0, 1), title="IoU with the nearest of the others: share of the seats below")
    place = {"loc": "upper center", "bbox_to_anchor": (0.38, -0.1)}
    ax.legend(frameon=False, fontsize=6.5, ncols=2, columnspacing=1.0, **place)
    _tidy(ax)


def _plot_statistics(figure: Any, results: dict[str, Any], numbers: Numbers) -> None:
    axes = figure.subplots(3, 3)
    for ax, statistic in zip(axes.flat, numbers["procedural"], strict=True):
        everything = np.concatenate([found[statistic] for found in numbers.values()])
        for name, found in numbers.items():
            _cumulative(ax, found[statistic], *STYLE[name], name)
        if "thickness" in statistic:
            ax.set_xscale("log")
        if np.isfinite(everything).any():
            ax.set_xlim(*np.nanpercentile(everything, (0.5, 99.5)))
        ax.set_title(statistic)
        late = np.nanmedian(everything) > np.mean(ax.get_xlim())  # so there is room before
        place = {"x": 0.03, "y": 0.85} if late else {"x": 0.97, "y": 0.05, "ha": "right"}
        verdict = _verdict(results["statistics"][statistic])
        ax.text(s=verdict, fontsize=7, transform=ax.transAxes, **place)
        _tidy(ax)
    axes[0, 0].legend(frameon=False, loc="center right")
    for ax in axes[:, 0]:
        ax.set_ylabel("share of the seats below")


def _verdict(statistic: dict[str, Any]) -> str:
    return "\n".join(
        f"{name.split(' and ')[1]}: {found['covered']:.0%} covered, KS {found['KS']:.2f}"
        for name, found in statistic.items()
        if "KS" in found
    )


def _cumulative(ax: Any, values: np.ndarray, color: str, line: str, label: str) -> None:
    known = np.sort(values[~np.isnan(values)])
    ax.plot(known, np.linspace(0, 1, len(known)), line, color=color, linewidth=1.6, label=label)


def _tidy(ax: Any) -> None:
    ax.grid(color=FAINT, linewidth=0.8)
    ax.set_axisbelow(True)
    ax.set_ylim(0, 1)
    ax.spines[["top", "right"]].set_visible(False)


def write_box_chairs(config: Config) -> None:
    """Write box chairs as PLY files. They are research data, and so are weights trained on them."""
    assert config.boxes and config.write_boxes
    config.write_boxes.mkdir(parents=True, exist_ok=True)
    for name, mesh in box_chairs(config.boxes, config.chairs):
        mesh.export(config.write_boxes / f"box-chair-{name}.ply")


if __name__ == "__main__":
    main(tyro.cli(Config))
