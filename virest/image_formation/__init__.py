"""The forward model: image formation by motion, shutter and exposure, shared by all but the simulator."""
