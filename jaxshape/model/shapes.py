"""The interface of every shape space: three pure functions over a pytree of parameters.

    first code = encode(params, grids)            F and M to a code, once per object
    prepared   = prepare(params, grids, precision)  everything independent of the code, once
    logits     = decode(prepared, codes)            thousands of times

Code outside `jaxshape.model` reaches a network through the `ShapeModel` that a `ShapePrior` carries
with its parameters. `autoencoder` and `pca` are such models; docs/examples shows how to write your
own.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from jaxshape.geometry.grids import Grids
from jaxshape.model.calibration import Calibration
from jaxshape.model.chunks import in_chunks
from jaxshape.model.config import Precision

EXAMPLES_AT_A_TIME = 8
"""Number of codes or grids that go through a model together on CPU: enough for efficient matrix
products, few enough that temporaries stay small."""


class Prepared(NamedTuple):
    """Parameters made ready for many calls of `decode`.

    Attributes:
        shared: Pytree of arrays that all objects share: the network.
        own: Pytree of arrays `[b ...]`, features of each object's own measurement. In a call of
            `decode` with n codes it has n rows, one for each code. Empty for models that decode
            from the code alone.
    """

    shared: PyTree
    own: PyTree = ()


def share_all(params: PyTree, grids: Grids | None, precision: Precision) -> Prepared:
    """The `prepare` of models that have nothing to prepare: it returns the parameters unchanged."""
    del grids, precision
    return Prepared(params)


@jax.tree_util.register_static
@dataclass(frozen=True)
class ShapeModel:
    """A space of shapes. Static under `jax.jit`: models are equal when their functions are.

    Attributes:
        kind: Name of the model, written into its weights files.
        encode: `(params, grids [b ...]) -> codes [b d]`, the first code of each object.
        decode: `(prepared, codes [n d]) -> logits [n x y z]`, occupied where positive.
            Differentiable in the codes.
        prepare: `(params, grids [b ...] | None, precision) -> Prepared`, called once per search.
            `precision` is the precision of the decoder's matrix products. A model that decodes from
            the code alone ignores the grids. None stands for one object of which nothing is known;
            every model takes it, because jaxshape learns the resolution of a model in this way.
        shapes: `params -> ` a tree of `jax.ShapeDtypeStruct` with the same structure, for a model
            of the sizes that the parameters suggest; loading compares weights files with it. None
            compares only the results of `encode` and `decode`.
        conditional: Whether `prepare` needs the grids: the decoder takes the measurement, so that
            the decoded first code already agrees with it.
    """

    kind: str
    encode: Callable[[PyTree, Grids], Float[Array, "b d"]]
    decode: Callable[[Prepared, Float[Array, "n d"]], Float[Array, "n x y z"]]
    prepare: Callable[[PyTree, Grids | None, Precision], Prepared] = share_all
    shapes: Callable[[PyTree], PyTree] | None = None
    conditional: bool = False


class ShapePrior(NamedTuple):
    """A trained shape model, with the distribution of the training codes.

    Attributes:
        model: Functions of the model, static under `jax.jit`.
        params: Parameters of these functions, a pytree of arrays.
        code_mean: Mean code of the training set `[d]`.
        code_covariance: Covariance of the codes of the training set `[d d]`, positive definite. It
            sets the scale of the steps of a search.
        calibration: Map from logits to calibrated probabilities; None if it was not fitted.
    """

    model: ShapeModel
    params: PyTree
    code_mean: Float[Array, " d"]
    code_covariance: Float[Array, "d d"]
    calibration: Calibration | None = None

    @property
    def code_size(self) -> int:
        """Dimension of a code, d."""
        return self.code_mean.shape[-1]

    @property
    def resolution(self) -> int:
        """Voxels along each axis of the grids."""
        return resolution_of(self.model, self.params, self.code_size)


def resolution_of(model: ShapeModel, params: PyTree, code_size: int) -> int:
    """Voxels along each axis of the grids that a model decodes."""
    leaves, structure = jax.tree.flatten(params)
    kinds = tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
    return _resolution(model, structure, kinds, code_size)


@lru_cache  # tracing a decoder takes a fifth of a second
def _resolution(model: ShapeModel, structure: Any, kinds: tuple[Any, ...], code_size: int) -> int:
    def decoded(params):
        prepared = model.prepare(params, None, "float32")
        if not isinstance(prepared, Prepared):
            raise ValueError(
                f"prepare of the model {model.kind!r} returned a {type(prepared).__name__}; it must"
                " return a Prepared(shared, own)."
            )
        return model.decode(prepared, jnp.zeros((1, code_size)))

    shapes = [jax.ShapeDtypeStruct(*kind) for kind in kinds]
    logits = jax.eval_shape(decoded, jax.tree.unflatten(structure, shapes))
    shape = getattr(logits, "shape", ())
    if len(shape) != 4 or shape != (1, *3 * shape[-1:]) or not _is_single(logits.dtype):
        kind = f"{logits.dtype} of shape {shape}" if shape else f"a {type(logits).__name__}"
        raise ValueError(
            f"decode of the model {model.kind!r} returned {kind} for one code; it must return"
            " float32 logits [1, n, n, n], the same number of voxels along each axis."
        )
    return shape[-1]


def _is_single(dtype: Any) -> bool:
    """Whether numbers are floating-point numbers of single precision or better."""
    return jnp.issubdtype(dtype, jnp.floating) and dtype.itemsize >= 4


def encode(prior: ShapePrior, grids: Grids) -> Float[Array, "*batch d"]:
    """The code that a model predicts from a measurement: the start of a search (section 3.1).

    Args:
        prior: The shape prior.
        grids: F and M `[*batch x y z]`, at the prior's resolution.

    Returns:
        One code for each object `[*batch d]`.

    Raises:
        ValueError: The grids are not of the prior's resolution, or its model returns codes of
            another size.
    """
    require_resolution(prior, grids)
    batch = grids.occupied.shape[:-3]
    rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[len(batch) :]), grids)
    count = len(rows.occupied)

    def of_rows(index):
        codes = prior.model.encode(prior.params, pick(rows, index))
        shape, wanted = jnp.shape(codes), (len(index), prior.code_size)
        if shape != wanted:
            raise ValueError(
                f"encode of the model {prior.model.kind!r} returned shape {shape} for"
                f" {len(index)} objects; it must return {wanted}, one code of this prior for each."
            )
        return codes

    return _a_few_at_a_time(of_rows, count).reshape(*batch, -1)


def decode(
    prior: ShapePrior, code: Float[Array, "*batch d"], grids: Grids | None = None
) -> Float[Array, "*batch x y z"]:
    """**Logits** of the occupancy grids of codes; occupied where positive.

    The paper's output in (0, 1) is `jax.nn.sigmoid(logits)`.

    Args:
        prior: The shape prior.
        code: Codes with any leading axes `[*batch d]`, decoded by one call in bounded memory.
        grids: F and M of the objects `[b x y z]`, for models whose decoder takes the measurement;
            the first axis of `code` is then the objects. None for models that decode from the code
            alone.

    Returns:
        Logits of each code `[*batch x y z]`.

    Raises:
        ValueError: The codes are not of the prior's size.
    """
    prepared = prior.model.prepare(prior.params, grids, "float32")
    return decode_prepared(prior.model, prepared, as_codes(prior, code))


def as_codes(prior: ShapePrior, code: Any) -> Float[Array, "*batch d"]:
    """Codes as floating-point numbers, because losses and steps take the type of the code.

    Args:
        prior: The shape prior.
        code: Codes of this prior `[*batch d]`, of any type of number.

    Raises:
        ValueError: The codes are not of the prior's size.
    """
    code, d = jnp.asarray(code), prior.code_size
    if code.shape[-1:] != (d,):
        raise ValueError(
            f"code has shape {code.shape}; the codes of this prior have {d} numbers, so give"
            f" [..., {d}]."
        )
    return code.astype(jnp.result_type(code.dtype, float))


def decode_prepared(
    model: ShapeModel, prepared: Prepared, code: Float[Array, "*batch d"]
) -> Float[Array, "*batch x y z"]:
    """`decode` with parameters that are prepared already.

    Args:
        model: The model that prepared the parameters.
        prepared: Prepared parameters, from `model.prepare`. Where they hold features of b objects,
            the first axis of `code` has b entries.
        code: Codes with any leading axes `[*batch d]`.

    Returns:
        Logits of each code `[*batch x y z]`, occupied where positive.
    """
    batch = code.shape[:-1]
    rows = code.reshape(-1, code.shape[-1])
    owners = len(jax.tree.leaves(prepared.own)[0]) if jax.tree.leaves(prepared.own) else 1
    each = len(rows) // owners

    def of_rows(index):
        own = pick(prepared.own, index // each)
        return model.decode(prepared._replace(own=own), rows[index])

    logits = _a_few_at_a_time(of_rows, len(rows))
    return logits.reshape(*batch, *logits.shape[1:])


def pick(tree: PyTree, index: Int[Array, "*n"] | int) -> PyTree:
    """Rows, or one row, of every array of a tree."""
    return jax.tree.map(lambda x: x[index], tree)


def _a_few_at_a_time(function: Callable[[Int[Array, " n"]], Any], count: int) -> Any:
    """Apply a function to all row indices, on CPU to a few rows at a time."""
    if count <= EXAMPLES_AT_A_TIME:  # the same on every platform: traced once
        return function(jnp.arange(count))
    chunked = partial(in_chunks, function, EXAMPLES_AT_A_TIME)
    return lax.platform_dependent(jnp.arange(count), cpu=chunked, default=function)


def require_resolution(prior: ShapePrior, grids: Grids) -> None:
    """Raise `ValueError` when F or M is not of the prior's resolution."""
    n = prior.resolution
    for name in ("occupied", "occluded"):
        shape = np.shape(getattr(grids, name))
        if shape[-3:] != (n, n, n):
            raise ValueError(
                f"{name} has shape {shape}; this prior knows shapes of {n} x {n} x {n} voxels, "
                f"so give [..., {n}, {n}, {n}] (measure(..., resolution={n}))."
            )
