"""`reslrb report`, and the page of a run during the run."""

from __future__ import annotations

import os
import threading
import time
from itertools import pairwise
from pathlib import Path

import pytest
from cli.tiny import KEY, done, outcome, read_metrics, write_experiment
from report.measured import make_run, write_bench, write_convergence, write_gradcheck

from reslrb_cli.optimization.uncertainty.measuring import Certainty
from reslrb_cli.records import measurement_files
from reslrb_cli.records.manifest import read_content
from reslrb_cli.records.measurement_files import LivePage
from reslrb_cli.report.sources import read_sources
from reslrb_cli.runs import recorder
from reslrb_cli.runs import recorder as recording

# `reslrb report`: its exit codes, and where it writes.


def test_one_page_for_everything(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "a")
    make_run(tmp_path / "b")
    write_bench(tmp_path / "bench.jsonl")
    write_gradcheck(tmp_path / "check.jsonl")
    write_convergence(tmp_path / "convergence.jsonl")
    names = ["a", "b", "bench.jsonl", "check.jsonl", "convergence.jsonl"]
    assert outcome("report", *names, "-o", "page.html") == (0, "look at page.html\n", "")
    page = (tmp_path / "page.html").read_text()
    assert page.endswith("</html>\n")
    assert 'http-equiv="refresh"' not in page


def test_a_link_to_a_run_is_shown_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "a")
    make_run(tmp_path / "b")
    (tmp_path / "latest").symlink_to("b")
    names = [each.name for each in read_sources([Path("a"), Path("b"), Path("latest")])]
    assert names == ["a", "b"]
    assert [each.name for each in read_sources([Path("a"), Path("latest")])] == ["a", "latest"]


def test_the_page_of_one_run_is_rewritten(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = make_run(tmp_path / "a")
    (folder / "report.html").write_text('<meta http-equiv="refresh" content="5">')
    assert outcome("report", "a") == (0, f"look at {os.path.join('a', 'report.html')}\n", "")
    assert "refresh" not in (folder / "report.html").read_text()


# The page of a run in progress. The page is current and always complete, and writing it is not counted as run time.

RUN, PAGE = Path("runs/tiny"), Path("runs/tiny/report.html")
REFRESH = 'http-equiv="refresh"'


@pytest.fixture
def optimize(llvm, tmp_path, monkeypatch):
    """Function that runs `reslrb optimize tiny.yaml`, writes the page after each iteration, and returns standard
    error.
    """
    write_experiment(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(measurement_files, "PAGE_SECONDS", 0.0)
    monkeypatch.setattr(measurement_files, "PAGE_SHARE", 0.0)

    return lambda *args: done("optimize", "tiny.yaml", *args).stderr


def test_writing_the_page_is_not_timed(optimize, monkeypatch):
    """Writing the page takes 0.1 s, at the start, after each iteration and at the end."""
    written = []

    def slowly(folder, *now):
        written.append(now)
        time.sleep(0.1)

    monkeypatch.setattr(recording, "write_report", slowly)
    optimize("--set", "run.iterations=6")
    assert len(written) == 1 + 6 + 1
    times = [record["elapsed_s"] for record in read_metrics(RUN)]
    warm = sorted(after - before for before, after in pairwise(times[2:]))
    assert warm[len(warm) // 2] < 0.1
    assert read_content(RUN)["results"]["elapsed_s"] == times[-1]


def test_the_page_shows_progress_and_is_always_complete(optimize, monkeypatch):
    seen, torn, over = [], [], threading.Event()

    def look():
        while not over.is_set():
            if PAGE.exists():
                page = PAGE.read_text()
                torn.extend([] if page.endswith("</html>\n") else [page])
            time.sleep(0.001)

    shown = recording.write_report

    def keep(folder, *now):
        path = shown(folder, *now)
        seen.append(PAGE.read_text())
        return path

    monkeypatch.setattr(recording, "write_report", keep)
    reader = threading.Thread(target=look)
    reader.start()
    try:
        optimize("--set", "run.iterations=3")
    finally:
        over.set()
        reader.join()
    assert torn == []
    first, *between, last = seen
    assert len(between) == 3
    for page in (first, *between):
        assert REFRESH in page
        assert '<span class="status open">running</span>' in page
    for page in between:
        assert f'alt="now: {KEY}"' in page
        assert '<th scope="col">now</th>' in page
    assert "No iteration has been completed yet" in first
    assert "2 iterations in" in between[1]
    assert REFRESH not in last
    assert '<span class="status open">finished</span>' in last
    assert f'alt="end: {KEY}"' in last


def test_no_page_claims_that_an_ended_run_is_running(optimize, monkeypatch):
    shown = recording.write_report

    def only_live(folder, *now):
        if not now:
            raise OSError(28, "No space left on device", str(folder))
        return shown(folder, *now)

    monkeypatch.setattr(recording, "write_report", only_live)
    err = optimize("--set", "run.iterations=1")
    assert "the page was not written" in err
    assert not PAGE.exists()
    assert read_content(RUN)["status"] == "finished"


def test_pages_keep_to_their_share_of_the_time(monkeypatch):
    """The next write follows 20 s after a write of 1 s, and 5 s after a quick write. A page that fails is not tried
    again.
    """
    now, cost, written = [100.0], [1.0], []
    monkeypatch.setattr(recorder.time, "monotonic", lambda: now[0])

    def write():
        written.append(now[0])
        now[0] += cost[0]
        if cost[0] < 0:
            raise OSError("full")

    page = LivePage(write)
    for _ in range(200):
        page.refresh()
        now[0] += 0.25
    assert [after - before for before, after in pairwise(written)] == [21.0, 21.0]
    cost[0], written[:] = 0.125, []
    for _ in range(200):
        page.refresh()
        now[0] += 0.25
    assert 5 <= written[-1] - written[-2] < 5.5
    cost[0] = -1e-3
    for _ in range(200):
        page.refresh()
        now[0] += 0.25
    assert len([start for start in written if start > written[-1] - 1]) == 1
    before = len(written)
    now[0] += 1000
    page.refresh()
    assert len(written) == before


def test_the_manifest_has_the_plan_and_perceptual_errors(optimize):
    optimize("--set", "run.iterations=1")
    manifest = read_content(RUN)
    plan = manifest["plan"]
    assert (plan["integrator"], plan["estimator"]) == ("reslrb", "stack")
    rows = {row["feature"]: row["needed"] for row in plan["rows"]}
    assert (rows["derivatives of BSDFs"], rows["derivatives of emission"]) == (True, False)
    seen = manifest["results"]["seen"]
    assert set(seen[""]) == {"exposure", "initial", "final"}
    assert seen[""]["final"]["ssim"] is None  # 8x8 is too small
    page = PAGE.read_text()
    for title in ("Plan", "Errors as people see them"):
        assert f"<h2>{title}</h2>" in page


def test_unmeasurable_errors_do_not_end_a_run(optimize, monkeypatch):
    def fail(*given):
        raise ImportError("no colours here")

    monkeypatch.setattr(recording, "seen_errors", fail)
    monkeypatch.setattr(Certainty, "measure", fail)
    monkeypatch.setattr(recording, "LEAST_ITERATIONS", 1)
    result = done("optimize", "tiny.yaml", "--set", "run.iterations=1")
    lines = [f"{what} not measured: ImportError: no colours here"
             for what in ("the certainty of the values was", "perceptual errors were")]  # fmt: skip
    results, last = read_content(RUN)["results"], result.stdout.splitlines()[-1]
    assert f"; {lines[0]}; {lines[1]}; look at" in last
    assert results["unmeasured"] == lines
    assert results["warnings"][-2:] == lines
    assert all(line in result.stderr and line in PAGE.read_text() for line in lines)
    assert "seen" not in results


def test_a_loss_without_a_certainty_is_named_in_the_last_line(optimize, monkeypatch):
    monkeypatch.setattr(recording, "LEAST_ITERATIONS", 1)
    code = "import drjit as dr\ndef loss(a, b):\n    return dr.mean((a - b)**2, axis=None)\n"
    Path("own.py").write_text(code)
    own = "loss={type: custom, file: 'own.py:loss'}"
    result = done("optimize", "tiny.yaml", "--allow-code", "--set", own, "--set", "run.iterations=1")
    line = "the certainty of the values was not measured: it needs a loss of separate pixels"
    assert f"; {line}; look at" in result.stdout.splitlines()[-1]
