"""Parts of an evaluation, kept as they are finished: a run that was cut short goes on where it stopped."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

Scores = dict[str, Any]
PICTURES = "pictures"  # of the scores: (caption, file in the folder) of each


def source_digest(names: Iterable[str]) -> str:
    """Changes when the source of a module does, or any module or measured figures (JSON) of a package."""
    digest = hashlib.sha256()
    for name in sorted(names):
        found = importlib.util.find_spec(name)
        if found is None or found.origin is None:
            raise ModuleNotFoundError(name)
        file = Path(found.origin)
        everything = (p for p in file.parent.rglob("*") if p.suffix in (".py", ".json"))
        for path in sorted(everything) if found.submodule_search_locations else [file]:
            digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def fingerprint(packages: Iterable[str], *settings: Any) -> str:
    """Changes when a source file of these packages does, or a setting."""
    told = json.dumps(settings, sort_keys=True, default=str) + source_digest(packages)
    return hashlib.sha256(told.encode()).hexdigest()


class Sections:
    """Scores by name and their pictures, in ``folder``. What another ``key`` made is made anew."""

    def __init__(self, folder: Path, key: str, progress: Callable[[str], None]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._key, self._progress = folder, key, progress

    def scores(self, name: str, make: Callable[[], Scores]) -> Scores:
        """The section's scores with the ``seconds`` that they took, of an earlier run where there was one."""
        path = self._folder / f"{name}.json"
        if path.is_file():
            kept = json.loads(path.read_text())
            drawn = all((self._folder / file).is_file() for _, file in kept["scores"].get(PICTURES, ()))
            if kept["key"] == self._key and drawn:
                self._progress(f"{name}: kept from an earlier run ({path})")
                return dict(kept["scores"])
        self._progress(name)
        started = time.perf_counter()
        scores = make()
        scores["seconds"] = time.perf_counter() - started
        unfinished = path.with_suffix(".part")
        unfinished.write_text(json.dumps({"key": self._key, "scores": scores}))
        unfinished.replace(path)
        return scores
