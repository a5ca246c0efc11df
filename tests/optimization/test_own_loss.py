"""Losses written by users: when their code runs, the results, and refused losses."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli import tiny
from cli.tiny import KEY, lines, read_metrics, reslrb
from runs.going_on import begin_alone, optimize
from turns import a_few

import reslrb_cli as rl
from reslrb_cli.config.loader import load, told, with_integrator
from reslrb_cli.errors import ConfigError, NonFinite
from reslrb_cli.measure.methods import first_message
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.views import View

OWN = """import drjit as dr
import mitsuba as mi

print("the code was run")


def own(image, target):
    return dr.mean(dr.square(image - target), axis=None)


def with_weights(image, target, weights):
    values = dr.square(image - target)
    return dr.mean(values if weights is None else values * weights, axis=None).array


def nan(image, target):
    return dr.mean(dr.sqrt(image - image - 1), axis=None)


def nan_derivative(image, target):
    return dr.mean(dr.sqrt(image - image), axis=None)


def not_one(image, target):
    return (image - target).array


def number(image, target):
    return 1.0


def constant(image, target):
    return dr.mean(target, axis=None)


def detached(image, target):
    return dr.detach(own(image, target))


def raises(image, target):
    raise ValueError("no such thing")


def ends(image, target):
    raise SystemExit(0)


def needs_two(image):
    return image


text = "no function"
"""
SETS = ("run={iterations: 3, spp: 4, measuring: 0, certainty: false, checkpoint_every: {iterations: 1}}",)


@pytest.fixture
def experiment(llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    begin_alone(tmp_path, monkeypatch)
    (tmp_path / "own.py").write_text(OWN)
    return tmp_path


def run(loss: str, *more: str, name: str = "a") -> int:
    sets = [f"loss={loss}", f"run.name={name}", *more]
    words = [word for each in (*SETS, *sets) for word in (("--set", each) if not each.startswith("--") else (each,))]
    return optimize("tiny.yaml", "--quiet", *words)


def own(name: str) -> str:
    return f"{{type: custom, file: own.py:{name}}}"


def values(name: str) -> dict[str, np.ndarray]:
    with np.load(f"runs/{name}/parameters/parameters.npz") as found:
        return {key: found[key] for key in found.files}


def test_an_own_l2_equals_the_built_in_one_bit_by_bit(experiment: Path) -> None:
    assert run("{type: l2}", name="l2") == 0
    for name in ("own", "with_weights"):
        assert run(own(name), "--allow-code", name=name) == 0
    assert run(f"[{own('own')}]", "--allow-code", name="list") == 0
    for each in ("own", "with_weights", "list"):
        for key, value in values("l2").items():
            np.testing.assert_array_equal(values(each)[key], value)
        assert [r["loss"] for r in read_metrics(f"runs/{each}")] == [r["loss"] for r in read_metrics("runs/l2")]
    assert (values("l2")[KEY] != 0.5).any(), "it moved"


def test_code_needs_permission_to_run(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(own("own")) == 2
    out, err = capsys.readouterr()
    assert "the code was run" not in out
    assert len(lines(err)) == 1
    assert "--set: loss.file: would run the code of" in err or "tiny.yaml: loss.file: would run the code of" in err
    assert "--allow-code" in err
    assert not Path("runs").exists()


def test_a_run_is_read_without_its_code_and_continues_only_with_the_same(
    experiment: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(own("own"), "--allow-code") == 0
    assert "the code was run" in capsys.readouterr().out
    before = set(sys.modules)
    for call in (("report", "runs/a", "-o", "page.html"), ("inspect", "runs/a/config.yaml"),
                 ("render", "runs/a", "-o", "image.exr", "--set", "run.spp=4")):  # fmt: skip
        result = reslrb(*call)
        assert result.exit_code == 0, (call, result.output)
        assert "the code was run" not in result.output
    assert not [name for name in set(sys.modules) - before if name.startswith("reslrb_own_")]
    more = ("--quiet", "--resume", "runs/a", "--set", "run.iterations=4")
    assert optimize(*more) == 2
    assert "--allow-code" in capsys.readouterr().err
    (experiment / "own.py").write_text(OWN + "# another\n")
    assert optimize(*more, "--allow-code") == 2
    err = capsys.readouterr().err
    assert "own.py has changed since runs/a began" in err
    (experiment / "own.py").write_text(OWN)
    assert optimize(*more, "--allow-code") == 0
    assert len(read_metrics("runs/a")) == 4


def test_yaml_cannot_give_permission(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for setting in ("allow_code=true", "run.allow_code=true", "loss.allow_code=true"):
        assert run(own("own"), setting) == 2
        assert "unknown key" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nan", "returns nan"),
        ("nan_derivative", "derivative that is not finite"),
        ("not_one", "returns 192 numbers instead of one"),
        ("number", "returns float, not mi.Float"),
        ("constant", "without a derivative by the image"),
        ("detached", "without a derivative by the image"),
        ("raises", "raises in line 41 ValueError: no such thing"),
        ("ends", "raises in line 45 SystemExit: 0"),
        ("needs_two", "raises"),
        ("text", "has a str, not a function, of the name `text`"),
        ("none", "has nothing of the name `none`"),
    ],
)
def test_an_invalid_loss_is_one_located_line(
    experiment: Path, capsys: pytest.CaptureFixture[str], name: str, words: str
) -> None:
    assert run(own(name), "--allow-code") == 2
    err = capsys.readouterr().err
    assert len(lines(err)) == 1, err
    assert "loss.file: " in err
    assert words in err
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def own(:", "SyntaxError"),
        ("import no_such_thing", "raises in line 1 ModuleNotFoundError"),
        ("1 / 0", "ZeroDivision"),
    ],
)
def test_a_file_that_fails(experiment: Path, capsys: pytest.CaptureFixture[str], text: str, words: str) -> None:
    (experiment / "own.py").write_text(text)
    assert run(own("own"), "--allow-code") == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("file", "words"),
    [("own.py", "must be FILE.py:NAME"), ("own.txt:own", "must be FILE.py:NAME"),
     ("'own.py:a b'", "must be FILE.py:NAME"), ("gone.py:own", "no such file"), ("null", "missing; give FILE.py:NAME")],
)  # fmt: skip
def test_a_missing_name(experiment: Path, capsys: pytest.CaptureFixture[str], file: str, words: str) -> None:
    assert run(f"{{type: custom, file: {file}}}", "--allow-code") == 2
    err = capsys.readouterr().err
    assert "loss.file: " in err
    assert words in err


def test_it_imports_neighbouring_modules_relative_to_the_file(experiment: Path) -> None:
    (experiment / "below").mkdir()
    (experiment / "below/helping_the_loss.py").write_text("from drjit import mean\n")
    (experiment / "below/far.py").write_text(
        "from helping_the_loss import mean\n\n\n"
        "def own(image, target):\n    return mean((image - target) ** 2, axis=None)\n"
    )
    assert run("{type: custom, file: below/far.py:own}", "--allow-code") == 0
    assert f"file: {experiment}/below/far.py:own" in Path("runs/a/config.yaml").read_text()


def test_a_later_nan_is_handled_by_the_policy(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (experiment / "own.py").write_text(
        "import drjit as dr\ncalls = []\n\n\ndef own(image, target):\n    calls.append(1)\n"
        "    value = dr.mean(dr.square(image - target), axis=None)\n"
        "    return value * (float('nan') if len(calls) > 2 else 1)\n"
    )
    assert run(own("own"), "run.on_nonfinite=stop", "--allow-code") == 5
    assert json.loads(Path("runs/a/manifest.json").read_text())["status"] == "failed"
    [line] = [each for each in lines(capsys.readouterr().err) if "not finite" in each]
    assert f"the loss (your own `{experiment}/own.py:own`); dL/dI" in line


def test_a_later_nan_of_a_function_names_it_and_keeps_the_folder_complete(experiment: Path) -> None:
    calls: list[int] = []

    def later(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
        calls.append(1)
        return dr.mean(dr.square(image - target), axis=None) * (np.nan if len(calls) > 3 else 1)

    settings = {"run.measuring": 0, "run.certainty": False, "run.spp": 4, "run.iterations": 30}
    for folder in ("mine", None):
        calls.clear()
        run = rl.optimize("tiny.yaml", folder=folder, loss=later, overrides=settings)
        with pytest.raises(NonFinite, match=r"the loss \(your own `later`\) was not finite in 10 iterations in a row"):
            list(run)
        assert run.status == "failed"
        assert all(np.isfinite(value).all() for value in run.parameters.values())
    assert tiny.files(Path("mine")) >= tiny.COMPLETE - {"images/final.exr", "images/final.png"}
    assert json.loads(Path("mine/manifest.json").read_text())["status"] == "failed"


def test_a_function_object(experiment: Path) -> None:
    seen: list[tuple[int, ...]] = []

    def loss(image: mi.TensorXf, target: mi.TensorXf) -> mi.Float:
        seen.append(tuple(image.shape))
        return dr.mean(dr.abs(image - target), axis=None).array

    config = load("tiny.yaml", ["run.measuring=0", "run.spp=4"]).with_loss(loss)
    problem = assemble(config, to_run=True)
    assert seen == [(8, 8, 3)], "it is tried once"
    assert problem.config.model_dump()["loss"] == {"type": "custom", "file": None}
    view = problem.views[0]
    by_name = assemble(load("tiny.yaml", ["loss.type=l1", "run.measuring=0", "run.spp=4"])).views[0]
    image = np.full((8, 8, 3), 0.3, np.float32)
    assert float(view.compare(mi.TensorXf(image))[0]) == float(by_name.compare(mi.TensorXf(image))[0])


def test_faults_of_a_function_are_located_by_name_and_line(experiment: Path) -> None:
    def nan(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
        return dr.mean(dr.sqrt(image - image - 1), axis=None)

    def raises(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
        raise ValueError("no such thing")

    def wide(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
        return image - target

    def detached(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
        return dr.mean(dr.detach(image), axis=None)

    line = raises.__code__.co_firstlineno + 1
    cases = [
        (nan, "loss: nan: returns nan for"), (wide, "loss: wide: returns 192 numbers instead of one"),
        (detached, "loss: detached: returns a value without a derivative by the image"),
        (raises, f"loss: raises: it raises in line {line} ValueError: no such thing"),
        ("own.py:own", "loss: is no function; a file's is named by the setting"),
    ]  # fmt: skip
    for loss, words in cases:
        with pytest.raises(ConfigError) as error:
            rl.optimize("tiny.yaml", loss=loss, overrides={"run.measuring": 0, "run.spp": 4})  # type: ignore[arg-type]
        assert str(error.value).startswith(words)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("adjoint", a_few(["batched", "independent", "correlated"], ["batched"]))
def test_in_place_changes_of_a_function_stay_local(experiment: Path, adjoint: str) -> None:
    def plain(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
        return dr.mean(dr.square(2 * image - 3 * target), axis=None)

    def in_place(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
        image *= 2
        target *= 3
        return dr.mean(dr.square(image - target), axis=None)

    settings = {"run.measuring": 0, "run.certainty": False, "run.spp": 4, "run.iterations": 3, "run.adjoint": adjoint}
    found = [[record.loss for record in rl.optimize("tiny.yaml", loss=loss, overrides=settings)]
             for loss in (plain, in_place)]  # fmt: skip
    assert found[0] == found[1]


def test_weights_are_passed_to_a_function_that_accepts_them(experiment: Path) -> None:
    rng = np.random.default_rng(1)
    image, target = rng.uniform(0, 1, (2, 8, 8, 3)).astype(np.float32)
    even, uneven = np.ones((8, 8)), rng.uniform(1, 2, (8, 8))
    even[:3] = uneven[:3] = 0

    def view(name: str, weights: np.ndarray) -> View:
        config = load("tiny.yaml", [f"loss={own(name)}", "run.measuring=0"]).with_code()
        made = assemble(config).views[0]
        made.see(target, weights)
        return made

    expected = ((image - target)[3:] ** 2).mean()
    assert float(view("with_weights", even).judge(mi.TensorXf(image))[0]) == pytest.approx(expected, rel=1e-5)
    assert float(view("own", even).judge(mi.TensorXf(image))[0]) == pytest.approx(expected * 5 / 8, rel=1e-5)
    view("with_weights", uneven).judge(mi.TensorXf(image))
    with pytest.raises(ConfigError, match=r"loss\.file: has no argument for the weights"):
        view("own", uneven).judge(mi.TensorXf(image))


def test_measuring_processes_know_the_permission(experiment: Path) -> None:
    call = ["--set", f"loss={own('own')}"]
    result = reslrb("convergence", "tiny.yaml", *call, "--objective", "loss", "--rounds", "2", "--spp", "4,8")
    assert (result.exit_code, "--allow-code" in result.output) == (2, True)
    result = reslrb("gradcheck", "tiny.yaml", *call, "--missing")
    assert (result.exit_code, "--allow-code" in result.output) == (2, True)
    config = load("tiny.yaml", [f"loss={own('own')}"])
    for allowed in (False, True):
        first = first_message(config.with_code(allowed), "llvm_ad_rgb", None)
        assert told(json.loads(json.dumps(first))).allows_code is allowed


def test_functions_and_permission_survive_a_change_of_integrator(experiment: Path) -> None:
    handed = load("tiny.yaml").with_loss(np.mean).with_code()
    other = with_integrator(handed, {"type": "prb"}, "--integrators", {})
    assert (other.own_loss, other.allows_code) == (np.mean, True)
    assert handed.with_exposures_fixed().own_loss is np.mean


@pytest.mark.long
def test_convergence_runs_an_own_loss_in_its_processes(experiment: Path) -> None:
    call = ["convergence", "tiny.yaml", "--set", f"loss={own('own')}", "--rounds", "2", "--spp", "4,8"]
    result = reslrb(*call, "--objective", "loss", "--allow-code", "--integrators", "reslrb")
    assert "reslrb, 8 spp: first step" in result.output
    assert "loss.file" not in result.output
