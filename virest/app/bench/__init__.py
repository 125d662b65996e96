"""Benchmarks of quality, accuracy, speed, memory and robustness: ``python -m virest.app.bench``."""
