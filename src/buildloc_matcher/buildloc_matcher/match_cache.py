"""Matches of stars that have not changed since the last map (Sec. "Candidate Generation")."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.matching import Matches, QueryStars, StarTable, match_stars


class StarMatcher(Protocol):
    """Finds reference stars for those of a map; ``matched_anew`` counts the stars of the last call that were
    not remembered."""

    matched_anew: int

    def match(self, stars: QueryStars) -> Matches:
        """The best reference stars of every star."""


MakeStarMatcher = Callable[[Sequence[StarTable], MatcherConfig], StarMatcher]


class MatchCache:
    """Matches stars against fixed tables, those of the last call from memory.

    What a star matches depends on its numbers alone, so the answer is that of a full match.
    """

    def __init__(self, tables: Sequence[StarTable], config: MatcherConfig) -> None:
        self.matched_anew = 0
        self._tables, self._config = tables, config
        self._rows: dict[bytes, int] = {}
        self._last: Matches | None = None

    def match(self, stars: QueryStars) -> Matches:
        """As :func:`match_stars`; ``tested`` and ``passed`` count the new stars' pairs."""
        keys = [f.tobytes() + a.tobytes() for f, a in zip(stars.features, stars.areas_m2, strict=True)]
        known = np.array([self._rows.get(key, -1) for key in keys], dtype=np.int64)
        new = np.flatnonzero(known < 0)
        found = match_stars(stars.select(new), self._tables, self._config)
        self.matched_anew = len(new)
        reference = np.empty((len(stars), self._config.matches_per_star), dtype=np.int64)
        score = np.empty(reference.shape, dtype=np.float32)
        reference[new], score[new] = found.reference, found.score
        if self._last is not None:
            old = known >= 0
            reference[old], score[old] = self._last.reference[known[old]], self._last.score[known[old]]
        self._last = Matches(reference, score, found.tested, found.passed)
        self._rows = {key: row for row, key in enumerate(keys)}
        return self._last
