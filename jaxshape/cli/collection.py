"""Checks of a folder of meshes before commands use it: units, axes, unusable meshes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxshape.cli.common import (
    console,
    named,
    progress_bar,
    report_notes,
    report_skipped,
    require,
    warn,
)
from jaxshape.cli.options import Axes

SAMPLE = 200
"""Number of meshes that are checked if a sample suffices."""

VOTERS = 12
"""Meshes that vote on the axes: each takes about a second."""


def find_meshes(path: Path) -> list[Any]:
    """The meshes (`MeshSource`) at a path; prints the other files found there."""
    from jaxshape.data.archives import list_meshes, passed_over

    sources = list_meshes(path)
    if others := passed_over(path):
        counts = ", ".join(f"{count} {suffix}" for suffix, count in others.most_common())
        console.print(f"[yellow]passed over[/] {counts}: not read here.", highlight=False)
    return sources


def look_at(sources: Sequence[Any], axes: Axes, workers: int | None = None) -> list[Any]:
    """The survey of each mesh (`Surveyed`), with a progress bar, and a warning about odd sizes."""
    from jaxshape.data.survey import doubted_size, survey

    found: list[Any] = [None] * len(sources)
    with progress_bar("meshes") as bar:
        task = bar.add_task("check", total=len(sources), note="")
        for number, one in survey(
            sources, up=axes.up, front=axes.front, unit=axes.unit, workers=workers
        ):
            found[number] = one
            bar.update(task, advance=1)
    sizes = [one.size for one in found if one.skipped is None]
    if doubt := doubted_size(sizes, axes.unit):
        warn(doubt)
    return found


def usable_of(
    sources: Sequence[Any], axes: Axes, *, alone: bool = True
) -> tuple[list[Any], list[Any]]:
    """The usable meshes (`Surveyed`) and the `Skipped` ones.

    `alone` raises if none is usable, and spreads the work over the cores; otherwise other processes
    have meshes as well, and use the other cores.
    """
    found = look_at(sources, axes, workers=None if alone else 1)
    skipped = [one.skipped for one in found if one.skipped is not None]
    usable = [one for one in found if one.skipped is None]
    report_skipped(skipped)
    report_notes((one.source.name, note) for one in usable for note in one.notes)
    require(
        bool(usable) or not alone,
        f"None of the {len(sources)} meshes can be used; the first is {skipped[0].name!r}: "
        f"{skipped[0].reason}. {skipped[0].detail}"
        if skipped
        else "",
    )
    return usable, skipped


# ------------------------------------------------------------------ axes


def turned(sources: Sequence[Any], axes: Axes, prior: Any = None) -> list[Any]:
    """The meshes; with --axes auto, each with the axes that were estimated for it."""
    if axes.axes == "given":
        return list(sources)
    from jaxshape.model.facing import dissenting, usual_axes

    scores = _scores(sources, axes, prior)
    if not scores:
        warn(
            "--axes auto works for seats only, and these meshes are not seats; --up and --front "
            "are used instead."
        )
        return list(sources)
    usual = usual_axes(scores, (axes.up, axes.front))
    others = dissenting(scores, usual)
    kept = len(scores) - len(others)
    console.print(f"{_flags(usual)} for {kept} meshes, other axes for {len(others)}.")
    return [source._replace(axes=others.get(source.name, usual)) for source in sources]


def check_surveyed(usable: Sequence[Any], axes: Axes, **how: Any) -> None:
    """`check_axes` of usable meshes, from their survey (`Surveyed`)."""
    lying = [one.source.name for one in usable if one.lies]
    check_axes([one.source for one in usable], lying, axes, **how)


def check_axes(
    sources: Sequence[Any],
    lying: Sequence[str],
    axes: Axes,
    *,
    prior: Any = None,
    refuse: bool = False,
) -> None:
    """Warn if the axes of a collection seem wrong, or differ between its meshes.

    `lying` holds the names of meshes that seem to lie on their side. If most meshes do and they are
    certainly seats, the collection can be refused.
    """
    from jaxshape.data.survey import evenly
    from jaxshape.model.facing import dissenting, usual_axes

    if axes.axes == "auto":
        return
    given, count = (axes.up, axes.front), len(sources)
    if 2 * len(lying) > count:
        scores = _scores(evenly(sources, VOTERS), axes, prior)
        if not scores and not refuse:  # these are not seats
            return
        standing = usual_axes(scores, ("z", "-y"))
        complaint = (
            f"{len(lying)} of {count} meshes seem to lie on their side{{}}, for example "
            f"{lying[0]!r}; name the axis that points up, for example {_flags(standing)}."
        )
        require(not refuse, complaint.format(""))
        return warn(complaint.format(", if they are seats"))
    if lying:
        warn(
            f"{len(lying)} of {count} meshes seem to lie on their side, if they are seats: "
            f"{named(lying)}; --axes auto turns each of them."
        )
    upright = [source for source in sources if source.name not in lying]
    scores = _scores(evenly(upright, VOTERS), axes, prior, ups=(axes.up,))
    usual = usual_axes(scores, given)
    others = dissenting(scores, given)
    if usual != given and 2 * len(others) > len(scores):
        warn(
            f"{len(others)} of {len(scores)} meshes that were looked at seem to face another way, "
            f"for example {next(iter(others))!r}; give {_flags(usual)}."
        )
    elif others:
        warn(
            f"{len(others)} of {len(scores)} meshes that were looked at seem to face another way "
            f"than the rest: {named(list(others))}; --axes auto turns each of them."
        )


def _flags(pair: tuple[str, str]) -> str:
    return f"--up {pair[0]} --front {pair[1]}"


def _scores(
    sources: Sequence[Any], axes: Axes, prior: Any, ups: tuple[str, ...] | None = None
) -> dict[str, Any]:
    """Scores of each pair of axes for each mesh; empty if no prior knows this kind of object.
    `prior` knows its own kind, and the weights for chairs know seats."""
    from jaxshape.data.dataset import LoadedWhenNeeded
    from jaxshape.data.meshes import Skipped, resembles_a_seat
    from jaxshape.model.facing import are_known, facing_scores
    from jaxshape.model.weights import load_prior

    models = LoadedWhenNeeded(sources, unit=axes.unit)
    if prior is None:
        seats = [resembles_a_seat(one.mesh) for one in models if not isinstance(one, Skipped)]
        if 2 * sum(seats) <= len(seats):
            return {}
    known = load_prior(None) if prior is None else prior
    with progress_bar("meshes") as bar:
        task = bar.add_task("axes", note="")
        scores = {
            model.name: facing_scores(known, model.mesh, ups)
            for model in bar.track(models, task_id=task)
            if not isinstance(model, Skipped)
        }
    return scores if prior is not None or are_known(scores) else {}
