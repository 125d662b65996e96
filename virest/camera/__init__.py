"""The phone: lens, shutter, exposure curve, and the profile that holds them."""
