"""Objects of a scene keep their numbers while clusters appear, join and part. [host]"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxshape.mapping.scene.world import Cluster, keys_of

SAME = 0.3
"""Least share of common cells in the smaller of an object and a cluster for both to be the same."""

SWALLOWED = 0.5
"""Least share of an object in the cluster of another object for both to be one object."""


class Thing(NamedTuple):
    """An object of a scene, as the cells that it fills.

    Attributes:
        number: Its number, from 1, which it keeps.
        keys: Keys of its cells, rising `[n]`.
        index: Indices of its cells `[n 3]`.
        is_moved: Whether it appeared or vanished while the room was filmed.
        is_on_top: Whether it stands on a table.
        is_numbered: Whether masks give its number, and its pixels.
    """

    number: int
    keys: Int[np.ndarray, " n"]
    index: Int[np.ndarray, "n 3"]
    is_moved: bool
    is_on_top: bool
    is_numbered: bool = False


class Tracks(NamedTuple):
    """The objects that are tracked in a scene, and what became of them.

    Attributes:
        things: The objects.
        events: What appeared, was joined, parted, moved or vanished, in sentences.
        numbers: Count of the numbers given so far.
    """

    things: tuple[Thing, ...] = ()
    events: tuple[str, ...] = ()
    numbers: int = 0


def associate(before: Tracks, clusters: Sequence[Cluster]) -> Tracks:
    """Data association: assign the clusters of the scene to the tracked objects.

    Pairs of an object and a cluster are formed in the order of the number of cells that they share.
    So if a cluster covers two objects, the object with more cells in it stays; and if an object is
    covered by two clusters, the one with more of its cells is that object. Clusters that are left
    over are new objects.

    Args:
        before: The objects so far.
        clusters: All that stands in the room now.

    Returns:
        The objects, which keep their numbers.
    """
    keys = [np.sort(keys_of(one.index)) for one in clusters]
    shared = np.array(
        [[len(np.intersect1d(one.keys, k, assume_unique=True)) for k in keys]
         for one in before.things], int,
    ).reshape(len(before.things), len(keys))  # fmt: skip
    least = np.array(
        [[min(len(one.keys), len(k)) for k in keys] for one in before.things], int
    ).reshape(shared.shape)
    same = _matched(shared, least)
    events, things, numbers = [], [], before.numbers
    for j, cluster in enumerate(clusters):
        i = same.get(j)
        if i is None:
            numbers += 1
            number = numbers
            events.append(_appeared(number, shared[:, j], before, len(keys[j])))
        else:
            number = before.things[i].number
            if cluster.is_moved and not before.things[i].is_moved:
                events.append(f"Object {number} was moved while it was filmed, and is left out.")
        things.append(
            Thing(number, keys[j], clusters[j].index, cluster.is_moved, cluster.is_on_top)
        )
    number_of = {j: things[j].number for j in range(len(things))}
    for i, one in enumerate(before.things):
        if i not in same.values():
            events.append(_vanished(one, shared[i], number_of))
    return Tracks(tuple(things), (*before.events, *events), numbers)


def _matched(
    shared: Int[np.ndarray, "thing cluster"], least: Int[np.ndarray, "thing cluster"]
) -> dict[int, int]:
    """The object of each cluster; pairs that share most cells are matched first."""
    found: dict[int, int] = {}
    order = np.argsort(-shared, axis=None, kind="stable")
    for i, j in zip(*np.unravel_index(order, shared.shape), strict=True):
        enough = shared[i, j] > 0 and shared[i, j] >= SAME * least[i, j]
        if enough and int(j) not in found and int(i) not in found.values():
            found[int(j)] = int(i)
    return found


def _appeared(number: int, shared: Int[np.ndarray, " thing"], before: Tracks, size: int) -> str:
    if len(shared) and shared.max() > SAME * size:
        return (
            f"Object {number} was split from object {before.things[int(shared.argmax())].number}."
        )
    return f"Object {number} appeared."


def _vanished(one: Thing, shared: Int[np.ndarray, " cluster"], number_of: dict[int, int]) -> str:
    if len(shared) and shared.max() > SWALLOWED * len(one.keys):
        return f"Object {one.number} is a part of object {number_of[int(shared.argmax())]}."
    return f"Object {one.number} does not exist: later frames see through it."
