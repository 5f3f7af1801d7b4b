"""The meshes of a collection that are kept out of training. [host]"""

import hashlib
from collections.abc import Sequence

from jaxshape.data.archives import MeshSource

SHARE = 0.1
"""Share of the meshes that are held out."""


def hold_out(sources: Sequence[MeshSource]) -> tuple[list[MeshSource], list[MeshSource]]:
    """Divide meshes into those to train on, and about every tenth, but at least one, held out.

    The side depends on the name alone: a mesh stays on its side when others join the collection, so
    that training can go on from earlier weights and never meets a mesh it is scored on.

    Args:
        sources: Meshes of the collection, two or more.

    Returns:
        The meshes to train on, and those held out.

    Raises:
        ValueError: There are fewer than two meshes.
    """
    if len(sources) < 2:
        raise ValueError(
            f"There is {len(sources)} mesh; give two or more, to train on some and score on others."
        )
    by_mark = sorted(sources, key=_mark)
    marked = sum(_mark(source) < SHARE for source in sources)
    held_out = by_mark[: min(max(marked, 1), len(sources) - 1)]
    return [source for source in sources if source not in held_out], held_out


def _mark(source: MeshSource) -> float:
    """A number from 0 to 1 that is spread evenly over names."""
    return int.from_bytes(hashlib.sha256(source.name.encode()).digest()[:8]) / 2**64
