"""Results of functions that need files, an environment or stand-ins, as a table of cases (`said.check`)."""

from __future__ import annotations

import json
import os
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from cli import tiny
from cli.tiny import write_photo
from golden import said
from golden.cases import Cases, ending, shown

from reslrb_cli.cli import init, inspect, jobs, optimize, options, render, serve, terminal
from reslrb_cli.records import images, manifest, sweeps
from reslrb_cli.records.manifest import PROGRAM
from reslrb_cli.runs import search
from reslrb_cli.runs import sweep as planned
from reslrb_cli.scene.xml import dictionary

Patch = pytest.MonkeyPatch
case = Cases()


# ---- The command line ----


@case
def gpus_of_the_environment(patch: Patch) -> Any:
    patch.setattr(jobs, "ask_gpu", lambda query: [f"by {query}"])
    found = []
    for given in (None, "", "3", " 3 , , 1,", "GPU-a"):
        patch.delenv(jobs.GPUS, raising=False) if given is None else patch.setenv(jobs.GPUS, given)
        found.append(jobs.visible_gpus())
    return found


@case
def last_lines_of_a_run(patch: Patch) -> Any:
    asked: list[int] = []
    child: Any = SimpleNamespace(tail=lambda size: (asked.append(size), "a\n\n  \nb\r\n c")[1])
    return jobs._last_lines(child), asked


@case
def room_for_a_bar(patch: Patch) -> Any:
    """For each terminal: its width, or the error of asking for it."""
    found = []
    for width in (None, 80, 1, 0, OSError(), ValueError()):

        def size(number: int, width: Any = width) -> Any:
            if isinstance(width, Exception):
                raise width
            return os.terminal_size((width, 5))

        patch.setattr(terminal.os, "get_terminal_size", size)
        stream: Any = SimpleNamespace(isatty=lambda width=width: width is not None, fileno=lambda: 2)
        found.append(terminal.has_room(stream))
    return found


@case
def scenes_by_their_files(patch: Patch) -> Any:
    files = {"a.xml": b"", "B.XML": b"", "c.yaml": b"a: 1", "d": b"<scene/>", "e": b"\xef\xbb\xbf \t\r\n<x", "f": b"",
             "g": b"x<", "h": b" " * 63 + b"<", "i": b" " * 64 + b"<"}  # fmt: skip
    for name, content in files.items():
        Path(name).write_bytes(content)
    return [[name, inspect._is_scene(Path(name))] for name in (*files, "gone", "gone.Xml", ".", "a" * 300)]


@case
def subjects_of_inspect(patch: Patch) -> Any:
    mi.Bitmap(np.ones((2, 2, 3), np.float32)).write("poster.exr")
    tiny.write_experiment(Path())
    texts = {
        "whole.yaml": tiny.CONFIG,
        "scene.yaml": "scene: {file: scene.xml}",
        "null.yaml": "scene: {file: scene.xml}\nrun:",
        "views.yaml": "scene: {file: scene.xml}\nviews: [{sensor: 0}]",
        "cameras.yaml": "scene: {file: scene.xml, cameras: c.json}",
        "list.yaml": "[1]",
        "text.yaml": "scene: x",
    }
    for name, text in texts.items():
        Path(name).write_text(text)
    for folder in ("run", "empty"):
        Path(folder).mkdir()
    Path("run/config.yaml").write_text(tiny.CONFIG.replace("scene.xml", "../scene.xml"))
    Path("run/manifest.json").write_text(f'{{"program": "{PROGRAM}", "status": "finished"}}')
    found = []
    for name in (*texts, "run", "run/config.yaml", "empty", "gone.yaml", "scene.xml"):
        for sets in ((), ("run.spp=3", "target.file=a.png")):
            made = ending(inspect.read_subject, Path(name), sets)
            parts = isinstance(made, inspect.Subject) and [made.is_scene, made.missing, made.run, made.config.run.spp]
            found.append([name, parts or made])
    return found


@case
def settings_that_init_takes(patch: Patch) -> Any:
    Path("a.xml").write_text("<scene/>")
    found = []
    for sets in (
        (),
        ("scene.options.x=3", "variant=llvm_ad_spectral"),
        ("run.spp=3",),
        ("scene.file=b",),
        ("scene={}",),
    ):
        config = ending(init._read_settings, Path("a.xml"), sets)
        found.append(config if isinstance(config, str) else [config.variant, config.scene.options])
    return found


@case
def copies_of_a_photograph(patch: Patch) -> Any:
    """Another copy, or another file of its name, is an error. The copy itself is kept."""
    from reslrb_cli.scene.images import read_stored
    from reslrb_cli.scene.proposal import write_smaller

    write_photo(Path("photo.png"), np.linspace(0, 1, 8 * 6 * 3).reshape(6, 8, 3))
    photo = read_stored(Path("photo.png"), upright=True)
    found = [ending(init._has_copy, Path("copy.png"), photo, (4, 3), False)]
    write_smaller(photo, (4, 3), Path("copy.png"), False)
    found += [ending(init._has_copy, Path("copy.png"), photo, size, False) for size in ((4, 3), (4, 2))]
    Path("folder.png").mkdir()
    Path("link.png").symlink_to("gone.png")
    return [*found, *(ending(init._has_copy, Path(name), photo, (4, 3), False) for name in ("folder.png", "link.png"))]


@case
def shards_and_clusters(patch: Patch) -> Any:
    cluster: Any = SimpleNamespace()
    return [ending(optimize._check_shards, SimpleNamespace(shards=shards, source="c.yaml"), workers)  # type: ignore[arg-type]
            for shards in (1, 2, None) for workers in (None, cluster)]  # fmt: skip


@case
def started_variants(patch: Patch) -> Any:
    """Commands start the variant of their configuration, and measurements name it."""
    patch.setattr("reslrb_cli.backend.variant.set_variant", lambda name: f"started {name}")
    patch.setattr(options, "device_name", lambda variant: f"device of {variant}")
    found = []
    for variant in ("llvm_ad_mono", "cuda_ad_rgb", "auto"):
        origin = options.origin_of(variant)
        config: Any = SimpleNamespace(variant=variant)
        found.append([options.start_variant(config), origin.device, origin.variant])
    return found


@case
def writable_outputs(patch: Patch) -> Any:
    Path("full").write_text("kept")
    Path("link").symlink_to("gone")
    os.mkfifo("pipe")
    Path("folder").mkdir()
    found = [ending(options.check_writable, "--json", Path(name))
             for name in ("new", "full", "link", "pipe", "folder", "nowhere/x", "a\0b")]  # fmt: skip
    return [found, Path("full").read_text(), sorted(os.listdir())]


@case
def paths_of_images(patch: Patch) -> Any:
    Path("folder.png").mkdir()
    os.mkfifo("pipe.png")
    Path("old.png").write_text("kept")
    names = ("a.png", "a.EXR", "a.gif", "a", "folder.png", "pipe.png", "old.png", "nowhere/a.png")
    return [[ending(render.check_image_path, Path(name)) for name in names], sorted(os.listdir())]


@case
def values_of_render(patch: Patch) -> Any:
    texts = (["a=1", "b=[1, 2]"], ["a"], ["=3"], [" =3"], ["a=1", "a =2"], ["a=[1"], ["a=b=c"])
    return [ending(render.parse_values, text) for text in texts]


# ---- The server ----


def made_run(folder: str, metrics: bytes | None = b'{"iteration": 2, "loss": 0.5}\n', **content: Any) -> Path:
    Path(folder).mkdir(parents=True)
    text = json.dumps({"program": PROGRAM, "status": "finished", "started": folder[-1], **content})
    Path(folder, "manifest.json").write_text(text)
    if metrics is not None:
        Path(folder, "metrics.jsonl").write_bytes(metrics)
    return Path(folder)


@case
def last_records(patch: Patch) -> Any:
    lines = (None, b"", b'{"iteration": 1}', b'{"iteration": 1}\n', b'{"iteration": 1}\n{"iteration": 2}\n{"iter',
             b"[1]\n", b"x\n", b'{"a": 1}\n\n', b"\xff\n", b"[" * 100000 + b"\n")  # fmt: skip
    return [serve._last_record(made_run(f"r{n}", each)) for n, each in enumerate(lines)]


@case
def rows_of_served_runs(patch: Patch) -> Any:
    made_run("a/run 1", b'{"iteration": 2, "loss": 0.5, "parameter_rmse": NaN}\n')
    made_run("b", b'{"iteration": null, "loss": true}\n', status="failed", started=None)
    made_run("c", None, status=3)
    Path("c/report.html").write_text("")
    rows = []
    for first in ("", "a/run 1", "b"):
        rows += [[*serve._row(each, first).items()] for each in serve.find_served(Path.cwd()) if each.is_run]
    return rows


@case
def served_folders(patch: Patch) -> Any:
    """Runs in folders of any depth, in a sweep, hidden and linked. Some have a page that is a link, or links to files
    that exist or not, inside of the folder or outside.
    """
    Path("root").mkdir()
    os.chdir("root")
    names = "a b/a b/c/a b/c/d/a .hidden b/.hidden linked s/run-1 out away in loop run/x/a"
    for name in names.split():
        made_run(name)
        Path(name, "report.html").write_text("")
    made_run("run/manifest")
    Path("s", sweeps.SWEEP_FILE).write_text("{}")
    Path("s", sweeps.PAGE_FILE).write_text("")
    Path("../outside").mkdir()
    Path("link").symlink_to("a")
    links = {"linked/report.html": "../a/report.html", "out/x": "../../outside", "away/x": "../../gone",
             "in/x": "../a", "in/y": "../gone", "loop/x": "x"}  # fmt: skip
    for name, target in links.items():
        Path(name).unlink(missing_ok=True)
        Path(name).symlink_to(target)
    found = serve.find_served(Path.cwd())
    return [[each.name, each.page, each.is_run, each.file is not None, str(each.folder)] for each in found]


# ---- Sweeps and searches ----


def sweep_of(text: str = tiny.CONFIG, **more: Any) -> Any:
    Path("c.yaml").write_text(text)
    Path("scene.xml").write_text("<scene/>")
    given = {"vary": ["run.spp=[4, 8]"], "seeds": 2, "overrides": [], **more}
    plan = ending(planned.make_plan, Path("c.yaml"), **given)
    if isinstance(plan, str):
        return plan
    made = plan.sweep
    return [made.config, made.overrides, made.seeds, [each.name for each in made.combinations], sorted(made.files),
            sorted(made.codes), made.search and vars(made.search),
            [config.run.spp for config in plan.configs.values()]]  # fmt: skip


@case
def plans_of_sweeps(patch: Patch) -> Any:
    last = planned.SEED_END - 2
    spread = "run.spp={low: 2, high: 40}"
    changes: list[dict[str, Any]] = [
        {}, {"seeds": 501}, {"overrides": ["run.seed=7"]}, {"overrides": [f"run.seed={last}"]},
        {"overrides": [f"run.seed={last + 1}"]}, {"vary": ["run.spp=[4]", "run.iterations=[1, 2]"]},
        {"vary": ["run.spp=[4]", "run.spp=[5]"]}, {"vary": ["run=[{spp: 4}]", "run.spp=[5]"]}, {"vary": []},
        {"vary": ["run=[{seed: 1}, {seed: 2}]"]}, {"vary": ["run.nothing=[1]"]}, {"vary": [spread], "trials": 3},
        {"vary": [spread, "optimizer.type=[adam, sgd]"], "trials": 3}, 
        {"vary": [spread], "trials": 501}, {"vary": [spread], "trials": 500},
        {"vary": [spread]}, {"vary": ["scene.file=[gone.xml]"]},
    ]  # fmt: skip
    return [sweep_of(**change) for change in changes]


@case
def varied_settings(patch: Patch) -> Any:
    texts = ("a=[1, 2]", "a=[1, 1]", "a=[1, 1.0]", "a=[]", "a=3", "a", "run.seed=[1]", "run.name=[a]", "run.output=[a]",
             "a=[{x: 1, y: 2}, {y: 2, x: 1}]", "a={low: 1, high: 2}", "a={low: 2, high: 1}", "a={low: 1, high: 1}",
             "a={low: 0, high: 1, log: true}", "a={low: 0, high: 1}", "a={low: -1, high: 1, log: false}", "a={low: 1}",
             "a={low: true, high: 2}", "a={low: 1, high: 2, log: 3}", "a={low: 1, high: 2, x: 3}",
             "a={low: 1, high: .inf}", "a={low: .nan, high: 1}", "a={low: 1e-3, high: 0.1, log: true}")  # fmt: skip
    found = []
    for text in texts:
        for searches in (False, True):
            each = ending(planned.parse_vary, text, searches)
            if isinstance(each, planned.Varied):
                values = [[one.label, one.value] for one in each.overrides]
                each = [each.key, each.location, each.given, each.is_range, values]
            found.append([text, searches, each])
    return found


@case
def combinations_one_by_one(patch: Patch) -> Any:
    varied = [planned.parse_vary(text) for text in ("a=[1, 2, 3]", "b=[4]", "c=[5, 6]")]
    return [[override.value for override in chosen] for chosen in planned._one_by_one(varied)]


@case
def integrators_of_a_sweep(patch: Patch) -> Any:
    """Values by name keep depth and shared options. The target keeps the integrator of the experiment."""
    Path("c.yaml").write_text(tiny.CONFIG)
    found = []
    for value in ("prb", "reslrb:reservoir", "prb, ptracer", "nothing", {"type": "ptracer"}):
        for key in ("integrator", "integrator.max_depth"):
            chosen = [planned.Override("--vary x", tuple(key.split(".")), 5 if "depth" in key else value)]
            config = ending(planned.with_chosen, tiny.CONFIG, Path("c.yaml"), ["integrator.rr_depth=2"], chosen, False)
            if not isinstance(config, str):
                kinds = [config.integrator, config.target.render.integrator]
                config = [[each.type, each.max_depth, each.rr_depth] if each else None for each in kinds]
            found.append(config)
    return found


@case
def folders_of_sweeps(patch: Patch) -> Any:
    """Folders that are new, empty, begun, full, in use, or no folder."""
    patch.setattr(planned, "FolderLock", partial(planned.FolderLock, wait_s=0))
    sweep_of()
    plan, found = planned.make_plan(Path("c.yaml"), ["run.spp=[4, 8]"], 1, []), []
    Path("empty").mkdir()
    Path("begun/configs").mkdir(parents=True)
    Path("full").mkdir()
    Path("full/x").touch()
    Path("file").touch()
    for name in ("new/deep", "empty", "begun", "full", "new/deep", "file", "file/x"):

        def start(name: str = name) -> Any:
            with planned.started(Path(name), plan) as made:
                busy = ending(lambda: planned.resumed(Path(name)).__enter__())
                return made == plan.sweep, busy, sorted(str(file) for file in Path(name).rglob("*") if file.is_file())

        found.append([name, ending(start)])
    for name in ("new/deep", "full", "gone"):

        def resume(name: str = name, **more: Any) -> Any:
            with planned.resumed(Path(name), **more) as made:
                return [made.seeds, made.failures]

        found.append([name, ending(resume), ending(resume, seeds=3), ending(resume, seeds=2), ending(resume, trials=2)])
    Path("scene.xml").write_text("<scene> </scene>")
    return [*found, ending(resume, "new/deep"), Path("new/deep", sweeps.SWEEP_FILE).exists()]


@case
def code_of_a_sweep(patch: Patch) -> Any:
    Path("a.py").write_text("x")
    digest = planned.digest_of(Path("a.py"))
    plan = sweeps.SweepPlan("c", [], [], [1], codes={"a.py": digest}, files={"b": "gone"})
    alone = sweeps.SweepPlan("c", [], [], [1], codes={"a.py": "other"}, files={"a.py": "other"})
    return [
        ending(planned._check_files, Path("s"), each, allowed) for each in (plan, alone) for allowed in (False, True)
    ]


@case
def reasons_of_unwritable_sweeps(patch: Patch) -> Any:
    found = [planned._unwritable(Path("s"), OSError(number, os.strerror(number))) for number in (13, 28, 5, 122)]
    return [[type(each).__name__, str(each)] for each in found]


@case
def distributions_of_a_search(patch: Patch) -> Any:
    kinds = SimpleNamespace(
        CategoricalDistribution=lambda values: ["one of", values],
        IntDistribution=lambda low, high, log: ["whole", low, high, log],
        FloatDistribution=lambda low, high, log: ["any", low, high, log],
    )
    texts = ("a=[1, x, [2]]", "a={low: 1, high: 5}", "a={low: 1, high: 5.0}", "a={low: 1.0, high: 5}",
             "a={low: 0.1, high: 5, log: true}", "a={low: 1, high: 5, log: true}")  # fmt: skip
    varied = [planned.parse_vary(text, True) for text in texts]
    found = [search._distribution(SimpleNamespace(distributions=kinds), each) for each in varied]
    return found, [search._to_optuna(each, each.overrides[0].value) for each in varied]


@case
def comparable_searches(patch: Patch) -> Any:
    """Settings that change the loss, the target, the scene or neither, with targets whose values are known or not."""
    patch.setattr(search, "load_optuna", lambda: None)
    found = []
    for key in ("optimizer.learning_rate", "loss.type", "target.file", "scene.file", "run.held_out"):
        two = [sweeps.Combination(name, {key: name}) for name in "ab"]
        for targets in ([(None, True), (None, True)], [(None, True), (None, False)], [({}, False), (None, False)],
                        [({}, False), ({}, False)]):  # fmt: skip
            configs = {n: SimpleNamespace(target=SimpleNamespace(render=render, truth=truth))
                       for n, (render, truth) in enumerate(targets)}  # fmt: skip
            plan: Any = SimpleNamespace(sweep=sweeps.SweepPlan("c", [], two, [1]), configs=configs)
            found.append([key, targets, ending(search.check_search, plan)])
    empty: Any = SimpleNamespace(sweep=sweeps.SweepPlan("c", [], [], [1]), configs={})
    return [*found, ending(search.check_search, empty)]


# ---- Records ----


@case
def times_of_the_last_sign(patch: Patch) -> Any:
    found = []
    for names in ((), ("manifest.json",), ("manifest.json", "metrics.jsonl"), ("checkpoint", "parameters"),
                  ("images", "metrics.jsonl", "other")):  # fmt: skip
        folder = Path(f"run-{len(found)}")
        folder.mkdir()
        for second, name in enumerate(names, 1000):
            (folder / name).touch()
            os.utime(folder / name, (0, second * 1000))
        found.append(manifest._last_sign(folder))
    return [str(each).replace("T", " ") for each in found]


@case
def written_images(patch: Patch) -> Any:
    """Slices of larger arrays, and any number of channels, in linear formats and in sRGB."""
    large = np.linspace(-0.2, 1.2, 6 * 8 * 5).reshape(6, 8, 5)
    found = []
    for suffix in ("exr", "pfm", "png"):
        for channels in (1, 2, 3, 4):
            file = Path(f"{channels}.{suffix}")
            fault = ending(images.write_file, file, large[::2, 1:5, :channels], suffix != "png")
            found.append([file.name, fault, shown(np.array(mi.Bitmap(str(file)))) if file.is_file() else None])
    return found


@case
def written_parameters(patch: Patch) -> Any:
    """Textures, heightmaps, colours, numbers and masks, as arrays and as pictures."""
    heights = np.float32([[[-1], [0]], [[1], [3]]])
    found = {"a.data": np.linspace(0, 1, 12).reshape(2, 2, 3), "b.heightmap": heights, "c": np.array(2.0),
             "d": np.ones(3), "e/f g": np.arange(40.0), "h.data": np.full((1, 2, 1), 0.5)}  # fmt: skip
    images.write_parameters(Path("p"), {key: value.astype(np.float32) for key, value in found.items()})
    for mask in (np.array([[True, False], [False, True]]), np.array([True, False]), np.array(True)):
        images.write_mask(Path("p"), f"m{mask.ndim}", mask)
    return {file.name: said.content(file, Path.cwd()) for file in sorted(Path("p").iterdir())}


@case
def layers_of_files(patch: Patch) -> Any:
    """Of channels with the same name in several parts, the first counts."""
    import OpenEXR

    parts = [OpenEXR.Part({"type": OpenEXR.scanlineimage}, {name: np.full((2, 3), value, "float32")
                                                             for name in names}, f"p{value}")
             for value, names in ((1, ("R", "Z")), (2, ("R", "x.G")))]  # fmt: skip
    OpenEXR.File(parts).write("a.exr")
    Path("b.exr").write_text("no")
    return {name: shown(plane) for name, plane in images.read_planes(Path("a.exr")).items()}, [
        ending(images.read_planes, Path(name))[:30] for name in ("b.exr", "gone.exr")]  # fmt: skip


# ---- Scenes ----


@case
def values_of_dictionaries(patch: Patch) -> Any:
    """Values of every kind, in a scene file. Values that it cannot express are errors."""
    Path("a.png").touch()
    T, writer = mi.ScalarTransform4f, dictionary._Writer("s", [Path.cwd(), Path("/gone")])
    values = (1, 2.5, True, False, "text", np.float32(0.1), np.int64(3), np.bool_(True), [1, 2, 3], (0.5, 1, 2), [1, 2],
              np.zeros((1, 1), int), [[1]], None, object, Path("a.png"), Path("gone.png"),
              mi.ScalarColor3f(0.1, 0.2, 0.3),
              mi.ScalarPoint3f(1, 2, 3), T().translate([1, 2, 3]), mi.ScalarTransform3f().scale([2, 3]),
              mi.load_dict({"type": "diffuse"}), {}, b"x", float("nan"), 10**30, [1, "a", 2], "inf")  # fmt: skip
    found: list[Any] = [[str(type(value)), ending(writer._value, "x", value, "scene.x")] for value in values]
    found += [ending(writer._value, "filename", name, "scene.x") for name in ("a.png", "gone.png", "")]
    for kind in ("rgb", "spectrum"):
        for value in ({}, {"value": 1}, {"value": [1, 2, 3]}, {"value": [1, 2]}, {"value": "#ff0000"}, {"value": None},
                      {"value": [(400, 0.5), (700, 1)]}, {"filename": "a.png"}, {"value": 1, "x": 2}, {"value": object},
                      {"value": 1, "id": "a", "type": kind}):  # fmt: skip
            element = ending(writer._colour, kind, value, {"name": "n"}, "scene.x")
            found.append(element if isinstance(element, str) else [element.tag, element.attributes])
    for shape in ((2, 3), (2, 3, 1), (2, 3, 2), (2, 3, 3), (2, 3, 4), (2, 3, 5), (2,), (1, 2, 3, 1)):
        element = ending(writer._image, "n", np.ones(shape, np.float32), "scene.x")
        found.append(element if isinstance(element, str) else element.attributes)
    return [found, {name: image.shape for name, image in writer.images.items()}]


test_cases = pytest.mark.usefixtures("llvm")(case.test())


def test_a_changed_result_is_found(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.delenv("RESLRB_GOLDEN", raising=False)
    table = Cases()

    @table
    def last_lines_of_a_run(patch: Patch) -> Any:
        return "another result"

    with pytest.raises(AssertionError, match="case last_lines_of_a_run has changed"):
        table.test()(last_lines_of_a_run, tmp_path, monkeypatch)
