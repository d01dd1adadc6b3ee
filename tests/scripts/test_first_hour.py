import re
import sys
from pathlib import Path

import pytest

from scripts import first_hour

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.scripts

PAGE = """# A page
## 1. Wait
```sh
sleep 1; echo waited   # a second
touch there
```
## 2. Read
```yaml
# mine.yaml
name: mine
```
```yaml
name: not saved
```
```sh
test -f Makefile && test -f there && \\
    grep -q "name: mine" mine.yaml
```
"""


def walk(tmp_path, monkeypatch, page):
    (tmp_path / "page.md").write_text(page)
    out = tmp_path / "report/report.md"
    arguments = ["--page", tmp_path / "page.md", "--work", tmp_path / "work", "--out", out]
    monkeypatch.setattr(sys, "argv", ["first_hour", *map(str, arguments)])
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:/usr/bin:/bin")
    first_hour.main()
    return out.read_text()


def test_a_page_is_walked_in_a_clone_and_each_command_has_its_seconds(tmp_path, monkeypatch):
    """Oracle: a command that sleeps for a second takes one and computes nothing."""
    text = walk(tmp_path, monkeypatch, PAGE)
    rows = re.findall(r"^\| (\d\. \w+) \| `(.+)` \| (\d+) \| (\d+) \|$", text, re.M)
    assert [row[0] for row in rows] == ["1. Wait", "1. Wait", "2. Read"]
    wall, cpu = map(int, rows[0][2:])
    assert wall >= 1 > cpu
    assert (tmp_path / "work/clone/mine.yaml").read_text() == "# mine.yaml\nname: mine\n"
    assert "waited" in (tmp_path / "work/log.txt").read_text()


def test_a_command_that_fails_ends_the_walk_with_its_words_and_leaves_no_report(
    tmp_path, monkeypatch
):
    with pytest.raises(SystemExit, match="it broke\n.*exit code 3"):
        walk(tmp_path, monkeypatch, "```sh\necho it broke >&2; exit 3\ntouch later\n```\n")
    assert not (tmp_path / "report/report.md").exists()
    assert not (tmp_path / "work/clone/later").exists()


def test_the_page_of_the_first_hour_has_the_steps_that_it_promises():
    found = first_hour.steps((ROOT / first_hour.PAGE).read_text())
    assert [step.file for step in found if step.file] == ["mine.yaml"]
    text = "\n".join(step.text for step in found)
    for part in (
        "make demo",
        "attnwarp edit bear",
        "inspect runs/demo",
        "run mine.yaml",
        "scenes export",
        "attnwarp fit",
        "--masks",
    ):
        assert part in text
