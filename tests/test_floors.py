"""The floors of the architecture: a file imports only from lower ones, and only some rooms open files or print."""

import ast
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "virest"
FLOOR = {
    "app": 11,
    "report": 10,
    "evaluation": 10,
    "diagnosis": 9,
    "restoration": 8,
    "calibration": 8,
    "inference": 7,
    "image_formation": 6,
    "simulation": 6,
    "motion": 5,
    "capture": 4,
    "effects": 3,
    "camera": 2,
    "errors": 1,
    "arrays": 1,
}
STRANGERS = {
    "simulation": {"image_formation", "inference", "motion", "restoration"},
    "image_formation": {"simulation"},
    "inference": {"simulation"},
}
"""Rooms that a room must not import although they are lower, so that a result never depends on the code it checks."""
ROOT_FILES = {"__init__.py", "__main__.py", "arrays.py", "errors.py"}
MAY_OPEN_ROOMS = {"capture", "report", "app"}
MAY_OPEN_FILES = {"camera/profile_file.py", "camera/yaml_mapping.py", "camera/kalibr.py", "simulation/recording.py"}
OPENERS = {"open", "read_text", "read_bytes", "write_text", "write_bytes", "imread", "imwrite", "read_csv", "to_csv",
           "loadtxt", "savetxt", "fromfile", "tofile", "memmap", "fdopen"}  # fmt: skip
FILES = sorted(path for path in PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    """The room of a file of the package; at the top level, the name of the file."""
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else path.stem


def imported_rooms(tree: ast.AST) -> set[str]:
    """Rooms of virest that a file imports from, also inside functions."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names |= (
                {f"{node.module}.{alias.name}" for alias in node.names} if node.module == "virest" else {node.module}
            )
    return {name.split(".")[1] for name in names if name.startswith("virest.")} & FLOOR.keys()


def calls(tree: ast.AST) -> set[str]:
    """Names of all functions and methods that a file calls."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            function = node.func
            found.add(function.id if isinstance(function, ast.Name) else getattr(function, "attr", ""))
    return found


@cache
def parse(path: Path) -> ast.Module:
    """Read the syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def identify(path: Path) -> str:
    """Path of a file in the package."""
    return path.relative_to(PACKAGE).as_posix()


def test_a_file_imports_only_from_lower_floors() -> None:
    """A file imports from its own room and from lower floors, without the excluded rooms."""
    for path in FILES:
        room = room_of(path)
        if path.parent == PACKAGE and room not in ("arrays", "errors"):
            assert path.name in ROOT_FILES, f"{path.name} belongs in a room"
            continue
        assert room in FLOOR, f"architecture.md has no room {room}"
        for other in imported_rooms(parse(path)) - {room}:
            assert FLOOR[other] < FLOOR[room], f"{identify(path)} (floor {FLOOR[room]}) imports {other}"
            assert other not in STRANGERS.get(room, set()), f"{identify(path)} imports {other}"


def test_no_import_is_relative() -> None:
    """Absolute imports name the room, so that floors can be checked."""
    relative = [
        identify(path)
        for path in FILES
        for node in ast.walk(parse(path))
        if isinstance(node, ast.ImportFrom) and node.level
    ]
    assert not relative


def test_only_the_listed_rooms_open_files() -> None:
    """Only some rooms and files touch the file system; everything else maps records to records."""
    closed = [path for path in FILES if room_of(path) not in MAY_OPEN_ROOMS and identify(path) not in MAY_OPEN_FILES]
    assert not {identify(path): found for path in closed if (found := calls(parse(path)) & OPENERS)}


def test_only_the_program_prints() -> None:
    """The library does not print: it logs, and gets progress callbacks as arguments."""
    for path in FILES:
        if room_of(path) == "app":
            continue
        nodes = list(ast.walk(parse(path)))
        touched = {node.attr for node in nodes if isinstance(node, ast.Attribute)
                   and isinstance(node.value, ast.Name) and node.value.id == "sys"}  # fmt: skip
        imported = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
        assert "print" not in calls(parse(path)), identify(path)
        assert not touched & {"stdout", "stderr", "exit"}, identify(path)
        assert "tqdm" not in imported, identify(path)


def test_every_exception_is_defined_in_errors() -> None:
    """Exit codes depend on the error tree, so only errors.py and app/cli.py define exceptions."""
    for path in FILES:
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.ClassDef) and identify(path) not in ("errors.py", "app/cli.py"):
                bases = {base.id for base in node.bases if isinstance(base, ast.Name)}
                assert not {b for b in bases if b.endswith(("Error", "Exception"))}, f"{identify(path)}: {node.name}"
