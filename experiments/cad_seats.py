r"""The 78 CAD seats that all experiments are tested on, from two packages that anyone can install.

    mkdir packages && cd packages
    apt-get download sweethome3d-furniture && dpkg-deb -x sweethome3d-furniture_*.deb .
    npm pack open3dfloorplan@1.1.4 && tar -xzf open3dfloorplan-1.1.4.tgz && cd ..
    python experiments/cad_seats.py --packages packages/ --output cad_chairs/

Debian's `sweethome3d-furniture` 1.8-1 (any release that has it, or packages.debian.org) holds 67 of
them in furniture catalogues, whose rotations and sizes are applied; npm's `open3dfloorplan` holds
11 of Kenney's Furniture Kit. Which they are, what kind of seat, who made it and under which licence
(CC0 or CC-BY: name the creator) is listed in experiments/cad_seats.json.

Writes a folder of PLY files in the canonical frame (metres, +y up, front along +z, centred) and
manifest.json, which says of each what the list does. No model is trained on them. Time: 20 seconds.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from rich.progress import track

from jaxshape.data.meshes import MeshSource, Model, Skipped, list_meshes, load
from jaxshape.files import write_json
from jaxshape.results.surface import write_mesh

LIST = Path(__file__).with_suffix(".json")
SIZE_TOLERANCE = 0.002
"""Metres by which a seat may differ from the size in the list."""


@dataclass(frozen=True)
class Config:
    """Where from, and where to."""

    packages: Path = Path("packages")
    """The folder both packages were unpacked in: it has `usr/` and `package/`."""
    output: Path = Path("cad_chairs")
    """Folder to write."""


class Seat(NamedTuple):
    """One seat of the list."""

    name: str
    kind: str
    """chair, armchair, stool or other_seat."""
    title: str
    creator: str
    licence: str
    package: str
    """Name and version of the package that holds it."""
    file: str
    """Below the folder of the packages."""
    member: str | None
    """Inside the file, where that is a catalogue."""
    size: list[float]
    """Along x, y, z in metres, by which another version is told."""


def main(config: Config) -> None:
    try:
        collect(read_list(), config.packages, config.output)
    except ValueError as problem:
        raise SystemExit(str(problem)) from problem


def read_list(path: Path = LIST) -> list[Seat]:
    """The seats of a list, in its order."""
    return [Seat(**entry) for entry in json.loads(path.read_text(encoding="utf-8"))]


def collect(seats: Sequence[Seat], packages: Path, output: Path) -> None:
    """Write all seats and their manifest.

    `ValueError` where a seat is not found in its package, cannot be read, or has another size.
    """
    for seat in track(seats, description="CAD seats"):
        write_mesh(read_seat(seat, packages).mesh, output / f"{seat.name}.ply")
    write_json(output / "manifest.json", [seat._asdict() for seat in seats])


def read_seat(seat: Seat, packages: Path) -> Model:
    """One seat in the canonical frame, as its catalogue turns and scales it."""
    source = _sources(packages / seat.file).get(seat.member)
    found = None if source is None else load(source)
    if found is None or isinstance(found, Skipped):
        reason = f"is not in {packages / seat.file}" if found is None else found.detail
        raise ValueError(
            f"{seat.name} cannot be read: {seat.member or 'the mesh'} {reason}. It comes with "
            f"{seat.package}; unpack that version into {packages}, as "
            "experiments/cad_seats.py says at its top."
        )
    size = found.mesh.extents
    if not np.allclose(size, seat.size, atol=SIZE_TOLERANCE, rtol=0):
        raise ValueError(
            f"{seat.name} measures {np.round(size, 3).tolist()} m, but {seat.size} m were "
            f"expected: {packages / seat.file} is of another version than that of {seat.package}. "
            f"Unpack that one into {packages}."
        )
    return found


@cache
def _sources(file: Path) -> dict[str | None, MeshSource]:
    """The meshes of a file by member; none where there is no such file."""
    return {source.member: source for source in list_meshes(file)} if file.is_file() else {}


if __name__ == "__main__":
    main(tyro.cli(Config))
