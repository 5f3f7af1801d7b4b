"""The objective of a search: shape model, residual and penalty as one function of a code."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxshape.geometry.grids import Grids
from jaxshape.model.chunks import vary_like
from jaxshape.model.shapes import Precision, Prepared, ShapeModel, ShapePrior, as_codes, pick
from jaxshape.search.curvature import Composed, Expansion, lanczos
from jaxshape.search.residuals import BALANCED, Residual, one_loss
from jaxshape.search.rows import hoisted, loss_over_rows, of_one_row, one_network, over_rows
from jaxshape.search.space import LatentSpace, raw

# The penalty of a code, in nats per voxel.
Penalty = Callable[[Float[Array, " d"]], Float[Array, ""]]


class ObjectTerms(NamedTuple):
    """The part of the objective that differs between objects; leading axes are batch axes.

    Attributes:
        features: Features of the object's measurement, prepared by the model.
        target: Target of the object's residual.
        weight: Weight of the penalty.
    """

    features: PyTree
    target: PyTree
    weight: Float[Array, "*batch"]


class Evaluation(NamedTuple):
    """Functions that score codes of any object.

    Attributes:
        loss: `(shared, code [d], own) -> loss`, under any `jax.vmap`s and `jax.grad`.
        shape: `(shared, codes [n d], own [m ...], owner [n]) -> logits [n x y z], losses [n]`.
        expansion: `(directions, shared, code [d], own, chain [d d]) -> Expansion` in coordinates of
            the search space, under any `jax.vmap`s; `chain` is the Jacobian of the code with
            respect to the point.
        shared: Arrays that all objects share: prepared parameters, and the constants of the
            residual and the penalty.
    """

    loss: Callable[..., Float[Array, ""]]
    shape: Callable[..., tuple[Array, Array]]
    expansion: Callable[..., Expansion]
    shared: PyTree


def evaluation(
    model: ShapeModel,
    prepared: Prepared,
    residual: Residual,
    penalty: Penalty | None,
    code: Float[Array, " d"],
    own: ObjectTerms,
) -> Evaluation:
    """Join a model, a residual and a penalty.

    Args:
        model: The shape model.
        prepared: Prepared parameters; only the shared ones are used.
        residual: The residual that scores logits.
        penalty: `code -> ` nats per voxel to add; None for no penalty.
        code: A code `[d]`, as an example of its shape.
        own: Part of the objective that differs between objects, as an example of its shapes.
    """

    def price(code, logits, target, weight):
        loss = one_loss("score of the residual", residual.score(logits, target))
        return loss if penalty is None else loss + weight * one_loss("penalty", penalty(code))

    row = jax.eval_shape(lambda own: jax.tree.map(lambda x: x[None], own), own.features)
    logits = jax.eval_shape(model.decode, Prepared(prepared.shared, row), code[None])
    one = vary_like(jnp.zeros(logits.shape[1:], logits.dtype), code)
    priced, constants = hoisted(price, code, one, own.target, own.weight)

    def shape(shared, codes, own):
        network, constants = shared
        logits = model.decode(Prepared(network, own.features), codes)
        prices = jax.vmap(partial(priced, constants))
        losses = prices(codes, logits, own.target, own.weight)
        return logits, losses.astype(codes.dtype)

    def expansion(directions, shared, codes, own_and_chain):
        network, constants = shared
        own, chain = own_and_chain
        prices = jax.vmap(partial(priced, constants))

        def decoded(steps):
            moved = codes + jnp.einsum("nij,nj->ni", chain, steps, precision="highest")
            return moved, model.decode(Prepared(network, own.features), moved)

        def slopes_of(codes, logits):
            losses, pull = jax.vjp(lambda *x: prices(*x, own.target, own.weight), codes, logits)
            return pull(jnp.ones_like(losses)), losses

        found, pull = jax.vjp(decoded, jnp.zeros_like(codes))
        slopes, bend, losses = jax.vjp(slopes_of, *found, has_aux=True)
        # J v is computed as the transpose of the transpose: decoders need reverse-mode derivatives
        # only.
        _, push = jax.vjp(
            lambda cotangents: pull(cotangents)[0], jax.tree.map(jnp.zeros_like, found)
        )
        product = lambda v: pull(bend(push(v)[0]))[0]  # noqa: E731
        slope = pull(slopes)[0]
        return Expansion(losses.astype(codes.dtype), slope, *lanczos(product, slope, directions))

    def expansion_of_one(directions, shared, code, own, chain):
        return of_one_row(partial(expansion, directions), shared, code, (own, chain))

    loss = loss_over_rows(lambda shared, codes, own: shape(shared, codes, own)[1])
    return Evaluation(loss, over_rows(shape), expansion_of_one, (prepared.shared, constants))


def composed(how: Evaluation, space: LatentSpace, own: ObjectTerms) -> Composed:
    """The objective of one object as a function of the points of a space.

    Args:
        how: The scoring of codes.
        space: Coordinates of the search.
        own: Part of the objective that belongs to this object.
    """

    def expansion(point, directions):
        chain = jax.jacobian(space.to_code)(point)
        return how.expansion(directions, how.shared, space.to_code(point), own, chain)

    return Composed(lambda point: how.loss(how.shared, space.to_code(point), own), expansion)


def objective(
    prior: ShapePrior,
    target: PyTree,
    *,
    residual: Residual = BALANCED,
    penalty: Penalty | None = None,
    penalty_weight: Float[Array, ""] | float = 1.0,
    grids: Grids | None = None,
    space: LatentSpace | None = None,
    precision: Precision = "float32",
) -> Callable[[Float[Array, " d"]], Float[Array, ""]]:
    """The objective of one object as a function of its code, for your own loop.

    `jax.vmap` it over codes and, around this call, over objects: the decoder still takes a bounded
    number of codes at a time.

    Args:
        prior: The shape prior.
        target: Target of the object, `residual.target(grids, first_logits)`.
        residual: The residual that the target belongs to.
        penalty: `code [d] -> ` nats per voxel to add to the residual; None for no penalty.
        penalty_weight: Factor of the penalty, 0 or more.
        grids: F and M of the object `[x y z]`, for models whose decoder takes the measurement; None
            for models that decode from the code alone.
        space: Coordinates of the points that the objective takes (`whitened`); None for codes.
        precision: Precision of the decoder's matrix products, `float32` or `bfloat16`.

    Returns:
        `loss(code [d]) -> ` nats per voxel, differentiable; NaN for a code that is not finite. A
        `gauss_newton` search finds its Gauss-Newton matrix, too.

    Raises:
        ValueError: `jax.vmap` batches the parameters of the prior. `loss` raises it for anything
            other than one code of the prior's size.
    """
    batch = None if grids is None else jax.tree.map(lambda x: jnp.asarray(x)[None], grids)
    prepared = prepare_one(prior, batch, precision)
    own = ObjectTerms(pick(prepared.own, 0), target, jnp.asarray(penalty_weight, jnp.float32))
    return objective_of(prior, prepared, own, residual, penalty, space)


def objective_of(
    prior: ShapePrior,
    prepared: Prepared,
    own: ObjectTerms,
    residual: Residual,
    penalty: Penalty | None = None,
    space: LatentSpace | None = None,
) -> Composed:
    """`objective` of a prepared network, which all elements of a batch are known to share.

    Args:
        prior: The shape prior.
        prepared: Its prepared parameters; only the shared ones are used.
        own: Part of the objective that belongs to this object.
        residual: The residual that the target belongs to.
        penalty: `code [d] -> ` nats per voxel to add to the residual; None for no penalty.
        space: Coordinates of the points that the objective takes; None for codes.
    """

    def about(point):
        chosen = raw(prior)._replace(mean=jnp.zeros_like(point)) if space is None else space
        how = evaluation(prior.model, prepared, residual, penalty, chosen.to_code(point), own)
        return composed(how, chosen, own)

    def loss(point):
        point = _one_code(prior, point)
        return about(point)(point)

    def expansion(point, count):
        point = _one_code(prior, point)
        return about(point).expansion(point, count)

    return Composed(loss, expansion)


def _one_code(prior: ShapePrior, code: Float[Array, " d"]) -> Float[Array, " d"]:
    """One code in floating point; `ValueError` for several."""
    code = as_codes(prior, code)
    if code.ndim != 1:
        raise ValueError(
            f"code has shape {code.shape}; the objective takes one code [{prior.code_size}], and"
            " jax.vmap(objective) takes several."
        )
    return code


def prepare_one(prior: ShapePrior, grids: Grids | None, precision: Precision) -> Prepared:
    """Prepare the single network of a search, without gradients to its parameters.

    Args:
        prior: The shape prior.
        grids: F and M of the objects `[b ...]`, or None.
        precision: Precision of the decoder's matrix products.

    Raises:
        ValueError: `jax.vmap` batches the parameters.
    """
    prepared = prior.model.prepare(prior.params, grids, precision)
    return jax.lax.stop_gradient(prepared._replace(shared=one_network(prepared.shared)))
