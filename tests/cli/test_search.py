"""Tests of `reslrb sweep --search`, and of several runs at once."""

from __future__ import annotations

import ast
import json
import math
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli import tiny
from cli.tiny import reslrb
from kit import wait_for

from reslrb_cli.cli import jobs, sweep
from reslrb_cli.config.loader import load
from reslrb_cli.records.manifest import PROGRAM, Status
from reslrb_cli.records.sweeps import Combination, SweepPlan, read_sweep, run_name
from reslrb_cli.report.page.sweep import best_records, ranked, run_records
from reslrb_cli.report.sources import read_sweep_runs
from reslrb_cli.runs import search
from reslrb_cli.runs.search import Remaining, propose
from reslrb_cli.runs.sweep import parse_vary

RATE, SPP = "optimizer.learning_rate", "run.spp"
SPACE = (f"{RATE}={{low: 0.001, high: 1, log: true}}", f"{SPP}={{low: 2, high: 40}}", "optimizer.type=[adam, sgd]")
VARY = [word for each in SPACE for word in ("--vary", each)]
WORDS = ["sweep", "tiny.yaml", *VARY, "--search", "optuna", "-o", "s"]


def figure(rate, spp, kind):
    """Return the pretended error of a run; its least value is 0.1."""
    return 0.1 + abs(math.log10(rate / 0.03)) + abs(spp - 20) / 20 + (kind == "sgd")


@pytest.fixture
def folder(llvm, tmp_path, monkeypatch):
    """Working directory with `tiny.yaml`. Runs are pretended: they write only a manifest with the figure above."""
    pytest.importorskip("optuna")
    tiny.write_experiment(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sweep, "call", pretend)
    return tmp_path


def run_of(arguments):
    """Return the folder of the run that `arguments` start, and its configuration."""
    sets = dict(word.partition("=")[::2] for word in arguments if word.startswith("run."))
    folder = Path(json.loads(sets["run.output"])) / json.loads(sets["run.name"])
    return folder, load(arguments[1])


def pretend(arguments, interrupts, slot=None, fresh=False, errors=True):
    folder, config = run_of(arguments)
    value = figure(config.optimizer.learning_rate, config.run.spp, config.optimizer.type)
    results = {"image_loss": {"final": 2 * value}, "rmse": {"final": value if errors else None}}
    folder.mkdir()
    (folder / "manifest.json").write_text(
        json.dumps({"program": PROGRAM, "status": Status.FINISHED, "results": results})
    )
    return 0, "finished"


def trials(folder="s"):
    return [each.settings for each in read_sweep(Path(folder)).combinations]


def test_a_search_finds_the_best_settings(folder):
    output = tiny.done(*WORDS, "--trials", 44).output
    tried = trials()
    values = [figure(*each.values()) for each in tried]
    assert min(values) < 0.25
    first, last = values[:10], values[-14:]
    assert sum(last) / 14 < 0.5 * sum(first) / 10  # random numbers would not improve
    assert len({json.dumps(each) for each in tried}) == 44
    for each in tried:
        assert 0.001 <= each[RATE] <= 1
        assert each[RATE] == float(f"{each[RATE]:.4g}")
        assert each[SPP] in range(2, 41)
    source = read_sweep_runs(Path("s"))
    runs = run_records(source)
    order = [figure(*each.settings.values()) for each in ranked(source.sweep, runs).combinations]
    assert order == sorted(values)
    best = next(each for each in best_records(source.sweep, runs) if each.of == "error").best
    assert f"the best trial by parameter RMSE: s/configs/{best}.yaml" in output
    assert load(f"s/configs/{best}.yaml").optimizer.learning_rate == tried[values.index(min(values))][RATE]
    assert "and 24 more trials, on the page" in output
    assert "finished, 44 of 44 runs done" in output
    assert "44 of 44 trials with 1 seed" in Path("s/sweep.html").read_text()


def test_a_search_that_continues_is_the_same_search(folder, monkeypatch):
    tiny.done(*WORDS, "--trials", 5)
    assert "add only --seeds, --trials" in reslrb("sweep", "--resume", "s", "--search", "optuna").output
    assert "--trials: is 4; the search has 5 trials already" in reslrb("sweep", "--resume", "s", "--trials", 4).output
    monkeypatch.chdir(folder / "s")  # the path of the configuration is absolute
    assert "9 of 9 runs done" in tiny.done("sweep", "--resume", ".", "--trials", 9).output
    monkeypatch.chdir(folder)
    whole = trials()
    calls = []

    def interrupted(arguments, interrupts, slot=None, fresh=False):
        calls.append(arguments)
        return pretend(arguments, interrupts) if len(calls) % 3 else (130, "interrupted")

    monkeypatch.setattr(sweep, "call", interrupted)
    words = [*WORDS[:-1], "t"]
    result = reslrb(*words, "--trials", 9)
    assert result.exit_code == 130
    assert "interrupted, 2 of 3 runs done; look at t/sweep.html; `reslrb sweep --resume t` continues" in result.output
    for _ in range(4):
        result = reslrb("sweep", "--resume", "t")
    assert result.exit_code == 0
    assert trials("t") == whole
    text = Path("tiny.yaml").read_text()
    Path("tiny.yaml").write_text(text + "# another\n")
    result = reslrb("sweep", "--resume", "t", "--trials", 30)
    assert (result.exit_code, "tiny.yaml: has changed since the sweep in t began" in result.output) == (2, True)


def test_failed_trials_do_not_end_the_search(folder, monkeypatch):
    """Diverging runs count as the worst, so that the search leaves their settings. Other failures say nothing."""
    called = []

    def failing(arguments, interrupts, slot=None, fresh=False):
        called.append(arguments)
        _, config = run_of(arguments)
        if config.optimizer.learning_rate > 0.01:
            return 5, "the loss is not finite"
        return (4, "no memory") if config.run.spp > 30 else pretend(arguments, interrupts)

    monkeypatch.setattr(sweep, "call", failing)
    result = reslrb(*WORDS, "--trials", 40)
    assert result.exit_code == 0
    failures = read_sweep(Path("s")).failures
    assert {failure.code for failure in failures.values()} == {4, 5}
    assert f"{40 - len(failures)} of 40 runs done, {len(failures)} failed; look at s/sweep.html\n" in result.output
    diverged = [each[RATE] > 0.01 for each in trials()]
    assert sum(diverged[20:]) <= 10  # 14 to 17 if they said nothing either
    called.clear()
    tiny.done("sweep", "--resume", "s")
    assert called == []
    monkeypatch.setattr(sweep, "call", lambda *given: (4, "no memory"))
    result = reslrb(*WORDS[:-1], "t", "--trials", 2, "--seeds", 2)
    assert result.exit_code == 1  # no trial has finished
    assert "0 of 4 runs done, 2 failed" in result.output  # other seeds of a failed trial are left out


def test_a_trial_whose_settings_do_not_fit_has_failed(folder):
    """The samples must be a multiple of the four batches, as both ends of the range are."""
    words = ["sweep", "tiny.yaml", "--set", "run.adjoint=batched", "--vary", f"{SPP}={{low: 4, high: 8}}", "-o", "s"]
    result = reslrb(*words, "--search", "optuna", "--trials", 9)
    assert result.exit_code == 0
    assert sorted(each[SPP] for each in trials()) == [4, 5, 6, 7, 8]
    assert {failure.code for failure in read_sweep(Path("s")).failures.values()} == {2}
    assert "the search ends after 5 trials: it finds no further combinations" in result.output
    assert "2 of 5 runs done, 3 failed" in result.output


def test_another_result_may_bring_another_proposal(folder, monkeypatch):
    """A search that finds nothing new asks again after the end of each run, and not before."""
    tiny.done(*WORDS, "--trials", 2)
    plan = read_sweep(Path("s"))
    remaining, found = Remaining(Path("s"), replace(plan, search=replace(plan.search, trials=4))), []
    assert (plan.size, remaining.sweep.size) == (2, 4)  # also of trials that are still to be chosen

    def nothing_new(varied, sweep, values):
        found.append(len(sweep.combinations))

    monkeypatch.setattr(search, "propose", nothing_new)
    assert [remaining.next(), remaining.next()] == [None, None]
    assert found == [2]
    remaining.end(run_name(*next(plan.runs)), 0, "finished")
    assert remaining.next() is None
    assert found == [2, 2]


def test_the_loss_counts_if_true_values_are_unknown(folder, monkeypatch):
    monkeypatch.setattr(sweep, "call", lambda *given: pretend(*given, errors=False))
    assert "the best trial by final loss: s/configs/" in tiny.done(*WORDS, "--trials", 3).output
    vary = ["--vary", "loss.type=[l1, l2]", "--search", "optuna", "--trials", "3"]
    result = reslrb("sweep", "tiny.yaml", *vary, "-o", "t")
    assert result.exit_code == 2  # found with the first result, because a rendered target usually has true values
    assert "--search: losses of different `loss.type` are not of the same" in result.output


def test_the_commands_of_the_docs_run(folder):
    page = (tiny.ROOT / "docs/sweeps.md").read_text(encoding="utf-8")
    block = page[page.index("## Search") : page.index("`--search optuna` looks")].replace("room.yaml", "tiny.yaml")
    block = block.replace("--trials 40", "--trials 6").replace("--trials 80", "--trials 9")
    commands = [shlex.split(line, comments=True) for line in block.replace("\\\n", " ").splitlines()]
    first, again = (words for words in commands if words[:1] == ["reslrb"])
    assert "6 of 6 runs done" in tiny.done(*first[1:]).output
    assert "9 of 9 runs done" in tiny.done(*again[1:]).output


@pytest.mark.long
def test_a_search_of_real_runs(llvm, tmp_path):
    """Two at once, in processes of their own."""
    pytest.importorskip("optuna")
    tiny.write_experiment(tmp_path)
    quick = tiny.settings("run.measuring=0", "run.certainty=false", "run.iterations=3", "run.final_spp=4")
    words = [*quick, *VARY[:2], "--search", "optuna", "--trials", "4", "--jobs", "2", "-o", "s"]
    process = tiny.start(tmp_path, *words, command="sweep")
    out, err = process.communicate(timeout=300)
    assert (process.returncode, err) == (0, "")
    assert "finished, 4 of 4 runs done; look at s/sweep.html" in out
    found = [each[RATE] for each in trials(tmp_path / "s")]
    results = [json.loads(line) for line in (tmp_path / "s/results.jsonl").read_text().splitlines()]
    errors = {each["settings"][RATE]: each["error"] for each in results if each["kind"] == "sweep_run"}
    assert set(errors) == set(found)
    assert len(set(errors.values())) > 1
    assert f"learning_rate={min(found, key=lambda rate: errors[rate]):g}.yaml" in out


def test_a_missing_optuna_is_named(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    result = reslrb(*WORDS, "--trials", 3)
    assert result.exit_code == 2
    assert "search: needs the package optuna (" in result.output
    assert "; `pip install 'reslrb[search]'` installs it" in result.output


# --- several runs at once ---------------------------------------------------------------------------------------------


class Together:
    """Pretended runs that last a moment. Notes how many were at work at each start, and which places they had."""

    def __init__(self, peak=0):
        self.lock, self.at_work, self.most, self.starts, self.places = threading.Lock(), 0, 0, [], set()
        self.peak = peak

    def __call__(self, arguments, interrupts, slot, fresh=False):
        with self.lock:
            self.starts.append(self.at_work)
            self.at_work += 1
            self.places.add((tuple(sorted(slot.cores)), slot.gpu))
        time.sleep(0.1)
        slot.line, slot.peak, slot.resident = "1/5: ", self.peak, self.peak
        time.sleep(0.25)
        with self.lock:
            self.at_work -= 1
        return pretend(arguments, interrupts)


@pytest.fixture
def four_cores(monkeypatch):
    bound = []
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {4, 5, 6, 7}, raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, cores: bound.append(cores), raising=False)
    return bound


def test_runs_at_once_share_the_cores(folder, monkeypatch, four_cores):
    monkeypatch.setattr(sweep, "call", together := Together())
    output = tiny.done(*WORDS, "--trials", 4, "--jobs", 2).output
    assert together.starts[:2] == [0, 1]
    assert set(together.starts) == {0, 1}
    assert together.places == {((4, 5), ""), ((6, 7), "")}
    assert {4, 5} in four_cores
    assert "4 of 4 runs done" in output
    words = ["sweep", "tiny.yaml", "--vary", f"{SPP}=[1, 2, 3, 4, 5]", "-o", "t", "--jobs", "9"]
    monkeypatch.setattr(sweep, "call", together := Together())
    output = tiny.done(*words).output
    assert "4 runs at once: this machine has no more GPUs, or cores" in output
    assert max(together.starts) == 3
    assert "5 of 5 runs done" in output


def test_the_first_run_begins_alone(folder, monkeypatch, four_cores):
    """Until it has printed a line of progress, or has ended."""
    seen = []

    def noting(arguments, interrupts, slot, fresh=False):
        seen.append(time.monotonic())
        return Together()(arguments, interrupts, slot)

    monkeypatch.setattr(sweep, "call", noting)
    tiny.done("sweep", "tiny.yaml", "--vary", f"{SPP}=[1, 2, 3]", "-o", "t", "--jobs", "3")
    assert seen[1] - seen[0] > 0.1
    assert seen[2] - seen[1] < 0.25


def test_runs_at_once_fit_into_memory(folder, monkeypatch, four_cores):
    monkeypatch.setattr(jobs, "free_bytes", lambda variant: 6500)
    monkeypatch.setattr(sweep, "call", together := Together(peak=7000))
    tiny.done("sweep", "tiny.yaml", "--vary", f"{SPP}=[1, 2]", "-o", "t", "--jobs", "3")
    assert together.starts == [0, 0]
    monkeypatch.setattr(sweep, "call", together := Together(peak=2000))
    tiny.done("sweep", "tiny.yaml", "--vary", f"{SPP}=[1, 2, 3]", "-o", "u", "--jobs", "3")
    assert max(together.starts) == 2


def test_memory_must_suffice_for_a_run_and_for_the_growth_of_the_others(monkeypatch, four_cores):
    """The run at work may still grow by 1500, and the next one needs 2000."""
    at_work, may_end = threading.Event(), threading.Event()

    def work(slot):
        slot.line, slot.peak, slot.resident = "1/5: ", 2000, 500
        at_work.set()
        return may_end.wait(60), "finished"

    with jobs.Jobs(3, "llvm_ad_rgb") as at_once:
        at_once.start("a", work)
        assert at_work.wait(60)
        for free, may in ((3499, False), (3500, True)):
            monkeypatch.setattr(jobs, "free_bytes", lambda variant, free=free: free)
            assert at_once.may_start() is may
        may_end.set()


def test_each_run_has_a_gpu(folder, monkeypatch, four_cores):
    monkeypatch.setattr(jobs, "ask_gpu", lambda query: ["GPU-a", "GPU-b", "GPU-c"])
    monkeypatch.delenv(jobs.GPUS, raising=False)
    assert [slot.gpu for slot in jobs.Jobs(2, "cuda_ad_rgb").slots] == ["GPU-a", "GPU-b"]
    assert [slot.gpu for slot in jobs.Jobs(9, "cuda_ad_rgb").slots] == ["GPU-a", "GPU-b", "GPU-c"]
    monkeypatch.setenv(jobs.GPUS, "3, , 1,")
    assert [slot.gpu for slot in jobs.Jobs(9, "cuda_ad_rgb").slots] == ["3", "1"]
    assert [slot.gpu for slot in jobs.Jobs(2, "llvm_ad_rgb").slots] == ["", ""]
    assert [slot.gpu for slot in jobs.Jobs(1, "cuda_ad_rgb").slots] == [""]
    monkeypatch.setattr(jobs, "_PROGRAM", f"import os; print(os.environ[{jobs.GPUS!r}])")
    assert jobs.call([], sweep.Interrupts(), jobs.RunSlot(gpu="GPU-b")) == (0, "GPU-b")


@pytest.mark.parametrize(("cores", "number"), [(5, 2), (7, 3), (8, 4), (3, 9)])
def test_no_core_is_left_over(monkeypatch, cores, number):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(10, 10 + cores)), raising=False)
    found = [slot.cores for slot in jobs.Jobs(number, "llvm_ad_rgb").slots]
    assert sorted(core for each in found for core in each) == list(range(10, 10 + cores))
    assert max(map(len, found)) - min(map(len, found)) <= 1


def test_a_fresh_run_has_no_caches(monkeypatch):
    """Neither kernels of LLVM, OptiX and CUDA nor decisions. Other runs have the caches of the user."""
    names = ("DRJIT_CACHE_DIR", "OPTIX_CACHE_PATH", "RESLRB_CACHE", "CUDA_CACHE_DISABLE")
    monkeypatch.setattr(jobs, "_PROGRAM", f"import os; print([os.environ.get(name) for name in {names}])")
    for name in names:
        monkeypatch.setenv(name, "the user's")
    code, line = jobs.call([], sweep.Interrupts(), jobs.RunSlot(), fresh=True)
    *folders, disabled = ast.literal_eval(line)
    assert (code, disabled, len(set(folders))) == (0, "1", 1)
    assert Path(folders[0]).name.startswith("reslrb-")
    assert not Path(folders[0]).exists()
    assert jobs.call([], sweep.Interrupts(), jobs.RunSlot()) == (0, str(["the user's"] * 4))


def test_memory_now_and_at_most(monkeypatch):
    """The process frees 64 MiB at once."""
    monkeypatch.setattr(jobs, "_PROGRAM", "x = bytearray(1 << 26); del x; import time; time.sleep(0.4)")
    slot, seen = jobs.RunSlot(), []
    slot.show = lambda: seen.append(slot.peak - slot.resident)
    assert jobs.call([], sweep.Interrupts(), slot)[0] == 0
    assert max(seen) > 1 << 25


def test_a_run_that_must_end_is_ended(monkeypatch):
    """Because another run has failed: nobody has sent a signal to the sweep."""
    monkeypatch.setattr(jobs, "_PROGRAM", "import time; print('at work', flush=True); time.sleep(60)")
    slot, start = jobs.RunSlot(must_end=True), time.monotonic()
    code, line = jobs.call([], sweep.Interrupts(), slot)
    assert (code, line.startswith("ended by SIGTERM: ")) == (130, True)
    assert time.monotonic() - start < 30


def test_a_sweep_that_ends_at_once_ends_its_runs_with_a_last_act(tmp_path, monkeypatch):
    """A run marks its manifest as interrupted at the second signal."""
    script = f"""
import time
from pathlib import Path
from reslrb_cli.cli.terminal import Interrupts
with Interrupts(last_act=lambda: Path({str(tmp_path / "last act")!r}).touch()):
    print("1/5: at work", flush=True)
    time.sleep(60)
"""
    monkeypatch.setattr(jobs, "_PROGRAM", f"exec({script!r})")
    at_once, ends = jobs.Jobs(1, "llvm_ad_rgb"), []
    (slot,) = at_once.slots
    thread = threading.Thread(target=lambda: ends.append(jobs.call([], sweep.Interrupts(), slot)))
    thread.start()
    wait_for(lambda: slot.line, 60)
    start = time.monotonic()
    at_once.end()
    assert time.monotonic() - start < jobs.END_SECONDS
    thread.join(20)
    assert ends == [(130, "interrupted")]
    assert (tmp_path / "last act").exists()


def test_trials_at_work_are_avoided(folder):
    """Among the trials are enough results for a proposal near the best one. Where trials are at work, none is made."""
    space = [parse_vary("optimizer.learning_rate={low: 0.0, high: 1.0}", search=True)]
    rates = [0.02 + n / 25 for n in range(25)]
    known = [Combination(f"t{n}", {RATE: rate}) for n, rate in enumerate(rates)]
    values = {each.name: (each.settings[RATE] - 0.5) ** 2 for each in known}
    at_work = [Combination(f"w{n}", {RATE: 0.45 + 0.01 * n}) for n in range(11)]

    def proposals(combinations):
        plan = SweepPlan("tiny.yaml", [], combinations, [0])
        return [propose(space, replace(plan, seeds=[seed]), values)[RATE] for seed in range(12)]

    alone, beside = (np.mean([abs(rate - 0.5) < 0.06 for rate in proposals(each)]) for each in (known, known + at_work))
    print(alone, beside)
    assert alone > 0.6
    assert beside < 0.3


def test_rounded_proposals_stay_in_their_range(folder):
    space = [parse_vary(f"{RATE}={{low: 0.123449, high: 0.123451}}", search=True)]
    plans = [SweepPlan("tiny.yaml", [], [], [seed]) for seed in range(4)]
    assert all(0.123449 <= propose(space, plan, {})[RATE] <= 0.123451 for plan in plans)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs affinities")
def test_a_process_has_the_cores_of_its_place(monkeypatch):
    monkeypatch.setattr(jobs, "_PROGRAM", "import os; print(os.sched_getaffinity(0))")
    core = min(os.sched_getaffinity(0))
    before = os.sched_getaffinity(0)
    ends = []
    thread = threading.Thread(
        target=lambda: ends.append(
            jobs._bound(jobs.RunSlot(cores={core}), lambda slot: jobs.call([], sweep.Interrupts(), slot))
        )
    )
    thread.start()
    thread.join()
    assert ends == [(0, f"{{{core}}}")]
    assert os.sched_getaffinity(0) == before


def test_ctrl_c_ends_all_runs_after_their_iterations(folder, monkeypatch, four_cores):
    asked = []

    def waiting(arguments, interrupts, slot, fresh=False):
        slot.line = "1/5: "
        if len(asked) == 1:
            interrupts.requested = True
        asked.append(arguments)
        while not interrupts.requested:
            time.sleep(0.01)
        time.sleep(0.2)
        return 130, "interrupted"

    monkeypatch.setattr(sweep, "call", waiting)
    result = reslrb(*WORDS, "--trials", 9, "--jobs", 2)
    assert result.exit_code == 130
    assert "interrupted, 0 of 2 runs done" in result.output
    assert len(asked) == 2
    monkeypatch.setattr(sweep, "call", pretend)
    assert "9 of 9 runs done" in tiny.done("sweep", "--resume", "s", "--jobs", 2).output


def test_a_fault_of_one_run_interrupts_the_others(folder, monkeypatch, four_cores):
    ends = []

    def faulty(arguments, interrupts, slot, fresh=False):
        slot.line = "1/5: "
        if ends == []:
            ends.append("fault")
            time.sleep(0.5)
            return 6, "the disk is full"
        while not slot.must_end:
            time.sleep(0.01)
        ends.append("interrupted")
        return 130, "interrupted"

    monkeypatch.setattr(sweep, "call", faulty)
    result = reslrb(*WORDS, "--trials", 9, "--jobs", 2)
    assert result.exit_code == 6
    assert "the disk is full; `reslrb sweep --resume s` continues" in result.output
    assert ends == ["fault", "interrupted"]


def test_the_end_of_a_sweep_ends_every_run(monkeypatch):
    """A run that ignores both signals, one that has ended already, and one that ends in time."""
    done = []

    class Process:
        def __init__(self, name, fault=None, waits=()):
            self.name, self.fault, self.waits = name, fault, list(waits)

        def send_signal(self, number):
            done.append((self.name, number))
            if self.fault is not None:
                raise self.fault

        def wait(self, seconds):
            assert 0 <= seconds <= jobs.END_SECONDS
            done.append((self.name, "wait"))
            if self.name == "deaf":
                raise subprocess.TimeoutExpired("reslrb", seconds)

        def kill(self):
            done.append((self.name, "kill"))

    pool = jobs.Jobs(1, "llvm_ad_rgb")
    pool.slots = [jobs.RunSlot() for _ in range(4)]
    for slot, process in zip(
        pool.slots, (Process("deaf"), None, Process("gone", ProcessLookupError()), Process("quick")), strict=True
    ):
        slot.process = process
    pool.end()
    names = ["deaf", "gone", "quick"]
    assert done[:6] == [(name, number) for number in (signal.SIGTERM, signal.SIGINT) for name in names]
    assert done[6:] == [(name, what) for name in names for what in ("wait", "kill")]


def test_progress_of_runs_is_for_terminals_alone(monkeypatch, capsys):
    pool = jobs.Jobs(1, "llvm_ad_rgb")
    pool.slots = [jobs.RunSlot(line="3/9"), jobs.RunSlot(), jobs.RunSlot(line="x" * 99)]
    pool.show()
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(jobs.shutil, "get_terminal_size", lambda: os.terminal_size((20, 5)))
    pool.show()
    shown = capsys.readouterr().err
    assert shown.startswith("\r\x1b[K  3/9; x")
    assert len(shown) == len("\r\x1b[K") + 19
