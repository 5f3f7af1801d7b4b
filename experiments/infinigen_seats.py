"""Seats by another author: chairs, office chairs, bar stools, armchairs and sofas of Infinigen.

    python3.11 -m venv .venv-infinigen
    .venv-infinigen/bin/pip install --no-deps infinigen==1.15.5 bpy==4.2.0
    .venv-infinigen/bin/pip install "numpy<2" "trimesh<3.23" "shapely<=2.0.5" \\
        "opencv-python-headless<4.9" gin-config scipy scikit-image scikit-learn networkx tqdm \\
        pandas geomdl psutil imageio matplotlib OpenEXR requests zstandard rtree submitit
    .venv-infinigen/bin/python experiments/infinigen_seats.py --output data/infinigen

makes 128 seats as PLY files, +y up and front along +z, in metres: 1 to 11 s each on one core. The
generators come from Infinigen Indoors (Raistrick et al. 2024, BSD licence), +x front and +z up.
This script does not depend on jaxshape, nor jaxshape on it. The shipped weights are scored by

    jaxshape evaluate --meshes data/infinigen --output infinigen.json
"""

import argparse
import sys
import time
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np
import trimesh
from infinigen.assets.objects.seating.chairs.bar_chair import BarChairFactory  # pyright: ignore[reportMissingImports]
from infinigen.assets.objects.seating.chairs.chair import ChairFactory  # pyright: ignore[reportMissingImports]
from infinigen.assets.objects.seating.chairs.office_chair import OfficeChairFactory  # pyright: ignore[reportMissingImports]
from infinigen.assets.objects.seating.sofa import ArmChairFactory, SofaFactory  # pyright: ignore[reportMissingImports]

GENERATORS = {
    "chair": ChairFactory,
    "office-chair": OfficeChairFactory,
    "bar-stool": BarChairFactory,
    "armchair": ArmChairFactory,
    "sofa": SofaFactory,
}
"""The generators; each makes every fifth seat."""


def make_seat(kind: str, seed: int) -> trimesh.Trimesh:
    """A seat in the frame of jaxshape: Infinigen's (y, z, x)."""
    # An empty file: what earlier seats leave behind makes each next one slower.
    bpy.ops.wm.read_factory_settings(use_empty=True)
    made = GENERATORS[kind](seed).spawn_asset(0)
    graph = bpy.context.evaluated_depsgraph_get()
    whole = made.evaluated_get(graph)
    mesh = whole.to_mesh()
    mesh.calc_loop_triangles()
    vertices = np.empty((len(mesh.vertices), 3))
    faces = np.empty((len(mesh.loop_triangles), 3), int)
    mesh.vertices.foreach_get("co", vertices.ravel())
    mesh.loop_triangles.foreach_get("vertices", faces.ravel())
    placed = trimesh.Trimesh(vertices, faces, process=False).apply_transform(made.matrix_world)
    return trimesh.Trimesh(placed.vertices[:, [1, 2, 0]], faces, process=False)


def main() -> None:
    parser = argparse.ArgumentParser(description="Make seats by Infinigen.")
    parser.add_argument("--output", type=Path, default=Path("data/infinigen"))
    parser.add_argument("--seats", type=int, default=128, help="How many seats to make.")
    parser.add_argument("--seed", type=int, default=0, help="Seed of the first seat.")
    config = parser.parse_args()
    config.output.mkdir(parents=True, exist_ok=True)
    for seed in range(config.seed, config.seed + config.seats):
        kind = list(GENERATORS)[seed % len(GENERATORS)]
        path = config.output / f"{kind}-{seed:05d}.ply"
        if path.exists():
            continue
        start = time.perf_counter()
        seat = make_seat(kind, seed)
        unfinished = path.with_suffix(".part")
        unfinished.write_bytes(seat.export(file_type="ply"))
        unfinished.rename(path)
        size = " x ".join(f"{x:.2f}" for x in seat.extents)
        seconds = time.perf_counter() - start
        print(f"{path.name}: {size} m, {len(seat.faces)} triangles, {seconds:.1f} s", flush=True)


if __name__ == "__main__":
    sys.exit(main())
