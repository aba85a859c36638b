"""The four nodes over DDS: with bad input they stay up, publish NO_FIX and say why in /diagnostics."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

import rclpy
from buildloc.bag import read_frames
from buildloc.settings import MAPPER, MATCHER, NODES, REFERENCE_DB, SEGMENTER
from buildloc_mapper.mapper_node import MapperNode
from buildloc_matcher.matcher_node import MatcherNode
from buildloc_matcher.reference_db_node import ReferenceDbNode
from buildloc_msgs_py import encode, topics
from buildloc_msgs_py.types import Frame
from buildloc_msgs_py.wire import stamp_ns
from buildloc_segmenter.segmenter_node import SegmenterNode
from diagnostic_msgs.msg import DiagnosticStatus
from drone import CAMERA, SECOND, Drone, domain_id
from nav_msgs.srv import LoadMap
from rclpy.context import Context
from rclpy.parameter import Parameter
from reference_files import BAD_DATABASES, bad_database, build_database, houses
from sensor_msgs.msg import Image, NavSatFix, NavSatStatus
from std_srvs.srv import Trigger

pytestmark = pytest.mark.dds
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
SAMPLE = Path(__file__).parents[1] / "bags" / "sample"
INPUT_SUBSCRIBERS = 2  # the segmenter and the mapper hear every input


class Graph(Drone):
    """The nodes, and the drone that flies them."""

    def __init__(self, context: Context, database: str) -> None:
        parameters = [Parameter("database", value=database)]
        self.reference = ReferenceDbNode(context=context, parameter_overrides=parameters)
        self.segmenter, self.mapper = SegmenterNode(context=context), MapperNode(context=context)
        self.matcher = MatcherNode(context=context)
        self.nodes = (self.reference, self.segmenter, self.mapper, self.matcher)
        super().__init__(context, *self.nodes)
        self.until(lambda: self.connected(INPUT_SUBSCRIBERS) and self.states.keys() >= set(NODES))

    def no_fix(self, count: int = 2) -> None:
        """Wait for further messages on /buildloc/fix: all without a position, and every node speaks."""
        self.fixes.clear()
        self.statuses.clear()
        self.until(lambda: len(self.fixes) >= count and self.states.keys() >= set(NODES))
        assert all(has_no_position(fix) for fix in self.fixes)

    def load(self, database: Path) -> int:
        """The result code of /buildloc/reference/load."""
        return int(self.call(LoadMap, topics.REFERENCE_LOAD, LoadMap.Request(map_url=str(database))).result)

    def uses(self, database: Path) -> bool:
        """Whether the matcher's latest word is that it uses a database."""
        state = self.states[MATCHER]
        figures = {value.key: value.value for value in state.values}
        return state.level == OK and figures.get("database") == str(database)


def has_no_position(fix: NavSatFix) -> bool:
    return fix.status.status == NavSatStatus.STATUS_NO_FIX and bool(
        np.isnan([fix.latitude, fix.longitude, fix.altitude]).all()
    )


@contextmanager
def running(database: Path | None) -> Iterator[Graph]:
    context = Context()
    rclpy.init(context=context, domain_id=domain_id())
    graph = Graph(context, "" if database is None else str(database))
    try:
        yield graph
    finally:
        for node in (*graph.nodes, graph):
            node.destroy_node()
        rclpy.try_shutdown(context=context)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("reference")
    build_database(made / "good.bldb", houses(made / "houses.geojson"))
    return made


@pytest.fixture
def graph(folder: Path) -> Iterator[Graph]:
    """The nodes with a good database."""
    with running(folder / "good.bldb") as made:
        made.until(lambda: made.uses(folder / "good.bldb"))
        yield made


def test_without_a_database_there_is_no_fix_and_one_can_be_loaded(folder: Path) -> None:
    with running(None) as graph:
        graph.no_fix()
        hint = "no reference database: call /buildloc/reference/load"
        assert graph.said(REFERENCE_DB, WARN, hint) and graph.said(MATCHER, ERROR, f"no fix: {hint}")
        assert graph.load(folder / "good.bldb") == LoadMap.Response.RESULT_SUCCESS
        graph.until(lambda: graph.uses(folder / "good.bldb"))
        graph.no_fix()


def test_a_database_that_is_refused_at_the_start_is_said(folder: Path) -> None:
    with running(folder / "absent.bldb") as graph:
        graph.no_fix()
        assert graph.said(REFERENCE_DB, ERROR, "no such reference database")
        assert graph.said(MATCHER, ERROR, "no fix: no reference database")


def test_bad_databases_are_refused_and_the_good_one_stays_in_use(
    graph: Graph, folder: Path, tmp_path: Path
) -> None:
    used = graph.matcher.session.seeker
    for number, (kind, text) in enumerate(BAD_DATABASES.items()):
        bad = bad_database(kind, tmp_path / f"{number}.bldb", folder / "houses.geojson")
        codes = LoadMap.Response
        expected = codes.RESULT_MAP_DOES_NOT_EXIST if kind == "missing" else codes.RESULT_INVALID_MAP_DATA
        assert graph.load(bad) == expected, kind
        graph.until(lambda text=text: graph.said(REFERENCE_DB, ERROR, text))
        graph.no_fix(count=1)
        assert graph.uses(folder / "good.bldb") and graph.matcher.session.seeker is used
    assert graph.load(folder / "good.bldb") == LoadMap.Response.RESULT_SUCCESS
    graph.until(lambda: graph.states[REFERENCE_DB].level == OK)


def test_a_database_that_was_built_again_is_read_again(graph: Graph, folder: Path, tmp_path: Path) -> None:
    def buildings() -> int:
        seeker = graph.matcher.session.seeker
        return 0 if seeker is None else len(seeker.matcher.database)

    path = build_database(tmp_path / "city.bldb", folder / "houses.geojson")
    assert graph.load(path) == LoadMap.Response.RESULT_SUCCESS
    graph.until(lambda: graph.uses(path) and buildings() == 25)
    build_database(path, houses(tmp_path / "more.geojson", rows=6))
    assert graph.load(path) == LoadMap.Response.RESULT_SUCCESS
    graph.until(lambda: buildings() == 36)


def raw(encoding: str) -> Callable[[int], Image]:
    def image(stamp: int) -> Image:
        message = encode.encode_image(np.zeros((64, 96, 3), dtype=np.uint8), stamp, "camera")
        message.encoding = encoding
        return message

    return image


BAD_INPUTS: dict[str, tuple[dict[str, Any], str]] = {
    "NaN altitude": ({"altitude_m": math.nan}, "altitude nan m is not a positive number"),
    "negative altitude": ({"altitude_m": -10.0}, "altitude -10.0 m is not a positive number"),
    "no gimbal": ({"attitude": None}, "no gimbal/attitude received"),
    "encoding": ({"image": raw("bayer_rggb8")}, "'bayer_rggb8' is not supported"),
    "size": ({"camera": dataclasses.replace(CAMERA, width=97)}, "camera_info says 97x64"),
}


@pytest.mark.parametrize("kind", BAD_INPUTS)
def test_bad_input_gives_no_fix_and_a_reason_and_the_next_good_frame_is_used(graph: Graph, kind: str) -> None:
    options, text = BAD_INPUTS[kind]
    make = options.get("image", lambda stamp: None)
    for second in (1, 2, 3):
        graph.send(second * SECOND, **{**options, "image": make(second * SECOND)})
    for node in (SEGMENTER, MAPPER):
        graph.until(lambda node=node: graph.said(node, WARN, text, frames_unusable=3))
    graph.no_fix()
    if kind == "no gimbal":
        assert graph.said(MATCHER, OK, "no fix: no gimbal/attitude received")
    assert not graph.masks
    graph.send(10 * SECOND)
    graph.until(lambda: [stamp_ns(mask) for mask in graph.masks] == [10 * SECOND])
    graph.until(lambda: graph.said(MAPPER, OK, "mapping", maps=1))


@pytest.fixture(scope="module")
def keyframes() -> list[Frame]:
    """The sample's first images that are keyframes: one every 5 s."""
    frames = [f for f in itertools.islice(read_frames(SAMPLE), 0, 21, 5) if isinstance(f, Frame)]
    assert len(frames) == 5
    return frames


def fly(graph: Graph, frame: Frame, later_ns: int = 0) -> list[int]:
    """Send a keyframe; the stamps in /buildloc/keyframes once it is there."""
    stamp = frame.stamp_ns + later_ns
    image = encode.encode_image(frame.image_bgr, stamp, "camera")
    graph.send(stamp, image, frame.camera, frame.altitude_m, frame.attitude_xyzw)

    def stamps() -> list[int]:
        return [stamp_ns(pose) - later_ns for pose in graph.paths[-1].poses] if graph.paths else []

    graph.until(lambda: frame.stamp_ns in stamps())
    return stamps()


@pytest.mark.parametrize("later_s", [0, -3600], ids=["flight goes on", "flight of an hour before"])
def test_reset_forgets_the_flight_and_keeps_the_reference(
    graph: Graph, folder: Path, keyframes: list[Frame], later_s: int
) -> None:
    stamps = [frame.stamp_ns for frame in keyframes]
    assert [fly(graph, frame) for frame in keyframes[:2]] == [stamps[:1], stamps[:2]]
    response = graph.call(Trigger, topics.RESET, Trigger.Request())
    assert response.success and response.message
    # As a flight that begins: its first image is a keyframe however soon it comes, and no telemetry is old.
    again = dataclasses.replace(keyframes[2], stamp_ns=stamps[1] + SECOND)
    graph.until(lambda: graph.said(SEGMENTER, OK, "flight forgotten"))
    assert fly(graph, again, later_s * SECOND) == [again.stamp_ns]
    assert fly(graph, keyframes[3], later_s * SECOND) == [again.stamp_ns, stamps[3]]
    graph.until(lambda: graph.said(MATCHER, OK, maps_answered=4))
    assert not any(status.level == WARN for status in graph.statuses)
    graph.no_fix()
    assert graph.uses(folder / "good.bldb")
