"""A network conditioned on the measurement: measured detail bypasses the code.

`COMPLETION` is its `ShapeModel`, a conditional variational auto-encoder with the skip connections
of a U-Net. The encoder reduces the measurement (soft F and M) to features of 16^3 down to 4^3
voxels, once for each object. The code enters at 4^3 and at each size on the way up, where skip
connections add the features of that size. Given the measurement, codes of all objects are normally
distributed with mean 0 and variance 1, so that the first code is 0 and half the squared length of a
code is its cost in nats.

In training a posterior network also takes the complete shape and predicts which codes lead to it.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from jaxshape.geometry.evidence import from_grids
from jaxshape.geometry.grids import Grids
from jaxshape.geometry.symmetry import mirror
from jaxshape.model.config import Completion
from jaxshape.model.convolution import multiplies_bfloat16
from jaxshape.model.shapes import Precision, Prepared, ShapeModel
from jaxshape.model.stencil import convolve, multiply

PATCH = 2
"""Side of the voxel patches from which the first features are computed, in voxels."""

CHANNELS = 4
"""Channels of `evidence_of`."""

Features = Float[Array, "b x y z channels"]


class Skips(NamedTuple):
    """Features of the measurement, from fine to coarse.

    Attributes:
        fine: At half the resolution of the grids.
        middle: At a quarter.
        coarse: At an eighth.
    """

    fine: Features
    middle: Features
    coarse: Features


# ------------------------------------------------------------------ parameters


def initialize(key: PRNGKeyArray, architecture: Completion) -> PyTree:
    """Parameters of an untrained network, as a tree of dictionaries.

    Args:
        key: Random key of the first weights.
        architecture: Sizes of the network.
    """
    fine, middle, coarse = architecture.channels
    patch, depth, code = PATCH**3, architecture.depth, architecture.code
    cells = (architecture.resolution // 8) ** 3
    q = [max(8, c // 2) for c in architecture.channels]
    return _drawn(key, {
        "measured": {
            "stem": _new_dense(CHANNELS * patch, fine),
            "fine": _new_block(fine),
            "down1": _new_dense(patch * fine, middle),
            "middle": _new_blocks(depth, middle),
            "down2": _new_dense(patch * middle, coarse),
            "coarse": _new_blocks(depth, coarse),
        },
        "decoder": {
            "code": _new_dense(code, cells * coarse, scale=0.1),
            "coarse": _new_block(coarse, code),
            "up1": _new_dense(coarse, patch * middle),
            "middle": _new_blocks(depth, middle, code),
            "up2": _new_dense(middle, patch * fine),
            "fine": _new_block(fine, code),
            "logits": _new_dense(fine, patch, scale=0.1),
        },
        "posterior": {
            "stem": _new_dense((CHANNELS + 1) * patch, q[0]),
            "down1": _new_dense(patch * q[0], q[1]),
            "middle": _new_block(q[1]),
            "down2": _new_dense(patch * q[1], q[2]),
            "coarse": _new_block(q[2]),
            "squeeze": _new_dense(q[2], q[0]),
            "code": _new_dense(cells * q[0], 2 * code, scale=0.1),
        },
    })  # fmt: skip


class _Normal(NamedTuple):
    """Weights that are to be drawn from a normal distribution of mean 0.

    Attributes:
        shape: Shape of the array.
        deviation: Standard deviation.
    """

    shape: tuple[int, ...]
    deviation: float


def _drawn(key: PRNGKeyArray, tree: PyTree) -> PyTree:
    """The tree with all its weights drawn in one call: each call takes a third of a second to
    compile.
    """
    leaves, structure = jax.tree.flatten(tree, is_leaf=lambda x: isinstance(x, _Normal))
    drawn = [i for i, x in enumerate(leaves) if isinstance(x, _Normal)]
    sizes = [math.prod(leaves[i].shape) for i in drawn]
    numbers = jnp.split(jax.random.normal(key, (sum(sizes),)), np.cumsum(sizes)[:-1])
    for i, values in zip(drawn, numbers, strict=True):
        leaves[i] = leaves[i].deviation * values.reshape(leaves[i].shape)
    return jax.tree.unflatten(structure, leaves)


def _new_dense(inputs: int, outputs: int, scale: float = 1.0) -> dict[str, Any]:
    kernel = _Normal((inputs, outputs), scale / math.sqrt(inputs))
    return {"kernel": kernel, "bias": jnp.zeros(outputs)}


def _new_block(channels: int, code: int = 0) -> dict[str, Any]:
    block = {
        "scale": jnp.ones(channels),
        "kernel": _Normal((3, 3, 3, channels, channels), 1 / math.sqrt(27 * channels)),
        "mix": _new_dense(channels, channels, scale=0.3),
    }
    return block | ({"code": _new_dense(code, channels, scale=0.1)} if code else {})


def _new_blocks(depth: int, channels: int, code: int = 0) -> dict[str, Any]:
    return {str(i): _new_block(channels, code) for i in range(depth)}


# ------------------------------------------------------------------ layers


def _dense(x, layer):
    return multiply(x, layer["kernel"].astype(x.dtype)) + layer["bias"].astype(x.dtype)


def _normalized(x, scale):
    """Features of root mean square 1 in each voxel, scaled by channel."""
    wide = x.astype(jnp.float32)
    mean = jnp.mean(wide * wide, axis=-1, keepdims=True)
    return (wide * jax.lax.rsqrt(mean + 1e-6) * scale).astype(x.dtype)


def _block(x, block, code=None):
    """x + W act(K * act(norm(x)) + V code), with a 3^3 kernel K."""
    y = convolve(jax.nn.silu(_normalized(x, block["scale"])), block["kernel"].astype(x.dtype))
    if code is not None:
        y = y + _dense(code, block["code"])[:, None, None, None].astype(y.dtype)
    return x + _dense(jax.nn.silu(y), block["mix"])


def _blocks(x, blocks, code=None):
    for i in range(len(blocks)):
        x = _block(x, blocks[str(i)], code)
    return x


def _gathered(x: Float[Array, "b x y z c"]) -> Float[Array, "b x//2 y//2 z//2 8*c"]:
    """Merge each block of 2^3 voxels into one voxel that has all their channels."""
    b, n, _, _, c = x.shape
    m = n // PATCH
    x = x.reshape(b, m, PATCH, m, PATCH, m, PATCH, c).transpose(0, 1, 3, 5, 2, 4, 6, 7)
    return x.reshape(b, m, m, m, PATCH**3 * c)


def _spread(x: Float[Array, "b x y z c"]) -> Float[Array, "b 2*x 2*y 2*z c//8"]:
    """The inverse of `_gathered`: split each voxel into a block of 2^3."""
    b, m, _, _, c = x.shape
    x = x.reshape(b, m, m, m, PATCH, PATCH, PATCH, c // PATCH**3)
    x = x.transpose(0, 1, 4, 2, 5, 3, 6, 7)
    return x.reshape(b, PATCH * m, PATCH * m, PATCH * m, c // PATCH**3)


# ------------------------------------------------------------------ networks


def evidence_of(grids: Grids) -> Float[Array, "b x y z 4"]:
    """Probabilities of measured surface and free space, in each voxel and in its mirror image.

    Many objects are symmetric. With these channels, each side also has the measurement of the other
    side, and the network learns how much to trust it.
    """
    seen = from_grids(grids)
    return jnp.stack([*seen, *map(mirror, seen)], axis=-1)


def skips(params: PyTree, grids: Grids, dtype: Any = jnp.float32) -> Skips:
    """Features of the measurement."""
    net = params["measured"]
    fine = _dense(_gathered(evidence_of(grids).astype(dtype)), net["stem"])
    fine = _block(fine, net["fine"])
    middle = _blocks(_dense(_gathered(fine), net["down1"]), net["middle"])
    coarse = _blocks(_dense(_gathered(middle), net["down2"]), net["coarse"])
    return Skips(fine, middle, coarse)


def decode_skips(
    params: PyTree, found: Skips, code: Float[Array, "b d"]
) -> Float[Array, "b x y z"]:
    """Logits of codes, each with the features of its own object."""
    net, code = params["decoder"], code.astype(found.fine.dtype)
    x = found.coarse + _dense(code, net["code"]).reshape(found.coarse.shape)
    x = _block(x, net["coarse"], code)
    x = found.middle + _spread(_dense(x, net["up1"]))
    x = _blocks(x, net["middle"], code)
    x = found.fine + _spread(_dense(x, net["up2"]))
    x = _block(x, net["fine"], code)
    return _spread(_dense(x, net["logits"]).astype(jnp.float32))[..., 0]


def posterior(
    params: PyTree,
    grids: Grids,
    surface: Bool[Array | np.ndarray, "b x y z"],
    dtype: Any = jnp.float32,
) -> tuple[Float[Array, "b d"], Float[Array, "b d"]]:
    """Mean and log-variance of the codes that lead to a complete surface."""
    net = params["posterior"]
    seen = jnp.concatenate([evidence_of(grids), surface[..., None].astype(jnp.float32)], axis=-1)
    x = _dense(_gathered(seen.astype(dtype)), net["stem"])
    x = _block(_dense(_gathered(jax.nn.silu(x)), net["down1"]), net["middle"])
    x = _block(_dense(_gathered(x), net["down2"]), net["coarse"])
    x = jax.nn.silu(_dense(x, net["squeeze"])).reshape(len(x), -1)
    mean, log_variance = jnp.split(_dense(x, net["code"]).astype(jnp.float32), 2, axis=-1)
    return mean, jnp.clip(log_variance, -10.0, 3.0)


# ------------------------------------------------------------------ the shape model


def encode(params: PyTree, grids: Grids) -> Float[Array, "b d"]:
    """The most probable code given the measurement: 0."""
    return jnp.zeros((len(grids.occupied), architecture_of(params).code))


def prepare(params: PyTree, grids: Grids | None, precision: Precision) -> Prepared:
    """Features of each object's measurement and of its mirror image.

    Without a measurement, all voxels are unknown. A CPU without matrix units for bfloat16 is faster
    in float32, which it then uses for both precisions.
    """
    if grids is None:
        n = architecture_of(params).resolution
        grids = Grids(jnp.zeros((1, n, n, n)), jnp.ones((1, n, n, n)))
    pays = jax.default_backend() != "cpu" or multiplies_bfloat16()
    dtype = jnp.bfloat16 if precision == "bfloat16" and pays else jnp.float32
    sides = [skips(params, Grids(*side)) for side in (grids[:2], map(mirror, grids[:2]))]
    own = jax.tree.map(lambda x: x.astype(dtype), sides)
    return Prepared({"decoder": params["decoder"]}, own)


def decode(prepared: Prepared, code: Float[Array, "n d"]) -> Float[Array, "n x y z"]:
    """Logits of codes, each with the features of its object.

    They are the mean of two predictions, for the object and for its mirror image, so that a
    mirrored measurement gives the mirrored prediction.
    """
    here, there = (decode_skips(prepared.shared, side, code) for side in prepared.own)
    return (here + mirror(there)) / 2


def architecture_of(params: PyTree) -> Completion:
    """Read the sizes of the network from its parameters, given as arrays or as their shapes."""
    down, decoder = params["measured"], params["decoder"]
    code, cells = decoder["code"]["kernel"].shape
    coarse = down["down2"]["kernel"].shape[-1]
    return Completion(
        channels=(down["stem"]["kernel"].shape[-1], down["down1"]["kernel"].shape[-1], coarse),
        depth=len(down["middle"]),
        code=code,
        resolution=8 * round((cells / coarse) ** (1 / 3)),
    )


def shapes(params: PyTree) -> PyTree:
    """Expected shapes of all arrays, for a network of the sizes that the parameters suggest."""
    architecture = architecture_of(params)
    return jax.eval_shape(partial(initialize, architecture=architecture), jax.random.key(0))


COMPLETION = ShapeModel("completion", encode, decode, prepare, shapes, conditional=True)
"""Conditional network whose decoder takes the measurement."""
