"""What a report says of the machine and the versions it was made with."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

LIBRARIES = (
    "buildloc",
    "numpy",
    "scipy",
    "numba",
    "shapely",
    "opencv-python-headless",
    "onnxruntime",
    "gtsam",
    "evo",
)


def machine() -> dict[str, Any]:
    """Date, processor, cores and versions."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in LIBRARIES},
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    names = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
    return names[0] if names else platform.machine()
