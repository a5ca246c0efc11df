"""Checks whose samples and cases workers take. The results equal those of one process to the bit, whichever worker
takes a part.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from runs.going_on import one_thread, write_experiment

from reslrb_cli.cli import main
from reslrb_cli.cluster.connection import Place
from reslrb_cli.config.loader import load, loads
from reslrb_cli.config.schema import Config
from reslrb_cli.measure.gradcheck import Gradcheck
from reslrb_cli.measure.participants import CheckSettings, settings_of
from reslrb_cli.measure.sampling import KIND
from reslrb_cli.measure.scenes import small
from reslrb_cli.records.measurement_files import Earlier, Kept

checks = pytest.importorskip("reslrb_cli.cluster.checks", reason="pip install reslrb[cluster]", exc_type=ImportError)


#: Initial values that no file of an experiment contains: a start for each part of a motion.
MOTION = (
    "parameters=[{motion: {of: wall, free: [translation, scale]}, initial: {translation: [0.1, 0, 0.2], scale: 0.9}}]"
)
OWN = Path(__file__).with_name("own_replay.py")


@pytest.fixture
def experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_experiment(tmp_path)
    (tmp_path / "own_replay.py").write_text(OWN.read_text())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def checked(config: Config, integrators: str) -> CheckSettings:
    return settings_of(config, integrators, 0.0, 4, None, 0.0)


def sampled(settings: CheckSettings, place: Place | None, earlier: Kept | None = None) -> tuple[Kept, list[str]]:
    """Run a check with one thread for each process, and return its kept content and its records. The check continues an
    `earlier` one.
    """
    before = None if earlier is None else Earlier(KIND, Path("a.jsonl"), *earlier)
    made = Gradcheck(settings, earlier=before)
    with one_thread():
        if place is None:
            found = [str(record) for record in made.run(lambda: False, lambda line: None)]
        else:
            with checks.samples_at(settings, made.participants, place, "llvm_ad_rgb", threads=1) as engine:
                made.sampling.engine = engine
                found = [str(record) for record in made.run(lambda: False, lambda line: None)]
    kept = made.sampling.kept({})
    assert kept is not None
    return kept, found


def check(settings: CheckSettings, workers: int) -> None:
    """Check that the samples, steps and records of workers equal those of one process."""
    alone, table = sampled(settings, None)
    together, same_table = sampled(settings, Place(workers))
    assert json.dumps(alone[0]) == json.dumps(together[0])
    assert {name: rows.tobytes() for name, rows in alone[1].items()} == {
        name: rows.tobytes() for name, rows in together[1].items()
    }
    assert table == same_table
    assert all(np.isfinite(rows).all() and rows.any() for rows in alone[1].values())


def test_samples_of_workers_equal_those_of_one_process(experiment: Path) -> None:
    """The test covers the steps of differences, which workers do not choose, and initial values that are sent
    separately.
    """
    check(checked(load(experiment / "tiny.yaml", [MOTION]), "reslrb:stack"), 1)


@pytest.mark.long
@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize("case", ["texture", "box", "own"])
def test_any_experiment_and_any_number_of_workers(experiment: Path, case: str, workers: int) -> None:
    if case == "box":
        sets = ["scene.options.size=16", "scene.options.texture=4", "run.spp=4", "integrator.max_depth=3"]
        settings = checked(loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, sets), "reslrb:stack,reslrb:event")
    elif case == "own":
        config = load(experiment / "tiny.yaml").with_code(True)
        settings = checked(config, "own_replay.py:Replay")
    else:
        settings = checked(load(experiment / "tiny.yaml"), "reslrb:stack,reslrb:reservoir")
    check(settings, workers)


@pytest.mark.long
def test_workers_continue_samples_of_one_process(experiment: Path) -> None:
    config = load(experiment / "tiny.yaml")
    few = settings_of(config, "reslrb:stack", 0.0, 3, None, 0.0)
    more = settings_of(config, "reslrb:stack", 0.0, 7, None, 0.0)
    whole, table = sampled(more, None)
    gone_on, same_table = sampled(more, Place(2), sampled(few, None)[0])
    assert {name: rows.tobytes() for name, rows in whole[1].items()} == {
        name: rows.tobytes() for name, rows in gone_on[1].items()
    }
    assert table == same_table


def call(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["gradcheck", *words], prog_name="reslrb")
    return int(ended.value.code or 0)


@pytest.mark.long
def test_cases_of_the_suite_are_calls(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The cases keep the order of one process. Threads add in any order, so that the last digits differ."""
    cases = ["--suite", "extreme:furnace,film_crop", "--integrators", "reslrb:stack", "--seeds", "4"]
    assert call(*cases, "--json", str(tmp_path / "alone.jsonl")) == 0
    alone = capsys.readouterr().out.splitlines()
    assert call(*cases, "--json", str(tmp_path / "two.jsonl"), "--cluster", "local:2") == 0
    together = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in alone] == [line.split()[0] for line in together]
    first, second = (
        [json.loads(line) for line in (tmp_path / name).read_text().splitlines()[1:]]
        for name in ("alone.jsonl", "two.jsonl")
    )
    same = ("case", "parameter", "estimator", "reference", "seeds", "holds")
    assert [[row[name] for name in same] for row in first] == [[row[name] for name in same] for row in second]
    assert call(*cases, "--json", str(tmp_path / "two.jsonl")) == 0
    assert [json.loads(line) for line in (tmp_path / "two.jsonl").read_text().splitlines()[1:]] == second


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--cluster", "local:2"], "--cluster: a budget of seconds has no meaning on other machines"),
        (["--cluster", "2", "--seeds", "4"], "--cluster: must be local:N"),
        (["--cluster", "local:2", "--missing"], "--cluster: has no effect with --missing"),
        (["--cluster", "local:2", "--seeds", "4", "--set", "integrator.guiding=on"], "integrator.guiding: "),
        (["--cluster", "tls://127.0.0.1:9", "--seeds", "4"], "distributed.comm.tls.ca-file: is not set"),
    ],
)
def test_undistributable_checks_are_refused(experiment: Path, capsys, words: list[str], line: str) -> None:
    assert call("tiny.yaml", *words) == 2
    assert line in capsys.readouterr().err.splitlines()[-1]
