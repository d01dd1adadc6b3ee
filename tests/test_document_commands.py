"""Every shell command that the README and the documents name can be called as they write it.

Oracles: the parsers of the commands themselves, the Makefile, pyproject.toml, and the files that are there. The
cheap ones run.
"""

import argparse
import functools
import importlib
import itertools
import re
import shlex
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import psutil
import pytest
import small_capture
import typer
from typer.testing import CliRunner

import attnwarp.cli.main
import attnwarp_eval.cli.main
from attnwarp_eval.study.study import load_study, shipped_studies

ROOT = Path(__file__).parents[1]
PAGES = [
    "README.md",
    *sorted(f"{path.relative_to(ROOT)}" for path in (ROOT / "docs").rglob("*.md")),
]
APPS = {"attnwarp": attnwarp.cli.main.app, "attnwarp-eval": attnwarp_eval.cli.main.app}
COMMAND = functools.cache(typer.main.get_command)
SHELLS = ("sh", "bash", "shell", "console")


def blocks(page, languages):
    """The fenced blocks of a page in one of the languages."""
    language, lines = None, []
    for line in (ROOT / page).read_text().splitlines():
        if not line.lstrip().startswith("```"):
            lines.append(line)
        elif language is None:
            language, lines = line.strip()[3:].strip(), []
        else:
            if language in languages:
                yield "\n".join(lines)
            language = None


def split(block):
    """The commands of a block, as a shell splits them."""
    lines = block.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def parse(app, words, name):
    """Parse a command line down to its last subcommand, as the command does before it acts."""
    command = COMMAND(app) if isinstance(app, typer.Typer) else app
    context = command.make_context(name, list(words), resilient_parsing=False)
    while hasattr(command, "resolve_command"):  # a group; typer may bring a click of its own
        rest = [*context._protected_args, *context.args]
        name, command, rest = command.resolve_command(context, rest)
        context = command.make_context(name, rest, parent=context)
    return context


def check_own(program, words):
    context = parse(APPS[program], [word.strip("[].") for word in words], program)
    path = context.command_path.split()[1:]
    if path == ["run"]:
        study = context.params["study"]
        assert study in shipped_studies() or study.endswith(".yaml")
    for scene in ["bear"] if "bear" in words else []:
        assert (ROOT / "scenes" / f"{scene}.yaml").is_file()


def check_python(words, folder):
    assert words[0] == "-m"
    module = words[1]
    at = folder / Path(*module.split("."))
    if at.is_dir():  # Python runs a package's __main__
        module, at = f"{module}.__main__", at / "__main__"
    assert at.with_suffix(".py").is_file()
    sys.path.insert(0, str(folder))
    try:
        found = importlib.import_module(module)
    finally:
        sys.path.remove(str(folder))
    if hasattr(found, "app"):
        parse(found.app, words[2:], module)
        return
    parsed = []

    class ParsedError(Exception):
        """Ends the program when its arguments are known to be right."""

    def parse_args(self, *given, **options):
        parsed.append(read(self, *given, **options))
        raise ParsedError

    read = argparse.ArgumentParser.parse_args
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", parse_args)
        patch.setattr(sys, "argv", [module, *words[2:]])
        with pytest.raises(ParsedError):
            found.main()
    assert parsed


def check_dask(words):
    kind = importlib.import_module(f"distributed.cli.dask_{words[0]}")
    parse(kind.main, words[1:], "dask")


def check_pip(words):
    assert words[0] == "install"
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    for before, word in itertools.pairwise(words):
        if before == "-c":
            assert (ROOT / word).is_file()
        if word.startswith(".["):
            assert set(word[2:-1].split(",")) <= extras.keys()


def check_make(words):
    targets = re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(), re.M)
    assert set(words) <= set(targets)


def check(program, rest, folder):
    if program in APPS:
        check_own(program, rest)
    elif program == "python":
        check_python(rest, folder)
    else:
        {"dask": check_dask, "pip": check_pip, "make": check_make}[program](rest)


def problems(page):
    """Commands of a page that cannot be called. ``cd`` counts for those that follow in its block; a
    line of options alone goes on with the command above it.
    """
    before = []
    for block in blocks(page, SHELLS):
        folder = ROOT
        for words in split(block):
            while re.match(r"[A-Z_]+=", words[0]):
                name, _, value = words.pop(0).partition("=")
                if name == "PYTHONPATH" and not (ROOT / value).is_dir():
                    yield f"{page}: {value}: no such folder"
            if words[0].startswith("--"):
                words = [*before, *words]
            before = words
            try:
                if words[0] == "cd":
                    folder = folder / words[1]
                    assert folder.is_dir()
                else:
                    check(re.sub(r"^(../)?.venv/bin/", "", words[0]), words[1:], folder)
            except (Exception, SystemExit) as error:
                yield f"{page}: {shlex.join(words)}: {error!r}"


WITH_COMMANDS = [page for page in PAGES if any(blocks(page, SHELLS))]


@pytest.mark.parametrize("page", WITH_COMMANDS)
def test_every_command_of_a_page_can_be_called_as_it_stands_there(page):
    assert list(problems(page)) == []


@pytest.mark.parametrize(
    "line",
    [
        "attnwarp fit DATA --kinds 2dgs --out fits/bear",
        "attnwarp-eval scene list",
        "attnwarp-eval run quik",
        "python -m benchmarks.renders --quick",
        "python -m benchmarks.render --quicker",
        "cd evals",
        "make tests",
        "pip install '.[edit,evaluation]'",
        "dask worker tcp://HOST:8786 --threads 4",
        "PYTHONPATH=tests/helper attnwarp-eval studies",
        "some-program --option",
    ],
)
def test_a_command_that_cannot_be_called_is_found(line, tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text(f"```sh\n{line}    # as documents have it\n```\n")
    assert len(list(problems(page))) == 1


def test_every_benchmark_of_make_bench_needs_no_argument():
    (names,) = re.findall(r"^BENCHMARKS := (.+)$", (ROOT / "Makefile").read_text(), re.M)
    for name in names.split():
        check_python(["-m", f"benchmarks.{name}"], ROOT)
    with pytest.raises(SystemExit):  # it needs a folder
        check_python(["-m", "benchmarks.drift"], ROOT)


CHEAP = {
    "docs/start/quickstart.md": [
        "attnwarp render fits/mine/splats.ply my_capture --out fits/views",
        "attnwarp convert fits/mine/splats.ply mine.splat",
        "attnwarp undistort my_capture undistorted",
        "attnwarp-eval scenes list",
        "attnwarp-eval scenes edits bear",
        "attnwarp-eval encoders",
    ],
    "docs/measuring/hard-cases.md": ["attnwarp-eval stability --list"],
    "docs/measuring/studies.md": ["attnwarp-eval studies", "attnwarp-eval run my.yaml --dry-run"],
    "docs/measuring/gate.md": [
        "attnwarp-eval run study.yaml --out runs/before",
        "attnwarp-eval compare baseline.jsonl runs/before --update",
        "attnwarp-eval run study.yaml --out runs/after",
        "attnwarp-eval compare baseline.jsonl runs/after --html compare.html",
    ],
}
"""Commands that take seconds, in the order of their page."""

TINY = """name: tiny
size: 16
scenes: [spheres]
views: [yaw030]
spp: 1
splats: {count: 100}
variants: {a: {}}
probes: {depth: [a]}
"""


@pytest.mark.usefixtures("coarse_textures")
@pytest.mark.parametrize("page", CHEAP)
def test_cheap_commands_of_a_page_run_in_their_order(page, tmp_path, monkeypatch):
    small_capture.write(tmp_path)
    (tmp_path / "study.yaml").write_text(TINY)
    (tmp_path / "my.yaml").write_text(next(blocks("docs/measuring/studies.md", ("yaml",))))
    monkeypatch.chdir(tmp_path)
    named = [shlex.join(words) for block in blocks(page, SHELLS) for words in split(block)]
    places = [named.index(line) for line in CHEAP[page]]
    assert places == sorted(places)
    for line in CHEAP[page]:
        program, *rest = shlex.split(line)
        done = CliRunner().invoke(APPS[program], rest)
        assert done.exit_code == 0, (line, done.output)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "word", "folder"),
    [
        ("README.md", "attnwarp inspect", "out/snow"),
        ("docs/start/own-photographs.md", "attnwarp poses", "out/red"),
    ],
)
def test_the_block_of_an_own_capture_runs_as_printed(page, word, folder, tmp_path):
    """Oracle: the files that its lines name, and what the edit says first."""
    if "poses" in word:
        pytest.importorskip("pycolmap")
    (block,) = (block for block in blocks(page, SHELLS) if word in block and "export" in block)
    for program, *rest in split(block):
        # A window would wait for its user.
        more = ["--screenshot", "scene.png"] if rest[0] == "inspect" else []
        command = [sys.executable, "-m", program.replace("-", "_"), *rest, *more]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, (rest, done.stderr)
        said = [line for line in done.stderr.splitlines() if "warning" in line]
        # Pictures of the bear's smooth back may find no pose; and every capture is a photograph's
        # to a bundled editor.
        foreign = [line for line in said if "not its world" in line]
        assert rest[0] == "poses" or said == foreign, (rest, done.stderr)
        if rest[0] == "edit":
            changed = re.match(r"inside the mask the scene changed by ([\d.]+) dE00", done.stdout)
            assert float(changed[1]) > 10  # grass that turned to snow, a bear to red
    for name in ("fits/mine/splats.ply", f"{folder}/edited.ply", f"{folder}/index.html"):
        assert (tmp_path / name).is_file()
    assert page != "README.md" or (tmp_path / "scene.png").is_file()


def test_the_first_study_of_a_newcomer_can_be_read(tmp_path):
    (study,) = blocks("docs/start/quickstart.md", ("yaml",))
    (tmp_path / "mine.yaml").write_text(study)
    assert load_study(str(tmp_path / "mine.yaml")).scenes == ["bear", "spheres"]


def test_the_study_that_extends_another_on_its_page_says_what_it_keeps(tmp_path):
    """Oracle: the comments of the page."""
    _, extending = blocks("docs/measuring/studies.md", ("yaml",))
    (tmp_path / "mine.yaml").write_text(extending)
    mine, base = load_study(str(tmp_path / "mine.yaml")), load_study("ablation")
    assert mine.editing.options == base.editing.options | {"steps": 4}
    assert (mine.size, mine.seeds, mine.fronts) == (96, [1, 2], [])
    assert mine.variants == base.variants


def test_a_scheduler_as_the_documents_start_it_listens_at_one_address(tmp_path):
    """Oracle: the kernel's table of the ports that the process listens at."""
    page = "docs/measuring/studies.md"
    named = [
        words for block in blocks(page, SHELLS) for words in split(block) if words[0] == "dask"
    ]
    assert {words[1] for words in named} == {"scheduler", "worker"}
    assert all("--host" in words for words in named)
    text = " ".join((ROOT / page).read_text().split())
    assert "dask's ports have no password" in text and "On a machine with several users" in text
    (limit,) = re.findall(r"`(--dashboard-address \S+)`", text)
    (words,) = [words[1:] for words in named if words[1] == "scheduler"]
    options = [word.replace("HOST", "127.0.0.1") for word in words]
    file = tmp_path / "scheduler.json"
    scheduler = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "dask",
            *options,
            *limit.split(),
            "--port",
            "0",
            "--scheduler-file",
            str(file),
        ],
        stderr=subprocess.DEVNULL,
    )
    try:
        end = time.monotonic() + 60
        while not file.is_file() and scheduler.poll() is None and time.monotonic() < end:
            time.sleep(0.1)
        connections = psutil.Process(scheduler.pid).net_connections()
    finally:
        scheduler.terminate()
        scheduler.wait(30)
    places = {each.laddr.ip for each in connections if each.status == psutil.CONN_LISTEN}
    assert places == {"127.0.0.1"}
