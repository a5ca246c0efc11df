"""Output that cannot be written ends nothing, says nothing, and changes no exit code."""

from __future__ import annotations

import errno
import io
import logging
import os
import subprocess
import sys
from pathlib import Path

import click
import pytest
from compilation import search_path

from reslrb_cli.cli import _Main, main
from reslrb_cli.cli.terminal import Forgiving, forgiving_output

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = "from reslrb_cli.cli import main; main(prog_name='reslrb')"


class Failing(io.StringIO):
    """A stream that fails with `error` whenever something is written or flushed."""

    def __init__(self, error: Exception) -> None:
        super().__init__()
        self.error = error

    def write(self, text: str) -> int:
        raise self.error

    def flush(self) -> None:
        raise self.error


FAILURES = [BrokenPipeError(errno.EPIPE, "Broken pipe"), OSError(errno.ENOSPC, "full"), OSError(errno.EIO, "hung up"),
            ValueError("I/O operation on closed file")]  # fmt: skip


@pytest.mark.parametrize("failure", [*FAILURES, None], ids=str)
def test_a_command_does_not_see_that_its_streams_fail(monkeypatch: pytest.MonkeyPatch, failure: Exception) -> None:
    seen = []

    @click.command("talking")
    def command() -> int:
        from tqdm import tqdm

        logging.getLogger("reslrb_cli").warning("a line in the log")
        for stream in (sys.stdout, sys.stderr):
            click.echo("a line", file=stream)
            print("another", file=stream, flush=True)
            with tqdm(total=2, file=stream) as bar:
                bar.update()
                bar.refresh()
        seen.append("the end")
        return 5

    monkeypatch.setattr(_Main, "get_command", lambda *_args: command)
    monkeypatch.setattr(sys, "stdout", None if failure is None else Failing(failure))
    monkeypatch.setattr(sys, "stderr", None if failure is None else Failing(failure))
    before = sys.stdout, sys.stderr
    with pytest.raises(SystemExit) as end:
        main(["talking"])
    assert end.value.code == 5
    assert seen == ["the end"]
    assert (sys.stdout, sys.stderr) == before


def test_the_last_line_of_an_error_may_fail_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Failing(FAILURES[0]))
    with pytest.raises(SystemExit) as end:
        main(["no such command"])
    assert end.value.code == 2


def test_what_can_be_written_is_written(capsys: pytest.CaptureFixture[str]) -> None:
    with forgiving_output():
        click.echo("to one")
        click.echo("to the other", err=True)
    assert capsys.readouterr() == ("to one\n", "to the other\n")


def test_characters_that_the_stream_lacks_are_spelled_out() -> None:
    raw = io.BytesIO()
    stream = Forgiving(io.TextIOWrapper(raw, encoding="ascii"))
    stream.write("runs/ü\udcff\n")
    stream.flush()
    assert raw.getvalue() == b"runs/\\xfc\\udcff\n"


def test_a_stream_without_a_terminal_is_none() -> None:
    closed = io.StringIO()
    closed.close()
    assert not Forgiving(None).isatty()
    assert not Forgiving(closed).isatty()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("streams", ["2>&-", ">&-", "<&- >&- 2>&-", ">/dev/full", "2>/dev/full", ">/dev/full 2>&1"])
@pytest.mark.parametrize(("arguments", "code"), [("--version", 0), ("--nope", 2)])
def test_python_has_nothing_to_add_at_its_end(tmp_path: Path, streams: str, arguments: str, code: int) -> None:
    script = f'"{sys.executable}" -c "{PROGRAM}" {arguments} {streams}'
    environment = {**os.environ, "PYTHONPATH": search_path(ROOT)}
    done = subprocess.run(["sh", "-c", script], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == code
    assert "Exception" not in done.stderr
    assert "Traceback" not in done.stderr


def test_a_reader_that_has_gone_ends_nothing() -> None:
    script = "from reslrb_cli.cli.terminal import forgiving_output\nimport sys\nsys.stdin.read()\n"
    script += (
        "with forgiving_output():\n  for number in range(10000): print(number)\n  print('error', file=sys.stderr)\n"
    )
    environment = {**os.environ, "PYTHONPATH": search_path(ROOT)}
    run = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                           stderr=subprocess.PIPE, env=environment)  # fmt: skip
    assert run.stdout is not None
    run.stdout.close()
    _, err = run.communicate()
    assert (run.returncode, err) == (0, b"error\n")


def test_no_file_takes_the_place_of_a_closed_stream(tmp_path: Path) -> None:
    script = "from reslrb_cli.cli.terminal import forgiving_output\n"
    script += f"with forgiving_output(): print(open({str(tmp_path / 'file')!r}, 'w').fileno() > 2)"
    command = f'"{sys.executable}" -c "{script}" 2>&- <&-'
    environment = {**os.environ, "PYTHONPATH": search_path(ROOT)}
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, env=environment, check=False)
    assert done.stdout == "True\n"
