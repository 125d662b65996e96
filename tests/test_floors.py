"""The floors of the house: a file imports only from lower ones, and only some rooms touch files or print."""

import ast
from pathlib import Path

import pytest

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
}
STRANGERS = {
    "simulation": {"image_formation", "inference", "motion", "restoration"},
    "image_formation": {"simulation"},
    "inference": {"simulation"},
}
"""The judge does not read the accused's notes."""
ROOT_FILES = {"__init__.py", "__main__.py", "errors.py"}
MAY_OPEN_ROOMS = {"capture", "report", "app"}
MAY_OPEN_FILES = {"camera/profile.py", "camera/kalibr.py", "simulation/recording.py"}
OPENERS = {"open", "read_text", "read_bytes", "write_text", "write_bytes", "imread", "imwrite", "read_csv", "to_csv",
           "loadtxt", "savetxt", "fromfile", "tofile", "memmap", "fdopen"}  # fmt: skip
FILES = sorted(path for path in PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    """The room of a file of the package; the file's own name at the top level."""
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else path.stem


def imported_rooms(tree: ast.AST) -> set[str]:
    """Rooms of virest that a file imports from, inside functions too."""
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


def parse(path: Path) -> ast.Module:
    """Read a file's syntax tree."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def identify(path: Path) -> str:
    """Name a file by its place in the package."""
    return path.relative_to(PACKAGE).as_posix()


@pytest.mark.parametrize("path", FILES, ids=identify)
def test_a_file_imports_only_from_lower_floors(path: Path) -> None:
    """A file imports from its own room and from lower floors, and never from a stranger."""
    room = room_of(path)
    if path.parent == PACKAGE and room != "errors":
        assert path.name in ROOT_FILES, f"{path.name} belongs into a room"
        return
    assert room in FLOOR, f"{room} is no room of architecture.md"
    for other in imported_rooms(parse(path)) - {room}:
        assert FLOOR[other] < FLOOR[room], f"{identify(path)} (floor {FLOOR[room]}) imports {other} ({FLOOR[other]})"
        assert other not in STRANGERS.get(room, set()), f"{identify(path)} imports {other}"


@pytest.mark.parametrize("path", FILES, ids=identify)
def test_no_file_imports_by_a_relative_path(path: Path) -> None:
    """Imports name the room, so that the floors can be read off them."""
    assert not [node for node in ast.walk(parse(path)) if isinstance(node, ast.ImportFrom) and node.level]


@pytest.mark.parametrize("path", FILES, ids=identify)
def test_only_the_named_rooms_open_files(path: Path) -> None:
    """Edges touch files; everything else maps records to records."""
    if room_of(path) in MAY_OPEN_ROOMS or identify(path) in MAY_OPEN_FILES:
        return
    assert not calls(parse(path)) & OPENERS


@pytest.mark.parametrize("path", FILES, ids=identify)
def test_only_the_program_prints(path: Path) -> None:
    """The library is silent: it logs, and takes progress as an argument."""
    if room_of(path) == "app":
        return
    tree = parse(path)
    assert "print" not in calls(tree)
    touched = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)
               and isinstance(node.value, ast.Name) and node.value.id == "sys"}  # fmt: skip
    assert not touched & {"stdout", "stderr", "exit"}
    assert "tqdm" not in {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}


def test_every_error_of_the_library_is_of_the_tree() -> None:
    """Exit codes hang on the error tree: no module but errors.py defines an exception."""
    for path in FILES:
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.ClassDef) and identify(path) not in ("errors.py", "app/cli.py"):
                bases = {base.id for base in node.bases if isinstance(base, ast.Name)}
                assert not {b for b in bases if b.endswith(("Error", "Exception"))}, f"{identify(path)}: {node.name}"
