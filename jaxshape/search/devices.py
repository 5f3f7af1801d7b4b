"""Objects spread over devices. They share nothing, so that no device waits for another.

`over_devices` is a `jax.shard_map` over all devices of the process, without a collective. It is
part of `refine`, `reconstruct` and `evaluate`. Under a `jax.shard_map` of yours it does nothing,
and in a mesh of yours it spreads the objects over that.
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

    Where devices cannot share the rows equally, some are worked out twice. The results of an eager
    call, and of a `jax.jit` around it, lie on all these devices.

    Args:
        function: Pure; returns a tree of arrays with the same leading axis as the rows.
        shared: Tree of arrays, or of numbers, that all rows share.
        rows: Tree of arrays with an axis over objects first.
        devices: Number of this process's devices to use, 1 or more; None for all, or for the one on
            which you have put an array. In a mesh of yours, it says nothing.

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
    """Numbers of the objects of this device in the whole batch.

    Copies that pad the last device are numbered after the objects of the batch.

    Args:
        count: Objects of this device.
    """
    axes = jax.sharding.get_abstract_mesh().manual_axes
    return jnp.arange(count) + (lax.axis_index(axes) * count if axes else 0)


def _mesh_of(rows: PyTree) -> tuple[AbstractMesh, tuple[str, ...]]:
    """The mesh that is set, or that the type of an array names, and the axes to spread over.

    They are the axes that objects are spread over already, or all. Without a mesh it is empty.
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
    """`function(shared, rows)`, with the rows filled up and spread over axes of a mesh."""
    count = len(jax.tree.leaves(rows)[0])
    number = prod(mesh.shape[axis] for axis in axes)
    size = -(-count // number) * number
    explicit = AxisType.Explicit in mesh.axis_types
    split, everywhere = PartitionSpec(axes), PartitionSpec()

    def place(tree, spec):
        """Arrays of an explicit mesh are moved by hand."""
        to = NamedSharding(mesh, spec)
        return jax.tree.map(lambda x: jax.sharding.reshard(x, to), tree) if explicit else tree

    if size > count:
        rows = jax.tree.map(lambda x: x[jnp.arange(size) % count], place(rows, everywhere))
    # Searches of other packages loop over states that do not say where they differ.
    spread = jax.shard_map(
        function, mesh=mesh, in_specs=(everywhere, split), out_specs=split, check_vma=False
    )
    found = jax.jit(spread)(place(shared, everywhere), place(rows, split))
    if size == count:
        return found
    return jax.tree.map(lambda x: x[:count], place(found, everywhere))
