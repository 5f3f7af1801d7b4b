"""The auto-encoder of the paper (section 2.2): occupancy to a short code and back.

`AUTOENCODER` is its `ShapeModel`. The number of layers decides the resolution, 32^3 in the paper.
The parameters are the two Flax collections `params` and `batch_stats` of `AutoEncoder`; Flax itself
is imported here and nowhere else.
"""

from functools import partial
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PRNGKeyArray, PyTree, Shaped

from jaxshape.geometry.grids import Grids, binary
from jaxshape.model.config import Architecture
from jaxshape.model.convolution import (
    KERNEL_SIZE,
    PreparedKernel,
    downsample,
    prepare_kernel,
    upsample,
    upsample_prepared,
)
from jaxshape.model.shapes import Precision, Prepared, ShapeModel

NORM_EPSILON = 1e-5
"""Added to variances by batch normalisation, Flax's default."""

LEAKY_SLOPE = 0.2
"""Slope of the leaky ReLU. The paper gives none; this is that of DCGAN, whose initialisation it
uses."""


class AutoEncoder(nn.Module):
    """Encoder and decoder without skip connections, so that either can be used alone.

    Attributes:
        architecture: Sizes of the network.
        dtype: Data type in which convolutions compute; parameters and batch statistics stay
            float32.
        axis: Mesh axis over which a batch is spread, so that statistics cover the whole batch; None
            where it is not spread.
    """

    architecture: Architecture = Architecture()
    dtype: DTypeLike = jnp.float32
    axis: str | None = None

    def setup(self):
        self.encoder = Encoder(self.architecture, self.dtype, self.axis)
        self.decoder = Decoder(self.architecture, self.dtype, self.axis)

    def __call__(
        self,
        seen: Shaped[Array, "b x y z c"],
        train: bool,
        noise: Float[Array, "b d"] | float = 0.0,
    ) -> tuple[Float[Array, "b x y z"], Float[Array, "b d"]]:
        """Logits of the completed grid, and its code, to which noise was added before decoding."""
        code = self.encoder(seen, train)
        return self.decoder(code + noise, train), code

    def encode(self, seen: Float[Array, "b x y z c"], train: bool = False) -> Float[Array, "b d"]:
        return self.encoder(seen, train)

    def decode(self, code: Float[Array, "b d"], train: bool = False) -> Float[Array, "b x y z"]:
        return self.decoder(code, train)


class Encoder(nn.Module):
    """32 -> 16 -> 8 -> 4 -> 2 by strided convolutions, then pooling and a 1^3 convolution.

    Each further layer takes a grid of twice the resolution. The fields are those of `AutoEncoder`.
    """

    architecture: Architecture
    dtype: DTypeLike
    axis: str | None

    @nn.compact
    def __call__(self, seen, train):
        x = seen.astype(self.dtype)
        for i, channels in enumerate(self.architecture.encoder):
            x = downsample(x, _kernel(self, f"conv{i}", x.shape[-1], channels).astype(self.dtype))
            x = _normalize(x, train, self.axis, f"norm{i}")
        pooled = jnp.mean(x.astype(jnp.float32), axis=(1, 2, 3))
        return nn.Dense(self.architecture.code, kernel_init=WEIGHT_INIT, name="project")(pooled)


class Decoder(nn.Module):
    """1 -> 4 -> 8 -> 16 -> 32 by transposed convolutions; each further layer doubles again.

    The fields are those of `AutoEncoder`.
    """

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
    """Parameters and batch statistics of an untrained network.

    Args:
        key: Random key of the first weights.
        architecture: Sizes of the network.
    """
    seen = jnp.zeros((1, *[architecture.resolution] * 3, 1 + architecture.occlusion), jnp.float32)
    # Flax traces the forward pass to find the shapes; under jit it is not executed.
    return jax.jit(partial(AutoEncoder(architecture).init, train=False))(key, seen)


def seen_by_encoder(grids: Grids, occlusion: bool) -> Float[Array, "b x y z c"]:
    """The encoder's input: F and M as they are, or F alone, rounded where it is soft (paper).

    Args:
        grids: F and M `[b x y z]`.
        occlusion: Whether the encoder takes M too (`Architecture.occlusion`).
    """
    channels = (grids.occupied, grids.occluded) if occlusion else (binary(grids).occupied,)
    return jnp.stack(channels, axis=-1).astype(jnp.float32)


def architecture_of(params: PyTree) -> Architecture:
    """Read the sizes of the network from its parameters.

    Args:
        params: Parameters of an auto-encoder, as arrays or as their shapes.
    """
    encoder, decoder = params["params"]["encoder"], params["params"]["decoder"]
    depth = sum(name.startswith("conv") for name in encoder)
    return Architecture(
        encoder=tuple(encoder[f"conv{i}"].shape[-1] for i in range(depth)),
        decoder=tuple(decoder[f"conv{i}"].shape[-2] for i in range(depth - 1)),
        code=decoder["conv0"].shape[-1],
        occlusion=encoder["conv0"].shape[-2] == 2,
    )


def shapes(params: PyTree) -> PyTree:
    """Expected shapes of all arrays, for a network of the sizes that the parameters suggest."""
    architecture = architecture_of(params)
    return jax.eval_shape(lambda: initialize(jax.random.key(0), architecture))


def encode(params: PyTree, grids: Grids) -> Float[Array, "b d"]:
    """The code of F, or of F and M, depending on the channels of the encoder."""
    architecture = architecture_of(params)
    seen = seen_by_encoder(grids, architecture.occlusion)
    return jnp.asarray(AutoEncoder(architecture).apply(params, seen, method="encode"))


class PreparedDecoder(NamedTuple):
    """A decoder for many calls, with all work done that does not depend on the code.

    Batch normalisation is folded into the layer before it.

    Attributes:
        first: Kernel of the first layer, from a code to 4^3 voxels.
        kernels: Prepared kernels of the further layers.
        biases: One bias for each layer; the last, a scalar, belongs to the output.
    """

    first: Float[Array, "4 4 4 channels d"]
    kernels: tuple[PreparedKernel, ...]
    biases: tuple[Float[Array, "..."], ...]


def prepare(params: PyTree, grids: Grids | None, precision: Precision) -> Prepared:
    """Fold the batch normalisation and transform the kernels of fast convolutions."""
    del grids  # the decoder sees the code alone
    weights, statistics = params["params"]["decoder"], params["batch_stats"]["decoder"]
    kernels, biases = [], []
    layers = len([name for name in weights if name.startswith("conv")])
    for i in range(layers - 1):
        norm, seen = weights[f"norm{i}"], statistics[f"norm{i}"]
        scale = norm["scale"] * lax.rsqrt(seen["var"] + NORM_EPSILON)
        kernels.append((weights[f"conv{i}"] * scale[:, None]).astype(precision))
        biases.append(norm["bias"] - seen["mean"] * scale)
    kernels.append(weights[f"conv{layers - 1}"].astype(precision))
    first, *rest = kernels
    decoder = PreparedDecoder(
        first[1:, 1:, 1:],
        tuple(prepare_kernel(kernel, 4 * 2**i) for i, kernel in enumerate(rest)),
        tuple(bias.astype(jnp.float32) for bias in (*biases, weights["bias"])),
    )
    return Prepared(decoder)


def decode(prepared: Prepared, code: Float[Array, "n d"]) -> Float[Array, "n x y z"]:
    """Logits of the occupancy grids of codes."""
    decoder: PreparedDecoder = prepared.shared
    code = code.astype(decoder.first.dtype)
    x = jnp.einsum("bd,xyzcd->bxyzc", code, decoder.first, preferred_element_type=jnp.float32)
    *biases, last = decoder.biases
    for kernel, bias in zip(decoder.kernels, biases, strict=True):
        x = upsample_prepared(nn.leaky_relu(x + bias, LEAKY_SLOPE), kernel)
    # The output layer is (tanh(x) + 1) / 2 = sigmoid(2 x); 2 x is its logit.
    return 2.0 * (x[..., 0].astype(jnp.float32) + last)


AUTOENCODER = ShapeModel("autoencoder", encode, decode, prepare, shapes)
"""The paper's model."""
