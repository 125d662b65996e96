"""How the camera moved: orientation and displacement from the inertial samples, and the lens that moves with them."""
