"""The objective of a search: shape model, residual and penalty as one function of a code."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxshape.geometry.grids import Grids
from jaxshape.model.shapes import Precision, Prepared, ShapeModel, ShapePrior, pick
from jaxshape.search.residuals import BALANCED, Residual
from jaxshape.search.rows import hoisted, loss_over_rows, one_network, over_rows

# What a code costs besides its residual, in nats per voxel.
Penalty = Callable[[Float[Array, " d"]], Float[Array, ""]]


class Evaluation(NamedTuple):
    """Scoring of codes, for any objects.

    Attributes:
        loss: `(shared, code [d], own) -> loss`, under any `jax.vmap`s and `jax.grad`; `own` holds
            the features and the target of the code's object.
        shape: `(shared, codes [n d], own [m ...], owner [n]) -> logits [n x y z], losses [n]`.
        shared: Arrays that all objects share: prepared parameters, and the constants of the
            penalty.
    """

    loss: Callable[..., Float[Array, ""]]
    shape: Callable[..., tuple[Array, Array]]
    shared: PyTree


def evaluation(
    model: ShapeModel,
    prepared: Prepared,
    residual: Residual,
    penalty: Penalty | None,
    code: Float[Array, " d"],
    own: tuple[PyTree, PyTree],
) -> Evaluation:
    """Join a model, a residual and a penalty.

    Args:
        model: The shape model.
        prepared: Its parameters; only the shared ones are used.
        residual: The residual that scores logits.
        penalty: `code -> ` nats per voxel to add; None for no penalty.
        code: A code `[d]`, as an example of its shape.
        own: Features and target of an object, as examples of their shapes.
    """

    def price(code, logits, target):
        loss = residual.score(logits, target)
        return loss if penalty is None else loss + penalty(code)

    row = jax.eval_shape(lambda own: jax.tree.map(lambda x: x[None], own), own[0])
    logits = jax.eval_shape(model.decode, Prepared(prepared.shared, row), code[None])
    one = jax.ShapeDtypeStruct(logits.shape[1:], logits.dtype)
    priced, constants = hoisted(price, code, one, own[1])

    def shape(shared, codes, own):
        network, constants = shared
        features, target = own
        logits = model.decode(Prepared(network, features), codes)
        losses = jax.vmap(priced, (None, 0, 0, 0))(constants, codes, logits, target)
        return logits, losses.astype(codes.dtype)

    loss = loss_over_rows(lambda shared, codes, own: shape(shared, codes, own)[1])
    return Evaluation(loss, over_rows(shape), (prepared.shared, constants))


def objective(
    prior: ShapePrior,
    target: PyTree,
    *,
    residual: Residual = BALANCED,
    penalty: Penalty | None = None,
    grids: Grids | None = None,
    precision: Precision = "float32",
) -> Callable[[Float[Array, " d"]], Float[Array, ""]]:
    """The objective of one object as a function of its code, for your own loop.

    `jax.vmap` it over codes and, around this call, over objects: all of them still go through the
    decoder a bounded number at a time.

    Args:
        prior: The shape prior.
        target: Target of the object, `residual.target(grids, first_logits)`.
        residual: The residual that the target belongs to.
        penalty: `code [d] -> ` nats per voxel to add to the residual; None for no penalty.
        grids: F and M of the object `[x y z]`, for models whose decoder takes the measurement; None
            for models that decode from the code alone.
        precision: Precision of the decoder's matrix products, `float32` or `bfloat16`.

    Returns:
        `loss(code [d]) -> ` nats per voxel, differentiable; NaN for a code that is not finite.

    Raises:
        ValueError: `jax.vmap` batches the parameters of the prior.
    """
    batch = None if grids is None else jax.tree.map(lambda x: jnp.asarray(x)[None], grids)
    prepared = prepare_one(prior, batch, precision)
    own = pick(prepared.own, 0), target

    def loss(code):
        how = evaluation(prior.model, prepared, residual, penalty, code, own)
        return how.loss(how.shared, code, own)

    return loss


def prepare_one(prior: ShapePrior, grids: Grids | None, precision: Precision) -> Prepared:
    """Prepare the one network of a search, as a constant of its derivatives.

    Args:
        prior: The shape prior.
        grids: F and M of the objects `[b ...]`, or None.
        precision: Precision of the decoder's matrix products.

    Raises:
        ValueError: `jax.vmap` batches the parameters.
    """
    prepared = prior.model.prepare(prior.params, grids, precision)
    return jax.lax.stop_gradient(prepared._replace(shared=one_network(prepared.shared)))
