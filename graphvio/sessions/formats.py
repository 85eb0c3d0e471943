"""The formats to which recordings are converted."""

from __future__ import annotations

from pathlib import Path

from graphvio.errors import SessionError
from graphvio.rig import Rig
from graphvio.sessions.euroc_writer import EurocWriter
from graphvio.sessions.storage import RecordingWriter
from graphvio.sessions.topics import ImageFormat
from graphvio.sessions.writer import SessionWriter

FORMATS = ("mcap", "rosbag1", "rosbag2", "euroc")

_BY_SUFFIX = {".mcap": "mcap", ".bag": "rosbag1"}


def format_of(path: Path, asked: str | None) -> str:
    """Return the format, one of `FORMATS`, in which a file or folder is to be written.

    Raises:
        SessionError: if the name does not show the format, or contradicts it.
    """
    if asked is not None and asked not in FORMATS:
        raise SessionError(f"--format {asked}: is not known; give one of {', '.join(FORMATS)}")
    named = _BY_SUFFIX.get(path.suffix)
    if asked is None and named is None:
        raise SessionError(
            f"{path}: its name shows no format; name a file .mcap or .bag, or give --format rosbag2 or --format euroc "
            "for a folder"
        )
    suffix = next((suffix for suffix, known in _BY_SUFFIX.items() if known == asked), None)
    if asked is not None and asked != named and (named is not None or suffix is not None):
        wanted = f"it {suffix}" if suffix is not None else "a folder without that ending"
        raise SessionError(f"{path}: is not how {asked} is named; name {wanted}, or give another --format")
    return asked or named or ""


def open_writer(path: Path, rig: Rig, file_format: str, image_format: ImageFormat = "raw") -> RecordingWriter:
    """Create a file or folder of a format.

    Args:
        path: path of the file or folder, which must not exist.
        rig: the rig of the framesets.
        file_format: one of `FORMATS`.
        image_format: format of images in sessions and bags; the EuRoC layout always has PNG.

    Raises:
        SessionError: if the target exists or cannot be created.
        MissingExtraError: if the extra ``sessions`` is not installed.
    """
    if file_format == "euroc":
        return EurocWriter(path, rig)
    if file_format == "mcap":
        return SessionWriter(path, rig, image_format)
    from graphvio.sessions.bag_storage import Ros1Storage, Ros2Storage

    return SessionWriter(path, rig, image_format, Ros1Storage if file_format == "rosbag1" else Ros2Storage)
