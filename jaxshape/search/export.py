"""A reconstruction compiled ahead of time: a program that another process runs without tracing it.

The file holds the program for CPUs and for GPUs, but no weights: these are arguments. It is
exported for a fixed number of objects per batch, which bounds the memory of a search, and processes
any number of objects in such batches.
"""

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
from jaxtyping import Array, Key

from jaxshape.checks import whole
from jaxshape.geometry.grids import Grid, Grids
from jaxshape.model.shapes import ShapePrior
from jaxshape.search.config import RefineConfig
from jaxshape.search.keys import one_key_each
from jaxshape.search.reconstruction import Reconstruction, reconstruct, require_batch
from jaxshape.search.refiner import Distribution, Refiner, Trace

PLATFORMS = ("cpu", "cuda")

for _result in (Reconstruction, Trace, Distribution):
    jax.export.register_namedtuple_serialization(
        _result, serialized_name=f"jaxshape.{_result.__name__}"
    )


def export_reconstruct(
    prior: ShapePrior,
    refiner: Refiner | None,
    config: RefineConfig,
    *,
    objects: int = 1,
    soft: bool = True,
    platforms: Sequence[str] = PLATFORMS,
) -> bytes:
    """Export `reconstruct` as a program for other processes (`load_reconstruct`).

    Args:
        prior: The shape prior. The program accepts any other prior of the same model and sizes.
        refiner: The search (`refiner_for`); None keeps the first code.
        config: Settings of the search.
        objects: Objects that are searched together, 1 or more.
        soft: Whether F and M are soft, as signed distances give them, or binary.
        platforms: Platforms on which the program can run, by JAX's names.

    Returns:
        The content of a file.

    Raises:
        ValueError: `objects` is not a whole number, or is below 1.
        ModuleNotFoundError: flatbuffers is not installed.
    """
    whole("objects", objects, 1)
    _require_flatbuffers()
    leaves, structure = jax.tree.flatten(prior)

    def program(leaves, keys, occupied, occluded):
        prior = jax.tree.unflatten(structure, leaves)
        keys = jax.random.wrap_key_data(keys)
        return reconstruct(keys, prior, occupied, occluded, refiner, config, devices=1)

    shape = jax.ShapeDtypeStruct
    keys = shape((objects, *jax.random.key_data(jax.random.key(0)).shape), jnp.uint32)
    grid = shape((objects, *[prior.resolution] * 3), jnp.float32 if soft else bool)
    shapes = [shape(jnp.shape(x), jnp.result_type(x)) for x in leaves]
    exported = jax.export.export(jax.jit(program), platforms=platforms)(shapes, keys, grid, grid)
    return bytes(exported.serialize())


def load_reconstruct(content: bytes) -> Callable[..., Reconstruction]:
    """Load a program that `export_reconstruct` has made.

    Nothing is traced. The program is compiled at its first call, or taken from JAX's cache of
    compiled programs.

    Args:
        content: The content of the file.

    Returns:
        `run(key, prior, occupied [object x y z], occluded [object x y z])`, which returns the
        result of `reconstruct` for any number of objects.

    Raises:
        ModuleNotFoundError: flatbuffers is not installed.
    """
    _require_flatbuffers()
    exported = jax.export.deserialize(bytearray(content))
    grid, call = exported.in_avals[-1], jax.jit(exported.call)
    at_a_time = grid.shape[0]

    def run(
        key: Key[Array, "*object"], prior: ShapePrior, occupied: Grid, occluded: Grid
    ) -> Reconstruction:
        require_batch(Grids(occupied, occluded))
        count = len(occupied)
        keys = jax.random.key_data(one_key_each(key, count))

        def batch(start: int) -> Any:
            """The results of one batch; the last batch is padded with its own objects."""
            some = jnp.arange(start, min(start + at_a_time, count))
            rows = some[jnp.arange(at_a_time) % len(some)]
            F, M = (jnp.asarray(x, grid.dtype)[rows] for x in (occupied, occluded))
            found = call(jax.tree.leaves(prior), keys[rows], F, M)
            return jax.tree.map(lambda x: x[: len(some)], found)

        found = [batch(start) for start in range(0, count, at_a_time)]
        return jax.tree.map(lambda *x: jnp.concatenate(x), *found)

    return run


def _require_flatbuffers() -> None:
    """Raise `ModuleNotFoundError` without the package that JAX needs to serialise programs."""
    if find_spec("flatbuffers") is None:
        raise ModuleNotFoundError(
            "Programs are written with flatbuffers, which is not installed:"
            " pip install 'jaxshape[export]'."
        )
