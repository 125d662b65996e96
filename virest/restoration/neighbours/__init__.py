"""Use of a frame's neighbours: to correct its motion, to restore it jointly, and to check the gain.

Two neighbouring frames show one scene, blurred along different paths.  Each of them, blurred along the other's path,
must look the same.  If they are displaced, the camera moved otherwise than predicted between them, and therefore also
during the exposures: the blur paths are corrected by what the frames show, whatever the cause.
"""
