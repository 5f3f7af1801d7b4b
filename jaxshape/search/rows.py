"""Scores of all candidates of all objects, in bounded memory under any nest of `jax.vmap`s.

`jax.vmap` over candidates, then over objects, would hand a decoder one axis per vmap and keep every
candidate's grid in memory. Here each vmap only makes more rows, and rows are scored a bounded
number at a time. Nothing here depends on networks or residuals: a score is a function

    score(shared, codes [n d], own [n ...]) -> pytree of [n ...]

of constants that all rows share, of one code for each row, and of arrays that belong to the row's
object.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array, Float, PyTree

from jaxshape.model.chunks import in_chunks, vary_like
from jaxshape.model.shapes import pick

Score = Callable[[PyTree, Float[Array, "n d"], PyTree], PyTree]

ROWS_AT_A_TIME = {"cpu": 8, "default": 1024}
"""Rows scored together: on CPU enough for efficient matrix products, on other platforms enough to
fill the device."""


def loss_over_rows(
    score: Score, at_a_time: Mapping[str, int] = ROWS_AT_A_TIME
) -> Callable[[PyTree, Float[Array, " d"], PyTree], Float[Array, ""]]:
    """The loss of one code of one object, to be used under `jax.vmap` and `jax.grad`.

    Args:
        score: Scores rows with one loss each; differentiable in the codes.
        at_a_time: Rows that are scored together, by platform.

    Returns:
        `loss(shared, code, own)`; a code that is not finite is not decoded and has the loss NaN. It
        is differentiable in the code; everything else is constant.
    """

    def losses(shared, codes, own):
        return score(shared, codes, own).astype(codes.dtype)

    def losses_and_slopes(shared, codes, own):
        found, pull_back = jax.vjp(lambda codes: losses(shared, codes, own), codes)
        return found, pull_back(jnp.ones_like(found))[0]

    @jax.custom_vjp
    def loss(shared, code, own):
        return of_one_row(losses, shared, code, own, at_a_time)

    def with_slope(shared, code, own):
        return of_one_row(losses_and_slopes, shared, code, own, at_a_time)

    loss.defvjp(with_slope, lambda slope, ct: (None, ct * slope, None))
    return loss


def over_rows(score: Score, at_a_time: Mapping[str, int] = ROWS_AT_A_TIME) -> Callable[..., PyTree]:
    """`score` in bounded memory under any nest of `jax.vmap`s.

    Args:
        score: Scores rows.
        at_a_time: Rows that are scored together, by platform.

    Returns:
        `scored(shared, codes [n d], own [m ...], owner [n])`, where `owner` is the index of each
        row's object in `own`. `shared` must be the same in every element of a batch
        (`one_network`).
    """

    score = jax.jit(score, inline=True)  # traced once for its shapes and its values

    @custom_vmap
    def scored(shared, codes, own, owner):
        branches = {
            platform: partial(_by_chunks, score, size) for platform, size in at_a_time.items()
        }
        return lax.platform_dependent(shared, codes, own, owner, **branches)

    @scored.def_vmap
    def more_rows(size, batched, shared, codes, own, owner):
        shared_is, codes_are, own_is, owner_is = batched
        # A branch under `jax.vmap`, as in a line search, copies constants to each element: keep
        # one.
        shared = jax.tree.map(lambda x, has_axis: x[0] if has_axis else x, shared, shared_is)
        n = owner.shape[-1]
        codes = codes if codes_are else jnp.broadcast_to(codes, (size, *codes.shape))
        owner = owner if owner_is else jnp.broadcast_to(owner, (size, n))
        if any(jax.tree.leaves(own_is)):
            own = jax.tree.map(
                lambda x, has_axis: x if has_axis else jnp.broadcast_to(x, (size, *x.shape)),
                own,
                own_is,
            )
            count = jax.tree.leaves(own)[0].shape[1]
            owner = owner + count * jnp.arange(size, dtype=owner.dtype)[:, None]
            own = jax.tree.map(lambda x: x.reshape(size * count, *x.shape[2:]), own)
        out = scored(shared, codes.reshape(size * n, -1), own, owner.ravel())
        out = jax.tree.map(lambda x: x.reshape(size, n, *x.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return scored


def of_one_row(
    score: Score,
    shared: PyTree,
    code: Float[Array, " d"],
    own: PyTree,
    at_a_time: Mapping[str, int] = ROWS_AT_A_TIME,
) -> PyTree:
    """The score of one code of one object, in bounded memory under any nest of `jax.vmap`s.

    Args:
        score: Scores rows.
        shared: Constants that all rows share.
        code: The code `[d]`.
        own: Arrays that belong to its object.
        at_a_time: Rows that are scored together, by platform.
    """
    rows = jax.tree.map(lambda x: x[None], own)
    found = over_rows(score, at_a_time)(shared, code[None], rows, jnp.zeros(1, jnp.int32))
    return pick(found, 0)


def _by_chunks(score: Score, size: int, shared, codes, own, owner) -> PyTree:
    """Score the rows `size` at a time; a chunk without a finite code is skipped.

    Rows whose code is not finite score NaN; they do not affect the other rows.
    """

    def chunk(rows, wanted):
        shapes = jax.eval_shape(score, shared, codes[rows], pick(own, owner[rows]))
        nothing = jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), shapes)
        nothing = vary_like(nothing, codes)

        def compute():
            found = score(shared, codes[rows], pick(own, owner[rows]))
            return jax.tree.map(lambda x, y: jax.vmap(jnp.where)(wanted, x, y), found, nothing)

        return lax.cond(jnp.any(wanted), compute, lambda: nothing)

    return in_chunks(chunk, size, jnp.arange(len(codes)), jnp.all(jnp.isfinite(codes), axis=-1))


@custom_vmap
def one_network(shared: PyTree) -> PyTree:
    """The identity, for constants of a search that all elements of a batch share.

    The constants are the network, and the arrays that a residual and a penalty close over.

    Raises:
        ValueError: `jax.vmap` batches them. A search over several networks is `jax.lax.map`.
    """
    return shared


@one_network.def_vmap
def _refuse_networks(size: int, batched: PyTree, shared: PyTree) -> tuple[PyTree, PyTree]:
    if any(jax.tree.leaves(batched)):
        raise ValueError(
            f"jax.vmap was asked to search with {size} networks at once, or with a residual or a "
            f"penalty that closes over {size} different arrays; but a search shares these among "
            "all objects and candidates. Use jax.lax.map, or a loop, over them, or penalty_weight "
            "for the weight of a penalty; and prepare a network outside of lax.cond."
        )
    return shared, batched


def hoisted(function: Callable[..., Array], *examples: Any) -> tuple[Callable[..., Array], Any]:
    """Turn the arrays that a function closes over into its first argument.

    A closure cannot pass through `over_rows`: its constants must be arguments.

    Args:
        function: Returns one array.
        examples: Example arguments, with the shapes and types of later calls.

    Returns:
        `pure(constants, *arguments)`, and the constants.
    """
    program = jax.make_jaxpr(function)(*examples)

    def pure(constants, *arguments):
        again = jaxpr_as_fun(ClosedJaxpr(program.jaxpr, constants))
        return again(*jax.tree.leaves(arguments))[0]

    return pure, program.consts
