"""The documentation site builds without warnings. Its pages fit phones and desktops and need no network."""

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

#: Links and pictures of a Markdown file.
LINK = re.compile(r"\]\(([^)\s]+)\)")


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


def test_every_page_of_the_docs_is_in_the_site(site: Path) -> None:
    sources = [path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")]
    pages = [path for path in sources if path.parts[0] not in ("benchmarks", "paper")]
    assert pages
    assert [str(page) for page in pages if not (site / page.with_suffix(".html")).is_file()] == []


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


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_links_outside_the_site_exist(page: str) -> None:
    links = LINK.findall((ROOT / page).read_text(encoding="utf-8"))
    files = [unquote(link.split("#")[0]) for link in links if "://" not in link and not link.startswith("#")]
    assert [name for name in files if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("width", [380, 1280])
@pytest.mark.parametrize("page", PAGES)
def test_pages_fit_and_need_no_network(chromium: Chromium, site: Path, page: str, width: int) -> None:
    chromium.open(site / f"{page}.html", width)
    assert chromium.evaluate("document.documentElement.scrollWidth") <= width
    assert chromium.evaluate("document.querySelectorAll('h1').length") == 1
    assert all(address.startswith(("file:", "data:")) for address in chromium.requests())
