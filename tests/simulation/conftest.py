"""Small simulated captures, written once."""

import pytest
from capture_files import SMALL

from virest.app.simulate import simulate_command


@pytest.fixture(scope="session")
def plain_capture(tmp_path_factory):
    """Write a capture without hidden effects."""
    folder = tmp_path_factory.mktemp("sim") / "plain"
    simulate_command(folder, **SMALL)
    return folder


@pytest.fixture
def simulate(tmp_path):
    """Write a small capture with changed settings: ``simulate("name", effects=["flicker"])`` returns its folder."""

    def write(name, **changes):
        simulate_command(tmp_path / name, **{**SMALL, **changes})
        return tmp_path / name

    return write
