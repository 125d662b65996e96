"""Quality, shutter, speed and memory tables: ``python -m virest.app.bench``."""
