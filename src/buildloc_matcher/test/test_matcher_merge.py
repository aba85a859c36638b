"""What is drawn twice is kept once: by hand-drawn cases, and against every pair of random towns."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import shapely
from buildloc_matcher.reference import spool as spool_module
from buildloc_matcher.reference.merge import duplicates, overlapping, overlapping_ids, windows
from buildloc_matcher.reference.spool import ROW, Rows, Spool, squares
from buildloc_msgs_py.footprint import footprints
from numpy.typing import NDArray
from shapely import affinity
from shapely.geometry import Polygon, box

HOUSE = box(0, 0, 10, 10)


def shifted(dx: float, dy: float = 0.0) -> Polygon:
    return affinity.translate(HOUSE, dx, dy)


@pytest.mark.parametrize(
    ("first", "second", "dropped"),
    [
        (HOUSE, HOUSE, True),
        (HOUSE, shifted(5.0), True),  # exactly half
        (HOUSE, shifted(5.1), False),
        (HOUSE, shifted(10.0), False),  # side by side
        (HOUSE, box(2, 2, 4, 4), True),  # a shed inside: half of the smaller
        (box(2, 2, 4, 4), HOUSE, True),
        (HOUSE, box(9, 0, 110, 100), False),  # a tenth of the smaller
        (Polygon(box(-5, -5, 15, 15).exterior, [HOUSE.exterior]), HOUSE, False),  # in the courtyard
    ],
)
def test_two_sources(first: Polygon, second: Polygon, dropped: bool) -> None:
    found = overlapping(np.array([0, 1], np.uint16), np.array([first, second], dtype=object))
    assert found.tolist() == [False, dropped]
    # The order in memory is no rank; the source is.
    found = overlapping(np.array([1, 0], np.uint16), np.array([second, first], dtype=object))
    assert found.tolist() == [dropped, False]


def test_one_source_never_overlaps_itself() -> None:
    outlines = np.array([HOUSE, HOUSE, shifted(1.0)], dtype=object)
    assert not overlapping(np.zeros(3, np.uint16), outlines).any()
    assert overlapping(np.empty(0, np.uint16), np.empty(0, dtype=object)).shape == (0,)


def test_what_is_dropped_itself_still_replaces() -> None:
    # The second lies over the first, the third over the second alone.
    outlines = np.array([HOUSE, shifted(4.0), shifted(8.0)], dtype=object)
    assert overlapping(np.array([0, 1, 2], np.uint16), outlines).tolist() == [False, True, True]
    assert overlapping(np.array([0, 0, 1], np.uint16), outlines).tolist() == [False, False, True]


def rows_of(outlines: NDArray[np.object_], sources: NDArray[np.uint16]) -> Rows:
    found = footprints(outlines)
    rows = np.zeros(len(outlines), ROW)
    rows["x"], rows["y"] = found.centroids_m.T
    rows["area"], rows["shape"] = found.areas_m2, found.shapes
    rows["source"], rows["id"] = sources, np.arange(len(outlines))
    return rows


def town(seed: int, count: int = 400) -> tuple[NDArray[np.object_], NDArray[np.uint16]]:
    """Rectangles of three sources over 300 m, half of them redrawn a little off, ten drawn twice."""
    rng = np.random.default_rng(seed)
    outlines = [
        affinity.rotate(box(x, y, x + w, y + h), angle)
        for x, y, w, h, angle in np.column_stack(
            [rng.uniform(0, 300, (count, 2)), rng.uniform(4, 30, (count, 2)), rng.uniform(0, 90, count)]
        ).tolist()
    ]
    outlines += [affinity.translate(o, *rng.normal(0, 2, 2)) for o in outlines[: count // 2]]
    outlines += outlines[:10]
    sources = rng.integers(0, 3, len(outlines)).astype(np.uint16)
    sources[-10:] = sources[:10]
    return np.array(outlines, dtype=object), sources


def replaced_by_pairs(outlines: NDArray[np.object_], sources: NDArray[np.uint16]) -> set[int]:
    """The rule as it is stated, one pair after the other."""
    return {
        a
        for a in range(len(outlines))
        for b in range(len(outlines))
        if sources[b] < sources[a]
        and outlines[a].intersection(outlines[b]).area >= 0.5 * min(outlines[a].area, outlines[b].area)
    }


@pytest.mark.parametrize("seed", [1, 2])
def test_cells_miss_no_pair(tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spool_module, "CELL_M", 25.0)  # smaller than a building, so that many lie across
    outlines, sources = town(seed)
    spool = Spool(tmp_path, 1000.0, True)
    rows = rows_of(outlines, sources)
    for batch in np.array_split(np.random.default_rng(seed).permutation(len(rows)), 7):
        spool.add(rows[batch], outlines[batch])
    assert set(overlapping_ids(spool).tolist()) == replaced_by_pairs(outlines, sources)


@pytest.mark.parametrize("margin_m", [0.0, 60.0])
def test_tiles_and_order_change_nothing(tmp_path: Path, margin_m: float) -> None:
    outlines, sources = town(3)
    rows = rows_of(outlines, sources)
    found = []
    for run, (tile_m, margin) in enumerate(((10_000.0, 500.0), (35.0, margin_m))):
        folder = tmp_path / str(run)
        folder.mkdir()
        spool = Spool(folder, tile_m, True)
        order = np.random.default_rng(run).permutation(len(rows))
        renumbered = rows[order].copy()
        renumbered["id"] = np.arange(len(rows))
        spool.add(renumbered, outlines[order])
        counts: Counter[str] = Counter()
        boxes = [spool.box_m(tile) for tile in spool.tiles()]
        parts = list(windows(spool, overlapping_ids(spool), boxes, margin, counts))
        found.append((boxes, parts, counts))
    (_, [whole], counts), (boxes, parts, same_counts) = found
    assert counts == same_counts and counts["duplicate"] > 0 and counts["overlapping"] > 0
    x, y = whole.centroids_m.T
    for (west, south, east, north), part in zip(boxes, parts, strict=True):
        near = (
            (x >= west - margin_m) & (x < east + margin_m) & (y >= south - margin_m) & (y < north + margin_m)
        )
        np.testing.assert_array_equal(part.centroids_m, whole.centroids_m[near])
        np.testing.assert_array_equal(part.shapes, whole.shapes[near])


def test_doubles_within_a_centimetre() -> None:
    rows = np.zeros(6, ROW)
    rows["x"] = [0.0, 0.005, 0.0, 0.02, 5.0, 5.0]
    rows["area"] = [50.0, 60.0, 50.0, 50.0, 70.0, 70.0]
    rows["source"] = [0, 0, 1, 0, 0, 0]
    rows["id"] = np.arange(6)
    # The largest of the first three of source 0 stays; 0.02 is 1.5 cm from it; of two alike one stays.
    assert duplicates(rows).tolist() == [True, False, False, False, False, True]
    assert duplicates(rows[:0]).shape == (0,)


def test_squares_are_exact_at_their_borders() -> None:
    size = 20_000.0 / 3.0
    borders = np.arange(-50, 50) * size
    assert (squares(borders, size) == np.arange(-50, 50)).all()
    assert (squares(np.nextafter(borders, -np.inf), size) == np.arange(-51, 49)).all()


def test_outlines_come_back_as_they_were(tmp_path: Path) -> None:
    outlines, sources = town(4, 20)
    spool = Spool(tmp_path, 1000.0, True)
    rows = rows_of(outlines, sources)
    spool.add(rows[:5], outlines[:5])
    spool.add(rows[5:], outlines[5:])
    found: dict[int, Polygon] = {}
    for cell in spool.cells():
        of_source, ids, shapes = spool.outlines(cell)
        found |= dict(zip(ids.tolist(), shapes, strict=True))
        assert (of_source == sources[ids]).all()
    assert len(found) == len(outlines)
    assert all(shapely.equals(found[row], outline) for row, outline in enumerate(outlines))
