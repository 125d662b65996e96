"""The forward model: how motion, shutter and exposure form a picture. Nobody keeps a second one."""
