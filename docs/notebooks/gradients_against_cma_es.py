# %% [markdown]
# # Gradients against CMA-ES
#
# The paper searches the code of an auto-encoder by CMA-ES, a population search that needs no
# derivatives. The decoder is a JAX function, so its gradient is available, too. Which search needs
# fewer decoder calls? A gradient counts as three calls here, because it takes the time of three.

# %%
from functools import partial

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxshape as js

SEEDS = range(1_000_001, 1_000_005)
CALLS = 1020  # decoder calls that each search may spend
POPULATION = 17

# %% [markdown]
# ## Problems: chairs in four clean depth frames each

# %%
film = [js.capture(js.random_chair(s), js.orbit(4, 2.0), noise=False, seed=0) for s in SEEDS]
frames = [js.merge_all(js.measure_frames(one)) for one in film]
F, M = (jnp.stack([grid(x) for x in frames]) for grid in (js.occupied, js.occluded))
truth = jnp.stack([one.surface for one in film])

# %% [markdown]
# ## Searches
#
# All chairs are searched in one compiled program. `prior` is the paper's network: its decoder
# knows the measurement only through the code.

# %%
prior = js.load_prior("chair-autoencoder")
PRICE = {"cma": POPULATION, "gradient:adam": 3, "gradient": 3}  # decoder calls of an iteration


def search(method):
    config = js.RefineConfig(iterations=CALLS // PRICE[method], population=POPULATION)
    refiner = js.refiner_for(method, prior, config)
    rebuild = jax.jit(partial(js.reconstruct, refiner=refiner, config=config))
    return rebuild(jax.random.key(0), prior, F, M)


found = {method: search(method) for method in PRICE}

# %% [markdown]
# ## Results
#
# The objective is Eq. 7 of the paper, in nats per voxel. The left figure shows the best value so
# far, averaged over the chairs, against decoder calls. The right figure shows the IoU of the
# refined shapes with the true surface.

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.5))
for method, one in found.items():
    objective = np.asarray(one.trace.best_loss).mean(axis=0)
    calls = PRICE[method] * np.arange(1, len(objective) + 1)
    left.plot(calls, objective, label=method)
    reached = float(js.iou(one.completed, truth).mean())
    right.bar(method, reached)
    print(f"{method}: objective {objective[-1]:.4f}, IoU {reached:.3f} after {calls[-1]} calls")
left.set(xscale="log", xlabel="decoder calls", ylabel="objective (nats per voxel)")
left.legend()
first = float(js.iou(found["cma"].completed_first, truth).mean())
right.axhline(first, color="black", linestyle=":", label="first code, no search")
right.set(ylabel="IoU of the refined shape")
right.legend()
plt.show()

# %% [markdown]
# Adam's objective decreases fastest: Adam needs 128 calls to reach the objective that CMA-ES
# reaches with 2,048. With more calls, all searches reach the same objective and the same shape. Try
# other names in `PRICE`, such as `gradient:lbfgs`, or a search of your own (`docs/extending.md`).
