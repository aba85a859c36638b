"""Ground without end: a real orthophoto, tiled and mirrored at its edges."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from buildloc_msgs_py.types import ByteArray
from numpy.typing import NDArray

from buildloc_eval.paper.flights import EPSG
from buildloc_eval.places import read_ortho, read_web_tiles
from buildloc_eval.world import Box, Window

SOURCES = ("barnarp", "banepa_ortho")


class MirroredGround:
    """A picture (H, W, 3) BGR repeated over the plane, every other time mirrored, so that no seam shows.

    Its first pixel's outer corner lies at ``left_m``, ``top_m``. It has texture alone: its own buildings say
    nothing of those that are flown over.
    """

    epsg = EPSG
    bounds_m: Box = (-math.inf, -math.inf, math.inf, math.inf)

    def __init__(self, image_bgr: ByteArray, gsd_m: float, left_m: float, top_m: float) -> None:
        self._image, self._gsd_m, self._left_m, self._top_m = image_bgr, gsd_m, left_m, top_m

    def window(self, box_m: Box) -> Window:
        """The pixels that touch the box."""
        west, south, east, north = box_m
        gsd, (height, width) = self._gsd_m, self._image.shape[:2]
        c0, c1 = math.floor((west - self._left_m) / gsd), math.ceil((east - self._left_m) / gsd)
        r0, r1 = math.floor((self._top_m - north) / gsd), math.ceil((self._top_m - south) / gsd)
        part = self._image[np.ix_(mirrored(r0, r1, height), mirrored(c0, c1, width))]
        return Window(part, self._left_m + c0 * gsd, self._top_m - r0 * gsd, gsd)


def mirrored(first: int, last: int, count: int) -> NDArray[np.int64]:
    """Rows of the picture that lie at rows [first, last) of the plane."""
    within = np.arange(first, last) % (2 * count)
    return np.where(within < count, within, 2 * count - 1 - within)


def ground_texture(imagery: Path, number: int, rng: np.random.Generator) -> MirroredGround:
    """The ground of a flight: Barnarp and Banepa in turns, laid anywhere. Raises PlaceError."""
    name = SOURCES[number % len(SOURCES)]
    folder = imagery / name
    if name == "barnarp":
        scene = read_ortho(folder / "ortho.jpg", folder / "footprints.geojson", folder / "georef.json")
    else:
        (scene,) = read_web_tiles(folder / "tiles", folder / "masks")
    rows, columns = np.flatnonzero(scene.labelled.any(axis=1)), np.flatnonzero(scene.labelled.any(axis=0))
    whole = scene.part(slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1), scene.name)
    left, top = rng.uniform(0.0, 1000.0, 2)
    return MirroredGround(np.ascontiguousarray(whole.rgb[..., ::-1]), whole.gsd_m, float(left), float(top))
