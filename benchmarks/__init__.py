"""How fast jaxshape is, against what a user would reach for otherwise, and against the machine.

    python -m benchmarks                      everything (about half an hour on two cores)
    python -m benchmarks --quick --gate       everything, shorter; fails where it got worse
    python -m benchmarks --only decode fusion

A benchmark is a module with `run(quick) -> list[Metric]`. Rivals run in the same process on the
same weights and inputs, in turns with ours; what is compared with `baseline.json` are ratios, which
carry over between machines far better than times do.
"""

NAMES = (
    "fusion", "completion", "decode", "refinement", "training", "scaling", "startup", "precision",
    "tracking",
)  # fmt: skip
"""The benchmarks, in the order they run."""
