"""A sweep over 8 step sizes of Adam and 8 weights of the prior, for all objects in one program.

python docs/examples/sweep.py    # a minute; it prints which of the 64 settings does best
"""

import jax
import jax.numpy as jnp

import jaxshape as js

STEPS, WEIGHTS, ITERATIONS = jnp.geomspace(0.003, 1, 8), jnp.geomspace(0.03, 100, 8), 8

chairs = [js.random_chair(seed) for seed in range(1_000_001, 1_000_003)]
seen = [js.capture(mesh, js.orbit(2, 2.0), noise=False, seed=0) for mesh in chairs]
frames = [js.merge_all(js.measure_frames(one)) for one in seen]
F, M = (jnp.stack([grid(x) for x in frames]) for grid in (js.occupied, js.occluded))
truth = jnp.stack([one.surface for one in seen])
prior = js.load_prior("chair-autoencoder")


def score(step_size, prior_weight):  # traced by JAX: their values are not known here
    config = js.RefineConfig(iterations=ITERATIONS, step_size=step_size, prior_weight=prior_weight)
    adam = js.refiner_for("gradient:adam", prior, config)
    found = js.reconstruct(jax.random.key(0), prior, F, M, adam, config)
    return js.iou(found.composed, truth).mean()


over_weights = jax.vmap(score, in_axes=(None, 0))
table = jax.jit(jax.vmap(over_weights, in_axes=(0, None)))(STEPS, WEIGHTS)
i, j = jnp.unravel_index(jnp.argmax(table), table.shape)
print(
    f"{table.size} settings: IoU from {table.min():.3f} to {table.max():.3f},"
    f" best with steps of {STEPS[i]:.3f} and {WEIGHTS[j]:.2f} of the prior."
)
