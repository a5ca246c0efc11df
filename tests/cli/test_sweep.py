"""Tests of `reslrb sweep`: its plan, its errors, how it continues after a kill, its table, and which settings it
distinguishes.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli import tiny
from cli.tiny import reslrb
from click.testing import CliRunner
from kit import count_iterations, wait_for

from reslrb_cli.cli import jobs, main, sweep
from reslrb_cli.cli.optimize import Progress
from reslrb_cli.cli.terminal import Interrupts
from reslrb_cli.config.base import SEED_END
from reslrb_cli.config.files import NAME_BYTES
from reslrb_cli.config.loader import dump, load
from reslrb_cli.errors import ConfigError, ExitCode
from reslrb_cli.records import sweeps as plans_file
from reslrb_cli.records.images import load_image
from reslrb_cli.records.lock import FolderLock
from reslrb_cli.records.sweeps import (
    Combination,
    SweepBestRecord,
    SweepPlan,
    SweepRunRecord,
    SweepSearch,
    in_words,
    read_sweep,
    run_name,
    short_keys,
)
from reslrb_cli.report.page.sweep import best_records, incomparable, lines, notes, row_records, run_records
from reslrb_cli.report.panels import run_panels
from reslrb_cli.report.sources import ShownRun, read_sweep_runs
from reslrb_cli.runs import recorder as recording
from reslrb_cli.runs import sweep as plans
from reslrb_cli.runs.sweep import make_plan

#: Settings for very short runs, and the record entries that differ even between two equal runs.
QUICK = ("run.measuring=0", "run.certainty=false", "run.final_spp=4", "run.checkpoint_every={iterations: 2}")
TIMES = ("elapsed_s", "peak_mib")
RATES = "optimizer.learning_rate=[0.02, 0.2]"


@pytest.fixture
def folder(llvm, tmp_path, monkeypatch):
    """Working directory with `tiny.yaml`. Runs are called in this process and write no real report pages."""
    tiny.write_experiment(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(recording, "write_report", lambda folder, *now: (folder / "report.html").write_text("<html>"))
    monkeypatch.setattr(recording, "seen_errors", lambda *about: {})
    monkeypatch.setattr(sweep, "call", call)
    return tmp_path


def call(arguments, interrupts, slot, fresh=False):
    """Call the command in this process, in place of `sweep.call`."""
    result = CliRunner().invoke(main, list(arguments))
    return result.exit_code, result.output.strip().splitlines()[-1]


def made(*arguments, seeds=2):
    """Return the plan that varies the settings of `tiny.yaml` given by `arguments`."""
    return make_plan(Path("tiny.yaml"), arguments, seeds, [])


def table(folder):
    """Return the rows of the table without times and memory, and the printed lines about the lowest medians."""
    source = read_sweep_runs(Path(folder))
    runs = [json.loads(run.to_json()) for run in run_records(source)]
    said = [line for line in lines(source.sweep, run_records(source)) if line.startswith("lowest")]
    return [{key: value for key, value in run.items() if key not in TIMES} for run in runs], said


# --- the plan ---------------------------------------------------------------------------------------------------------


def test_all_combinations_with_all_seeds(folder):
    plan = made("optimizer=[{type: adam, learning_rate: 0.1}, {type: sgd}]", "run.spp=[4, 8, 12]", seeds=4)
    names = [run_name(*run) for run in plan.sweep.runs]
    assert len(names) == len(set(names)) == plan.sweep.size == 2 * 3 * 4
    assert names[0] == "optimizer=adam-learning_rate=0.1-spp=4-seed=0"
    assert names[6] == "optimizer=adam-learning_rate=0.1-spp=4-seed=1"  # all combinations of one seed come first
    assert make_plan(Path("tiny.yaml"), ["run.spp=[4, 8]"], 3, ["run.seed=5"]).sweep.seeds == [5, 6, 7]
    found = {(type(each.optimizer).__name__, each.run.spp) for each in plan.configs.values()}
    assert found == {(kind, spp) for kind in ("Adam", "SGD") for spp in (4, 8, 12)}


def test_integrators_are_varied_as_methods_with_the_depth_of_the_experiment(folder):
    values = "integrator=[prb, 'reslrb:stack(guiding=on,adjoint=independent)', {type: ptracer}]"
    plan = make_plan(Path("tiny.yaml"), [values], 1, ["integrator.max_depth=3", "integrator.rr_depth=2"])
    prb, stack, plain = plan.configs.values()
    for config in (prb, stack):
        assert (config.integrator.max_depth, config.integrator.rr_depth) == (3, 2)
    assert (prb.integrator.type, stack.integrator.type, plain.integrator.type) == ("prb", "reslrb", "ptracer")
    assert (stack.integrator.estimator, stack.integrator.guiding, stack.adjoint) == ("stack", "on", "independent")
    assert plain.integrator.max_depth == 8  # a given section keeps its defaults
    names = ["integrator=prb", "integrator=reslrb-stack-guiding=on-adjoint=independent", "integrator=ptracer"]
    assert list(plan.configs) == names
    depths = make_plan(Path("tiny.yaml"), ["integrator=[prb]", "integrator.max_depth=[2, 3]"], 1, [])
    assert [config.integrator.max_depth for config in depths.configs.values()] == [2, 3]


@pytest.mark.parametrize("varied", ["integrator=[prb, 'reslrb:stack(paths=camera)', {type: ptracer}]",
                                    "integrator.max_depth=[2, 5]", "integrator.paths=[light, both]"])  # fmt: skip
def test_one_target_for_all_integrators(folder, varied):
    """The integrator without `--vary` renders the target, unless the target names one."""
    base, own = load("tiny.yaml", ["integrator.max_depth=4"]), "target.render.integrator={type: prb, max_depth: 7}"
    other = [varied, "run.spp=[4, 8]"]
    for sets, expected in (([], base.integrator), ([own], load("tiny.yaml", [own]).target.render.integrator)):
        plan = make_plan(Path("tiny.yaml"), other, 1, ["integrator.max_depth=4", *sets])
        assert len({dump(each) for each in plan.configs.values()}) == len(plan.configs)
        assert [each.target.render.integrator for each in plan.configs.values()] == [expected] * len(plan.configs)
    assert make_plan(Path("tiny.yaml"), other[1:], 1, []).configs["spp=4"].target.render.integrator is None


def test_names_are_short_safe_and_different(folder):
    keys = ["run.spp", "target.render.spp", "parameters[0].bounds"]
    assert short_keys(keys) == dict(zip(keys, ["run.spp", "render.spp", "bounds"], strict=True))
    assert [in_words(each) for each in (0.1, 0.1234567, 1e-05, True, None, "a, b", [1, 2.5], {"type": "sgd"})] == [
        "0.1", "0.1234567", "1e-05", "true", "null", "'a, b'", "[1, 2.5]", "{type: sgd}",
    ]  # fmt: skip
    nested = {"kind": [1, 2.5], "type": "b", "c": {"d": True}}
    assert plans.named({"optimizer": nested}, []).name == "optimizer=b-kind=1-2.5-c=d=true"
    values = ["0.1, 0.2", "0.1-0.2", "../x", "A", "a", "x" * 500, "x" * 499 + "y", "ä\u202e"]
    text = json.dumps([{"a": value} for value in values], ensure_ascii=False).replace("\u202e", "\\u202e")
    scene = Path("scene.xml")
    scene.write_text(scene.read_text().replace("</scene>", '<string name="unused" value="$a"/></scene>'))
    longest = len(plans._bounded("x" * 500)) + len(f"-{plans.MOST_RUNS}-seed={SEED_END}")
    assert longest == NAME_BYTES
    plan = made(f"scene.options={text}")
    names = [each.name for each in plan.sweep.combinations]
    assert len({name.casefold() for name in names}) == len(values)
    for name in (run_name(*run) for run in plan.sweep.runs):
        assert len(name.encode()) <= 200
        assert name == Path(name).name
        assert not name.startswith(".")


def test_a_folder_has_one_sweep(folder):
    arguments = ["sweep", "tiny.yaml", *tiny.settings(*QUICK), "--vary", "run.iterations=[1]", "-o", "s"]
    Path("s/configs").mkdir(parents=True)
    Path("s/configs/of a sweep that was killed before its plan was whole.yaml").touch()
    tiny.done(*arguments)
    assert "-o: s has a sweep already; `reslrb sweep --resume s` continues it" in reslrb(*arguments).output
    more = tiny.done("sweep", "--resume", "s", "--seeds", 2)
    assert "2 of 2 runs done" in more.output
    assert "--seeds: is 1; the sweep has 2 seeds already" in reslrb("sweep", "--resume", "s", "--seeds", 1).output
    assert "--trials: the sweep in the folder is not a search" in reslrb("sweep", "--resume", "s", "--trials", 3).output
    assert (
        "--seeds: 1 x 1001 seeds: a sweep has at most 1000 runs"
        in reslrb("sweep", "--resume", "s", "--seeds", 1001).output
    )
    assert len(plans._grown(read_sweep(Path("s")), 1000, None).seeds) == 1000
    assert (
        "add only --seeds, --trials, --jobs or --allow-code"
        in reslrb("sweep", "--resume", "s", "--vary", "run.spp=[4]").output
    )


@pytest.mark.parametrize(
    ("number", "code", "line"),
    [
        (errno.ENOSPC, 6, "s: No space left on device; the sweep has stopped"),
        (errno.EACCES, 2, "-o: cannot write to s"),
    ],
)
def test_an_unwritable_folder_is_named(folder, monkeypatch, number, code, line):
    def fail(self, place):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(SweepPlan, "write", fail)
    result = reslrb("sweep", "tiny.yaml", "--vary", "run.spp=[4]", "-o", "s")
    assert (result.exit_code, line in result.output) == (code, True), result.output


def test_the_last_seed_can_be_used(folder):
    def sweep(first):
        return make_plan(Path("tiny.yaml"), ["run.spp=[4]"], 2, [f"run.seed={first}"]).sweep

    kept = sweep(2**32 - 3)
    assert sweep(2**32 - 2).seeds == [2**32 - 2, 2**32 - 1]
    assert plans._grown(kept, 3, None).seeds[-1] == 2**32 - 1
    for make in (lambda: sweep(2**32 - 1), lambda: plans._grown(kept, 4, None)):
        with pytest.raises(ConfigError, match="--seeds"):
            make()


def test_a_run_does_not_replace_other_files(folder):
    """It replaces a run that was killed before its first checkpoint."""
    plan = made("run.spp=[4]", seeds=1).sweep
    name = run_name(*next(plan.runs))
    run = Path("s", name)
    run.mkdir(parents=True)
    with pytest.raises(ConfigError, match=f"{name}: is no run's folder, and a run of the sweep needs the name"):
        plans.command(Path("s"), plan, plan.combinations[0], 0)
    (run / "manifest.json").write_text(json.dumps({"program": "reslrb", "status": "interrupted"}))
    assert plans.command(Path("s"), plan, plan.combinations[0], 0)[:2] == [
        "optimize", str(Path("s/configs/spp=4.yaml").absolute())
    ]  # fmt: skip
    assert not run.exists()


def test_damage_is_located(folder):
    Path("s").mkdir()
    for text in ("{", "[]", '{"seeds": [0]}', "\0"):
        Path("s/sweep.json").write_text(text)
        result = reslrb("sweep", "--resume", "s")
        assert (result.exit_code, result.output[:13]) == (2, "s/sweep.json:"), result.output
    plan = made("run.spp=[4, 8]").sweep
    plan.write(Path("s"))
    content = json.loads(Path("s/sweep.json").read_text())
    for name in ("../elsewhere", "/tmp", "", plan.combinations[1].name):
        content["combinations"][0]["name"] = name
        Path("s/sweep.json").write_text(json.dumps(content))
        if name:
            with pytest.raises(ConfigError, match="no names of folders"):
                read_sweep(Path("s"))
    Path("s/sweep.json").write_text(json.dumps(content | {"version": 99}))
    with pytest.raises(ConfigError, match=r"s/sweep\.json: version: was written by another version, 0"):
        read_sweep(Path("s"))


# --- runs, kills and what is left -------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_killed_sweep_ends_with_the_same_table(folder, monkeypatch):
    """The test copies what a kill would leave at four moments: in the middle of a run, before a run has saved a
    checkpoint, while final images are written, and between two runs.
    """
    show, begin, calls, moments = Progress.show, recording.Recording._begin, [], []
    end = recording.Recording._write_final_images

    def copy(moment):
        moments.append(f"killed-{moment}")
        shutil.copytree("whole", moments[-1])

    def showing(self, record):
        show(self, record)
        if (len(calls), record.iteration) == (2, 2):
            copy("in-a-run")

    def beginning(self):
        if len(calls) == 3:
            shutil.rmtree(self.folder.checkpoint)
            self.folder.checkpoint.mkdir()
            copy("before-a-checkpoint")
        begin(self)

    def ending(self):
        if len(calls) == 3:
            copy("over-final-images")
        end(self)

    def calling(arguments, interrupts, slot, fresh=False):
        calls.append(arguments)
        if len(calls) == 4:
            copy("between-runs")
        return call(arguments, interrupts, slot)

    monkeypatch.setattr(Progress, "show", showing)
    monkeypatch.setattr(recording.Recording, "_begin", beginning)
    monkeypatch.setattr(recording.Recording, "_write_final_images", ending)
    monkeypatch.setattr(sweep, "call", calling)
    words = ["sweep", "tiny.yaml", *tiny.settings(*QUICK), "--vary", RATES, "--seeds", "2"]
    tiny.done(*words, "-o", "whole")
    whole = table("whole")
    assert [run["status"] for run in whole[0]] == ["finished"] * 4
    assert len(moments) == 4
    for left in moments:
        calls[:] = [None] * 10  # nothing is copied from now on
        tiny.done("sweep", "--resume", left)
        assert table(left) == whole, left
        resumed = [words[1] == "--resume" for words in calls[10:]]
        assert (len(resumed), resumed.count(True)) == {
            "killed-in-a-run": (3, 1), "killed-before-a-checkpoint": (2, 0), "killed-between-runs": (1, 0),
            "killed-over-final-images": (2, 1),
        }[left]  # fmt: skip
    calls[:] = [None] * 10
    tiny.done("sweep", "--resume", "whole")
    assert len(calls) == 10  # nothing is done twice


@pytest.mark.long
def test_a_failed_run_is_shown_in_its_row(folder, monkeypatch):
    ends = {"learning_rate=0.02-seed=1": (5, "the loss is not finite"), "learning_rate=0.2-seed=0": (-9, "killed")}
    called = []

    def failing(arguments, interrupts, slot, fresh=False):
        called.append(arguments)
        name = next(word for word in ends if any(word in each for each in arguments)) if any(
            word in each for word in ends for each in arguments) else None  # fmt: skip
        return ends[name] if name else call(arguments, interrupts, slot)

    monkeypatch.setattr(sweep, "call", failing)
    words = ["sweep", "tiny.yaml", *tiny.settings(*QUICK), "--vary", RATES, "--seeds", "2", "-o", "s"]
    result = reslrb(*words)
    assert result.exit_code == 1
    for line in ("1 of 2, 1 failed", "learning_rate=0.02-seed=1 failed: the loss is not finite",
                 "finished, 2 of 4 runs done, 2 failed; look at s/sweep.html; `reslrb sweep --resume s"):  # fmt: skip
        assert line in result.output
    assert "lowest median" not in result.output  # remaining runs of failed combinations are the lucky ones
    kinds = [json.loads(line)["kind"] for line in Path("s/results.jsonl").read_text().splitlines()]
    assert kinds == ["origin", *["sweep_run"] * 4, *["sweep_row"] * 2]
    called.clear()
    ends = {}
    result = reslrb("sweep", "--resume", "s")
    assert (result.exit_code, len(called)) == (0, 2)
    assert "lowest median parameter RMSE: learning_rate=0.02" in result.output


@pytest.mark.parametrize("code", [6, 3, 130])
def test_a_fault_outside_the_run_ends_the_sweep(folder, monkeypatch, code):
    pages = []
    monkeypatch.setattr(
        sweep, "call", lambda *given, **options: (pages.append(Path("s/sweep.html").exists()), (code, "full"))[1]
    )
    result = reslrb("sweep", "tiny.yaml", "--vary", RATES, "-o", "s")
    assert pages == [True]  # before the first run begins
    assert "run 1 of 2: learning_rate=0.02, seed 0\n" in result.output
    assert result.exit_code == code
    assert "--resume s" in result.output or code == 3
    assert read_sweep(Path("s")).failures == {}


def test_ctrl_c_ends_it_after_the_iteration_with_complete_folders(folder, monkeypatch):
    show = Progress.show

    def interrupting(self, record):
        show(self, record)
        if record.iteration == 1 and not Path("sent").exists():
            Path("sent").touch()
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Progress, "show", interrupting)
    words = ["sweep", "tiny.yaml", *tiny.settings(*QUICK), "--vary", RATES, "-o", "s"]
    result = reslrb(*words)
    assert result.exit_code == 130
    assert "interrupted, 0 of 2 runs done; look at s/sweep.html; `reslrb sweep --resume s` continues" in result.output
    run = Path("s/learning_rate=0.02-seed=0")
    assert tiny.faults(run, 130, "") == []
    assert "finished, 2 of 2 runs done" in tiny.done("sweep", "--resume", "s").output


def test_a_sweep_locks_its_folder(folder, monkeypatch):
    monkeypatch.setattr(FolderLock.__init__, "__defaults__", (0.05, False))  # waits for a shorter time
    said = []

    def another(arguments, interrupts, slot, fresh=False):
        said.append(reslrb("sweep", "--resume", "s").output)
        return 130, ""

    monkeypatch.setattr(sweep, "call", another)
    reslrb("sweep", "tiny.yaml", "-o", "s")
    assert said == ["s: is in use by another `reslrb sweep`; end that first\n"]


def test_a_crashed_process_is_reported_by_its_last_message(monkeypatch):
    for end, code, said in (
        ("print('>>> no room'); print('x'); sys.stdout.flush(); os.kill(os.getpid(), 9)", -9,
         "ended by SIGKILL (often sent when memory runs out): no room"),
        ("print('a.yaml: wrong'); sys.exit(2)", 2, "a.yaml: wrong"),
        ("sys.exit(4)", 4, "ended with exit code 4, without a message"),
        ("time.sleep(60)", 130, "ended by SIGTERM: "),
    ):  # fmt: skip
        monkeypatch.setattr(jobs, "_PROGRAM", f"import os, sys, time; {end}")
        interrupts = Interrupts()
        interrupts.requested = code == 130  # a run that does not handle signals yet
        assert jobs.call(["optimize"], interrupts, jobs.RunSlot()) == (code, said)


def test_runs_of_equal_time_use_no_earlier_results(folder, monkeypatch):
    monkeypatch.undo()  # use the real `call`
    monkeypatch.setattr(jobs, "_PROGRAM", "import os; print(*map(os.environ.get, ('DRJIT_CACHE_DIR', 'RESLRB_CACHE')))")
    plain = jobs.call([], Interrupts(), jobs.RunSlot())[1]
    kernels, decisions = jobs.call([], Interrupts(), jobs.RunSlot(), fresh=True)[1].split()
    assert kernels == decisions
    assert kernels not in plain
    assert not Path(kernels).exists()


@pytest.mark.long  # test_runs_of_equal_time_use_no_earlier_results pretends the runs
def test_only_runs_of_equal_time_are_fresh(folder, monkeypatch):
    asked = []

    def noting(arguments, interrupts, slot, fresh=False):
        asked.append(fresh)
        return call(arguments, interrupts, slot)

    monkeypatch.setattr(sweep, "call", noting)
    result = tiny.done("sweep", "tiny.yaml", *tiny.settings(*QUICK), "--vary", "run.max_seconds=[null, 0.001]",
                       "--vary", "integrator=[ptracer, reslrb:stack]", "-o", "s")  # fmt: skip
    assert asked == [False, False, True, True]
    runs, _ = table("s")
    assert [run["iterations"] for run in runs if run["settings"]["run.max_seconds"]] == [1] * 2
    assert "iterations" in result.output
    assert "the loss of each integrator has its own noise, and what its paths lack: compare the errors" in result.output
    targets = [load_image(run / "images/target.exr") for run in sorted(Path("s").glob("*-seed=0"))]
    assert len(targets) == 4
    for target in targets:
        np.testing.assert_allclose(target, targets[0], rtol=1e-4)


def test_a_run_in_use_is_waited_for(folder, monkeypatch):
    words = ["sweep", "tiny.yaml", *tiny.settings(*QUICK), "-o", "s"]
    tiny.done(*words)
    manifest = json.loads(Path("s/seed=0/manifest.json").read_text())
    Path("s/seed=0/manifest.json").write_text(json.dumps(manifest | {"status": "running"}))
    monkeypatch.setattr(plans, "RELEASE_SECONDS", 0.1)
    monkeypatch.setattr(FolderLock.__init__, "__defaults__", (0.05, False))
    with FolderLock(Path("s/seed=0")):
        result = reslrb("sweep", "--resume", "s")
    assert (result.exit_code, result.output.splitlines()[-1]) == (
        2, f"{Path('s/seed=0').absolute()}: is in use by another run; end that first")  # fmt: skip
    assert "finished, 1 of 1 runs done" in tiny.done("sweep", "--resume", "s").output


def test_a_run_ends_when_the_input_from_its_sweep_closes(monkeypatch):
    """The end of the sweep's process closes the input."""
    waiting = "import reslrb_cli.cli as cli, time; cli.run = lambda: [print('1/5: x', flush=True), time.sleep(60)]; "
    monkeypatch.setattr(jobs, "_PROGRAM", waiting + jobs._PROGRAM)
    slot, ends = jobs.RunSlot(), []
    with Interrupts() as interrupts:
        sweep_of_it = threading.Thread(target=lambda: ends.append(jobs.call([], interrupts, slot)))
        sweep_of_it.start()
        wait_for(lambda: slot.line != "")
        slot.process.stdin.close()
        sweep_of_it.join(20)
    assert ends == [(ExitCode.INTERRUPTED, "1/5: x")]


@pytest.mark.long
def test_a_run_ends_with_its_killed_sweep(llvm, tmp_path):
    tiny.write_experiment(tmp_path)
    settings = tiny.settings(*QUICK, "run.iterations=100000")
    process = tiny.start(tmp_path, *settings, "-o", "s", command="sweep")  # each of its runs also has a process
    run = tmp_path / "s/seed=0"
    wait_for(lambda: count_iterations(run) > 6)
    worker = json.loads((run / "manifest.json").read_text())["process"]["pid"]
    process.kill()
    process.communicate()

    def is_gone():
        try:
            return Path(f"/proc/{worker}/stat").read_text().split()[2] == "Z"
        except OSError:
            return True

    wait_for(is_gone, 5.0)


OWN = "import drjit as dr\n\n\ndef own(image, target):\n    return dr.mean(dr.square(image - target), axis=None)\n"


def test_users_code_needs_permission_and_stays_the_same(folder):
    Path("own.py").write_text(OWN)
    sets = tiny.settings(*QUICK, "run.iterations=2", "loss={type: custom, file: own.py:own}")
    words = ("sweep", "tiny.yaml", *sets, "--vary", "run.spp=[4]", "-o", "s")
    result = reslrb(*words)
    assert (result.exit_code, Path("s").exists()) == (2, False)
    assert result.output == (f"tiny.yaml: loss.file: would run the code of {folder / 'own.py'} with all your rights; "
                             "--allow-code permits it\n")  # fmt: skip
    assert "finished, 1 of 1 runs done" in tiny.done(*words, "--allow-code").output
    more = ("sweep", "--resume", "s", "--seeds", "2")
    asked = reslrb(*more)
    assert (asked.exit_code, "--allow-code permits it" in asked.output) == (2, True)
    Path("own.py").write_text(OWN + "# another\n")
    changed = reslrb(*more, "--allow-code")
    assert changed.exit_code == 2
    assert changed.output.startswith(f"{folder / 'own.py'}: has changed since the sweep in s began; put it back")
    Path("own.py").write_text(OWN)
    assert "finished, 2 of 2 runs done" in tiny.done(*more, "--allow-code").output
    Path("own.py").write_text("raise RuntimeError('it was run')\n")
    assert "table.html" in tiny.done("report", "s", "-o", "table.html").output


# --- what it comes to -------------------------------------------------------------------------------------------------


def pretended(losses, key="run.spp", **about):
    """Return a sweep with as many settings and seeds as `losses` (settings, seeds), and its finished runs with these
    losses.
    """
    combinations = [Combination(f"spp={k}", {key: k}) for k in range(len(losses))]
    sweep = SweepPlan("a.yaml", [], combinations, list(range(len(losses[0]))))
    done = {"status": "finished", "error": 0.5, "elapsed_s": 2.0, "peak_mib": 3.0}
    runs = [SweepRunRecord(run_name(each, seed), each.settings, seed, **done | {"loss": float(losses[k][seed])} | about)
            for seed in sweep.seeds for k, each in enumerate(combinations)]  # fmt: skip
    return sweep, runs


def test_the_best_is_judged_by_seeds_that_all_share():
    noise = np.exp(np.random.default_rng(4).normal(0, 1, 10))
    sweep, runs = pretended([1.1 * noise, noise])
    assert best_records(sweep, runs) == [
        SweepBestRecord("loss", "spp=1", "spp=0", 10, 10), SweepBestRecord("error", "spp=0", "spp=1", 10, 0)
    ]  # fmt: skip
    assert notes(sweep, runs)[0] == ("lowest median final loss: spp=1; lower than the next, spp=0, with 10 of 10 seeds")
    losses = np.stack([1.1 * noise, noise])
    losses[:, 3] = losses[::-1, 3]
    assert best_records(*pretended(losses))[0].lower == 9
    # Comparisons leave out seeds that only one combination has, failed runs, and values of another kind
    runs[-1] = replace(runs[-1], status="waiting")
    assert best_records(sweep, runs)[0].seeds == 9
    runs[-1] = replace(runs[-1], status="failed", message="no room")
    assert best_records(sweep, runs) == []
    row = row_records(sweep, runs)[1]
    assert (row.runs, row.of, row.failed, row.message) == (9, 10, 1, "seed 9: no room")
    assert (row.loss.median, row.loss.low, row.loss.high) == (
        np.median(noise[:9]), noise[:9].min(), noise[:9].max())  # fmt: skip
    for key, compared in (("loss", ["error"]), ("loss.type", ["error"]), ("scene.size", []), ("target", ["error"]),
                          ("parameters[0].bounds", []), ("lossy", ["loss", "error"]),
                          ("parameters[0].learning_rate", ["loss", "error"]),
                          ("integrator.guiding", ["error"]), ("integrator", ["error"])):  # fmt: skip
        assert [each.of for each in best_records(*pretended([noise, noise], key))] == compared, key
    assert [each.of for each in best_records(*pretended([noise, noise], "integrator", error=None))] == ["loss"]
    noted = "the loss of each integrator has its own noise"
    assert [any(noted in line for line in notes(*pretended([noise, noise], key)))
            for key in ("integrator.guiding", "run.spp")] == [True, False]  # fmt: skip


@pytest.mark.parametrize(
    ("key", "values", "found"),
    [
        ("variant", ["llvm_ad_rgb", "llvm_ad_spectral"], "variant"),
        ("integrator.max_depth", [3, 6], "integrator.max_depth"),
        ("integrator.hide_emitters", [True, False], "integrator.hide_emitters"),
        ("integrator", ["prb", "reslrb:stack(hide_emitters=true)"], "integrator.hide_emitters"),
        ("integrator", [{"type": "prb", "max_depth": 3}, {"type": "prb", "max_depth": 6}], "integrator.max_depth"),
        ("integrator", [{"type": "prb", "max_depth": 3}, {"type": "ptracer", "max_depth": 3}], ""),
        ("integrator", ["prb", "reslrb:stack(paths=camera)"], ""),
    ],
)
def test_losses_of_different_light_are_not_compared(key, values, found):
    combinations = [Combination(str(place), {key: value}) for place, value in enumerate(values)]
    sweep = SweepPlan("a.yaml", [], combinations, [0])
    assert incomparable(sweep, "loss") == found
    assert incomparable(replace(sweep, combinations=[], search=SweepSearch(3, {key: values})), "loss") == found
    assert not incomparable(sweep, "error")


def test_curves_are_medians_with_minimum_and_maximum():
    """Runs have 1, 2 and 4 iterations. The curve by time begins when every run has an iteration. Each ended run keeps
    its last value.
    """
    runs = []
    for number, (times, losses) in enumerate(
        [([1.0], [9.0]), ([2.0, 3.0], [7.0, 5.0]), ([0.5, 1.5, 4.0, 5.0], range(4))]
    ):
        records = [{"elapsed_s": at, "loss": float(loss), "parameter_rmse": None}
                   for at, loss in zip(times, losses, strict=True)]  # fmt: skip
        runs.append(ShownRun(Path(), str(number), {}, records))
    by_iteration, by_time, *errors = run_panels(["a"], [runs])
    (curve,) = by_iteration.shown()
    assert (curve.name, curve.xs, curve.ys, curve.band) == ("a", [0], [7.0], ([0.0], [9.0]))
    (curve,) = by_time.shown()
    assert curve.xs == [2.0, 3.0, 4.0, 5.0]
    assert curve.ys == [7.0, 5.0, 5.0, 5.0]
    assert curve.band == ([1.0, 1.0, 2.0, 3.0], [9.0] * 4)
    assert not any(panel.shown() for panel in errors)


def test_errors_without_a_common_unit_are_relative():
    """A radius (true value 2) and an index (true value 1.5): the root mean square of the relative errors is drawn."""
    parameters = {"a.radius": {"scale": 2.0}, "a.index": {"scale": 1.5}, "a.unknown": {"scale": None}}
    results = {"parameters": parameters, "parameter_rmse": {"a.radius": {}}, "rmse": {"initial": None}}
    records = [
        {"elapsed_s": at, "loss": 1.0, "parameter_rmse": None,
         "parameter_errors": {"a.radius": error, "a.index": 0.0, "a.unknown": 7.0}}
        for at, error in ((1.0, 0.4), (2.0, 0.2))
    ]  # fmt: skip
    panel = run_panels(["a"], [[ShownRun(Path(), "a", {"results": results}, records)]])[-1]
    assert (panel.x, panel.y) == ("time in steps and updates (s)", "relative error of the parameters")
    (curve,) = panel.shown()
    assert curve.ys == pytest.approx([0.2 / 2**0.5, 0.1 / 2**0.5])


@pytest.mark.long
def test_the_page_has_a_table_curves_and_pictures(folder):
    words = ["sweep", "tiny.yaml", *tiny.settings(*QUICK), "--vary", "target.render.spp=[8, 16]", "--seeds", "2"]
    tiny.done(*words, "-o", "s")
    assert "look at s/sweep.html" in tiny.done("report", "s").output
    content = json.loads(Path("s/sweep.json").read_text())
    tiny.done("report", "s", "-o", "page.html")
    for page in ("s/sweep.html", "page.html"):
        text = Path(page).read_text()
        assert "2 combinations with 2 seeds: 4 of 4 runs finished." in text
        assert text.count("<svg") == 4  # loss and error, by iteration and by time
        assert text.count("data:image/png") == 3  # the target beside the final images
        assert "losses of different `target.render.spp` are not of the same, and not compared" in text
        assert "lowest median parameter RMSE" in text
        assert "cannot be shown" not in text
    for place, value in enumerate(("<b>x</b>", "$y$")):
        content["combinations"][place]["settings"] = {"<i>k</i>": value}
    Path("s/sweep.json").write_text(json.dumps(content))
    shutil.rmtree("s/spp=8-seed=1/images")
    tiny.done("report", "s", "s/spp=8-seed=0", "-o", "both.html")
    text = Path("both.html").read_text()
    assert "Settings: s" in text
    assert "&lt;b&gt;x" in text
    assert "<b>x" not in text
    assert "<i>k" not in text


@pytest.mark.parametrize(
    ("names", "version", "message"),
    [
        (["a", "b=1.5", "+x", "ä-1"], plans_file.VERSION, None),
        ([""], plans_file.VERSION, None),
        (["a", "a"], plans_file.VERSION, "combinations: have names that are no names of folders, or twice the same"),
        (["a", "A"], plans_file.VERSION, "combinations: have names"),
        (["../a"], plans_file.VERSION, "combinations: have names"),
        ([".a"], plans_file.VERSION, "combinations: have names"),
        (["a/b"], plans_file.VERSION, "combinations: have names"),
        (["a"], plans_file.VERSION + 1, "version: was written by another version, "),
    ],
)
def test_names_of_a_stored_sweep(tmp_path: Path, names: list[str], version: int, message: str | None) -> None:
    combinations = [Combination(name, {"run.spp": place}) for place, name in enumerate(names)]
    sweep = SweepPlan("a.yaml", [], combinations, [1, 2], version=version)
    sweep.write(tmp_path)
    if message is None:
        assert read_sweep(tmp_path) == sweep
        name = run_name(combinations[0], 1)
        assert plans.is_left(tmp_path, sweep, name)
        assert not plans.is_left(tmp_path, replace(sweep, failures={name: plans_file.Failure(1, "")}), name)
    else:
        with pytest.raises(ConfigError, match=rf"sweep\.json: {message}"):
            read_sweep(tmp_path)
