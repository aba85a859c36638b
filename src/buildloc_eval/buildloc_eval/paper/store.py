"""What was computed, kept in files; what another configuration or another code computed is refused."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path
from typing import Any

from buildloc_msgs_py.errors import BuildlocError

MANIFEST = "made_by.json"


class StaleError(BuildlocError):
    """Kept results are of another configuration or code."""


class Store:
    """A folder of results that one configuration and one code made, each written at once.

    Raises StaleError when the folder holds those of another: what it was made by is compared in full.
    """

    def __init__(self, folder: Path, made_by: dict[str, Any]) -> None:
        self.folder, self.made_by = folder, made_by
        folder.mkdir(parents=True, exist_ok=True)
        manifest = folder / MANIFEST
        if manifest.is_file():
            kept = json.loads(manifest.read_text())
            different = [name for name in made_by if kept.get(name) != made_by[name]]
            if different:
                raise StaleError(
                    f"{folder}: was made with another {', '.join(different)}; choose another --out, or "
                    "remove the folder to compute it anew"
                )
        else:
            _write(manifest, json.dumps(made_by, indent=1).encode())

    def path(self, name: str) -> Path:
        """Where a result is kept."""
        return self.folder / f"{name}.pickle"

    def has(self, name: str) -> bool:
        """Whether a result is there."""
        return self.path(name).is_file()

    def load(self, name: str) -> Any:
        """A result that is there."""
        return pickle.loads(self.path(name).read_bytes())

    def save(self, name: str, value: Any) -> None:
        """Keep a result."""
        _write(self.path(name), pickle.dumps(value))


def _write(path: Path, data: bytes) -> None:
    """All or nothing, for a run that is killed to go on from what is there."""
    staged = path.with_suffix(f".{os.getpid()}.part")
    staged.write_bytes(data)
    os.replace(staged, path)
