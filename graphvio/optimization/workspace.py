"""The results folder of an optimisation, in which an interrupted run is continued."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from graphvio.errors import OptimizationError, writing
from graphvio.reporting.files import replace_file

_STATE = "stages.json"
_REMEDY = "choose another folder for results"


class Workspace:
    """A folder of results that are written stage by stage.

    Args:
        folder: the folder: made if missing; otherwise that of an optimisation of the same inputs.
        inputs: name -> value of everything that determines the results.

    Raises:
        OptimizationError: if the folder holds something else, or cannot be written.
    """

    def __init__(self, folder: Path, inputs: Mapping[str, str]) -> None:
        self.folder = folder
        self._inputs = dict(inputs)
        self._finished: dict[str, list[str]] = {}
        state = folder / _STATE
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if state.is_file():
                self._continue(json.loads(state.read_text(encoding="utf-8")))
            elif any(folder.iterdir()):
                raise OptimizationError(
                    f"{folder}: is not empty, and results are never overwritten; choose another folder"
                )
            self._save()
        except OSError as error:
            raise OptimizationError(f"{folder}: cannot be written ({error.strerror or error}); {_REMEDY}") from None
        except (json.JSONDecodeError, KeyError, TypeError, AttributeError):
            raise OptimizationError(f"{state}: is damaged; remove the folder or choose another one") from None

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from continuing in the folder.

        Raises:
            OptimizationError: if another process has it locked.
        """
        descriptor = os.open(self.folder, os.O_RDONLY)
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise OptimizationError(
                    f"{self.folder}: another run writes into it; wait for its end, or choose another folder"
                ) from None
            except OSError:
                pass  # a file system without locks
            yield
        finally:
            os.close(descriptor)

    def has_finished(self, stage: str) -> bool:
        """Whether a stage was finished, in this run or an earlier one, and its files exist."""
        return stage in self._finished and self._exist(self._finished[stage])

    def finish(self, stage: str, *files: str) -> None:
        """Record that a stage is finished and has written these files."""
        self._finished[stage] = list(files)
        self._save()

    def forget(self, stage: str) -> None:
        """Mark a stage as not finished, so that it is done again."""
        if self._finished.pop(stage, None) is not None:
            self._save()

    def write(self, name: str, data: bytes) -> None:
        """Write a file of the folder, which is whole or absent."""
        path = self.folder / name
        with writing(path, OptimizationError, _REMEDY):
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(path, data)

    def _continue(self, state: dict[str, Any]) -> None:
        known = state["inputs"]
        differing = [name for name in sorted({*known, *self._inputs}) if known.get(name) != self._inputs.get(name)]
        if differing:
            raise OptimizationError(
                f"{self.folder}: holds results of other input (different: {', '.join(differing)}); name another folder"
            )
        self._finished = {
            str(stage): [str(name) for name in files]
            for stage, files in state["finished"].items()
            if self._exist(files)
        }

    def _exist(self, names: Sequence[str]) -> bool:
        return all((self.folder / name).is_file() for name in names)

    def _save(self) -> None:
        state = {"inputs": self._inputs, "finished": self._finished}
        self.write(_STATE, (json.dumps(state, indent=2) + "\n").encode())


def digest(*parts: str) -> str:
    """Return a short hash of texts."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
