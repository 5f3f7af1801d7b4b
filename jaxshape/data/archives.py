"""Meshes in folders, zip archives and furniture catalogues, listed without opening a mesh. [host]

Everything is read into memory, through `read_bytes`: nothing is unpacked to disk, so that a member
called `../../evil.obj` is harmless, and a member that inflates without end is cut off.
"""

import os
import posixpath
import re
import zipfile
from collections import Counter
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from jaxshape.data.formats.parts import Unreadable
from jaxshape.limits import MESH_BYTES

MESH_SUFFIXES = (".obj", ".off", ".ply", ".glb", ".gltf", ".stl")
ARCHIVE_SUFFIXES = (".zip", ".sh3f")

UNREAD_SUFFIXES = (
    ".3ds", ".3mf", ".7z", ".abc", ".blend", ".bz2", ".c4d", ".dae", ".dxf", ".fbx", ".gz", ".iges",
    ".igs", ".lwo", ".ma", ".max", ".mb", ".rar", ".skp", ".step", ".stp", ".tar", ".tgz", ".usd",
    ".usda", ".usdc", ".usdz", ".vrml", ".wrl", ".x", ".x3d", ".xz",
)  # fmt: skip
"""Suffixes of meshes and archives that are not read; such files are only counted."""

MAX_BYTES = MESH_BYTES
"""Largest file or inflated archive member that is read."""

_SUFFIX = "|".join(map(re.escape, MESH_SUFFIXES + ARCHIVE_SUFFIXES))
_CATALOGUE = "PluginFurnitureCatalog.properties"
_CATALOGUE_FIELDS = (
    "name", "creator", "license", "category", "tags",
    "modelRotation", "width", "height", "depth",
)  # fmt: skip


class MeshSource(NamedTuple):
    """One mesh that can be loaded: small, picklable, without geometry.

    Attributes:
        name: Path below the listed root without suffixes, with `/` between folders and no `..`;
            if two would be equal, each keeps its suffixes. All names of a listing are different.
        path: The file on disk: a mesh, or the archive that holds it.
        member: Name of the member inside the archive; None for a file that is not in an archive.
        metadata: Entries of a furniture catalogue for the mesh, under the catalogue's own field
            names; empty without a catalogue.
        axes: Axes of this file that point up and to the front, such as ("z", "-y"); None for the
            axes of its collection.
    """

    name: str
    path: str
    member: str | None = None
    metadata: dict[str, str] = {}  # noqa: RUF012 - never written to
    axes: tuple[str, str] | None = None


class TooLarge(ValueError):
    """A file or archive member is larger than `MAX_BYTES`."""


def list_meshes(path: str | os.PathLike[str]) -> list[MeshSource]:
    """List every mesh at a path, sorted by name, without loading any.

    Folders, such as the trees of ShapeNet and ModelNet, are searched recursively for meshes and
    archives. Symbolic links to folders are not followed, and hidden files are left out
    (`passed_over` counts files that might be meshes). An archive or a folder that cannot be opened
    is listed under its own name, so that loading it reports the reason.

    Args:
        path: A mesh, an archive (`.zip`, or Sweet Home 3D's `.sh3f`), or a folder of both.

    Raises:
        FileNotFoundError: There is nothing at the path.
        ValueError: The path holds no mesh.
    """
    root = Path(path)
    if not root.exists():
        raise FileNotFoundError(f"There is no file or folder {str(root)!r} to read meshes from.")
    walked = _walk(root)
    folder = root if root.is_dir() else root.parent
    found: list[tuple[str, MeshSource]] = []
    for closed in walked.closed:
        found.append((closed.relative_to(folder).as_posix(), MeshSource("", str(closed))))
    for file in walked.files:
        inside = file.relative_to(folder).as_posix()
        if file.suffix.lower() in MESH_SUFFIXES:
            found.append((inside, MeshSource("", str(file))))
        elif file.suffix.lower() in ARCHIVE_SUFFIXES:
            prefix = inside if root.is_dir() else ""
            found += _list_archive(file, prefix)
    if not found:
        raise ValueError(
            f"{str(root)!r} holds no mesh: looked for files ending in {', '.join(MESH_SUFFIXES)}, "
            f"also inside {' and '.join(ARCHIVE_SUFFIXES)} archives."
        )
    return _named(found)


class _Walked(NamedTuple):
    """Names of the entries of a folder, or of a single file.

    Attributes:
        files: All files that are not hidden.
        closed: Folders that cannot be opened.
        links: Number of links to folders, which are not followed.
    """

    files: list[Path]
    closed: list[Path]
    links: int


def _walk(folder: Path) -> _Walked:
    if not folder.is_dir():
        return _Walked([folder], [], 0)
    files, closed, links = [], [], 0

    def refuse(problem: OSError) -> None:
        closed.append(Path(problem.filename or folder))

    for parent, inside, names in os.walk(folder, onerror=refuse):
        files += [Path(parent, name) for name in names]
        links += sum(os.path.islink(Path(parent, name)) for name in inside)
    shown = sorted(file for file in files if not _hidden(file.relative_to(folder).as_posix()))
    return _Walked(shown, sorted(closed), links)


def passed_over(path: str | os.PathLike[str]) -> Counter[str]:
    """Number of files, for each suffix, that may be meshes but are not read.

    Args:
        path: A mesh, an archive, or a folder of both, whose archives are searched, too.
    """
    walked = _walk(Path(path))
    archives = [file for file in walked.files if file.suffix.lower() in ARCHIVE_SUFFIXES]
    members = [PurePosixPath(name) for archive in archives for name in _members(archive)]
    suffixes = (file.suffix.lower() for file in [*walked.files, *members])
    found = Counter(suffix for suffix in suffixes if suffix in UNREAD_SUFFIXES)
    if nested := sum(member.suffix.lower() in ARCHIVE_SUFFIXES for member in members):
        found["archives inside archives"] = nested
    if walked.links:
        found["linked folders"] = walked.links
    return found


def _members(archive: Path) -> list[str]:
    """Files in an archive that are not hidden; none if it cannot be opened, as loading reports."""
    try:
        with zipfile.ZipFile(archive) as opened:
            names = opened.namelist()
    except Exception:  # zipfile raises many kinds on broken archives
        return []
    return [name for name in names if not name.endswith("/") and not _hidden(name)]


def _hidden(path: str) -> bool:
    parts = path.split("/")
    return "__MACOSX" in parts or any(re.match(r"\.[^.]", part) for part in parts)


def _list_archive(file: Path, prefix: str) -> list[tuple[str, MeshSource]]:
    """Return each mesh of an archive with its path below the root."""
    try:
        with zipfile.ZipFile(file) as archive:
            members = archive.namelist()
            catalogue = _catalogue(archive) if _CATALOGUE in members else {}
    except Exception:  # zipfile and decompressors raise many kinds on broken archives
        return [(prefix or file.name, MeshSource("", str(file)))]
    return [
        (f"{prefix}/{member}", MeshSource("", str(file), member, catalogue.get(member, {})))
        for member in dict.fromkeys(members)
        if member.lower().endswith(MESH_SUFFIXES) and not _hidden(member)
    ]


def _named(found: list[tuple[str, MeshSource]]) -> list[MeshSource]:
    """Name each source by its path, without suffixes unless this would give two the same name."""
    paths = [printable(_safe(path)) for path, _ in found]
    stems = [re.sub(rf"(?i)({_SUFFIX})(?=/|$)", "", path) for path in paths]
    shared = Counter(stems)
    seen: Counter[str] = Counter()
    sources = []
    for path, stem, (_, source) in zip(paths, stems, found, strict=True):
        name = stem if shared[stem] == 1 else path
        seen[name] += 1  # members of one archive may have equal paths after `_safe`
        sources.append(source._replace(name=name if seen[name] == 1 else f"{name}~{seen[name]}"))
    return sorted(sources, key=lambda source: source.name)


def printable(name: str) -> str:
    """A file name with bytes that are not UTF-8 written as `\\xe9`, for any file and console.

    Args:
        name: A name or path, as Python gives it.
    """
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def _safe(path: str) -> str:
    """Return a relative path that stays below any folder it is joined to."""
    parts = re.split(r"[/\\]", path.replace("\0", "").replace(":", "_"))
    return "/".join(part for part in parts if part not in ("", ".", "..")) or "mesh"


def _catalogue(archive: zipfile.ZipFile) -> dict[str, dict[str, str]]:
    """Return the fields of each member that a Sweet Home 3D furniture catalogue describes.

    Lines read `name#12=Oak chair`: field, entry, value. Fields without an entry apply to all
    entries.
    """
    content = _read_member(archive, _CATALOGUE)
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    text = re.sub(r"\\\r?\n\s*", "", text)  # a backslash continues a line
    shared: dict[str, str] = {}
    entries: dict[str, dict[str, str]] = {}
    for field, entry, value in re.findall(r"(?m)^(\w+)(?:#(\d+))?[ \t]*[=:](.*)$", text):
        fields = entries.setdefault(entry, {}) if entry else shared
        fields[field] = re.sub(
            r"\\(u[0-9a-fA-F]{4}|.)",
            lambda escape: chr(int(escape[1][1:], 16)) if len(escape[1]) == 5 else escape[1],
            value.strip(),
        )
    defaults = {field: shared[field] for field in ("license",) if field in shared}
    return {
        fields["model"].lstrip("/"): defaults
        | {field: fields[field] for field in _CATALOGUE_FIELDS if field in fields}
        for fields in entries.values()
        if "model" in fields
    }


def read_bytes(source: MeshSource, relative: str | None = None) -> bytes:
    """The content of the file of a mesh, or of a file next to it.

    Args:
        source: The mesh.
        relative: Path of the other file, relative to the folder of the mesh; None for the mesh
            itself.

    Raises:
        FileNotFoundError: There is no such file.
        Unreadable: `relative` leaves the folder or the archive.
        TooLarge: The file is larger than `MAX_BYTES`.
    """
    path = Path(source.path)
    if path.is_dir():
        os.listdir(path)  # raises the reason why a listed folder cannot be read
        raise IsADirectoryError(f"{printable(path.name)!r} could not be opened as a folder.")
    if source.member is None and path.suffix.lower() in ARCHIVE_SUFFIXES:
        raise zipfile.BadZipFile(f"{path.name} is not a readable zip archive.")
    if source.member is None:
        file = path if relative is None else path.parent / _below(relative)
        if not file.is_file():  # reading a device or a pipe might never end
            raise FileNotFoundError(f"There is no file {file.name!r} next to the mesh.")
        with open(file, "rb") as stream:
            return _read(stream.read, file.name)
    member = source.member
    if relative is not None:
        member = _below(posixpath.join(posixpath.dirname(member), relative))
    about = path.stat()
    return _read_member(_archive(source.path, about.st_mtime_ns, about.st_size), member)


@lru_cache(maxsize=4)
def _archive(path: str, modified: int, size: int) -> zipfile.ZipFile:
    """An open archive, cached: reading its list of members for each member may take minutes."""
    del modified, size  # a changed file at the same path is opened again
    return zipfile.ZipFile(path)


def _read_member(archive: zipfile.ZipFile, member: str) -> bytes:
    if member not in archive.NameToInfo:
        raise FileNotFoundError(f"There is no file {member!r} in the archive.")
    with archive.open(member) as stream:
        return _read(stream.read, member)


def _below(name: str) -> str:
    path = PurePosixPath(posixpath.normpath(name.replace("\\", "/")))
    if path.is_absolute() or path.parts[:1] == ("..",):
        raise Unreadable(f"The mesh refers to {name!r}, outside its own folder; it is not read.")
    return str(path)


def _read(read: Callable[[int], bytes], name: str) -> bytes:
    """Read to the end, but stop at the limit; the length in a header is not trusted."""
    content = read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise TooLarge(f"{name!r} is larger than {MAX_BYTES // 2**20} MiB.")
    return content
