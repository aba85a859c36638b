"""What the documents name exists: links, paths, commands with their options, parameters, topics."""

from __future__ import annotations

import dataclasses
import re
import shlex
from pathlib import Path

import pytest
from buildloc.cli import parser
from buildloc.settings import MAPPER, MATCHER, NOT_CONFIG, REFERENCE_DB, SEGMENTER
from buildloc_mapper.config import MapperConfig
from buildloc_matcher.config import MatcherConfig
from buildloc_msgs_py import topics
from buildloc_segmenter.config import SegmenterConfig

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted(
    [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("bags/*.md"), *ROOT.glob("training/*.md")]
)
CONFIGS = {
    SEGMENTER: SegmenterConfig, MAPPER: MapperConfig, MATCHER: MatcherConfig, REFERENCE_DB: MatcherConfig
}  # fmt: skip
documents = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))


def fenced(text: str) -> list[str]:
    """Lines of code blocks, those that a backslash continues in one."""
    blocks = re.findall(r"^```(?:sh|)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return [line.strip() for block in blocks for line in block.replace("\\\n", " ").splitlines()]


def quoted(text: str) -> list[str]:
    """What stands in backticks outside of code blocks."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL))


@documents
def test_links_lead_somewhere(document: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)", document.read_text(encoding="utf-8"))
    dead = [link for link in links if "://" not in link and not (document.parent / link).exists()]
    assert dead == []


@documents
def test_paths_exist(document: Path) -> None:
    names = [name.strip("/") for name in quoted(document.read_text(encoding="utf-8"))]
    own = [name for name in names if re.fullmatch(r"(src|docs|bags|test|training|ros2_ws)(/[\w./]+)?", name)]
    assert [name for name in own if not (ROOT / name).exists()] == []
    modules = [name for name in names if re.fullmatch(r"[\w/]+\.py", name)]
    known = [path.as_posix() for part in ("src", "training", "test") for path in (ROOT / part).rglob("*.py")]
    assert [name for name in modules if not any(path.endswith(f"/{name}") for path in known)] == []


@documents
def test_commands_are_understood(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for line in fenced(text):
        if line.startswith("buildloc "):
            parser().parse_args(shlex.split(line, comments=True)[1:])  # exits with what is wrong
    made = (ROOT / "Makefile").read_text(encoding="utf-8")
    for name in [*fenced(text), *quoted(text)]:
        if target := re.fullmatch(r"make ([a-z]+)", name):
            assert re.search(rf"^{target[1]}:", made, re.MULTILINE), name


@documents
def test_commands_in_the_text_exist(document: Path) -> None:
    named = [name.split()[1:] for name in quoted(document.read_text(encoding="utf-8"))
             if name.startswith("buildloc ")]  # fmt: skip
    for words in named:
        plain = [word for word in words if re.fullmatch(r"[a-z]+", word)]
        with pytest.raises(SystemExit) as stopped:
            parser().parse_args([*plain[: 2 if plain[:1] == ["refdb"] else 1], "--help"])
        assert stopped.value.code == 0, words


@documents
def test_parameters_and_topics_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for node, parameter in re.findall(r"\b([a-z_]+_node)\.([a-z_]+)\b", text):
        fields = {field.name for field in dataclasses.fields(CONFIGS[node])}
        assert parameter in fields | {"preset", *NOT_CONFIG}, (node, parameter)
    known = {value for name, value in vars(topics).items() if name.isupper()}
    assert [
        name for name in quoted(text) if re.fullmatch(r"/buildloc(/\w+)+", name) and name not in known
    ] == []
