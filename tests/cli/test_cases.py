"""Results of functions of the command line, as a table of cases (`said.check`)."""

from __future__ import annotations

import importlib
import itertools
import json
import os
import signal
import sys
import threading
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np
import pytest
from cli.tiny import reslrb, write_experiment
from golden.cases import Cases, ending

from reslrb_cli import cli, errors
from reslrb_cli.cli import (
    bench,
    convergence,
    example,
    gradcheck,
    init,
    jobs,
    optimize,
    options,
    render,
    sweep,
    terminal,
)
from reslrb_cli.records import checkpoint
from reslrb_cli.records.manifest import PROGRAM
from reslrb_cli.records.measurements import BenchStatus, MissingRecord
from reslrb_cli.scene.catalog import Value

Patch = pytest.MonkeyPatch
case = Cases()


def proposals(count: int, first: int, kind: str = "bsdf") -> list[Any]:
    found = []
    for n in range(count):
        value = Value([0.1 * n], 0.1 * n, 0.1 * n, 0.1 * n)
        info = SimpleNamespace(key=f"a{n}.b", kind=kind, value=value, shape=(), remark="odd" if n == 1 else None)
        bounds, size = ("[0, 1]", (4, 3)) if n % 2 else (None, None)
        found.append(
            SimpleNamespace(
                key=info.key, info=info, share=0.5 / (n + 1), bounds=bounds, resolution=size, first=n < first
            )
        )
    return found


@case
def first_configurations(patch: Patch) -> Any:
    """Whole texts, with each of the values changed alone."""
    plain: dict[str, Any] = {
        "options": {}, "variables": {}, "sensors": ["camera"], "sensor": 0, "proposals": proposals(2, 1),
        "movable": [], "scene": Path("x/scene.xml"), "target": Path("photo.exr"), "variant": "auto", "is_raw": False,
        "is_integer": False, "size": (8, 6), "film": (8, 6), "reason": None, "hides_emitters": False, "depth": 5,
        "missing": 0.0,
    }  # fmt: skip
    long = {f"v{n}": str(n) for n in range(9)}
    moved = [(f"s {n}", 0.25, "a\nb.ply" if n else "", "translation") for n in range(2)]
    changes: list[dict[str, Any]] = [
        {}, {"variant": "llvm_ad_mono"}, {"options": {"a": True, "b": 3}, "variables": {"a": "true", "b": "3"}},
        {"variables": {"a": "x" * 37, "b": "x" * 38}}, {"variables": dict([*long.items()][:8])}, {"variables": long},
        {"options": {"v0": 1}, "variables": long}, {"size": (4, 3)}, {"sensors": ["a", "b c"], "sensor": 1},
        {"sensors": list("abcdef")}, {"sensors": list("abcdefg")}, {"target": None},
        {"target": None, "sensors": ["a", "b"]}, {"is_integer": True}, {"is_integer": True, "is_raw": True},
        {"is_raw": True}, {"proposals": proposals(2, 1, "emitter")},
        {"is_integer": True, "proposals": [*proposals(2, 2), *proposals(1, 1, "emitter")]},
        {"is_integer": True, "proposals": proposals(2, 1, "emitter")}, {"proposals": proposals(62, 2)},
        {"proposals": proposals(63, 2)}, {"movable": moved}, {"reason": "a reason"}, {"hides_emitters": True},
        {"hides_emitters": True, "target": None}, {"missing": 0.2}, {"depth": 2},
    ]  # fmt: skip
    first = init._first_config(Path("c.yaml"), **plain).splitlines()
    found = [first]
    for change in changes[1:]:
        lines = init._first_config(Path("c.yaml"), **plain | change).splitlines()
        new, gone = ([line for line in a if line not in b] for a, b in ((lines, first), (first, lines)))
        found.append([sorted(change), new, gone])
    return found


@case
def sizes_of_first_configurations(patch: Patch) -> Any:
    found = []
    photos = (None, (100, 100), (1000, 990), (1000, 980), (1010, 1000), (400, 201), (3000, 2000))
    films = ((100, 100, False), (200, 100, False), (99, 100, False), (200, 100, True))
    for (width, height, fixed), size in itertools.product(films, photos):
        film = width, height
        photo: Any = size and SimpleNamespace(size=size, path=Path("p.png"))
        found.append([film, size, fixed, ending(init.choose_size, film, photo, fixed)])
    return found


@case
def suites_of_gradcheck(patch: Patch) -> Any:
    """Cases by name, left out, interrupted and failing."""
    rows = {"holds": [SimpleNamespace(z_max=2.5, relative_l2=1e-6, relative_l2_limit=1e-3, holds=True)] * 2,
            "open": [SimpleNamespace(z_max=None, relative_l2=None, relative_l2_limit=None, holds=None)],
            "fails": [SimpleNamespace(z_max=1.5, relative_l2=None, relative_l2_limit=1e-3, holds=False)],
            "mixed": [SimpleNamespace(z_max=9.0, relative_l2=0.5, relative_l2_limit=None, holds=each)
                      for each in (True, None)]}  # fmt: skip
    texts = ("reslrb:stack", "reslrb:stack(paths=both),reslrb:auto", "reslrb:stack(guiding=on)", "ptracer", "x")
    found = [[name, gradcheck._case_line(name, each), gradcheck._exit_code(each)] for name, each in rows.items()]
    return found, [ending(gradcheck._estimators, text) for text in texts]


class Notes:
    """Stand-in of a `Keeper` and of `Interrupts` that notes how files are completed."""

    def __init__(self, requested: bool) -> None:
        self.requested, self.done = requested, list[Any]()

    def __enter__(self) -> Notes:
        return self

    def __exit__(self, *_: object) -> None:
        self.done.append("left")

    def refresh(self) -> None:
        self.done.append("refresh")

    def finish(self, interrupted: bool) -> None:
        self.done.append(["finish", interrupted])


@case
def files_of_gradcheck(patch: Patch) -> Any:
    """An interrupted measurement says so to its file, of all records, of a suite and of missing shares."""
    found: list[Any] = []
    row = SimpleNamespace(z_max=2.5, relative_l2=None, relative_l2_limit=None, holds=True)
    patch.setattr(gradcheck, "echo", lambda line: found.append(str(line)[:60]))
    patch.setattr(gradcheck, "origin_of", lambda variant: variant)
    patch.setattr(gradcheck, "set_variant", lambda name: name)
    patch.setattr(gradcheck, "device_name", lambda name: f"device of {name}")
    patch.setattr("reslrb_cli.report.tables.summary_lines", lambda records: [f"{len(records)} records"])
    patch.setattr("reslrb_cli.report.tables.gradcheck_columns", lambda records: SimpleNamespace(head=lambda: "head"))
    missing = MissingRecord("c", "k", 0.25, 0.01, 2, 8)
    check: Any = SimpleNamespace(run=lambda stop, say, refresh: refresh() or [], records=lambda interrupted: [])
    measured = SimpleNamespace(conditions=lambda: "conditions", keys=["a", "b"], source="c.yaml",
                               measured=lambda *given, **more: missing)  # fmt: skip
    patch.setattr("reslrb_cli.measure.missing.MissingCheck.of_config", lambda config, spp: measured)
    patch.setattr("reslrb_cli.measure.extreme.case_records", lambda stop, name, chosen, seeds: [row])
    importlib.import_module("reslrb_cli.measure.scenes.catalogue")  # with the true module
    patch.setitem(sys.modules, "mitsuba", SimpleNamespace(is_spectral=False))
    for requested in (False, True):
        notes = Notes(requested)
        patch.setattr(gradcheck, "Interrupts", lambda notes=notes: notes)
        patch.setattr(gradcheck, "Keeper", lambda *given, notes=notes: notes)
        asked: Any = SimpleNamespace(json_file=None, spp=None, seeds=4, budget=1.0, integrators=None)
        asked.suite, asked.config = "extreme:a,b", lambda: SimpleNamespace(variant="llvm_ad_rgb")
        patch.setattr("reslrb_cli.measure.extreme.CASES", {"a": SimpleNamespace(), "b": SimpleNamespace()})
        found.append(gradcheck._run(check, "v", asked)[1])
        found.append(int(gradcheck.run_missing(asked, None, "v")))  # type: ignore[arg-type]
        found.append(int(gradcheck.run_suite(asked)))
        found.append(notes.done)
    return found


@case
def runs_at_once(patch: Patch) -> Any:
    """What slots hold while runs are at work and after their ends, and when another run may start."""
    patch.setattr(jobs.os, "sched_getaffinity", lambda process: {0, 1}, raising=False)
    patch.setattr(jobs, "_bound", lambda slot, call: call(slot))
    found: list[Any] = []
    for free in (100, 10000):
        patch.setattr(jobs, "free_bytes", lambda variant, free=free: free)
        go_on = threading.Event()

        def work(slot: Any, go_on: Any = go_on) -> tuple[int, str]:
            slot.line, slot.peak, slot.resident = "1/2: ", 2000, 1500
            go_on.wait(20)
            return 0, "finished"

        with jobs.Jobs(2, "llvm_ad_rgb") as at_once:
            found.append([at_once.number, at_once.busy, at_once.may_start()])
            at_once.start("a", work)
            while not at_once.slots[1].line:
                time.sleep(0.001)
            found.append([at_once.busy, at_once.may_start(), list(at_once.ended())])
            go_on.set()
            while not (ended := list(at_once.ended())):
                pass
            slots = [[slot.line, slot.peak, slot.resident, slot.must_end] for slot in at_once.slots]
            found.append([ended, slots, at_once.busy, at_once.may_start(), at_once._peak])
        found.append([slot.must_end for slot in at_once.slots])
    return found


@case
def exit_codes_of_comparisons(patch: Patch) -> Any:
    memory, states = {BenchStatus.OUT_OF_MEMORY}, list(BenchStatus)
    return [[interrupted, done, sorted(map(str, each)), int(options.exit_code(interrupted, done, each))]
            for interrupted in (False, True) for done in (False, True)
            for each in (set(), memory, memory | {states[0]}, {states[0]})]  # fmt: skip


def parsed(kind: Any, text: Any) -> Any:
    """Return the value of an option, or why it is refused."""
    try:
        return kind.convert(text, None, None)
    except click.ClickException as error:
        return error.format_message()


@case
def values_of_options(patch: Patch) -> Any:
    counts = ("4", "4,16", "4,4", "0", "1", "-1", "", "4,", "x", "2147483647", "2147483648", "4, 8", "4.5")
    factors = ("auto", "0", "-1", "1e-9", "inf", "nan", "x", "", "2.5")
    found = [[text, parsed(options.Counts(), text)] for text in counts]
    return [*found, *([text, parsed(render.ExposureType(), text)] for text in factors)]


@case
def results_of_sweeps(patch: Patch) -> Any:
    """The device is that of the first run."""
    patch.setattr("reslrb_cli.report.page.sweep.run_records", lambda source: ["run"])
    patch.setattr("reslrb_cli.report.page.sweep.row_records", lambda plan, runs: ["row", plan, *runs])
    patch.setattr("reslrb_cli.report.page.sweep.best_records", lambda plan, runs: ["best", plan, *runs])
    found = []
    for manifests in ([], [{}], [{"device": "d", "variant": "v"}, {"device": "e", "variant": "w"}]):
        runs = {str(n): SimpleNamespace(manifest=each) for n, each in enumerate(manifests)}
        origin, *others = sweep._results(SimpleNamespace(runs=runs, sweep="plan"))  # type: ignore[arg-type]
        found.append([origin.device, origin.variant, others])  # type: ignore[attr-defined]
    return found


@pytest.mark.usefixtures("llvm")
@case
def signals_that_count(patch: Patch) -> Any:
    """Other signals count nothing, the same one counts once within `SAME_S`, and too many end the process."""
    found: list[Any] = []
    clock = SimpleNamespace(now=0.0)
    patch.setattr(terminal, "time", SimpleNamespace(monotonic=lambda: clock.now))
    patch.setattr(terminal, "_say", found.append)
    for tolerated in (0, 1, 2):
        found.append(f"{tolerated} tolerated")
        interrupts = terminal.Interrupts(tolerated, notice="stopping")
        interrupts._before = dict.fromkeys(terminal.SIGNALS)
        patch.setattr(interrupts, "_end", lambda: found.append("end"))
        numbers = [signal.SIGUSR1, signal.SIGINT, signal.SIGINT, signal.SIGTERM, signal.SIGCHLD, signal.SIGTERM]
        for sent, now in zip(numbers, (10.0, 11.0, 11.0 + terminal.SAME_S / 2, 11.2, 15.0, 19.0), strict=True):
            read, write = interrupts._pipe = os.pipe()
            os.write(write, bytes([sent]) + terminal._LEAVE)
            clock.now = now
            interrupts._watch()
            os.close(read)
            os.close(write)
            found.append([sent.name, now, interrupts.requested, interrupts._count])
    return found


@case
def descriptors_of_contexts(patch: Patch) -> Any:
    """Who is told of signals, in contexts within each other, and after `ignore`; descriptors and handlers that stay."""

    def state(*contexts: Any) -> list[Any]:
        now = signal.set_wakeup_fd(-1)
        signal.set_wakeup_fd(now, warn_on_full_buffer=False)
        pipes = [context._pipe and context._pipe[1] for context in contexts]
        kept = [signal.getsignal(number) == before for number, before in handlers.items()]
        alive = [context._thread.is_alive() for context in contexts]
        return ["program" if now == own[1] else pipes.index(now) if now in pipes else now, kept, alive]

    handlers = {number: signal.getsignal(number) for number in terminal.SIGNALS}
    own = os.pipe()
    os.set_blocking(own[1], False)
    earlier = signal.set_wakeup_fd(own[1], warn_on_full_buffer=False)
    found, closed, close = list[Any](), list[int](), os.close
    patch.setattr(os, "close", lambda descriptor: closed.append(descriptor) or close(descriptor))  # type: ignore
    try:
        for ignores in (False, True):
            outer, inner = terminal.Interrupts(), terminal.Interrupts()
            with outer:
                found.append(state(outer, inner))
                with inner:
                    pipes = [*(outer._pipe or ()), *(inner._pipe or ())]
                    found.append(state(outer, inner))
                    if ignores:
                        inner.ignore()
                        found.append(state(outer, inner))
                found.append(state(outer, inner))
            found.append([*state(outer, inner), [pipe in closed for pipe in pipes]])
            closed.clear()
        return found
    finally:
        signal.set_wakeup_fd(earlier)
        for descriptor in own:
            os.close(descriptor)
        for number, before in handlers.items():
            signal.signal(number, before)


@case
def last_acts_of_commands(patch: Patch) -> Any:
    """What the contexts of commands do at the end of the process."""
    found: list[Any] = []

    def begin(*given: Any, **named: Any) -> Any:
        found.append([given, {name: getattr(each, "__name__", each) for name, each in named.items()}])
        raise KeyboardInterrupt

    plan: Any = SimpleNamespace(device="device", variant="v", budget_s=1.0, rounds=None)
    asked: Any = SimpleNamespace(json_file=None, spp=None, seeds=4, budget=1.0, integrators=None, suite="extreme:a",
                                 config=lambda: SimpleNamespace(variant="v"))  # fmt: skip
    measured = SimpleNamespace(conditions=lambda: "conditions", keys=["a"])
    patch.setattr("reslrb_cli.measure.missing.MissingCheck.of_config", lambda config, spp: measured)
    patch.setattr("reslrb_cli.measure.extreme.CASES", {"a": SimpleNamespace()})
    for name in ("origin_of", "set_variant", "device_name"):
        patch.setattr(gradcheck, name, str)
    for module in (gradcheck, options, cli):
        patch.setattr(module, "Interrupts", begin)
    for call in (
        lambda: options.measuring(SimpleNamespace, plan, 0.0).__enter__(),  # type: ignore[attr-defined]
        lambda: gradcheck._run(asked, "v", asked), lambda: gradcheck.run_missing(asked, None, "v"),  # type: ignore
        lambda: gradcheck.run_suite(asked), cli.run,
    ):  # fmt: skip
        with pytest.raises(KeyboardInterrupt):
            call()
    return found


@case
def settings_of_commands(patch: Patch) -> Any:
    """Every command with `--set` applies it to each kind of subject: a scene, a configuration and a run."""
    write_experiment(Path())
    Path("run/checkpoint").mkdir(parents=True)
    checkpoint.save_checkpoint(Path("run/checkpoint"), 2, {"parameter/a.b": np.ones(3)})
    Path("run/config.yaml").write_text(Path("tiny.yaml").read_text())
    Path("run/manifest.json").write_text(json.dumps({"program": PROGRAM, "status": "finished"}))
    found, context = [], click.Context(cli.main)
    for name in cli.main.list_commands(context):
        command = cli.main.get_command(context, name)
        assert command is not None
        by_name = {each.name: each for each in command.params}
        if "overrides" not in by_name:
            continue
        more = {"init": ["-o", "out.yaml"], "render": ["-o", "x.exr"], "export": ["-o", "out"],
                "sweep": ["--vary", "run.spp=[4]"]}.get(name, [])  # fmt: skip
        for subject in ("scene.xml", "tiny.yaml", "run"):
            result = reslrb(name, subject, *more, "--set", "run.nothing=1")
            found.append([name, subject, result.exit_code, result.stderr.splitlines()[-1][:70]])
    return found


@case
def files_of_comparisons(patch: Patch) -> Any:
    """The file grows with each round, and an interrupted measurement says so to it."""
    found: list[Any] = []
    rows = [SimpleNamespace(method=SimpleNamespace(spp=spp, max_depth=3, label="m"), message=why)
            for spp, why in ((2, ""), (4, "why"))]  # fmt: skip
    columns = SimpleNamespace(head=lambda: "head", line=lambda cells: f"line {cells}")
    plan: Any = SimpleNamespace(cases=[SimpleNamespace(label="m")], variant="v", swept="spp")
    patch.setattr("reslrb_cli.report.tables.bench_columns", lambda labels, swept: columns)
    patch.setattr("reslrb_cli.report.tables.bench_cells", lambda record, value: value)
    patch.setattr("reslrb_cli.report.tables.method_cells", lambda overall, rounds: (overall, rounds))
    patch.setattr("reslrb_cli.measure.judgement.Judgement", Judged)
    patch.setattr(convergence, "_table", lambda session: columns)
    for module in (bench, convergence):
        patch.setattr(module, "origin_of", str)
        patch.setattr(module, "_conditions", lambda *given: "conditions")
        patch.setattr(module, "echo", lambda line: found.append(line))
    members = [SimpleNamespace(status=status) for status in (BenchStatus.OK, BenchStatus.REFUSED)]
    for requested in (False, True):
        notes = Notes(requested)
        notes.done = found
        for module, steps in ((bench, [rows[:1], rows[1:], rows]), (convergence, [1, 3, 4, 5, 6, 8])):
            session = SimpleNamespace(run=lambda steps=steps: steps, results=lambda: "results",
                                      of=lambda kind: members, facts={})  # fmt: skip
            opened = nullcontext((session, notes))
            patch.setattr(module, "measuring", lambda *given, opened=opened, **more: opened)
            patch.setattr(module, "Keeper", lambda *given, notes=notes: notes)
        for plan.swept in ("spp", "max_depth"):
            found.append(bench._run(plan, None, 0.0))
        asked: Any = SimpleNamespace(json_file=None, draws=None)
        with pytest.raises(KeyboardInterrupt):
            convergence._run(plan, asked, 0.0)
    return found


@case
def copied_examples(patch: Patch) -> Any:
    """Into a new folder, into one that has a file of that name, and into a file."""
    known = [*example.examples().values()]
    path = min(known, key=lambda each: len(each.read_text()))
    Path("file").touch()
    Path("taken/scenes").mkdir(parents=True)
    Path("taken", path.name).touch()
    Path("linked").mkdir()
    Path("linked", path.name).symlink_to("gone")
    ends = [ending(lambda name=name: str(example.copy(path, Path(name)))) for name in ("new/deep", "taken", "file",
                                                                                       "linked")]  # fmt: skip
    copies = {str(each): each.stat().st_size > 0 for each in sorted(Path("new").rglob("*")) if each.is_file()}
    return ends, copies, [line for line in Path("new/deep", path.name).read_text().splitlines() if "scenes" in line]


@case
def resumed_runs(patch: Patch) -> Any:
    """All that happens before a run continues, with and without workers, and if it is complete."""
    found: list[Any] = []

    def noted(name: str, result: Any = None) -> Any:
        return lambda *given: (found.append([name, *given]), result)[1]

    for name, result in (("echo", None), ("_check_shards", None), ("start_variant", "v"), ("_callbacks", ["c"]),
                         ("_run", 0)):  # fmt: skip
        patch.setattr(optimize, name, noted(name, result))
    patch.setattr(optimize.logger, "info", noted("info"))
    config = SimpleNamespace(run=SimpleNamespace(iterations=9), model_copy=lambda update: ["config with", update])
    given: Any = SimpleNamespace(overrides=["o"], allow_code=True, quiet=True)
    for is_done, workers in ((True, None), (False, None), (False, SimpleNamespace(check=noted("workers")))):
        earlier = SimpleNamespace(
            is_done=is_done, done_line=lambda *words: words, settled=SimpleNamespace(variant="stored"), iteration=4,
            config=SimpleNamespace(with_code=lambda allowed: (found.append(allowed), config)[1]),
            begin=lambda variant, *tell: ["begun", variant, len(tell)],
        )  # fmt: skip
        patch.setattr("reslrb_cli.runs.resume.open_earlier", lambda *given, made=earlier: nullcontext(made))
        found.append(optimize._resume(Path("run"), given, workers))
    return [[str(part).split("(")[0] for part in each] if isinstance(each, list) else each for each in found]


@case
def code_of_measurements(patch: Patch) -> Any:
    """Own losses run only if a measurement needs them, and the user permits it."""
    write_experiment(Path())
    Path("own.py").write_text("import mitsuba as mi\n\ndef own(image):\n    return image\n")

    def end(*given: Any, **more: Any) -> Any:
        raise errors.ConfigError("measured", "", "nothing")

    patch.setattr(convergence, "convergence_plan", end)
    patch.setattr("reslrb_cli.measure.missing.MissingCheck.of_config", end)
    patch.setattr("reslrb_cli.measure.participants.CheckSettings", end)
    found = []
    for words in (["convergence"], ["convergence", "--objective", "loss"], ["convergence", "--objective", "image"],
                  ["gradcheck"], ["gradcheck", "--missing"], ["render", "-o", "x.exr"]):  # fmt: skip
        for allowed in ((), ("--allow-code",)):
            result = reslrb(
                words[0], "tiny.yaml", *words[1:], "--set", "loss={type: custom, file: own.py:own}", *allowed
            )
            found.append([*words, *allowed, result.exit_code, *result.stderr.splitlines()[-1:]])
    return found


class Judged:
    """Stand-in of a `Judgement` that ends the command where the results are read."""

    ready = True

    def __init__(self, session: Any) -> None:
        pass

    def overall(self, member: Any) -> str:
        return str(member.status)

    def results(self) -> Any:
        raise KeyboardInterrupt


test_cases = case.test()
