"""`help()` of every public name says what each argument and each field of a result is.

Docstrings have Google's sections: an entry of `Args:` for each parameter, one of `Attributes:` for
each field.
"""

import ast
import doctest
import enum
import importlib
import inspect
import re
import textwrap
import typing
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import jaxshape as js

PACKAGE = Path(js.__file__).parent

FEWEST_WORDS = 3
"""A shorter entry says no more than the name of the argument."""


# Sections --------------------------------------------------------------------------------------


def section(docstring: str | None, name: str) -> str:
    """The text of a section of a docstring; empty where it has none."""
    found = re.search(
        rf"^{name}:\n((?:    .*\n|\n)*)", inspect.cleandoc(docstring or "") + "\n", re.M
    )
    return textwrap.dedent(found[1]) if found else ""


def entries(docstring: str | None, name: str) -> dict[str, str]:
    """The entries of a section, and what each of them says."""
    begun = re.split(r"^\*{0,2}(\w+): ", section(docstring, name), flags=re.M)
    return dict(zip(begun[1::2], begun[2::2], strict=True))


def too_short(documented: dict[str, str]) -> list[str]:
    return [name for name, text in documented.items() if len(text.split()) < FEWEST_WORDS]


def test_entries_are_read_over_several_lines():
    docstring = """Summary.

    Args:
        first: One line,
            and another: with a colon.
        **rest: More.

    Returns:
        Nothing.
    """
    found = entries(docstring, "Args")
    assert list(found) == ["first", "rest"]
    assert found["first"].split() == "One line, and another: with a colon.".split()
    assert section(docstring, "Returns").strip() == "Nothing."


# Public names ----------------------------------------------------------------------------------


def fields_of(cls: type) -> list[str]:
    """The fields of a NamedTuple or a dataclass, or the members of an enumeration."""
    if issubclass(cls, enum.Enum):
        return list(cls.__members__)
    return list(getattr(cls, "_fields", ()) or getattr(cls, "__dataclass_fields__", ()))


def holds_fields(value: object) -> bool:
    """Whether a value is a class of the package that has fields."""
    if not isinstance(value, type) or not value.__module__.startswith("jaxshape"):
        return False
    return bool(fields_of(value))


def classes_in(annotation: object) -> Iterator[type]:
    """The classes with fields that an annotation names."""
    if isinstance(annotation, type) and holds_fields(annotation):
        yield annotation
    for inner in typing.get_args(annotation):
        yield from classes_in(inner)


def hints_of(function: Callable) -> dict[str, object]:
    return typing.get_type_hints(inspect.unwrap(function))


PUBLIC = {name: getattr(js, name) for name in js.__all__}
FUNCTIONS = {name: x for name, x in PUBLIC.items() if callable(x) and not isinstance(x, type)}
CLASSES = {
    cls.__name__: cls
    for cls in [
        *filter(holds_fields, PUBLIC.values()),
        *(c for f in FUNCTIONS.values() for hint in hints_of(f).values() for c in classes_in(hint)),
    ]
}
"""The public classes, and those that public functions take or return."""

METHODS = {
    f"{name}.{key}": getattr(member, "fget", member)
    for name, cls in CLASSES.items()
    for key, member in vars(cls).items()
    if not key.startswith("_")
    and key not in fields_of(cls)
    and (inspect.isfunction(member) or isinstance(member, property))
}


def parameters_of(function: typing.Any) -> list[str]:
    return [name for name in inspect.signature(function).parameters if name not in ("self", "cls")]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_argument_of_a_public_function_is_documented(name):
    documented = entries(FUNCTIONS[name].__doc__, "Args")
    assert list(documented) == parameters_of(FUNCTIONS[name])
    assert too_short(documented) == []


@pytest.mark.parametrize("name", METHODS)
def test_every_argument_of_a_public_method_is_documented(name):
    assert METHODS[name].__doc__
    documented = entries(METHODS[name].__doc__, "Args")
    assert list(documented) == parameters_of(METHODS[name])
    assert too_short(documented) == []


@pytest.mark.parametrize("name", CLASSES)
def test_every_field_of_a_public_class_is_documented(name):
    documented = entries(CLASSES[name].__doc__, "Attributes")
    assert list(documented) == fields_of(CLASSES[name])
    assert too_short(documented) == []


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_result_of_a_public_function_is_documented(name):
    docstring, result = FUNCTIONS[name].__doc__, hints_of(FUNCTIONS[name])["return"]
    is_said = section(docstring, "Returns") or section(docstring, "Yields")
    assert is_said or result is type(None) or any(True for _ in classes_in(result))


@pytest.mark.parametrize("name", FUNCTIONS | CLASSES)
def test_errors_that_public_names_raise_are_documented(name):
    """Those that stand in their own code; they may document more."""
    value = FUNCTIONS.get(name) or CLASSES[name]
    check = value if name in FUNCTIONS else vars(value).get("__post_init__")
    raised = raised_by(check) if check else set()
    if name in CLASSES and check:
        raised = {"ValueError"}  # by the checks of settings
    assert raised <= entries(value.__doc__, "Raises").keys()


def raised_by(function: Callable) -> set[str]:
    """The names of the exceptions that a function makes and raises itself."""
    source = textwrap.dedent(inspect.getsource(inspect.unwrap(function)))
    made = [x.exc for x in ast.walk(ast.parse(source)) if isinstance(x, ast.Raise)]
    return {ast.unparse(x.func) for x in made if isinstance(x, ast.Call)}


@pytest.mark.parametrize("name", sorted(PUBLIC.keys() - FUNCTIONS.keys() - CLASSES.keys()))
def test_public_constants_are_explained(name):
    """`help()` of a constant shows the docstring of its class."""
    assert f"`{name}`" in (type(PUBLIC[name]).__doc__ or "")


# The whole package -----------------------------------------------------------------------------

FILES = sorted(PACKAGE.rglob("*.py"))


def nodes(path: Path, kind: type) -> Iterator[typing.Any]:
    return (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, kind))


def is_text(node: ast.AST) -> bool:
    """Whether a statement is a string by itself, as a docstring is."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_docstrings_name_what_is_there(path):
    """No entry of an argument that is gone, and none missing where there are any."""
    for node in nodes(path, ast.FunctionDef):
        documented, given = entries(ast.get_docstring(node), "Args"), node.args
        named = [*given.posonlyargs, *given.args, given.vararg, *given.kwonlyargs, given.kwarg]
        expected = [x.arg for x in named if x is not None and x.arg not in ("self", "cls")]
        assert not documented or list(documented) == expected, node.name


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_named_tuples_document_their_fields_where_help_shows_them(path):
    for node in nodes(path, ast.ClassDef):
        if not any(isinstance(base, ast.Name) and base.id == "NamedTuple" for base in node.bases):
            continue
        below = [text for x, text in zip(node.body, node.body[1:], strict=False)
                 if isinstance(x, ast.AnnAssign) and is_text(text)]  # fmt: skip
        assert not below, f"{node.name} has docstrings below its fields"
        expected = [ast.unparse(x.target) for x in node.body if isinstance(x, ast.AnnAssign)]
        assert list(entries(ast.get_docstring(node), "Attributes")) == expected, node.name


WITH_EXAMPLES = [path for path in FILES if ">>> " in path.read_text()]


@pytest.mark.parametrize("path", WITH_EXAMPLES, ids=lambda path: path.stem)
def test_examples_run(path):
    module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    found = doctest.testmod(importlib.import_module(module))
    assert found.attempted and not found.failed
