"""`reslrb report`: its exit codes, and where it writes."""

from __future__ import annotations

import json
import os

import pytest
from report.measured import write_bench, write_convergence, write_gradcheck, write_maps
from report.run_folder import make_run

from reslrb_cli.cli import main


@pytest.fixture
def report(capsys, tmp_path, monkeypatch):
    """A function that runs `reslrb report` in `tmp_path`; returns exit code, standard output and standard error."""
    monkeypatch.chdir(tmp_path)

    def call(*args):
        with pytest.raises(SystemExit) as end:
            main.main(["report", *map(str, args)])
        out, err = capsys.readouterr()
        return int(end.value.code or 0), out, err

    return call


def test_one_page_of_everything(report, tmp_path):
    make_run(tmp_path / "a")
    make_run(tmp_path / "b")
    write_bench(tmp_path / "bench.jsonl")
    write_gradcheck(tmp_path / "check.jsonl")
    write_convergence(tmp_path / "convergence.jsonl")
    write_maps(tmp_path / "maps")
    names = ["a", "b", "bench.jsonl", "check.jsonl", "convergence.jsonl", "maps"]
    code, out, err = report(*names, "-o", "page.html")
    assert (code, out, err) == (0, "look at page.html\n", "")
    page = (tmp_path / "page.html").read_text()
    assert page.endswith("</html>\n")
    assert 'http-equiv="refresh"' not in page
    # of runs that never recorded them they are found in the folder
    assert "Errors as people see them" in page
    assert "ΔE ITP" in page


def test_of_one_run_its_own_page_is_written_anew(report, tmp_path):
    folder = make_run(tmp_path / "a")
    (folder / "report.html").write_text('<meta http-equiv="refresh" content="5">')
    assert report("a") == (0, f"look at {os.path.join('a', 'report.html')}\n", "")
    assert "refresh" not in (folder / "report.html").read_text()
    assert "seen" not in json.loads((folder / "manifest.json").read_text())["results"]  # the run is left as it was


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (["gone"], "gone: no such file"),
        (["a", "note.txt"], "note.txt: line 1: holds no line that bench, gradcheck or convergence wrote"),
        (["empty"], "empty: is no run folder"),
        (["a", "a"], "--output: is missing"),
        (["bench.jsonl"], "--output: is missing"),
        (["a", "-o", "gone/page.html"], "--output: cannot write gone/page.html"),
        (["a", "-o", "empty"], "--output: cannot write empty"),
        (["a"] * 101, "RUN: 101 are given; a page shows at most 100"),
        (["pipe"], "pipe: is a pipe, not a regular file"),
        (["\x1b[31m"], "\\x1b[31m: no such file"),
    ],
)
def test_what_cannot_be_done_is_one_line(report, tmp_path, args, line):
    make_run(tmp_path / "a", iterations=0)
    (tmp_path / "empty").mkdir()
    (tmp_path / "note.txt").write_text("hello\n")
    os.mkfifo(tmp_path / "pipe")
    write_bench(tmp_path / "bench.jsonl")
    before = sorted(tmp_path.rglob("*"))
    code, out, err = report(*args)
    assert (code, out) == (2, "")
    assert err.startswith(line)
    assert err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before
