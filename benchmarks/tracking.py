"""Poses of frames of 320 x 240 pixels, against Open3D and small_gicp, and what a step of the map
takes."""

import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import trimesh

import jaxshape as js
from benchmarks.harness import Metric, compiled, optional
from benchmarks.problems import FIRST_CHAIR
from benchmarks.rivals.variant import Variant
from jaxshape.data import render
from jaxshape.data.boxes import Box
from jaxshape.geometry import camera
from jaxshape.mapping.config import MappingConfig, TrackingConfig
from jaxshape.mapping.map.mapper import Step, build_mapper
from jaxshape.mapping.tracking import icp, registration
from jaxshape.mapping.tracking.keyframes import PreparedFrame
from jaxshape.mapping.tracking.views import DepthView, view_of
from jaxshape.search.config import RefineConfig
from jaxshape.search.reconstruction import refiner_for

WIDTH, HEIGHT = 320, 240
FIELD_OF_VIEW = 57.0
"""Degrees across, as a Kinect's."""
DISTANCE = 1.9
"""Metres of the camera from the middle of the chair."""
STEPS = (5, 10, 20, 30)
"""Degrees between two frames, about the chair."""
SUCCESS = (0.01, 1.0)
"""Metres and degrees below which a pose counts as found."""
SETTLED = 4
"""Keyframes until everything that a step needs is compiled."""

RIVALS = {"open3d": "open3d_registration", "small_gicp": "small_gicp_registration"}


class Pair(NamedTuple):
    """Two frames, and how the camera moved between them."""

    step: int
    reference: np.ndarray
    frame: np.ndarray
    T_reference_frame: np.ndarray


class Outcome(NamedTuple):
    """Of one pair and one way to align it."""

    metres: float
    degrees: float
    prepare: float
    """Seconds for the new frame; the reference was prepared when it was new."""
    align: float

    @property
    def success(self) -> bool:
        return self.metres < SUCCESS[0] and self.degrees < SUCCESS[1]


def run(quick: bool) -> list[Metric]:
    metrics = registrations(quick)
    return metrics + mapping(frames=7 if quick else 9)


# ------------------------------------------------------------------ registration


def registrations(quick: bool) -> list[Metric]:
    """Every way to align, on the same pairs, from the guess that nothing moved."""
    ways, seconds = our_ways()
    systems = {name: {"": way} for name, way in ways.items()}
    for name, module in RIVALS.items():
        if rival := optional(module):
            systems[name] = rival.variants()
    metrics = [Metric("tracking/compile", seconds, "s", note="view_of and register")]
    for scene in ("room", "chair"):
        problem = list(pairs(scene, chairs=1 if quick else 2, starts=2))
        outcomes = compare(problem, {
            (system, variant): way
            for system, ways in systems.items() for variant, way in ways.items()
        })  # fmt: skip
        metrics += _report(scene, problem, outcomes)
    return metrics


def our_ways() -> tuple[dict[str, Variant], float]:
    """Registration from one guess and from many, and the seconds it takes to compile the first."""
    everything, still = jnp.ones((HEIGHT, WIDTH), bool), jaxlie.SE3.identity()
    lens, flat = intrinsics(), jnp.ones((HEIGHT, WIDTH))
    prepare, seconds = compiled(view_of, flat, lens)

    def one(reference: DepthView, frame: DepthView) -> jax.Array:
        match = icp.match_view(reference, still)
        found = registration.register(frame, everything, match, still)
        return found.T_reference_source.as_matrix()

    def many(reference: DepthView, frame: DepthView) -> jax.Array:
        match = icp.match_view(reference, still)
        guesses = registration.guesses(still, jnp.array([0.0, 0.0, DISTANCE]))
        found = registration.register_from(frame, everything, match, guesses)
        return found.T_reference_source.as_matrix()

    view = prepare(flat, lens)
    (register, more), (register_from, _) = (compiled(f, view, view) for f in (one, many))
    ways = {"jaxshape": register, "jaxshape_guesses": register_from}
    view_from = lambda depth, _: prepare(jnp.asarray(depth), lens)  # noqa: E731
    return {name: Variant(view_from, align) for name, align in ways.items()}, seconds + more


def compare(problem: list[Pair], ways: dict[Any, Variant]) -> dict[Any, list[Outcome]]:
    """The outcome of each pair, the systems taking turns."""
    lens = tuple(map(float, intrinsics()))
    for way in ways.values():  # what is allocated or loaded at first is not counted
        frames = [way.prepare(x, lens) for x in (problem[0].reference, problem[0].frame)]
        jax.block_until_ready(way.align(*frames))
    outcomes: dict[Any, list[Outcome]] = {name: [] for name in ways}
    for pair in problem:
        for name, way in ways.items():
            reference = way.prepare(pair.reference, lens)
            frame, prepare = _timed(way.prepare, pair.frame, lens)
            T, align = _timed(way.align, reference, frame)
            outcomes[name].append(Outcome(*_error(T, pair.T_reference_frame), prepare, align))
    return outcomes


def _timed(function: Callable, *arguments: Any) -> tuple[Any, float]:
    start = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, time.perf_counter() - start


def _error(T: Any, truth: np.ndarray) -> tuple[float, float]:
    as_pose = lambda matrix: jaxlie.SE3.from_matrix(jnp.asarray(matrix, jnp.float32))  # noqa: E731
    return registration.displacement(as_pose(np.array(T)), as_pose(truth))


def _report(scene: str, problem: list[Pair], outcomes: dict[Any, list[Outcome]]) -> list[Metric]:
    """Of each system its best variant: most poses found, the faster of those."""
    metrics, frame_seconds = [], {}
    for system in dict.fromkeys(name for name, _ in outcomes):
        ways = {variant: found for (name, variant), found in outcomes.items() if name == system}
        best = max(ways, key=lambda variant: _merit(ways[variant]))
        found = ways[best]
        prefix = f"tracking/{scene}/{system}"
        for step in STEPS:
            of_step = [o for o, pair in zip(found, problem, strict=True) if pair.step == step]
            metrics += _accuracy(f"{prefix}/{step}_degrees", of_step, gated=system not in RIVALS)
        prepare, align = (1e3 * np.median([o[i] for o in found]) for i in (2, 3))
        frame_seconds[system] = np.array([o.prepare + o.align for o in found])
        metrics.append(Metric(f"{prefix}/frame", prepare + align, "ms", note=best))
        metrics.append(Metric(f"{prefix}/align", align, "ms", note="preprocessing not counted"))
    ours = frame_seconds["jaxshape"]
    for system in [name for name in RIVALS if name in frame_seconds]:
        ratio = float(np.median(frame_seconds[system] / ours))
        metrics.append(Metric(f"tracking/{scene}/{system}/speedup", ratio, "x", "higher"))
    return metrics


def _merit(outcomes: list[Outcome]) -> tuple[int, float]:
    return sum(o.success for o in outcomes), -sum(o.prepare + o.align for o in outcomes)


def _accuracy(prefix: str, outcomes: list[Outcome], *, gated: bool) -> list[Metric]:
    metres, degrees = (np.array([o[i] for o in outcomes]) for i in (0, 1))
    (mm, most_mm), (turn, most_turn) = (np.quantile(x, (0.5, 0.9)) for x in (1e3 * metres, degrees))
    share = 100 * float(np.mean([o.success for o in outcomes]))
    note = f"90 %: {most_mm:.1f} mm; median and 90 % of the angle {turn:.2f}, {most_turn:.2f} deg"
    return [
        Metric(f"{prefix}/found", share, "%", "higher" if gated else "info", tolerance=0.15),
        Metric(f"{prefix}/position", float(mm), "mm", note=note),
    ]


# ------------------------------------------------------------------ frames


def intrinsics() -> js.Intrinsics:
    """Of the images; rendered square and cut to their height."""
    lens = camera.intrinsics_for(FIELD_OF_VIEW, WIDTH)
    return lens._replace(cy=jnp.float32(HEIGHT / 2))


def pairs(scene: str, *, chairs: int, starts: int) -> Iterable[Pair]:
    """Frames of some chairs, alone or in a room, from some directions and a step further on."""
    for number in range(chairs):
        mesh = js.random_chair(FIRST_CHAIR + number)
        whole = furnished(mesh) if scene == "room" else mesh
        for start in range(starts):
            azimuth = 360 / starts * start + 13 * number
            T, depth = look(whole, azimuth + np.array([0, *STEPS]), seed=number * starts + start)
            for i, step in enumerate(STEPS, start=1):
                yield Pair(step, depth[0], depth[i], np.linalg.inv(T[0]) @ T[i])


def look(mesh: trimesh.Trimesh, azimuth: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses on a circle about the chair, and what a Kinect sees from there."""
    T = camera.on_sphere(jnp.float32(azimuth), jnp.full(len(azimuth), 25.0), DISTANCE)
    lens = camera.intrinsics_for(FIELD_OF_VIEW, WIDTH)
    depth, cosine = render.render_depth(mesh, T, lens, WIDTH)
    depth = render.add_sensor_noise(depth, cosine, np.random.default_rng(seed))
    edge = (WIDTH - HEIGHT) // 2
    return np.asarray(T.as_matrix(), np.float64), depth[:, edge:-edge].copy()


def furnished(chair: trimesh.Trimesh) -> trimesh.Trimesh:
    """The chair on a floor between two walls, with a crate and a shelf."""
    floor = float(chair.bounds[0, 1])
    boxes = [
        ((-3, floor - 0.1, -3), (4, floor, 4)),
        ((-3, floor, -2.1), (4, floor + 2.5, -2)),
        ((-2.1, floor, -3), (-2, floor + 2.5, 4)),
        ((0.7, floor, -0.9), (1.2, floor + 0.45, -0.4)),
        ((-1.3, floor, 0.6), (-0.9, floor + 1.1, 1.5)),
    ]
    solids = [trimesh.creation.box(bounds=np.array(ends, float)) for ends in boxes]
    return trimesh.util.concatenate([chair, *solids])


# ------------------------------------------------------------------ the map


def mapping(frames: int) -> list[Metric]:
    """What a keyframe takes, part by part, and how many frames are tracked in a second; both with
    everything compiled."""
    mesh = js.random_chair(FIRST_CHAIR)
    whole = furnished(mesh)
    T, depth = look(whole, 11.0 * np.arange(frames), seed=0)
    _, between = look(whole, 11.0 * (frames - 1) + 2.0 * np.arange(1, 5), seed=1)
    mapper = _mapper()
    box = Box(np.eye(4), 1.05 * np.asarray(mesh.extents, np.float64))
    state, _ = mapper.init(_shot(depth[0]), box, jaxlie.SE3.from_matrix(jnp.float32(T[0])))
    steps: list[Step] = []
    for frame in depth[1:]:
        state, step = mapper.step(state, _shot(frame))
        steps.append(step)
    steps = [step for step in steps if step.status == "keyframe"][SETTLED:]
    metrics = _parts(steps)
    rates = []
    for frame in [*between, *between]:
        start = time.perf_counter()
        state, step = mapper.step(state, _shot(frame))
        if step.status == "tracked":
            rates.append(1 / (time.perf_counter() - start))
    rate = float(np.median(rates)) if rates else np.nan
    return [*metrics, Metric("tracking/rate", rate, "frames/s", "higher", target=10.0)]


def _parts(steps: list[Step]) -> list[Metric]:
    metrics, total = [], 0.0
    for part in ("track", "fuse", "refine", "realign"):
        seconds = float(np.median([step.seconds.get(part, np.nan) for step in steps]))
        total += seconds
        metrics.append(Metric(f"tracking/keyframe/{part}", seconds, "s"))
    return [*metrics, Metric("tracking/keyframe", total, "s", "lower", target=3.0)]


def _mapper():
    prior, search, settings = js.load_prior("chair-autoencoder"), RefineConfig(), MappingConfig()
    refiner = refiner_for("cma", prior, search)
    return build_mapper(prior, refiner, search, settings, TrackingConfig())


def _shot(depth: np.ndarray) -> PreparedFrame:
    return PreparedFrame(_view_of(jnp.asarray(depth), intrinsics()), jnp.ones(depth.shape, bool))


_view_of = jax.jit(view_of)
