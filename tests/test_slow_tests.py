import ast
from pathlib import Path

TESTS = Path(__file__).parent
LIST = (TESTS.parent / "docs" / "testing.md").read_text()


def slow_tests():
    """(file, function) of each test that a mark of its own, of a case's or of its file makes slow."""
    for path in sorted(TESTS.rglob("test_*.py")):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.Assign) and "mark.slow" in ast.unparse(node):
                yield path, None
            elif isinstance(node, ast.FunctionDef) and any(
                "mark.slow" in ast.unparse(decorator) for decorator in node.decorator_list
            ):
                yield path, node.name


def test_the_documents_list_every_slow_test_and_no_other():
    listed = [line for line in LIST.splitlines() if line.startswith("| tests/")]
    slow = list(slow_tests())
    assert slow
    for path, name in slow:
        place = path.relative_to(TESTS.parent).as_posix()
        assert any(place in line and (name or "") in line for line in listed), (place, name)
    names = [name or path.name for path, name in slow]
    for line in listed:
        assert any(name in line for name in names), line
