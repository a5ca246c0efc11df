"""The documentation site builds without warnings. Its pages fit phones and desktops and need no network.

Building the site takes seconds, so these tests are `long`. By default, links and the table of contents are checked
without Sphinx.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import pytest
from cli.tiny import ROOT
from report.chromium import Chromium

PAGES = ("index", "first_run", "config", "method")

#: Pages on a code host and in the site. The others are templates of generated pages.
DOCS = [
    path for path in (ROOT / "docs").rglob("*.md") if path.parts[len(ROOT.parts) + 1] not in ("benchmarks", "paper")
]
#: Links and pictures of a Markdown file, its blocks of code, and its headings.
LINK = re.compile(r"\]\(([^)\s]+)\)")
BLOCK = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)


def build(source: Path, site: Path) -> subprocess.CompletedProcess[str]:
    command = ["-m", "sphinx", "-W", "--keep-going", "-b", "html", "-D", "nb_execution_mode=off", "-d"]
    return subprocess.run(
        [sys.executable, *command, f"{site}.doctrees", source, site], capture_output=True, text=True, timeout=300
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("sphinx", reason="the extra `docs` is not installed")
    folder = tmp_path_factory.mktemp("docs") / "site"
    done = build(ROOT / "docs", folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.long
def test_every_page_of_the_docs_is_in_the_site(site: Path) -> None:
    pages = [path.relative_to(ROOT / "docs") for path in DOCS]
    assert pages
    assert [str(page) for page in pages if not (site / page.with_suffix(".html")).is_file()] == []


@pytest.mark.long
def test_a_dead_link_fails_the_build(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason="the extra `docs` is not installed")
    source = tmp_path / "docs"
    source.mkdir()
    (source / "conf.py").write_text((ROOT / "docs" / "conf.py").read_text(encoding="utf-8"))
    links = "[there](index.md#title) [nowhere](nowhere.md) [no heading](index.md#nothing)"
    (source / "index.md").write_text(f"# Title\n\n{links}\n")
    done = build(source, tmp_path / "bad")
    assert done.returncode == 1
    assert "nowhere" in done.stderr
    assert "nothing" in done.stderr
    assert "title" not in done.stderr


def text_of(page: Path) -> str:
    """Return the text of a page without its blocks of code."""
    return BLOCK.sub("", page.read_text(encoding="utf-8"))


def anchors(page: Path) -> set[str]:
    """Return the names of a page's headings in links, as code hosts and the site make them."""
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in HEADING.findall(text_of(page))}


def dead_links(page: Path) -> list[str]:
    """Return the links of a page to files and headings that do not exist."""
    dead = []
    for link in LINK.findall(text_of(page)):
        name, _, heading = link.partition("#")
        target = page.parent / unquote(name) if name else page
        is_dead = not target.exists() or (heading and target.suffix == ".md" and heading not in anchors(target))
        dead += [link] if "://" not in link and is_dead else []
    return dead


def test_links_lead_to_files_and_headings() -> None:
    pages = [*ROOT.glob("*.md"), *DOCS]
    assert {"README.md", "CHANGELOG.md", "CONTRIBUTING.md", "index.md"} <= {page.name for page in pages}
    assert {page.name: dead for page in pages if (dead := dead_links(page))} == {}


def test_dead_links_are_found(tmp_path: Path) -> None:
    page = tmp_path / "index.md"
    page.write_text("# A title\n\n[there](index.md#a-title) [nowhere](nowhere.md) [no heading](#nothing)\n")
    assert dead_links(page) == ["nowhere.md", "#nothing"]


def test_every_page_is_in_the_table_of_contents() -> None:
    index = (ROOT / "docs/index.md").read_text(encoding="utf-8")
    named = {line for block in BLOCK.findall(index) if "{toctree}" in block for line in block.splitlines()}
    pages = {page.relative_to(ROOT / "docs").with_suffix("").as_posix() for page in DOCS} - {"index"}
    assert "notes/*" in named
    assert sorted(page for page in pages - named if not page.startswith("notes/")) == []


@pytest.mark.long
@pytest.mark.parametrize("width", [380, 1280])
@pytest.mark.parametrize("page", PAGES)
def test_pages_fit_and_need_no_network(chromium: Chromium, site: Path, page: str, width: int) -> None:
    chromium.open(site / f"{page}.html", width)
    assert chromium.evaluate("document.documentElement.scrollWidth") <= width
    assert chromium.evaluate("document.querySelectorAll('h1').length") == 1
    assert all(address.startswith(("file:", "data:")) for address in chromium.requests())
