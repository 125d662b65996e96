"""The row clock is written once: no other file adds readout and exposure to a start time."""

import ast
from collections.abc import Iterator

import pytest
from test_floors import FILES, FLOOR, PACKAGE, identify, parse, room_of

HOME = "image_formation/row_clock.py"
READERS = [
    path
    for path in FILES
    if path.parent != PACKAGE
    and FLOOR[room_of(path)] >= FLOOR["motion"]
    and room_of(path) != "simulation"
    and identify(path) != HOME
]
"""The simulator has its own physics; camera/ and capture/ are below the clock."""
BY_HAND = {
    "row through a pixel": "start + shutter.readout_fraction(p, w, h) * shutter.readout_time_s + 0.5 * exposure_s",
    "waiting time of a row": "waited_s = profile.shutter.readout_time_s * fraction[:, None]",
    "end of a frame": "end_s = motion.start_s + motion.readout_time_s + motion.exposure_s",
    "middle of a frame": "start_s + 0.5 * (readout_s + profile.shutter.true_exposure_s(logged))",
    "halves of a frame": "frame.time_s + readout_s / 2 + exposure_s / 2",
    "middle of a row": "middle = row_start_s + 0.5 * exposure",
    "share of a row": "motion.row_start_s(points_px) + anchor * motion.exposure_s",
    "share of a row, as an array": "row_s - np.linspace(-0.5, 0.5, n) * float(exposure_s)",
    "share in a product of three": "begin + 0.5 * (1 + instant) * exposure",
    "start of the first row": "profile.imu_time_s(profile.shutter.first_row_start_s(stamp_s, logged))",
}
ANOTHER_MATTER = {
    "offset at the middle row": "(profile.time_offset_s or 0.0) + 0.5 * profile.shutter.readout_time_s",
    "table's margin": "start_s - OUTSIDE_FRACTION * readout_s - STEP_S",
    "first row before a middle": "offset_s = -0.5 * shutter.readout_time_s",
    "scale of an exposure": "1.0 + 2.0 * (found_s - given_s) / exposure",
    "milliseconds": "1e3 * profile.shutter.readout_time_s",
    "phase over half an exposure": "half = 0.5 * omega * exposure_s",
    "another length about the same middle": "motion.start_s + 0.5 * (motion.exposure_s - seen.exposure_s)",
    "the simulator's own": "session.first_row_start_s(capture)",
    "the clock itself": "clock.middle_s(frame.time_s, frame.exposure_s or 0.0)",
}


def _bare(node: ast.expr) -> ast.expr:
    """The expression inside a conversion, float(...) or np.asarray(...), or an index."""
    while True:
        if isinstance(node, ast.Subscript):
            node = node.value
        elif isinstance(node, ast.Call) and _name(node.func) in ("float", "asarray") and node.args:
            node = node.args[0]
        else:
            return node


def _name(node: ast.expr) -> str:
    """The last name of a variable, an attribute or a called function."""
    node = node.func if isinstance(node, ast.Call) else node
    return node.id if isinstance(node, ast.Name) else getattr(node, "attr", "")


def _is_readout(node: ast.expr) -> bool:
    return _name(_bare(node)) in ("readout_time_s", "readout_s", "readout")


def _is_exposure(node: ast.expr) -> bool:
    return _name(_bare(node)) in ("exposure_s", "exposures_s", "exposure", "true_exposure_s", "logged_exposure_s")


def _is_constant(node: ast.expr) -> bool:
    node = node.operand if isinstance(node, ast.UnaryOp) else node
    return isinstance(node, ast.Constant) or _name(node).isupper()


SUM = (ast.Add, ast.Sub)


def _terms(node: ast.expr) -> list[ast.expr]:
    """The terms of a chain of + and −."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, SUM):
        return [*_terms(node.left), *_terms(node.right)]
    return [node]


def _factors(node: ast.expr) -> list[ast.expr]:
    """The factors of a chain of ×. A division gives its first operand's and 1, since dividing by a time is no share."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
        return [*_factors(node.left), *_factors(node.right)]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
        return [*_factors(node.left), ast.Constant(1)]
    return [node]


def _adds_rows(node: ast.BinOp) -> bool:
    """Whether a sum adds a share of an exposure to something, or readout and exposure."""
    terms = [_factors(term) for term in _terms(node)]
    shares = any(len(factors) > 1 and any(map(_is_exposure, factors)) for factors in terms)
    both = all(any(any(map(found, factors)) for factors in terms) for found in (_is_readout, _is_exposure))
    return shares or both


def _waits_for_rows(node: ast.BinOp) -> bool:
    """Whether a product multiplies the readout time by a fraction that is not constant."""
    factors = _factors(node)
    return any(map(_is_readout, factors)) and any(not _is_readout(f) and not _is_constant(f) for f in factors)


def row_clocks(tree: ast.AST) -> Iterator[ast.expr]:
    """Places where a file computes the row clock by hand."""
    for node in ast.walk(tree):
        match node:
            case ast.BinOp(op=ast.Add() | ast.Sub()) if _adds_rows(node):
                yield node
            case ast.BinOp(op=ast.Mult()) if _waits_for_rows(node):
                yield node
            case ast.Call(func=ast.Attribute(value=owner, attr="first_row_start_s")) if _name(owner) != "session":
                yield node


def test_the_row_clock_is_written_in_one_place() -> None:
    """Files get exposure times of rows from image_formation/row_clock.py, or from RowMotion, which uses it."""
    assert len(READERS) > 100
    found = [f"{identify(p)}:{node.lineno}: {ast.unparse(node)}" for p in READERS for node in row_clocks(parse(p))]
    assert not found, "row clock computed by hand; use image_formation/row_clock.py:\n" + "\n".join(found)


@pytest.mark.parametrize("written", BY_HAND.values(), ids=BY_HAND)
def test_a_row_clock_by_hand_is_detected(written: str) -> None:
    """Each way of writing the formula is detected."""
    assert list(row_clocks(ast.parse(written)))


@pytest.mark.parametrize("written", ANOTHER_MATTER.values(), ids=ANOTHER_MATTER)
def test_other_formulas_are_allowed(written: str) -> None:
    """Products and sums of the same quantities with another meaning are allowed."""
    assert not list(row_clocks(ast.parse(written)))


def test_the_row_clock_is_in_its_file() -> None:
    """The formula is detected in its own file."""
    assert list(row_clocks(parse(PACKAGE / HOME)))
