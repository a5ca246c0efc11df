"""Tests of the error lines for wrong configurations. Each error is one line that names the place and a correct
value.
"""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from reslrb_cli.config.errors import REMOVED
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


def parameter(options: str) -> str:
    return changed(PARAMETER, f"{{key: a, {options}}}")


def target(section: str) -> str:
    return changed("{render: {}}", section)


def scene(file: str) -> str:
    return changed("scene.xml", file)


PARAMETER = "{key: floor.reflectance.data}"

#: The text of a file, the start of its error line after the file name, and parts of that line.
FILES: dict[str, tuple[str | bytes, ...]] = {
    "empty": ("", "is empty", "scene, target and parameters"),
    "comments only": ("# nothing\n", "is empty"),
    "list at the top": ("- scene\n", "must hold sections"),
    "text at the top": ("scene\n", "must hold sections"),
    "not UTF-8": (b"\xff\xfe\x00a", "is not UTF-8 text"),
    "control character": ("scene:\n  \x01", ":2: not valid YAML"),
    "syntax": (GOOD + "run: [1,\n", ":6: not valid YAML"),
    "tab": ("scene:\n\tfile: x", ":2: not valid YAML: a tab; YAML allows only spaces for indentation"),
    "tab behind a colon": ("scene:\n  file:\tx", ":2: not valid YAML: a tab; YAML allows only spaces"),
    "loss unknown": (
        GOOD + "loss: {type: huba}\n",
        "loss.type: must be one of l2, l1, relative_l2, ssim, custom, not",
    ),
    "two documents": (GOOD + "---\n" + GOOD, ":5: not valid YAML"),
    "python object": ("scene: !!python/object:os.x {}", ":1: not valid YAML"),
    "contradicting tag": ("variant: !!bool maybe", "not valid YAML"),
    "deep nesting": ("[" * 20_000, "lists and mappings are nested too deeply"),
    "endless integer": ("variant: " + "1" * 6000, ":1: the integer 1111", "more than 64 bits"),
    "unhashable key": (GOOD + "? [a]\n: 1\n", ":5: has a key that is a list"),
    "value that holds itself": (changed(f"\n  - {PARAMETER}", " &a [*a]"), "parameters[0]: must be a mapping"),
    "duplicate key": (GOOD + "run: {spp: 1}\nrun: {spp: 2}\n", ":6: run: given twice", "line 5"),
    "duplicate in a list": (parameter("key: b"), ":4: parameters[0].key: given twice"),
    "key is a number": (GOOD + "1: 2\n", ":5: 1: a key must be text"),
    "unknown section": (GOOD + "optimiser: {}\n", "optimiser: unknown key", "`optimizer`"),
    "unknown key": (GOOD + "run: {iteration: 3}\n", "run.iteration: unknown key", "`iterations`"),
    "unknown key, none near": (GOOD + "run: {xyz: 3}\n", "run.xyz: unknown key; known here: name, output"),
    "key of another section": (GOOD + "spp: 3\n", "spp: unknown key", "`run.spp`"),
    "key of the section below": (target("{render: {}, spp: 3}"), "target.spp: unknown key", "`target.render.spp`"),
    "unknown key of an image": (
        parameter("initial: {file: x, colour_space: srgb}"),
        "parameters[0].initial.colour_space: unknown key",
        "`color_space`",
    ),
    "missing section": ("scene: {file: x}\ntarget: {render: {}}\n", "parameters: missing"),
    "missing key": (changed("{file: scene.xml}", "{options: {a: 1}}"), "scene.file: missing"),
    "misspelt, so also missing": (
        changed("file:", "fil:"),
        "scene.fil: unknown key; did you mean `file`?",
        "(and 1 more)",
    ),
    "several errors": (GOOD + "run: {spp: 0, seed: -1, iterations: x}\n", "run.", "(and 2 more)"),
    "section is text": (GOOD + "run: fast\n", "run: must be a mapping", "'fast'"),
    "section is a list": (GOOD + "loss: [l1]\n", "loss[0]: must be a mapping such as {type: NAME}"),
    "no parameters": (changed(f"\n  - {PARAMETER}", " []"), "parameters: must have at least one entry"),
    "parameters is a mapping": (changed(f"\n  - {PARAMETER}", " {key: a}"), "parameters: must be a list"),
    "parameter twice": (
        changed(f"- {PARAMETER}", f"- {PARAMETER}\n  - {PARAMETER}"),
        "parameters[1].key: ",
        "parameters[0]",
    ),
    "empty parameter key": (changed(PARAMETER, "{key: ''}"), "parameters[0].key: must be nonempty text"),
    "bounds reversed": (parameter("bounds: [1, 0]"), "parameters[0].bounds: ", "low < high"),
    "bounds equal": (parameter("bounds: [1, 1]"), "parameters[0].bounds: ", "low < high"),
    "bounds NaN": (parameter("bounds: [0, .nan]"), "parameters[0].bounds: ", "low < high"),
    "bounds of one": (parameter("bounds: [1]"), "parameters[0].bounds: ", "two"),
    "bounds of three": (parameter("bounds: [1, 2, 3]"), "parameters[0].bounds: ", "two"),
    "bounds a number": (parameter("bounds: 1"), "parameters[0].bounds: must be a list"),
    "bounds of text": (parameter("bounds: [0, inf]"), "parameters[0].bounds[1]: must be a number", "'inf'"),
    "unknown transform": (parameter("transform: logarithm"), "parameters[0].transform: must be one of", "log"),
    "sigmoid without bounds": (
        parameter("transform: sigmoid"),
        "parameters[0].transform: sigmoid maps to finite `bounds`",
        "has none",
    ),
    "sigmoid with an open side": (
        parameter("transform: sigmoid, bounds: [0, .inf]"),
        "parameters[0].transform: sigmoid maps to finite `bounds`",
        "has [0, inf]",
    ),
    "log of nothing positive": (
        parameter("transform: log, bounds: [-1, 0]"),
        "parameters[0].bounds: exclude positive values",
        "log",
    ),
    "unknown scale": (GOOD + "optimizer: {scale: 1e6}\n", "optimizer.scale: must be", "auto"),
    "bounds exclude the initial value": (
        parameter("bounds: [0, 1], initial: [0.5, 1.5, 0.5]"),
        "parameters[0].initial: 1.5 is outside of the bounds [0, 1]",
    ),
    "initial unknown word": (
        parameter("initial: black"),
        "parameters[0].initial: must be a number",
        "`scene`",
        "'black'",
    ),
    "initial NaN": (parameter("initial: .nan"), "parameters[0].initial: must be a finite"),
    "initial infinite": (parameter("initial: [1, .inf, 1]"), "parameters[0].initial[1]: must be a finite number"),
    "initial true": (parameter("initial: true"), "parameters[0].initial: must be a number"),
    "initial empty list": (parameter("initial: []"), "parameters[0].initial: must have"),
    "resolution": (parameter("resolution: [64, 0]"), "parameters[0].resolution[1]: ", "1"),
    "both targets": (target("{render: {}, file: a.exr}"), "target: must have exactly one of"),
    "no target": (target("{}"), "target: must have exactly one of `file` and `render`"),
    "target file a number": (target("{file: 3}"), "target.file: must be a path"),
    "target file a list": (
        target("{file: [a.exr, b.exr]}"),
        "target.file: is a list; give each view its own in `views`",
    ),
    "target file empty": (target("{file: ''}"), "target.file: must be a path"),
    "colour space of a rendered target": (
        target("{render: {}, color_space: srgb}"),
        "target.color_space: has no effect",
    ),
    "truth of a rendered target": (target("{render: {}, truth: true}"), "target.truth: has no effect on a rendered"),
    "colour space unknown": (
        target("{file: a.png, color_space: sRGB}"),
        "target.color_space: must be one of auto, linear, srgb (did you mean srgb?)",
    ),
    "target value": (
        target("{render: {parameters: {a.b.value: [1, x]}}}"),
        "target.render.parameters.a.b.value[1]: must be a number",
    ),
    "target integrator": (
        target("{render: {integrator: {type: path}}}"),
        "target.render.integrator.type: must be one of reslrb, ptracer, prb, prb_projective, walk_ad, trajectory",
    ),
    "sensor negative": (GOOD + "views: [{sensor: -1}]\n", "views[0].sensor: must be at least 0"),
    "scene option a list": (scene("a, options: {r: [1]}"), "scene.options.r: must be text"),
    "scene option null": (scene("a, options: {r: }"), "scene.options.r: must be text"),
    "null character in a path": (scene('"a\\0"'), "scene.file: must be a path"),
    "home of nobody": (scene("~no-such-user-here/a"), "scene.file: must be a path"),
    "unknown integrator": (
        GOOD + "integrator: {type: reslbr}\n",
        "integrator.type: must be one of reslrb, ptracer, prb, prb_projective, walk_ad, trajectory, "
        "custom (did you mean reslrb?)",
    ),
    "type is a list": (GOOD + "integrator: {type: [prb]}\n", "integrator.type: must be one of"),
    "option of another integrator": (
        GOOD + "integrator: {type: prb, estimator: reservoir}\n",
        "integrator.estimator: not an option of prb but of reslrb",
    ),
    "option of another estimator": (
        GOOD + "integrator: {estimator: gather, capacity: 2}\n",
        "integrator.capacity: has no effect with estimator `gather`, only with `reservoir`",
    ),
    "estimator's option left at its default": (
        GOOD + "integrator: {capacity: 1}\n",
        "integrator.capacity: has no effect with estimator `auto`, only with `reservoir` or `event`",
    ),
    "unknown estimator": (
        GOOD + "integrator: {estimator: gater}\n",
        "integrator.estimator: must be one of",
        "(did you mean gather?)",
    ),
    "capacity": (GOOD + "integrator: {capacity: 0}\n", "integrator.capacity: must be at least 1"),
    "weight": (
        GOOD + "integrator: {weight: adjont}\n",
        "integrator.weight: must be luminance or adjoint (did you mean adjoint?)",
    ),
    "weight that is not known yet": (
        GOOD + "integrator: {estimator: reservoir, weight: adjoint}\nrun: {adjoint: correlated}\n",
        "integrator.weight: `adjoint` needs dL/dI before",
        "run.adjoint: correlated",
    ),
    "memory budget in no unit": (
        GOOD + "run: {memory_budget: 2 floppies}\n",
        "run.memory_budget: must be a number of MiB, or text such as 512 MiB or 2GiB",
    ),
    "memory budget of nothing": (GOOD + "run: {memory_budget: 0}\n", "run.memory_budget: must be a number"),
    "memory budget of a baseline": (
        GOOD + "integrator: {type: ptracer}\nrun: {memory_budget: 64}\n",
        "run.memory_budget: needs integrator `reslrb`, not `ptracer`",
    ),
    "memory budget and passes": (
        GOOD + "integrator: {samples_per_pass: 4}\nrun: {memory_budget: 64}\n",
        "integrator.samples_per_pass: is chosen by run.memory_budget",
    ),
    "option of another optimiser": (
        GOOD + "optimizer: {type: sgd, beta_1: 0.5}\n",
        "optimizer.beta_1: not an option of sgd but of adam",
    ),
    "option of another loss": (
        GOOD + "loss: {epsilon: 1}\n",
        "loss.epsilon: not an option of l2 but of relative_l2",
    ),
    "epsilon zero": (GOOD + "loss: {type: relative_l2, epsilon: 0}\n", "loss.epsilon: must be above 0"),
    "fraction of a constant": (
        GOOD + "optimizer: {final_fraction: 0.1}\n",
        "optimizer.final_fraction: has no effect on a constant",
    ),
    "learning rate text": (GOOD + "optimizer: {learning_rate: fast}\n", "optimizer.learning_rate: must be a number"),
    "learning rate true": (GOOD + "optimizer: {learning_rate: true}\n", "optimizer.learning_rate: ", "not true"),
    "learning rate NaN": (GOOD + "optimizer: {learning_rate: .nan}\n", "optimizer.learning_rate: must be a finite"),
    "momentum one": (GOOD + "optimizer: {type: sgd, momentum: 1}\n", "optimizer.momentum: must be below 1"),
    "record without end": (
        GOOD + "integrator: {type: trajectory, max_depth: -1}\n",
        "integrator.max_depth: must be at least 0",
    ),
    "depth": (GOOD + "integrator: {max_depth: -2}\n", "integrator.max_depth: must be at least -1"),
    "flag is a number": (GOOD + "integrator: {hide_emitters: 1}\n", "integrator.hide_emitters: must be true or false"),
    "flag is YAML 1.1": (GOOD + "integrator: {hide_emitters: yes}\n", "integrator.hide_emitters: must be true or"),
    "passes do not divide": (
        GOOD + "integrator: {samples_per_pass: 5}\n",
        "integrator.samples_per_pass: 5 does not divide run.spp, which is 16",
    ),
    "spp a fraction": (GOOD + "run: {spp: 1.5}\n", "run.spp: must be an integer, not 1.5"),
    "spp zero": (GOOD + "run: {spp: 0}\n", "run.spp: must be at least 1"),
    "seed beyond 32 bits": (GOOD + "run: {seed: 4294967296}\n", "run.seed: must be below 4294967296"),
    "batches that do not divide": (
        GOOD + "run: {adjoint: batched, spp: 6, batches: 4}\n",
        "run.batches: 4 does not divide run.spp, which is 6",
    ),
    "one batch": (GOOD + "run: {adjoint: batched, batches: 1}\n", "run.batches: must be"),
    "batches that passes do not divide": (
        GOOD + "integrator: {samples_per_pass: 4}\nrun: {adjoint: batched, spp: 24}\n",
        "integrator.samples_per_pass: 4 does not divide run.spp / run.batches, which is 6",
    ),
    "batches of nothing": (
        GOOD + "run: {adjoint: correlated, batches: 2}\n",
        "run.batches: has no effect with run.adjoint: correlated",
    ),
    "adjoint": (
        GOOD + "run: {adjoint: correlate}\n",
        "run.adjoint: must be one of auto, correlated, independent, batched",
    ),
    "name without letters": (GOOD + "run: {name: '---'}\n", "run.name: must contain a letter or a digit"),
    "variant": (GOOD + "variant: scalar_rgb\n", "variant: must be one of auto, llvm_ad_rgb"),
    "key that looks like a tag": (GOOD + "<script>: 1\n", "<script>: unknown key; known here: variant"),
    "key that looks like pydantic's": (GOOD + '"[key]": 1\n', "[key]: unknown key; known here: variant"),
    "such keys in a choice": (
        GOOD + "integrator: {<prb>: 1, '[key]': {type: 3}}\n",
        "integrator.<prb>: unknown key",
        "(and 1 more)",
    ),
    "control character in a key": (GOOD + 'run: {"\\e[31m": 1}\n', ":5: run.", "must not hold control"),
    "half a surrogate pair": (GOOD + 'run: {name: "\\ud800"}\n', ":5: ", "half of a surrogate pair"),
    "half a surrogate pair in a key": (GOOD + '"\\ud800": 1\n', ":5: ", "must not hold control"),
    "a byte of a path": (scene('"\\udcff.xml"'), ":1: ", "half of a surrogate pair"),
    "endless hexadecimal": (GOOD + f"run: {{spp: 0x{'f' * 20_000}}}\n", ":5: the integer 0xff", "64 bits"),
    "memory of 400 digits": (GOOD + f"run: {{memory_budget: {'9' * 400}}}\n", ":5: the integer 99", "64 bits"),
    "tag of other data": (GOOD + "run: {name: !!binary aGFsbG8=}\n", ":5: not valid YAML: the tag !!binary"),
    "glob without quotes": (
        changed("floor.reflectance.data", "*.data"),
        ":4: *.data is an alias in YAML",
        'in quotes: "*.data"',
    ),
    "long name": (GOOD + f"run: {{name: {'a' * 300}}}\n", "run.name: must have at most 200 bytes", "not 300"),
    "name of many bytes": (GOOD + f"run: {{name: {'ü' * 101}}}\n", "run.name: must have", "not 202"),
    "name that leads out": (GOOD + "run: {name: ../x}\n", "run.name: must be a name and not a path"),
    "name that leads back": (GOOD + "run: {name: 'a/../b'}\n", "run.name: must be a name and not a path"),
    "name from the root": (GOOD + "run: {name: /etc/x}\n", "run.name: must be a name and not a path"),
    "name from a home": (GOOD + "run: {name: ~root/x}\n", "run.name: must be a name and not a path"),
    "name of the folder": (GOOD + "run: {name: '..'}\n", "run.name: must be a name and not a path"),
    "name of a drive": (GOOD + "run: {name: 'C:\\x'}\n", "run.name: must be a name and not a path"),
    "empty key of a target": (
        target("{render: {parameters: {'': 1}}}"),
        "target.render.parameters: must have keys that are not empty",
    ),
    "more texels than an image has": (
        parameter("resolution: [100000, 100000]"),
        "parameters[0].resolution: must have at most 134217728 texels, not 10000000000",
    ),
}

#: An override of the valid file, and parts of its error line.
OVERRIDES: dict[str, tuple[str, ...]] = {
    "novalue": ("--set novalue: must be KEY=VALUE",),
    "=3": ("--set =3: must be KEY=VALUE",),
    "a..b=3": ("--set a..b=3: `a..b` is not a key",),
    "run.spp=[1,": ("--set run.spp=[1,: not valid YAML",),
    "run.spp=many": ("--set run.spp=many: run.spp: must be an integer, not the text 'many'",),
    "run.spp=": ("--set run.spp=: run.spp: must be an integer, not null",),
    "run.spq=3": ("--set run.spq=3: run.spq: unknown key; did you mean `spp`?",),
    "rnu.spp=3": ("--set rnu.spp=3: rnu: unknown key; did you mean `run`?",),
    "integrator.estimater=reservoir": ("integrator.estimater: unknown key; did you mean `estimator`?",),
    "parameters[0].bounds=[1,0]": ("--set parameters[0].bounds=[1,0]: parameters[0].bounds: must be [low, high]",),
    "parameters.0.bounds=[1,0]": ("--set parameters.0.bounds=[1,0]: parameters[0].bounds: must be [low, high]",),
    "parameters[2].bounds=[0,1]": (": parameters: has 1 entry; there is no [2]",),
    "parameters.bounds=[0,1]": (": parameters: is a list; give an entry, such as parameters[0]",),
    "scene.file.name=x": (": scene.file: is a single value",),
    "scene[0]=x": (": scene: is not a list",),
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
    "run.name=../x": ("--set run.name=../x: run.name: must be a name and not a path",),
    "target.file=x.exr": (
        "--set target.file=x.exr: target: must have exactly one of `file` and `render`, and has both",
    ),
}


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


@pytest.mark.parametrize("name", REMOVED)
def test_removed_settings_are_refused_with_a_replacement(name: str, tmp_path: Path) -> None:
    place, _, value = name.partition(": ")
    lists = {
        "views.": "views[0].", "render.": "target.render.", "mask.": "target.mask.",
        "regularizers.": "parameters[0].regularizers[0].",
    }  # fmt: skip
    for short, whole in lists.items():
        place = whole + place.removeprefix(short) if place.startswith(short) else place
    there = ("views=[{sensor: 0}]", "fabrication.thickness=9", "parameters[0].regularizers=[{type: total_variation}]")
    line = line_of(tmp_path, GOOD, (*there, f"{place}={value or 1}"))
    assert line.startswith(f"--set {place}={value or 1}: {place}: ")
    assert line.endswith(f"was removed; {REMOVED[name]}")


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


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: no such file"):
        load(tmp_path / "none.yaml")


def test_folder_in_place_of_a_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is a folder"):
        load(tmp_path)


def test_unreadable_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_args: object) -> int:
        raise PermissionError(13, "Permission denied")

    (tmp_path / "x.yaml").write_text(GOOD)
    monkeypatch.setattr("pathlib.Path.open", refuse)  # chmod does not stop root from reading
    with pytest.raises(ConfigError, match=r"x\.yaml: cannot be read: Permission denied"):
        load(tmp_path / "x.yaml")


def test_null_character_in_the_file_name() -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load("a\0b.yaml")
