"""`rl.optimize`: the results of a user's loop, with and without a folder, for every way of ending the loop."""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli import tiny
from cli.tiny import KEY, files
from compilation import search_path
from runs.going_on import TIMES, begin_alone, differences, optimize, records_of

import reslrb_cli as rl
from reslrb_cli.api import experiment as experiment_module
from reslrb_cli.errors import ExitCode, MachineError, NonFinite
from reslrb_cli.optimization import sensitivity
from reslrb_cli.optimization.uncertainty import measuring
from reslrb_cli.records.images import load_image
from reslrb_cli.records.lock import FolderLock
from reslrb_cli.runs import recorder as recording

#: Settings for the two-parameter case of tests/runs. The tests there compare the values that certainty needs.
SET = {"run.certainty": False, "run.iterations": 6}
STAYS = {"poster.reflectance.data": (4, 4, 3), "lamp.emitter.radiance.value": (3,)}


@pytest.fixture
def experiment(llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    begin_alone(tmp_path, monkeypatch)
    return tmp_path


def as_json(record: rl.Record) -> dict[str, Any]:
    return {key: value for key, value in json.loads(record.to_json()).items() if key not in TIMES}


def test_a_loop_ends_with_the_warnings_of_the_run(
    experiment: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only if it has come to its end."""
    run = rl.optimize("tiny.yaml", "runs/a", overrides={"run.iterations": 30, "optimizer.learning_rate": 1e-3})
    for _ in run:
        break
    said = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert not any("not converged" in line for line in said)
    assert run.unexplained() is None  # too few iterations
    list(run)
    results = json.loads(Path("runs/a/manifest.json").read_text())["results"]
    monkeypatch.delattr(measuring.Certainty, "measure")  # it is not measured again
    warnings, found = results["warnings"], run.unexplained()
    assert found is not None
    assert found.to_json() == results["certainty"]["fit"]
    assert 0 < found.p <= 1
    assert any("not converged, still moving" in line for line in warnings)
    said = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert said[-len(warnings) :] == warnings


@pytest.mark.parametrize("is_certain", [True, False])
def test_the_map_of_a_misfit_is_that_of_the_last_end(
    experiment: Path, monkeypatch: pytest.MonkeyPatch, is_certain: bool
) -> None:
    shown = np.full((2, 3, 1), -0.3, np.float32)

    def measure(self: measuring.Certainty, iterations: int, *_: object) -> None:
        self.misfits = {0: shown} if iterations == 20 else {}

    monkeypatch.setattr(measuring.Certainty, "measure", measure)
    list(rl.optimize("tiny.yaml", "runs/a", overrides={"run.iterations": 20}))
    path = Path("runs/a/images/misfit.exr")
    np.testing.assert_allclose(load_image(path), shown)
    list(rl.optimize(resume="runs/a", overrides={"run.iterations": 21, "run.certainty": is_certain}))
    assert not path.exists()


def values_equal(first: dict[str, Any], second: dict[str, Any]) -> bool:
    return first.keys() == second.keys() and all(first[key].tobytes() == second[key].tobytes() for key in first)


def is_free(folder: Path) -> bool:
    with FolderLock(folder, wait_s=0):
        return True


def status_of(folder: Path) -> str:
    return str(json.loads((folder / "manifest.json").read_text())["status"])


@pytest.mark.parametrize(
    "settings", [pytest.param({}, marks=pytest.mark.long), {"optimizer": {"type": "sgd", "scale": "curvature"}}]
)
def test_a_loop_gives_the_results_of_the_command(experiment: Path, settings: dict[str, Any]) -> None:
    """All results match bit by bit. The loop is tested with and without a folder."""
    sets = [word for key, value in (SET | settings).items() for word in ("--set", f"{key}={json.dumps(value)}")]
    assert optimize("tiny.yaml", "--quiet", *sets) == 0
    run = rl.optimize("tiny.yaml", folder="runs/mine", overrides=SET | settings)
    records = [as_json(record) for record in run]
    assert run.folder == experiment / "runs/mine"
    assert (run.status, run.iteration, status_of(run.folder)) == ("finished", 6, "finished")
    assert differences(Path("runs/tiny"), run.folder) == []
    assert records == records_of(Path("runs/tiny")) == [as_json(record) for record in run.records]
    assert files(run.folder) == files(Path("runs/tiny"))

    alone = rl.optimize("tiny.yaml", overrides=SET | settings)
    assert [as_json(record) for record in alone] == records
    assert values_equal(alone.parameters, run.parameters)
    assert values_equal(alone.parameters, dict(np.load("runs/tiny/parameters/parameters.npz")))
    assert (alone.folder, alone.status) == (None, "finished")
    assert files(Path("runs")) == {f"{name}/{file}" for name in ("tiny", "mine") for file in files(run.folder)}


#: `scale: curvature` measures gradients before the first iteration.
DESCENT: dict[str, Any] = SET | {"optimizer": {"type": "sgd", "scale": "curvature"}}


def signal_at_a_gradient(patch: pytest.MonkeyPatch, number: int) -> list[Any]:
    """Send the signal `number` during the third gradient that is measured. Returns the arguments of the gradients."""
    real, seen = sensitivity.sample_gradient, list[Any]()

    def measured(*given: Any) -> Any:
        seen.append(given)
        if len(seen) == 3:
            os.kill(os.getpid(), number)
        return real(*given)

    patch.setattr(sensitivity, "sample_gradient", measured)
    return seen


def test_a_signal_stops_the_measurement_of_curvature(experiment: Path) -> None:
    """With large lenses, the measurement takes a minute. The command, a loop with a folder, and a loop without one stop
    after the current gradient. The runs then continue as if there had been no signal.
    """
    sets = [word for key, value in DESCENT.items() for word in ("--set", f"{key}={json.dumps(value)}")]
    assert optimize("tiny.yaml", "--quiet", *sets, "--set", "run.name=whole") == 0
    with pytest.MonkeyPatch.context() as patch:
        seen = signal_at_a_gradient(patch, signal.SIGTERM)
        assert optimize("tiny.yaml", "--quiet", *sets, "--set", "run.name=part") == ExitCode.INTERRUPTED
    assert len(seen) == 3
    assert "rendering the final image" not in Path("runs/part/run.log").read_text(), "it is the initial image"
    images = Path("runs/part/images")
    assert (images / "final.exr").read_bytes() == (images / "initial.exr").read_bytes()
    runs = [rl.optimize("tiny.yaml", folder, overrides=DESCENT) for folder in ("runs/loop", None)]
    for run, number, error in zip(runs, (signal.SIGINT, signal.SIGTERM), (KeyboardInterrupt, SystemExit), strict=True):
        with pytest.MonkeyPatch.context() as patch:
            seen = signal_at_a_gradient(patch, number)
            with pytest.raises(error):
                list(run)
        assert (len(seen), run.status, run.iteration) == (3, "interrupted", 0)
    for folder in (Path("runs/part"), Path("runs/loop")):
        assert status_of(folder) == "interrupted"
        assert files(folder) >= tiny.COMPLETE - {"metrics.jsonl"}
        assert optimize("--resume", str(folder), "--quiet") == 0
        assert records_of(folder) == records_of(Path("runs/whole"))
    assert [as_json(record) for record in runs[1]] == records_of(Path("runs/whole"))


def test_everything_can_be_inspected_between_iterations(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Inspection does not change results. The test of fit is measured once, because it takes most of the time."""
    monkeypatch.setattr(measuring, "LEAST_ITERATIONS", 4)
    plain = rl.optimize("tiny.yaml", overrides=SET)
    expected = [as_json(record) for record in plain]
    run = rl.optimize("tiny.yaml", overrides=SET)
    assert run.gradients == {}
    assert (run.iteration, run.records, run.status) == (0, [], "running")
    before, seen = run.parameters, []
    assert {key: value.shape for key, value in before.items()} == STAYS
    for record in run:
        seen.append(as_json(record))
        image, target = run.images[0], run.targets[0]
        assert image.shape == target.shape == (8, 8, 3)
        assert image.dtype == np.float32
        gradients = run.gradients
        assert {key: value.shape for key, value in gradients.items()} == STAYS
        norm = np.sqrt(sum(float(np.square(each, dtype=np.float64).sum()) for each in gradients.values()))
        assert norm == pytest.approx(record.grad_norm, rel=1e-5)
        assert not values_equal(run.parameters, before)
        found = run.unexplained() if record.iteration in (2, 3) else None
        assert (found is not None) == (record.iteration == 3)
    assert seen == expected
    assert values_equal(run.parameters, plain.parameters)
    assert (before[KEY] == 0.5).all()
    assert set(run.truth) <= set(STAYS)
    assert repr(run) == "<Run tiny.yaml: 6 of 6, finished>"


@pytest.mark.long
def test_two_experiments_alternate(experiment: Path) -> None:
    """Each run gives the same records as alone, bit by bit."""
    other = SET | {"run.iterations": 4, "run.seed": 7, "optimizer.type": "sgd"}
    alone = [list(map(as_json, rl.optimize("tiny.yaml", overrides=each))) for each in (SET, other)]
    runs = [rl.optimize("tiny.yaml", overrides=each) for each in (SET, other)]
    turns = list(zip_longest(*runs))
    assert [[as_json(pair[place]) for pair in turns if pair[place]] for place in (0, 1)] == alone
    assert [run.status for run in runs] == ["finished", "finished"]


def test_runs_in_two_threads_take_turns(experiment: Path) -> None:
    """Each run gives the same records as alone, bit by bit, and neither waits until the other has ended."""
    cases = [SET | {"run.seed": seed} for seed in (0, 7)]
    alone = [list(map(as_json, rl.optimize("tiny.yaml", overrides=each))) for each in cases]
    found: list[list[dict[str, Any]]] = [[], []]
    order, start = list[int](), threading.Barrier(2)

    def work(place: int) -> None:
        run = rl.optimize("tiny.yaml", overrides=cases[place])
        start.wait(60)
        for record in run:
            assert run.status == "running"
            found[place].append(as_json(record))
            order.append(place)
            assert set(run.parameters) == set(STAYS)

    threads = [threading.Thread(target=work, args=(place,), daemon=True) for place in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(100)
    assert found == alone
    assert set(order[:4]) == {0, 1}


def test_a_loop_in_another_thread_is_refused(experiment: Path) -> None:
    """Dr.Jit would end the process."""
    run, found = rl.optimize("tiny.yaml", overrides=SET), []

    def work() -> None:
        with pytest.raises(RuntimeError, match="made in another thread; call optimize in the thread of its loop"):
            list(run)
        found.append(run.iteration)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(20)
    assert found == [0]
    assert next(iter(run)).iteration == 0


def test_a_change_of_variant_is_named(experiment: Path) -> None:
    import mitsuba as mi

    before, run = mi.variant(), rl.optimize("tiny.yaml", overrides=SET)
    loop = iter(run)
    next(loop)
    mi.set_variant("scalar_rgb")
    with pytest.raises(
        rl.ConfigError, match=f"variant: is {before}, but the script has set scalar_rgb during the loop"
    ):
        next(loop)
    mi.set_variant(before)
    assert [record.iteration for record in run] == [1, 2, 3, 4, 5]


def test_no_thread_waits_for_a_loop_to_end() -> None:
    """A thread in a loop gives way to a thread that waits, and a thread does not wait for itself."""
    done, waiting = [0, 0], threading.Event()

    def work() -> None:
        waiting.set()
        with experiment_module.held(), experiment_module.held():
            done[1] = done[0]

    thread = threading.Thread(target=work)
    for done[0] in range(300):
        with experiment_module.held():
            time.sleep(0.001)
            if done[0] == 10:
                thread.start()
                waiting.wait(10)
    thread.join(10)
    assert 10 <= done[1] < 100


def leave_by_break(run: rl.Run) -> None:
    for record in run:
        if record.iteration == 1:
            break


def leave_by_error(run: rl.Run) -> None:
    with pytest.raises(ZeroDivisionError):
        [1 // (1 - record.iteration) for record in run]


def leave_by_return_from_live(run: rl.Run) -> None:
    for record in run.live():
        if record.iteration == 1:
            return


def leave_a_block(run: rl.Run) -> None:
    loop = iter(run)
    with run:
        assert [next(loop).iteration for _ in range(2)] == [0, 1]
    assert list(loop) == []


def interrupt(at: bool) -> None:
    if at:
        os.kill(os.getpid(), signal.SIGINT)


def leave_by_an_interrupt(run: rl.Run) -> None:
    with pytest.raises(KeyboardInterrupt):
        [interrupt(record.iteration == 1) for record in run]


def leave_by_an_interrupt_at_work(run: rl.Run) -> None:
    """Send an interrupt while the second iteration is at work. The run completes this iteration and keeps it."""
    write, seen = recording.MetricsWriter.write, list[int]()

    def interrupted(self: Any, record: rl.Record) -> None:
        interrupt(record.iteration == 1)
        write(self, record)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording.MetricsWriter, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            seen.extend(record.iteration for record in run)
    assert seen == [0]


@pytest.mark.parametrize("leave", [leave_by_break, leave_by_error, leave_by_return_from_live, leave_a_block,
                                   leave_by_an_interrupt, leave_by_an_interrupt_at_work])  # fmt: skip
def test_leaving_a_loop_leaves_a_complete_folder(experiment: Path, leave: Callable[[rl.Run], None]) -> None:
    run = rl.optimize("tiny.yaml", folder="mine", overrides=SET)
    leave(run)
    assert run.folder is not None
    assert (run.status, run.iteration, status_of(run.folder)) == ("interrupted", 2, "interrupted")
    assert is_free(run.folder)
    assert files(run.folder) >= tiny.COMPLETE
    assert json.loads((run.folder / "manifest.json").read_text())["error"] is None
    assert values_equal(run.parameters, dict(np.load(run.folder / "parameters/parameters.npz")))
    assert len(records_of(run.folder)) == 2


@pytest.mark.parametrize("folder", [pytest.param("mine", marks=pytest.mark.long), None])
def test_a_second_loop_continues(experiment: Path, folder: str | None) -> None:
    whole = rl.optimize("tiny.yaml", folder=folder and "whole", overrides=SET)
    expected = [as_json(record) for record in whole]
    run = rl.optimize("tiny.yaml", folder=folder, overrides=SET)
    for _ in range(2):
        for record in run:
            if record.iteration % 3 == 1:
                break
    found = [as_json(record) for record in run]
    assert [record["iteration"] for record in found] == [5]
    assert [as_json(record) for record in run.records] == expected
    assert values_equal(run.parameters, whole.parameters)
    if run.folder is not None and whole.folder is not None:
        assert differences(whole.folder, run.folder) == []
    assert list(run) == []
    assert (run.status, run.iteration) == ("finished", 6)


def test_a_run_continues_from_its_folder(experiment: Path, caplog: pytest.LogCaptureFixture) -> None:
    whole = rl.optimize("tiny.yaml", folder="whole", overrides=SET)
    assert len(list(whole)) == 6
    with rl.optimize("tiny.yaml", folder="mine", overrides=SET | {"run.iterations": 3}) as first:
        assert len(list(first)) == 3
    again = rl.optimize(resume="mine", overrides={"run.iterations": 6})
    assert again.iteration == 3
    assert values_equal(again.parameters, first.parameters)
    assert [record.iteration for record in again] == [3, 4, 5]
    assert again.folder == experiment / "mine"
    assert differences(Path("whole"), Path("mine")) == []

    assert caplog.messages == []
    done = rl.optimize(resume="mine")
    left = "mine: is finished, after 6 of 6 iterations; the override run.iterations: NUMBER continues it"
    assert [record.message for record in caplog.records if record.levelname == "WARNING"] == [left]
    assert (done.status, list(done), done.folder) == ("finished", [], experiment / "mine")
    assert values_equal(done.parameters, again.parameters)
    assert is_free(Path("mine"))

    longer = rl.optimize(resume="mine", overrides={"run.iterations": 7})
    assert [record.iteration for record in longer] == [6]


def test_one_thread_at_a_time_records(llvm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The next one records when the first has ended."""
    from reslrb_cli.integrators import freezing

    monkeypatch.setattr(freezing, "_recorder", None)
    found, go_on = list[bool](), threading.Event()

    def work() -> None:
        found.append(freezing._may_record())
        go_on.wait(20)

    thread = threading.Thread(target=work)
    thread.start()
    while not found:
        time.sleep(0.001)
    found.append(freezing._may_record())
    go_on.set()
    thread.join(20)
    assert [*found, freezing._may_record()] == [True, False, True]


def test_a_folder_keeps_its_name(experiment: Path) -> None:
    run = rl.optimize("tiny.yaml", folder="mine/my run #1 (é)", overrides=SET | {"run.iterations": 1})
    list(run)
    assert run.folder == experiment / "mine/my run #1 (é)"
    assert [path.name for path in (experiment / "mine").iterdir()] == ["my run #1 (é)"]
    for name in ("~x", "###"):
        with pytest.raises(rl.ConfigError, match=r"run\.name: must "):
            rl.optimize("tiny.yaml", folder=f"mine/{name}", overrides=SET)


def test_a_cell_that_resumes_can_be_run_again(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The earlier Run, which no loop has used, gives the folder back. It can still be used later."""
    with rl.optimize("tiny.yaml", folder="mine", overrides=SET) as first:
        next(iter(first))
    earlier = rl.optimize(resume="mine")
    again = rl.optimize(resume="../" + experiment.name + "/mine")
    loop = iter(again)
    assert next(loop).iteration == 1
    (experiment / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")  # the script's own business
    assert [record.iteration for record in loop] == [2, 3, 4, 5]
    assert is_free(experiment / "mine")
    monkeypatch.chdir(experiment)
    assert list(earlier) == []
    assert (earlier.status, earlier.iteration) == ("finished", 6)
    assert list(rl.optimize(resume="mine", overrides={"run.iterations": 6})) == []


ENDED = """
import os, signal, sys
import reslrb_cli as rl
few = {"run.iterations": 1000, "run.certainty": False}
runs = [rl.optimize("tiny.yaml", folder=name, overrides=few) for name in "ab"]
left = iter(runs[0])
next(left)
for record in runs[1]:
    if record.iteration == 2:
        os.kill(os.getpid(), getattr(signal, sys.argv[1]))
"""


@pytest.mark.parametrize("name", ["SIGTERM", pytest.param("SIGHUP", marks=pytest.mark.long)])
def test_the_end_of_a_script_completes_its_folders(name: str, experiment: Path) -> None:
    """A signal of a batch system ends the script, whose other iterator is still open."""
    environment = {**os.environ, "PYTHONPATH": search_path(), "RESLRB_CACHE": str(experiment / "cache")}
    done = subprocess.run([sys.executable, "-c", ENDED, name], capture_output=True, text=True, env=environment)
    assert done.returncode == 128 + getattr(signal, name), done.stderr
    assert "Traceback" not in done.stderr
    for folder, count in (("a", 1), ("b", 3)):
        manifest = json.loads((experiment / folder / "manifest.json").read_text())
        assert (manifest["status"], manifest["error"]) == ("interrupted", None)
        assert manifest["results"]["iterations"] == count
        assert files(experiment / folder) >= tiny.COMPLETE


def test_a_signal_waits_for_the_end_of_a_step_and_acts_during_a_loop_alone(experiment: Path) -> None:
    end_by, done = experiment_module.end_by, list[int]()
    run = rl.optimize("tiny.yaml", overrides=SET | {"run.iterations": 1})

    def work() -> None:
        with experiment_module.held() as stop:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.05)
            assert stop()
            done.append(1)  # an exception in the midst of a kernel would end the process

    for _ in run:
        assert [signal.getsignal(number) for number in experiment_module.KILLING] == [end_by, end_by]
        with pytest.raises(SystemExit) as end:
            work()
        assert (end.value.code, done) == (143, [1])
    assert [signal.getsignal(number) for number in experiment_module.KILLING] == [signal.SIG_DFL, signal.SIG_DFL]


def test_folder_replaces_the_output_of_the_experiment(experiment: Path) -> None:
    config = rl.load("tiny.yaml", {**SET, "run.output": "elsewhere"})
    assert rl.optimize(config, folder="mine").config.run.output == experiment


def test_a_run_is_in_only_one_loop(experiment: Path) -> None:
    run = rl.optimize("tiny.yaml", overrides=SET)
    for _ in run:
        with pytest.raises(RuntimeError, match="in a loop already"):
            iter(run)
        break
    gc.collect()
    assert next(iter(run)).iteration == 1


def test_errors_are_located(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FolderLock.__init__, "__defaults__", (0.05, False))  # waits for a shorter time
    cases: list[tuple[Callable[[], Any], str]] = [
        (lambda: rl.optimize(), "experiment: is missing; give a configuration, or resume=RUN"),
        (lambda: rl.optimize("tiny.yaml", folder="scene.xml/runs"), f"folder: {experiment}/scene.xml is not"),
        (lambda: rl.optimize("tiny.yaml", folder="/proc/runs"), "folder: cannot write to /proc"),
        *(
            (
                lambda key=key: rl.optimize("tiny.yaml", "mine", overrides={key: "b"}),
                f"overrides: {key}: is what folder",
            )
            for key in ("run.output", "run.name")
        ),
        (lambda: rl.optimize("tiny.yaml", overrides={"variant": "cuda_ad_rgb"}), "variant: is cuda_ad_rgb, but llvm"),
        (lambda: rl.optimize(resume="."), ".: is no run's folder"),
        (lambda: rl.optimize("tiny.yaml", resume="mine"), "experiment: cannot be given with resume"),
        (lambda: rl.optimize(resume="mine", folder="other"), "folder: cannot be given with resume; copy the folder"),
    ]
    for call, start in cases:
        with pytest.raises(rl.ConfigError) as error:
            call()
        assert start in str(error.value), error.value
    with rl.optimize("tiny.yaml", folder="mine", overrides=SET) as run:
        next(loop := iter(run))
        with pytest.raises(rl.ConfigError, match="mine: is in use by a run"):
            rl.optimize(resume="mine")
        del loop
    with pytest.raises(rl.ConfigError, match=r"overrides: run.seed: is 5, 0 in the run; mine may change only"):
        rl.optimize(resume="mine", overrides={"run.seed": 5})


def test_failures_of_a_run_are_raised(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from reslrb_cli.optimization import loop

    work = loop.step

    def failing(problem: Any, state: Any, *rest: Any) -> Any:
        if state.iteration == 2:
            raise NonFinite("the loss of iteration 2 is not finite")
        return work(problem, state, *rest)

    monkeypatch.setattr(loop, "step", failing)
    for folder in ("mine", None):
        run = rl.optimize("tiny.yaml", folder=folder, overrides=SET)
        with pytest.raises(NonFinite, match="iteration 2"):
            list(run)
        assert (run.status, run.iteration) == ("failed", 2)
        assert {key: value.shape for key, value in run.parameters.items()} == STAYS
    assert status_of(Path("mine")) == "failed"


def test_an_incomplete_folder_is_reported(
    experiment: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    run = rl.optimize("tiny.yaml", folder="mine", overrides=SET)
    tiny.failing_last(monkeypatch, "write_parameters", calls=2)
    leave_by_break(run)
    assert "No space left on device" in caplog.text
    with pytest.raises(MachineError, match="No space left on device"):
        run.close()
    run.close()
    assert status_of(Path("mine")) == "failed"


INTERRUPTED = """
import os, signal, sys
import reslrb_cli as rl
run = rl.optimize("tiny.yaml", folder="mine", overrides={"run.iterations": 1000000})
print("begins", flush=True)
try:
    for record in run:
        print(record.iteration, flush=True)
except KeyboardInterrupt:
    print("left", run.status, run.iteration, len(run.parameters), run.folder.name, flush=True)
"""


@pytest.mark.long  # in this process: test_leaving_a_loop_leaves_a_complete_folder
def test_an_interrupt_from_outside_keeps_the_result(experiment: Path) -> None:
    """SIGINT, as from a terminal or a notebook, may arrive at any moment of an iteration."""
    environment = {**os.environ, "PYTHONPATH": search_path(), "RESLRB_CACHE": str(experiment / "cache")}
    process = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )
    assert process.stdout is not None
    timer = threading.Timer(100, process.kill)
    timer.start()
    try:
        for line in process.stdout:
            if line.strip() == "5":
                break
        process.send_signal(signal.SIGINT)
        out, err = process.communicate()
    finally:
        timer.cancel()
    assert process.returncode == 0, err
    assert "Traceback" not in err
    [status, count, keys, name] = out.splitlines()[-1].removeprefix("left ").split()
    assert (status, keys, name) == ("interrupted", "2", "mine")
    assert int(count) == len(records_of(Path("mine"))) >= 6
    assert status_of(Path("mine")) == "interrupted"


def test_a_run_can_be_watched(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = rl.optimize("tiny.yaml", overrides=SET)
    assert [record.iteration for record in run.live()] == [0, 1, 2, 3, 4, 5]
    assert "6/6" in capsys.readouterr().err
