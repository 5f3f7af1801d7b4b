"""Searches on four devices; prints what was found, for `test_devices.py`."""

import json
import re
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from jaxshape.model.pca import PCA
from jaxshape.model.shapes import ShapePrior
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner
from jaxshape.search.reconstruction import reconstruct
from jaxshape.search.residuals import Target
from jaxshape.search.run import refine

D, SHAPE, OBJECTS = 4, (8, 8, 8), 8
METHODS = ("cma", "gradient:adam", "gauss-newton", "evosax:SNES")
rng = np.random.default_rng(0)


def of(*shape):
    return jnp.asarray(rng.normal(size=shape), jnp.float32)


PRIOR = ShapePrior(
    PCA,
    {
        "components": of(D, *SHAPE),
        "mean": of(*SHAPE),
        "variances": jnp.ones(D),
        "slope": jnp.float32(1),
        "noise": jnp.float32(1e-3),
    },
    jnp.zeros(D),
    jnp.eye(D),
)
CODES, TARGETS = of(OBJECTS, D), Target(*jnp.abs(of(2, OBJECTS, *SHAPE)))
GRIDS = jnp.abs(of(2, OBJECTS, *SHAPE)) < 0.5
KEYS = jax.random.split(jax.random.key(0), OBJECTS)
CONFIG = RefineConfig(iterations=5, population=4, sigma0=0.3, tolerance=0.0, space="raw")


def search(method, keys=KEYS, codes=CODES, targets=TARGETS, **options):
    refiner = build_refiner(method, D, CONFIG)
    found = refine(keys, PRIOR, codes, targets, refiner, 5, **options)
    return {"code": found.code, "loss": found.loss, "iterations": found.iterations}


def rebuild(keys, prior, occupied, occluded):
    refiner = build_refiner("cma", D, CONFIG)
    found = reconstruct(keys, prior, occupied, occluded, refiner, CONFIG)
    return {"code": found.code, "loss": found.objective, "composed": found.composed}


def listed(tree):
    return jax.tree.map(lambda x: np.asarray(x).tolist(), tree)


def shifted(mesh):
    """One search of Adam and one of CMA-ES, their objects on four devices of a mesh."""
    rows = KEYS, CODES, TARGETS
    placed = jax.device_put(rows, NamedSharding(mesh, PartitionSpec("b")))
    return {name: jax.jit(lambda *x, m=name: search(m, *x))(*placed) for name in METHODS[:2]}


def by_shard_map(method):
    """Under a `jax.shard_map` with its default settings, which evosax does not bear."""
    mesh = jax.make_mesh((4,), ("b",), axis_types=(AxisType.Auto,))
    split = PartitionSpec("b")
    one = jax.shard_map(lambda *x: search(method, *x), mesh=mesh, in_specs=split, out_specs=split)
    return jax.jit(one)(KEYS, CODES, TARGETS)


def main():
    out = {
        "devices": jax.device_count(),
        "searched": {m: jax.jit(lambda m=m: search(m))() for m in METHODS},
    }
    program = jax.jit(rebuild).lower(KEYS, PRIOR, *GRIDS).compile()
    out["collectives"] = re.findall(r"all-\w+|collective-\w+", program.as_text())
    out["rebuilt"] = jax.jit(rebuild)(KEYS, PRIOR, *GRIDS)
    out["places"] = len(out["rebuilt"]["code"].devices())
    some = jax.tree.map(lambda x: x[:5], (KEYS, CODES, TARGETS))
    out["five"] = jax.jit(lambda *x: search("cma", *x))(*some)
    heard = []
    jax.jit(lambda *x: search("cma", *x, callback=lambda *said: heard.append(said)))(*some)
    jax.effects_barrier()
    out["heard"] = [[objects, iterations] for objects, iterations, _ in heard]
    if jax.device_count() > 1:
        out["shard_map"] = {method: by_shard_map(method) for method in METHODS[:3]}
        for kind in (AxisType.Auto, AxisType.Explicit):
            out[kind.name] = shifted(jax.make_mesh((4,), ("b",), axis_types=(kind,)))
        mesh = jax.make_mesh((4,), ("b",), axis_types=(AxisType.Explicit,))
        with jax.set_mesh(mesh):
            out["set_mesh"] = search("cma")
        here = jax.device_put((KEYS, CODES, TARGETS), jax.devices()[2])
        out["placed"] = len(search("gradient:adam", *here)["code"].devices())
    print(json.dumps(listed(out)))


if __name__ == "__main__":
    sys.exit(main())
