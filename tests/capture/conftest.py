"""Tiny captures with known content."""

from __future__ import annotations

from pathlib import Path

import pytest
from capture_writing import CaptureWriter


@pytest.fixture
def writer(tmp_path: Path) -> CaptureWriter:
    """An intact capture of 30 frames, 64 × 96, not yet written."""
    return CaptureWriter(tmp_path / "2022_09_17_10_00_00")
