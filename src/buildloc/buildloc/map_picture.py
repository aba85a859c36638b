"""A picture of a map: the keyframes' images laid where the graph has put them, path, buildings, links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from buildloc_mapper.mapper import MapUpdate
from buildloc_mapper.similarity import Similarity
from buildloc_msgs_py.ground import border, level_to_ray, pixels_to_level, resample, resized
from buildloc_msgs_py.types import ByteArray, CameraModel, FloatArray, Frame, Keyframe
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

IMAGE_WIDTH_PX = 320  # of a keyframe, as it is kept until the end of the flight
LONGEST_SIDE_PX = 2000
LINKS: dict[str, dict[str, Any]] = {  # the path shows the consecutive ones, above the skip links along it
    "skip": {"colors": "tab:cyan", "lw": 3.0, "alpha": 0.5, "zorder": 1.5},
    "loop": {"colors": "tab:red", "lw": 1.6, "zorder": 2.5},
}


@dataclass(frozen=True)
class _Shot:
    """A keyframe's image, small, with what puts it on the ground."""

    image_bgr: ByteArray
    camera: CameraModel
    altitude_m: float
    attitude_xyzw: tuple[float, float, float, float]

    def edge_m(self) -> FloatArray:
        """(N, 2) outer edge of the image in the level camera frame."""
        return pixels_to_level(border(self.camera), self.camera, self.altitude_m, self.attitude_xyzw)


@dataclass(frozen=True)
class Mosaic:
    """(H, W, 4) RGBA ground, transparent where nobody looked; ``extent_m``: west, east, south, north."""

    image_rgba: ByteArray
    extent_m: tuple[float, float, float, float]


class MapPicture:
    """Keeps the images of keyframes, and draws a map of them."""

    def __init__(self) -> None:
        self._shots: dict[int, _Shot] = {}

    def add(self, frame: Frame) -> None:
        """Keep the image of a keyframe."""
        camera = resized(frame.camera, min(1.0, IMAGE_WIDTH_PX / frame.camera.width))
        size = (camera.width, camera.height)
        image = np.asarray(cv2.resize(frame.image_bgr, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        self._shots[frame.stamp_ns] = _Shot(image, camera, frame.altitude_m, frame.attitude_xyzw)

    def write(self, update: MapUpdate, path: Path, title: str) -> None:
        """Draw the map as it is now."""
        figure = Figure(figsize=(12.0, 10.0))
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        mosaic = self.mosaic(update.keyframes)
        axes.imshow(mosaic.image_rgba, extent=mosaic.extent_m, interpolation="antialiased")
        places = np.array([(k.x_m, k.y_m) for k in update.keyframes])
        outlines = [np.asarray(outline.exterior.coords) for outline in update.outlines]
        for cut, colour, name in ((False, "yellow", "buildings"), (True, "tab:orange", "cut by the border")):
            drawn = [o for o, is_cut in zip(outlines, update.local_map.cut, strict=True) if is_cut == cut]
            label = f"{len(drawn)} {name}"
            axes.add_collection(PolyCollection(drawn, fc="none", ec=colour, lw=0.8, label=label))
        axes.plot(*places.T, "o-", c="tab:blue", lw=1.2, ms=3, label=f"path, {len(places)} keyframes")
        for kind, look in LINKS.items():
            ends = [places[[earlier, later]] for earlier, later, of in update.links if of == kind]
            if ends:
                axes.add_collection(LineCollection(ends, label=f"{len(ends)} {kind} links", **look))
        axes.plot(*places[0], "o", c="white", mec="tab:blue", ms=7, label="first keyframe")
        axes.set_xlabel("x, m (buildloc_map)")
        axes.set_ylabel("y, m")
        axes.set_title(title)
        axes.legend(loc="best", fontsize=8, framealpha=0.9)
        figure.tight_layout()
        figure.savefig(path, dpi=150)

    def mosaic(self, keyframes: Sequence[Keyframe]) -> Mosaic:
        """The images in ``buildloc_map``. Where several saw a place, the one is shown that had it nearest to
        its middle, so that the seams between them tell how well they fit."""
        shots = [self._shots[k.stamp_ns] for k in keyframes]
        poses = [Similarity(k.x_m, k.y_m, k.yaw_rad, k.scale) for k in keyframes]
        edges = [pose.apply(shot.edge_m()) for pose, shot in zip(poses, shots, strict=True)]
        low, high = np.vstack(edges).min(axis=0), np.vstack(edges).max(axis=0)
        finest = min(shot.altitude_m / shot.camera.fx for shot in shots)
        gsd = max(finest, float((high - low).max()) / LONGEST_SIDE_PX)
        columns, rows = np.ceil((high - low) / gsd).astype(int) + 1
        left, top = float(low[0]), float(high[1])
        ground = np.zeros((rows, columns, 3), dtype=np.uint8)
        nearness = np.zeros((rows, columns), dtype=np.uint8)
        for shot, pose, edge in zip(shots, poses, edges, strict=True):
            c0, r0 = np.floor([(edge[:, 0].min() - left) / gsd, (top - edge[:, 1].max()) / gsd]).astype(int)
            c1, r1 = np.ceil([(edge[:, 0].max() - left) / gsd, (top - edge[:, 1].min()) / gsd]).astype(int)
            to_map = [[gsd, 0.0, left + (c0 + 0.5) * gsd], [0.0, -gsd, top - (r0 + 0.5) * gsd], [0, 0, 1.0]]
            to_level = np.linalg.inv(pose.matrix()) @ np.array(to_map)
            to_ray = level_to_ray(shot.altitude_m, shot.attitude_xyzw) @ to_level
            size, window = (int(c1 - c0), int(r1 - r0)), np.s_[r0:r1, c0:c1]
            near = resample(_nearness(shot.camera), shot.camera, to_ray, size)
            better = near > nearness[window]
            nearness[window][better] = near[better]
            ground[window][better] = resample(shot.image_bgr, shot.camera, to_ray, size)[better]
        seen = np.where(nearness > 0, np.uint8(255), np.uint8(0))
        image = np.dstack([ground[:, :, ::-1], seen])
        return Mosaic(image, (left, left + float(columns) * gsd, top - float(rows) * gsd, top))


def _nearness(camera: CameraModel) -> NDArray[np.uint8]:
    """(H, W): 255 in the middle of an image, 1 at its edge."""
    across, down = (1.0 - np.abs(np.linspace(-1.0, 1.0, n)) for n in (camera.width, camera.height))
    return (1.0 + 254.0 * np.minimum(across[None, :], down[:, None])).astype(np.uint8)
