r"""The frozen problems of `jaxshape bench` (beyond the paper).

    python experiments/bench_set.py --meshes cad_chairs/ --output jaxshape/bench

16 procedural chairs from seeds kept for tests and 8 CAD seats whose licence is CC0, each seen by 1,
4 and 8 frames of an orbit at 30 degrees elevation: clean (the paper's camera, points) and with a
Kinect's noise (signed distances). The lowest known objective of a problem is the result of 400
steps of Adam from the encoder's code, with a step size that decays to zero along a cosine.

Writes jaxshape-bench-1.npz, the same bytes wherever it runs with the same versions, and
jaxshape-bench-1.json. The set is frozen: this script is kept to show how it was made. Problems that
were searched are kept in the results folder. Time: 20 minutes on two cores.
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from rich.progress import track

from jaxshape.bench.config import FRAMES
from jaxshape.bench.problem_set import NAME, ProblemSet, fingerprint, write_set
from jaxshape.bench.problems import EQUATION_7, WEIGHTS, Problem, problems
from jaxshape.data.archives import list_meshes
from jaxshape.data.dataset import Object, load_object, pack, pack_measured
from jaxshape.data.families import TEST_SEEDS, procedural_objects
from jaxshape.data.meshes import Skipped
from jaxshape.model import weights
from jaxshape.model.weights import load_prior
from jaxshape.results.evaluation import EvaluateConfig, observe
from jaxshape.results.journal import Journal
from jaxshape.search.methods.gradient import gradient
from jaxshape.search.run import refine
from jaxshape.search.space import whitened

KINDS = {
    "clean": EvaluateConfig(camera="paper", frames=FRAMES),
    "noisy": EvaluateConfig(camera="kinect", frames=FRAMES),
}
LIST = Path(__file__).with_name("cad_seats.json")
SEATS = (
    "blendswap_cc_0_armchair_armchair",
    "blendswap_cc_0_oakchair_oakchair",
    "blendswap_cc_0_stool_stool",
    "blendswap_cc_0_thonet_thonet",
    "kenney_loungechair",
    "blendswap_cc_0_plasticchair_plasticchair",
    "blendswap_cc_0_deckchair_deckchair",
    "blendswap_cc_0_osakachair_osakachair",
)
"""CAD seats by their names in the list; all are under CC0."""


@dataclass(frozen=True)
class Config:
    """Sources and output."""

    meshes: Path = Path("cad_chairs")
    """Folder of the CAD seats, as experiments/cad_seats.py writes it."""
    output: Path = Path("out/bench_set")
    """Folder for the two files, and for finished searches."""
    steps: int = 400
    """Steps of Adam."""
    at_a_time: int = 8
    """Number of problems that are searched together."""


def main(config: Config) -> None:
    measured = measure(config.meshes)
    write_set(config.output, measured)
    best = lowest(problems(problem_set=measured), config)
    found = measured._replace(best=best)
    write_set(config.output, found)
    print(f"{found.name}: {len(best)} problems, SHA-256 {fingerprint(found)}")


def items(meshes: Path) -> list[tuple[Object, dict[str, str]]]:
    """The objects with their metadata, two procedural chairs before each seat."""
    files = {source.name: source for source in list_meshes(meshes)}
    listed = {seat["name"]: seat for seat in json.loads(LIST.read_text(encoding="utf-8"))}
    found = []
    for i, name in enumerate(SEATS):
        for chair in procedural_objects("chair", 2, TEST_SEEDS + 2 * i):
            found.append((chair, {"name": chair.name, "source": "procedural"}))
        seat = listed[name]
        assert seat["licence"] == "CC0"
        about = {key: seat[key] for key in ("title", "creator", "licence")}
        found.append((files[name], {"name": name, "source": seat["package"]} | about))
    return found


def measure(meshes: Path) -> ProblemSet:
    """The set, without the lowest objectives."""
    measured, surfaces, objects = {kind: [] for kind in KINDS}, [], []
    for item, about in track(items(meshes), description="objects"):
        model = load_object(item)
        assert not isinstance(model, Skipped), model
        for kind, config in KINDS.items():
            case = observe(model, config)
            assert case is not None, about["name"]
            measured[kind].append(pack_measured(jax.device_get(case.grids)))
        surfaces.append(pack(np.asarray(case.surface[0])))
        objects.append(about)
    return ProblemSet(
        name=NAME,
        objects=objects,
        measured={kind: np.stack(grids) for kind, grids in measured.items()},
        surfaces=np.stack(surfaces),
        weights=weights.fingerprint(load_prior(WEIGHTS)),
        best={},
    )


def lowest(every: list[Problem], config: Config) -> dict[str, float]:
    """The lowest objective that a long descent finds of each problem."""
    journal = Journal(config.output / "lowest.json", {"steps": config.steps})
    left = [one for one in every if one.name not in journal.rows]
    refiner = gradient(optax.adam(optax.cosine_decay_schedule(0.1, config.steps)))

    @jax.jit
    def descend(prior, codes, targets):
        found = refine(
            jax.random.key(0), prior, codes, targets, refiner, config.steps,
            residual=EQUATION_7, space=whitened(prior),
        )  # fmt: skip
        return found.loss

    for start in track(range(0, len(left), config.at_a_time), description="lowest objectives"):
        began = time.perf_counter()
        batch = left[start : start + config.at_a_time]
        filled = [batch[i % len(batch)] for i in range(config.at_a_time)]  # compiled once
        codes = jnp.stack([one.first_code for one in filled])
        targets = jax.tree.map(lambda *x: jnp.stack(x), *[one.target for one in filled])
        losses = descend(batch[0].prior, codes, targets)
        rows = {one.name: float(f"{loss:.7g}") for one, loss in zip(batch, losses, strict=False)}
        journal.add(rows, time.perf_counter() - began)
    return {one.name: journal.rows[one.name] for one in every}


if __name__ == "__main__":
    main(tyro.cli(Config))
