"""`help()` of every public name says what each argument and each result field is."""

import ast
import doctest
import enum
import importlib
import inspect
import pkgutil
import re
import textwrap
import typing
from pathlib import Path

import pytest

import jaxshape as js

PACKAGE = Path(js.__file__).parent
SECTIONS = ("Args", "Attributes", "Raises", "Returns", "Yields")


def entries(text: str | None, section: str) -> dict[str, str]:
    """The entries of a section of a Google-style docstring, and what each says."""
    lines = inspect.cleandoc(text or "").splitlines()
    found, name, inside = {}, "", False
    for line in lines:
        if not line.startswith(" ") and line:
            inside = line == f"{section}:"
        elif inside and (begun := re.match(r"    (\*{0,2}\w+): (.*)", line)):
            name = begun[1].lstrip("*")
            found[name] = begun[2]
        elif inside and name:
            found[name] += " " + line.strip()
    return found


def is_field_class(value: object) -> bool:
    """Whether a value is a class of the package that holds fields: a NamedTuple or dataclass."""
    return inspect.isclass(value) and value.__module__.startswith("jaxshape") and bool(fields(value))


def fields(cls: type) -> list[str]:
    """The fields of a class; the members of an enumeration."""
    if issubclass(cls, enum.Enum):
        return list(cls.__members__)
    return list(getattr(cls, "_fields", ()) or getattr(cls, "__dataclass_fields__", ()))


def classes_in(annotation: object) -> list[type]:
    """The classes with fields that an annotation names, at any depth."""
    if is_field_class(annotation):
        return [annotation]
    return [cls for inner in typing.get_args(annotation) for cls in classes_in(inner)]


def public_functions() -> dict[str, typing.Callable]:
    """The public functions by name."""
    return {name: x for name in js.__all__ if inspect.isfunction(x := getattr(js, name))}


def documented_classes() -> dict[str, type]:
    """The public classes, and those that public functions take or return."""
    found = [x for name in js.__all__ if is_field_class(x := getattr(js, name))]
    for function in public_functions().values():
        for annotation in typing.get_type_hints(inspect.unwrap(function)).values():
            found += classes_in(annotation)
    return {f"{cls.__module__}.{cls.__qualname__}": cls for cls in found}


def methods() -> dict[str, object]:
    """The public methods and properties of these classes."""
    return {
        f"{name}.{attribute}": member
        for name, cls in documented_classes().items()
        for attribute, member in vars(cls).items()
        if not attribute.startswith("_")
        and isinstance(member, (property, classmethod, staticmethod)) or inspect.isfunction(member)
        and not attribute.startswith("_")
    }
