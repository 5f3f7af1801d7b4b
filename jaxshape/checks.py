"""Checks that refuse wrong values of settings, in one sentence with the given and the valid values.

A settings dataclass calls them in its `__post_init__`. Each raises a `BadSetting`, a `ValueError`
that begins with the name of the field, as in "population is 2; give a whole number, 3 or more.";
the command line replaces the field by the name of its option. Numbers that JAX traces have no value
yet and are not checked.
"""

import math
import sys
from collections.abc import Iterable
from numbers import Integral, Real
from typing import Any, NoReturn

from jaxshape.limits import SEED


class BadSetting(ValueError):
    """A setting has a wrong value.

    Attributes:
        name: Name of the field.
        value: The refused value.
        wanted: Description of valid values, as the end of a sentence that begins with "give".
    """

    def __init__(self, name: str, value: Any, wanted: str) -> None:
        super().__init__(f"{name} is {value!r}; give {wanted}.")
        self.name, self.value, self.wanted = name, value, wanted


def refuse(name: str, value: Any, wanted: str) -> NoReturn:
    """Raise the error for a wrong value of a setting.

    Args:
        name: Name of the field.
        value: The refused value.
        wanted: Description of valid values, as the end of a sentence that begins with "give".

    Raises:
        BadSetting: Always.
    """
    raise BadSetting(name, value, wanted)


def one_of(name: str, value: Any, choices: Iterable[Any]) -> None:
    """Refuse a value that is not one of the choices.

    Args:
        name: Name of the field.
        value: The value to check.
        choices: All values that the field takes.
    """
    choices = tuple(choices)
    if value not in choices:
        refuse(name, value, " or ".join(map(repr, choices)))


def instance(name: str, value: Any, kind: type, source: str) -> None:
    """Refuse an argument of another type; its value may be too large to show.

    Args:
        name: Name of the argument.
        value: The value to check.
        kind: The type that it must have.
        source: What returns such values, as "load_prior".

    Raises:
        ValueError: It has another type.
    """
    if not isinstance(value, kind):
        raise ValueError(
            f"{name} is of type {type(value).__name__}; give a {kind.__name__}, as {source} makes"
            " it."
        )


def whole(name: str, value: Any, least: int, most: int | None = None, why: str = "") -> None:
    """Refuse a value that is not a whole number in a range.

    Args:
        name: Name of the field.
        value: The value to check.
        least: The smallest number it takes.
        most: The largest number it takes; None for any.
        why: Why it takes no larger one, in a few words.
    """
    if not (_is_number(value) and isinstance(value, Integral) and int(value) >= least):
        refuse(name, value, f"a whole number, {least} or more")
    if most is not None and int(value) > most:
        refuse(name, value, f"a whole number, {least} to {most}" + (f": {why}" if why else ""))


def seed(name: str, value: Any) -> None:
    """Refuse a value that is not a seed of random numbers: a whole number of 32 bits.

    Args:
        name: Name of the field.
        value: The value to check.
    """
    whole(name, value, 0, SEED, "random keys have 32 bits")


def positive(name: str, value: Any, unit: str = "") -> None:
    """Refuse a value that is not a finite number above 0.

    Args:
        name: Name of the field.
        value: The value to check.
        unit: Unit in the plural, as "metres"; empty without a unit.
    """
    if not (is_traced(value) or _is_number(value) and 0 < value < math.inf):
        refuse(name, value, f"a number of {unit} above 0" if unit else "a number above 0")


def at_least(name: str, value: Any, least: int | float) -> None:
    """Refuse a value that is not a finite number, `least` or more.

    Args:
        name: Name of the field.
        value: The value to check.
        least: The smallest number it takes.
    """
    if not (is_traced(value) or _is_number(value) and least <= value < math.inf):
        refuse(name, value, f"a number, {least:g} or more")


def within(name: str, value: Any, low: int | float, high: int | float) -> None:
    """Refuse a value that is not a number in a range, limits included.

    Args:
        name: Name of the field.
        value: The value to check.
        low: The smallest number it takes.
        high: The largest number it takes.
    """
    if not (is_traced(value) or _is_number(value) and low <= value <= high):
        refuse(name, value, f"a number from {low:g} to {high:g}")


def is_traced(value: Any) -> bool:
    """Whether JAX traces a value, as under `jax.jit` or `jax.vmap`, so that it is not known yet.

    Args:
        value: Any value. The check does not import JAX.
    """
    core = sys.modules.get("jax.core")
    return core is not None and isinstance(value, core.Tracer)


def _is_number(value: Any) -> bool:
    """Whether a value is a real number or an array of one; NaN is, and fails all comparisons."""
    if hasattr(value, "dtype") and getattr(value, "ndim", None) == 0:
        value = value.item()
    return isinstance(value, Real) and not isinstance(value, bool)
