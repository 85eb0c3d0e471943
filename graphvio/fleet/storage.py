"""Access to files by path or URL with fsspec: local folders, S3, GCS and others."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from graphvio.errors import FleetError, MissingExtraError, importing
from graphvio.optimization.workspace import digest

_UNFINISHED = ".tmp"


def file_system(url: str) -> tuple[Any, str]:
    """Return the file system of a path or URL, and the path in it.

    Raises:
        FleetError: if the kind of URL is unknown, or a package that it needs is not installed.
        MissingExtraError: if the extra ``fleet`` is not installed.
    """
    with importing("fsspec", "fleet", "working on many sessions"):
        from fsspec.core import url_to_fs
    try:
        files, path = url_to_fs(url)
    except (ImportError, ValueError) as error:
        if isinstance(error, ImportError) and url.startswith(("s3:", "s3a:")):
            raise MissingExtraError("s3fs", "s3", "an S3 store") from None
        raise FleetError(f"{url}: cannot be reached ({error})") from None
    return files, str(path)


def local_path(url: str) -> Path | None:
    """Return the absolute path of a local file or folder, or None for other URLs."""
    files, path = file_system(url)
    protocol = (files.protocol,) if isinstance(files.protocol, str) else files.protocol
    return Path(path) if "file" in protocol else None


@contextmanager
def reaching() -> Iterator[None]:
    """Raise errors of S3's client on network or credentials as an `OSError`, as fsspec does for other storage."""
    try:
        yield
    except Exception as error:
        if type(error).__module__.partition(".")[0] not in ("botocore", "aiobotocore", "aiohttp"):
            raise
        raise OSError(f"{type(error).__name__}: {error}") from None


class Storage:
    """A folder of results, local or remote, made with its first file; methods raise a `FleetError` if they fail."""

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        self._files, self._root = file_system(self.url)
        self._local = local_path(self.url)

    def sizes(self) -> dict[str, int]:
        """Return the sizes of all files in the folder and in folders below: name -> bytes."""
        with self._reaching(self.url, "read"):
            self._files.invalidate_cache()
            try:
                found = self._files.find(self._root, detail=True)
            except FileNotFoundError:
                return {}
            root = self._root.rstrip("/") + "/"
            return {path.removeprefix(root): int(info["size"]) for path, info in found.items()}

    def read(self, name: str) -> bytes | None:
        """Read a file, or return None if it does not exist."""
        with self._reaching(name, "read"):
            try:
                return bytes(self._files.cat_file(self._path(name)))
            except FileNotFoundError:
                return None

    def fetch(self, name: str, to: Path) -> None:
        """Copy a file to a local path, whose folder is made."""
        with self._reaching(name, "read"):
            to.parent.mkdir(parents=True, exist_ok=True)
            self._files.get_file(self._path(name), str(to))

    def put(self, path: Path, name: str) -> None:
        """Copy a local file into the folder; at any time it is complete or absent."""
        self._replace(name, lambda unfinished: self._files.put_file(str(path), unfinished))

    def write(self, name: str, data: bytes) -> None:
        """Write a file; at any time it is complete or absent."""
        self._replace(name, lambda unfinished: self._files.pipe_file(unfinished, data))

    def remove(self, name: str) -> None:
        """Remove a file, if it exists."""
        with self._reaching(name, "removed"), suppress(FileNotFoundError):
            self._files.rm_file(self._path(name))

    def remove_unfinished(self) -> None:
        """Remove partial files of interrupted tasks."""
        for name in self.sizes():
            if name.endswith(_UNFINISHED):
                self.remove(name)

    def _path(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"

    def _replace(self, name: str, fill: Callable[[str], None]) -> None:
        """Write a file under a temporary name with ``fill``, and move it to its name."""
        path = self._path(name)
        folder, _, file = path.rpartition("/")
        unfinished = f"{folder}/.{file}.{uuid.uuid4().hex[:8]}{_UNFINISHED}"
        with self._reaching(name, "written"):
            try:
                self._files.makedirs(folder, exist_ok=True)
                fill(unfinished)
                self._move(unfinished, path)
            except BaseException:
                with suppress(Exception):  # it may not exist, or the disk be gone; the first error is raised
                    self._files.rm_file(unfinished)
                raise

    def _move(self, unfinished: str, path: str) -> None:
        if self._local is None:
            self._files.mv(unfinished, path)
            return
        with Path(unfinished).open("rb") as copy:
            os.fsync(copy.fileno())
        Path(unfinished).replace(path)

    @contextmanager
    def _reaching(self, name: str, what: str) -> Iterator[None]:
        try:
            with reaching():
                yield
        except OSError as error:
            raise FleetError(
                f"{self.url}: {name} cannot be {what} ({error.strerror or error}); check the place of the results"
            ) from None


def fetch_recording(url: str, scratch: Path) -> Path:
    """Return the local path of a recording, or of a copy in ``scratch``, which keeps the recording fetched last.

    Raises:
        FleetError: if the recording does not exist, cannot be read or does not fit on the disk.
    """
    local = local_path(url)
    if local is not None:
        return local
    files, path = file_system(url.rstrip("/"))
    kept = scratch / "recording"
    folder = kept / digest(url)
    copy = folder / path.rpartition("/")[2]
    if copy.exists():
        return copy
    shutil.rmtree(kept, ignore_errors=True)
    unfinished = kept / "unfinished" / copy.name
    try:
        unfinished.parent.mkdir(parents=True)
        with reaching():
            if files.isdir(path):
                files.get(f"{path}/", f"{unfinished}/", recursive=True)
            else:
                files.get_file(path, str(unfinished))
        unfinished.parent.replace(folder)
    except OSError as error:
        shutil.rmtree(kept, ignore_errors=True)
        raise FleetError(f"{url}: cannot be fetched ({error.strerror or error})") from None
    return copy
