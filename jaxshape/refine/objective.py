"""The mapping objective, Eq. 7 of the paper, over codes.

For one object, Eq. 7 is a weighted cross-entropy whose weights do not depend on the code, so they
are worked out once, as a `Target`. `objective` then scores one code; under any `jax.vmap`s it
becomes one decoder call over all candidates of all objects, with bounded memory.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, PyTree

from jaxshape.model.autoencoder import decode

BALANCED_WEIGHT = 3.0
"""Weight of measured occupied voxels in the `balanced` objective; the paper has 1."""

CANDIDATES_AT_A_TIME = {"cpu": 2, "default": 1024}
"""Candidates decoded together: on CPU as many as keep a layer in cache, else a full device."""


class Target(NamedTuple):
    """How much each voxel wants to be occupied, and how much empty."""

    occupied: Float[Array, "*batch x y z"]
    empty: Float[Array, "*batch x y z"]


def target(
    occupied: Bool[Array, "*batch x y z"],
    occluded: Bool[Array, "*batch x y z"],
    prior_logits: Float[Array, "*batch x y z"],
    *,
    occupied_weight: float = BALANCED_WEIGHT,
) -> Target:
    """The weights of Eq. 7: F where something was seen, alpha times the prior elsewhere.

    `occupied` is F, `occluded` is M, `prior_logits` the decoded first code,
    G(lambda_0). `occupied_weight` is 1
    for the paper's objective; more keeps thin measured structures from drowning in free space.
    alpha = sum(M) / sum(1 - M); it is 0 where nothing is occluded, and where everything is, the
    sum over no voxels counts as one, so that the prior alone decides.
    """
    axes = (-3, -2, -1)
    M = occluded.astype(prior_logits.dtype)
    F = occupied.astype(prior_logits.dtype)
    G0 = jax.nn.sigmoid(prior_logits)
    alpha = M.sum(axes, keepdims=True) / jnp.maximum((1 - M).sum(axes, keepdims=True), 1)
    return Target(
        occupied=occupied_weight * (1 - M) * F + alpha * M * G0,
        empty=(1 - M) * (1 - F) + alpha * M * (1 - G0),
    )


def cross_entropy(logits: Float[Array, "*batch x y z"], target: Target) -> Float[Array, "*batch"]:
    """Eq. 7 from logits, in nats per voxel: f carries the 1 / N^3 of the training loss."""
    # -log sigmoid(l) = softplus(-l) = softplus(l) - l, and -log(1 - sigmoid(l)) = softplus(l).
    total = (target.occupied + target.empty) * jax.nn.softplus(logits) - target.occupied * logits
    return jnp.mean(total, axis=(-3, -2, -1))


@jax.custom_vjp
def objective(params: PyTree, code: Float[Array, " d"], target: Target) -> Float[Array, ""]:
    """Eq. 7 of one code. Differentiable in the code; parameters and target are constants."""
    return _loss(params, code, target)


objective.defvjp(
    lambda params, code, target: _loss_and_slope(params, code, target),
    lambda slope, ct: (None, ct * slope, None),
)


# `jax.vmap` over candidates, then over objects, would hand the decoder one axis per vmap and keep
# every candidate's grid in memory. These rules flatten both axes into one and go through it a
# number of candidates at a time. Only here, at the loss, is the result small enough to keep.


@custom_vmap
def _loss(params, code, target):
    return _losses(params, code[None], target)[0]


@_loss.def_vmap
def _over_candidates(size, batched, params, codes, target):
    _require_shared(batched[0])
    codes = codes if batched[1] else jnp.broadcast_to(codes, (size, *codes.shape))
    if any(jax.tree.leaves(batched[2])):  # one candidate for each of several objects
        return _by_chunks(_score, params, codes[:, None], target)[:, 0], True
    return _losses(params, codes, target), True


@custom_vmap
def _losses(params, codes, target):
    return _by_chunks(_score, params, codes[None], _add_axis(target))[0]


@_losses.def_vmap
def _over_objects(size, batched, params, codes, target):
    _require_shared(batched[0])
    codes = codes if batched[1] else jnp.broadcast_to(codes, (size, *codes.shape))
    if not any(jax.tree.leaves(batched[2])):
        target = jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), target)
    return _by_chunks(_score, params, codes, target), True


@custom_vmap
def _loss_and_slope(params, code, target):
    return jax.tree.map(
        lambda x: x[0, 0],
        _by_chunks(_score_and_slope, params, code[None, None], _add_axis(target)),
    )


@_loss_and_slope.def_vmap
def _slopes_over_objects(size, batched, params, codes, target):
    _require_shared(batched[0])
    codes = codes if batched[1] else jnp.broadcast_to(codes, (size, *codes.shape))
    if not any(jax.tree.leaves(batched[2])):
        target = jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), target)
    scored = _by_chunks(_score_and_slope, params, codes[:, None], target)
    return jax.tree.map(lambda x: x[:, 0], scored), (True, True)


def _score(params, codes, targets):
    return cross_entropy(decode(params, codes), targets)


def _score_and_slope(params, codes, targets):
    losses, pull_back = jax.vjp(lambda codes: _score(params, codes, targets), codes)
    return losses, pull_back(jnp.ones_like(losses))[0]


def _by_chunks(score, params, codes: Float[Array, "b n d"], targets: Target):
    """Score all candidates of all objects, a bounded number at a time."""
    b, n, _ = codes.shape

    def chunked(size):
        def go(codes, targets):
            pick = lambda i: jax.tree.map(lambda x: x[i], targets)  # noqa: E731
            item = lambda i: jax.tree.map(  # noqa: E731
                lambda x: x[0], score(params, codes[i // n, i % n][None], _add_axis(pick(i // n)))
            )
            return lax.map(item, jnp.arange(b * n), batch_size=min(size, b * n))

        return go

    branches = {platform: chunked(size) for platform, size in CANDIDATES_AT_A_TIME.items()}
    scored = lax.platform_dependent(codes, targets, **branches)
    return jax.tree.map(lambda x: x.reshape(b, n, *x.shape[1:]), scored)


def _add_axis(target: Target) -> Target:
    return jax.tree.map(lambda x: x[None], target)


def _require_shared(batched: PyTree) -> None:
    if any(jax.tree.leaves(batched)):
        raise ValueError("The decoder's parameters are shared by a batch; vmap over codes only.")
