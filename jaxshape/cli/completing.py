"""`jaxshape complete`: one object from a point cloud or a fused model."""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from jaxshape.claim import Output
from jaxshape.cli.common import console, require, warn
from jaxshape.cli.rebuild import Rebuild, report_objective, written
from jaxshape.data.config import Axis, UnitName


@dataclass(frozen=True, kw_only=True)
class Complete(Rebuild):
    """Complete a point cloud or a fused model of a single object.

    The prior finds which axes of the file point up and to the front. Free space is known along rays
    from --sensor to the points or, to a lesser extent, from normals in the file; without both,
    every unmeasured voxel is predicted.

    Examples: jaxshape complete scan.ply

    jaxshape complete scan.pcd --up z --front -y --sensor 0 0 0
    """

    scan: Positional[Path]
    """A .ply file of points (with or without normals) or of triangles, or a .pcd file."""
    up: Axis | None = None
    """Axis of the file that points up; estimated by default."""
    front: Axis | None = None
    """Axis of the file towards which the object faces; estimated by default."""
    unit: UnitName | None = None
    """Unit of the file; by default the one of m, cm and mm with which the cloud is as large as an
    object in a room."""
    sensor: tuple[float, float, float] | None = None
    """Position of the sensor, in the frame and unit of the file, if all points were measured from
    one position; a .pcd file may contain it."""
    output: Path = Path("out/complete")
    """Folder for mesh.glb (in metres), mesh.ply (in the frame and the unit of the file), grid.npz,
    result.json, overview.png and report.html. If the coordinates of the file are too large for the
    single precision of meshes, mesh.ply lacks their `offset` in result.json."""

    @property
    def writes(self) -> Output:
        """The output folder."""
        return Output(self.output)

    def run(self) -> None:
        start = time.perf_counter()
        import numpy as np

        from jaxshape.data.clouds import moved, offset_of, read_cloud
        from jaxshape.mapping.map.doubts import unseen_of_points
        from jaxshape.mapping.placement.cloud_placing import cloud_grids, place_cloud
        from jaxshape.mapping.tracking.keyframes import place_of
        from jaxshape.results.output import Observation
        from jaxshape.results.summary import verdict_in_words
        from jaxshape.search.reconstruction import require_measured

        mesh = self.output / "mesh.ply"
        require(
            self.scan.resolve() != mesh.resolve(),
            f"{str(self.scan)!r} would be overwritten by the result; give another --output.",
        )
        cloud = read_cloud(self.scan, seed=self.seed)
        if self.sensor is not None:
            require(bool(np.isfinite(self.sensor).all()), "--sensor is not finite; give x y z.")
            cloud = cloud._replace(sensor=np.array(self.sensor))
        offset = offset_of(cloud)
        cloud = moved(cloud, -offset)
        prior, refiner, config = self.prepare()
        with console.status("finding which way is up"):
            placed = place_cloud(
                cloud,
                self.placer(prior),
                up=self.up,
                front=self.front,
                unit=self.unit,
                seed=self.seed,
            )
        warnings = [*placed.warnings, *_of_rays(cloud), *_of_offset(offset)]
        for warning in warnings:
            warn(warning)
        cloud = placed.cloud
        frame = place_of(placed.box, prior.resolution).frame
        grids = cloud_grids(cloud, placed, frame, prior.resolution, seed=self.seed)
        require_measured(np.asarray(grids.occupied))
        found = self.searched(prior, refiner, config, grids)
        T, size = placed.box.T_world_object, placed.box.size
        points = (placed.metres * np.asarray(cloud.points, np.float64) - T[:3, 3]) @ T[:3, :3]
        observation = Observation(
            depth=[],
            occupied=np.asarray(grids.occupied),
            occluded=np.asarray(grids.occluded),
            frame=frame,
            T_world_object=np.diag([1 / placed.metres] * 3 + [1.0]) @ T,
            truth=None,
            cloud=points,
            unseen=unseen_of_points(points, size),
        )
        figures: dict[str, Any] = {"object": str(self.scan), **self.settings(prior, "points")}
        figures |= {"points": len(cloud.points), "up": placed.up, "metres_in_a_unit": placed.metres}
        figures |= {"offset": offset.tolist()}
        figures["box"] = {"T_world_object": T.tolist(), "size": size.tolist()}
        figures |= {"warnings": warnings, "seconds": round(time.perf_counter() - start, 2)}
        result = written(self.output, observation, found, figures)
        extents = " x ".join(f"{extent:.2f}" for extent in size)
        print(f"{len(cloud.points)} points of an object of {extents} m, {placed.up} is up")
        report_objective(result)
        print(verdict_in_words(result))
        print(f"wrote mesh.glb, mesh.ply, result.json, overview.png, report.html to {self.output}")
        if result["verdict"] == "failed":
            sys.exit(3)


def _of_rays(cloud: Any) -> list[str]:
    if cloud.sensor is not None or cloud.normals is not None:
        return []
    return [
        "Neither the sensor's position nor normals are known, so free space cannot be "
        "distinguished from unseen surface; give --sensor, or a file with normals."
    ]


def _of_offset(offset: Any) -> list[str]:
    if not offset.any():
        return []
    said = " ".join(f"{x:.0f}" for x in offset)
    return [f"The coordinates are large: mesh.ply lies at {said} less than those of the file."]
