"""Tests of `reslrb serve`: what it shows, that it only reads, and that nothing outside of the folder is reached."""

from __future__ import annotations

import http.client
import json
import os
import re
import shutil
import socket
import subprocess
import threading
import time
from pathlib import Path
from urllib.parse import quote

import pytest
from cli import tiny
from cli.tiny import reslrb
from report.chromium import PATIENCE
from report.measured import make_run

import reslrb_cli.report.page as page_module
from reslrb_cli.cli import serve
from reslrb_cli.records.lock import Holder
from reslrb_cli.report.page import write_report

SECRET = "the secret outside of the folder"


def change_manifest(folder, **fields):
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


@pytest.fixture
def runs(llvm, tmp_path):
    """Folder with the finished runs `a <b>` and `b`, and the sweep `s` with a run."""
    root = tmp_path / "runs"
    a, b = make_run(root / "a <b>", iterations=30), make_run(root / "b", iterations=12)
    for folder, rate in ((a, 0.1), (b, 0.2)):
        text = f"optimizer: {{learning_rate: {rate}}}\nrun: {{spp: 4, name: {folder.name}}}\nparameters: [{{key: k}}]\n"
        (folder / "config.yaml").write_text(text)
    write_report(a)
    make_run(root / "s" / "rate=1-seed=0", iterations=3)
    (root / "s" / "sweep.json").write_text("{}")
    (root / "s" / "sweep.html").write_text("the page of the sweep")
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "report.html").write_text(SECRET)
    return root


@pytest.fixture
def served(runs):
    """The address of a server of `runs`."""
    with serve.make_server(runs, 0) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))  # the time that `shutdown` waits
        thread.start()
        yield server.server_port
        server.shutdown()
        thread.join()


def ask(port, path="/", method="GET", host="127.0.0.1"):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.putrequest(method, path, skip_host=True)
    for name in [host] if host is not None else []:
        connection.putheader("Host", name)
    connection.endheaders()
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer, text


def test_the_first_page_lists_runs_and_sweeps(served, runs):
    answer, text = ask(served)
    assert answer.status == 200
    assert 'href="/a%20%3Cb%3E/report.html"' in text
    assert "<b>" not in text
    assert text.count(">compare</a>") == 3
    assert 'href="/s/sweep.html"' in text
    assert 'http-equiv="refresh"' in text
    assert '<td data-label="iterations"><div>12</div>' in text
    assert ask(served, "/a%20%3Cb%3E/report.html")[1] == (runs / "a <b>" / "report.html").read_text()
    assert ask(served, "/s/sweep.html")[1] == "the page of the sweep"
    with (runs / "b" / "metrics.jsonl").open("a") as file:  # it grows
        last = json.loads((runs / "b" / "metrics.jsonl").read_text().splitlines()[-1])
        file.write(json.dumps(last | {"iteration": 12}) + "\n" + '{"iteration": 13, "lo')
        file.flush()
    assert "<div>13</div>" in ask(served)[1]


def test_two_runs_are_compared(served, runs):
    _, text = ask(served, "/?with=b")
    assert "Choose a run to compare with b." in text
    address = "/compare?run=b&amp;run=a+%3Cb%3E"
    assert f'href="{address}"' in text
    assert text.count(">compare</a>") == 2
    answer, text = ask(served, address.replace("&amp;", "&"))
    assert answer.status == 200
    assert 'http-equiv="refresh"' not in text
    assert text.count("<svg") == 4  # the loss and the relative error, over iterations and time
    assert text.count(">relative error of the parameters<") == 2
    assert "cannot be shown" not in text
    assert text.count('alt="target: ') == text.count('alt="final: ') == 2
    rows = text[text.index("Settings that differ") : text.index("Convergence")]
    assert "<wbr>learning_<wbr>rate" in rows
    assert "0.1" in rows
    assert "spp" not in rows
    assert "name" not in rows
    change_manifest(runs / "b", status="running", process=vars(Holder.here(False)))
    shutil.rmtree(runs / "b" / "images")
    assert 'http-equiv="refresh"' in ask(served, address.replace("&amp;", "&"))[1]
    for query in ("run=b", "run=b&run=no", "run=b&run=b&run=b", "run=b&run=../outside", ""):
        assert ask(served, f"/compare?{query}")[0].status == 404
    assert "Choose" not in ask(served, "/?with=no")[1]


def test_there_are_no_methods_that_write(served):
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT"):
        assert ask(served, method=method)[0].status == 501, method


def test_head_has_the_headers_alone(served):
    answer, text = ask(served, method="HEAD")
    assert (answer.status, text) == (200, "")
    assert int(answer.headers["Content-Length"]) > 1000
    for path in ("/", "/no"):
        headers = ask(served, path)[0].headers
        assert headers["Content-Security-Policy"].startswith("default-src 'none'; img-src data:; style-src")
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["X-Frame-Options"] == "DENY"
        assert "Access-Control-Allow-Origin" not in headers


HOSTS = {"127.0.0.1": 200, "localhost:8000": 200, "LOCALHOST": 200, "[::1]:80": 200, "evil.example": 403,
         "127.0.0.1.evil.example": 403, "evil.example:8000": 403, "localhost@evil.example": 403, "": 403, None: 403,
         "127.0.0.1\tevil": 403}  # fmt: skip


def test_only_names_of_this_machine_are_answered(served):
    """A page of another site could let its own name lead to 127.0.0.1."""
    for host, status in HOSTS.items():
        answer, text = ask(served, host=host)
        assert answer.status == status, host
        assert ("compare" in text) == (status == 200), host


OUTSIDE = ["/../outside/report.html", "/%2e%2e/outside/report.html", "/..%2foutside/report.html",
           "/b/../../outside/report.html", "/b/..%2f..%2foutside%2freport.html", "//outside/report.html",
           "/link/report.html", "/c/report.html", "/d/report.html", "/..%5coutside%5creport.html",
           "/outside/report.html", "/b/config.yaml", "/b/", "/b", "/s", "/.hidden/report.html", "/b/report.html%00",
           "/deep/er/still/report.html", "/latest/report.html", "*", "/%ff"]  # fmt: skip


def test_no_path_leaves_the_folder(served, runs):
    outside = runs.parent / "outside"
    (runs / "link").symlink_to(outside)
    (outside / "manifest.json").write_text((runs / "b" / "manifest.json").read_text())
    for name in ("c", "d", "e"):
        shutil.copytree(runs / "a <b>", runs / name)
    (runs / "e" / "later").symlink_to(outside / "later")
    (runs / "c" / "report.html").unlink()
    (runs / "c" / "report.html").symlink_to(outside / "report.html")
    (runs / "d" / "config.yaml").unlink()
    (runs / "d" / "config.yaml").symlink_to(outside / "report.html")
    for name in (".hidden", "deep/er/still"):
        shutil.copytree(runs / "a <b>", runs / name)
    (runs / "latest").symlink_to("a <b>")
    for path in OUTSIDE:
        answer, text = ask(served, path)
        assert answer.status == 404, path
        assert SECRET not in text, path
    _, text = ask(served)
    assert text.count(">compare</a>") == 3  # the folders above are not listed
    assert {run.name for run in serve.find_served(runs)} == {"a <b>", "b", "s", "s/rate=1-seed=0"}


def test_nothing_is_changed(served, runs):
    """Not even the status of a run whose process has ended."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    holder = vars(Holder.here(True)) | {"pid": gone.pid}
    change_manifest(runs / "b", status="running", process=holder)
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in runs.rglob("*") if path.is_file()}
    assert ">interrupted</" in ask(served)[1].replace("</div>", "</")
    assert ask(served, "/compare?run=b&run=a+%3Cb%3E")[0].status == 200
    after = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in runs.rglob("*") if path.is_file()}
    assert after == before


@pytest.mark.parametrize("name", ["a <b>", "s"])
def test_the_folder_may_be_one_run_or_sweep(runs, name):
    (page,) = (each for each in serve.find_served(runs / name) if each.file is not None)
    assert (page.name, page.page) == (name, f"/{page.file.name}")
    assert len(serve.find_served(runs / name)) == (1 if name != "s" else 2)


def test_the_newest_run_is_first(served, runs):
    for hour, name in enumerate(("b", "s/rate=1-seed=0", "a <b>")):
        change_manifest(runs / name, started=f"2026-01-02T0{hour}:00:00+00:00")
    _, text = ask(served)
    shown = re.findall(r"/\?with=([^\"]+)", text)
    assert shown == ["a+%3Cb%3E", "s%2Frate%3D1-seed%3D0", "b"]


def test_names_need_not_be_utf_8(served, runs):
    os.rename(runs / "a <b>", os.fsencode(runs) + b"/\xff")
    _, text = ask(served)
    assert 'href="/%FF/report.html"' in text
    assert ask(served, "/%FF/report.html")[0].status == 200
    assert 'href="/?with=%FF"' in text
    assert ask(served, "/compare?run=%FF&run=b")[0].status == 200


def test_it_listens_on_this_machine_alone(runs):
    with serve.make_server(runs, 0) as server:
        assert server.server_address[0] == "127.0.0.1"


def test_damage_is_one_line(served, runs):
    (runs / "b").rename(runs / "ä€")
    (runs / "ä€" / "metrics.jsonl").write_text("damaged\n")
    assert ask(served)[0].status == 200
    address = f"/compare?run={quote('ä€')}&run=a+%3Cb%3E"
    assert ask(served, address)[0].status == 200  # without the line
    (runs / "ä€" / "metrics.jsonl").unlink()
    (runs / "ä€" / "metrics.jsonl").mkdir()
    assert ask(served)[0].status == 200
    answer, text = ask(served, address)
    assert answer.status == 500
    assert re.search(r"Error code explanation: .*metrics\.jsonl: ", text)


def test_one_bad_folder_leaves_the_others(served, runs):
    """Folders with damaged files, and links that form a loop."""
    for name, line in {
        "null": '{"iteration": null, "loss": 1}', "words": '{"iteration": "3", "loss": {}}', "list": "[1]",
        "nest": "[" * 50_000, "huge": '{"iteration": Infinity, "parameter_rmse": NaN}', "flag": '{"loss": true}',
    }.items():  # fmt: skip
        shutil.copytree(runs / "b", runs / name)
        (runs / name / "metrics.jsonl").write_text(line + "\n")
        change_manifest(runs / name, status=[name], started={"a": 1}, process=[3], results=["no"], views=7)
    shutil.copytree(runs / "b", runs / "loop")
    for name, other in (("one", "two"), ("two", "one")):
        (runs / "loop" / name).symlink_to(other)
    answer, text = ask(served)
    assert answer.status == 200
    assert text.count(">compare</a>") == 9
    assert "/loop/" not in text
    answer, text = ask(served, "/compare?run=null&run=b")
    assert (answer.status, "is not iterable" in text) == (500, True)
    assert ask(served)[0].status == 200


@pytest.mark.parametrize("line", [b"GET http://[/ HTTP/1.1", b"GET //[::1 HTTP/1.1", b"GET /?with=%ff%00[ HTTP/1.0"])
def test_an_odd_address_has_no_page(served, line, capfd):
    with socket.create_connection(("127.0.0.1", served), timeout=20) as connection:
        connection.sendall(line + b"\r\nHost: localhost\r\n\r\n")
        status = connection.makefile("rb").readline()
    assert status.split()[1] in (b"404", b"200")
    assert capfd.readouterr().err == ""


def test_a_browser_that_leaves_is_no_error(served, capfd, monkeypatch):
    left, seen = threading.Event(), threading.Event()

    def page(self):
        left.wait(20)
        return b"x" * 2**24

    finish = serve._Server.shutdown_request
    monkeypatch.setattr(serve._Handler, "_page", page)
    monkeypatch.setattr(serve._Server, "shutdown_request", lambda *given: (finish(*given), seen.set())[0])
    with socket.create_connection(("127.0.0.1", served)) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # a reset
    left.set()
    assert seen.wait(20)
    assert capfd.readouterr().err == ""


def test_a_silent_connection_is_closed(served, monkeypatch):
    """Otherwise each connection would keep a thread for ever."""
    assert 1 <= serve._Handler.timeout <= 60
    monkeypatch.setattr(serve._Handler, "timeout", 0.1)
    with socket.create_connection(("127.0.0.1", served), timeout=20) as connection:
        assert connection.recv(100) == b""


def test_pages_are_drawn_one_at_a_time(served, monkeypatch):
    from reslrb_cli.report.page import compare

    at_work, most = [], []

    def parts(shown):
        at_work.append(1)
        most.append(len(at_work))
        time.sleep(0.1)
        at_work.pop()
        return {}

    monkeypatch.setattr(compare, "compare_parts", parts)
    address = "/compare?run=b&run=a+%3Cb%3E"
    threads = [threading.Thread(target=ask, args=(served, address)) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert most == [1, 1, 1]


def test_a_page_that_becomes_a_link_is_not_followed(served, runs, monkeypatch):
    """Between the search for pages and the reading of one."""
    find = serve.find_served

    def turning(root):
        found = find(root)
        (runs / "a <b>" / "report.html").unlink(missing_ok=True)
        (runs / "a <b>" / "report.html").symlink_to(runs.parent / "outside" / "report.html")
        return found

    monkeypatch.setattr(serve, "find_served", turning)
    answer, text = ask(served, "/a%20%3Cb%3E/report.html")
    assert answer.status == 500
    assert SECRET not in text


def test_the_command(llvm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "runs: no such file or folder; give the folder that contains the run folders" in reslrb("serve").output
    Path("runs").mkdir()
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        result = reslrb("serve", "--port", other.getsockname()[1])
    assert result.exit_code == 2
    assert "--port: " in result.output
    assert "in use; give another port, or 0 for a free one" in result.output
    shown = tiny.start(tmp_path, "--port", "0", command="serve", config=False)
    try:
        line = shown.stdout.readline()
        assert line.startswith("http://127.0.0.1:")
        assert "No run yet." in ask(int(line.split("/")[2].rpartition(":")[2]))[1]
    finally:
        shown.terminate()
    assert (shown.wait(30), shown.stderr.read()) == (130, "interrupted\n")


# --- in a browser -----------------------------------------------------------------------------------------------------


def test_the_pages_in_a_browser(served, runs, chromium, monkeypatch):
    """Links lead to the pages and back, nothing is blocked, and a list that reloads keeps its place."""
    monkeypatch.setattr(page_module, "REFRESH_SECONDS", 0.4)
    for number in range(30):
        make_run(runs / f"more-{number}", iterations=1)
    address = f"http://127.0.0.1:{served}/"
    chromium.open(address, 1280)
    chromium.evaluate("scrollTo(0, 500)")
    loaded = "document.readyState == 'complete'"
    for _ in range(2):
        chromium.evaluate("window.seen = 1")
        assert chromium.wait_for(f"window.seen != 1 && {loaded} && scrollY == 500", PATIENCE)
    monkeypatch.setattr(page_module, "REFRESH_SECONDS", 3600)  # no page reloads while its links are clicked
    assert chromium.wait_for(f"document.body?.dataset.reload == 3600 && {loaded}", PATIENCE)
    click = "[...document.querySelectorAll('a')].find(a => decodeURI(a.href).includes('%s')).click()"
    chromium.evaluate(click % "with=b")
    assert chromium.wait_for(f"document.body?.textContent.includes('to compare with b') && {loaded}", PATIENCE)
    chromium.evaluate(click % "run=a")
    assert chromium.wait_for(f"document.querySelectorAll('svg').length == 4 && {loaded}", PATIENCE)
    assert chromium.evaluate("[...document.images].every(i => i.complete && i.naturalWidth > 0)")
    assert chromium.evaluate("document.images.length") >= 4
    assert chromium.evaluate("document.documentElement.scrollWidth") <= 1280
    chromium.open(address + "a%20%3Cb%3E/report.html", 1280)
    assert chromium.evaluate("document.querySelectorAll('.compare').length") == 1  # the script of the page runs
    assert [event for event in chromium.events if event["method"] == "Log.entryAdded"] == []
