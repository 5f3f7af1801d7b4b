"""Trained shape models on disk, as safetensors: no code is ever loaded. [host]"""

import hashlib
import json
import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from jaxshape import checks, limits, reading
from jaxshape.files import atomic_path
from jaxshape.geometry.grids import Grids
from jaxshape.model.autoencoder import AUTOENCODER
from jaxshape.model.calibration import Calibration
from jaxshape.model.completion import COMPLETION
from jaxshape.model.pca import PCA
from jaxshape.model.shapes import ShapeModel, ShapePrior, resolution_of

FORMAT = "jaxshape-shape-prior-1"

FORMAT_IN_BYTES = "jaxshape-shape-prior-2"
"""Format in which each 8-bit array has an array of factors, one per channel of its last axis."""

FACTORS = "factors/"
"""Prefix of the names of these factors."""

BYTE_STEPS = 127
"""Quantisation steps of an 8-bit weight from 0 to the largest weight of its channel."""

LEAST_IN_BYTES = 4096
"""Arrays of fewer numbers stay in half precision."""

MODELS = {model.kind: model for model in (AUTOENCODER, COMPLETION, PCA)}
"""The kinds of shape models that come with the package."""

PACKAGED = ("chair", "chair-autoencoder")
"""Names of the weights that come with the package: the network that is conditioned on the
measurement, and the paper's auto-encoder."""


CLASSES = ("chair", "table")
"""Classes of the package; their weights come with it if they are among `PACKAGED`."""


def load_scene_priors(
    further: Mapping[str, str | os.PathLike[str]],
) -> tuple[dict[str, ShapePrior], dict[str, ShapePrior]]:
    """Load the priors of all classes that a scene may hold, and the priors that find boxes. [host]

    Args:
        further: Weights by class name, of further classes or as replacements for the package's own
            weights.

    Returns:
        The priors, and the priors that find boxes, both by class name. For a class without the
        latter, its own prior finds the boxes.

    Raises:
        WeightsError: A file cannot be read.
    """
    packaged = {name: name for name in CLASSES if name in PACKAGED}
    priors = {name: load_prior(where) for name, where in {**packaged, **further}.items()}
    placers = {
        name: load_prior(f"{name}-autoencoder")
        for name in packaged
        if name not in further and f"{name}-autoencoder" in PACKAGED
    }
    return priors, placers


def packaged_for(family: str) -> str:
    """The package's weights for a family of objects; those for chairs if it has no weights of its
    own."""
    return family if family in PACKAGED else "chair"


class WeightsError(ValueError):
    """A weights file is missing, damaged, or of another model."""


def save_prior(
    path: str | os.PathLike[str],
    prior: ShapePrior,
    card: dict[str, Any],
    *,
    in_bytes: bool = False,
) -> None:
    """Write a shape prior, with its model card as metadata, atomically. [host]

    Args:
        path: The file to write, `.safetensors`.
        prior: The shape prior to write; its parameters are a tree of dictionaries. The kind of its
            model is written beside them.
        card: The model card: a dictionary of anything that JSON can hold.
        in_bytes: Round the weights of each channel to 1/127 of the largest one, instead of to half
            precision. The file is half as large, and our networks lose less than 0.001 of IoU.

    Raises:
        ValueError: JSON cannot hold the card; nothing is written.
    """
    tensors = {}
    for name, x in flatten(prior.params).items():
        weights = np.asarray(x)
        if in_bytes and weights.ndim > 1 and weights.size >= LEAST_IN_BYTES:
            tensors[name], tensors[FACTORS + name] = _in_bytes(weights)
        else:
            tensors[name] = _half(weights)
    tensors["code_mean"] = np.asarray(prior.code_mean, np.float32)
    tensors["code_covariance"] = np.asarray(prior.code_covariance, np.float32)
    if prior.calibration is not None:
        tensors["calibration"] = np.asarray(prior.calibration, np.float32)
    form = FORMAT_IN_BYTES if in_bytes else FORMAT
    try:
        metadata = {"format": form, "kind": prior.model.kind, "card": json.dumps(card)}
    except TypeError as problem:
        raise ValueError(f"JSON cannot hold the card ({problem}); give plain numbers.") from None
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata)


def _in_bytes(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights `[... channels]` as whole numbers, and their factors `[channels]`."""
    largest = np.abs(weights).max(axis=tuple(range(weights.ndim - 1)))
    factors = np.where(largest > 0, largest, 1).astype(np.float32) / BYTE_STEPS
    return np.rint(weights / factors).astype(np.int8), factors


def _half(x: np.ndarray) -> np.ndarray:
    """The array in half precision; in single precision where it would overflow."""
    fits = np.abs(x).max(initial=0) < np.finfo(np.float16).max
    return x.astype(np.float16 if fits else np.float32)


def load_prior(
    path: str | os.PathLike[str] | None = None, model: ShapeModel | None = None
) -> ShapePrior:
    """Read a shape prior; without a path, the one for chairs that comes with the package. [host]

    Args:
        path: A file written by `save_prior` or `jaxshape train`, or a name of the package's weights
            (`PACKAGED`): "chair", which is also what None stands for, or "chair-autoencoder".
        model: Your own model, for weights of its kind; None for weights of the package's models.

    Raises:
        WeightsError: The file is missing, damaged, not in this format, or of an unknown kind of
            model; or its arrays are not finite, or do not fit its model.
        ValueError: An argument is of another type.
    """
    where = _path(path)
    if model is not None:
        checks.instance("model", model, ShapeModel, "ShapeModel(...)")
    tensors, metadata = _read(where)
    found = _model(metadata.get("kind", AUTOENCODER.kind), model, where)
    mean, covariance = tensors.pop("code_mean", None), tensors.pop("code_covariance", None)
    calibration = _calibration(tensors.pop("calibration", None), where)
    # NumPy converts, and device_put moves: jax.numpy would compile a program for each shape.
    with np.errstate(over="ignore"):  # values that overflow are found to be infinite below
        named = jax.device_put(_weights(tensors, where))
        mean, covariance = (None if x is None else x.astype(np.float32) for x in (mean, covariance))
    try:
        params = unflatten(named)
    except (TypeError, ValueError) as problem:
        raise WeightsError(f"{str(where)!r} holds no weights: {problem}.") from None
    _check(found, params, mean, covariance, where)
    mean, covariance = jax.device_put((mean, covariance))
    return ShapePrior(found, params, mean, covariance, calibration)


def _calibration(numbers: np.ndarray | None, path: Path) -> Calibration | None:
    if numbers is None:
        return None
    if numbers.shape != (3,) or not np.isfinite(numbers).all() or (numbers[:2] < 0).any():
        raise WeightsError(
            f"{str(path)!r} is damaged: calibration is {numbers.tolist()}; expected a slope and a "
            "doubt that are not negative, and an offset."
        )
    return Calibration(*map(float, numbers))


def _weights(tensors: dict[str, np.ndarray], path: Path) -> dict[str, np.ndarray]:
    """The weights in single precision; arrays of bytes are multiplied by their factors."""
    found = {}
    for name, x in tensors.items():
        if not name.startswith(FACTORS):
            factors = tensors.get(FACTORS + name, np.float32(1))
            if factors.shape not in ((), x.shape[-1:]):
                raise WeightsError(
                    f"{str(path)!r} is damaged: {name} has {x.shape[-1]} channels and "
                    f"{factors.shape} factors."
                )
            found[name] = x.astype(np.float32) * factors
    return found


def _model(kind: str, given: ShapeModel | None, path: Path) -> ShapeModel:
    known = MODELS if given is None else MODELS | {given.kind: given}
    if kind not in known:
        raise WeightsError(
            f"{str(path)!r} holds weights of the kind {kind!r}; known are {', '.join(known)}. "
            "Weights of your own model need it: load_prior(path, model)."
        )
    return known[kind]


def load_card(path: str | os.PathLike[str] | None = None) -> dict[str, Any]:
    """Read the model card of a weights file: data, command, seed, time, measured figures. [host]

    Args:
        path: A weights file, or a name of the package's weights; None for "chair".
    """
    where = _path(path)
    try:
        return reading.parse_json_object(_read(where)[1].get("card", "{}"))
    except WeightsError:
        raise
    except ValueError as problem:
        raise WeightsError(f"{str(where)!r} holds a damaged card: {problem}.") from None


def fingerprint(prior: ShapePrior) -> str:
    """A hash of all numbers of a shape prior, which does not depend on where the file is stored."""
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
            if not isinstance(branch, dict):
                raise ValueError(f"{parent!r} is an array and holds {name!r}")
        if leaf in branch:
            raise ValueError(f"{name!r} is an array and holds others")
        branch[leaf] = x
    return tree


def _path(path: str | os.PathLike[str] | None) -> Path:
    given = "chair" if path is None else path
    if not (isinstance(given, str | os.PathLike) and os.fspath(given)):
        checks.refuse("path", path, f"a weights file, or one of {', '.join(PACKAGED)}")
    name = os.fspath(given)
    if name in PACKAGED:
        return Path(str(resources.files("jaxshape.model") / f"{name}.safetensors"))
    return Path(name)


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    if not path.exists():
        raise WeightsError(
            f"There is no weights file {str(path)!r}; make one (jaxshape train), or name weights of"
            f" the package: {', '.join(PACKAGED)}."
        )
    try:
        with reading.opened(path, limits.WEIGHT_BYTES), safe_open(path, "np") as file:
            metadata, names = file.metadata() or {}, list(file.keys())
            if len(names) > limits.ARRAY_ENTRIES:
                raise ValueError(f"it holds {len(names)} arrays")
            if any(name.count("/") > limits.WEIGHT_NESTING for name in names):
                raise ValueError(f"its names are nested more than {limits.WEIGHT_NESTING} deep")
            tensors = {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError) as problem:
        raise WeightsError(
            f"{str(path)!r} is not a readable safetensors file: {problem}."
        ) from None
    if metadata.get("format") not in (FORMAT, FORMAT_IN_BYTES):
        raise WeightsError(
            f"{str(path)!r} is of format {metadata.get('format')!r}, not {FORMAT!r}; "
            "give a file written by `jaxshape train`."
        )
    return tensors, metadata


def _check(model: ShapeModel, params: PyTree, mean, covariance, path: Path) -> None:
    """Raise `WeightsError` unless the arrays are finite and of the shapes of their model."""
    problem = _wrong_shape(model, params) or _wrong_statistics(model, params, mean, covariance)
    if problem:
        raise WeightsError(f"{str(path)!r} holds weights of another architecture: {problem}.")
    arrays = {**flatten(params), "code_mean": mean, "code_covariance": covariance}
    for name, x in arrays.items():
        if not np.isfinite(x).all():
            raise WeightsError(f"{str(path)!r} is damaged: {name} holds NaN or infinity.")
    if not is_covariance(covariance):
        raise WeightsError(
            f"{str(path)!r} is damaged: code_covariance is not symmetric and positive definite."
        )


def _wrong_shape(model: ShapeModel, params: PyTree) -> str | None:
    """Description of the first parameter of a wrong shape; None if all shapes are right."""
    if model.shapes is None:
        return None
    try:
        expected = {name: x.shape for name, x in flatten(model.shapes(params)).items()}
    except (KeyError, TypeError, IndexError, ValueError, AttributeError) as missing:
        return f"no array {missing}"
    found = {name: x.shape for name, x in flatten(params).items()}
    for name in sorted(expected.keys() | found.keys()):
        shape = expected.get(name, "no such array")
        if found.get(name) != shape:
            return f"{name} is {found.get(name, 'missing')}, expected {shape}"
    return None


def _wrong_statistics(model: ShapeModel, params: PyTree, mean, covariance) -> str | None:
    """Description of statistics of a wrong shape; None if all shapes are right."""
    if mean is None or covariance is None:
        return "the codes' mean or covariance is missing"
    if mean.ndim != 1 or covariance.shape != mean.shape * 2:
        return f"a covariance of shape {covariance.shape} for a mean code of shape {mean.shape}"
    try:
        nothing = jnp.zeros((1, *[resolution_of(model, params, len(mean))] * 3), bool)
        code = jax.eval_shape(model.encode, params, Grids(nothing, nothing))
    except Exception as problem:  # the model may be the user's, and raise anything
        return f"{len(mean)} numbers are no code of this model ({problem})"
    if code.shape[-1] != len(mean):
        return f"statistics of codes of {len(mean)} numbers for codes of {code.shape[-1]} numbers"
    return None


def is_covariance(matrix: np.ndarray) -> bool:
    """Whether a matrix is symmetric and positive definite, within the rounding of float32."""
    values = np.linalg.eigvalsh(np.asarray(matrix, np.float64))
    symmetric = np.allclose(matrix, matrix.T, rtol=1e-4, atol=1e-6 * abs(matrix).max())
    return bool(symmetric and values[0] > 1e-9 * values[-1] > 0)
