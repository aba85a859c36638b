"""Training crops: squares cut out of labelled scenes at any scale, heading and tilt, and their targets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from augment import augmented
from buildloc_eval.places import Scene
from layouts import decoys, render
from numpy.typing import NDArray
from rendered import Image, Labels

TRAIN_GSD_M = 0.2  # what the network sees
FINEST_GSD_M = 0.12  # scenes are kept no finer than this
CROP_PX = 256
CORE_M = 0.6  # the core of a building is what lies deeper inside it than this
RENDERED_SIDE_PX = 448
ONE_HOUSE_M2 = 200.0  # what a mask shows as one building, and is larger, may be several


@dataclass(frozen=True)
class CropConfig:
    """How crops are drawn: shares of rendered scenes and of real crops with decoys, scale range of a wrong
    altitude, tilt; and the last part of a run, whose crops are closer to what a camera brings: rendered
    scenes, decoys and weather at this strength."""

    rendered_share: float = 0.4
    rendered_scenes: int = 1200
    decoy_share: float = 0.3
    scale: float = 1.5
    tilt: float = 0.06
    closing: float = 0.3
    closing_strength: float = 0.4


def core(labels: Labels, gsd_m: float) -> NDArray[np.bool_]:
    """Pixels deeper inside their own building than CORE_M: cores of touching buildings lie apart."""
    reach = max(1, round(CORE_M / gsd_m))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    numbers = labels.astype(np.float32)
    return (labels > 0) & (cv2.erode(numbers, disc) == cv2.dilate(numbers, disc))


def rendered_scenes(count: int, seed: int) -> list[Scene]:
    """Towns drawn at random, of TRAIN_GSD_M."""
    rng = np.random.default_rng(seed)
    scenes = []
    for index in range(count):
        rgb, labels = render(RENDERED_SIDE_PX, TRAIN_GSD_M, rng)
        everywhere = np.ones(labels.shape, dtype=np.bool_)
        scenes.append(Scene(f"rendered/{index}", TRAIN_GSD_M, rgb.astype(np.uint8), labels, everywhere))
    return scenes


@dataclass(frozen=True)
class _Ground:
    """A real scene, of which labels it is known where a building ends (:func:`_one_house`), and where crops
    may lie: (N, 2) rows and columns of labelled pixels."""

    scene: Scene
    one_house: NDArray[np.bool_]
    inside: NDArray[np.int64]

    @staticmethod
    def of(scene: Scene) -> _Ground:
        """Of a scene, which is kept no finer than FINEST_GSD_M."""
        scene = scene.resampled(FINEST_GSD_M) if scene.gsd_m < FINEST_GSD_M else scene
        return _Ground(scene, _one_house(scene), np.argwhere(scene.labelled[::16, ::16]) * 16)


class CropSampler:
    """Draws crops from scenes held in memory; one that is named several times is held once and drawn more
    often."""

    def __init__(self, real: Sequence[Scene], config: CropConfig, seed: int) -> None:
        self._config, self._seed = config, seed
        once = {id(scene): scene for scene in real}
        grounds = {key: _Ground.of(scene) for key, scene in once.items()}
        self._real = [grounds[id(scene)] for scene in real]
        # Large places count more than small ones, but not by their area: variety matters.
        area = np.array([at.scene.labelled.sum() * at.scene.gsd_m**2 for at in self._real]) ** 0.6
        self._odds = area / area.sum()
        self._rendered = rendered_scenes(config.rendered_scenes, seed) if config.rendered_share > 0.0 else []

    def batch(self, step: int, count: int, done: float = 0.0) -> tuple[Image, Image, Image]:
        """A step's batch: RGB 0-255 (n, 3, h, w), building and core (n, 2, h, w), their weights (n, 2, h, w).

        ``done`` is the share of the run that lies behind.
        """
        rng = np.random.default_rng((self._seed, step))
        strength = self._config.closing_strength if done >= 1.0 - self._config.closing else 1.0
        rgb, target, weight = zip(*(self._crop(strength, rng) for _ in range(count)), strict=True)
        return np.stack(rgb), np.stack(target), np.stack(weight)

    def _crop(self, strength: float, rng: np.random.Generator) -> tuple[Image, Image, Image]:
        config = self._config
        is_rendered = rng.random() < config.rendered_share * strength
        if is_rendered:
            scene = self._rendered[rng.integers(len(self._rendered))]
            centre = rng.uniform(0.3, 0.7, 2) * RENDERED_SIDE_PX
        else:
            ground = self._real[int(rng.choice(len(self._real), p=self._odds))]
            scene = ground.scene
            row, column = ground.inside[rng.integers(len(ground.inside))]
            centre = np.array([column, row]) + rng.uniform(0.0, 16.0, 2)
        to_scene = _warp(centre, TRAIN_GSD_M / scene.gsd_m, rng, config)
        rgb, labels, known = _cut(scene, to_scene)
        if not is_rendered and rng.random() < config.decoy_share * strength:
            rgb = decoys(rgb, labels, TRAIN_GSD_M, rng)
        rgb = augmented(rgb, labels, TRAIN_GSD_M, strength, rng)
        split_known = known if is_rendered else known & ground.one_house[labels]
        target = np.stack([labels > 0, core(labels, TRAIN_GSD_M)]).astype(np.float32)
        return (
            np.ascontiguousarray(rgb.transpose(2, 0, 1)),
            target,
            np.stack([known, split_known]).astype(np.float32),
        )


def _one_house(scene: Scene) -> NDArray[np.bool_]:
    """Of each label, ground (0) too, whether it is known where its building ends and the next one begins."""
    areas = np.bincount(scene.buildings.ravel()) * scene.gsd_m**2
    known = scene.told_apart | (areas <= ONE_HOUSE_M2)
    known[0] = True
    return known


def _warp(
    centre: NDArray[np.float64], step: float, rng: np.random.Generator, config: CropConfig
) -> NDArray[np.float64]:
    """(3, 3) from crop pixels to scene pixels: any heading, mirrored or not, wrong altitude, tilt."""
    step *= math.exp(rng.uniform(-1.0, 1.0) * math.log(config.scale))
    angle = rng.uniform(0.0, math.tau)
    c, s = step * math.cos(angle), step * math.sin(angle)
    linear = np.array([[c, -s], [s, c]]) * np.array([rng.choice((-1.0, 1.0)), 1.0])
    tilt = np.eye(3)
    tilt[2, :2] = rng.uniform(-config.tilt, config.tilt, 2) * 2.0 / CROP_PX
    shift = np.eye(3)
    shift[:2, 2] = -(CROP_PX - 1) / 2.0
    place = np.eye(3)
    place[:2, :2], place[:2, 2] = linear, centre
    return place @ tilt @ shift


def _cut(scene: Scene, to_scene: NDArray[np.float64]) -> tuple[Image, Labels, NDArray[np.bool_]]:
    """The crop's RGB, labels and labelled pixels."""
    corners = np.array([[0, 0], [CROP_PX, 0], [0, CROP_PX], [CROP_PX, CROP_PX]], dtype=np.float64)
    seen = cv2.perspectiveTransform(corners[None], to_scene)[0]
    height, width = scene.labelled.shape
    c0, r0 = np.clip(seen.min(axis=0).astype(int) - 2, 0, (width - 1, height - 1))
    c1, r1 = np.clip(seen.max(axis=0).astype(int) + 3, 1, (width, height))
    part = scene.part(slice(r0, r1), slice(c0, c1), scene.name)  # warping the whole scene would be slow
    back = np.eye(3)
    back[:2, 2] = -c0, -r0
    matrix, size = back @ to_scene, (CROP_PX, CROP_PX)
    step = math.sqrt(abs(np.linalg.det(to_scene[:2, :2])))
    rgb = part.rgb if step <= 1.0 else cv2.GaussianBlur(part.rgb, (0, 0), 0.45 * step)
    flags = cv2.WARP_INVERSE_MAP
    out = cv2.warpPerspective(rgb, matrix, size, flags=cv2.INTER_LINEAR | flags)
    numbers = cv2.warpPerspective(
        part.buildings.astype(np.float32), matrix, size, flags=cv2.INTER_NEAREST | flags
    )
    known = cv2.warpPerspective(part.labelled.astype(np.uint8), matrix, size, flags=cv2.INTER_NEAREST | flags)
    return out.astype(np.float32), numbers.astype(np.int32), known > 0
