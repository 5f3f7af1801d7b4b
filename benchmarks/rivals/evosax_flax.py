"""The obvious JAX program: evosax's CMA_ES over a decoder of Flax `ConvTranspose` layers."""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from evosax.algorithms import CMA_ES
from jaxtyping import Array, Float

from jaxshape.model.autoencoder import LEAKY_SLOPE
from jaxshape.search.residuals import Target, cross_entropy


class Decoder(nn.Module):
    """The decoder of the paper as anybody would write it."""

    channels: tuple[int, ...]

    @nn.compact
    def __call__(self, code: Float[Array, "b d"]) -> Float[Array, "b x y z"]:
        x = code[:, None, None, None, :]
        # Output voxel 2 i + k - padding: in Flax's terms of the padded, dilated input.
        paddings = [(3, 4)] + [(2, 3)] * (len(self.channels) - 1)
        for i, (channels, padding) in enumerate(zip(self.channels, paddings, strict=True)):
            if i:
                x = nn.BatchNorm(use_running_average=True, name=f"norm{i - 1}")(x)
                x = nn.leaky_relu(x, LEAKY_SLOPE)
            x = nn.ConvTranspose(
                channels, [5] * 3, [2] * 3, [padding] * 3, use_bias=False, name=f"conv{i}"
            )(x)
        return 2 * (x[..., 0] + self.param("bias", nn.initializers.zeros, ()))


def decoder(variables: Any) -> Callable[[Float[Array, "b d"]], Float[Array, "b x y z"]]:
    """The decoder with jaxshape's weights."""
    params, stats = variables["params"]["decoder"], variables["batch_stats"]["decoder"]
    kernels = {name: _kernel(x) for name, x in params.items() if name.startswith("conv")}
    network = Decoder(tuple(kernels[f"conv{i}"]["kernel"].shape[-1] for i in range(4)))
    return lambda code: network.apply({"params": params | kernels, "batch_stats": stats}, code)


def _kernel(kernel: Float[Array, "5 5 5 fine coarse"]) -> dict[str, Float[Array, "5 5 5 in out"]]:
    """Flax correlates with the dilated input, so taps run backwards."""
    return {"kernel": jnp.flip(kernel, (0, 1, 2)).swapaxes(-1, -2)}


def search(
    variables: Any, target: Target, *, iterations: int, population: int, sigma0: float = 0.1
) -> Callable[[Array, Float[Array, " d"], Float[Array, "d d"]], Float[Array, ""]]:
    """The best objective of one search from (key, code, root)."""
    decode, dim = decoder(variables), variables["params"]["decoder"]["conv0"].shape[-1]
    strategy = CMA_ES(population, jnp.zeros(dim), metrics_fn=lambda *_: {})
    settings = strategy.default_params.replace(std_init=sigma0)

    def run(key, code, root):
        def step(state, key):
            ask_key, tell_key = jax.random.split(key)
            points, state = strategy.ask(ask_key, state, settings)
            losses = cross_entropy(decode(code + points @ root.T), target)
            state, _ = strategy.tell(tell_key, points, losses, state, settings)
            return state, jnp.min(losses)

        state = strategy.init(key, jnp.zeros(dim), settings)
        return jnp.min(jax.lax.scan(step, state, jax.random.split(key, iterations))[1])

    return run
