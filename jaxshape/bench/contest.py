"""Run a method on a batch of problems until the budget of each is spent. [host]"""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxshape.bench.ask_tell import ASK_TELL, AskTell
from jaxshape.bench.problems import Problem, objectives, stacked_targets
from jaxshape.bench.watching import Observer, evaluates_in_a_branch, watched
from jaxshape.data.dataset import hash_seed
from jaxshape.model.shapes import ShapePrior
from jaxshape.search.config import RefineConfig
from jaxshape.search.names import find_build
from jaxshape.search.reconstruction import search_space
from jaxshape.search.refiner import Refiner, StopReason, advance, as_promised
from jaxshape.search.residuals import Target
from jaxshape.search.space import LatentSpace


class Outcome(NamedTuple):
    """The result of problems that were searched together.

    Attributes:
        observer: The evaluations of the problems.
        stops: Why the search of each problem stopped: the name of a `StopReason`, or the search's
            own reason.
        compiling: Time that compilation took, in seconds; close to 0 except for the first problems.
    """

    observer: Observer
    stops: list[str]
    compiling: float


Contestant = Callable[[Sequence[Problem], int], Outcome]
"""`(problems, seed) -> outcome`, compiled once for each number of problems."""


def contestant(
    method: str, example: Problem, config: RefineConfig, budget: int
) -> tuple[Contestant, bool]:
    """Build a search by its name, ready to be run on problems.

    Args:
        method: Name of a search (`jaxshape.search.names`), `pycma`, or `nevergrad:NAME`.
        example: Any of the problems.
        config: Settings of the search.
        budget: Decoder calls that each problem may spend.

    Returns:
        The contestant, and whether it must be given one problem at a time because it evaluates the
        objective within a loop of its own.

    Raises:
        ValueError: There is no such search, or it refuses its settings.
    """
    field = _field(example, config, budget)
    family, _, variant = method.partition(":")
    if family in ASK_TELL:
        build, found = ASK_TELL[family], variant or None
    else:
        build, found = find_build(method)
    search = build(found, example.prior.code_size, config)
    if isinstance(search, AskTell):
        return _on_the_host(search, field), False
    if not isinstance(search, Refiner):
        raise ValueError(
            f"The method {method!r} returned {type(search).__name__}; it must return a"
            " jaxshape.Refiner or a jaxshape.AskTell."
        )
    return _compiled(search, field), _must_be_alone(search, field, example)


def _must_be_alone(refiner: Refiner, field: "_Field", example: Problem) -> bool:
    """Whether a step of the search evaluates points in a loop or branch, as line searches do."""
    objective = field.objectives(field.decoder, stacked_targets([example]))(jnp.int32(0))
    point, key = field.space.from_code(example.first_code), jax.random.key(0)
    state, _ = as_promised("init", refiner.init(key, point, jnp.float32(1)))
    step = lambda key, state: refiner.step(key, state, objective)  # noqa: E731
    return evaluates_in_a_branch(step, key, state)


# ------------------------------------------------------------------ problems side by side


class _Field(NamedTuple):
    """The decoder and coordinates in which a method is run.

    Attributes:
        decoder: The shape prior.
        space: Coordinates of the search.
        observer: Counts the evaluations.
    """

    decoder: ShapePrior
    space: LatentSpace
    observer: Observer

    def objectives(self, decoder: ShapePrior, targets: Target) -> Callable[..., Any]:
        """The watched objective of each problem, by its number, as a function of points."""
        of_number = objectives(decoder, targets, self.space)
        return watched(of_number, self.observer, self.space.to_code)

    def start(self, problems: Sequence[Problem], seed: int) -> "_Start":
        """Stack the arrays of problems."""
        codes = jnp.stack([one.first_code for one in problems])
        return _Start(
            targets=stacked_targets(problems),
            codes=codes,
            points=jax.vmap(self.space.from_code)(codes),
            losses=jnp.array([one.first_objective for one in problems], jnp.float32),
            seeds=[hash_seed(seed, *one.name.encode()) for one in problems],
        )


def _field(example: Problem, config: RefineConfig, budget: int) -> _Field:
    """The decoder of a problem, in the coordinates that the settings select."""
    return _Field(example.decoder, search_space(example.prior, config), Observer(budget))


class _Start(NamedTuple):
    """Starting points of the searches of some problems.

    Attributes:
        targets: Targets of the problems `[problem ...]`.
        codes: First codes `[problem d]`.
        points: First codes in the search space `[problem d]`.
        losses: Objectives of the first codes `[problem]`.
        seeds: A seed for each problem, independent of the other problems.
    """

    targets: Target
    codes: Float[Array, "problem d"]
    points: Float[Array, "problem d"]
    losses: Float[Array, " problem"]
    seeds: list[int]


def _compiled(refiner: Refiner, field: _Field) -> Contestant:
    """Contestant of a `Refiner`: all problems make a step in one call of a compiled program."""
    observer, programs = field.observer, {}

    @jax.jit
    @jax.vmap
    def begin(key, point, loss):
        return refiner.init(jax.random.fold_in(key, 0), point, loss)

    def move(decoder, targets, number, spent, key, owner, state, trace):
        objective = field.objectives(decoder, targets)(owner)
        stop = jnp.where((state.stop == 0) & spent, StopReason.BUDGET, state.stop)
        state, key = state._replace(stop=stop), jax.random.fold_in(key, number)
        return advance(refiner, key, state, trace, objective)

    move_all = jax.jit(jax.vmap(move, (None, None, None, 0, 0, 0, 0, 0)))

    def search(problems, seed):
        at, began = field.start(problems, seed), time.perf_counter()
        keys = jax.vmap(jax.random.key)(jnp.array(at.seeds, jnp.uint32))
        owners, spent = jnp.arange(len(problems)), np.zeros(len(problems), bool)
        now = begin(keys, at.points, at.losses)
        if len(problems) not in programs:
            shapes = field.decoder, at.targets, jnp.int32(1), jnp.asarray(spent), keys, owners, *now
            programs[len(problems)] = move_all.lower(*shapes).compile()
        step, compiling = programs[len(problems)], time.perf_counter() - began
        observer.begin(at.codes, at.losses)
        for number in range(1, observer.budget + 2):  # also ends a search that evaluates nothing
            more = jnp.int32(number), jnp.asarray(spent), keys, owners
            now = step(field.decoder, at.targets, *more, *now)
            jax.effects_barrier()
            spent = observer.spent
            stops = np.where(spent & (now[0].stop == 0), StopReason.BUDGET, now[0].stop)
            if StopReason.RUNNING not in stops:
                break
        named = [StopReason(int(stop) or StopReason.BUDGET).name.lower() for stop in stops]
        return Outcome(observer, named, compiling)

    return search


def _on_the_host(search: AskTell, field: _Field) -> Contestant:
    """Contestant of an `AskTell`: one search per problem, with all points evaluated in one call."""
    observer = field.observer

    @jax.jit
    def evaluate(decoder, targets, points):
        each = field.objectives(decoder, targets)
        of_points = lambda owner, points: jax.vmap(each(owner))(points)  # noqa: E731
        return jax.vmap(of_points)(jnp.arange(len(points)), points)

    def run(problems, seed):
        at = field.start(problems, seed)
        starts = zip(at.seeds, np.asarray(at.points, np.float64), at.losses.tolist(), strict=True)
        searches = [search.start(*one) for one in starts]
        stops: list[str | None] = [None] * len(searches)
        asked = [_points_of(one.ask(), at.points.shape[1]) for one in searches]
        began = time.perf_counter()
        nothing = np.nan * _stacked(asked, stops)
        observer.begin(at.codes, at.losses)
        jax.block_until_ready(evaluate(field.decoder, at.targets, nothing))
        compiling = time.perf_counter() - began
        observer.begin(at.codes, at.losses)
        for _ in range(observer.budget + 1):  # also ends a search that evaluates nothing
            losses = np.asarray(evaluate(field.decoder, at.targets, _stacked(asked, stops)))
            jax.effects_barrier()
            for i, one in enumerate(searches):
                if stops[i] is None:
                    said = one.tell(asked[i], losses[i, : len(asked[i])])
                    stops[i] = said or ("budget" if observer.spent[i] else None)
                if stops[i] is None:
                    asked[i] = _points_of(one.ask(), at.points.shape[1])
            if None not in stops:
                break
        return Outcome(observer, [str(stop or "budget") for stop in stops], compiling)

    return run


def _points_of(asked: Any, d: int) -> Float[np.ndarray, "n d"]:
    """The points that a search proposed; refuse other answers."""
    shape = np.shape(asked)
    if len(shape) != 2 or shape[0] < 1 or shape[1] != d:
        raise ValueError(
            f"ask of the search returned shape {shape}; it must return points [n, {d}], one or"
            " more."
        )
    return np.asarray(asked)


def _stacked(
    asked: Sequence[Float[np.ndarray, "n d"]], stops: Sequence[str | None]
) -> Float[np.ndarray, "problem m d"]:
    """The points of all searches, padded with NaN; all NaN for searches that have stopped."""
    points = np.full((len(asked), max(map(len, asked)), asked[0].shape[1]), np.nan, np.float32)
    for i, (one, stop) in enumerate(zip(asked, stops, strict=True)):
        if stop is None:
            points[i, : len(one)] = one
    return points
