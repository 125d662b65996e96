"""Evaluation: restored frames against ground truth, and against other methods given the same information."""
