"""A process that is handed scenes and images that may be wrong, one a line, and says what came of each.

It works in a folder of its own, under a limit of memory. Each line names a command (`scene FILE`, `photo FILE`,
`run FILE`, `resume RUN`), each answer is one JSON object. What ends the process in the midst of a case is seen by who
waits for the answer.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

#: Bytes that a case may have beside what the process has before the first.
ROOM = 6 * 2**30


def limit_memory() -> None:
    """Let the process have no more than it has now, and ROOM."""
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + ROOM
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def call(arguments: Sequence[str]) -> dict[str, object]:
    """`reslrb` with these arguments: exit code, and what it printed to standard error."""
    from reslrb_cli.cli import main

    said = io.StringIO()
    code: object = 0
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        try:
            main(list(arguments), prog_name="reslrb")
        except SystemExit as end:
            code = end.code
        except BaseException:
            import traceback

            traceback.print_exc(file=said)
            code = "traceback"
    return {"code": code, "said": said.getvalue()[-3000:]}


def resume(run: str) -> dict[str, object]:
    """Go on with a run, whose page is not drawn: that takes longer than all else."""
    from unittest.mock import patch

    from reslrb_cli.runs import recorder as recording

    with patch.object(recording, "write_report", lambda folder, *now: None):
        return call(["optimize", "--resume", run, "--quiet"])


def main_loop() -> None:
    """Answer until there are no more questions."""
    import reslrb_cli  # noqa: F401
    from reslrb_cli.backend.variant import set_variant

    answers = os.fdopen(os.dup(1), "w")
    below = tempfile.TemporaryFile()  # noqa: SIM115  # what libraries print themselves, past Python
    for stream in (1, 2):
        os.dup2(below.fileno(), stream)
    set_variant("llvm_ad_rgb")
    limit_memory()
    for line in sys.stdin:
        start = os.fstat(below.fileno()).st_size
        kind, _, name = line.strip().partition(" ")
        if kind == "scene":
            answer = call(["inspect", name, "--no-counts"])
        elif kind == "run":
            answer = call(["optimize", name, "--quiet", "--force"])
        elif kind == "resume":
            answer = resume(name)
        else:
            answer = call(["optimize", "photo.yaml", "--quiet", "--force", "--set", f"target.file={name}"])
        below.seek(start)
        answer["below"] = below.read().decode(errors="surrogateescape")
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main_loop()
