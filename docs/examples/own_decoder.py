"""Your own shape prior: a coordinate decoder as in DeepSDF, without an encoder.

python docs/examples/own_decoder.py    # half a minute; it prints:
Chairs it never saw: IoU 0.28 with the mean code, 0.42 after the search.
"""

import jax
import jax.numpy as jnp
import optax
from jax.random import fold_in, key, normal, randint

import jaxshape as js

CHAIRS, STEPS = 48, 600
GRID = jnp.stack(jnp.meshgrid(*[jnp.linspace(-1, 1, 32)] * 3, indexing="ij"), -1).reshape(-1, 3)
WAVES = jnp.sin(GRID @ (6 * normal(key(0), (3, 96))) + jnp.arange(96))  # per voxel position
SIZES = {"place": (96, 64), "code": (8, 64), "hidden": (64, 64), "out": (64,)}


def mlp(params, codes, waves):  # logits [code voxel]
    h = jax.nn.relu(waves @ params["place"] + (codes @ params["code"])[:, None])
    return jax.nn.relu(h @ params["hidden"]) @ params["out"] - 3


def loss(both, voxels):  # for the weights and the codes of all chairs, trained together
    logits, truth = mlp(*both, WAVES[voxels]), surfaces.reshape(CHAIRS, -1)[:, voxels]
    return jnp.mean((1 + 2 * truth) * optax.sigmoid_binary_cross_entropy(logits, truth))


def step(number, carry):
    slope = jax.grad(loss)(carry[0], randint(fold_in(key(9), number), (512,), 0, 32**3))
    change, state = adam.update(slope, carry[1])
    return optax.apply_updates(carry[0], change), state


def look(seed):  # F, M and the true surface of a chair in four frames
    mesh = js.random_chair(seed, style="side chair")
    seen = js.capture(mesh, js.orbit(4, 2.0), noise=False, seed=0)
    frames = js.merge_all(js.measure_frames(seen))
    return js.occupied(frames), js.occluded(frames), seen.surface


*_, surfaces = map(jnp.stack, zip(*map(look, range(CHAIRS)), strict=True))
params = {x: normal(key(i), SIZES[x]) * (2 / SIZES[x][0]) ** 0.5 for i, x in enumerate(SIZES)}
both, adam = (params, normal(key(8), (CHAIRS, 8)) / 10), optax.adam(5e-3)
(params, codes), _ = jax.lax.fori_loop(0, STEPS, step, (both, adam.init(both)))
MODEL = js.ShapeModel(
    kind="coordinates",
    encode=lambda params, grids: jnp.tile(params["mean"], (len(grids.occupied), 1)),
    decode=lambda prepared, codes: mlp(prepared.shared, codes, WAVES).reshape(-1, 32, 32, 32),
)
FILE, mean = "out/own.safetensors", codes.mean(0)
prior = js.ShapePrior(MODEL, params | {"mean": mean}, mean, jnp.cov(codes.T))
js.save_prior(FILE, prior, {"data": f"{CHAIRS} side chairs"})
prior, config = js.load_prior(FILE, MODEL), js.RefineConfig(iterations=60)
F, M, truth = map(jnp.stack, zip(*map(look, range(1_000_001, 1_000_004)), strict=True))
found = js.reconstruct(key(0), prior, F, M, js.refiner_for("gradient:adam", prior, config), config)
first, last = (js.iou(x, truth).mean() for x in (found.completed_first, found.completed))
print(f"Chairs it never saw: IoU {first:.2f} with the mean code, {last:.2f} after the search.")
