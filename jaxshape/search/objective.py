"""The mapping objective, Eq. 7 of the paper, over codes.

For one object, Eq. 7 is a weighted cross-entropy whose weights do not depend on the code, so they
are worked out once, as a `Target`. `objective` then scores one code; under any `jax.vmap`s it
becomes one decoder call over all candidates of all objects, with bounded memory.
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxshape.model.autoencoder import decode
from jaxshape.model.chunks import in_chunks

CANDIDATES_AT_A_TIME = {"cpu": 8, "default": 1024}
"""Candidates decoded together: on CPU enough rows for its products, else a full device."""


class Weights(NamedTuple):
    """How the parts of Eq. 7 are weighed against what was measured as occupied."""

    free: float = 1.0
    """Of what was measured as free; less keeps thin structures from drowning in free space."""
    prior: Float[Array, "*#batch 1 1 1"] | float = 1.0
    """Of the prior where nothing was measured: a factor of alpha."""


PAPER = Weights()
"""Eq. 7 as printed."""
BALANCED = Weights(free=1 / 3)
"""The best on procedural and CAD chairs, without noise and with it (experiments/objective.py)."""


class Target(NamedTuple):
    """How much each voxel wants to be occupied, and how much empty."""

    occupied: Float[Array, "*batch x y z"]
    empty: Float[Array, "*batch x y z"]


def target(
    occupied: Bool[Array, "*batch x y z"],
    occluded: Bool[Array, "*batch x y z"],
    prior_logits: Float[Array, "*batch x y z"],
    weights: Weights = BALANCED,
) -> Target:
    """The weights of Eq. 7: F where something was seen, alpha times the prior elsewhere.

    `occupied` is F, `occluded` is M, `prior_logits` the decoded first code, G(lambda_0).
    alpha = sum(M) / sum(1 - M), times `weights.prior`; it is 0 where nothing is occluded, and where
    everything is, the sum over no voxels counts as one, so that the prior alone decides.
    """
    axes = (-3, -2, -1)
    M = occluded.astype(prior_logits.dtype)
    F = occupied.astype(prior_logits.dtype)
    G0 = jax.nn.sigmoid(prior_logits)
    alpha = M.sum(axes, keepdims=True) / jnp.maximum((1 - M).sum(axes, keepdims=True), 1)
    alpha = weights.prior * alpha
    return Target(
        occupied=(1 - M) * F + alpha * M * G0,
        empty=weights.free * (1 - M) * (1 - F) + alpha * M * (1 - G0),
    )


def cross_entropy(logits: Float[Array, "*batch x y z"], target: Target) -> Float[Array, "*batch"]:
    """Eq. 7 from logits, in nats per voxel: f carries the 1 / N^3 of the training loss."""
    # -log sigmoid(l) = softplus(-l) = softplus(l) - l, and -log(1 - sigmoid(l)) = softplus(l).
    softplus = jnp.maximum(logits, 0) + jnp.log(1 + jnp.exp(-jnp.abs(logits)))
    # Sums written as products run several times faster on CPU than what XLA fuses into a mean.
    over_voxels = partial(jnp.einsum, "...xyz,...xyz->...", precision="highest")
    total = over_voxels(target.occupied + target.empty, softplus)
    return (total - over_voxels(target.occupied, logits)) / math.prod(logits.shape[-3:])


@jax.custom_vjp
def objective(params: PyTree, code: Float[Array, " d"], target: Target) -> Float[Array, ""]:
    """Eq. 7 of one code; NaN, without decoding it, for a code that is not finite.

    Differentiable in the code; parameters and target are constants.
    """
    return _losses(params, code[None], _add_axis(target), jnp.zeros(1, jnp.int32))[0]


def _with_slope(params, code, target):
    losses, slopes = _losses_and_slopes(
        params, code[None], _add_axis(target), jnp.zeros(1, jnp.int32)
    )
    return losses[0], slopes[0]


objective.defvjp(_with_slope, lambda slope, ct: (None, ct * slope, None))


def _score(params, codes, targets):
    return cross_entropy(decode(params, codes), targets)


def _score_and_slope(params, codes, targets):
    losses, pull_back = jax.vjp(lambda codes: _score(params, codes, targets), codes)
    return losses, pull_back(jnp.ones_like(losses))[0]


# `jax.vmap` over candidates, then over objects, would hand the decoder one axis per vmap and keep
# every candidate's grid in memory. Here each vmap only makes more rows, so that any nest of them
# goes through the decoder a bounded number of candidates at a time. `owner` is the index of each
# row's target.


def _over_rows(score):
    """`score` of rows of codes, in bounded memory under any nest of `jax.vmap`s."""

    @custom_vmap
    def scored(params, codes, targets, owner):
        branches = {
            platform: partial(_by_chunks, score, size)
            for platform, size in CANDIDATES_AT_A_TIME.items()
        }
        return lax.platform_dependent(params, codes, targets, owner, **branches)

    @scored.def_vmap
    def more_rows(size, batched, params, codes, targets, owner):
        params, is_one = _one_network(params, batched[0])
        n, shared = len(owner), not any(jax.tree.leaves(batched[2]))
        codes = codes if batched[1] else jnp.broadcast_to(codes, (size, *codes.shape))
        if shared:
            owner = jnp.tile(owner, size)
        else:
            targets = jax.tree.map(
                lambda x, has_axis: x if has_axis else jnp.broadcast_to(x, (size, *x.shape)),
                targets,
                batched[2],
            )
            count = targets.occupied.shape[1]
            owner = (owner + count * jnp.arange(size)[:, None]).ravel()
            targets = jax.tree.map(lambda x: x.reshape(size * count, *x.shape[2:]), targets)
        out = scored(params, codes.reshape(size * n, -1), targets, owner)
        out = jax.tree.map(lambda x: x.reshape(size, n, *x.shape[1:]), out)
        out = jax.tree.map(lambda x: jnp.where(is_one, x, jnp.nan), out)
        return out, jax.tree.map(lambda _: True, out)

    return scored


_losses, _losses_and_slopes = _over_rows(_score), _over_rows(_score_and_slope)


def _by_chunks(score, size, params, codes, targets, owner):
    """Score the rows `size` at a time; a chunk without a finite code is passed over.

    Rows whose code is not finite score NaN in any company.
    """

    def chunk(rows, wanted):
        shapes = jax.eval_shape(score, params, codes[rows], _pick(targets, owner[rows]))
        nothing = jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), shapes)

        def compute():
            scored = score(params, codes[rows], _pick(targets, owner[rows]))
            return jax.tree.map(lambda x, y: jax.vmap(jnp.where)(wanted, x, y), scored, nothing)

        return lax.cond(jnp.any(wanted), compute, lambda: nothing)

    return in_chunks(chunk, size, jnp.arange(len(codes)), jnp.all(jnp.isfinite(codes), axis=-1))


def _one_network(params: PyTree, batched: PyTree) -> tuple[PyTree, Bool[Array, ""] | bool]:
    """The network that a batch shares, and whether it does; a batch of networks scores NaN.

    A branch under `jax.vmap`, as in a line search, copies parameters for each element; compilers
    take the first of equal copies without making any. Biases and scales stand for the rest.
    """
    small = lambda x: x.ndim <= 2  # with the axis of the batch  # noqa: E731
    same = [
        jnp.all(x == x[0])
        for x, is_batched in zip(jax.tree.leaves(params), jax.tree.leaves(batched), strict=True)
        if is_batched and small(x)
    ]
    first = jax.tree.map(lambda x, is_batched: x[0] if is_batched else x, params, batched)
    return first, jnp.all(jnp.stack(same)) if same else True


def _pick(targets: Target, owner: Int[Array, " n"]) -> Target:
    return jax.tree.map(lambda x: x[owner], targets)


def _add_axis(target: Target) -> Target:
    return jax.tree.map(lambda x: x[None], target)
