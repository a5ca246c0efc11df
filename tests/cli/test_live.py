"""The page of a run while it is at work: current, whole at every moment, and in no time that is counted."""

from __future__ import annotations

import threading
import time
from itertools import pairwise
from pathlib import Path

import pytest
from cli.calling import read_metrics
from cli.tiny import KEY, write_experiment

from reslrb_cli.cli import main
from reslrb_cli.records import measurement_files
from reslrb_cli.records.manifest import read_content
from reslrb_cli.records.measurement_files import LivePage
from reslrb_cli.runs import recorder
from reslrb_cli.runs import recorder as recording

RUN, PAGE = Path("runs/tiny"), Path("runs/tiny/report.html")
REFRESH = 'http-equiv="refresh"'


@pytest.fixture
def optimize(llvm, tmp_path, monkeypatch, capsys):
    """A function that runs `reslrb optimize tiny.yaml`, with a page after every iteration; returns standard error."""
    write_experiment(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(measurement_files, "PAGE_SECONDS", 0.0)
    monkeypatch.setattr(measurement_files, "PAGE_SHARE", 0.0)

    def call(*args):
        with pytest.raises(SystemExit) as end:
            main.main(["optimize", "tiny.yaml", *args])
        assert end.value.code == 0
        return capsys.readouterr().err

    return call


def test_writing_the_page_is_in_no_time_that_is_counted(optimize, monkeypatch):
    """A page that takes 0.2 s, before and after each iteration."""
    written = []

    def slowly(folder, *now):
        written.append(now)
        time.sleep(0.2)

    monkeypatch.setattr(recording, "write_report", slowly)
    optimize("--set", "run.iterations=8")
    assert len(written) == 1 + 8 + 1
    times = [record["elapsed_s"] for record in read_metrics(RUN)]
    warm = sorted(after - before for before, after in pairwise(times[2:]))
    assert warm[len(warm) // 2] < 0.1
    assert read_content(RUN)["results"]["elapsed_s"] == times[-1]


def test_the_page_says_how_the_run_goes_and_is_whole_at_every_moment(optimize, monkeypatch):
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
        assert '<span class="status running">running</span>' in page
    for page in between:
        assert f'alt="now: {KEY}"' in page
        assert '<th scope="col">now</th>' in page
    assert "No iteration has been completed yet" in first
    assert "2 iterations in" in between[1]
    assert REFRESH not in last
    assert '<span class="status finished">finished</span>' in last
    assert f'alt="end: {KEY}"' in last


def test_where_the_last_page_cannot_be_written_none_says_that_the_run_is_at_work(optimize, monkeypatch):
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


def test_pages_take_no_more_than_their_share(monkeypatch):
    """One that takes 1 s is written every 20 s, a quick one every 5 s; one that fails is not tried again."""
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


def test_the_manifest_has_the_plan_and_errors_as_people_see_them(optimize):
    optimize("--set", "run.iterations=1")
    manifest = read_content(RUN)
    plan = manifest["plan"]
    assert (plan["integrator"], plan["estimator"]) == ("reslrb", "stack")
    rows = {row["feature"]: row["needed"] for row in plan["rows"]}
    assert (rows["derivatives of BSDFs"], rows["derivatives of emission"]) == (True, False)
    seen = manifest["results"]["seen"]
    assert set(seen["images"][""]) == {"exposure", "initial", "final"}
    assert seen["images"][""]["final"]["ssim"] is None  # 8x8 pixels
    assert seen["colors"][KEY]["measure"] == "ciede2000"
    assert seen["colors"][KEY]["final"]["mean"] > 0
    page = PAGE.read_text()
    for title in ("Plan", "Errors as people see them"):
        assert f"<h2>{title}</h2>" in page


def test_errors_that_cannot_be_measured_end_no_run(optimize, monkeypatch):
    def fail(folder, results):
        raise ImportError("no colours here")

    monkeypatch.setattr(recording, "seen_errors", fail)
    err = optimize("--set", "run.iterations=1")
    assert "errors as people see them were not measured: " in err
    assert "seen" not in read_content(RUN)["results"]
