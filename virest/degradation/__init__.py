"""The forward model: how motion, shutter and exposure write themselves into a picture. Nobody keeps a second one."""
