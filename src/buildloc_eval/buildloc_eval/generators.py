"""Other ways to find candidate stars, to compare with: nearest neighbours in a vector index."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import faiss
import numpy as np
from buildloc_matcher.config import matcher_config
from buildloc_matcher.match_cache import MakeStarMatcher
from buildloc_matcher.matcher import Matcher
from buildloc_matcher.matching import Matches, QueryStars, query_stars
from buildloc_matcher.reference.database import ReferenceDatabase
from numpy.typing import NDArray

Encode = Callable[[NDArray[np.float32]], NDArray[np.float32]]
PROBES = 32  # lists searched: more cost more and find little more
CELLS_PER_ROOT = 4.0


def full_vector(stars: NDArray[np.float32]) -> NDArray[np.float32]:
    """(S, 32) of stars (S, 4, 8): sorted angles, log perimeter and four shape metrics of four triangles."""
    largest = np.float32(math.pi) - stars[:, :, :1] - stars[:, :, 1:2]
    parts = [stars[:, :, :2], largest, np.log(stars[:, :, 3:4]), stars[:, :, 4:]]
    return np.concatenate(parts, axis=2).reshape(len(stars), -1)


def shapeless_vector(stars: NDArray[np.float32]) -> NDArray[np.float32]:
    """(S, 8) of stars (S, 4, 8), after Li et al.: area and squared perimeter of four triangles; logarithms,
    so that a difference is a ratio."""
    sines = np.sin(np.stack([stars[:, :, 0], stars[:, :, 1], stars[:, :, 0] + stars[:, :, 1]], axis=2))
    diameter = stars[:, :, 3] / sines.sum(axis=2)  # of the circumscribed circle: a side is that times a sine
    area = 0.5 * diameter**2 * sines.prod(axis=2)
    vector = np.stack([np.log(np.maximum(area, 1e-3)), 2.0 * np.log(stars[:, :, 3])], axis=2)
    return np.asarray(vector.reshape(len(stars), -1), dtype=np.float32)


class VectorIndex:
    """Reference stars in a standardised vector space (inverted lists, Faiss)."""

    def __init__(self, encode: Encode, stars: NDArray[np.float32]) -> None:
        self._encode = encode
        vectors = encode(stars)
        self._mean, self._std = vectors.mean(axis=0), vectors.std(axis=0)
        vectors = self._standard(vectors)
        self._quantizer = faiss.IndexFlatL2(vectors.shape[1])
        lists = max(1, int(CELLS_PER_ROOT * math.sqrt(len(vectors))))
        self._index = faiss.IndexIVFFlat(self._quantizer, vectors.shape[1], lists)
        self._index.train(vectors)
        self._index.add(vectors)
        self._index.nprobe = PROBES

    def _standard(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.ascontiguousarray((vectors - self._mean) / self._std, dtype=np.float32)

    def search(self, stars: NDArray[np.float32], kept: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """The nearest reference stars (S, K) and the square of their distance, per dimension."""
        squared, rows = self._index.search(self._standard(self._encode(stars)), kept)
        return rows.astype(np.int64), np.asarray(squared / self._mean.size, dtype=np.float32)


@dataclass
class NearestStars:
    """Candidates are the nearest stars of an index; a score falls from 1 with the distance."""

    index: VectorIndex
    kept: int
    matched_anew: int = 0

    def match(self, stars: QueryStars) -> Matches:
        """The nearest reference stars of every star."""
        self.matched_anew = len(stars)
        rows, squared = self.index.search(stars.features, self.kept)
        score = np.where(rows >= 0, np.exp(-0.5 * squared), 0.0).astype(np.float32)
        return Matches(rows, score, rows.size, rows.size)


def nearest_stars(encode: Encode, database: ReferenceDatabase) -> MakeStarMatcher:
    """A candidate generator over one index of the stars of a database."""
    index = VectorIndex(encode, reference_stars(database).features)
    return lambda _, config: NearestStars(index, config.matches_per_star)


def reference_stars(database: ReferenceDatabase) -> QueryStars:
    """All stars of a database, in the order of their numbers."""
    parts = [query_stars(tile.triangles, tile.buildings.areas_m2) for tile in database.tiles]
    features, areas = [part.features for part in parts], [part.areas_m2 for part in parts]
    return QueryStars(np.concatenate(features), np.concatenate(areas))


def method(name: str, database: ReferenceDatabase) -> Matcher:
    """A matcher by the name of its preset or of its candidate generator."""
    paper, default = matcher_config({"preset": "paper"}), matcher_config()
    if name == "index 32-D":
        return Matcher(database, default, nearest_stars(full_vector, database))
    if name == "shape-free 8-D":
        return Matcher(database, paper, nearest_stars(shapeless_vector, database))
    return Matcher(database, paper if name == "paper" else default)
