"""Estimators of the user: registered, named in a configuration, and checked against references."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import ROOT, outcome, read_metrics, settings
from conformance.scenes import stage
from runs.going_on import begin_alone

import reslrb_cli as rl
from reslrb_cli.config import integrators
from reslrb_cli.estimators import ESTIMATORS, Gather
from reslrb_cli.integrators import own
from reslrb_cli.measure import methods

PAGE = (ROOT / "docs/your_estimator.md").read_text(encoding="utf-8")
CODE, CHECK = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
SHORT = settings("run.certainty=false", "run.iterations=2", "run.measuring=0", "run.adjoint=independent")


@pytest.fixture(autouse=True)
def tables(llvm: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Restore the tables of estimators after the test."""
    known = dict(ESTIMATORS)
    monkeypatch.setattr(own, "_loaded", {})
    yield
    for name in set(ESTIMATORS) - set(known):
        del ESTIMATORS[name]
        integrators.OWN_ESTIMATORS.discard(name)


def classes(code: str = CODE) -> dict[str, Any]:
    found: dict[str, Any] = {"__name__": "mine"}
    exec(compile(code, "mine.py", "exec"), found)
    return found


@pytest.fixture
def experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    begin_alone(tmp_path, monkeypatch)
    Path("mine.py").write_text(CODE)
    return tmp_path


def gradient(estimator: str) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    scene, integrator = stage(), mi.load_dict({"type": "reslrb", "max_depth": 4, "estimator": estimator})
    params = mi.traverse(scene)
    key = "wall.bsdf.reflectance.value"
    dr.enable_grad(params[key])
    params.update()
    result = rl.step(integrator, scene, 0, lambda image: dr.sum(image * image, axis=None), seed=1, spp=4, params=params)
    return np.array(result.image), np.array(dr.grad(params[key])).ravel()


def test_a_registered_estimator_works_in_the_plugin() -> None:
    rl.register()
    rl.register_estimator("twice", classes()["Twice"])
    image, found = gradient("twice")
    expected_image, expected = gradient("gather")
    np.testing.assert_allclose(image, expected_image, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert np.abs(expected).min() > 0


def test_a_registered_estimator_works_in_an_experiment(experiment: Path) -> None:
    with pytest.raises(rl.ConfigError, match=r"integrator\.estimator: must be one of"):
        rl.load("tiny.yaml", {"integrator.estimator": "twice"})
    rl.register_estimator("twice", classes()["Twice"])
    losses = []
    for name in ("twice", "gather"):
        options = {"integrator.estimator": name, "run.certainty": False, "run.iterations": 2, "run.measuring": 0}
        losses.append([record.loss for record in rl.optimize("tiny.yaml", overrides=options)])
    np.testing.assert_allclose(*losses, rtol=1e-5)
    [case] = methods.parse_checked("reslrb:twice")
    assert case.at(rl.load("tiny.yaml"), 3, known=True).integrator.options()["estimator"] == "twice"


def test_a_configuration_names_the_file(experiment: Path) -> None:
    named = settings("integrator.estimator=mine.py:Twice")
    code, _, err = outcome("optimize", "tiny.yaml", *SHORT, *named)
    assert code == 2
    assert "integrator.estimator: would run the code of " in err
    assert "; --allow-code permits it" in err
    assert not Path("runs").exists()
    assert outcome("optimize", "tiny.yaml", "--allow-code", *SHORT, *named)[0] == 0
    assert outcome("optimize", "tiny.yaml", *SHORT, *settings("integrator.estimator=gather"))[0] == 0
    first, second = ([each["loss"] for each in read_metrics(f"runs/{name}")] for name in ("tiny", "tiny-2"))
    np.testing.assert_allclose(first, second, rtol=1e-5)
    longer = settings("run.iterations=3")
    assert outcome("optimize", "--resume", "runs/tiny", *longer)[0] == 2
    assert outcome("optimize", "--resume", "runs/tiny", "--allow-code", *longer)[0] == 0
    code, out, _ = outcome("inspect", "runs/tiny")  # shows all but the plan
    assert code == 0
    assert "would run the code of" in out
    Path("mine.py").write_text(CODE + "\n# changed\n")
    code, _, err = outcome("optimize", "--resume", "runs/tiny", "--allow-code", *settings("run.iterations=4"))
    assert code == 2
    assert "mine.py has changed since runs/tiny began" in err
    Path("mine.py").write_text(CODE.replace("def kept", "def keep"))
    code, _, err = outcome("optimize", "tiny.yaml", "--allow-code", *SHORT, *named)  # a new run loads the file again
    assert code == 2
    assert "Twice lacks kept" in err


@pytest.mark.long
def test_gradcheck_names_the_file(experiment: Path) -> None:
    words = ("gradcheck", "tiny.yaml", "--integrators", "reslrb:mine.py:Twice", "--seeds", 3, "--spp", 4)
    code, _, err = outcome(*words)
    assert (code, err) == (2, "--integrators reslrb:mine.py:Twice: would run with all your rights; --allow-code "
                              "permits it\n")  # fmt: skip
    code, out, _ = outcome(*words, "--allow-code")
    assert code == 0
    assert len(re.findall(r"reslrb:mine.py:Twice  walk_ad, equal seeds .* holds$", out, re.MULTILINE)) == 2
    (case,) = methods.parse_cases("reslrb:mine.py:Twice(paths=light)")
    assert case.options == {"estimator": f"{experiment}/mine.py:Twice", "paths": "light"}


@pytest.mark.parametrize(
    ("code", "name", "message"),
    [
        (CODE.replace("delta = p.delta(", "delta = p.dellta("), "Twice",
         "mine.py: Twice: its backward raises in line {} AttributeError: 'Pass' object has no attribute 'dellta'"),
        (CODE, "Replaying", "integrator.estimator: is <class "),
        (CODE, "Nobody", "mine.py has nothing of the name `Nobody`"),
        (CODE.replace("def kept", "def keep"), "Twice", "integrator.estimator: Twice lacks kept"),
        ("raise ValueError('no')", "Twice", "integrator.estimator: the file raises in line 1 ValueError: no"),
    ],
)  # fmt: skip
def test_errors_of_a_class_are_one_line(experiment: Path, code: str, name: str, message: str) -> None:
    Path("mine.py").write_text(code)
    place = settings(f"integrator.estimator=mine.py:{name}")
    status, _, err = outcome("optimize", "tiny.yaml", "--allow-code", "--quiet", *SHORT, *place)
    number = next((n for n, line in enumerate(code.splitlines(), 1) if "dellta" in line), 0)
    assert (status, err.count("\n")) == (2, 1), err
    assert message.format(number) in err


@pytest.mark.parametrize(
    ("name", "kind", "message"),
    [
        ("stack", Gather, "name: is 'stack'; it must be an identifier, and none of auto, reservoir, gather"),
        ("my own", Gather, "name: is 'my own'; it must be an identifier"),
        ("mine", Gather(), "kind: is <reslrb_cli.estimators.gather.Gather o"),
        ("mine", str, "kind: is <class 'str'>, which is no class derived from reslrb_cli.estimators.base.Estimator"),
    ],
)
def test_wrong_names_and_classes_are_refused(name: str, kind: Any, message: str) -> None:
    with pytest.raises(rl.ConfigError) as caught:
        rl.register_estimator(name, kind)
    assert str(caught.value).startswith(message)


# --- the check --------------------------------------------------------------------------------------------------------


def test_the_check_tells_right_from_wrong() -> None:
    right = rl.check_estimator(classes()["Twice"], ["negative_loss"], seeds=8)
    assert right
    assert all(record.holds for record in right)
    assert {record.reference.value for record in right} == {"walk_ad", "ptracer", "path"}
    line = "        S = S.minus(delta, C, vertex.depth, connected)\n"
    assert CODE.count(line) == 1
    wrong = rl.check_estimator(classes(CODE.replace(line, ""))["Twice"], ["negative_loss"], seeds=8)
    failed = [(record.parameter, record.reference.value) for record in wrong if not record.holds]
    assert ("floor.brdf_0.reflectance.value", "ptracer") in failed
    assert all(record.holds for record in wrong if record.parameter is None)  # the image is right
    assert "checked" not in ESTIMATORS


def test_the_check_accepts_names_and_files(experiment: Path) -> None:
    for given, more in (("gather", {}), ("mine.py:Twice", {"allow_code": True})):
        records = rl.check_estimator(given, ["black_lamp"], seeds=8, **more)
        assert [record.case for record in records] == ["black_lamp"] * len(records)
        assert all(record.holds for record in records)
    for given, scenes, message in (
        (
            "mine.py:Twice",
            ["black_lamp"],
            "estimator: would run the code of mine.py:Twice with all your rights; allow",
        ),
        ("twice", ["black_lamp"], "estimator: there is no `twice`; there are reservoir, gather, event, stack"),
        (str, ["black_lamp"], "estimator: is <class 'str'>"),
        ("gather", ["dark_lamp"], "scenes: has 'dark_lamp', which is no scene of the suite"),
    ):
        with pytest.raises(rl.ConfigError) as caught:
            rl.check_estimator(given, scenes)
        assert str(caught.value).startswith(message)
    with pytest.raises(rl.ConfigError, match="seeds: is 2; at least 3 are needed"):
        rl.check_estimator("gather", seeds=2)


@pytest.mark.long
def test_the_example_passes_the_check(experiment: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.syspath_prepend(experiment)
    exec(compile(CHECK, "check.py", "exec"), {"__name__": "__main__"})
    sys.modules.pop("mine", None)
    number, _, count, *_ = capsys.readouterr().out.split()
    assert number == count
    assert int(count) > 40
