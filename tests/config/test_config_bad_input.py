"""Tests of the error lines for wrong configurations. Each error is one line that names the place and a correct
value.
"""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError, ExitCode

GOOD = """\
scene: {file: scene.xml}
target: {render: {}}
parameters:
  - {key: floor.reflectance.data}
"""


def line_of(tmp_path: Path, text: str | bytes, overrides: tuple[str, ...] = ()) -> str:
    path = tmp_path / "x.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError) as caught:
        load(path, overrides)
    assert caught.value.exit_code == ExitCode.USAGE
    line = str(caught.value)
    assert "\n" not in line
    return line.replace(str(path), "x.yaml")


def changed(old: str, new: str) -> str:
    assert old in GOOD
    return GOOD.replace(old, new)


def scene(file: str) -> str:
    return changed("scene.xml", file)


PARAMETER = "{key: floor.reflectance.data}"

#: Text that is added to the valid file, and parts of the error line.
ADDED: dict[str, str | tuple[str, ...]] = {
    "loss: {type: huba}": "loss.type: must be one of l2, l1, relative_l2, ssim, custom, not",
    "optimiser: {}": ("optimiser: unknown key", "`optimizer`"),
    "run: {iteration: 3}": ("run.iteration: unknown key", "`iterations`"),
    "fabrication: {thickness: 3, ior: PMA}": "fabrication.ior: there is no glass 'PMA'; did you mean `PMMA`?",
    "fabrication: {thickness: 3, ior: 1}": "fabrication.ior: must be above 1 and at most 5, or the name of a material",
    "run: {xyz: 3}": "run.xyz: unknown key; known here: name, output",
    "spp: 3": ("spp: unknown key", "`run.spp`"),
    "loss: {spp: 3}": ("loss.spp: unknown key", "`run.spp`"),
    "run: {spp: 0, seed: -1, iterations: x}": ("run.", "(and 2 more)"),
    "run: fast": ("run: must be a mapping", "'fast'"),
    "loss: [l1]": "loss[0]: must be a mapping such as {type: NAME}",
    "optimizer: {scale: 1e6}": ("optimizer.scale: must be", "curvature"),
    "views: [{sensor: -1}]": "views[0].sensor: must be at least 0",
    "integrator: {type: reslbr}": "integrator.type: must be one of reslrb, ptracer, prb, prb_projective, walk_ad,",
    "integrator: {type: prb, estimator: reservoir}": "integrator.estimator: not an option of prb but of reslrb",
    "integrator: {estimator: gather, capacity: 2}": "integrator.capacity: has no effect with estimator `gather`, only",
    "integrator: {capacity: 1}": "integrator.capacity: has no effect with estimator `auto`, only with `reservoir` or",
    "integrator: {estimator: gater}": ("integrator.estimator: must be one of", "(did you mean `gather`?)"),
    "integrator: {edges: maybe}": "integrator.edges: must be one of",
    "integrator: {capacity: 0}": "integrator.capacity: must be at least 1",
    "integrator: {weight: adjont}": "integrator.weight: must be luminance or adjoint (did you mean `adjoint`?)",
    "integrator: {estimator: event, weight: adjoint}\nrun: {adjoint: correlated}": "`adjoint` needs dL/dI before",
    "optimizer: {type: sgd, beta_1: 0.5}": "optimizer.beta_1: not an option of sgd but of adam",
    "loss: {epsilon: 1}": "loss.epsilon: not an option of l2 but of relative_l2",
    "loss: {type: relative_l2, epsilon: 0}": "loss.epsilon: must be above 0",
    "optimizer: {final_fraction: 0.1}": "optimizer.final_fraction: has no effect on a constant",
    "optimizer: {learning_rate: .nan}": "optimizer.learning_rate: must be a finite",
    "optimizer: {type: sgd, momentum: 1}": "optimizer.momentum: must be below 1",
    "integrator: {type: trajectory, max_depth: -1}": "integrator.max_depth: must be at least 0",
    "integrator: {max_depth: -2}": "integrator.max_depth: must be at least -1",
    "integrator: {hide_emitters: 1}": "integrator.hide_emitters: must be true or false",
    "integrator: {samples_per_pass: 5}": "integrator.samples_per_pass: 5 does not divide run.spp, which is 16",
    "run: {spp: 1.5}": "run.spp: must be an integer, not 1.5",
    "run: {seed: 4294967296}": "run.seed: must be below 4294967296",
    "run: {adjoint: batched, spp: 6, batches: 4}": "run.batches: 4 does not divide run.spp, which is 6",
    "run: {adjoint: batched, batches: 1}": "run.batches: must be",
    "integrator: {samples_per_pass: 4}\nrun: {adjoint: batched, spp: 24}": "integrator.samples_per_pass: 4 does not",
    "run: {adjoint: correlate}": "run.adjoint: must be one of auto, correlated, independent, batched",
    "run: {name: '---'}": "run.name: must contain a letter or a digit",
    "variant: scalar_rgb": "variant: must be one of auto, llvm_ad_rgb",
    "<script>: 1": "<script>: unknown key; known here: variant",
    '"[key]": 1': "[key]: unknown key; known here: variant",
    "run: {name: ../x}": "run.name: must be a name and not a path",
    "run: {name: /etc/x}": "run.name: must be a name and not a path",
    "run: {name: 'C:\\x'}": "run.name: must be a name and not a path",
}
#: An entry of `parameters`, and parts of the error line.
ENTRIES: dict[str, str | tuple[str, ...]] = {
    "{key: a, initial: {file: x, colour_space: srgb}}": ("parameters[0].initial.colour_space:", "`color_space`"),
    "{key: ''}": "parameters[0].key: must be nonempty text",
    "{key: a, bounds: [1, 0]}": ("parameters[0].bounds: ", "low < high"),
    "{key: a, bounds: [0, .nan]}": ("parameters[0].bounds: ", "low < high"),
    "{key: a, bounds: 1}": "parameters[0].bounds: must be a list",
    "{key: a, transform: logarithm}": ("parameters[0].transform: must be one of", "log"),
    "{key: a, transform: sigmoid}": ("parameters[0].transform: sigmoid maps to finite `bounds`", "has none"),
    "{key: a, transform: log, bounds: [-1, 0]}": ("parameters[0].bounds: exclude positive values", "log"),
    "{key: a, bounds: [0, 1], initial: [0.5, 1.5, 0.5]}": "parameters[0].initial: 1.5 is outside of the bounds [0, 1]",
    "{key: a, initial: .nan}": "parameters[0].initial: must be a finite",
    "{key: a, resolution: [64, 0]}": ("parameters[0].resolution[1]: ", "1"),
    "{key: a, resolution: [100000, 100000]}": "parameters[0].resolution: must have at most 134217728 texels, not",
    "{initial: 1}": "parameters[0]: must have one of `key`, `tint`, `heightmap` and `motion`",
    "{key: 3}": "parameters[0].key: must be text",
    "{key: b}\n  - {key: b}": ("parameters[1].key: ", "parameters[0]"),
    "{key: [a, a]}": "parameters[0].key: must list each key once",
    "{key: [a, b], resolution: [4, 4]}": "parameters[0].resolution: needs a single key",
    "{motion: {of: lens}}\n  - {motion: {of: [x, lens]}}": "parameters[1].motion.of[1]: `lens` is already in",
    "{motion: {of: []}}": "parameters[0].motion.of: must have at least one entry",
    "{motion: {of: a, free: [shear]}}": ("parameters[0].motion.free[0]: must be one of", "rotation"),
    "{motion: {of: a, free: [translation, x]}}": "motion.free: has both `translation` and",
    "{motion: {of: a, free: [rotation_x, rotation]}}": "motion.free: has both `rotation` and",
    "{motion: {of: a, free: [x, y]}, bounds: {z: [0, 1]}}": "parameters[0].bounds.z: has no effect: `motion.free` has",
    "{motion: {of: a, pivot: [1, 2]}}": "motion.pivot: must be a point, [x, y, z], not",
    "{motion: {of: a, about: [1, 2, 3]}}": "parameters[0].motion.about: unknown key",
    "{heightmap: {mesh: a}}": "parameters[0].heightmap.resolution: missing",
    "{heightmap: {mesh: a, resolution: [99999, 99999]}}": "heightmap.resolution: must be at least",
    "{heightmap: {mesh: a, resolution: [4, 4]}, resolution: [4, 4]}": "parameters[0].resolution: has no effect here",
    "{motion: {of: lens}, bounds: {rotaton: [0, 1]}}": "parameters[0].bounds.rotaton: unknown key; did you mean",
    "{motion: {of: lens}, bounds: {scale: [0, 1]}}": ("parameters[0].bounds.scale: has no", "translation, rotation"),
    "{key: a, bounds: {scale: [0, 1]}}": "parameters[0].bounds: is a mapping for a motion",
    "{motion: {of: lens}, bounds: [0, 1]}": "parameters[0].bounds: must be a mapping for `motion.free`",
    "{key: a, initial: grey}": ("[0].initial: must be a number", "{file: IMAGE}, {run: RUN}, or `scene`"),
    "{motion: {of: lens}, initial: {file: a.png}}": "parameters[0].initial: is an image file",
    "{motion: {of: lens}, bounds: {rotation: [1, 0]}}": ("parameters[0].bounds.rotation: ", "low < high"),
    "{motion: {of: lens}, transform: {rotation: sigmoid}}": ("parameters[0].transform.rotation: sigmoid", "has none"),
    "{motion: {of: lens}, bounds: {rotation: [0, 1]}, initial: {rotation: 2}}": "parameters[0].initial.rotation: 2 is",
    "{key: a}\nintegrator: {type: prb, attached: true}": "integrator.attached: not an option",
    "{key: a}\nintegrator: {filter_normalization: none}": "filter_normalization: must be attached",
}
#: A target, and parts of the error line.
TARGETS: dict[str, str | tuple[str, ...]] = {
    "{render: {}, file: a.exr}": "target: must have exactly one of",
    "{file: 3}": "target.file: must be a path",
    "{file: [a.exr, b.exr]}": "target.file: is a list; give each view its own in `views`",
    "{render: {}, color_space: srgb}": "target.response: has no effect on a rendered",
    "{render: {}, response: srgb}": "target.response: has no effect on a rendered",
    "{render: {}, truth: true}": "target.truth: has no effect on a rendered",
    "{file: a.png, color_space: sRGB}": "target.color_space: must be one of auto, linear, srgb (did you mean `srgb`?)",
    "{file: a.png, color_space: srgb, response: linear}": "target.color_space: is a former name of `response`",
    "{file: a.png, response: sRGB}": ("target.response: must be one of srgb, linear, {gamma", "did you mean `srgb`?"),
    "{file: a.png, response: auto}": ("target.response: is auto; write {curve: auto} or {gamma: auto}", "or null"),
    "{file: a.png, response: {gamma: -1}}": "target.response.gamma: must be a positive number below 100, or `auto`",
    "{file: a.png, response: {curve: [1, 2]}}": (
        "target.response.curve: must be a list of 6 pos",
        "below 100, or `auto`",
    ),
    "{file: a.png, response: {curve: [1, 1, 1, 0, 1, 1]}}": "target.response.curve: must be a list of 6 positive",
    "{file: a.png, response: {curve: [1, 1, 1, x, 1, 1]}}": "target.response.curve: must be a list of 6 positive",
    "{file: a.png, response: {gamma: 2, encoding: srgb}}": ("target.response: must have exactly one", "`encoding` and"),
    "{file: a.png, response: {}}": "target.response: must have exactly one of `encoding`, `gamma` and `curve`",
    "{file: a.png, response: {curve: auto}}": (
        "target.response.curve: is recovered only up to",
        "target.exposure to auto",
    ),
    "{file: a.png, response: {gamma: auto}, white_balance: {scene: A}}": "target.white_balance: cannot be combined",
    "{}\nviews: [{target: a.png, response: {curve: auto}}]": (
        "views[0].response.curve: is rec",
        "views[0].exposure to auto",
    ),
    "{response: {curve: auto}, exposure: auto}\nviews: [{target: a.png}, {sensor: 1, target: b.png, exposure: 2}]": (
        "target.response.curve: is recovered only",
        "set views[1].exposure to auto",
    ),
    "{render: {parameters: {a.b.value: [1, x]}}}": "target.render.parameters.a.b.value[1]: must be a number",
    "{render: {integrator: {type: path}}}": "target.render.integrator.type: must be one of reslrb, ptracer, prb,",
    "{render: {parameters: {'': 1}}}": "target.render.parameters: must have keys that are not empty",
}
#: The text of a file, the start of its error line after the file name, and parts of that line.
FILES: dict[str, tuple[str | bytes, ...]] = {
    "empty": ("", "is empty", "scene, target and parameters"),
    "list at the top": ("- scene\n", "must hold sections"),
    "not UTF-8": (b"\xff\xfe\x00a", "is not UTF-8 text"),
    "control character": ("scene:\n  \x01", ":2: not valid YAML"),
    "syntax": (GOOD + "run: [1,\n", ":6: not valid YAML"),
    "tab": ("scene:\n\tfile: x", ":2: not valid YAML: a tab; YAML allows only spaces for indentation"),
    "python object": ("scene: !!python/object:os.x {}", ":1: not valid YAML"),
    "contradicting tag": ("variant: !!bool maybe", "not valid YAML"),
    "endless integer": ("variant: " + "1" * 6000, ":1: the integer 1111", "more than 64 bits"),
    "unhashable key": (GOOD + "? [a]\n: 1\n", ":5: has a key that is a list"),
    "value that holds itself": (changed(f"\n  - {PARAMETER}", " &a [*a]"), "parameters[0]: must be a mapping"),
    "duplicate key": (GOOD + "run: {spp: 1}\nrun: {spp: 2}\n", ":6: run: given twice", "line 5"),
    "key is a number": (GOOD + "1: 2\n", ":5: 1: a key must be text"),
    "misspelt, so also missing": (
        changed("file:", "fil:"),
        "scene.fil: unknown key; did you mean `file`?",
        "(and 1 more)",
    ),
    "scene option a list": (scene("a, options: {r: [1]}"), "scene.options.r: must be text"),
    "null character in a path": (scene('"a\\0"'), "scene.file: must be a path"),
    "control character in a key": (GOOD + 'run: {"\\e[31m": 1}\n', ":5: run.", "must not hold control"),
    "half a surrogate pair": (GOOD + 'run: {name: "\\ud800"}\n', ":5: ", "half of a surrogate pair"),
    "a byte of a path": (scene('"\\udcff.xml"'), ":1: ", "half of a surrogate pair"),
    "tag of other data": (GOOD + "run: {name: !!binary aGFsbG8=}\n", ":5: not valid YAML: the tag !!binary"),
    "glob without quotes": (
        changed("floor.reflectance.data", "*.data"),
        ":4: *.data is an alias in YAML",
        'in quotes: "*.data"',
    ),
    "long name": (GOOD + f"run: {{name: {'a' * 300}}}\n", "run.name: must have at most 200 bytes", "not 300"),
}

#: An override of the valid file, and parts of its error line.
OVERRIDES: dict[str, tuple[str, ...]] = {
    "novalue": ("--set novalue: must be KEY=VALUE",),
    "=3": ("--set =3: must be KEY=VALUE",),
    "a..b=3": ("--set a..b=3: `a..b` is not a key",),
    "run.spp=[1,": ("--set run.spp=[1,: not valid YAML",),
    "run.spp=": ("--set run.spp=: run.spp: must be an integer, not null",),
    "run.spq=3": ("--set run.spq=3: run.spq: unknown key; did you mean `spp`?",),
    "parameters[0].bounds=[1,0]": ("--set parameters[0].bounds=[1,0]: parameters[0].bounds: must be [low, high]",),
    "parameters[2].bounds=[0,1]": (": parameters: has 1 entry; there is no [2]",),
    "parameters.bounds=[0,1]": (": parameters: is a list; give an entry, such as parameters[0]",),
    "scene.file.name=x": (": scene.file: is a single value",),
    "scene=null": ("--set scene=null: scene: missing",),
    "parameters[0].key=*.data": (
        "--set parameters[0].key=*.data: *.data is an alias in YAML",
        """in quotes: --set 'parameters[0].key="*.data"'""",
    ),
    "parameters=[{key: *.data}]": ("""in quotes: --set 'parameters=[{key: "*.data"}]'""",),
    "a" + ".a" * 3000 + "=1": ("is nested too deeply",),
    "run.name=\udcff": (
        "--set run.name=\\udcff: not valid YAML: holds a control character, or bytes that are not UTF-8",
    ),
    "\x1b[31m=1": ("--set \\x1b[31m=1: a key must not hold control characters",),
    "target.file=x.exr": (
        "--set target.file=x.exr: target: must have exactly one of `file` and `render`, and has both",
    ),
}


CASES = {text: (f"{GOOD}{text}\n", parts) for text, parts in ADDED.items()}
CASES |= {text: (changed(PARAMETER, text), parts) for text, parts in ENTRIES.items()}
CASES |= {text: (changed("{render: {}}", text), parts) for text, parts in TARGETS.items()}


@pytest.mark.parametrize("case", CASES)
def test_errors_are_located(case: str, tmp_path: Path) -> None:
    text, parts = CASES[case]
    line = line_of(tmp_path, text)
    assert line.startswith("x.yaml: ")
    assert all(part in line for part in ([parts] if isinstance(parts, str) else parts))


@pytest.mark.parametrize("case", FILES)
def test_file_errors_are_located(case: str, tmp_path: Path) -> None:
    text, start, *parts = FILES[case]
    line = line_of(tmp_path, text)
    assert line.startswith(f"x.yaml{start}" if str(start).startswith(":") else f"x.yaml: {start}")
    assert all(str(part) in line for part in parts)


def test_the_suggested_override_is_valid(tmp_path: Path) -> None:
    line = line_of(tmp_path, GOOD, ("parameters[0].key=*.data",))
    option, mended = shlex.split(line.partition("in quotes: ")[2])
    assert option == "--set"
    assert load(tmp_path / "x.yaml", [mended]).parameters[0].key == "*.data"


@pytest.mark.parametrize("override", OVERRIDES)
def test_override_errors_name_the_override(override: str, tmp_path: Path) -> None:
    line = line_of(tmp_path, GOOD, (override,))
    assert line.startswith("--set ")
    for part in OVERRIDES[override]:
        assert part in line


def test_override_that_makes_an_option_unknown_is_blamed(tmp_path: Path) -> None:
    text = GOOD + "integrator: {estimator: reservoir}\n"
    line = line_of(tmp_path, text, ("run.spp=4", "integrator.type=ptracer", "run.seed=3"))
    assert line.startswith("--set integrator.type=ptracer: integrator.estimator: not an option of ptracer")


def test_file_is_blamed_for_its_own_errors(tmp_path: Path) -> None:
    assert line_of(tmp_path, GOOD + "run: {spp: 0}\n", ("run.seed=3",)).startswith("x.yaml: run.spp")


def test_an_override_can_correct_the_file(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(GOOD + "run: {spp: 0}\n")
    assert load(path, ["run.spp=2"]).run.spp == 2


def test_unreadable_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_args: object) -> int:
        raise PermissionError(13, "Permission denied")

    (tmp_path / "x.yaml").write_text(GOOD)
    monkeypatch.setattr("pathlib.Path.open", refuse)  # chmod does not stop root from reading
    with pytest.raises(ConfigError, match=r"x\.yaml: cannot be read: Permission denied"):
        load(tmp_path / "x.yaml")
    monkeypatch.undo()
    for path, why in ((tmp_path / "none.yaml", r"none\.yaml: no such file"), (tmp_path, "is a folder")):
        with pytest.raises(ConfigError, match=why):
            load(path)
    with pytest.raises(ConfigError, match="cannot be read"):
        load("a\0b.yaml")
