"""Hundreds of scenes and images that are nearly right, in processes with limits: each works, or is one located line.

A few by default. A process that ends in the midst of a case, or takes too long over it, is a fault of ours; nothing
may be written but the run folder and the cache.
"""

from __future__ import annotations

import json
import os
import random
import re
import select
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from cli.tiny import CONFIG, ROOT, SCENE, write_experiment
from compilation import search_path
from scene.mutations import mutate_bytes, mutate_scene, write_images

pytestmark = [
    pytest.mark.usefixtures("llvm"),
    pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, and limits memory"),
]
#: A warning in Mitsuba's own log, which it prints in red: of its text nothing else may reach a terminal.
_RED = re.compile(r"\x1b\[31m([^\x1b]*)\x1b\[0m")
#: Seconds that a case may take; a hang takes longer on any machine.
SECONDS = 100
PHOTO = CONFIG.replace("{render: {spp: 16}}", "{file: x.exr}").replace("iterations: 5", "iterations: 1")
PHOTO = PHOTO.replace("spp: 4, reach_spp: 8", "spp: 4, certainty: false, final_spp: 1")
RUN = CONFIG.replace("{render: {spp: 16}}", "{render: {spp: 1}}").replace("file: scene.xml", "file: mutated.xml")
RUN = RUN.replace("iterations: 5, spp: 4, reach_spp: 8", "iterations: 1, spp: 1, reach_spp: 1, final_spp: 1")


class Hostile:
    """The process that is asked; made anew where it ended."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._process = folder, self._start(folder)

    @staticmethod
    def _start(folder: Path) -> subprocess.Popen[str]:
        environment = {**os.environ, "PYTHONPATH": search_path(ROOT, ROOT / "tests")}
        environment["RESLRB_CACHE"] = str(folder / "cache")
        command = [sys.executable, "-m", "scene.hostile"]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        return subprocess.Popen(command, cwd=folder, env=environment, text=True, **pipes)  # type: ignore[call-overload,no-any-return]

    def ask(self, question: str) -> dict[str, object]:
        """The answer, with code `hang` or `ended by N` where there is none."""
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(question + "\n")
        process.stdin.flush()
        ready, _, _ = select.select([process.stdout], [], [], SECONDS)
        line = process.stdout.readline() if ready else ""
        if line:
            return json.loads(line)  # type: ignore[no-any-return]
        process.kill()
        process.wait()
        self._process = self._start(self.folder)
        return {"code": f"ended by {process.returncode}" if ready else "hang", "said": ""}

    def end(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "place"
    place.mkdir()
    write_experiment(place)
    (place / "photo.yaml").write_text(PHOTO)
    (place / "run.yaml").write_text(RUN)
    return place


def state(folder: Path) -> dict[str, bytes]:
    """All files around and in a folder, but for what a run may write."""
    own = (folder / "runs", folder / "cache")
    return {
        str(path): path.read_bytes()
        for path in folder.parent.rglob("*")
        if path.is_file() and not any(path.is_relative_to(place) for place in own)
    }


def judge(seed: int, answer: dict[str, object], seen: Counter[object]) -> list[str]:
    """What is wrong with an answer."""
    code, said = answer["code"], str(answer["said"])
    seen[code] += 1
    if code not in (0, 2, 4, 5) or "Traceback" in said:
        return [f"seed {seed}: {code}: {said}"]
    if code and (not said.strip() or not said.splitlines()[-1].isprintable()):
        return [f"seed {seed}: {code}, and no line: {said!r}"]
    below = _RED.sub(r"\1", str(answer.get("below", "")))
    if not all(character.isprintable() or character in "\n\t" for character in below):
        return [f"seed {seed}: printed past us: {below!r}"]
    return []


def sources(folder: Path) -> list[str]:
    """Scenes to begin with; their files come to lie in `folder`."""
    texts = [SCENE]
    for name in ("lens_pose", "caustic_slab", "grey_room"):
        for file in (ROOT / "scenes" / name).iterdir():
            if file.suffix != ".xml":
                (folder / file.name).write_bytes(file.read_bytes())
        texts.append((ROOT / "scenes" / name / "scene.xml").read_text())
    return texts


@pytest.mark.parametrize(("first", "count"), [(0, 8), pytest.param(1000, 500, marks=pytest.mark.long)])
def test_mutated_scenes(folder: Path, first: int, count: int) -> None:
    hostile, seen, faults = Hostile(folder), Counter[object](), []
    mutated, texts = folder / "mutated.xml", sources(folder)
    meshes = sorted(folder.glob("*.ply"))
    whole = {mesh: mesh.read_bytes() for mesh in meshes}
    try:
        for seed in range(first, first + count):
            rng = random.Random(seed)
            for mesh, data in whole.items():
                mesh.write_bytes(data)
            if seed % 5:
                mutated.write_bytes(mutate_scene(rng, rng.choice(texts)))
            else:  # a good scene, of damaged meshes
                mutated.write_text(rng.choice([text for text in texts if ".ply" in text]))
                for mesh in meshes:
                    mesh.write_bytes(mutate_bytes(rng, whole[mesh]))
            before = state(folder)
            answer = hostile.ask("scene mutated.xml")
            faults += judge(seed, answer, seen)
            if answer["code"] == 0 and seed % 4 == 0:
                faults += judge(seed, hostile.ask("run run.yaml"), seen)
            faults += [] if state(folder) == before else [f"seed {seed}: files were written"]
    finally:
        hostile.end()
    print(dict(seen))
    assert faults == []
    assert seen[0] >= count / 20
    assert seen[2] >= count / 10


@pytest.mark.parametrize(("first", "count"), [(0, 10), pytest.param(1000, 500, marks=pytest.mark.long)])
def test_mutated_images(folder: Path, first: int, count: int) -> None:
    """As a target, and every second one as a texture of the scene."""
    hostile, seen, faults = Hostile(folder), Counter[object](), []
    images = write_images(folder)
    try:
        for seed in range(first, first + count):
            rng = random.Random(seed)
            good = rng.choice(images)
            image = folder / f"mutated{good.suffix}"
            image.write_bytes(mutate_bytes(rng, good.read_bytes()))
            (folder / "mutated.xml").write_text(SCENE.replace("poster.exr", image.name))
            before = state(folder)
            question = "scene mutated.xml" if seed % 2 else f"photo {image.name}"
            faults += judge(seed, hostile.ask(question), seen)
            faults += [] if state(folder) == before else [f"seed {seed}: files were written"]
            image.unlink()
    finally:
        hostile.end()
    print(dict(seen))
    assert faults == []
    assert seen[0] >= count / 20
    assert seen[2] >= count / 4
