"""The ground that the frames show: a real orthophoto under every flight, tiled and mirrored.

It has texture alone, for registration to meet: its own buildings say nothing of those that are flown over.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from buildloc_eval.orthos import banepa, barnarp
from buildloc_eval.paper.flights import EPSG, PlacedFlight
from buildloc_eval.world import MirroredWorld, PictureWorld

GROUNDS = (barnarp, banepa)
SHIFT_M = (150.0, 30.0)
TIMES = 2


def ground_texture(data: Path, flight: PlacedFlight, rng: np.random.Generator) -> MirroredWorld:
    """Barnarp or Banepa, in turns, laid so that the seam from north to south passes near the flight's centre.

    The other seam stays out of sight: where the two cross, the ground is a copy of itself turned by half a
    circle, and the mapper links the one to the other. Raises BuildlocError without the data.
    """
    picture = GROUNDS[flight.number % len(GROUNDS)](data).picture
    whole = picture.window(picture.bounds_m)
    size = whole.gsd_m * np.array(whole.image_bgr.shape[1::-1])
    left, top = flight.centre_m + size * (-1.0, 0.5) + rng.uniform(-1.0, 1.0, 2) * SHIFT_M
    return MirroredWorld(
        PictureWorld(whole.image_bgr, EPSG, float(left), float(top), whole.gsd_m), TIMES, TIMES
    )
