"""What a camera, a season and a flight do to a picture. Every function draws from ``rng`` and returns a new
RGB picture (H, W, 3) of float32, 0-255; chances and ranges are for the world, not for any one place."""

from __future__ import annotations

import cv2
import numpy as np
from rendered import Image, Labels, noise

COARSEST_GSD_M = 0.5


def colours(rgb: Image, strength: float, rng: np.random.Generator) -> Image:
    """Light and camera: hue, saturation, white balance, gamma, contrast, brightness; ``strength`` of 1 goes
    as far as cameras and suns do."""
    out = rgb
    if rng.random() < 0.5 * strength:  # turn the hues: roofs and grounds come in every colour
        hsv = cv2.cvtColor(np.clip(out, 0, 255).astype(np.uint8), cv2.COLOR_RGB2HSV).astype(np.int16)
        hsv[..., 0] = (hsv[..., 0] + rng.integers(-18, 19)) % 180
        out = cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB).astype(np.float32)
    grey = out.mean(axis=2, keepdims=True)
    faded = rng.random() < 0.2 * strength
    saturation = rng.uniform(0.0, 0.5) if faded else 1.0 + strength * rng.uniform(-0.5, 0.5)
    out = grey + (out - grey) * np.float32(saturation)
    out = out * (1.0 + strength * rng.uniform(-0.2, 0.2, 3)).astype(np.float32)
    gamma = np.float32(np.exp(strength * rng.uniform(-0.45, 0.45)))
    out = 255.0 * np.power(np.clip(out / 255.0, 0.0, 1.0), gamma)
    mean = out.mean()
    contrast, shift = 1.0 + strength * rng.uniform(-0.45, 0.4), strength * rng.uniform(-35.0, 35.0)
    return np.clip((out - mean) * np.float32(contrast) + mean + np.float32(shift), 0.0, 255.0)


def snow(rgb: Image, labels: Labels, rng: np.random.Generator) -> Image:
    """Snow in patches on the ground, and on roofs or not."""
    cover = noise(rng, len(rgb), 60) + 0.5 * noise(rng, len(rgb), 6) > rng.uniform(-1.6, 0.6)
    if rng.random() < 0.5:
        cover &= labels == 0
    white = np.float32([232, 236, 242]) + 0.25 * (rgb.mean(axis=2, keepdims=True) - 128.0)
    depth = cv2.GaussianBlur(cover.astype(np.float32), (0, 0), 1.2)[:, :, None] * np.float32(
        rng.uniform(0.6, 0.97)
    )
    return np.clip(rgb * (1.0 - depth) + white * depth, 0.0, 255.0).astype(np.float32)


def season(rgb: Image, rng: np.random.Generator) -> Image:
    """Vegetation greener or drier."""
    green = np.clip((2.0 * rgb[..., 1] - rgb[..., 0] - rgb[..., 2]) / 60.0, 0.0, 1.0)[..., None]
    turned = rgb * rng.uniform((0.6, 0.8, 0.5), (1.7, 1.15, 1.1)).astype(np.float32)
    return np.clip(rgb * (1.0 - green) + turned * green, 0.0, 255.0).astype(np.float32)


def cloud_shadow(rgb: Image, rng: np.random.Generator) -> Image:
    """Part of the picture in the shade of a cloud."""
    edge = cv2.GaussianBlur(
        (noise(rng, len(rgb), 243) > 0).astype(np.float32), (0, 0), rng.uniform(2.0, 12.0)
    )
    return (rgb * (1.0 - edge[:, :, None] * np.float32(rng.uniform(0.2, 0.6)))).astype(np.float32)


def coarse(rgb: Image, gsd_m: float, rng: np.random.Generator) -> Image:
    """As if photographed from higher: down to the coarsest resolution and back."""
    zoom = gsd_m / rng.uniform(gsd_m, COARSEST_GSD_M)
    side = max(8, round(len(rgb) * zoom))
    small = cv2.resize(rgb, (side, side), interpolation=cv2.INTER_AREA)
    return cv2.resize(small, rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR)


def blur(rgb: Image, rng: np.random.Generator) -> Image:
    """Out of focus, or moved while exposed."""
    if rng.random() < 0.6:
        return cv2.GaussianBlur(rgb, (0, 0), rng.uniform(0.4, 1.4))
    length, angle = int(rng.integers(3, 8)), rng.uniform(0.0, np.pi)
    kernel = np.zeros((length, length), dtype=np.float32)
    middle, reach = (length - 1) / 2.0, np.array([np.cos(angle), np.sin(angle)]) * length / 2.0
    ends = [tuple(int(v) for v in np.round(middle + sign * reach)) for sign in (-1, 1)]
    cv2.line(kernel, *ends, 1.0)
    return cv2.filter2D(rgb, -1, kernel / kernel.sum())


def sensor(rgb: Image, rng: np.random.Generator) -> Image:
    """Noise, and the blocks of a compressed stream."""
    out = rgb
    if rng.random() < 0.4:
        out = out + rng.standard_normal(rgb.shape, dtype=np.float32) * np.float32(rng.uniform(1.0, 9.0))
    if rng.random() < 0.5:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 95))]
        _, stream = cv2.imencode(".jpg", np.clip(out, 0, 255).astype(np.uint8), quality)
        out = cv2.imdecode(stream, cv2.IMREAD_COLOR).astype(np.float32)
    return np.clip(out, 0.0, 255.0).astype(np.float32)


def augmented(rgb: Image, labels: Labels, gsd_m: float, strength: float, rng: np.random.Generator) -> Image:
    """A picture as another flight would have taken it; the labels stay true. ``strength`` from 0 to 1."""
    out: Image = rgb
    if rng.random() < 0.3 * strength:
        out = season(out, rng)
    if rng.random() < 0.08 * strength:
        out = snow(out, labels, rng)
    if rng.random() < 0.15 * strength:
        out = cloud_shadow(out, rng)
    out = colours(out, strength, rng)
    if rng.random() < 0.35 * strength:
        out = coarse(out, gsd_m, rng)
    if rng.random() < 0.25 * strength:
        out = blur(out, rng)
    return sensor(out, rng)
