"""README and docs say what is true today: made anew, they come out as they stand."""

from __future__ import annotations

import ast
import importlib.util
import math
import re
import shutil
import subprocess
import sys
import textwrap
import types
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from agv_cloud.control.registry import CONTROL_LAWS
from agv_cloud.staleness.registry import STALENESS_POLICIES
from agv_plant.vehicle.registry import VEHICLES
from agv_ros.part_registry import Registry
from test.command_runner import run_command

REPOSITORY = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def update() -> Any:
    return module_of_docs("update")


def test_the_page_of_parameters_is_current(update: Any) -> None:
    assert update.parameters_page() == (REPOSITORY / "docs/parameters.md").read_text()


def test_the_table_of_criteria_is_current(update: Any) -> None:
    assert update.stability_page() == (REPOSITORY / "docs/stability.md").read_text()


def test_the_page_of_the_python_api_is_current(update: Any) -> None:
    assert update.python_api_page() == (REPOSITORY / "docs/python_api.md").read_text()


@pytest.mark.parametrize(
    ("page", "registry"),
    [("control_laws", CONTROL_LAWS), ("plant", VEHICLES), ("policies", STALENESS_POLICIES)],
)
def test_a_page_has_a_row_for_every_part_with_its_parameters(page: str, registry: Registry) -> None:
    rows = (REPOSITORY / f"docs/{page}.md").read_text()
    for name in registry.own:
        row = re.findall(rf"^\| `{name}` \|.*$", rows, re.MULTILINE)[0]
        for known in registry.find(name).parameters:
            default = ".inf" if known.default == math.inf else f"{known.default:g}"
            assert re.search(rf"`(?:{name})?\.?{known.name}`[^`]* {re.escape(f'{known.unit} {default}')}\b", row), (
                known.name
            )


def test_the_readme_shows_what_the_demo_prints(update: Any, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    bag = str(tmp_path / "bag")
    update.command("run", "config/outages.yaml", "--bag", bag)
    block = update.demo_block(update.command("analyse", bag))
    assert block in (REPOSITORY / "README.md").read_text()


def module_of_docs(name: str) -> Any:
    """A script of docs/ as a module."""
    spec = importlib.util.spec_from_file_location(name, REPOSITORY / f"docs/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.no_cover
@pytest.mark.parametrize("page", sorted(path.stem for path in (REPOSITORY / "docs/tutorials").glob("*.md")))
def test_the_blocks_of_a_tutorial_run_in_order_and_print_what_it_shows(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tutorials = module_of_docs("tutorials")
    monkeypatch.setenv("COLUMNS", str(tutorials.WIDTH))
    monkeypatch.chdir(tmp_path)
    tutorials.fresh_files(tmp_path)
    text = (REPOSITORY / f"docs/tutorials/{page}.md").read_text(encoding="utf-8")
    assert len(tutorials.blocks(text)) == len(re.findall(r"^```(?:console|python)$", text, re.MULTILINE)) > 2
    for block, printed in tutorials.run(text, run_command):
        assert block.shown is None or tutorials.is_shown(block.shown, printed), printed
    for name in tutorials.PICTURE.findall(text):
        assert (tmp_path / f"{name}.png").stat().st_size > 0
        assert (REPOSITORY / f"docs/images/tutorial_{name}.png").stat().st_size > 0


def test_what_a_tutorial_shows_may_leave_out_lines_but_no_other_ones() -> None:
    tutorials = module_of_docs("tutorials")
    assert tutorials.is_shown("a\n...\nd\n", "a  \nb\nc\nd")
    assert not tutorials.is_shown("a\n...\nd\n", "a\nb\nc")
    page = "```python\nprint(2)\n```\n\n```text\n1\n```\n"
    assert tutorials.with_printed(page, ["2\n"]) == page.replace("\n1\n", "\n2\n")
    assert tutorials.with_printed(page, ["1\n"]) == page
    with pytest.raises(ValueError, match="choose anew"):
        tutorials.with_printed(page.replace("\n1\n", "\n1\n...\n"), ["2\n"])


def test_the_navigation_of_the_site_names_every_page_once() -> None:
    docs = REPOSITORY / "docs"
    named = re.findall(r"^   ([\w/]+)$", (docs / "index.rst").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(named) == sorted(str(page.relative_to(docs).with_suffix("")) for page in docs.rglob("*.md"))


def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """Names of the headings of a page, as GitHub and the site's generator make them."""
    headings = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_link_to_a_file_and_to_a_heading_leads_there() -> None:
    """Those to elsewhere are not followed."""
    pages = [*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").rglob("*.md")]
    wrong = []
    for page in pages:
        for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
            path, _, heading = target.partition("#")
            to = page.parent / path if path else page
            if not re.match(r"https?:", target) and not (to.exists() and (not heading or heading in anchors(to))):
                wrong.append(f"{page.relative_to(REPOSITORY)}: {target}")
    assert wrong == []
    assert len(pages) > 40


def test_rosdoc2_finds_the_pages() -> None:
    import xml.etree.ElementTree as ElementTree

    import yaml

    found = ElementTree.parse(REPOSITORY / "package.xml").findtext("export/rosdoc2")
    assert found is not None
    _, settings = yaml.safe_load_all((REPOSITORY / found).read_text(encoding="utf-8"))
    (builder,) = settings["builders"]
    assert (REPOSITORY / builder["sphinx"]["sphinx_sourcedir"] / "conf.py").is_file()


def test_rosdoc2_s_copy_of_the_pages_has_the_changelog(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It lies in a folder below the package, so that `../CHANGELOG.md` is not there."""
    monkeypatch.setattr(sys, "path", list(sys.path))  # which conf.py changes
    copy = tmp_path / "build/copy"
    copy.mkdir(parents=True)
    for name in ("package.xml", "CHANGELOG.md"):
        shutil.copy(REPOSITORY / name, tmp_path)
    conf: dict[str, Any] = {"__file__": str(copy / "conf.py")}
    exec((REPOSITORY / "docs/conf.py").read_text(encoding="utf-8"), conf)
    source = [(REPOSITORY / "docs/changelog.md").read_text(encoding="utf-8")]
    conf["included"](types.SimpleNamespace(srcdir=copy), "changelog", source)
    assert source[0].startswith("# Changelog")
    assert "](docs/" not in source[0]


def test_the_answer_in_metres_of_the_readme_is_true() -> None:
    """22 updates within 0.25 m, by the closed form at the track's top speed; the shares of laps by counting."""
    import agv_ncs
    from agv_analysis.simulation import simulate_batch

    text = " ".join((REPOSITORY / "README.md").read_text().split())
    said = re.search(r"within ([\d.]+) m as long as no outage is longer than (\d+) updates \((\d+) ms\)", text)
    assert said is not None
    width, n = float(said[1]), int(said[2])
    scenario = agv_ncs.load_scenario("config/outages.yaml")
    a, ts, top_speed = scenario.controller.kx * scenario.plant.ts, scenario.plant.ts, 1.5
    farthest = [a * top_speed * ts * slots * (slots + 1) / 2 for slots in (n, n + 1)]
    assert farthest[0] <= width < farthest[1]
    assert int(said[3]) == round(1e3 * n * ts)
    deviation = simulate_batch([scenario], range(1, 301))["deviation_max"][0]
    assert "in about two of three laps of 100 s, and within 0.60 m it stays in 19 of 20" in text
    assert (deviation > width).mean() == pytest.approx(2 / 3, abs=0.06)
    assert (deviation <= 0.60).mean() == pytest.approx(19 / 20, abs=0.03)


def test_each_page_is_drawn_at_the_size_of_a_screen_and_of_a_phone_light_and_dark() -> None:
    """`make images` draws them; here they are there, of the size that their names say, and shown by the docs."""
    pages = "".join(page.read_text() for page in (REPOSITORY / "docs").glob("*.md"))
    for name in ("report", "sweep", "map", "explorer", "watch"):
        for size in ("1400x900", "390x844"):
            for scheme in ("light", "dark"):
                content = (REPOSITORY / f"docs/images/{name}-{size}-{scheme}.png").read_bytes()
                assert content.startswith(b"\x89PNG")
                assert size == f"{int.from_bytes(content[16:20], 'big')}x{int.from_bytes(content[20:24], 'big')}"
        assert f"images/{name}-1400x900-light.png" in pages or name == "map"


def test_the_page_of_the_report_has_every_key_of_the_json() -> None:
    import agv_ncs

    scenario = agv_ncs.load_scenario("config/outages.yaml", ["plant.duration=5.0"])
    keys = agv_ncs.analyse(agv_ncs.simulate(scenario)).to_json()
    pages = "".join((REPOSITORY / "docs" / page).read_text() for page in ("report.md", "convergence.md"))
    assert [key for key in keys if f"`{key}`" not in pages] == []


def test_the_python_of_the_readme_runs(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (REPOSITORY / "README.md").read_text(), re.DOTALL)
    short = code.replace('["controller.law', '["plant.duration=5.0", "controller.law')
    assert short != code
    (tmp_path / "law.py").write_text(short, encoding="utf-8")  # what is compiled of a law in a file is kept
    command = [sys.executable, str(tmp_path / "law.py")]
    result = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=300)
    assert result.returncode == 0, result.stderr
    assert re.fullmatch(r"[a-z-]+ \d+\n", result.stdout), result.stdout


def test_the_tables_of_the_page_of_bags_are_read_as_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from agv_analysis.bags import read_bag
    from agv_analysis.bags.export import export_parquet

    for library in ("pandas", "polars", "pyarrow"):
        pytest.importorskip(library)
    page = (REPOSITORY / "docs/bags.md").read_text()
    (code,) = [block for block in re.findall(r"(?:^    .*\n|^\n)+", page, re.MULTILINE) if "import pandas" in block]
    bag = read_bag(REPOSITORY / "bags/sample", topics=["/edge/error", "/edge/slot"])
    export_parquet(bag, tmp_path / "tables")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    shown = []
    for statement in ast.parse(textwrap.dedent(code)).body:
        if isinstance(statement, ast.Expr):
            shown.append(eval(compile(ast.Expression(statement.value), "bags.md", "eval"), names))
        else:
            exec(compile(ast.Module([statement], []), "bags.md", "exec"), names)
    largest, slots, about = shown
    assert largest.max() == bag["/edge/error"]["pose.pose.position.y"].max()
    counts = {name.encode(): count for name, count in slots.rows()}
    assert counts == dict(Counter(bag["/edge/slot"]["source"].tolist()))
    assert about[b"unit"] == b"m/s"


def test_the_commands_of_the_readme_exist(agv_ncs: Callable[..., tuple[int, str]]) -> None:
    readme = (REPOSITORY / "README.md").read_text()
    _, known = agv_ncs("--help")
    for command in set(re.findall(r"^ +agv-ncs (\w+)", readme, re.MULTILINE)):
        assert re.search(rf"^  {command} ", known, re.MULTILINE), command
    targets = re.findall(r"^(\w+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"(?:`|^ +)make (\w+)", readme, re.MULTILINE)) <= set(targets)
    for path in set(re.findall(r"(?:config|docs|bags)/[\w/]+\.\w+", readme)):
        assert (REPOSITORY / path).exists() or path.startswith("bags/demo/"), path


@pytest.mark.parametrize("page", ["docs/architecture.md", "CONTRIBUTING.md"])
def test_what_the_pages_for_developers_name_is_there(page: str) -> None:
    text = (REPOSITORY / page).read_text()
    paths = set(re.findall(r"`((?:agv_\w+|test|docs|config|examples)/[\w/.]*)`", text))
    assert paths
    assert [path for path in sorted(paths) if not (REPOSITORY / path).exists()] == []
    targets = re.findall(r"^(\w+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"(?:`|^ +)make (\w+)", text, re.MULTILINE)) <= set(targets)


def test_the_page_of_the_architecture_names_every_room() -> None:
    tree = (REPOSITORY / "docs/architecture.md").read_text().partition("## Folders")[2].partition("\nImports")[0]
    rooms = {path.parent.name for layer in REPOSITORY.glob("agv_*") for path in layer.rglob("__init__.py")}
    assert [room for room in sorted(rooms) if f"{room}/" not in tree] == []
