"""Batched functions, applied to a few examples at a time so that temporaries stay small."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, PyTree


def in_chunks(function: Callable[..., PyTree], size: int, *examples: Array) -> PyTree:
    """Apply a batched function to at most `size` examples at a time.

    All chunks have the same size, so that the function is compiled once; zeros pad the last one,
    and their results are dropped.
    """
    b = examples[0].shape[0]
    chunks = _count(b, size)
    if chunks <= 1:
        return function(*examples)
    each = -(-b // chunks)
    out = lax.map(lambda x: function(*x), [_split(x, chunks, each) for x in examples])
    return jax.tree.map(lambda x: x.reshape(chunks * each, *x.shape[2:])[:b], out)


def sum_chunks(function: Callable[..., Array], size: int, *examples: Array) -> Array:
    """Sum a batched function over at most `size` examples at a time, in float32.

    The function must be additive over examples, and 0 for examples of zeros.
    """
    chunks = _count(examples[0].shape[0], size)
    each = -(-examples[0].shape[0] // max(chunks, 1))
    split = [_split(x, chunks, each) for x in examples]
    out: Any = jax.eval_shape(function, *[x[0] for x in split])
    add = lambda total, chunk: (total + function(*chunk), None)  # noqa: E731
    total, _ = lax.scan(add, vary_like(jnp.zeros(out.shape, jnp.float32), split[0]), split)
    return total


def vary_like(tree: PyTree, example: Array) -> PyTree:
    """The same arrays, marked as varying over the `jax.shard_map` axes that an example varies over.

    The first state of a loop must have the type of the later ones, and under `jax.shard_map` the
    type includes the mesh axes along which an array may differ.

    Args:
        tree: Tree of arrays, which may be constants.
        example: An array that belongs to the examples.
    """
    axes = _axes_of(example)

    def vary(x):
        missing = tuple(axes - _axes_of(x))
        return lax.pcast(jnp.asarray(x), missing, to="varying") if missing else x

    return jax.tree.map(vary, tree)


def _axes_of(x: Any) -> frozenset[str]:
    """Axes along which an array may differ; their name depends on the version of JAX."""
    kind: Any = jax.typeof(x)
    return kind.vma if hasattr(kind, "vma") else kind.manual_axis_type.varying


def _count(b: int, size: int) -> int:
    """Number of chunks of at most `size` of b examples.

    It is the lowest one, or one up to a half higher that divides b: filling up the last chunk
    copies all examples.
    """
    fewest = -(-b // size)
    even = (n for n in range(fewest, fewest * 3 // 2 + 1) if n and b % n == 0)
    return next(even, fewest)


def _split(x: Array, chunks: int, each: int) -> Array:
    filled = jnp.pad(x, [(0, chunks * each - x.shape[0])] + [(0, 0)] * (x.ndim - 1))
    return filled.reshape(chunks, each, *x.shape[1:])
