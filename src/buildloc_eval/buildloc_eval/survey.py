"""Real flights with the positions of their images: what the mapper is told, and the truth it never sees."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from buildloc_mapper.matching import Sift
from buildloc_mapper.registration import robust_similarity
from buildloc_mapper.similarity import fit_similarity
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import Quaternion, pixels_to_level
from buildloc_msgs_py.types import CameraModel, FloatArray, Frame, Mask
from pyproj import Transformer
from scipy.optimize import minimize

LEVEL: Quaternion = (0.0, 0.0, 0.0, 1.0)
XMP = re.compile(rb'drone-dji:(\w+)="([+-]?[0-9.,;+-]+)"')
SHEFFIELD_FOCAL_PX = 3.61 / 6.25 * 800  # EXIF focal length; sensor width of its 20 mm equivalent
SHEFFIELD_GSD_M = 0.15  # from the data's README: the height above ground is not recorded
SHEFFIELD_TILT = math.radians(18.0)  # where the estimate of the tilt starts, looking ahead
TILT_PAIRS = 12


@dataclass(frozen=True)
class Survey:
    """A flight over real ground, N images.

    ``true_m`` (N, 2): east, north, of the receiver. ``yaw_rad`` (N,): true direction of image-right,
    counter-clockwise from east; None when it is not recorded. Altitudes (m) and attitudes are telemetry.
    """

    name: str
    images: tuple[Path, ...]
    camera: CameraModel
    altitudes_m: tuple[float, ...]
    attitudes: tuple[Quaternion, ...]
    true_m: FloatArray
    yaw_rad: FloatArray | None

    def __len__(self) -> int:
        return len(self.images)

    def frame(self, index: int) -> Frame:
        """An image with its telemetry; its stamp is its number in seconds."""
        image = np.asarray(cv2.imread(str(self.images[index])), dtype=np.uint8)
        altitude, attitude = self.altitudes_m[index], self.attitudes[index]
        return Frame(index * 1_000_000_000, "camera", image, self.camera, altitude, attitude)

    def mask(self, index: int) -> Mask:
        """Nothing: buildings are not mapped here."""
        empty = np.zeros((self.camera.height, self.camera.width), dtype=np.uint8)
        return Mask(index * 1_000_000_000, "camera", empty)


def _local_m(latitudes_deg: list[float], longitudes_deg: list[float]) -> FloatArray:
    """(N, 2) east, north of the first; true north, so that headings need no convergence."""
    local = f"+proj=aeqd +lat_0={latitudes_deg[0]} +lon_0={longitudes_deg[0]} +units=m"
    east, north = Transformer.from_crs(4326, local, always_xy=True).transform(longitudes_deg, latitudes_deg)
    return np.column_stack([east, north])


def attitude_of(yaw_rad: float, pitch_rad: float, roll_rad: float) -> Quaternion:
    """Tilt ahead by ``pitch_rad`` and to the right by ``roll_rad``, then clockwise by ``yaw_rad``."""
    (sy, cy), (sp, cp), (sr, cr) = (
        (math.sin(a / 2), math.cos(a / 2)) for a in (yaw_rad, pitch_rad, roll_rad)
    )
    x, y, z, w = cr * sp, sr * cp, -sr * sp, cr * cp  # roll about image-down, then pitch about image-right
    return cy * x - sy * y, cy * y + sy * x, cy * z + sy * w, cy * w - sy * z


def read_xmp(image: Path) -> dict[str, str]:
    """DJI's XMP attributes of an image."""
    found = {k.decode(): v.decode() for k, v in XMP.findall(image.read_bytes()[:200_000])}
    if "GpsLatitude" not in found:
        raise BuildlocError(f"{image}: holds no DJI position; fetch the original images again")
    return found


def mirafiori(data: Path) -> Survey:
    """32 nadir images with RTK; lens and attitude from their own XMP, focal length from K.txt."""
    folder = data / "imagery" / "mirafiori_rtk"
    images = tuple(sorted(folder.glob("*.JPG")))
    if not images:
        raise BuildlocError(f"{folder}: no images here; set BUILDLOC_DATA to the folder of the data")
    notes = [read_xmp(image) for image in images]
    fx, fy, cx, cy = np.loadtxt(folder / "K.txt")[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    lens = tuple(float(v) for v in notes[0]["DewarpData"].split(";")[1].split(",")[4:9])
    camera = CameraModel(1600, 1300, fx, fy, cx, cy, lens)
    angles = np.radians([[float(n[f"Gimbal{a}Degree"]) for a in ("Yaw", "Pitch", "Roll")] for n in notes])
    true_m = _local_m([float(n["GpsLatitude"]) for n in notes], [float(n["GpsLongitude"]) for n in notes])
    attitudes = tuple(attitude_of(y, p + math.pi / 2, r) for y, p, r in angles.tolist())
    altitudes = tuple(float(n["RelativeAltitude"]) for n in notes)
    return Survey("mirafiori_rtk", images, camera, altitudes, attitudes, true_m, -angles[:, 0])


def sheffield(data: Path, images: int | None = None) -> Survey:
    """172 images of a tilted camera with EXIF GPS and no attitude: the tilt is estimated from the images.

    The height is nominal, with the changes that EXIF records.
    """
    folder = data / "imagery" / "sheffield_flight"
    if not (folder / "gps.csv").is_file():
        raise BuildlocError(f"{folder}: no gps.csv here; set BUILDLOC_DATA to the folder of the data")
    with (folder / "gps.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))[:images]
    paths = tuple(folder / row["file"] for row in rows)
    camera = CameraModel(800, 600, SHEFFIELD_FOCAL_PX, SHEFFIELD_FOCAL_PX, 399.5, 299.5)
    told = np.array([float(row["exif_alt_m"]) for row in rows])
    heights = tuple((SHEFFIELD_GSD_M * SHEFFIELD_FOCAL_PX + told - np.median(told)).tolist())
    true_m = _local_m([float(row["lat"]) for row in rows], [float(row["lon"]) for row in rows])
    pitch, roll = estimate_tilt(paths, camera, heights[0])
    attitudes = (attitude_of(0.0, pitch, roll),) * len(rows)
    return Survey("sheffield_flight", paths, camera, heights, attitudes, true_m, None)


def estimate_tilt(images: tuple[Path, ...], camera: CameraModel, altitude_m: float) -> tuple[float, float]:
    """Pitch and roll (rad) of a camera that is mounted fast: those that make pairs of images most similar.

    From correspondences alone, at a height that only sets the unit.
    """
    sift = Sift(2000, 800, 0.8)
    greys = [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), dtype=np.uint8) for path in images[:40]]
    step = max(1, (len(greys) - 1) // TILT_PAIRS)
    pairs: list[tuple[FloatArray, FloatArray]] = []
    for first in range(0, len(greys) - 1, step):
        found = sift.match(*(sift.prepare(grey) for grey in greys[first : first + 2]))
        plane, kept = cv2.findHomography(found.later_uv, found.earlier_uv, cv2.USAC_MAGSAC, 2.0)
        if plane is not None and kept.sum() >= 30:
            pairs.append((found.later_uv[kept.ravel() > 0], found.earlier_uv[kept.ravel() > 0]))
    if not pairs:
        raise BuildlocError("no pair of images shows the same ground; the tilt cannot be estimated")

    def residual(tilt: FloatArray) -> float:
        """Mean absolute error of the similarities, m."""
        attitude, errors = attitude_of(0.0, float(tilt[0]), float(tilt[1])), []
        for later, earlier in pairs:
            source, target = (pixels_to_level(uv, camera, altitude_m, attitude) for uv in (later, earlier))
            rough, _ = robust_similarity(source, target, altitude_m / 10.0)
            fine, _ = fit_similarity(source, target, np.array(rough[:2]), 1e-6)
            errors.append(float(np.abs(fine.apply(source) - target).mean()))
        return float(np.mean(errors))

    start = np.array([[SHEFFIELD_TILT, 0.0], [SHEFFIELD_TILT - 0.1, 0.0], [SHEFFIELD_TILT, 0.1]])
    options = {"initial_simplex": start, "xatol": 1e-4, "fatol": 1e-6, "maxiter": 80}
    pitch, roll = minimize(residual, start[0], method="Nelder-Mead", options=options).x
    return float(pitch), float(roll)
