"""Calibration of a phone from its own recordings: response curve and geometry."""
