"""virest: visual-inertial restoration of shaken, rolling-shutter phone captures.

The folders follow the river from light to picture: camera -> capture -> motion -> degradation -> restoration.
Import from the room that you need (``from virest.camera.profile import read_profile``); this file stays light.
"""

__version__ = "0.1.0"
