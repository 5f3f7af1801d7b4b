"""The names of searches, and the function behind each. Nothing here imports JAX.

    family, family:variant                     a module of `methods/`, or an entry point of the
                                               group `jaxshape.methods`
    module:function, package.module:function[@variant]   any function that can be imported

Behind every name is a function `build(variant, dim, config)`. It returns a `Refiner` over points of
dimension `dim` with the settings of a `RefineConfig`, and raises `ValueError` for a variant that it
does not know; `variant` is None for a name without one.
"""

import importlib
import importlib.util
import inspect
import pkgutil
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

GROUP = "jaxshape.methods"
"""Group of the entry points by which packages offer searches: NAME = "package.module:function"."""

Build = Callable[..., Any]


def families() -> list[str]:
    """The families of searches of this package and of installed packages."""
    return sorted({*_own(), *_offered()})


def find_build(name: str) -> tuple[Build, str | None]:
    """The function behind the name of a search, and the variant that it builds.

    Args:
        name: Name of a search.

    Returns:
        The function, and the variant or None.

    Raises:
        ValueError: The search is unknown, or the module in its name cannot be imported.
    """
    family, _, variant = name.partition(":")
    if family in _own():
        module = importlib.import_module(f"{__package__}.methods.{family.replace('-', '_')}")
        return module.build, variant or None
    if family in _offered():
        offered = _offered()[family]
        return _imported(name, offered.module, offered.attr), variant or None
    if variant and ("." in family or (family and importlib.util.find_spec(family))):
        function, _, variant = variant.partition("@")
        return _imported(name, family, function), variant or None
    if name == "encoder":
        raise ValueError(
            f"'encoder' keeps the first code, but a search is needed here; choose from"
            f" {', '.join(families())}."
        )
    raise ValueError(
        f"There is no method {name!r}; choose from {', '.join(families())}, or 'encoder' for no"
        " search at all. Some have variants: cma:ipop, gradient:adam, evosax:Sep_CMA_ES. A function"
        " of your own goes by its import path, package.module:function."
    )


def _own() -> list[str]:
    """The modules of `methods/`, found as files; the `_` of a module is a `-` in its name."""
    folder = Path(__file__).parent / "methods"
    return [module.name.replace("_", "-") for module in pkgutil.iter_modules([str(folder)])]


def _offered() -> dict[str, EntryPoint]:
    """The entry points of installed packages."""
    return {point.name: point for point in entry_points(group=GROUP)}


def _imported(name: str, module: str, function: str) -> Build:
    """A function by its import path."""
    try:
        found = getattr(importlib.import_module(module), function, None)
    except Exception as error:  # a module may raise anything while it is imported
        raise ValueError(
            f"The method {name!r} cannot be imported: {type(error).__name__}: {error}."
        ) from error
    if not callable(found):
        raise ValueError(
            f"The method {name!r} cannot be imported: {module} has no function {function!r}."
        )
    try:
        inspect.signature(found).bind("variant", 1, "config")
    except TypeError as error:
        raise ValueError(
            f"The method {name!r} is no search: {function} takes other arguments than (variant,"
            f" dim, config) ({error})."
        ) from error
    except ValueError:  # Python does not know the arguments of some functions
        pass
    return found
