"""The virtual depth camera of the paper (section 2.3), and the noise of a real one. [host]

Each pixel casts one ray through its centre. The first triangle that it hits hides all others; the
depth is that of the point where the ray intersects the plane of this triangle.
"""

import jax.numpy as jnp
import jaxlie
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from trimesh.ray import has_embree

from jaxshape.data.rays import rasterize
from jaxshape.data.virtual_cameras import CAMERAS, SensorNoise, VirtualCamera
from jaxshape.geometry.camera import Intrinsics

IMAGE_SIZE = CAMERAS["paper"].width
"""Pixels along each side of the paper's square images."""

TILE = 4
"""Side, in pixels, of the squares in which either all rays are cast or none."""

WINDOW_STEP = 8
"""Window sizes are multiples of this number of pixels, so that few compiled programs suffice."""


def fit_intrinsics(
    mesh: trimesh.Trimesh, T_object_camera: jaxlie.SE3, image_size: int = IMAGE_SIZE
) -> Intrinsics:
    """The largest focal length with which every view shows the mesh's whole bounding box."""
    corners = _corners(mesh, np.asarray(T_object_camera.as_matrix()))
    reach = np.abs(corners[..., :2] / corners[..., 2:]).max()
    focal = (image_size / 2 - 1) / reach
    center = image_size / 2
    return Intrinsics(*jnp.array([focal, focal, center, center], jnp.float32))


def window(
    camera: VirtualCamera, mesh: trimesh.Trimesh, T_object_camera: jaxlie.SE3, margin: float = 0.0
) -> tuple[Intrinsics, tuple[int, int]]:
    """The part of a camera's images that can show a mesh, the same for all views.

    It contains the sphere around the mesh. Rays outside hit nothing, so they are not cast and their
    pixels are not kept. For a camera that looks at the centre from its usual distance, the window
    is the same for all meshes, so that one compiled program serves all of them.

    Args:
        camera: The camera. Its whole image is kept if its focal length is fitted to the mesh.
        mesh: The mesh in the object frame, in metres.
        T_object_camera: One pose per view.
        margin: Margin of the sphere around the mesh's bounding box, as a share of its radius.

    Returns:
        Intrinsics with the principal point relative to the window's corner, and the window's height
        and width in pixels.
    """
    if camera.field_of_view is None:
        return fit_intrinsics(mesh, T_object_camera, camera.width), (camera.height, camera.width)
    focal = camera.width / 2 / np.tan(np.deg2rad(camera.field_of_view) / 2)
    image = np.array([camera.width, camera.height])
    low, high = np.zeros(2), image
    poses = np.asarray(T_object_camera.as_matrix())
    center = np.einsum("vij,vi->vj", poses[:, :3, :3], mesh.bounds.mean(axis=0) - poses[:, :3, 3])
    radius = (1 + margin) * mesh.scale / 2
    if (center[:, 2] > radius).all():
        middle = np.arctan2(center[:, :2], center[:, 2:])
        reach = np.arcsin(radius / np.hypot(center[:, :2], center[:, 2:]))
        low, high = (focal * np.tan(middle + sign * reach) for sign in (-1, 1))
        low, high = low.min(axis=0) + image / 2, high.max(axis=0) + image / 2
        low = (np.floor(low / WINDOW_STEP) * WINDOW_STEP).clip(0, image - 1)
        high = (np.ceil(high / WINDOW_STEP) * WINDOW_STEP).clip(low + 1, image)
    intrinsics = jnp.array([focal, focal, *(image / 2 - low)], jnp.float32)
    return Intrinsics(*intrinsics), (int(high[1] - low[1]), int(high[0] - low[0]))


def render_depth(
    mesh: trimesh.Trimesh,
    T_object_camera: jaxlie.SE3,
    intrinsics: Intrinsics,
    image_size: int | tuple[int, int] = IMAGE_SIZE,
) -> tuple[Float[np.ndarray, "views h w"], Float[np.ndarray, "views h w"]]:
    """Depth images of a mesh, in metres, and each pixel's cosine between ray and surface normal.

    Depth is infinite where the ray hits nothing; the cosine is 1 there. `T_object_camera` holds one
    pose per view; `image_size` is the side of square images, or height and width. Visibility is
    exact: the nearest of all triangles on a ray counts.
    """
    size = (image_size, image_size) if isinstance(image_size, int) else image_size
    rays = _rays(intrinsics, size)
    poses = np.asarray(T_object_camera.as_matrix())
    may_hit = _may_hit(mesh, poses, intrinsics, size).reshape(len(poses), -1)
    corners, normals = mesh.triangles[:, 0], mesh.face_normals
    depth = np.full(may_hit.shape, np.inf, np.float32)
    cosine = np.ones_like(depth)
    for i, pose in enumerate(poses):  # one view at a time stays in the processor's cache
        pixel, origin = np.flatnonzero(may_hit[i]), pose[:3, 3]
        directions = rays[pixel] @ pose[:3, :3].T
        if has_embree:
            origins = np.broadcast_to(origin, directions.shape)
            triangle = mesh.ray.intersects_first(origins, directions)
        else:
            seen = (mesh.triangles - origin) @ pose[:3, :3]
            x, y = rays[: size[1], 0], rays[:: size[1], 1]
            triangle = rasterize(seen, seen[..., 2], x, y).ravel()[pixel]
        hit = np.flatnonzero(triangle >= 0)
        pixel, triangle, directions = pixel[hit], triangle[hit], directions[hit]
        facing = _dot(normals[triangle], directions)
        to_plane = _dot(normals, corners - origin)[triangle]
        in_plane = np.abs(facing) <= 1e-9  # the ray lies in the plane
        depth[i, pixel] = np.where(in_plane, np.inf, to_plane / np.where(in_plane, 1, facing))
        length = np.sqrt(_dot(directions, directions))
        cosine[i, pixel] = np.where(in_plane, 0, np.abs(facing)) / length
    return depth.reshape(-1, *size), cosine.reshape(-1, *size)


def _rays(intrinsics: Intrinsics, size: tuple[int, int]) -> Float[np.ndarray, "n 3"]:
    """Directions through the centres of all pixels; z is 1, so the ray parameter is the depth."""
    fx, fy, cx, cy = (np.float32(x) for x in intrinsics)
    row, column = np.indices(size, np.float32) + np.float32(0.5)
    one = np.float32(1)  # a product with the reciprocal, as compilers write divisions
    rays = [(column - cx) * (one / fx), (row - cy) * (one / fy), np.ones_like(row)]
    return np.stack(rays, axis=-1).reshape(-1, 3)


def _dot(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _corners(
    mesh: trimesh.Trimesh, poses: Float[np.ndarray, "views 4 4"]
) -> Float[np.ndarray, "views 8 3"]:
    """The corners of the mesh's bounding box in the frame of each camera."""
    offsets = trimesh.bounds.corners(mesh.bounds) - poses[:, None, :3, 3]
    return offsets @ poses[:, :3, :3]  # the inverse of a rotation is its transpose


def _may_hit(
    mesh: trimesh.Trimesh,
    poses: Float[np.ndarray, "views 4 4"],
    intrinsics: Intrinsics,
    size: tuple[int, int],
) -> Bool[np.ndarray, "views h w"]:
    """Pixels in tiles that a triangle may touch: all that can hit the mesh, and few others."""
    rows, columns = -(-size[0] // TILE), -(-size[1] // TILE)
    points = (mesh.vertices - poses[:, None, :3, 3]) @ poses[:, :3, :3]
    depth = points[..., 2]
    behind = np.asarray((depth <= 0).any(axis=1))  # part of the mesh lies behind the camera
    fx, fy, cx, cy = (float(x) for x in intrinsics)
    pixels = points[..., :2] * (fx, fy) / np.where(depth > 0, depth, 1)[..., None] + (cx, cy)
    left, right = _ends(pixels[..., 0], mesh.faces, columns)
    top, bottom = _ends(pixels[..., 1], mesh.faces, rows)
    marked = _cover(left, right, top, bottom, (rows, columns)) | behind[:, None, None]
    return marked.repeat(TILE, axis=1).repeat(TILE, axis=2)[:, : size[0], : size[1]]


def _ends(
    pixels: Float[np.ndarray, "views vertices"], faces: Int[np.ndarray, "faces 3"], count: int
) -> tuple[Int[np.ndarray, "views faces"], Int[np.ndarray, "views faces"]]:
    """First tile that each triangle may touch along one axis, and the one after its last."""
    # The hundredth of a pixel allows for rounding.
    low = np.floor((pixels - 0.01) / TILE).astype(np.int32)
    high = np.floor((pixels + 0.01) / TILE).astype(np.int32) + 1
    a, b, c = (low[:, faces[:, i]] for i in range(3))
    d, e, f = (high[:, faces[:, i]] for i in range(3))
    first, last = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(d, e), f)
    return first.clip(0, count), last.clip(0, count)


def _cover(
    left: Int[np.ndarray, "views n"],
    right: Int[np.ndarray, "views n"],
    top: Int[np.ndarray, "views n"],
    bottom: Int[np.ndarray, "views n"],
    shape: tuple[int, int],
) -> Bool[np.ndarray, "views rows columns"]:
    """Tiles inside any of the rectangles of their view.

    A rectangle changes four entries of a difference image; its sums along both axes count the
    rectangles over each tile.
    """
    rows, columns = shape[0] + 1, shape[1] + 1
    view = np.arange(len(left))[:, None] * rows * columns
    changes = np.zeros(len(left) * rows * columns, np.int64)
    for row, column, sign in (
        (top, left, 1),
        (top, right, -1),
        (bottom, left, -1),
        (bottom, right, 1),
    ):
        index = (view + row * columns + column).ravel()
        changes += sign * np.bincount(index, minlength=len(changes))
    counts = changes.reshape(-1, rows, columns).cumsum(axis=1).cumsum(axis=2)
    return counts[:, :-1, :-1] > 0


def add_sensor_noise(
    depth: Float[np.ndarray, "views h w"],
    cosine: Float[np.ndarray, "views h w"],
    rng: np.random.Generator,
    noise: SensorNoise = SensorNoise(),
) -> Float[np.ndarray, "views h w"]:
    """The depths that a real sensor would have reported; lost pixels become 0."""
    noisy, (h, w) = depth.copy(), depth.shape[1:]
    flat, rows = noisy.reshape(-1), np.arange(len(depth)) * h
    # Lateral jitter is applied only at edges; elsewhere it would act as axial noise.
    edges = np.flatnonzero(np.stack([_is_edge(image) for image in depth]))
    jitter = np.rint(rng.normal(0, noise.lateral, (2, len(edges)))).astype(int)
    (view, row), column = divmod(edges // w, h), edges % w
    row, column = np.clip(row + jitter[0], 0, h - 1), np.clip(column + jitter[1], 0, w - 1)
    flat[edges] = depth.reshape(-1)[(rows[view] + row) * w + column]

    seen = np.flatnonzero(np.isfinite(flat))
    z = flat[seen].astype(np.float64)
    z += rng.normal(0, noise.axial, z.shape) * z**2
    z = 1 / (noise.quantization * np.rint(1 / (noise.quantization * z)))  # steps of disparity
    grazing = cosine.reshape(-1)[seen] < np.cos(np.deg2rad(noise.grazing))
    flat[seen] = np.where(grazing, 0, z)
    flat[edges[rng.random(len(edges)) < noise.dropout]] = 0
    return noisy


def _is_edge(depth: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """True where a neighbour's depth differs by more than 5 %, or belongs to the background."""
    inverse = 1 / depth
    tolerance = 0.05 * inverse.max()
    down = np.abs(inverse[1:] - inverse[:-1]) > tolerance
    right = np.abs(inverse[:, 1:] - inverse[:, :-1]) > tolerance
    edge = np.zeros(depth.shape, bool)
    edge[1:] |= down
    edge[:-1] |= down
    edge[:, 1:] |= right
    edge[:, :-1] |= right
    return edge
