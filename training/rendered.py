"""Rendered ground: towns drawn at random, labels exact.

Labelled imagery with a licence is scarce and tropical. What it lacks is drawn here at random and mixed in:
pitched roofs in any colour, driveways, patios, car parks and roads that are no roofs, trees, shadows.
Nothing is drawn after any real place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]  # (H, W, 3) RGB, 0-255
Labels = NDArray[np.int32]
Points = NDArray[np.float64]
Wing = tuple[Points, float, float, float]  # centre, length, width, angle of a rectangle

GROUNDS = np.array(
    [
        [74, 92, 58],
        [92, 108, 66],
        [58, 76, 48],
        [128, 122, 84],
        [150, 138, 104],
        [138, 112, 84],
        [176, 158, 128],
    ],
    dtype=np.float32,
)  # lawns, meadow, dry grass, soil, sand
PAVINGS = np.array(
    [[96, 98, 100], [122, 122, 120], [148, 146, 140], [178, 174, 166], [136, 124, 112], [158, 132, 112]],
    dtype=np.float32,
)  # asphalt old and new, concrete, gravel, brick
ROOFS = np.array(
    [
        [70, 72, 78],
        [96, 98, 104],
        [150, 150, 152],
        [198, 198, 198],
        [152, 84, 62],
        [186, 108, 76],
        [118, 66, 52],
        [128, 104, 84],
        [88, 108, 140],
        [92, 130, 110],
        [214, 206, 190],
        [60, 54, 52],
    ],
    dtype=np.float32,
)  # slate, felt, metal, tiles, brown, painted
CARS = np.array(
    [[230, 230, 230], [40, 42, 46], [120, 124, 130], [150, 40, 36], [40, 60, 120]], dtype=np.float32
)
HEDGE = np.array([50, 72, 38], dtype=np.float32)
SUBPIXEL = 4


def noise(rng: np.random.Generator, side: int, coarsest_px: int) -> Image:
    """(side, side) noise of unit deviation, correlated over up to ``coarsest_px``."""
    total = np.zeros((side, side), dtype=np.float32)
    step = coarsest_px
    while step >= 1:
        coarse = rng.standard_normal((side // step + 2,) * 2).astype(np.float32)
        fine = cv2.resize(coarse, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)
        total += fine[:side, :side] * (step / coarsest_px) ** 0.5
        step //= 3
    return total / total.std()


Pixels = tuple[NDArray[np.intp], NDArray[np.intp]]  # rows and columns


def _inside(shape: tuple[int, ...], outline: Points) -> Pixels:
    """The pixels of a picture that an outline covers."""
    corners = np.round(outline * 2**SUBPIXEL).astype(np.int32)
    low, high = corners.min(axis=0) >> SUBPIXEL, (corners.max(axis=0) >> SUBPIXEL) + 2
    left, top = np.clip(low - 1, 0, (shape[1], shape[0]))
    right, bottom = np.clip(high, 0, (shape[1], shape[0]))
    plane = np.zeros((max(0, bottom - top), max(0, right - left)), dtype=np.uint8)
    if plane.size:
        cv2.fillPoly(plane, [corners - (np.array([left, top]) << SUBPIXEL)], 1, cv2.LINE_8, SUBPIXEL)
    rows, columns = np.nonzero(plane)
    return rows + top, columns + left


def _where(pixels: Pixels, plane: NDArray[np.bool_]) -> Pixels:
    """Those at which the plane is true."""
    kept = plane[pixels]
    return pixels[0][kept], pixels[1][kept]


def axes(angle: float) -> Points:
    """(2, 2) unit vectors along an angle and across it."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s], [-s, c]])


def rectangle(centre: Points, length: float, width: float, angle: float) -> Points:
    """Corners (4, 2) of a rectangle, its length along ``angle``."""
    corners = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) * (length / 2.0, width / 2.0)
    return centre + corners @ axes(angle)


@dataclass(frozen=True)
class Light:
    """Direction of the shadows in the picture, shadow length per height, darkness of the shade, and how far
    the camera's view lets walls lean out per height."""

    away: Points
    stretch: float
    shade: float
    lean: Points

    @staticmethod
    def drawn(rng: np.random.Generator) -> Light:
        """A sun anywhere from high to low, or an overcast sky."""
        angle = rng.uniform(0.0, math.tau)
        shade = rng.uniform(0.15, 0.6) if rng.random() < 0.8 else rng.uniform(0.8, 1.0)
        return Light(axes(angle)[0], rng.uniform(0.3, 1.8), shade, rng.normal(0.0, 0.12, 2))

    def shadow(self, outline: Points, height_px: float) -> Points:
        """The outline of a body together with its shadow."""
        tip = outline + self.away * height_px * self.stretch
        return cv2.convexHull(np.vstack([outline, tip]).astype(np.float32))[:, 0].astype(np.float64)


class Canvas:
    """A picture under construction: RGB, and the building of each pixel."""

    def __init__(self, side_px: int, gsd_m: float, rng: np.random.Generator) -> None:
        self.rng, self.side, self.gsd, self.light = rng, side_px, gsd_m, Light.drawn(rng)
        self.labels: Labels = np.zeros((side_px, side_px), dtype=np.int32)
        self.roof_px: Image = np.zeros((side_px, side_px), dtype=np.float32)  # heights
        fine, coarse = noise(rng, side_px, 9), noise(rng, side_px, 81)
        first, second = GROUNDS[rng.integers(len(GROUNDS), size=2)]
        blend = 1.0 / (1.0 + np.exp(-rng.uniform(1.0, 4.0) * coarse))[:, :, None]
        self.rgb: Image = first * (1.0 - blend) + second * blend
        self.fine = fine[:, :, None]
        self.rgb += self.fine * rng.uniform(2.0, 12.0)

    def place(self) -> Points:
        """A random place."""
        return self.rng.uniform(0.0, self.side, 2)

    def px(self, low_m: float, high_m: float) -> float:
        """A random length."""
        return float(self.rng.uniform(low_m, high_m)) / self.gsd

    def paint(self, outline: Points, colour: Image, roughness: float, ground_only: bool = True) -> None:
        """Fill an outline with a rough colour, not over roofs when ``ground_only``."""
        where = _inside(self.labels.shape, outline)
        if ground_only:
            where = _where(where, self.labels == 0)
        self.rgb[where] = colour + self.fine[where] * roughness

    def shade(self, outline: Points, height_px: float) -> None:
        """Darken the ground that a body of this outline and height casts its shadow on, and much lower roofs
        that it reaches."""
        low = self.roof_px < 0.6 * height_px
        for reach, lit in ((1.0, self.labels == 0), (0.5, (self.labels > 0) & low)):
            shadow = self.light.shadow(outline, height_px * reach)
            self.rgb[_where(_inside(self.labels.shape, shadow), lit)] *= self.light.shade

    def car(self, centre: Points, angle: float) -> None:
        """A parked car."""
        length, width = self.px(3.8, 5.2), self.px(1.6, 2.0)
        body = rectangle(centre, length, width, angle)
        self.shade(body, 1.4 / self.gsd)
        colour = CARS[self.rng.integers(len(CARS))] * self.rng.uniform(0.8, 1.1)
        self.paint(body, colour, 3.0)
        self.paint(rectangle(centre, length * 0.45, width * 0.8, angle), colour * 0.5, 2.0)

    def paving(self) -> Image:
        """A colour of road, yard or terrace."""
        return PAVINGS[self.rng.integers(len(PAVINGS))] * self.rng.uniform(0.7, 1.25)

    def road(self, centre: Points, angle: float) -> None:
        """A road through the picture, at times with pavements and a marking."""
        width, colour = self.px(3.0, 9.0), self.paving()
        if self.rng.random() < 0.4:
            self.paint(
                rectangle(centre, 3.0 * self.side, width + self.px(2.0, 5.0), angle), self.paving(), 4.0
            )
        self.paint(rectangle(centre, 3.0 * self.side, width, angle), colour, 4.0)
        if self.rng.random() < 0.4:
            self.paint(rectangle(centre, 3.0 * self.side, 0.15 / self.gsd, angle), colour * 0 + 220, 4.0)
        for _ in range(self.rng.integers(0, 4)):
            side = width * self.rng.uniform(-0.4, 0.4)
            offset = np.array([self.rng.uniform(-0.7, 0.7) * self.side, side])
            self.car(centre + offset @ axes(angle), angle)

    def yard(self, centre: Points, angle: float) -> None:
        """Bare paving."""
        outline = rectangle(centre, self.px(3.0, 20.0), self.px(2.5, 10.0), angle)
        self.paint(outline, self.paving(), self.rng.uniform(2.0, 7.0))

    def car_park(self, centre: Points, angle: float) -> None:
        """Rows of bays, some taken."""
        length, depth = self.px(8.0, 30.0), self.px(5.0, 18.0)
        colour = self.paving()
        self.paint(rectangle(centre, length, depth, angle), colour, 4.0)
        along, across = axes(angle)
        bay = 2.5 / self.gsd
        for k in range(int(length / bay)):
            at = centre + along * ((k + 0.5) * bay - length / 2.0) + across * (depth / 2.0 - 2.5 / self.gsd)
            if self.rng.random() < 0.8:
                self.paint(
                    rectangle(at + along * bay / 2.0, 0.12 / self.gsd, 5.0 / self.gsd, angle),
                    colour * 0 + 225,
                    3.0,
                )
            if self.rng.random() < 0.4:
                self.car(at, angle + math.pi / 2.0)

    def pool(self, centre: Points, angle: float) -> None:
        """Water with a rim: a basin, a round pool, a trampoline, at times a pond."""
        rng = self.rng
        water = np.array([70, 150, 190], dtype=np.float32) * rng.uniform(0.6, 1.2, 3).astype(np.float32)
        if rng.random() < 0.35:
            water = np.array([30, 38, 44], dtype=np.float32) * np.float32(rng.uniform(0.4, 1.3))
        turns = np.linspace(0.0, math.tau, 20, endpoint=False)
        disc = np.column_stack([np.cos(turns), np.sin(turns)])
        if rng.random() < 0.15:
            shape = disc * self.px(4.0, 14.0) * rng.uniform(0.8, 1.2, (20, 1))
        elif rng.random() < 0.5:
            shape = disc * self.px(1.5, 3.0)
        else:
            shape = rectangle(np.zeros(2), self.px(5.0, 11.0), self.px(3.0, 5.0), angle)
        self.paint(centre + shape * 1.12, self.paving() * 1.2, 3.0)
        self.paint(centre + shape, water, 3.0)

    def hedge(self, centre: Points, angle: float) -> None:
        """A hedge, fence or wall with its shadow."""
        line = rectangle(centre, self.px(6.0, 35.0), self.px(0.2, 1.6), angle)
        height = self.px(0.8, 2.0)
        green = HEDGE * np.float32(self.rng.uniform(0.6, 1.3))
        self.wall(line, height, green if self.rng.random() < 0.6 else self.paving() * 1.2)

    def wall(self, outline: Points, height_px: float, colour: Image) -> None:
        """Something too low or too narrow to be a building, with its shadow."""
        self.shade(outline, height_px)
        self.paint(outline, colour, 9.0)

    def enclosure(self, centre: Points, angle: float) -> None:
        """A garden, a bed or a court within a hedge or a low wall."""
        length, width, thick = self.px(5.0, 16.0), self.px(4.0, 12.0), self.px(0.3, 1.4)
        ring = rectangle(centre, length, width, angle)
        height, green = self.px(0.6, 1.8), HEDGE * np.float32(self.rng.uniform(0.6, 1.3))
        self.wall(ring, height, green if self.rng.random() < 0.7 else self.paving())
        ground = GROUNDS[self.rng.integers(len(GROUNDS))] if self.rng.random() < 0.7 else self.paving()
        self.paint(rectangle(centre, length - 2.0 * thick, width - 2.0 * thick, angle), ground, 7.0)

    def awning(self, centre: Points, angle: float) -> None:
        """A canopy, pale or striped, over a terrace: cloth, and no building."""
        outline = rectangle(centre, self.px(2.0, 6.0), self.px(1.5, 4.0), angle)
        self.shade(outline, self.px(2.0, 2.6))
        colour = np.array([226, 222, 212], dtype=np.float32) * np.float32(self.rng.uniform(0.7, 1.1))
        if self.rng.random() < 0.3:
            colour = colour * self.rng.uniform(0.4, 1.0, 3).astype(np.float32)
        self.paint(outline, colour, 2.0)

    def terrace(self, centre: Points, angle: float) -> None:
        """A paved or decked yard with things on it."""
        length, width = self.px(3.0, 14.0), self.px(2.5, 8.0)
        self.paint(rectangle(centre, length, width, angle), self.paving(), self.rng.uniform(2.0, 8.0))
        for _ in range(self.rng.integers(0, 8)):
            at = centre + self.rng.uniform(-0.45, 0.45, 2) * min(length, width)
            thing = rectangle(at, self.px(0.4, 2.5), self.px(0.4, 1.8), self.rng.uniform(0.0, math.pi))
            self.shade(thing, self.px(0.4, 1.2))
            self.paint(
                thing, self.rng.uniform(20.0, 240.0) * self.rng.uniform(0.85, 1.15, 3).astype(np.float32), 4.0
            )

    def tree(self, centre: Points, radius: float) -> None:
        """A crown with its shadow; it may hang over a roof."""
        turns = np.linspace(0.0, math.tau, 14, endpoint=False)
        ragged = radius * self.rng.uniform(0.7, 1.15, len(turns))
        crown = centre + np.column_stack([np.cos(turns), np.sin(turns)]) * ragged[:, None]
        self.shade(crown, radius * 1.5)
        colour = np.array([52, 72, 40], dtype=np.float32) * self.rng.uniform(0.6, 1.5, 3).astype(np.float32)
        self.paint(crown, colour, 14.0, ground_only=self.rng.random() < 0.7)
        lit = centre - self.light.away * radius * 0.25 + (crown - centre) * 0.55
        self.paint(lit, colour * 1.35, 14.0, ground_only=True)


def _roof_faces(length: float, width: float, kind: str) -> list[tuple[Points, Points]]:
    """Faces of a roof over a rectangle about the origin, and the downhill direction of each."""
    half, w = length / 2.0, width / 2.0
    corners = np.array([[half, w], [-half, w], [-half, -w], [half, -w]])
    if kind == "flat":
        return [(corners, np.zeros(2))]
    if kind == "shed":
        return [(corners, np.array([0.0, 1.0]))]
    inset = min(w, half * 0.8) if kind == "hip" else 0.0
    ridge = np.array([[half - inset, 0.0], [inset - half, 0.0]])
    faces = [
        (np.array([corners[0], corners[1], ridge[1], ridge[0]]), np.array([0.0, 1.0])),
        (np.array([corners[2], corners[3], ridge[0], ridge[1]]), np.array([0.0, -1.0])),
    ]
    if kind == "hip":
        faces.append((np.array([corners[3], corners[0], ridge[0]]), np.array([1.0, 0.0])))
        faces.append((np.array([corners[1], corners[2], ridge[1]]), np.array([-1.0, 0.0])))
    return faces


def _roof_top(canvas: Canvas, footprint: NDArray[np.bool_], wing: Wing, colour: Image) -> None:
    """What stands on a flat roof that people use: parapet, head of the stairs, water tanks."""
    rng, (centre, length, width, angle) = canvas.rng, wing
    size = (max(1.0, side - 2.0 * canvas.px(0.2, 0.5)) for side in (length, width))
    inner = rectangle(centre, *size, angle)
    floor = colour * np.float32(rng.uniform(0.65, 1.0)) if rng.random() < 0.6 else canvas.paving()
    where = _where(_inside(footprint.shape, inner), footprint)
    canvas.rgb[where] = floor + canvas.fine[where] * np.float32(rng.uniform(2.0, 9.0))
    turns = np.linspace(0.0, math.tau, 12, endpoint=False)
    disc = np.column_stack([np.cos(turns), np.sin(turns)])
    tank = np.float32(rng.choice((30.0, 90.0, 225.0)))
    for _ in range(rng.integers(0, 5)):
        spot = centre + (inner[rng.integers(4)] - centre) * rng.uniform(0.0, 0.85)
        if rng.random() < 0.3:
            body = rectangle(spot, canvas.px(2.0, 4.5), canvas.px(1.8, 3.5), angle)
            height = canvas.px(1.5, 3.0)
            paint = colour * np.float32(rng.uniform(0.8, 1.3))
        else:
            body, height = spot + disc * canvas.px(0.4, 0.9), canvas.px(0.8, 1.8)
            paint = np.full(3, tank, dtype=np.float32)
        shadow = canvas.light.shadow(body, height)
        canvas.rgb[_where(_inside(footprint.shape, shadow), footprint)] *= canvas.light.shade
        canvas.rgb[_where(_inside(footprint.shape, body), footprint)] = paint


def _roof_colour(rng: np.random.Generator) -> Image:
    """Of one roof."""
    return ROOFS[rng.integers(len(ROOFS))] * rng.uniform(0.7, 1.25) + rng.uniform(-12, 12, 3).astype(
        np.float32
    )


def _body(
    canvas: Canvas, number: int, footprint: NDArray[np.bool_], wings: list[Wing], height: float, kind: str,
    colour: Image,
) -> None:  # fmt: skip
    """Draw wings of one height and kind of roof, and their shadow; theirs is the ``footprint``."""
    rng = canvas.rng
    wall = canvas.paving() * rng.uniform(0.8, 1.6)
    for wing in wings:
        canvas.shade(rectangle(*wing), height)
    for wing in wings:  # the roof hides the foot of one wall, and shows that of the other
        foot = rectangle(*wing)
        hull = cv2.convexHull(np.vstack([foot, foot + canvas.light.lean * height]).astype(np.float32))[:, 0]
        canvas.paint(hull.astype(np.float64), wall, 4.0)
    stripes, amplitude = rng.uniform(0.25, 1.2) / canvas.gsd, rng.uniform(0.0, 0.12)
    contrast = rng.uniform(0.2, 1.2) * (1.0 - canvas.light.shade)
    used = rng.random() < 0.6
    for at, long, wide, a in wings:
        if rng.random() < 0.25:
            colour = _roof_colour(rng)
        turn = axes(a)
        for face, downhill in _roof_faces(long, wide, kind):
            rows, columns = where = _where(_inside(footprint.shape, at + face @ turn), footprint)
            lit = max(0.3, 1.0 - contrast * float(downhill @ turn @ canvas.light.away))
            along = columns * math.cos(a) + rows * math.sin(a)
            ribs = 1.0 + amplitude * np.sin(along * (math.tau / max(stripes, 2.2)))
            canvas.rgb[where] = colour * lit * ribs[:, None] + canvas.fine[where] * rng.uniform(1.0, 8.0)
        if kind == "flat" and used:
            _roof_top(canvas, footprint, (at, long, wide, a), colour)
    canvas.labels[footprint] = number
    canvas.roof_px[footprint] = height


def _attached(canvas: Canvas, house: Wing) -> Wing:
    """What is built against a house: a garage, a porch, a later part."""
    rng, (_, length, width, _) = canvas.rng, house
    long, wide = canvas.px(2.5, 7.5), canvas.px(2.5, 6.5)
    if rng.random() < 0.5:
        offset = np.array([(length + long) / 2.0, rng.uniform(-0.5, 0.5) * width])
    else:
        offset = np.array([rng.uniform(-0.5, 0.5) * length, (width + wide) / 2.0])
    return _beside(house, offset * rng.choice((-1.0, 1.0), 2), long, wide)


def joined(canvas: Canvas, house: Wing) -> tuple[Wing, Wing]:
    """Another body of a house at some distance, and what joins the two."""
    rng, (_, length, width, _) = canvas.rng, house
    gap, long, wide = canvas.px(2.0, 6.0), length * rng.uniform(0.6, 1.1), width * rng.uniform(0.6, 1.1)
    side, shift = float(rng.choice((-1.0, 1.0))), rng.uniform(-0.4, 0.4) * length
    other = _beside(house, np.array([shift, side * ((width + wide) / 2.0 + gap)]), long, wide)
    low, high = max(-length, 2.0 * shift - long) / 2.0, min(length, 2.0 * shift + long) / 2.0
    along = low + (high - low) * rng.uniform(0.3, 0.7)  # where both bodies are
    middle = np.array([along, side * (width + gap) / 2.0])
    return other, _beside(house, middle, (high - low) * rng.uniform(0.3, 1.2), gap + canvas.px(0.0, 2.0))


def _beside(house: Wing, offset: Points, length: float, width: float) -> Wing:
    """A wing whose centre lies at an offset from that of the house, along and across it."""
    centre, _, _, angle = house
    return centre + offset @ axes(angle), length, width, angle


def _lower(canvas: Canvas, number: int, wing: Wing, free: NDArray[np.bool_], colour: Image) -> None:
    """Draw a part of a house that is lower and under a roof of its own, where it is ``free``."""
    rng = canvas.rng
    footprint = np.zeros(free.shape, dtype=np.bool_)
    footprint[_where(_inside(free.shape, rectangle(*wing)), free)] = True
    kind = str(rng.choice(("flat", "shed", "gable"), p=(0.5, 0.2, 0.3)))
    own = colour if rng.random() < 0.3 else _roof_colour(rng)
    _body(canvas, number, footprint, [wing], canvas.px(2.2, 3.4), kind, own)


def building(canvas: Canvas, number: int, centre: Points, length: float, width: float, angle: float) -> bool:
    """Draw one building, of a wing or two, at times with something lower built against or between them, with
    its shadow; False where another stands."""
    rng = canvas.rng
    turn = axes(angle)
    house = (centre, length, width, angle)
    wings, lower = [house], list[Wing]()
    form = rng.random()
    if form < 0.1:
        other, link = joined(canvas, house)
        wings.append(other)
        lower.append(link)
    elif form < 0.45:
        side = np.array([rng.choice((-1, 1)) * (length - width) / 2.0 * 0.95, width / 2.0])
        wings.append(
            (
                centre + side @ turn,
                width * rng.uniform(0.9, 1.6),
                width * rng.uniform(0.5, 0.95),
                angle + math.pi / 2,
            )
        )
    footprint = np.zeros(canvas.labels.shape, dtype=np.bool_)
    for wing in wings:
        footprint[_inside(footprint.shape, rectangle(*wing))] = True
    taken = canvas.labels > 0
    if not footprint.any() or taken[footprint].mean() > 0.1:  # pixels that touching houses share
        return False
    footprint &= ~taken
    height, colour = canvas.px(2.5, 9.0), _roof_colour(rng)
    lower += [_attached(canvas, house) for _ in range(rng.integers(1, 3) if rng.random() < 0.35 else 0)]
    for wing in lower:  # first: the house shades it
        _lower(canvas, number, wing, ~(taken | footprint), colour)
    kind = str(rng.choice(("gable", "hip", "flat", "shed"), p=(0.45, 0.2, 0.25, 0.1)))
    _body(canvas, number, footprint, wings, height, kind, colour)
    for _ in range(rng.integers(0, 5)):  # chimneys, skylights, panels
        spot = centre + (rng.uniform(-0.4, 0.4, 2) * (length, width)) @ turn
        size = (
            (canvas.px(0.5, 1.5), canvas.px(0.5, 1.5))
            if rng.random() < 0.7
            else (canvas.px(2, 6), canvas.px(1.5, 3))
        )
        shine = rng.choice((0.4, 0.6, 1.5)) * colour if rng.random() < 0.6 else np.float32([44, 56, 84])
        where = _where(_inside(footprint.shape, rectangle(spot, *size, angle)), footprint)
        canvas.rgb[where] = shine
    return True


def annexes(canvas: Canvas, centre: Points, length: float, width: float, angle: float) -> None:
    """Driveway, terrace, lawn or yard about a building: rectangles along its walls that are no building."""
    rng = canvas.rng
    along, across = axes(angle)
    if rng.random() < 0.5:
        plot = rectangle(centre, length + canvas.px(6, 20), width + canvas.px(6, 20), angle)
        canvas.paint(plot, GROUNDS[rng.integers(len(GROUNDS))] * rng.uniform(0.8, 1.2), 8.0)
    for _ in range(rng.integers(0, 4)):
        long, wide = canvas.px(2.5, 14.0), canvas.px(2.5, 6.0)
        side = float(rng.choice((-1, 1)))
        at = centre + across * side * (width + wide) / 2.0 + along * rng.uniform(-0.5, 0.5) * length
        if rng.random() < 0.5:
            at = centre + along * side * (length + long) / 2.0 + across * rng.uniform(-0.5, 0.5) * width
        if rng.random() < 0.4:
            canvas.terrace(at, angle)
        else:
            canvas.paint(rectangle(at, long, wide, angle), canvas.paving(), rng.uniform(2.0, 6.0))
        if rng.random() < 0.2:
            canvas.awning(at, angle)
        if rng.random() < 0.3:
            canvas.car(at, angle + rng.choice((0.0, math.pi / 2.0)))
