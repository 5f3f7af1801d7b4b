"""The parts of a network that training needs: its initial parameters and the loss of a batch."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from jaxshape.geometry.grids import Grids
from jaxshape.model import autoencoder, completion
from jaxshape.model.config import Architecture, Completion, TrainConfig
from jaxshape.model.shapes import ShapeModel


class Batch(NamedTuple):
    """Training pairs.

    Attributes:
        occupied: Soft F `[b x y z]`.
        occluded: Soft M `[b x y z]`.
        surface: Complete surface Y `[b x y z]`.
    """

    occupied: Float[Array | np.ndarray, "b x y z"]
    occluded: Float[Array | np.ndarray, "b x y z"]
    surface: Bool[Array | np.ndarray, "b x y z"]

    @property
    def grids(self) -> Grids:
        """F and M."""
        return Grids(self.occupied, self.occluded)


class Cost(NamedTuple):
    """The loss of a batch.

    Attributes:
        loss: Nats per voxel.
        variables: The variables besides the parameters, after this batch.
        completed: The completed grids `[b x y z]`.
    """

    loss: Float[Array, ""]
    variables: dict[str, PyTree]
    completed: Bool[Array, "b x y z"]


class Family(NamedTuple):
    """A kind of network that can be trained.

    Attributes:
        model: Its shape model.
        initialize: `(key, architecture) -> variables`, a dictionary with `params` and the network's
            other state.
        cost: `(variables, batch, noise, config, axis) -> Cost`, where `noise` holds standard normal
            numbers for each code `[b d]`, and `axis` is the mesh axis over which the batch is
            spread.
        params: `variables -> ` parameters of the shape model.
        variables: The inverse of `params`.
        architecture_of: `parameters of the shape model -> ` sizes of the network.
        codes_are_normal: Whether training gives the codes mean 0 and covariance 1, so that their
            statistics need not be measured.
    """

    model: ShapeModel
    initialize: Callable[[PRNGKeyArray, Any], dict[str, PyTree]]
    cost: Callable[..., Cost]
    params: Callable[[dict[str, PyTree]], PyTree]
    variables: Callable[[PyTree], dict[str, PyTree]]
    architecture_of: Callable[[PyTree], Any]
    codes_are_normal: bool = False


def family_of(architecture: Architecture | Completion) -> Family:
    """The kind of network that has these sizes."""
    return COMPLETIONS if isinstance(architecture, Completion) else AUTOENCODERS


def cross_entropy(
    logits: Float[Array, "b x y z"], batch: Batch, config: TrainConfig
) -> Float[Array, ""]:
    """Mean cross-entropy with the complete surfaces, weighted according to the settings."""
    weights = jnp.where(batch.surface, config.occupied_weight, 1.0)
    weights *= 1 + (config.occluded_weight - 1) * batch.occluded
    return jnp.mean(weights * optax.sigmoid_binary_cross_entropy(logits, batch.surface))


# ------------------------------------------------------------------ auto-encoders


def autoencoder_cost(variables, batch: Batch, noise, config: TrainConfig, axis) -> Cost:
    """Cross-entropy of the decoded code of F, and the penalty on the code's length."""
    dtype = jnp.bfloat16 if config.bfloat16 else jnp.float32
    assert isinstance(config.architecture, Architecture)
    network = autoencoder.AutoEncoder(config.architecture, dtype, axis)
    (logits, code), updates = network.apply(
        variables,
        autoencoder.seen_by_encoder(batch.grids, config.architecture.occlusion),
        train=True,
        noise=config.code_noise * noise,
        mutable=["batch_stats"],
    )
    length = 0.5 * jnp.mean(jnp.sum(code**2, axis=-1)) / batch.surface[0].size
    loss = cross_entropy(logits, batch, config) + config.code_weight * length
    return Cost(loss, dict(updates), logits > 0)


AUTOENCODERS = Family(
    autoencoder.AUTOENCODER,
    autoencoder.initialize,
    autoencoder_cost,
    params=lambda variables: variables,
    variables=lambda params: params,
    architecture_of=autoencoder.architecture_of,
)

# ------------------------------------------------------------------ conditional networks


def completion_cost(variables, batch: Batch, noise, config: TrainConfig, axis) -> Cost:
    """The evidence bound of a conditional variational auto-encoder.

    Some examples decode the first code, 0, which must give the best prediction without a search.
    The others decode a sample of the posterior, and its divergence from the normal distribution is
    added.
    """
    del axis  # no batch statistics
    dtype = jnp.bfloat16 if config.bfloat16 else jnp.float32
    params = variables["params"]
    mean, log_variance = completion.posterior(params, batch.grids, batch.surface, dtype)
    place = jnp.arange(len(mean))
    share = config.posterior_share
    searched = (jnp.floor((place + 1) * share) > jnp.floor(place * share))[:, None]
    code = jnp.where(searched, mean + jnp.exp(log_variance / 2) * noise, 0.0)
    found = completion.skips(params, batch.grids, dtype)
    logits = completion.decode_skips(params, found, code)
    nats = 0.5 * (mean**2 + jnp.exp(log_variance) - 1 - log_variance)
    divergence = jnp.sum(jnp.where(searched, nats, 0)) / batch.surface.size
    loss = cross_entropy(logits, batch, config) + config.code_weight * divergence
    return Cost(loss, {}, logits > 0)


COMPLETIONS = Family(
    completion.COMPLETION,
    lambda key, architecture: {"params": completion.initialize(key, architecture)},
    completion_cost,
    params=lambda variables: variables["params"],
    variables=lambda params: {"params": params},
    architecture_of=completion.architecture_of,
    codes_are_normal=True,
)
