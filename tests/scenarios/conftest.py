"""Folders shared by the scenarios of one session."""

from pathlib import Path

import pytest
from story import simulate


@pytest.fixture(scope="session")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder for captures and runs."""
    return tmp_path_factory.mktemp("scenarios")


@pytest.fixture(scope="session")
def hand_held(virest, work: Path) -> Path:
    """Simulate a phone held upright by hand: four small frames with about ten pixels of blur."""
    options = "--width 360 --height 480 --frames 4 --exposure-ms 14 --rate 2 --noise 2 --seed 5"
    return simulate(virest, work / "hand_held", *options.split())
