"""docs/benchmarks.md, docs/paper.md and the README's tables match the output of `scripts/` for the records."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import benchmarks_measure
import benchmarks_page as pages
import click
import pytest
from benchmarks_measure import MEASUREMENTS, OTHERS, PAPER, RECORDS, ROOT, record_file
from benchmarks_page import main, read

from paper import page as paper_page
from reslrb_cli.cli import main as program
from reslrb_cli.measure.scenes.catalogue import CASES

TINY = ("bench", "--values", "2", "--integrators", "reslrb:stack", "--rounds", "1", "--set", "scene.options.size=8",
        "--set", "run.spp=1")  # fmt: skip


def test_the_pages_match_the_records() -> None:
    blocks = pages.Blocks()
    again = "`scripts/benchmarks write` makes it anew"
    assert pages.PAGE.read_text(encoding="utf-8") == pages.page(blocks), again
    assert pages.GALLERY.read_text(encoding="utf-8") == pages.gallery(blocks), again
    text = pages.README.read_text(encoding="utf-8")
    assert text == pages.readme(blocks, text), again
    assert (ROOT / "docs" / "paper.md").read_text(encoding="utf-8") == paper_page.page(), "`scripts/paper write`"


def test_every_measurement_is_recorded_by_its_own_command() -> None:
    recorded = {file.stem for file in RECORDS.glob("*.jsonl")}
    assert recorded <= set(MEASUREMENTS)
    readme = pages.README.read_text(encoding="utf-8")
    for name in pages.EXPERIMENTS:  # recorded results are not also typed by hand
        assert readme.count(f"\n| `{name}`: ") == 1
    for words, _ in OTHERS.values():
        assert readme.count(f"\n| {words} | ") == 1
    for name in recorded:
        origin = read(record_file(name)).origin
        assert origin["command"] == ["reslrb", *MEASUREMENTS[name]]
        assert origin["versions"]["mitsuba"]
        assert origin["device"]
        assert origin["seconds"] > 0


def test_every_record_names_its_commit() -> None:
    found = benchmarks_measure.origins()
    assert {"depth", "optimize_grey_room", "figure1", "figure5", "figure6"} <= set(found)
    for name, origin in found.items():
        assert re.fullmatch(r"[0-9a-f]{12}", origin["commit"]), name
        assert origin["clean"] in (True, False, None), name
        for place in benchmarks_measure.measures(origin["command"]):
            assert (ROOT / place).exists(), f"{name}: {place}"


def test_every_table_of_records_names_its_commit(folder: Path) -> None:
    for number, file in enumerate(sorted(folder.glob("*.jsonl"))):
        first, _, rest = file.read_text(encoding="utf-8").partition("\n")
        origin = json.loads(first) | {"commit": f"{number:012x}", "clean": number % 2 == 0}
        file.write_text(f"{json.dumps(origin)}\n{rest}", encoding="utf-8")
    blocks = pages.Blocks(folder)
    assert {f"{number:012x}" for number in range(len(list(folder.glob("*.jsonl"))))} <= set(
        re.findall(r"\b[0-9a-f]{12}\b", pages.page(blocks) + blocks.experiments() + blocks.extreme())
    )
    for name in blocks.makers.keys() - {"machine", "gpu", "extreme"}:
        assert re.search(r"at commit `[0-9a-f]{12}`", blocks.make(name)), name
    assert "000000000003` with changes that were not committed" in " ".join(pages.page(blocks).split())
    assert paper_page.page().count("at commit `") == 3


def commit_all(folder: Path) -> None:
    """Commit everything in a folder."""
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c"]
    subprocess.run([*git, "add", "-A"], cwd=folder, check=True)
    subprocess.run([*git, "commit", "-qm", "x"], cwd=folder, check=True)


def test_a_record_is_stale_after_a_change_of_the_measured_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, content in {
        "configs/room.yaml": "scene: {file: ../scenes/room/scene.xml}\nrun: {spp: 1}", "scenes/room/scene.xml": "",
        "docs/a.md": "", "reslrb_cli/config/run.py": "", "reslrb_cli/records/clock.py": "",
        "reslrb_cli/measure/bench.py": "", "reslrb_cli/cli/bench.py": "",
        "reslrb_cli/transport/walk.py": 'a = f"must be less than {1}"\nif a:\n    b = 1\n    raise ValueError(b)',
    }.items():  # fmt: skip
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    commit_all(tmp_path)
    for name, value in {"ROOT": tmp_path, "RECORDS": tmp_path / "docs" / "benchmarks", "PAPER": tmp_path}.items():
        monkeypatch.setattr(benchmarks_measure, name, value)
    (tmp_path / "docs" / "benchmarks").mkdir()
    (tmp_path / "docs/a.md").write_text("no code")
    state = benchmarks_measure.code_state()
    assert state["clean"] is True
    commands = {"depth": ["reslrb", "bench"], "room": ["reslrb", "optimize", "configs/room.yaml"]}
    for name, command in commands.items():
        origin = {"kind": "origin", "command": command} | state
        (tmp_path / "docs" / "benchmarks" / f"{name}.jsonl").write_text(json.dumps(origin) + "\n")
    (tmp_path / "reslrb_cli/cli/bench.py").write_text("1")  # no figure depends on it, nor on words
    (tmp_path / "configs/room.yaml").write_text("# a room\nscene:\n  file: ../scenes/room/scene.xml\nrun: {spp: 1}\n")
    (tmp_path / "reslrb_cli/transport/walk.py").write_text(
        '"""Walk."""  # along a path\na = "this is another message"\nif a:\n    b = 2\n    raise ValueError(b)'
    )
    assert benchmarks_measure.code_state()["clean"] is False
    commit_all(tmp_path)
    assert main(["stale"]) == 0
    (tmp_path / "reslrb_cli/transport/walk.py").write_text('a = "a message"\nif a:\n    b = 2\n    raise TypeError(b)')
    commit_all(tmp_path)
    assert main(["stale"]) == 1  # another type of error may be handled in another way
    subprocess.run(["git", "reset", "-q", "--hard", "HEAD~1"], cwd=tmp_path, check=True)
    for place, names in {
        "reslrb_cli/measure/bench.py": ["depth"], "configs/room.yaml": ["depth", "room"],
        "scenes/room/scene.xml": ["depth", "room"],
        "reslrb_cli/transport/walk.py": ["depth", "room"], "reslrb_cli/config/run.py": ["depth", "room"],
        "reslrb_cli/records/clock.py": ["depth", "room"],
    }.items():  # fmt: skip
        capsys.readouterr()
        (tmp_path / place).write_text("scene: {file: ../scenes/room/scene.xml}" if place.endswith(".yaml") else "a = 1")
        commit_all(tmp_path)
        assert main(["stale"]) == 1
        lines = capsys.readouterr().out.splitlines()
        assert [line.split(":")[0] for line in lines] == names
    assert lines[1] == (
        f"room: measured at {state['commit']}; files changed since then: reslrb_cli/transport (1), "
        "reslrb_cli/config (1), reslrb_cli/records/clock.py (1), configs/room.yaml (1), scenes/room (1)"
    )
    record = tmp_path / "docs" / "benchmarks" / "room.jsonl"
    record.write_text(json.dumps({"kind": "origin", "command": commands["room"], "commit": "0" * 12}) + "\n")
    assert benchmarks_measure.stale()[1] == "room: the commit that it was measured at is not known"


def test_texts_that_seeds_depend_on_are_no_messages() -> None:
    def same(text: str) -> bool:
        return benchmarks_measure._syntax(text.format("first one")) == benchmarks_measure._syntax(
            text.format("second one")
        )

    assert same("say('{}')")
    assert same("a = f'{} {{a}}'")
    for text in ("seed(0, 1, 2, '{}')", "self._seed(round, view, f'{}, {{name}}')", "see_images(problem, 1, 0, '{}')",
                 "problem.render(0, 16, 1, '{}')", "purposes = ['{}']", "_PURPOSE = '{}'"):  # fmt: skip
        assert not same(text), text


#: Modules that measured code imports, but no figure depends on: errors, text, and files of results.
NO_FIGURE = {f"reslrb_cli/{name}.py" for name in ("__init__", "errors", "version", "report/format")} | {
    f"reslrb_cli/records/{name}.py" for name in (
        "__init__", "atomic", "checkpoint", "lock", "manifest", "measurements", "measurement_files", "metrics",
        "run_folder", "tree",
    )
}  # fmt: skip


def test_figures_depend_on_all_modules_that_measured_code_imports() -> None:
    @cache
    def imports(file: Path) -> set[str]:
        """Return the modules of the package that a file imports, as paths."""
        found = re.findall(r"^ *from (reslrb_cli[\w.]*) import (\([^)]*\)|.*)", file.read_text(encoding="utf-8"), re.M)
        return {
            place for module, names in found for name in ["", *re.findall(r"\w+", names)]
            if (ROOT / (place := f"{module}.{name}".strip(".").replace(".", "/") + ".py")).is_file()
        }  # fmt: skip

    for command in ("bench", "gradcheck", "optimize", "figure5"):
        places = [ROOT / place for place in benchmarks_measure.measures(["reslrb", command])]
        files = {file for place in places for file in ([place] if place.is_file() else place.rglob("*.py"))}
        imported = set().union(*(imports(file) for file in files if file.suffix == ".py"))
        assert imported - {str(file.relative_to(ROOT)) for file in files} - NO_FIGURE == set(), command


def test_no_figure_is_typed_by_hand() -> None:
    """Numbers with a unit come only from records. The published memory of the paper's machine is the only exception."""
    published = ("142 MB",)
    for template in (RECORDS / pages.TEMPLATE, PAPER / "page.md"):
        text = template.read_text(encoding="utf-8")
        for words in published:
            text = text.replace(words, "")
        assert re.findall(r"\d[\d.,]* ?(?:ms|s|%|[kMG]i?B)\b", text) == []
        assert pages.PLACE.findall(text)


#: Names of this repository's files, as they appear in text.
NAMED = re.compile(
    r"(?<![\w/.{}-])((?:configs|docs|paper|scenes|scripts|tests|reslrb_cli)(?:/[\w-]+)*/[\w-]+\.\w+(?:\.\w+)*"
    r"|(?:[\w-]+/)*test_\w+\.py|(?:[a-z]\w*/)+\w+\.py|scripts/\w+)\b"
)


def test_files_named_in_text_exist() -> None:
    """In the documentation, every named file must exist. In other files, only the names of tests are checked."""
    listed = subprocess.check_output(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, text=True)
    files = [name for name in listed.split() if (ROOT / name).is_file()]
    ends = {name[at:] for name in (f"/{file}" for file in files) for at in range(len(name)) if name[at] == "/"}
    gone = []
    for file in files:
        if file.endswith((".md", ".py")) and file != "CHANGELOG.md":
            for name in set(NAMED.findall((ROOT / file).read_text(encoding="utf-8"))):
                is_told = file.endswith(".md") or Path(name).name.startswith("test_")
                if is_told and f"/{name}" not in ends:
                    gone.append(f"{file} names {name}")
    assert gone == []
    text = "`walk/x.py`, scripts/a (tests/b.py)"
    assert NAMED.findall(text) == ["walk/x.py", "scripts/a", "tests/b.py"]


#: Command lines of the documentation: blocks have whole ones, and text may leave out arguments.
BLOCK, IN_TEXT = re.compile(r"^ {4,}reslrb ((?:.*\\\n)*.*)$", re.MULTILINE), re.compile(r"`reslrb ([a-z][^`]*)`")


def wrong_command(line: str, is_whole: bool) -> str:
    """Return a command line of the documentation with its error, or an empty text. Files and values are not checked."""
    words = [word for word in shlex.split(line.replace("\\\n", " "), comments=True) if word not in ("...", "--debug")]
    words = words[: next((place for place, word in enumerate(words) if word in ("|", "&&", ">")), None)]
    name, *rest = words or ["--help"]
    if name.startswith("-"):
        return ""
    command = program.get_command(click.Context(program), name)
    if command is None:
        return f"{line}: no such command"
    try:
        command.make_context(name, rest)
    except click.UsageError as error:
        lacks = isinstance(error, click.MissingParameter) or "requires an argument" in error.message
        if is_whole if lacks else not isinstance(error, click.BadParameter):
            return f"{line}: {error.format_message()}"
    except click.exceptions.Exit:  # --help
        pass
    return ""


def test_commands_of_the_documentation_are_accepted() -> None:
    wrong, checked = [], 0
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        for pattern in (BLOCK, IN_TEXT):
            for line in pattern.findall(page.read_text(encoding="utf-8")):
                checked += 1
                if error := wrong_command(line, is_whole=pattern is BLOCK):
                    wrong.append(f"{page.name}: {error}")
    assert wrong == []
    assert checked > 200
    assert wrong_command("render a.yaml", is_whole=True).endswith("Missing option '-o' / '--output'.")
    assert "No such option" in wrong_command("report --colour", is_whole=False)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder with a copy of the records."""
    return Path(shutil.copytree(RECORDS, tmp_path / "records"))


def change(file: Path, key: str, value: object) -> None:
    """Change a member of the record in the file's last line."""
    *others, last = file.read_text(encoding="utf-8").splitlines()
    file.write_text("\n".join([*others, json.dumps(json.loads(last) | {key: value})]) + "\n", encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "key", "value", "shown"),
    [
        ("depth", "peak_mib", 98765.4, "98765.4"),
        ("depth", "status", "out_of_memory", "out of memory"),
        ("spp", "step_ms", {"median": 91.25, "min": 81.0, "max": 99.0}, "91.2 [81.0, 99.0]"),
        ("gradcheck_furnace", "seeds", 987654, "987654"),
        ("optimize_cornell_floor", "step_ms", 98765.0, "98765"),
    ],
)
def test_a_figure_of_a_record_equals_that_of_the_page(
    folder: Path, name: str, key: str, value: object, shown: str
) -> None:
    assert shown not in pages.page(pages.Blocks(folder))
    change(folder / f"{name}.jsonl", key, value)
    assert shown in pages.page(pages.Blocks(folder))


def test_the_readme_uses_figures_of_records(folder: Path) -> None:
    text = pages.README.read_text(encoding="utf-8")
    key = "floor.reflectance.data"
    change(folder / "optimize_cornell_floor.jsonl", "parameter_rmse", {key: {"initial": 0.987, "final": 0.0123}})
    change(folder / "optimize_cornell_floor.jsonl", "elapsed_s", 1234.4)
    row = "| `cornell_floor`: a carpet of 64 x 64 texels | 0.987 | 0.0123 | 1234 s |"
    assert row in pages.readme(pages.Blocks(folder), text)
    assert row not in text


@pytest.mark.parametrize(
    ("needed", "reason", "shown"),
    [
        (True, "paths: both", "both, guided"),
        (True, "paths: camera; paths: auto, 3 times", "camera, guided"),
        (False, "paths: light; paths: auto, 3 times", "light, guided"),
    ],
)
def test_the_paths_of_a_run_match_its_manifest(needed: bool, reason: str, shown: str) -> None:
    rows = [
        {"feature": "camera paths", "needed": needed, "reason": reason},
        {"feature": "guided emission", "needed": True, "reason": ""},
    ]
    row = benchmarks_measure.traced({"plan": {"rows": rows}})
    assert pages.paths_of(pages.Record({}, [row])) == shown
    of_prb = benchmarks_measure.traced({"plan": {"rows": []}})
    assert pages.paths_of(pages.Record({}, [of_prb])) == ""


def test_ratios_are_of_medians() -> None:
    def row(label: str, depth: int, time: float, status: str = "ok") -> dict:
        times = {"median": time, "min": time, "max": time}
        return {"label": label, "max_depth": depth, "status": status, "kernel_ms": times, "peak_mib": float(depth)}

    rows = [row("ptracer", 2, 8.0), row("reslrb:stack", 2, 4.0), row("ptracer", 4, 1.0, "out_of_memory"),
            row("reslrb:stack", 4, 5.0)]  # fmt: skip
    made = pages.bench_ratios(pages.Record({}, rows), "depth")
    assert made.splitlines()[2:] == ["| `ptracer` | 1.00 | out of memory | 2.0 |", "| `stack` | 0.50 | | 2.0 to 4.0 |"]


@pytest.mark.long
def test_a_measurement_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, llvm: str) -> None:
    monkeypatch.setattr(benchmarks_measure, "RECORDS", tmp_path)
    benchmarks_measure.measure("tiny", TINY)
    record = read(tmp_path / "tiny.jsonl")
    assert record.origin["command"] == ["reslrb", *TINY]
    assert record.origin["seconds"] > 0
    assert {name: record.origin[name] for name in ("commit", "clean")} == benchmarks_measure.code_state()
    assert [row["status"] for row in record.rows] == ["ok"]
    benchmarks_measure.draw(tmp_path / "tiny.jsonl", tmp_path / "tiny.png")
    assert (tmp_path / "tiny.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(SystemExit, match="exit code 2; its record is left as it was"):
        benchmarks_measure.measure("tiny", ("--nonsense",))
    assert read(tmp_path / "tiny.jsonl") == record


def test_wrong_names_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["measure", "dept"]) == 2
    assert "there is no measurement `dept`; did you mean depth?" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["write", "depth"])


def suite_lines() -> list[dict[str, Any]]:
    """Return the lines of a run of the extreme suite with two cases, of which the second has an open comparison."""

    def record(case: str, estimator: str, z_max: float, verdict: str = "holds", message: str = "") -> dict[str, Any]:
        return {"case": case, "parameter": "floor.reflectance.data", "label": f"reslrb:{estimator}", "options": {},
                "kind": "expectation", "reference": "ptracer", "seeds": 8, "verdict": verdict, "z_max": z_max,
                "z_max_limit": 5.9, "relative_l2": None, "relative_l2_limit": None, "message": message}  # fmt: skip

    first, second, *_ = CASES
    records = [record(first, "gather", 2.0), record(first, "stack", 1.0), record(second, "stack", 3.0),
               record(second, "stack", 9.0, "fails"), record(second, "gather", 1.0, "unresolved", "is noisy"),
               record(second, "stack", 1.0, "unresolved", "is noisy")]  # fmt: skip
    return [{"kind": "origin", "device": "a CPU", "variant": "v", "commit": "0" * 12, "clean": True}, *records]


def test_the_page_of_the_extreme_suite_has_rows_for_cases_and_columns_for_estimators() -> None:
    first, second, *_ = CASES.values()
    page = benchmarks_measure.extreme_page(suite_lines())
    assert "(limit at most 5.9)" in page
    assert f"## Open comparisons\n\n- floor.reflectance in `{second.name}` (is noisy)\n\n## Cases\n" in page
    noisy = "**unresolved: reflectance**"
    assert page.splitlines()[-4:] == [
        "| case | subject | references | seeds | gather | stack |",
        "|---|---|---|---|---|---|",
        f"| `{first.name}` | {first.about} | ptracer | 8 | 2.0 | 1.0 |",
        f"| `{second.name}` | {second.about} | ptracer | 8 | {noisy} | 3.0, **fails: reflectance**, {noisy} |",
    ]


def test_the_readme_names_the_open_comparisons_of_the_extreme_suite(folder: Path) -> None:
    origin, *records = suite_lines()
    lines = [origin, *benchmarks_measure.suite_summary(records)]
    (folder / "extreme.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    said = " ".join(pages.Blocks(folder).extreme().split())
    assert "in 2 difficult scenes (" in said
    second = list(CASES)[1]
    counts = "3 of 6 comparisons hold, 1 fail, 2 stay open"
    assert said.endswith(f"{counts}: floor.reflectance in `{second}` (is noisy). Measured at commit `{'0' * 12}`.")


def test_the_page_of_the_extreme_suite_is_that_of_its_record() -> None:
    _, counts, *opened = benchmarks_measure.read_lines(record_file("extreme"))
    page = (ROOT / "docs" / "extreme.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(.*?)` \|(.*)$", page, re.MULTILINE)
    assert counts["cases"] == len(rows)
    named = {case for row in opened for case in row["cases"]}
    assert {case for case, cells in rows if "**" in cells} == named | set(re.findall(r"`(.*?)` .*fails", page))
