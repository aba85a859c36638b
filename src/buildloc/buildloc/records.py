"""Fixes as JSON records: what `run`, `replay` and the listener write and `eval` reads."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import Fix, NoFix


class RecordError(BuildlocError):
    """A file of fixes cannot be read."""


def record(fix: Fix | NoFix, pose: tuple[float, float, float] | None = None) -> dict[str, Any]:
    """One fix, or its absence, ready for JSON; ``pose`` (easting, northing, yaw) completes a wire fix."""
    if isinstance(fix, NoFix):
        return {"stamp_ns": fix.stamp_ns, "fix": False, "reason": fix.reason}
    easting, northing, yaw = pose or (fix.easting_m, fix.northing_m, fix.yaw_rad)
    return {
        "stamp_ns": fix.stamp_ns,
        "fix": True,
        "latitude_deg": fix.latitude_deg,
        "longitude_deg": fix.longitude_deg,
        "altitude_m": fix.altitude_m if math.isfinite(fix.altitude_m) else None,
        "easting_m": easting,
        "northing_m": northing,
        "yaw_deg": math.degrees(yaw),
        "covariance_enu_m2": np.asarray(fix.covariance_enu_m2).ravel().tolist(),
    }


def parse(values: dict[str, Any]) -> Fix | NoFix:
    """Inverse of :func:`record`."""
    if not values["fix"]:
        return NoFix(int(values["stamp_ns"]), str(values["reason"]))
    altitude = values["altitude_m"]
    return Fix(
        int(values["stamp_ns"]), values["latitude_deg"], values["longitude_deg"],
        math.nan if altitude is None else altitude, values["easting_m"], values["northing_m"],
        math.radians(values["yaw_deg"]), np.array(values["covariance_enu_m2"]).reshape(3, 3),
    )  # fmt: skip


def read_fixes(path: Path) -> list[Fix | NoFix]:
    """All records of a JSON lines file, in order. Raises RecordError with the line that is wrong."""
    fixes: list[Fix | NoFix] = []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        try:
            fixes.append(parse(json.loads(line)))
        except (ValueError, KeyError, TypeError) as error:
            raise RecordError(
                f"{path}:{number}: is not a fix record; write it with `buildloc run --out`"
            ) from error
    return fixes
