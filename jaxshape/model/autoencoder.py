"""The auto-encoder of the paper (section 2.2): 32^3 occupancy to a short code and back.

`encode` and `decode` are pure functions of the parameters and broadcast over leading axes. The
parameters are the two Flax collections `params` and `batch_stats` of `AutoEncoder`; Flax itself is
imported here and nowhere else.
"""

from functools import partial
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from jaxshape.geometry.grid import RESOLUTION
from jaxshape.model.chunks import in_chunks
from jaxshape.model.config import Architecture
from jaxshape.model.convolution import (
    KERNEL_SIZE,
    PreparedKernel,
    downsample,
    prepare_kernel,
    upsample,
    upsample_prepared,
)

CODES_AT_A_TIME = 8
"""Codes or grids that go through the network together on CPU: enough rows for its products, few
enough that its memory stays small; layers that need fewer to stay in cache take them in turn."""

NORM_EPSILON = 1e-5
"""Added to variances by batch normalisation, Flax's default."""

LEAKY_SLOPE = 0.2
"""Not given in the paper; that of the networks whose initialisation it uses (DCGAN)."""


class AutoEncoder(nn.Module):
    """Encoder and decoder without skip connections, so that either can be used alone."""

    architecture: Architecture = Architecture()
    dtype: DTypeLike = jnp.float32
    """Of the convolutions' arithmetic; parameters and batch statistics stay float32."""
    axis: str | None = None
    """Mesh axis over which a batch is spread, if it is: its statistics are those of all of it."""

    def setup(self):
        self.encoder = Encoder(self.architecture, self.dtype, self.axis)
        self.decoder = Decoder(self.architecture, self.dtype, self.axis)

    def __call__(
        self,
        grid: Bool[Array, "b x y z"] | Float[Array, "b x y z"],
        train: bool,
        noise: Float[Array, "b d"] | float = 0.0,
    ) -> tuple[Float[Array, "b x y z"], Float[Array, "b d"]]:
        """Logits of the completed grid, and its code, to which noise was added before decoding."""
        code = self.encoder(grid, train)
        return self.decoder(code + noise, train), code

    def encode(self, grid: Float[Array, "b x y z"], train: bool = False) -> Float[Array, "b d"]:
        return self.encoder(grid, train)

    def decode(self, code: Float[Array, "b d"], train: bool = False) -> Float[Array, "b x y z"]:
        return self.decoder(code, train)


class Encoder(nn.Module):
    """32 -> 16 -> 8 -> 4 -> 2 by strided convolutions, then pooling and a 1^3 convolution."""

    architecture: Architecture
    dtype: DTypeLike
    axis: str | None

    @nn.compact
    def __call__(self, grid, train):
        x = grid[..., None].astype(self.dtype)
        for i, channels in enumerate(self.architecture.encoder):
            x = downsample(x, _kernel(self, f"conv{i}", x.shape[-1], channels).astype(self.dtype))
            x = _normalize(x, train, self.axis, f"norm{i}")
        pooled = jnp.mean(x.astype(jnp.float32), axis=(1, 2, 3))
        return nn.Dense(self.architecture.code, kernel_init=WEIGHT_INIT, name="project")(pooled)


class Decoder(nn.Module):
    """1 -> 4 -> 8 -> 16 -> 32 by transposed convolutions."""

    architecture: Architecture
    dtype: DTypeLike
    axis: str | None

    @nn.compact
    def __call__(self, code, train):
        channels = (*self.architecture.decoder, 1)
        # On a single voxel, padding 1 and output padding 1 give 4 voxels: taps 1 to 4 of five.
        kernel = _kernel(self, "conv0", channels[0], code.shape[-1])[1:, 1:, 1:]
        x = jnp.einsum("bd,xyzcd->bxyzc", code.astype(self.dtype), kernel.astype(self.dtype))
        for i in range(1, len(channels)):
            x = _normalize(x, train, self.axis, f"norm{i - 1}")
            x = upsample(x, _kernel(self, f"conv{i}", channels[i], x.shape[-1]).astype(self.dtype))
        bias = self.param("bias", nn.initializers.zeros, ())
        # The output layer is (tanh(x) + 1) / 2 = sigmoid(2 x); 2 x is its logit.
        return 2.0 * (x[..., 0].astype(jnp.float32) + bias)


WEIGHT_INIT = nn.initializers.normal(0.02)
"""Convolutions start at N(0, 0.02) (paper, section 2.3)."""


def _kernel(module, name, fine, coarse):
    return module.param(name, WEIGHT_INIT, (*[KERNEL_SIZE] * 3, fine, coarse))


def _normalize(x, train, axis, name):
    """Batch normalisation, scales started at N(1, 0.02) (paper, section 2.3), and leaky relu."""
    norm = nn.BatchNorm(
        use_running_average=not train,
        momentum=0.9,
        epsilon=NORM_EPSILON,
        scale_init=lambda *args: 1 + WEIGHT_INIT(*args),
        dtype=x.dtype,
        axis_name=axis if train else None,
        name=name,
    )
    return nn.leaky_relu(norm(x), LEAKY_SLOPE)


def initialize(key: PRNGKeyArray, architecture: Architecture = Architecture()) -> PyTree:
    """Parameters and batch statistics of an untrained network."""
    grid = jnp.zeros((1, *[RESOLUTION] * 3))
    # Under jit the forward pass, which Flax traces to find the shapes, is left out.
    return jax.jit(partial(AutoEncoder(architecture).init, train=False))(key, grid)


def architecture_of(params: PyTree) -> Architecture:
    """Read the sizes off the parameters."""
    encoder, decoder = params["params"]["encoder"], params["params"]["decoder"]
    return Architecture(
        encoder=tuple(encoder[f"conv{i}"].shape[-1] for i in range(4)),
        decoder=tuple(decoder[f"conv{i}"].shape[-2] for i in range(3)),
        code=decoder["conv0"].shape[-1],
    )


def encode(
    params: PyTree,
    grid: Bool[Array, "*batch x y z"] | Float[Array, "*batch x y z"],
    *,
    dtype: DTypeLike = jnp.float32,
) -> Float[Array, "*batch d"]:
    """The code of a (partial) occupancy grid: the first code of a search (paper, section 3.1)."""
    network = AutoEncoder(architecture_of(params), dtype)
    apply = lambda grid: network.apply(params, grid, method="encode")  # noqa: E731
    return _over_leading_axes(apply, grid.astype(jnp.float32), 3)


class PreparedDecoder(NamedTuple):
    """A decoder for many calls, with everything done that does not depend on the code.

    Batch normalisation is folded into the layer before it.
    """

    first: Float[Array, "4 4 4 channels d"]
    kernels: tuple[PreparedKernel, ...]
    biases: tuple[Float[Array, "..."], ...]
    """One per layer; the last is the output's, a scalar."""


def prepare_decoder(params: PyTree, dtype: DTypeLike = jnp.float32) -> PreparedDecoder:
    """Make a decoder ready for a search, with products in the given precision."""
    weights, statistics = params["params"]["decoder"], params["batch_stats"]["decoder"]
    kernels, biases = [], []
    layers = len([name for name in weights if name.startswith("conv")])
    for i in range(layers - 1):
        norm, seen = weights[f"norm{i}"], statistics[f"norm{i}"]
        scale = norm["scale"] * lax.rsqrt(seen["var"] + NORM_EPSILON)
        kernels.append((weights[f"conv{i}"] * scale[:, None]).astype(dtype))
        biases.append(norm["bias"] - seen["mean"] * scale)
    kernels.append(weights[f"conv{layers - 1}"].astype(dtype))
    first, *rest = kernels
    return PreparedDecoder(
        first[1:, 1:, 1:],
        tuple(prepare_kernel(kernel, 4 * 2**i) for i, kernel in enumerate(rest)),
        (*biases, weights["bias"]),
    )


def decode(
    params: PyTree | PreparedDecoder,
    code: Float[Array, "*batch d"],
    *,
    dtype: DTypeLike = jnp.float32,
) -> Float[Array, "*batch x y z"]:
    """**Logits** of the occupancy that a code stands for; occupied where positive.

    The paper's output in (0, 1) is `jax.nn.sigmoid(logits)`. However many leading axes the codes
    have, they are decoded by one call; on CPU it works through them a few at a time, so that its
    memory does not grow with the population. A decoder that was prepared already has its precision.
    """
    decoder = params if isinstance(params, PreparedDecoder) else prepare_decoder(params, dtype)
    return _over_leading_axes(partial(_decode, decoder), code, 1)


def _decode(decoder: PreparedDecoder, code: Float[Array, "b d"]) -> Float[Array, "b x y z"]:
    code = code.astype(decoder.first.dtype)
    x = jnp.einsum("bd,xyzcd->bxyzc", code, decoder.first, preferred_element_type=jnp.float32)
    *biases, last = decoder.biases
    for kernel, bias in zip(decoder.kernels, biases, strict=True):
        x = upsample_prepared(nn.leaky_relu(x + bias, LEAKY_SLOPE), kernel)
    # The output layer is (tanh(x) + 1) / 2 = sigmoid(2 x); 2 x is its logit.
    return 2.0 * (x[..., 0].astype(jnp.float32) + last)


def _over_leading_axes(function, x, core_axes):
    """Apply a function of `[b, ...]` to any leading axes, on CPU a few examples at a time."""
    batch, core = x.shape[: x.ndim - core_axes], x.shape[x.ndim - core_axes :]
    flat = x.reshape(-1, *core)
    chunked = partial(in_chunks, function, CODES_AT_A_TIME)
    out = lax.platform_dependent(flat, cpu=chunked, default=function)
    return out.reshape(*batch, *out.shape[1:])
