from .data.capture import Capture, capture, measure_frames
from .data.chairs import random_chair
from .data.meshes import load, read_meshes
from .data.sequences import Trajectory, open_sequence, read_trajectory, write_trajectory
from .data.virtual_cameras import CAMERAS, SensorNoise, VirtualCamera
from .geometry.camera import Intrinsics, orbit, random_views
from .geometry.fusion import Measurement, measure, merge, merge_all, occluded, occupied
from .geometry.grid import GridFrame, fit_box, fit_box_isotropic
from .mapping.config import MappingConfig, TrackingConfig
from .mapping.finding import find_start
from .mapping.incremental import Mapper, build_mapper
from .mapping.keyframes import Shot
from .mapping.placement import Placement, PlacementConfig, place
from .mapping.recording import Progress, follow, trajectory
from .mapping.segmentation import Prompt, Segmentation, segment
from .model.autoencoder import PreparedDecoder, decode, encode, initialize, prepare_decoder
from .model.config import Architecture
from .model.weights import ShapePrior, load_prior, save_prior
from .results.metrics import bounds, chamfer_l1, f_score, iou, shape_scores
from .results.report import write_report
from .results.surface import surface, write_mesh
from .search.cma import cma
from .search.config import RefineConfig
from .search.methods import build_refiner
from .search.methods.evosax import evosax_strategy
from .search.methods.gradient import gradient
from .search.methods.hybrid import polished
from .search.objective import Target, Weights, objective, target
from .search.reconstruction import (
    Reconstruction,
    compose,
    fit_surface,
    reconstruct,
    refiner_for,
)
from .search.refiner import Distribution, Refiner, StopReason, Trace
from .search.restarts import with_restarts
from .search.run import Refined, refine
from .search.space import LatentSpace, raw, whitened
from .search.stopping import Tolerances

__all__ = [
    "CAMERAS",
    "Architecture",
    "Capture",
    "Distribution",
    "GridFrame",
    "Intrinsics",
    "LatentSpace",
    "Mapper",
    "MappingConfig",
    "Measurement",
    "Placement",
    "PlacementConfig",
    "PreparedDecoder",
    "Progress",
    "Prompt",
    "Reconstruction",
    "RefineConfig",
    "Refined",
    "Refiner",
    "Segmentation",
    "SensorNoise",
    "ShapePrior",
    "Shot",
    "StopReason",
    "Target",
    "Tolerances",
    "Trace",
    "TrackingConfig",
    "Trajectory",
    "VirtualCamera",
    "Weights",
    "bounds",
    "build_mapper",
    "build_refiner",
    "capture",
    "chamfer_l1",
    "cma",
    "compose",
    "decode",
    "encode",
    "evosax_strategy",
    "f_score",
    "find_start",
    "fit_box",
    "fit_box_isotropic",
    "fit_surface",
    "follow",
    "gradient",
    "initialize",
    "iou",
    "load",
    "load_prior",
    "measure",
    "measure_frames",
    "merge",
    "merge_all",
    "objective",
    "occluded",
    "occupied",
    "open_sequence",
    "orbit",
    "place",
    "polished",
    "prepare_decoder",
    "random_chair",
    "random_views",
    "raw",
    "read_meshes",
    "read_trajectory",
    "reconstruct",
    "refine",
    "refiner_for",
    "save_prior",
    "segment",
    "shape_scores",
    "surface",
    "target",
    "trajectory",
    "whitened",
    "with_restarts",
    "write_mesh",
    "write_report",
    "write_trajectory",
]
