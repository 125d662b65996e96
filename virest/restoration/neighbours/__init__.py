"""What a frame's neighbours tell of it: where the picture really moved, and how well the restored frame predicts them.

A movie holds its own truth.  Two neighbours show one scene, blurred along different paths; each, blurred as the other
was, must look the same.  Where they lie apart, the camera moved otherwise than predicted between the two, and so it did
over the exposures: the blur paths are corrected by what the frames show, whatever the cause.
"""
