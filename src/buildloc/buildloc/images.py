"""Image files in, masks, outlines and overlays out: `buildloc segment` without ROS."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import ByteArray
from buildloc_segmenter.network import Segmentation
from shapely.geometry import mapping

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
OUTLINE_BGR = (0, 0, 255)


class ImageError(BuildlocError):
    """An image file cannot be used."""


def is_bag(path: Path) -> bool:
    """Whether a path is a recording: neither an image nor a folder without a recording's metadata."""
    return (path / "metadata.yaml").is_file() or path.suffix.lower() in (".mcap", ".db3")


def find_images(inputs: Sequence[Path]) -> list[Path]:
    """The images among files and folders, those of a folder by name. Raises ImageError."""
    found: list[Path] = []
    for path in inputs:
        if path.is_dir():
            inside = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
            if not inside:
                raise ImageError(
                    f"{path}: is a folder without metadata.yaml and without images ({', '.join(SUFFIXES)}); "
                    "give images, folders of images, or a rosbag2"
                )
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            raise ImageError(f"{path}: no such bag, image or folder; check the path")
    names: dict[str, Path] = {}
    for path in found:
        other = names.setdefault(path.stem, path)
        if other != path:
            raise ImageError(f"{other} and {path} would have the same results; give them one at a time")
    return list(names.values())


def read_image(path: Path) -> ByteArray:
    """(H, W, 3) uint8 BGR of a file, upright as its EXIF orientation says. Raises ImageError.

    Grey becomes three equal channels and transparency is left out. Of more than 8 bits the highest 8 that
    the image uses are taken: a 12-bit camera in a 16-bit file is as bright as it would be in 8 bits.
    """
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror})") from error
    if data.size == 0:
        raise ImageError(f"{path}: is empty; copy it again")
    with tempfile.TemporaryFile() as said:
        try:
            with _stderr_into(said):
                image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
        except (cv2.error, MemoryError) as error:
            raise ImageError(f"{path}: is too large to be decoded here; cut it into parts") from error
        said.seek(0)
        complaint = said.read().decode(errors="replace")
    if image is None or "rror" in complaint:
        raise ImageError(f"{path}: is damaged or no image (JPEG, PNG, TIFF); copy or export it again")
    return _eight_bits(image, path)


def _eight_bits(image: Any, path: Path) -> ByteArray:
    if image.dtype == np.uint8:
        return np.asarray(image, dtype=np.uint8)
    if image.dtype != np.uint16:
        raise ImageError(f"{path}: pixels are {image.dtype}; export it with 8 or 16 bits")
    bits = max(8, int(image.max()).bit_length())
    return np.asarray(image >> (bits - 8), dtype=np.uint8)


@contextmanager
def _stderr_into(file: IO[bytes]) -> Iterator[None]:
    """What the image libraries write to stderr goes to a file: they tell of damage in no other way."""
    sys.stderr.flush()
    kept = os.dup(2)
    os.dup2(file.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def write_results(segmentation: Segmentation, image: ByteArray, out: Path, name: str, overlay: bool) -> None:
    """NAME_mask.png and NAME.geojson in pixels; with ``overlay`` NAME_overlay.png, outlines on the image."""
    _write_png(out / f"{name}_mask.png", segmentation.mask)
    features = [
        {
            "type": "Feature",
            "geometry": mapping(building.outline),
            "properties": {
                "area_m2": round(building.area_m2, 2),
                "centroid": [round(v, 2) for v in building.outline.centroid.coords[0]],
                "score": round(building.score, 3),
            },
        }
        for building in segmentation.buildings
    ]
    (out / f"{name}.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    if overlay:
        drawn = image.copy()
        # Outlines have (0, 0) at a pixel's corner, OpenCV at its centre; 4 bits below the pixel.
        corners = [
            np.round((np.array(b.outline.exterior.coords) - 0.5) * 16).astype(np.int32)
            for b in segmentation.buildings
        ]
        cv2.polylines(drawn, corners, True, OUTLINE_BGR, 2, cv2.LINE_AA, 4)
        _write_png(out / f"{name}_overlay.png", drawn)


def _write_png(path: Path, image: ByteArray) -> None:
    if not cv2.imwrite(str(path), image):
        raise BuildlocError(f"{path}: cannot be written; check the folder and the space left")
