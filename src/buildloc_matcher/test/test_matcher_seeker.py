"""The seeker over a scripted matcher: what it asks, when it lets go, and which fixes go out."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from buildloc_matcher.acceptance import Outcome
from buildloc_matcher.calibration import PROTECTED, measured
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.follow import Followed, Opinion
from buildloc_matcher.geometry import Similarity
from buildloc_matcher.matcher import Answer
from buildloc_matcher.pursuit import Agreement, Mode, Place
from buildloc_matcher.seeker import UNTRACKED, WAITING, Seeker
from buildloc_msgs_py.types import Fix, FloatArray, FrameObservation, Keyframe, LocalMap, NoFix, Tracked

SECOND = 10**9
SPREAD = np.diag([1.0, 1.0, 1e-4])
PATH = [Keyframe(i * SECOND, 30.0 * i, 0.0, 0.0) for i in range(1, 20)]
FRAME = np.zeros((4, 4))
NOTHING = np.empty(0, dtype=np.int64)


class Scripted:
    """Stands in for a Matcher: global searches find ``places`` in turn (None: nothing), the reference says
    ``outcomes`` in turn, always agreeing with the prediction up to ``offset_m``."""

    def __init__(self, **parameters: float) -> None:
        self.config = MatcherConfig(sigma_registration_m=0.5, **parameters)
        self.places: deque[tuple[float, float] | None] = deque()
        self.outcomes: deque[Outcome] = deque()
        self.searches = 0
        self.spread = SPREAD  # of a fix; its agreement has SPREAD

    def fix(self, local_map: LocalMap, keyframes: Sequence[Keyframe], _: object) -> Answer:
        self.searches += 1
        place, last = self.places.popleft(), keyframes[-1]
        if place is None:
            return Answer(NoFix(last.stamp_ns, "nothing found"), (), {})
        agreement = Agreement({last.stamp_ns: (*place, 0.0)}, SPREAD, 1.0)
        fix = self.fix_at(Place(last.stamp_ns, *place, 0.0, self.spread), math.nan)
        return Answer(fix, (), {}, agreement)

    def follow(
        self, predicted: Similarity, _: FloatArray, keyframes: Sequence[Keyframe], __: object, ___: int
    ) -> Followed:
        outcome, last = self.outcomes.popleft(), keyframes[-1]
        if outcome is not Outcome.ACCEPTED:
            return Followed(Opinion(outcome, f"said {outcome.value}", 0.0, 0.0), None)
        x, y = predicted.apply(np.array([[last.x_m, last.y_m]]))[0].tolist()
        agreement = Agreement({last.stamp_ns: (x, y, last.yaw_rad)}, SPREAD, predicted.scale)
        return Followed(Opinion(outcome, "", 30.0, 30.0), agreement)

    def fix_at(self, place: Place, altitude_m: float) -> Fix:
        spread = np.diag([*np.diag(place.covariance)[:2], 1.0])
        variance = float(place.covariance[2, 2])
        return Fix(
            place.stamp_ns, 0.0, 0.0, altitude_m, place.x_m, place.y_m, place.yaw_rad, spread, variance
        )


@pytest.fixture
def matcher() -> Scripted:
    return Scripted(check_keyframes=100, drift_share=0.02, max_coast_m=300.0)


@pytest.fixture
def seeker(matcher: Scripted) -> Seeker:
    return Seeker(matcher)  # type: ignore[arg-type]


def at_keyframe(seeker: Seeker, number: int, path: Sequence[Keyframe] = PATH) -> Fix | NoFix:
    """A map with keyframes 1 to ``number`` comes in."""
    keyframes = path[:number]
    local_map = LocalMap.whole(
        keyframes[-1].stamp_ns, NOTHING, np.empty((0, 2)), np.empty(0), np.empty((0, 4)), NOTHING
    )
    seeker.carry(keyframes)
    seen = [FrameObservation(keyframes[-1].stamp_ns, np.empty((0, 2)), 90.0)]
    return seeker.solve(local_map, keyframes, seen).result


def frame(keyframe: int, x: float, after_ns: int = 1) -> Tracked:
    return Tracked(keyframe * SECOND + after_ns, keyframe * SECOND, x, 0.0, 0.0, 91.0, FRAME)


def test_it_searches_until_it_finds_and_follows_from_then_on(matcher: Scripted, seeker: Seeker) -> None:
    assert seeker.reason == WAITING
    matcher.places += [None, (500.0, 700.0)]
    assert at_keyframe(seeker, 1) == NoFix(SECOND, "nothing found")
    assert seeker.locate(frame(1, 5.0)) == NoFix(SECOND + 1, "nothing found")
    found = at_keyframe(seeker, 2)
    assert isinstance(found, Fix) and (found.easting_m, found.northing_m) == (500.0, 700.0)
    assert seeker.pursuit.mode is Mode.TRACK and seeker.reason == UNTRACKED
    here = seeker.locate(frame(2, 5.0))
    assert isinstance(here, Fix) and (here.easting_m, here.northing_m) == pytest.approx((505.0, 700.0))
    assert (here.stamp_ns, here.altitude_m) == (2 * SECOND + 1, 91.0)
    matcher.outcomes.append(Outcome.ACCEPTED)
    followed = at_keyframe(seeker, 3)
    assert isinstance(followed, Fix) and (followed.easting_m, followed.altitude_m) == (530.0, 90.0)
    assert matcher.searches == 2 and seeker.withdrawals == 0


def test_undecided_coasts_with_a_growing_uncertainty_until_it_is_withdrawn(
    matcher: Scripted, seeker: Seeker
) -> None:
    matcher.places += [(500.0, 700.0), None]
    matcher.outcomes += [Outcome.UNDECIDED] * 20
    fixes = [at_keyframe(seeker, number) for number in range(1, 12)]
    assert all(isinstance(fix, Fix) for fix in fixes) and seeker.pursuit.mode is Mode.COAST
    grown = [fix.covariance_enu_m2[0, 0] for fix in fixes if isinstance(fix, Fix)]
    assert grown == sorted(grown) and grown[-1] == pytest.approx(1.0 + (0.02 * 300.0) ** 2)
    assert at_keyframe(seeker, 12) == NoFix(12 * SECOND, "nothing found")  # 330 m: acquires again
    assert seeker.withdrawals == 1 and matcher.searches == 2
    assert seeker.pursuit.withdrawn == "flew 330 m without an agreement with the reference"


def test_disagreement_withdraws_and_the_search_begins_again(matcher: Scripted, seeker: Seeker) -> None:
    matcher.places += [(500.0, 700.0), (800.0, 700.0)]
    matcher.outcomes.append(Outcome.REJECTED)
    at_keyframe(seeker, 1)
    assert at_keyframe(seeker, 2) == NoFix(2 * SECOND, "said rejected")
    assert seeker.pursuit.mode is Mode.ACQUIRE and seeker.withdrawals == 1
    assert seeker.reason == seeker.pursuit.withdrawn == "said rejected"
    assert seeker.locate(frame(2, 5.0)) == NoFix(2 * SECOND + 1, "said rejected")
    found = at_keyframe(seeker, 3)
    assert isinstance(found, Fix) and found.easting_m == 800.0


def test_now_and_then_the_global_search_has_to_confirm(matcher: Scripted) -> None:
    matcher.config = replace(matcher.config, check_keyframes=2)
    seeker = Seeker(matcher)  # type: ignore[arg-type]
    # Confirmed at keyframe 3, not found at 5, which says nothing, and elsewhere at 7.
    matcher.places += [(500.0, 700.0), (561.0, 700.0), None, (900.0, 700.0)]
    matcher.outcomes += [Outcome.ACCEPTED] * 5
    fixes = [at_keyframe(seeker, number) for number in range(1, 8)]
    assert all(isinstance(fix, Fix) for fix in fixes[:6]) and matcher.searches == 4
    assert isinstance(fixes[6], NoFix) and "another place, 220.0 m away" in fixes[6].reason
    assert seeker.pursuit.mode is Mode.ACQUIRE


@pytest.mark.parametrize(("sigma_m", "kept"), [(1.0, False), (10.0, True)])
def test_a_search_that_was_carried_on_contradicts_no_better_than_it_knows(sigma_m: float, kept: bool) -> None:
    """A fix may lie far beyond the agreement behind it: its own covariance counts, not the agreement's."""
    matcher = Scripted(check_keyframes=2)
    seeker = Seeker(matcher)  # type: ignore[arg-type]
    matcher.places += [(500.0, 700.0), (585.0, 700.0)]
    matcher.outcomes += [Outcome.ACCEPTED] * 2
    at_keyframe(seeker, 1)
    at_keyframe(seeker, 2)
    matcher.spread = np.diag([sigma_m**2, sigma_m**2, 1e-3])
    # At 561 m by what was followed; the search says 24 m on.
    assert isinstance(at_keyframe(seeker, 3), Fix) is kept


def test_another_submap_withdraws_before_its_map_is_solved(matcher: Scripted, seeker: Seeker) -> None:
    matcher.places += [(500.0, 700.0)]
    at_keyframe(seeker, 3)
    foreign = [Keyframe(30 * SECOND, 0.0, 0.0, 0.0), Keyframe(31 * SECOND, 30.0, 0.0, 0.0)]
    seeker.carry(foreign)
    assert seeker.pursuit.mode is Mode.ACQUIRE and seeker.withdrawals == 1
    assert seeker.locate(frame(31, 5.0)) == NoFix(
        31 * SECOND + 1, "the mapper began another map: tracking was lost"
    )


def test_a_frame_carried_too_far_withdraws(matcher: Scripted, seeker: Seeker) -> None:
    matcher.places += [(500.0, 700.0)]
    at_keyframe(seeker, 1)
    assert isinstance(seeker.locate(frame(1, 299.0)), Fix)
    assert isinstance(seeker.locate(frame(1, 301.0)), NoFix)
    assert seeker.pursuit.mode is Mode.ACQUIRE and seeker.withdrawals == 1


def test_a_fix_older_than_one_that_is_out_is_not_fresh(matcher: Scripted, seeker: Seeker) -> None:
    matcher.places += [(500.0, 700.0)]
    at_keyframe(seeker, 1)
    first, second = seeker.locate(frame(1, 1.0, 5)), seeker.locate(frame(1, 2.0, 9))
    assert isinstance(first, Fix) and isinstance(second, Fix)
    assert [seeker.fresh(fix) for fix in (second, first, second)] == [True, False, False]
    seeker.reset()
    assert seeker.fresh(first)


def test_the_protection_level_is_that_of_the_fix_that_is_out(matcher: Scripted, seeker: Seeker) -> None:
    assert math.isnan(seeker.figures()["protection_level_m"])  # type: ignore[arg-type]
    matcher.places += [(500.0, 700.0), None]
    matcher.outcomes.append(Outcome.REJECTED)
    found = at_keyframe(seeker, 2)
    assert isinstance(found, Fix) and seeker.fresh(found)
    assert seeker.figures()["protection_level_m"] == pytest.approx(measured().errors.radius(PROTECTED))
    at_keyframe(seeker, 3)
    assert seeker.withdrawals == 1 and math.isnan(seeker.figures()["protection_level_m"])  # type: ignore[arg-type]


def test_a_reset_forgets_the_flight_even_while_it_is_solved(matcher: Scripted, seeker: Seeker) -> None:
    matcher.places += [(500.0, 700.0), (500.0, 700.0)]
    at_keyframe(seeker, 1)
    seeker.reset()
    assert seeker.pursuit.mode is Mode.ACQUIRE and seeker.reason == WAITING
    solve = matcher.fix

    def interrupted(*arguments: object) -> Answer:
        seeker.reset()
        return solve(*arguments)  # type: ignore[arg-type]

    matcher.fix = interrupted  # type: ignore[method-assign]
    assert at_keyframe(seeker, 2) == NoFix(2 * SECOND, "the flight was forgotten meanwhile")
    assert seeker.pursuit.mode is Mode.ACQUIRE and seeker.reason == WAITING


def another_map(seeker: Seeker) -> None:
    """The mapper began a map that has nothing of the one before."""
    seeker.carry([Keyframe(30 * SECOND, 0.0, 0.0, 0.0), Keyframe(31 * SECOND, 30.0, 0.0, 0.0)])


@pytest.mark.parametrize("following", [False, True], ids=["acquiring", "following"])
def test_a_place_that_is_withdrawn_while_it_is_asked_about_gives_no_fix(following: bool) -> None:
    matcher = Scripted(check_keyframes=100)
    seeker = Seeker(matcher)
    matcher.places += [(500.0, 700.0)]
    if following:
        assert isinstance(at_keyframe(seeker, 2), Fix)
        matcher.outcomes += [Outcome.UNDECIDED]
    name = "follow" if following else "fix"
    asked = getattr(matcher, name)

    def interrupted(*arguments: Any) -> Any:
        another_map(seeker)
        return asked(*arguments)

    setattr(matcher, name, interrupted)
    result = at_keyframe(seeker, 3)
    assert isinstance(result, NoFix) and seeker.pursuit.mode is Mode.ACQUIRE
    assert result.reason == seeker.reason == seeker.pursuit.withdrawn != ""


def test_a_map_without_an_answer_lets_the_place_grow_old() -> None:
    matcher = Scripted(check_keyframes=100)
    seeker = Seeker(matcher)
    matcher.places += [(500.0, 700.0)]
    assert isinstance(at_keyframe(seeker, 2), Fix)
    seeker.failed("solving failed: MemoryError")
    assert seeker.pursuit.mode is Mode.COAST and seeker.reason == "solving failed: MemoryError"
