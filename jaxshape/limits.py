"""Limits of input files and options; each is checked before it can cost memory or time.

`docs/reliability.md` has them in a table, reader by reader. Imports nothing of jaxshape.
"""

MIB, GIB = 2**20, 2**30

# Text and JSON ---------------------------------------------------------------------------------

TEXT_BYTES = 64 * MIB
"""Size of a text file, whose words take ten times as much memory; an hour of poses has a
quarter."""

JSON_BYTES = 64 * MIB
"""Size of a JSON file; 50,000 frames of nerfstudio have this size."""

JSON_VALUES = 5_000_000
"""Values in a JSON file, each of which takes some 50 bytes of memory."""

JSON_NESTING = 32
"""Brackets in a JSON file that are open at the same time."""

PATH_LENGTH = 1024
"""Characters of a path that a file names."""

FAR = 1e7
"""Largest coordinate, in metres; for poses written in millimetres it is 10 km."""

BOX_SIZE = (1e-3, 1e3)
"""Least and greatest extent of an object's box, in metres."""

# Images and arrays -----------------------------------------------------------------------------

IMAGE_BYTES = 256 * MIB
"""Size of an image file."""

DEPTH_PIXELS = 4096 * 4096
"""Pixels of a depth image; depth cameras have at most 4 million."""

COLOR_PIXELS = 8192 * 4096
"""Pixels of a colour image or a mask, which take 4 bytes each while it is decoded."""

IMAGE_SIDE = 65_535
"""Pixels along a side of the images of a camera, and largest number of a 16-bit header."""

IMAGE_CHANNELS = 16
"""Channels of an EXR image."""

ARRAY_BYTES = 4 * GIB
"""Size of all arrays of an .npz file that are read, unpacked."""

ARRAY_RATIO, ARRAY_FREE = 200, 64 * MIB
"""Bytes to which a byte of an .npz file may unpack, for arrays larger than the second number."""

ARRAY_ENTRIES = 100_000
"""Arrays of an .npz file, and of a file of weights."""

WEIGHT_BYTES = 4 * GIB
"""Size of a file of weights."""

WEIGHT_NESTING = 16
"""Names of folders in the name of a parameter, as in encoder/block/kernel."""

# Meshes and point clouds -----------------------------------------------------------------------

MESH_BYTES = 512 * MIB
"""Size of a mesh, of a point cloud, or of an inflated member of an archive."""

MESH_FACES = 20_000_000
"""Faces of a mesh."""

CLOUD_POINTS = 100_000_000
"""Points of a point cloud in a file."""

CLOUD_TEXT_BYTES = 128 * MIB
"""Size of the points of a point cloud in text form: words take ten times as much memory."""

# Options ---------------------------------------------------------------------------------------

SEED = 2**32 - 1
"""Largest seed: JAX makes random keys of 32 bits."""

FRAMES = 180
"""Depth frames of a virtual camera: at 20 degrees each, ten times around the object."""

POPULATION = 100_000
"""Candidates in an iteration, each of which is a shape to decode."""

STEPS = 10_000_000
"""Iterations of a search, or steps of a training."""

BATCH = 65_536
"""Pairs in a training batch, which are in memory together."""

CHANNELS = 4096
"""Channels of a layer of a network."""

RESOLUTION = 512
"""Voxels along each axis of a grid."""

CODE = 10_000
"""Dimension of a code, whose covariance has its square."""

PATHS = 1_000
"""Camera paths around an object of a dataset."""

WORKERS = 256
"""Processes that work at the same time, each of which takes 0.3 GB."""

# Disk ------------------------------------------------------------------------------------------

FREE_BYTES = 64 * MIB
"""Free space needed to begin a result; a result with pictures and meshes takes half of it."""

CACHE_BYTES = 2 * GIB
"""Size of all compiled programs that are kept; the oldest are removed."""

OBJECTS = 100_000_000
"""Objects of a dataset."""
