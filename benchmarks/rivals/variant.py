"""The form in which registrations are compared."""

from collections.abc import Callable
from typing import Any, NamedTuple


class Variant(NamedTuple):
    """One way to use a library: what is done once for each frame, and for each pair."""

    prepare: Callable[..., Any]
    """(depth, (fx, fy, cx, cy)) -> what `align` needs of a frame."""
    align: Callable[..., Any]
    """(reference, frame) -> T_reference_frame as a matrix, from a guess that nothing moved."""
