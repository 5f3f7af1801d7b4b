"""Trained auto-encoders on disk, as safetensors: no code is ever loaded. [host]"""

import hashlib
import json
import os
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from jaxshape.files import atomic_path
from jaxshape.model.autoencoder import architecture_of, initialize

FORMAT = "jaxshape-shape-prior-1"


class WeightsError(ValueError):
    """A weights file is missing, damaged, or of another architecture."""


class ShapePrior(NamedTuple):
    """A trained auto-encoder and where in code space the training shapes lie."""

    params: PyTree
    """For `encode` and `decode`."""
    code_mean: Float[Array, " d"]
    code_covariance: Float[Array, "d d"]
    """Of the codes of the training set: the scale on which a search takes its steps."""


def save_prior(path: str | os.PathLike[str], prior: ShapePrior, card: dict[str, Any]) -> None:
    """Write a shape prior in half precision, with its model card as metadata, atomically."""
    tensors: dict[str, np.ndarray] = {
        name: np.asarray(x, np.float16) for name, x in flatten(prior.params).items()
    }
    tensors["code_mean"] = np.asarray(prior.code_mean, np.float32)
    tensors["code_covariance"] = np.asarray(prior.code_covariance, np.float32)
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, {"format": FORMAT, "card": json.dumps(card)})


def load_prior(path: str | os.PathLike[str] | None = None) -> ShapePrior:
    """Read a shape prior; without a path, the one for chairs that comes with the package.

    Raises `WeightsError` when the file is missing, not in this format, damaged, or does not hold
    the tensors, with the shapes, of an auto-encoder of the paper's form.
    """
    tensors, _ = _read(_path(path))
    mean, covariance = tensors.pop("code_mean", None), tensors.pop("code_covariance", None)
    # Converted by NumPy: JAX would compile a program for each shape.
    params = unflatten({name: jnp.asarray(x.astype(np.float32)) for name, x in tensors.items()})
    _check(params, mean, covariance, _path(path))
    return ShapePrior(params, jnp.asarray(mean), jnp.asarray(covariance))


def load_card(path: str | os.PathLike[str] | None = None) -> dict[str, Any]:
    """Read the model card of a weights file: data, command, seed, time, measured figures."""
    return json.loads(_read(_path(path))[1]["card"])


def fingerprint(prior: ShapePrior) -> str:
    """A hash of all numbers of a shape prior: the same for the same weights, wherever they lie."""
    digest = hashlib.sha256()
    for name, x in flatten(prior).items():
        digest.update(name.encode())
        digest.update(np.asarray(x).tobytes())
    return digest.hexdigest()


def flatten(tree: PyTree) -> dict[str, Any]:
    """Name each array of a tree by its path, joined with `/`."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): x for path, x in leaves}


def unflatten(named: dict[str, Any]) -> PyTree:
    """Nested dictionaries from names joined with `/`."""
    tree: dict = {}
    for name, x in named.items():
        *parents, leaf = name.split("/")
        branch = tree
        for parent in parents:
            branch = branch.setdefault(parent, {})
        branch[leaf] = x
    return tree


def _path(path: str | os.PathLike[str] | None) -> Path:
    packaged = resources.files("jaxshape.model") / "chair.safetensors"
    return Path(str(packaged) if path is None else path)


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    if not path.exists():
        raise WeightsError(f"There is no weights file {str(path)!r}; make one: jaxshape train.")
    try:
        with safe_open(path, "np") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as problem:
        raise WeightsError(
            f"{str(path)!r} is not a readable safetensors file: {problem}."
        ) from None
    if metadata.get("format") != FORMAT:
        raise WeightsError(
            f"{str(path)!r} is of format {metadata.get('format')!r}, not {FORMAT!r}; "
            "give a file written by `jaxshape train`."
        )
    return tensors, metadata


def _check(params: PyTree, mean, covariance, path: Path) -> None:
    """Compare every shape with those of a network of the sizes the file seems to have."""
    problem = None
    try:
        architecture = architecture_of(params)
        expected = flatten(jax.eval_shape(lambda: initialize(jax.random.key(0), architecture)))
        found = {name: x.shape for name, x in flatten(params).items()}
        for name in sorted(expected.keys() | found.keys()):
            shape = expected[name].shape if name in expected else "no such array"
            if found.get(name) != shape:
                problem = f"{name} is {found.get(name, 'missing')}, expected {shape}"
                break
        if mean is None or covariance is None:
            problem = "the codes' mean or covariance is missing"
        elif mean.shape != (architecture.code,) or covariance.shape != mean.shape * 2:
            problem = f"statistics of {mean.shape} codes for codes of {architecture.code} numbers"
    except (KeyError, TypeError, IndexError) as missing:
        problem = f"no array {missing}"
    if problem:
        raise WeightsError(f"{str(path)!r} holds weights of another architecture: {problem}.")
