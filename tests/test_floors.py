"""The floors of the house: a file imports only from lower ones, and only some rooms touch files or print."""

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
"""The judge does not read the accused's notes."""
ROOT_FILES = {"__init__.py", "__main__.py", "arrays.py", "errors.py"}
MAY_OPEN_ROOMS = {"capture", "report", "app"}
MAY_OPEN_FILES = {"camera/profile_file.py", "camera/yaml_mapping.py", "camera/kalibr.py", "simulation/recording.py"}
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


@cache
def parse(path: Path) -> ast.Module:
    """Read a file's syntax tree."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def identify(path: Path) -> str:
    """Name a file by its place in the package."""
    return path.relative_to(PACKAGE).as_posix()


def test_a_file_imports_only_from_lower_floors() -> None:
    """A file imports from its own room and from lower floors, and never from a stranger."""
    for path in FILES:
        room = room_of(path)
        if path.parent == PACKAGE and room not in ("arrays", "errors"):
            assert path.name in ROOT_FILES, f"{path.name} belongs into a room"
            continue
        assert room in FLOOR, f"{room} is no room of architecture.md"
        for other in imported_rooms(parse(path)) - {room}:
            assert FLOOR[other] < FLOOR[room], f"{identify(path)} (floor {FLOOR[room]}) imports {other}"
            assert other not in STRANGERS.get(room, set()), f"{identify(path)} imports {other}"


def test_no_file_imports_by_a_relative_path() -> None:
    """Imports name the room, so that the floors can be read off them."""
    relative = [
        identify(path)
        for path in FILES
        for node in ast.walk(parse(path))
        if isinstance(node, ast.ImportFrom) and node.level
    ]
    assert not relative


def test_only_the_named_rooms_open_files() -> None:
    """Edges touch files; everything else maps records to records."""
    closed = [path for path in FILES if room_of(path) not in MAY_OPEN_ROOMS and identify(path) not in MAY_OPEN_FILES]
    assert not {identify(path): found for path in closed if (found := calls(parse(path)) & OPENERS)}


def test_only_the_program_prints() -> None:
    """The library is silent: it logs, and takes progress as an argument."""
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


def test_every_error_of_the_library_is_of_the_tree() -> None:
    """Exit codes hang on the error tree: no module but errors.py defines an exception."""
    for path in FILES:
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.ClassDef) and identify(path) not in ("errors.py", "app/cli.py"):
                bases = {base.id for base in node.bases if isinstance(base, ast.Name)}
                assert not {b for b in bases if b.endswith(("Error", "Exception"))}, f"{identify(path)}: {node.name}"
