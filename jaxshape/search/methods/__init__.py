"""Searches by name; `names.py` says which names there are.

A module of this folder is a family of searches: its name is the method's name everywhere, the
command line included, and its `build(variant, dim, config)` gives the search. A function of another
package is named by its import path or by an entry point.
"""

from jaxshape.search.config import RefineConfig
from jaxshape.search.names import find_build
from jaxshape.search.refiner import Refiner


def build_refiner(name: str, dim: int, config: RefineConfig) -> Refiner:
    """Build a search by its name.

    Args:
        name: `family` or `family:variant`, as in "cma", "cma:ipop" and "gradient:adam", or
            `package.module:function`, the import path of a function that takes
            `(variant, dim, config)`.
        dim: Dimension of the search space, 1 or more.
        config: Settings of the search.

    Returns:
        The search.

    Raises:
        ValueError: The search is unknown or refuses its settings, or the function cannot be
            imported or does not return a search.
    """
    build, variant = find_build(name)
    refiner = build(variant, dim, config)
    if not isinstance(refiner, Refiner):
        raise ValueError(
            f"The method {name!r} returned {type(refiner).__name__}; it must return a"
            " jaxshape.Refiner."
        )
    return refiner
