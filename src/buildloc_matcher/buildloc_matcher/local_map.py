"""What a map must be to be matched at all."""

from __future__ import annotations

import numpy as np
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import LocalMap

DEGREES = 0.5  # a map smaller than this, in what should be metres, is in degrees


class MapError(BuildlocError):
    """A map that no flight makes."""


def check_map(local_map: LocalMap) -> None:
    """Raise MapError for numbers that are not finite, and for a map in degrees."""
    for name, values in (
        ("centroids", local_map.centroids_m),
        ("areas", local_map.areas_m2),
        ("shape metrics", local_map.shapes),
    ):
        bad = (
            int((~np.isfinite(values)).reshape(len(local_map), -1).any(axis=1).sum()) if len(local_map) else 0
        )
        if bad:
            raise MapError(f"{bad} buildings of the map have {name} that are not numbers; repair the map")
    if len(local_map) > 1:
        span = float(np.ptp(local_map.centroids_m, axis=0).max())
        if 0.0 < span < DEGREES:
            raise MapError(
                f"the map spans {span:.3g}, as if in degrees; project it to metres, such as its UTM zone"
            )
