"""Searches by name, `family` or `family:variant`; a family is a module of this folder.

A module offers `build(variant, dim, config)`, which gives a `Refiner` over points of `dim` numbers
with the settings of a `RefineConfig`, and raises `ValueError` for a variant it does not know. That
is all: the module's name is the method's name everywhere, the command line included.
"""

import importlib
import pkgutil

from jaxshape.search.config import RefineConfig
from jaxshape.search.refiner import Refiner


def families() -> list[str]:
    """The modules of this folder."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def build_refiner(name: str, dim: int, config: RefineConfig) -> Refiner:
    """The search of that name; `ValueError` where there is none."""
    family, _, variant = name.partition(":")
    if family not in families():
        raise ValueError(
            f"There is no method {name!r}; choose from {', '.join(families())}, or 'encoder' for"
            " no search at all. Some have variants: cma:ipop, gradient:adam, evosax:Sep_CMA_ES."
        )
    module = importlib.import_module(f"{__name__}.{family}")
    return module.build(variant or None, dim, config)
