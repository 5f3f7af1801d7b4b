"""Random keys: one for each object of a batch."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxshape.model.shapes import ShapePrior


def keys_of(
    keys: Key[Array, "*object"], codes: Float[Array, "object d"], prior: ShapePrior
) -> Key[Array, " object"]:
    """One key for each code, from one for each or one for all.

    Args:
        keys: One key for each code `[object]`, or one for all.
        codes: Codes of the objects `[object d]`.
        prior: The shape prior.

    Raises:
        ValueError: The number of keys is neither 1 nor that of the codes, or codes have another
            size.
    """
    shape = jnp.shape(codes)
    if len(shape) != 2 or shape[-1] != prior.code_size:
        raise ValueError(
            f"codes have shape {shape}; give [object, {prior.code_size}], one code for each "
            "object of the batch (code[None] for one object)."
        )
    return one_key_each(keys, len(codes))


def one_key_each(keys: Key[Array, "*object"], count: int) -> Key[Array, " object"]:
    """One key for each object, from one for each or one for all.

    Args:
        keys: One key for each object `[object]`, or one for all.
        count: Number of objects.

    Raises:
        ValueError: The number of keys is neither 1 nor that of the objects, or they are not keys.
    """
    if not hasattr(keys, "dtype"):
        raise ValueError(f"keys is {keys!r}; give random keys, as jax.random.key(0).")
    if not jnp.issubdtype(keys.dtype, jax.dtypes.prng_key):
        try:
            keys = jax.random.wrap_key_data(keys)
        except (TypeError, ValueError):
            raise ValueError(
                f"keys are {keys.dtype} numbers of shape {keys.shape}; give random keys, as "
                "jax.random.key(0)."
            ) from None
    if keys.ndim == 0:
        return jax.random.split(keys, count)
    if keys.shape != (count,):
        raise ValueError(
            f"There are keys of shape {keys.shape} for {count} objects; give one for each, "
            "jax.random.split(key, objects), or a single one."
        )
    return keys
