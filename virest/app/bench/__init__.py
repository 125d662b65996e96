"""Quality, shutter, speed, growth, memory and command tables: ``python -m virest.app.bench``."""
