"""Your own search on the board of the benchmark: descent whose steps grow while they succeed.

python docs/examples/own_entry.py board/    # a few minutes; then draw the board:
jaxshape bench --methods "" --output board
"""

import sys

import jax
import jax.numpy as jnp

import jaxshape as js

BUDGET, PROBLEMS = 512, {"objects": 8, "frames": (4,)}


def descend(watch, slope_of, number):
    """Steps along the gradient, longer after each gain, half as long after each loss."""
    space, length = js.whitened(watch.problems[0].prior), 1.0
    watch.begin(number)  # starts to count its decoder calls and its time
    point = space.from_code(watch.problems[number].first_code)
    loss, slope = slope_of(space, point, number)
    while not watch.spent(number):
        trial = point - length * slope / jnp.linalg.norm(slope)
        new_loss, new_slope = slope_of(space, trial, number)
        length *= 1.2 if new_loss < loss else 0.5
        if new_loss < loss:
            point, loss, slope = trial, new_loss, new_slope


if __name__ == "__main__":
    watch = js.Watch(js.problems(**PROBLEMS), BUDGET)
    loss = lambda space, point, number: watch.objective(space.to_code(point), number)  # noqa: E731
    slope_of = jax.jit(jax.value_and_grad(loss, argnums=1))
    descend(watch, slope_of, 0)  # compiles
    for number in range(len(watch.problems)):
        descend(watch, slope_of, number)
    rows = watch.rows()
    path = js.enter_benchmark(sys.argv[1], "bold descent", rows, budget=BUDGET)
    gain = sum(row["iou"][-1] - row["iou"][0] for row in rows.values()) / len(rows)
    print(f"{path} has {len(rows)} problems; the IoU gained {gain:.3f} on average.")
