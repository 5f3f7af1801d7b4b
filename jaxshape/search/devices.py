"""Objects spread over devices. They share nothing, so that no device waits for another.

`over_devices` is a `jax.shard_map` over all devices of the process, without a collective. It is
part of `refine`, `reconstruct` and `evaluate`. Inside your own `jax.shard_map` it does nothing;
inside your own mesh it spreads the objects over that mesh.
"""

from collections.abc import Callable
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.sharding import AbstractMesh, AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int, PyTree

from jaxshape.checks import whole

AXIS = "objects"
"""Name of the axis of our own mesh."""


def over_devices(
    function: Callable[[PyTree, PyTree], PyTree],
    shared: PyTree,
    rows: PyTree,
    devices: int | None = None,
) -> PyTree:
    """`function(shared, rows)`, with the rows spread over devices.

    If the rows do not divide evenly among the devices, some rows are computed twice. The results of
    an eager call, and of a `jax.jit` around it, lie on all these devices.

    Args:
        function: Pure; returns a tree of arrays with the same leading axis as the rows.
        shared: Tree of arrays, or of numbers, that all rows share.
        rows: Tree of arrays whose first axis is over objects.
        devices: Number of this process's devices to use, 1 or more; None for all, or for the one on
            which you have put an array. It is ignored inside your own mesh.

    Raises:
        ValueError: `devices` is not a whole number, or is below 1.
    """
    if devices is not None:
        whole("devices", devices, 1)
    mesh, axes = _mesh_of(rows)
    if mesh.manual_axes:
        return function(shared, rows)
    if not mesh.empty:
        return _spread(function, shared, rows, mesh, axes)
    local, count = jax.local_devices()[:devices], len(jax.tree.leaves(rows)[0])
    if min(len(local), count) == 1 or any(map(_is_committed, jax.tree.leaves((shared, rows)))):
        return function(shared, rows)
    return _spread(function, shared, rows, Mesh(np.array(local), (AXIS,)), (AXIS,))


def numbers(count: int) -> Int[Array, " object"]:
    """Indices, in the whole batch, of the objects on this device.

    Copies that pad the last device are numbered after the objects of the batch.

    Args:
        count: Objects of this device.
    """
    axes = jax.sharding.get_abstract_mesh().manual_axes
    return jnp.arange(count) + (lax.axis_index(axes) * count if axes else 0)


def _mesh_of(rows: PyTree) -> tuple[AbstractMesh, tuple[str, ...]]:
    """The current mesh, or the mesh in the type of an array, and the axes to spread objects over.

    The axes are those over which the objects are already spread, or else all axes of the mesh. If
    there is no mesh, an empty one is returned.
    """
    mesh, first = jax.sharding.get_abstract_mesh(), None
    for x in jax.tree.leaves(rows):
        placed = jax.typeof(x).sharding
        mesh = placed.mesh if mesh.empty else mesh
        first = first or (placed.spec[0] if placed.spec else None)
    axes = first if isinstance(first, tuple | None) else (first,)
    return mesh, axes or mesh.axis_names


def _is_committed(x: Any) -> bool:
    """Whether the caller has put an array on one device; unknown for a traced array."""
    is_known = isinstance(x, jax.Array) and not isinstance(x, Tracer)
    return is_known and x.committed and len(x.devices()) == 1


def _spread(
    function: Callable[[PyTree, PyTree], PyTree],
    shared: PyTree,
    rows: PyTree,
    mesh: Any,
    axes: tuple[str, ...],
) -> PyTree:
    """`function(shared, rows)`, with the rows padded and spread over axes of a mesh."""
    count = len(jax.tree.leaves(rows)[0])
    number = prod(mesh.shape[axis] for axis in axes)
    size = -(-count // number) * number
    explicit = AxisType.Explicit in mesh.axis_types
    split, everywhere = PartitionSpec(axes), PartitionSpec()

    def place(tree, spec):
        """Reshard the arrays of an explicit mesh, which JAX does not do by itself."""
        to = NamedSharding(mesh, spec)
        return jax.tree.map(lambda x: jax.sharding.reshard(x, to), tree) if explicit else tree

    if size > count:
        rows = jax.tree.map(lambda x: x[jnp.arange(size) % count], place(rows, everywhere))
    # Searches of other packages have loop states that do not declare the mesh axes they vary over.
    spread = jax.shard_map(
        function, mesh=mesh, in_specs=(everywhere, split), out_specs=split, check_vma=False
    )
    found = jax.jit(spread)(place(shared, everywhere), place(rows, split))
    if size == count:
        return found
    return jax.tree.map(lambda x: x[:count], place(found, everywhere))
