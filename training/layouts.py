"""How towns are laid out: streets of plots, blocks of touching houses, houses anywhere; and decoys for real
pictures. Nothing is laid out after any real place."""

from __future__ import annotations

import math

import numpy as np
from rendered import GROUNDS, HEDGE, Canvas, Image, Labels, Wing, annexes, axes, building, rectangle


def block(canvas: Canvas, angle: float) -> list[Wing]:
    """A block of a dense town: two rows of houses that touch, back to back. Centre, length, width, angle."""
    rng = canvas.rng
    along, across = axes(angle)
    corner, depth, plans = canvas.place(), canvas.px(6.0, 14.0), []
    for side in (-1.0, 1.0):
        front = -canvas.px(0.0, 4.0)
        for _ in range(rng.integers(3, 9)):
            length, width = canvas.px(4.0, 11.0), depth * rng.uniform(0.7, 1.0)
            centre = corner + along * (front + length / 2.0) + across * side * width / 2.0
            plans.append((centre, length, width, angle))
            front += length
    return plans


def street(canvas: Canvas, angle: float) -> list[Wing]:
    """A street of detached houses, each on a plot with a garden, a drive, and often a garage and a shed."""
    rng = canvas.rng
    along, across = axes(angle)
    middle, plans = canvas.place(), list[Wing]()
    canvas.road(middle, angle)
    setback = canvas.px(5.0, 12.0)
    house = (canvas.px(9.0, 15.0), canvas.px(7.0, 10.0))  # a street's houses are alike
    gable_on = rng.random() < 0.3
    for side in (-1.0, 1.0):
        front = -0.7 * canvas.side + canvas.px(0.0, 10.0)
        while front < 0.7 * canvas.side:
            width, depth = canvas.px(15.0, 32.0), canvas.px(22.0, 40.0)
            plot = middle + along * (front + width / 2.0) + across * side * (setback + depth / 2.0)
            front += width
            if not (-0.2 * canvas.side < plot.min() and plot.max() < 1.2 * canvas.side):
                continue
            if rng.random() < 0.6:
                ground = GROUNDS[rng.integers(len(GROUNDS))] * rng.uniform(0.8, 1.2)
                canvas.paint(rectangle(plot, width, depth, angle), ground, 8.0)
            if rng.random() < 0.6:
                fence = plot + along * width / 2.0
                line = rectangle(fence, canvas.px(0.2, 1.4), depth, angle)
                canvas.wall(line, canvas.px(0.6, 1.8), HEDGE * np.float32(rng.uniform(0.6, 1.6)))
            home = plot - across * side * depth * rng.uniform(0.0, 0.25)
            size = tuple(length * rng.uniform(0.85, 1.15) for length in house)
            own = angle + (math.pi / 2.0 if gable_on else 0.0) + rng.normal(0.0, 0.03)
            plans.append((home, *size, own))
            hand = along * float(rng.choice((-1.0, 1.0)))
            drive = home + hand * canvas.px(6.0, 9.0) - across * side * canvas.px(4.0, 9.0)
            paved = rectangle(drive, canvas.px(2.5, 6.0), canvas.px(8.0, 18.0), angle)
            canvas.paint(paved, canvas.paving(), 4.0)
            if rng.random() < 0.5:
                canvas.car(drive, angle + math.pi / 2.0)
            if rng.random() < 0.5:
                garage = home + hand * canvas.px(7.0, 11.0) + across * side * canvas.px(-3.0, 5.0)
                plans.append((garage, canvas.px(5.0, 8.0), canvas.px(3.2, 6.5), own))
            garden = plot + across * side * depth * 0.3
            if rng.random() < 0.5:
                shed = garden + along * rng.uniform(-0.4, 0.4) * width
                plans.append((shed, canvas.px(2.8, 5.0), canvas.px(2.2, 4.0), own))
            things = (canvas.terrace, canvas.enclosure, canvas.awning, canvas.pool, canvas.hedge, canvas.yard)
            for _ in range(rng.integers(0, 3)):
                spot = garden + along * rng.uniform(-0.4, 0.4) * width
                things[rng.integers(len(things))](spot, own)
    return plans


def render(side_px: int, gsd_m: float, rng: np.random.Generator) -> tuple[Image, Labels]:
    """A square of a town nobody knows: RGB (side, side, 3) 0-255 and labels (side, side)."""
    canvas = Canvas(side_px, gsd_m, rng)
    angle = rng.uniform(0.0, math.pi)
    for _ in range(rng.integers(0, 4)):
        canvas.paint(
            rectangle(canvas.place(), canvas.px(8, 40), canvas.px(8, 40), angle),
            GROUNDS[rng.integers(len(GROUNDS))] * rng.uniform(0.8, 1.2), 8.0,
        )  # fmt: skip
    for _ in range(rng.integers(0, 3)):
        canvas.road(canvas.place(), angle + rng.choice((0.0, math.pi / 2.0)) + rng.normal(0.0, 0.1))
    for _ in range(rng.integers(0, 3)):
        canvas.car_park(canvas.place(), angle)
    dense = rng.random() < 0.35
    count, number = int(rng.integers(4, 26) if dense else rng.integers(0, 9)), 0
    plans = street(canvas, angle) if not dense and rng.random() < 0.45 else []
    while len(plans) < count:
        length, width = canvas.px(5.0, 18.0), canvas.px(4.0, 11.0)
        if rng.random() < 0.1:
            length, width = canvas.px(18.0, 45.0), canvas.px(9.0, 22.0)
        at, own = canvas.place(), angle + rng.choice((0.0, math.pi / 2.0)) + rng.normal(0.0, 0.12)
        row = int(rng.integers(2, 6)) if rng.random() < (0.7 if dense else 0.1) else 1  # a terrace of houses
        step = axes(own)[0] * length
        plans += [(at + step * k, length, width * rng.uniform(0.85, 1.15), own) for k in range(row)]
    for plan in plans:
        annexes(canvas, *plan)
    for _ in range(rng.integers(1, 6) if dense else 0):
        plans += block(canvas, angle + rng.choice((0.0, math.pi / 2.0)) + rng.normal(0.0, 0.05))
    for thing, most in ((canvas.pool, 3), (canvas.hedge, 6), (canvas.terrace, 3), (canvas.enclosure, 3)):
        for _ in range(rng.integers(0, most)):
            thing(canvas.place(), angle + rng.choice((0.0, math.pi / 2.0)))
    for plan in plans:
        number += building(canvas, number + 1, *plan)
    for _ in range(int(rng.exponential(6.0))):
        canvas.tree(canvas.place(), canvas.px(1.0, 5.0))
    if rng.random() < 0.2:  # a wood
        edge = canvas.place()
        for _ in range(40):
            canvas.tree(edge + rng.normal(0.0, 0.18 * side_px, 2), canvas.px(1.5, 4.0))
    return np.clip(canvas.rgb, 0.0, 255.0).astype(np.float32), canvas.labels


def decoys(rgb: Image, labels: Labels, gsd_m: float, rng: np.random.Generator) -> Image:
    """A real picture with pavings, car parks and cars drawn on its ground: none of them is a building."""
    canvas = Canvas(len(rgb), gsd_m, rng)
    canvas.rgb, canvas.labels = rgb.copy(), labels
    canvas.roof_px[labels > 0] = np.inf  # how high they are is not known: nothing shades them
    angle = rng.uniform(0.0, math.pi)
    for _ in range(rng.integers(1, 5)):
        drawers = (
            canvas.yard, canvas.car_park, canvas.pool, canvas.terrace, canvas.hedge, canvas.enclosure,
            canvas.awning,
        )  # fmt: skip
        drawers[rng.integers(len(drawers))](canvas.place(), angle)
    for _ in range(rng.integers(0, 4)):
        canvas.car(canvas.place(), angle)
    return canvas.rgb
