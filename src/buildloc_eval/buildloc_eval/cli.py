"""What this package adds to the command line: sim, eval and demo."""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import sys
from pathlib import Path
from typing import Literal

from buildloc.settings import REFERENCE_DB, SEGMENTER, config_of, load
from buildloc_msgs_py.config import from_mapping
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import Fix
from buildloc_segmenter.config import SegmenterConfig

from buildloc_eval.flight import FlightConfig, fly
from buildloc_eval.sim import SimError, remove_bag, write_flight
from buildloc_eval.town import write_town
from buildloc_eval.world import OrthoWorld, TownWorld, World

TOWN_CENTRE_DEG = (47.62, 8.15)
DEMO_RATE = 4.0


def _region(text: str) -> tuple[float, float, float, float]:
    try:
        west, south, east, north = (float(v) for v in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not WEST,SOUTH,EAST,NORTH") from None
    if not (0.0 <= west < east <= 1.0 and 0.0 <= south < north <= 1.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not WEST,SOUTH,EAST,NORTH in fractions of the world")
    return west, south, east, north


def _extent(text: str) -> float:
    try:
        extent = float(text)
    except ValueError:
        extent = math.nan
    if not 300.0 <= extent <= 20_000.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a length of 300 to 20000 m")
    return extent


def _level(text: str) -> int | Literal["measured"]:
    if text == "measured":
        return "measured"
    if not (text.isdecimal() and 1 <= int(text) <= 8):
        raise argparse.ArgumentTypeError(f"{text!r} is neither a whole number from 1 to 8 nor measured")
    return int(text)


def _count(text: str) -> int:
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above zero")
    return int(text)


def _progress(done: int, total: int) -> None:
    if sys.stderr.isatty():
        print(f"\r{done}/{total} images", end="\n" if done == total else "", file=sys.stderr, flush=True)


def add_sim_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `buildloc sim`; every field of FlightConfig is one."""
    parser.add_argument("-o", "--out", type=Path, required=True, help="bag folder to write")
    world = parser.add_mutually_exclusive_group(required=True)
    world.add_argument("--ortho", type=Path, help="orthophoto to cut the flight out of (with --georef)")
    world.add_argument("--world", type=Path, help="GeoJSON of footprints to render the flight over")
    world.add_argument("--town", type=Path, help="invent a suburb, write its footprints here and render it")
    parser.add_argument("--force", action="store_true", help="replace the bag of an earlier run")
    parser.add_argument(
        "--georef", type=Path, help="JSON with origin_lat_deg, origin_lon_deg (top left), gsd_m"
    )
    parser.add_argument("--extent-m", type=_extent, default=3200.0, help="side of the invented suburb, m")
    parser.add_argument(
        "--region", type=_region, default=(0.0, 0.0, 1.0, 1.0), help="W,S,E,N fractions to fly in"
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of everything random")
    for field in dataclasses.fields(FlightConfig):
        low, high = field.metadata["low"], field.metadata["high"]
        parser.add_argument(
            f"--{field.name.replace('_', '-')}", type=type(field.default), default=field.default,
            help=f"{field.metadata['doc']} [{low:g}, {high:g}] (default %(default)s)",
        )  # fmt: skip


def _world(args: argparse.Namespace) -> World:
    if args.ortho is not None:
        if args.georef is None:
            raise BuildlocError("--ortho needs --georef; give the JSON that places the orthophoto")
        return OrthoWorld(args.ortho, args.georef)
    if args.town is not None:
        print(f"inventing a suburb of {args.extent_m:g} m: {args.town}", file=sys.stderr)
        write_town(args.town, args.seed, args.extent_m, TOWN_CENTRE_DEG)
    return TownWorld(args.town or args.world, args.seed)


def run_sim(args: argparse.Namespace) -> int:
    """`buildloc sim`; raises BuildlocError for what cannot be flown or written."""
    names = [field.name for field in dataclasses.fields(FlightConfig)]
    config = from_mapping(FlightConfig, {name: getattr(args, name) for name in names})
    if args.out.exists() and not args.force:
        raise SimError(f"{args.out}: exists; choose another --out or give --force")
    world = _world(args)
    west, south, east, north = world.bounds_m
    w, s, e, n = args.region
    box = (
        west + w * (east - west), south + s * (north - south),
        west + e * (east - west), south + n * (north - south),
    )  # fmt: skip
    trajectory = fly(box, config, args.seed)
    remove_bag(args.out)
    images = write_flight(args.out, world, trajectory, config, args.seed, _progress)
    size = sum(file.stat().st_size for file in args.out.iterdir()) / 1e6
    print(f"{args.out}: {images} images, {size:.1f} MB, EPSG:{world.epsg}, seed {args.seed}")
    return 0


def add_demo_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `buildloc demo`."""
    parser.add_argument("--bag", type=Path, default=Path("bags/sample"), help="bag with ground truth")
    parser.add_argument("--footprints", type=Path, default=Path("bags/sample_footprints.geojson"))
    parser.add_argument("--rate", type=float, default=DEMO_RATE, help="speed relative to the recording")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/demo"), help="folder for what is made")


def run_demo(args: argparse.Namespace) -> int:
    """Database, nodes, replay, fixes with their errors, one picture; 1 when nothing was accepted."""
    from buildloc.supervisor import dds_environment

    os.environ.update(dds_environment())
    from buildloc_matcher.config import MatcherConfig
    from buildloc_matcher.reference.build import build
    from buildloc_matcher.reference.database import open_database

    from buildloc_eval.flights import evaluate_live

    args.out.mkdir(parents=True, exist_ok=True)
    database = args.out / "reference.bldb"
    build([args.footprints], database, MatcherConfig())
    built = open_database(database, MatcherConfig())
    print(f"reference: {len(built)} buildings of {args.footprints} -> {database}")
    settings = load()
    settings[REFERENCE_DB]["database"] = str(database.resolve())
    rate = f"{args.rate:g}x"
    print(f"replaying {args.bag} at {rate} through the nodes (rendered imagery, not real)", flush=True)
    live = evaluate_live(args.bag, built, settings, args.rate, args.out, f"{args.bag} (rendered imagery)")
    print(live.table)
    print(live.summary)
    print(f"picture: {live.picture}")
    return 0 if any(isinstance(result, Fix) for result in live.results) else 1


def add_eval_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `buildloc eval`."""
    parser.add_argument(
        "name",
        choices=["barnarp", "beyond", "integrity", "mapping", "paper", "scale", "segmentation"],
        help="which evaluation",
    )
    parser.add_argument(
        "-o", "--out", type=Path, required=True, help="folder for report.json and report.html"
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of everything random")
    parser.add_argument("--quick", action="store_true", help="a part of it, in less than five minutes")
    parser.add_argument_group("eval scale").add_argument(
        "--levels", nargs="+", type=_level, metavar="LEVEL",
        help="levels of the maps' errors: numbers, or `measured` on the segmenter (default: 1 2 3)",
    )  # fmt: skip
    paper = parser.add_argument_group("eval paper")
    paper.add_argument(
        "--parts",
        nargs="+",
        choices=["boston", "tokyo", "real"],
        help="parts to run and report (default: all)",
    )
    paper.add_argument(
        "--model", action="append", default=[], metavar="PLACE=MODEL", dest="models",
        help="ONNX network for real imagery of a place that it never saw; repeatable (default: shipped one)",
    )  # fmt: skip
    paper.add_argument(
        "--netvlad", type=Path, metavar="FOLDER",
        help="networks of the baseline NetVLAD, from training/netvlad.py (default: it is left out)",
    )  # fmt: skip
    group = parser.add_argument_group("eval integrity")
    group.add_argument(
        "--plan", choices=["test", "calibration"],
        help="ground and seeds: the test's (default), or those of the calibration",
    )  # fmt: skip
    group.add_argument("--trials", type=_count, metavar="N", help="how many (default: 30000, quick: 400)")
    group.add_argument(
        "--write-calibration", type=Path, metavar="FILE",
        help="fit acceptance and protection levels to the calibration's trials, write them here",
    )  # fmt: skip
    group = parser.add_argument_group("eval segmentation")
    group.add_argument(
        "--case", action="append", default=[], metavar="PLACE=MODEL", dest="cases",
        help="score an ONNX network on a place it never saw; repeatable (default: shipped one, barnarp)",
    )  # fmt: skip
    group.add_argument(
        "--set", action="append", default=[], metavar="NODE.PARAMETER=VALUE", dest="overrides",
        help="parameter of networks without their own contract, such as segmenter_node.output=probability",
    )  # fmt: skip
    group.add_argument(
        "--speed", nargs="*", metavar="MODEL",
        help="time networks beside each other (none named: the shipped ones)",
    )  # fmt: skip
    group.add_argument(
        "--write-errors", type=Path, metavar="FILE", help="measure the error model, write it here"
    )


def run_eval(args: argparse.Namespace) -> int:
    """`buildloc eval NAME`."""
    from buildloc.supervisor import dds_environment

    os.environ.update(dds_environment())
    if args.name != "segmentation" and (
        args.cases or args.overrides or args.speed is not None or args.write_errors
    ):
        raise BuildlocError(
            f"--case, --set, --speed and --write-errors are of `eval segmentation`, not of `eval {args.name}`"
        )
    if args.name != "scale" and args.levels:
        raise BuildlocError(f"--levels is of `eval scale`, not of `eval {args.name}`")
    if args.name != "paper" and (args.parts or args.models or args.netvlad):
        raise BuildlocError(f"--parts, --model and --netvlad are of `eval paper`, not of `eval {args.name}`")
    if args.name != "integrity" and (args.plan or args.trials or args.write_calibration):
        raise BuildlocError(
            f"--plan, --trials and --write-calibration are of `eval integrity`, not of `eval {args.name}`"
        )
    if args.name == "scale":
        from buildloc_eval import scale

        levels = None if args.levels is None else tuple(args.levels)
        print(scale.evaluate(args.out, args.seed, args.quick, _stage, levels))
    elif args.name == "beyond":
        from buildloc_eval.beyond import evaluate as beyond

        print(beyond.evaluate(args.out, args.seed, args.quick, _stage))
    elif args.name == "integrity":
        from buildloc_eval.integrity import evaluate as integrity

        plan = args.plan or "test"
        print(
            integrity.evaluate(
                args.out, plan, args.trials, args.seed, args.quick, _stage, args.write_calibration
            )
        )
    elif args.name == "mapping":
        from buildloc_eval import mapping

        print(mapping.evaluate(args.out, args.seed, args.quick, _stage))
    elif args.name == "paper":
        from buildloc_eval.paper import evaluate as paper
        from buildloc_eval.segmentation import parse_case

        given = {case.place: case.model for case in (parse_case(text, "--model") for text in args.models)}
        parts = args.parts or paper.PARTS
        if given and "real" not in parts:
            raise BuildlocError("--model is of the part real; add it to --parts")
        if args.netvlad and "boston" not in parts:
            raise BuildlocError("--netvlad is of the part boston; add it to --parts")
        print(paper.evaluate(args.out, args.seed, args.quick, _stage, parts, given, args.netvlad))
    elif args.name == "segmentation":
        from buildloc_eval import segmentation

        cases = tuple(segmentation.parse_case(text) for text in args.cases) or segmentation.DEFAULT
        config = config_of(load(None, args.overrides), SEGMENTER, SegmenterConfig)
        speed = () if args.speed is None else tuple(args.speed) or ("", "int8")
        plan = segmentation.Plan(cases, config, args.seed, args.quick, speed, args.write_errors)
        print(segmentation.evaluate(args.out, plan, _stage))
    else:
        from buildloc_eval import barnarp

        print(barnarp.evaluate(args.out, args.seed, args.quick))
    return 0


def _stage(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


sim_command = ("make a bag from an orthophoto or a rendered world", add_sim_arguments, run_sim)
demo_command = ("sample bag through the live nodes; fixes, errors, picture", add_demo_arguments, run_demo)
eval_command = ("evaluations with reports", add_eval_arguments, run_eval)
