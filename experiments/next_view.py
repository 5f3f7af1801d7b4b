r"""Next best view: composed IoU by the number of views, for four ways to choose the views.

    python experiments/next_view.py --meshes cad_chairs/

CAD seats in front of a Kinect (with its noise) at a distance of 1.8 diagonals, true poses. The
views are chosen among 252 cameras that a person can reach (`jaxshape.mapping.views`). All ways
begin with the same view, at 30 degrees elevation and a random azimuth. The ways are: next best view
(the greatest expected drop in entropy), a regular orbit in steps of 45 degrees at 30 degrees
elevation, random cameras, and the camera farthest from all earlier ones. Samples are 16 codes of
the conditional prior, drawn anew after each view.

Results: experiments/results/next_view.json, .png and .svg; a finished seat is not run again.
Time: 5 minutes on one core.
"""

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import tyro

import runs
from figures import COLUMN, draw_mean, interval, save_column
from jaxshape.data.capture import camera_distance, capture, fused_frames, sensor_of
from jaxshape.data.dataset import hash_seed, load_object
from jaxshape.data.meshes import Skipped
from jaxshape.data.virtual_cameras import CAMERAS
from jaxshape.geometry import camera, distance
from jaxshape.geometry.evidence import soft_grids
from jaxshape.geometry.fusing import Distances
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.overlap import iou
from jaxshape.mapping.views.candidates import reachable_views
from jaxshape.mapping.views.gain import next_views
from jaxshape.model.shapes import decode
from jaxshape.model.weights import fingerprint, load_prior
from jaxshape.report.figures import tidy
from jaxshape.report.palette import BLUE, GREEN, GREY, ORANGE
from jaxshape.results.journal import Journal
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import reconstruct_jit

KINECT = CAMERAS["kinect"]
SENSOR = sensor_of(KINECT)
LINES: dict[str, dict[str, Any]] = {
    "next best view": {"color": BLUE, "dashes": ()},
    "farthest point": {"color": GREEN, "dashes": (6, 1.5, 1, 1.5)},
    "regular orbit": {"color": ORANGE, "dashes": (4, 1.5)},
    "random": {"color": GREY, "dashes": (2, 2)},
}
ELEVATION, STEP = 30.0, 45.0


@dataclass(frozen=True)
class Config(runs.SeatsConfig):
    """Settings of the experiment."""

    views: int = 6
    """Number of views of each seat, 2 or more."""
    samples: int = 16
    """Number of sampled shapes from which views are chosen, 1 to 32."""
    at_a_time: int = 6
    """Number of seats that are rebuilt in one call."""


class Seat(NamedTuple):
    """A seat, the cameras around it, and the measurement so far for each way of choosing."""

    name: str
    mesh: Any
    floor: float
    eyes: np.ndarray
    """Positions of the cameras `[view 3]`, in metres."""
    T_object_camera: jaxlie.SE3
    first: jaxlie.SE3
    seed: int


def main(config: Config) -> None:
    config = config.reduced(seats=1, views=2, samples=4, at_a_time=1)
    plot(run(config), config.results / "next_view.png")


def run(config: Config) -> Journal:
    """Choose views and rebuild after each, a few seats at a time."""
    prior = load_prior()
    journal = config.journal(
        "next_view", views=config.views, samples=config.samples, weights=fingerprint(prior)
    )
    missing = [one for one in config.chosen() if one.name not in journal.rows]
    for start in range(0, len(missing), config.at_a_time):
        began = time.perf_counter()
        seats = [_seat(one) for one in missing[start : start + config.at_a_time]]
        journal.add(_explored(seats, prior, config), time.perf_counter() - began)
        print(f"{start + len(seats)} of {len(missing)} seats", flush=True)
    journal.write({"summary": summary(journal)})
    return journal


def _seat(source: Any) -> Seat:
    model = load_object(source)
    if isinstance(model, Skipped):
        raise SystemExit(f"{source.name} cannot be read: {model.detail}")
    mesh = model.mesh
    radius, floor = camera_distance(mesh, KINECT), float(mesh.bounds[0, 1])
    T = reachable_views(radius, floor)
    seed = hash_seed(0, *source.name.encode())
    azimuth = jnp.float32([np.random.default_rng(seed).uniform(0, 360)])
    first = camera.on_sphere(azimuth, jnp.float32([ELEVATION]), radius)
    return Seat(source.name, mesh, floor, np.asarray(T.translation()), T, first, seed % 2**31)


def _explored(seats: list[Seat], prior: Any, config: Config) -> dict[str, Any]:
    """A row for each seat: IoU after each view, and the views, of each way of choosing."""
    ways = [(seat, way) for seat in seats for way in LINES]
    first = {seat.name: _seen(seat, seat.first, 0) for seat in seats}
    fields = [first[seat.name][0] for seat, _ in ways]
    eyes = [[np.asarray(seat.first.translation())[0]] for seat, _ in ways]
    scores, seconds = [], []
    for number in range(1, config.views + 1):
        grids = jax.tree.map(lambda *x: jnp.stack(x), *[_grids(one) for one in fields])
        scores.append(_scores(prior, grids, [first[seat.name][2] for seat, _ in ways]))
        for i, (seat, way) in enumerate(ways if number < config.views else ()):
            own = jax.tree.map(lambda x, i=i: x[i], grids)
            began = time.perf_counter()
            T = _next(way, seat, prior, own, first[seat.name], eyes[i], config.samples)
            seconds += [time.perf_counter() - began] if way == "next best view" else []
            eyes[i].append(np.asarray(T.translation())[0])
            fields[i] = distance.merge(fields[i], _seen(seat, T, number)[0])
    rows: dict[str, Any] = {seat.name: {} for seat in seats}
    for i, (seat, way) in enumerate(ways):
        rows[seat.name][way] = {
            "iou": [round(float(of[i]), 4) for of in scores],
            "views": np.round(eyes[i], 3).tolist(),
        }
    print(f"a decision takes {np.median(seconds):.2f} s with its samples", flush=True)
    return rows


def _seen(seat: Seat, T: jaxlie.SE3, number: int) -> tuple[Any, Any, Any]:
    """Signed distances of one view, the capture's camera and frame, and the true surface."""
    seen = capture(seat.mesh, T, noise=True, seed=seat.seed + number, camera=KINECT)
    field, _ = fused_frames(seen, Distances(32), SENSOR)
    return field, (seen.frame, seen.intrinsics, seen.depth.shape[1:]), seen.surface


_grids = jax.jit(soft_grids)


def _scores(prior: Any, grids: Grids, surfaces: list[Any]) -> np.ndarray:
    rebuild = reconstruct_jit(None, RefineConfig())
    found = rebuild(jax.random.key(0), prior, grids.occupied, grids.occluded)
    return np.asarray(iou(found.composed, jnp.stack(surfaces)))


def _next(
    way: str, seat: Seat, prior: Any, grids: Grids, seen: Any, eyes: list[np.ndarray], samples: int
) -> jaxlie.SE3:
    """The pose of the next view."""
    if way == "regular orbit":
        azimuth = np.degrees(np.arctan2(eyes[0][0], eyes[0][2])) + STEP * len(eyes)
        radius = float(np.linalg.norm(eyes[0]))
        return camera.on_sphere(jnp.float32([azimuth]), jnp.float32([ELEVATION]), radius)
    if way == "random":
        best = np.random.default_rng((seat.seed, len(eyes))).integers(len(seat.eyes))
    elif way == "farthest point":
        best = np.argmin((seat.eyes @ np.transpose(eyes)).max(axis=1))
    else:
        (frame, intrinsics, shape), key = seen[1], jax.random.key(len(eyes))
        logits = _sampled(prior, key, grids, samples)
        here = jnp.asarray(eyes[-1])
        best = _choose(
            logits, grids, frame, seat.T_object_camera, intrinsics, tuple(shape),
            here=here, sensor=SENSOR,
        ).ranking[0]  # fmt: skip
    return jax.tree.map(lambda x: x[int(best)][None], seat.T_object_camera)


@partial(jax.jit, static_argnums=3)
def _sampled(prior: Any, key: Any, grids: Grids, count: int) -> Any:
    codes = jax.random.normal(key, (1, count, prior.code_size))
    return decode(prior, codes, jax.tree.map(lambda x: x[None], grids))[0]


_choose = jax.jit(next_views, static_argnames=("shape", "sensor"))


def summary(journal: Journal) -> dict[str, Any]:
    """Mean IoU after each number of views, with its 95 % interval, of each way of choosing."""
    found = {}
    for way in LINES:
        of = _of(journal, way)
        found[way] = np.round([of.mean(axis=0), *interval(of)], 4).T.tolist()
    chosen, random = _of(journal, "next best view"), _of(journal, "random")
    if random.shape[1] > 4:
        gain = chosen[:, 2] - random[:, 4]
        ends = np.round([gain.mean(), *interval(gain)], 4).tolist()
        found["next best view with 3 less random with 5"] = ends
    return found


def _of(journal: Journal, way: str) -> np.ndarray:
    return np.array([row[way]["iou"] for row in journal.rows.values()])


def plot(journal: Journal, path: Path) -> None:
    """Curves with their intervals."""

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        for way, line in LINES.items():
            of = _of(journal, way)
            draw_mean(axes, np.arange(of.shape[1]) + 1, of, label=way, **line)
        title = f"{len(journal.rows)} CAD seats, Kinect"
        axes.set(xlabel="views", ylabel="IoU, composed", title=title)
        axes.legend(frameon=False)
        tidy(axes)

    save_column(path.with_suffix(""), draw, height=3.2, width=1.3 * COLUMN)


if __name__ == "__main__":
    main(tyro.cli(Config))
