from .bench.ask_tell import AskTell
from .bench.own_loop import Watch, enter_benchmark
from .bench.problems import Problem, problems
from .data.archives import MeshSource
from .data.boxes import Box
from .data.capture import (
    Capture,
    camera_distance,
    capture,
    fuse_frames,
    measure_frames,
    sensor_of,
)
from .data.chairs import random_chair
from .data.meshes import Model, Skipped, load, read_meshes
from .data.sequences import (
    Pinhole,
    Trajectory,
    open_sequence,
    read_trajectory,
    write_trajectory,
)
from .data.tables import random_table
from .data.virtual_cameras import SensorNoise, VirtualCamera, virtual_camera
from .geometry.camera import Intrinsics, orbit, random_views
from .geometry.distance import DistanceField
from .geometry.evidence import soft_grids
from .geometry.fusion import Measurement, measure, merge, merge_all, occluded, occupied
from .geometry.grid import GridFrame, fit_box, fit_box_isotropic
from .geometry.grids import Grids, binary
from .geometry.overlap import iou
from .geometry.pixels import Sensor
from .mapping.config import MappingConfig, TrackingConfig
from .mapping.map.mapper import Mapper, build_mapper
from .mapping.map.recording import Progress, follow, trajectory
from .mapping.placement.finding import Start, find_start
from .mapping.placement.placing import Placement, PlacementConfig, place
from .mapping.scene.classes import Decision, SceneClasses, build_classes
from .mapping.scene.following import Scene, SceneObject, finish_scene, follow_scene
from .mapping.segmentation.segment import Prompt, Segmentation, segment
from .mapping.tracking.keyframes import PreparedFrame
from .mapping.views.candidates import reachable_views
from .mapping.views.gain import NextViews, next_views
from .model.calibration import Calibration
from .model.config import Architecture
from .model.shapes import Prepared, ShapeModel, ShapePrior, decode, decode_prepared, encode
from .model.weights import load_prior, save_prior
from .report.page import write_report
from .results.fused_surface import FusedSurface, fuse_surface
from .results.metrics import (
    Bounds,
    Reliability,
    ShapeScores,
    bounds,
    chamfer_l1,
    f_score,
    reliability,
    shape_scores,
)
from .results.surface import surface, write_mesh
from .search.calibrating import fit_calibration
from .search.cma import CmaState, cma_ask, cma_start, cma_tell
from .search.composition import Composition, best_threshold, complete, compose
from .search.config import RefineConfig
from .search.export import export_reconstruct, load_reconstruct
from .search.methods import build_refiner
from .search.methods.cma import cma
from .search.methods.evosax import evosax_strategy
from .search.methods.gauss_newton import gauss_newton
from .search.methods.gradient import gradient
from .search.methods.hybrid import polished
from .search.objective import objective
from .search.posterior import hypotheses, sample_codes
from .search.reconstruction import (
    Reconstruction,
    fit_surface,
    reconstruct,
    refiner_for,
)
from .search.refiner import (
    Candidate,
    Distribution,
    Refiner,
    StopReason,
    Trace,
    finite_or_inf,
    keep_better,
    start_trace,
    summarise,
)
from .search.residuals import (
    BALANCED,
    PAPER,
    SOFT,
    Residual,
    Target,
    Weights,
    cross_entropy,
    equation_7,
    soft,
    weigh,
)
from .search.restarts import with_restarts
from .search.run import Refined, refine
from .search.space import LatentSpace, raw, whitened
from .search.stopping import Tolerances

__all__ = [
    "Architecture",
    "AskTell",
    "BALANCED",
    "Bounds",
    "Box",
    "Calibration",
    "Candidate",
    "Capture",
    "CmaState",
    "Composition",
    "Decision",
    "DistanceField",
    "Distribution",
    "FusedSurface",
    "GridFrame",
    "Grids",
    "Intrinsics",
    "LatentSpace",
    "Mapper",
    "MappingConfig",
    "Measurement",
    "MeshSource",
    "Model",
    "NextViews",
    "PAPER",
    "Pinhole",
    "Placement",
    "PlacementConfig",
    "Prepared",
    "PreparedFrame",
    "Problem",
    "Progress",
    "Prompt",
    "Reconstruction",
    "RefineConfig",
    "Refined",
    "Refiner",
    "Reliability",
    "Residual",
    "SOFT",
    "Scene",
    "SceneClasses",
    "SceneObject",
    "Segmentation",
    "Sensor",
    "SensorNoise",
    "ShapeModel",
    "ShapePrior",
    "ShapeScores",
    "Skipped",
    "Start",
    "StopReason",
    "Target",
    "Tolerances",
    "Trace",
    "TrackingConfig",
    "Trajectory",
    "VirtualCamera",
    "Watch",
    "Weights",
    "best_threshold",
    "binary",
    "bounds",
    "build_classes",
    "build_mapper",
    "build_refiner",
    "camera_distance",
    "capture",
    "chamfer_l1",
    "cma",
    "cma_ask",
    "cma_start",
    "cma_tell",
    "complete",
    "compose",
    "cross_entropy",
    "decode",
    "decode_prepared",
    "encode",
    "enter_benchmark",
    "equation_7",
    "evosax_strategy",
    "export_reconstruct",
    "f_score",
    "find_start",
    "finish_scene",
    "finite_or_inf",
    "fit_box",
    "fit_box_isotropic",
    "fit_calibration",
    "fit_surface",
    "follow",
    "follow_scene",
    "fuse_frames",
    "fuse_surface",
    "gauss_newton",
    "gradient",
    "hypotheses",
    "iou",
    "keep_better",
    "load",
    "load_prior",
    "load_reconstruct",
    "measure",
    "measure_frames",
    "merge",
    "merge_all",
    "next_views",
    "objective",
    "occluded",
    "occupied",
    "open_sequence",
    "orbit",
    "place",
    "polished",
    "problems",
    "random_chair",
    "random_table",
    "random_views",
    "raw",
    "reachable_views",
    "read_meshes",
    "read_trajectory",
    "reconstruct",
    "refine",
    "refiner_for",
    "reliability",
    "sample_codes",
    "save_prior",
    "segment",
    "sensor_of",
    "shape_scores",
    "soft",
    "soft_grids",
    "start_trace",
    "summarise",
    "surface",
    "trajectory",
    "virtual_camera",
    "weigh",
    "whitened",
    "with_restarts",
    "write_mesh",
    "write_report",
    "write_trajectory",
]
