"""Everything that commands print and write (`said.check`): refused calls, and measurements by pretended processes."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cli.tiny import files, outcome, reslrb, write_experiment, write_photo
from golden import said
from kit import work_in
from measure.pretended_steps import CONFIG, Pretence, Pretended, Stage
from report.measured import make_run

from reslrb_cli.backend.doctor import device_name
from reslrb_cli.cli import gradcheck
from reslrb_cli.measure import bench, convergence, extreme, methods, missing
from reslrb_cli.measure import gradcheck as checks
from reslrb_cli.records.measurements import GradcheckRecord, Kind, MissingRecord, Reference, Verdict

pytestmark = pytest.mark.usefixtures("llvm")


# Refused calls: the exit code and the line.

#: Calls without `reslrb`. `@` stands for `--search optuna --trials 3 --vary`.
CALLS = """

optimise
inspekt a.yaml
frobnicate
--nope
doctor --nope
optimize
optimize gone.yaml
optimize tiny.yaml --resume a
optimize --resume a --dry-run
optimize tiny.yaml --dry-run --cluster local:2
optimize tiny.yaml --cluster local:0
optimize tiny.yaml --cluster local:1025
optimize tiny.yaml --cluster tls://host:0
optimize tiny.yaml --cluster local:2
optimize tiny.yaml --log nobody
optimize tiny.yaml --set run.output=note.txt
optimize tiny.yaml --set run.output=note.txt/runs
optimize tiny.yaml --set run.spp=x
optimize --resume gone
optimize --resume empty
optimize --resume note.txt
optimize --resume a
optimize a
optimize empty
optimize a --free lamp.emitter.radiance.value
optimize empty --free lamp.emitter.radiance.value
optimize tiny.yaml --free lamp.emitter.radiance
optimize tiny.yaml --free poster.reflectance.data
optimize tiny.yaml --free wall.to_world
optimize tiny.yaml --free *.radiance.value
optimize tiny.yaml --free ''
optimize --resume a --free lamp.emitter.radiance.value
render tiny.yaml -o x.exr --exposure bright
render tiny.yaml -o x.png --exposure 0
render tiny.yaml -o x.png --exposure inf
render tiny.yaml -o x.png --exposure nan
render tiny.yaml -o x.exr --exposure 2
render a -o x.exr --exposure 2
render a -o x.exr --scene
render empty -o x.exr
render tiny.yaml -o x.gif
render tiny.yaml -o exr
render tiny.yaml -o folder.exr
render tiny.yaml -o gone/x.exr
render tiny.yaml -o pipe.exr
render tiny.yaml -o x.exr --sensor 7
render tiny.yaml -o x.exr --sensor 0 --set 'scene.file=<mi.Scene>'
render tiny.yaml -o x.exr --sensor 2 --set 'views=[{sensor: 0}, {sensor: 0, lamps: [lamp]}]'
render tiny.yaml -o x.exr --value k
render tiny.yaml -o x.exr --value =1
render tiny.yaml -o x.exr --value k=1 --value k=2
export gone -o x
export empty -o x
export a -o a
report gone
report a note.txt
report empty
report a a
report a -o gone/page.html
report a -o page.doc
report pipe
report \x1b[31m
inspect none.xml
inspect none.yaml
inspect .
inspect scene.xml --set scene.options.nothing=1
inspect scene.xml --set scene.filee=1
inspect empty.yaml
inspect run.yaml
init scene.xml --target wide.png
init scene.xml --target none.png
init scene.xml --target scene.xml
init none.xml
init scene.xml -o config.txt
init scene.xml -o gone/config.yaml
init scene.xml -o tiny.yaml
init scene.xml --sensor 1
init scene.xml --set run.spp=4
example nothing
example cornel_floor
example cornell_floor -o note.txt
lens wide.png --sun 1 --light-distance 100
lens wide.png -o note.txt
lens wide.png -o lens
lens none.png -o x
lens wide.png --ior glas
lens wide.png -o x --mirror 30 --outline round --light-distance 100
serve gone
serve a --port 70000
bench none.yaml
bench --max-depth 1
bench --sweep film
bench --sweep spp --max-depth 3
bench --sweep depth --values 3 --max-depth 3
bench --sweep spp --values 3 --max-depth 3
bench --values 4,x
bench --values 4,4
bench --integrators pt
bench --json gone/folder.json
bench --resum a
convergence tiny.yaml --integrators reslrb:stack(adjoint=batched)
convergence tiny.yaml --reference ptracer,prb
convergence tiny.yaml --reference walk
convergence tiny.yaml --json gone/a.jsonl
convergence tiny.yaml --draws gone/a.npz
convergence tiny.yaml --objective gradient
convergence tiny.yaml --spp 4,0
convergence tiny.yaml --spp 4,4
convergence tiny.yaml --spp 3 --set integrator.samples_per_pass=2
convergence tiny.yaml --integrators reslrb:auto
convergence
gradcheck --integrators reslrb:stak
gradcheck --integrators reslrb:stack(
gradcheck --integrators prb
gradcheck --set run.sp=3
gradcheck --seeds 2
gradcheck --json gone/a.jsonl
gradcheck --json pipe
gradcheck --draws gone/a.npz
gradcheck nothing.yaml
gradcheck --missing
gradcheck --missing --draws a.npz
gradcheck tiny.yaml --missing --suite extreme
gradcheck --suite extreme --set run.spp=4
gradcheck --suite extreme --draws a.npz
gradcheck --suite extreme --budget 4
gradcheck --suite extrem
gradcheck --suite extreme a.yaml
gradcheck --suite extreme --spp 4
gradcheck --suite extreme:furnac
gradcheck --suite extreme --integrators reslrb:stak
gradcheck --suite extreme --integrators own.py:A
gradcheck --suite extreme --integrators reslrb:event(capacity=2)
sweep
sweep tiny.yaml --resume a
sweep --resume s
sweep --resume .
sweep tiny.yaml -o tiny.yaml
sweep tiny.yaml -o .
sweep tiny.yaml -o tiny.yaml/s
sweep tiny.yaml --vary run.spp
sweep tiny.yaml --vary run.spp=4
sweep tiny.yaml --vary run.spp=[]
sweep tiny.yaml --vary 'run.spp=[4, 4]'
sweep tiny.yaml --vary 'run.spq=[4, 8]'
sweep tiny.yaml --vary 'run.spp=[4, {}]'
sweep tiny.yaml --vary run.spp=[4 --seeds 2
sweep tiny.yaml --vary 'run.seed=[1, 2]'
sweep tiny.yaml --vary 'run.name=[a, b]'
sweep tiny.yaml --vary 'run.output=[a, b]'
sweep tiny.yaml --vary 'run=[{spp: 4}, {seed: 3}]'
sweep tiny.yaml --vary run.spp=[4] --vary 'run=[{spp: 4}]'
sweep tiny.yaml --vary 'run.spp=[4, 8]' --seeds 501
sweep tiny.yaml --set run.seed=4294967295 --seeds 2
sweep tiny.yaml --vary 'run.spp=[4, 6]' --vary 'run.adjoint=[independent, batched]'
sweep tiny.yaml --set scene.file=gone.xml --vary run.spp=[4]
sweep tiny.yaml --vary 'integrator=[prb, path]'
sweep tiny.yaml --vary "integrator=[prb, 'ptracer,prb']"
sweep tiny.yaml --vary "integrator=[prb, 'reslrb:']"
sweep tiny.yaml --vary integrator=[own.py:Own]
sweep tiny.yaml --vary 'run.spp={low: 2, high: 4}'
sweep tiny.yaml --search optuna
sweep tiny.yaml --trials 3
sweep tiny.yaml --search optuna --trials 3
sweep tiny.yaml --search grid --trials 3
sweep tiny.yaml @ 'optimizer.learning_rate={low: 0, high: 1, log: true}'
sweep tiny.yaml @ 'optimizer.learning_rate={low: 1, high: 1}'
sweep tiny.yaml @ 'optimizer.learning_rate={low: 0.1, high: .inf}'
sweep tiny.yaml @ 'optimizer.learning_rate={low: 0.1, hi: 1}'
sweep tiny.yaml @ 'optimizer.learning_rate={low: 0.1, high: 1, lag: true}'
sweep tiny.yaml @ 'optimizer.learning_rate={low: 0.1, high: x}'
sweep tiny.yaml @ 'optimizer.learning_rate={low: true, high: 2}'
sweep tiny.yaml @ 'optimizer.learning_rate={low: 0.1, high: 1, log: 1}'
sweep tiny.yaml @ 'optimizer.type=[adam, sdg, sgd]'
sweep tiny.yaml @ optimizer.learning_rate=0.1
sweep tiny.yaml @ 'run.spp={low: 0.5, high: 4}'
sweep tiny.yaml @ 'run.spp={low: -1, high: 4}'
sweep tiny.yaml @ 'optimizer.learning_rate={low: 0.1, high: 1}' --seeds 400
sweep tiny.yaml @ 'loss.type=[l1, l2]' --set 'target={file: square.png}'
"""


@pytest.fixture(scope="module")
def folder(llvm: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with an experiment, a run that has ended, and files and folders of other kinds."""
    folder = tmp_path_factory.mktemp("calls")
    write_experiment(folder)
    make_run(folder / "a", iterations=0)
    for name in ("empty", "folder.exr", "lens"):
        (folder / name).mkdir()
    for name, text in (("note.txt", "hello\n"), ("empty.yaml", ""), ("run.yaml", "run: {spp: 4}"),
                       ("lens/lens.yaml", "x"), ("own.py", "class Own: pass")):  # fmt: skip
        (folder / name).write_text(text)
    for name in ("pipe", "pipe.exr"):
        os.mkfifo(folder / name)
    write_photo(folder / "wide.png", np.random.default_rng(3).uniform(0, 0.9, (8, 16, 3)))
    write_photo(folder / "square.png", np.full((8, 8, 3), 0.5))
    return folder


@pytest.mark.parametrize("call", CALLS[1:-1].split("\n"))
def test_refused_calls(folder: Path, call: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    before = files(folder)
    words = shlex.split(call.replace("@", "--search optuna --trials 3 --vary"))
    code, out, err = outcome(*words)
    *before_it, line = err.splitlines()
    assert (code, out, [each for each in before_it if not each.startswith("variant ")]) == (2, "", [])
    said.check(f"call {call}", line.replace(f"{folder}/", ""))
    assert files(folder) == before


# Measurements.


@pytest.fixture
def _work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work_in(tmp_path, monkeypatch)
    Path("x.yaml").write_text(CONFIG)
    monkeypatch.setattr(methods, "memory_bytes", lambda *_: 5 * 2**30)


def check(*words: str) -> None:
    """Check the exit code, the output and the file of `--json` of a command. Options of methods and missing values are
    left out of the file.
    """
    result = reslrb(*words, "--json", "a.jsonl")
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    warned = said.lines_of(result.stderr)
    lines = Path("a.jsonl").read_text().splitlines() if Path("a.jsonl").exists() else []
    records = [
        {key: value for key, value in json.loads(line).items() if key != "options" and value is not None}
        for line in lines
    ]
    records[:1] = [said.masked(origin, Path.cwd()) for origin in records[:1]]
    written = [json.dumps(short(each)) for each in records]
    printed = [line.replace(device_name("llvm"), "DEVICE") for line in result.stdout.splitlines()]
    said.check(" ".join(words), [result.exit_code, *printed, *warned, *written])


def short(value: Any) -> Any:
    """Return JSON with numbers of four digits."""
    if isinstance(value, dict):
        return {key: short(each) for key, each in value.items()}
    return float(f"{value:.4g}") if isinstance(value, float) else value


THREE = ("--integrators", "ptracer,reslrb:stack,walk_ad", "--rounds", "3")


@pytest.mark.usefixtures("_work")
@pytest.mark.parametrize(
    ("words", "ends"),
    [
        ("--max-depth 4", {}),
        ("--sweep spp", {}),
        ("--values 2,7", {("reslrb", 7): 2}),
        ("--values 2,16", {("ptracer", 2): 1}),
        ("--max-depth 2", dict.fromkeys([("ptracer", 2), ("reslrb", 2), ("walk_ad", 2)], 1)),
    ],
)
def test_bench(words: str, ends: dict[Any, int], monkeypatch: pytest.MonkeyPatch) -> None:
    Pretended.log, Pretended.ends, Pretended.refusing, Pretended.alive = [], ends, set(), 0
    monkeypatch.setattr(bench, "Bench", partial(bench.Bench, start=Pretended))
    check("bench", "x.yaml", *THREE, *words.split())


@pytest.mark.usefixtures("_work")
@pytest.mark.parametrize(
    ("words", "played"),
    [
        ("--rounds 16", {}),
        ("--rounds 8 --spp 4,16 --set integrator.rr_depth=2", {"reslrb_event": Pretence(0.3, noise=3.0)}),
        ("--rounds 8 --objective loss --integrators reslrb:stack,reslrb:stack(adjoint=correlated)", {}),
        ("--rounds 8 --objective image --integrators ptracer,prb", {"ptracer": Pretence(bias=0.5)}),
        ("--rounds 8 --reference prb", {"case_reslrb_event": Pretence(refuses=True), "ptracer": Pretence(ends=4)}),
        ("--rounds 8 --integrators ptracer", {"case_ptracer": Pretence(ends=1)}),
        ("--rounds 2", {}),
    ],
)
def test_convergence(words: str, played: dict[str, Pretence], monkeypatch: pytest.MonkeyPatch) -> None:
    stage = Stage({"masked": "spp" in words, "pictures": "8 images" if "loss" in words else ""}, **played)
    monkeypatch.setattr(convergence, "Session", partial(convergence.Session, start=stage.start, now=stage.clock))
    named = () if "--integrators" in words else ("--integrators", "ptracer,reslrb:stack,reslrb:event")
    check("convergence", "x.yaml", *words.split(), *named)


def compared(parameter: str, label: str, verdict: Verdict, message: str = "", **figures: Any) -> GradcheckRecord:
    kind = Kind.EQUAL_SEEDS if "relative_l2" in figures else Kind.EXPECTATION
    figures |= {"relative_l2_limit": 1e-4} if kind is Kind.EQUAL_SEEDS else {"z_rms_limit": 1.4, "z_max_limit": 4.5}
    reference = Reference.WALK_AD if kind is Kind.EQUAL_SEEDS else Reference.PTRACER
    return GradcheckRecord("x.yaml", parameter, label, {}, reference, kind, 8, verdict, message=message, **figures)


HOLDS = compared("a", "reslrb:stack", Verdict.HOLDS, relative_l2=2e-6, cosine=1.0)
FAILS = compared("b", "reslrb:event", Verdict.FAILS, z_rms=3.2, z_max=9.5, variance_ratio=2.0)
OPEN = compared("b", "reslrb:stack", Verdict.UNRESOLVED, "is noisy", z_rms=1.1, z_max=2.5, detectable=1.5)
UNMEASURED = compared("a", "reslrb:event", Verdict.NOT_MEASURED, "the budget was spent")


@pytest.mark.usefixtures("_work")
@pytest.mark.parametrize(
    ("words", "records"),
    [
        ("--seeds 8", [HOLDS, FAILS, OPEN, UNMEASURED]),
        ("--budget 7 --spp 3 --integrators reslrb:stack", [HOLDS, OPEN]),
        ("--seeds 5", [UNMEASURED, UNMEASURED]),
        ("--seeds 4", []),
        ("--suite extreme --seeds 6 --integrators reslrb:stack,reslrb:gather(paths=both)", [HOLDS, FAILS, OPEN]),
        ("--suite extreme:second", [HOLDS, OPEN]),
        ("--suite extreme:second,third --set variant=llvm_ad_spectral", [HOLDS]),
    ],
)
def test_gradcheck(words: str, records: list[GradcheckRecord], monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[object] = []

    class Checked:
        seeds = 16

        def __init__(self, settings: Any, file: object) -> None:
            told.append(
                [settings.budget_s, settings.seeds, settings.spp, [case.label for case in settings.integrators]]
            )

        def conditions(self) -> str:
            return "conditions"

        def run(self, stop: object, say: Callable[[str], None], refresh: Callable[[], None]) -> list[GradcheckRecord]:
            say("comparing")
            refresh()
            return records

        def records(self, interrupted: bool) -> list[GradcheckRecord]:
            return records

    def of_case(stop: object, name: str, *chosen: object) -> list[GradcheckRecord]:
        told.append([name, *chosen])
        return [replace(record, case=name) for record in records]

    monkeypatch.setattr(checks, "Gradcheck", Checked)
    monkeypatch.setattr(extreme, "case_records", of_case)
    reasons = {"first": "", "second": "", "third": "has no spectra"}
    monkeypatch.setattr(
        extreme, "CASES", {name: SimpleNamespace(not_spectral=reason) for name, reason in reasons.items()}
    )
    check("gradcheck", *([] if "--suite" in words else ["x.yaml"]), *words.split())
    said.check(f"settings of gradcheck {words}", told)


@pytest.mark.usefixtures("_work")
@pytest.mark.parametrize("words", ["--budget 60", "--seeds 3 --spp 5"])
def test_gradcheck_missing(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second parameter takes half of its time, which the third gets."""
    clock, asked = SimpleNamespace(now=100.0), []
    shares = {"a": (0.2, 0.01), "b": (0.001, 0.001), "c": (None, None)}

    class Missing:
        source, keys = "x.yaml", list(shares)

        @classmethod
        def of_config(cls, config: object, spp: int | None) -> Missing:
            asked.append(spp)
            return cls()

        def conditions(self) -> str:
            return "conditions"

        def measured(self, key: str, affords: Callable[[int], bool], most: int, looks: bool) -> MissingRecord:
            begin = clock.now
            while affords(0) and clock.now - begin < (10 if key == "b" else 50):
                clock.now += 0.5
            asked.append([key, clock.now - begin, most, looks])
            return MissingRecord("x.yaml", key, *shares[key], 3, 4)

    monkeypatch.setattr(missing, "MissingCheck", Missing)
    monkeypatch.setattr(gradcheck, "time", SimpleNamespace(monotonic=lambda: clock.now))
    check("gradcheck", "x.yaml", "--missing", *words.split())
    said.check(f"times of gradcheck --missing {words}", asked)
