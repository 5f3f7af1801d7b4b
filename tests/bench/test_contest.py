"""A search on problems is the search that it is elsewhere, in any company."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxshape.bench.contest import contestant
from jaxshape.bench.problems import EQUATION_7
from jaxshape.bench.scoring import LADDER, rows_of
from jaxshape.search.config import RefineConfig
from jaxshape.search.methods import build_refiner
from jaxshape.search.run import refine
from jaxshape.search.space import whitened

pytestmark = pytest.mark.usefixtures("compile_quickly")
CONFIG = RefineConfig(population=4, tolerance=0.0)


def searched(method, problems, budget=64):
    search, alone = contestant(method, problems[0], CONFIG, budget)
    found = search(problems, 0)
    return rows_of(problems, found.observer, found.stops), alone


def test_adam_walks_as_it_does_in_refine(two, linear_prior):
    """After c decoder calls, c / 3 gradients were taken."""
    rows, alone = searched("gradient:adam", two)
    refiner = build_refiner("gradient:adam", linear_prior.code_size, CONFIG)
    codes = jnp.stack([one.first_code for one in two])
    targets = jax.tree.map(lambda *x: jnp.stack(x), *[one.target for one in two])
    found = refine(
        jax.random.key(0), linear_prior, codes, targets, refiner, 21,
        residual=EQUATION_7, space=whitened(linear_prior),
    )  # fmt: skip
    assert not alone
    for i, one in enumerate(two):
        steps = [rung // 3 for rung in LADDER if 0 < rung < 64]
        expected = np.asarray(found.trace.best_loss)[i, np.array(steps) - 1]
        got = rows[one.name]["objective"][1 : len(steps) + 1]
        np.testing.assert_allclose(got, expected, rtol=1e-5)
        assert rows[one.name]["calls"] == 66 and rows[one.name]["stop"] == "budget"


def test_a_line_search_has_its_problem_to_itself(two):
    rows, alone = searched("gradient:lbfgs", two[:1])
    (row,) = rows.values()
    assert alone and row["objective"][-1] < row["objective"][0]


def test_an_objective_may_be_evaluated_in_a_branch_of_a_batch(two):
    """As in the line search of a loop of one's own."""

    def lowered(code):
        loss = two[0].objective
        return jax.lax.cond(code[0] > 0, loss, lambda code: loss(code) + 1, code)

    codes = jnp.stack([two[0].first_code.at[0].set(sign) for sign in (1.0, -1.0)])
    expected = [two[0].objective(codes[0]), two[0].objective(codes[1]) + 1]
    np.testing.assert_allclose(jax.jit(jax.vmap(lowered))(codes), expected, rtol=1e-6)


def test_a_population_does_not_depend_on_its_company(two):
    together, _ = searched("evosax:SNES", two)
    alone, _ = searched("evosax:SNES", two[1:])
    one, other = together[two[1].name], alone[two[1].name]
    assert one["calls"] == other["calls"] == 64
    np.testing.assert_allclose(one["objective"], other["objective"], rtol=1e-5)
    assert one["objective"][-1] < one["objective"][0]


def test_pycma_is_asked_and_told(two):
    pytest.importorskip("cma")
    rows, _ = searched("pycma", two)
    for row in rows.values():
        assert row["calls"] == 64 and row["objective"][-1] < row["objective"][0]


STRANGER = """
import jaxshape as js

class Halve:
    def __init__(self, seed, point, loss):
        self.point, self.asked = point, 0

    def ask(self):
        self.asked += 1
        return self.point[None] / 2**self.asked

    def tell(self, points, losses):
        return "tired" if self.asked == 3 else None

def build(variant, dim, config):
    return js.AskTell(Halve)

def wrong(variant, dim, config):
    return Halve
"""


def test_a_search_on_the_host_goes_by_its_import_path(two, tmp_path, monkeypatch):
    (tmp_path / "halving_stranger.py").write_text(STRANGER)
    monkeypatch.syspath_prepend(tmp_path)
    try:
        rows, _ = searched("halving_stranger:build", two)
        assert [(row["calls"], row["stop"]) for row in rows.values()] == [(3, "tired")] * 2
        with pytest.raises(
            ValueError, match="must return a jaxshape.Refiner or a jaxshape.AskTell"
        ):
            contestant("halving_stranger:wrong", two[0], CONFIG, 64)
    finally:
        sys.modules.pop("halving_stranger", None)


ODD = """
import numpy as np
import jaxshape as js

def asks(points):
    class Search:
        def __init__(self, seed, point, loss):
            self.point = point

        def ask(self):
            return points(self.point)

        def tell(self, points, losses):
            return None

    return lambda variant, dim, config: js.AskTell(Search)

nothing = asks(lambda point: point[None][:0])
one = asks(lambda point: point)
lost = asks(lambda point: np.nan * point[None])
"""


def test_a_search_on_the_host_that_proposes_no_points_ends(two, tmp_path, monkeypatch):
    (tmp_path / "odd_stranger.py").write_text(ODD)
    monkeypatch.syspath_prepend(tmp_path)
    try:
        for name, shape in {"nothing": r"\(0, 10\)", "one": r"\(10,\)"}.items():
            with pytest.raises(ValueError, match=f"returned shape {shape}; it must return points"):
                searched(f"odd_stranger:{name}", two)
        rows, _ = searched("odd_stranger:lost", two)
        assert [(row["calls"], row["stop"]) for row in rows.values()] == [(0, "budget")] * 2
    finally:
        sys.modules.pop("odd_stranger", None)
