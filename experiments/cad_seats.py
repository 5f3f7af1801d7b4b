r"""The 78 CAD seats and 62 CAD tables of the tests, from two packages that anyone can install.

    mkdir packages && cd packages
    apt-get download sweethome3d-furniture && dpkg-deb -x sweethome3d-furniture_*.deb .
    npm pack open3dfloorplan@1.1.4 && tar -xzf open3dfloorplan-1.1.4.tgz && cd ..
    python experiments/cad_seats.py --packages packages/ --output cad_chairs/
    python experiments/cad_seats.py --packages packages/ --output cad_tables/ --list tables

Debian's `sweethome3d-furniture` 1.8-1 (any release that has it, or packages.debian.org) holds 67
seats and 52 tables in furniture catalogues, whose rotations and sizes are applied; npm's
`open3dfloorplan` holds 11 and 10 of Kenney's Furniture Kit. experiments/cad_seats.json and
cad_tables.json list the pieces with their kind, their maker and their licence (CC0 or CC-BY: name
the creator). The tables are all tables of the packages, including desks and night stands, without
copies of a mesh in another material.

Writes a folder of PLY files in the canonical frame (metres, +y up, front along +z, centred) and
manifest.json, which repeats the entries of the list. No model is trained on them. Time: 20 seconds.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import tyro
from rich.progress import track

from jaxshape.data.meshes import MeshSource, Model, Skipped, list_meshes, load
from jaxshape.files import write_json
from jaxshape.results.surface import write_mesh

LISTS = {name: Path(__file__).with_name(f"cad_{name}.json") for name in ("seats", "tables")}
SIZE_TOLERANCE = 0.002
"""Largest difference between the size of a piece and its size in the list, in metres."""


@dataclass(frozen=True)
class Config:
    """Sources and output."""

    packages: Path = Path("packages")
    """The folder in which both packages were unpacked: it has `usr/` and `package/`."""
    output: Path = Path("cad_chairs")
    """Folder to write."""
    list: Literal["seats", "tables"] = "seats"
    """List of furniture to write."""


class Piece(NamedTuple):
    """A piece of furniture of a list."""

    name: str
    kind: str
    """chair, armchair, stool or other_seat; table, low_table or desk."""
    title: str
    creator: str
    licence: str
    package: str
    """Name and version of the package that holds it."""
    file: str
    """Path below the folder of the packages."""
    member: str | None
    """Name inside the file, if the file is a catalogue."""
    size: list[float]
    """Size along x, y, z in metres, which identifies the version."""


def main(config: Config) -> None:
    try:
        collect(read_list(LISTS[config.list]), config.packages, config.output)
    except ValueError as problem:
        raise SystemExit(str(problem)) from problem


def read_list(path: Path) -> list[Piece]:
    """The pieces of a list, in its order."""
    return [Piece(**entry) for entry in json.loads(path.read_text(encoding="utf-8"))]


def collect(pieces: Sequence[Piece], packages: Path, output: Path) -> None:
    """Write all pieces and their manifest.

    `ValueError` where a piece is not found in its package, cannot be read, or has another size.
    """
    for piece in track(pieces, description="CAD furniture"):
        write_mesh(read_piece(piece, packages).mesh, output / f"{piece.name}.ply")
    write_json(output / "manifest.json", [piece._asdict() for piece in pieces])


def read_piece(piece: Piece, packages: Path) -> Model:
    """A piece in the canonical frame, as its catalogue turns and scales it."""
    source = _sources(packages / piece.file).get(piece.member)
    found = None if source is None else load(source)
    if found is None or isinstance(found, Skipped):
        reason = f"is not in {packages / piece.file}" if found is None else found.detail
        raise ValueError(
            f"{piece.name} cannot be read: {piece.member or 'the mesh'} {reason}. It comes with "
            f"{piece.package}; unpack that version into {packages}, as "
            "experiments/cad_seats.py says at its top."
        )
    size = found.mesh.extents
    if not np.allclose(size, piece.size, atol=SIZE_TOLERANCE, rtol=0):
        raise ValueError(
            f"{piece.name} measures {np.round(size, 3).tolist()} m, but {piece.size} m were "
            f"expected: {packages / piece.file} is of another version than that of "
            f"{piece.package}. Unpack that one into {packages}."
        )
    return found


@cache
def _sources(file: Path) -> dict[str | None, MeshSource]:
    """The meshes of a file by member; none if the file is missing."""
    return {source.member: source for source in list_meshes(file)} if file.is_file() else {}


if __name__ == "__main__":
    main(tyro.cli(Config))
